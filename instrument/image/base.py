"""AnyImager: what makes images of visibilities, a plugin kind; and sums of images to which blocks are added."""

from __future__ import annotations

import tempfile
from abc import ABC, abstractmethod
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any, ClassVar, Self

import numpy as np
from pydantic import Field, field_validator, model_validator

from instrument.checked import checked
from instrument.component import Component
from instrument.errors import FileError, InputError, RefusedError
from instrument.image.cube import StokesCube
from instrument.image.pixel_map import PixelMap
from instrument.image.psf import Psf
from instrument.image.weights import Density
from instrument.observe.directions import LIGHT
from instrument.observe.grid import ImageGrid
from instrument.predict.operator import ImageOperator
from instrument.sky.base import PlacedSky
from instrument.store import StoreWriter
from instrument.units import Direction, Float, Radians
from instrument.visibilities import Visibilities, VisibilitySet
from instrument.visibility_sets import VisibilityFile


@dataclass(frozen=True)
class Imaged:
    """What an imager has made: the cube, cubes beside it by name (a residual), and what a run records of it.

    `maps` are by name what else is known of its pixels (noise amplification), which a run writes beside the cube.
    """

    cube: StokesCube
    beside: Mapping[str, StokesCube] = field(default_factory=dict)
    record: Mapping[str, Any] = field(default_factory=dict)
    maps: Mapping[str, PixelMap] = field(default_factory=dict)


class ImageSums(ABC):
    """Images in the making: blocks are added as they come by, `finish` gives the cube."""

    @abstractmethod
    def add(self, block: Visibilities) -> None:
        """Add a block."""

    @abstractmethod
    def finish(self) -> StokesCube:
        """The cube; raises `RefusedError` where nothing was added."""

    def everything(self) -> Imaged:
        """The cube, in place of `finish`, and what the imager makes beside it."""
        return Imaged(self.finish())


@checked
class AnyImager(Component):
    """Makes images of `pixels` x `pixels` of `pixel` each, of baselines within `uv_range` (wavelengths).

    A subclass writes `image`. Those that can add blocks up as they come by write `start` too; for the others a run
    keeps the blocks in a file until all are there.
    """

    plugin_kind: ClassVar[str | None] = "imagers"
    restores: ClassVar[bool] = False  # whether what it gives is more than the sums of visibilities: a CLEAN, say
    planes_held: ClassVar[float] = 10  # images a channel, while it works, and of what it gives: for the plan of a run
    planes_made: ClassVar[float] = 5
    pixels: Annotated[int, Field(ge=16, le=32768)]
    pixel: Annotated[Radians, Field(gt=0)]
    uv_range: tuple[float, float] | None = None

    @property
    def through_beams(self) -> bool:
        """Whether a run gives it the operator of its beams."""
        return False

    @property
    def operator_tolerance(self) -> float:
        """That of the operator of a run, for imagers that look through beams."""
        return 1e-5

    @field_validator("pixels")
    @classmethod
    def _even(cls, value: int) -> int:
        if value % 2:
            raise InputError(f"pixels = {value} must be even: take {value + 1}")
        return value

    @model_validator(mode="after")
    def _on_the_sky(self) -> Self:
        self.grid().on_the_sky()
        return self

    @field_validator("uv_range")
    @classmethod
    def _ordered(cls, value: tuple[float, float] | None) -> tuple[float, float] | None:
        if value is not None and not 0 <= value[0] < value[1]:
            raise InputError(f"uv_range = {value} must be two numbers of wavelengths, the smaller one first")
        return value

    def grid(self, centre: Direction | None = None) -> ImageGrid:
        """The pixels of its images, about a phase centre."""
        return ImageGrid.of((self.pixels, self.pixels), self.pixel, centre)

    @abstractmethod
    def image(
        self, visibilities: VisibilitySet | Iterable[Visibilities], operator: ImageOperator | None = None
    ) -> StokesCube:
        """Images in Jy/beam (F, 4, N, N) of visibilities or of blocks of them, gone through as often as needed.

        `operator` is the map from images to these visibilities, for imagers that know beams or subtract what they find.
        """

    def imaged(
        self, visibilities: VisibilitySet | Iterable[Visibilities], operator: ImageOperator | None = None
    ) -> Imaged:
        """What `image` gives, and the cubes beside it, of imagers that make any."""
        return Imaged(self.image(visibilities, operator))

    def chosen(self, block: Visibilities, channel: int) -> tuple[Float, Float, Any]:
        """Baselines in wavelengths (N, 3) within the uv range, their weights (N,), and which ones (T, B) they are.

        One weight for each visibility, 0 where a correlation is not known; `chosen_stokes` has those of I, Q, U, V.
        """
        uvw, weight, use = self._within(block, channel, block.whole_weight[..., None])
        return uvw, weight[:, 0], use

    def chosen_stokes(self, block: Visibilities, channel: int) -> tuple[Float, Float, Any]:
        """The same with weights of I, Q, U, V (N, 4), or (N, 1) where one holds for all; one above 0 at least."""
        return self._within(block, channel, block.stokes_weight)

    def _within(self, block: Visibilities, channel: int, weights: Float) -> tuple[Float, Float, Any]:
        uvw = block.uvw_m * (block.freq_hz[channel] / LIGHT)
        weight = np.broadcast_to(weights, (*block.data.shape[:3], weights.shape[-1]))[:, channel]
        use = (weight > 0).any(axis=-1)
        if self.uv_range is not None:
            length = np.hypot(uvw[..., 0], uvw[..., 1])
            use = use & (length >= self.uv_range[0]) & (length <= self.uv_range[1])
        return uvw[use], weight[use], use

    def psf(self, visibilities: VisibilitySet | Iterable[Visibilities]) -> Psf:
        """The point spread function alone, peak 1; raises `RefusedError` where its images have none."""
        found = self.image(visibilities).psf
        if found is None:
            raise RefusedError(f"{type(self).__name__} gives no PSF")
        return found

    @property
    def operator_passes(self) -> float:
        """How often visibilities are taken through the operator of a run, there or back: for its plan."""
        return 0.0

    def for_sky(self, sky: PlacedSky, centre: Direction) -> Self:
        """What a run takes in its place, for one that can use what the run knows of its sky: itself."""
        return self

    def density(self, visibilities: VisibilitySet) -> dict[float, Density] | None:
        """What weights need to know of all visibilities before the first is added; `None`: nothing."""
        return None

    def start(self, density: dict[float, Density] | None = None) -> ImageSums:
        """Sums to which blocks are added one by one."""
        return Kept(self)

    @property
    def passes(self) -> int:
        """How often it goes through the visibilities at most, for the seconds of a plan."""
        return 1

    def error(self) -> str:
        """How wrong its images may be, in words."""
        return ""


@checked
class SolvingImager(AnyImager):
    """An imager that makes a model of the sky too: a subclass writes `imaged`, whose cube is the image."""

    def image(
        self, visibilities: VisibilitySet | Iterable[Visibilities], operator: ImageOperator | None = None
    ) -> StokesCube:
        """Images in Jy/beam (F, 4, N, N) with their PSF; see `imaged`."""
        return self.imaged(visibilities, operator).cube

    @abstractmethod
    def imaged(
        self, visibilities: VisibilitySet | Iterable[Visibilities], operator: ImageOperator | None = None
    ) -> Imaged:
        """The images, cubes of the same size beside them, and how it ended."""


class Kept(ImageSums):
    """Blocks kept in a file of their own, for an imager that goes through all of them, or more than once."""

    def __init__(self, imager: AnyImager, operator: ImageOperator | None = None) -> None:
        self.imager, self.operator = imager, operator
        self.folder = tempfile.TemporaryDirectory(prefix="instrument-")
        self.path = Path(self.folder.name) / "blocks.h5"
        self.writer: StoreWriter | None = None

    def add(self, block: Visibilities) -> None:
        """Write a block."""
        with self._on_disk():
            self.writer = self.writer or StoreWriter(self.path, block)
            self.writer.add(block)

    def finish(self) -> StokesCube:
        """The images; the file is gone afterwards."""
        return self.everything().cube

    def everything(self) -> Imaged:
        """All that the imager makes; the file is gone afterwards."""
        with self.folder:
            if self.writer is None:
                raise RefusedError("no block of visibilities was given: nothing to image")
            with self._on_disk():
                self.writer.finish()
            return self.imager.imaged(VisibilityFile(self.path), self.operator)

    @contextmanager
    def _on_disk(self) -> Iterator[None]:
        """Says of an error of the disk where blocks are kept, and how to keep them elsewhere."""
        try:
            yield
        except OSError as error:
            why = error.strerror or str(error)
            raise FileError(
                f"blocks for {type(self.imager).__name__} cannot be kept in {self.folder.name}: {why}; "
                "TMPDIR names a folder with more room"
            ) from None
