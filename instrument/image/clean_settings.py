"""Cleaning: the settings of a CLEAN, checked."""

from __future__ import annotations

from typing import Annotated, Any, ClassVar, Literal, Self

from pydantic import Field, field_validator, model_validator

from instrument.errors import InputError
from instrument.image.base import SolvingImager
from instrument.image.dirty import Imager
from instrument.image.weights import Weighting
from instrument.numbers import TOLERANCE
from instrument.units import ArrayOf, Count, Jansky, Radians


class Cleaning(SolvingImager):
    """What an imager that cleans is told; `CleanImager` says what each means."""

    restores: ClassVar[bool] = True
    planes_held: ClassVar[float] = 32  # residual, model, its best, PSF and transforms of twice the size
    planes_made: ClassVar[float] = 13
    weighting: Weighting = "natural"
    robust: Annotated[float, Field(ge=-4, le=4)] = 0.0
    accuracy: Annotated[float, Field(ge=1e-12, le=1e-2)] = 1e-6
    algorithm: Literal["hogbom", "multiscale"] = "hogbom"
    scales: tuple[Annotated[Radians, Field(ge=0)], ...] = ()
    peaks: Literal["each", "joint", "I"] = "each"
    terms: Count | None = None
    mask: Annotated[Any, ArrayOf(bool, (None, None))] | None = None
    auto_mask: Annotated[float, Field(gt=0)] | None = None
    negative: bool = True
    gain: Annotated[float, Field(gt=0, le=1)] = 0.1
    major_gain: Annotated[float, Field(gt=0, le=1)] = 0.8
    cycles: Count = 12
    iterations: Count = 100_000
    threshold: Annotated[Jansky, Field(ge=0)] = 0.0
    sigma: Annotated[float, Field(ge=0)] = 3.0
    backend: Literal["own", "radler"] = "own"
    beams: bool = False
    tolerance: Annotated[float, TOLERANCE] = 1e-5

    @field_validator("gain", "major_gain", mode="before")
    @classmethod
    def _converges(cls, value: Any) -> Any:
        if isinstance(value, int | float) and not 0 < value <= 1:
            raise InputError(f"a gain of {value} must be above 0 and at most 1: a CLEAN with more does not end")
        return value

    @model_validator(mode="after")
    def _consistent(self) -> Self:
        if self.mask is not None and self.mask.shape != (self.pixels, self.pixels):
            raise InputError(f"mask has shape {self.mask.shape}, needed that of the images, {(self.pixels,) * 2}")
        if self.mask is not None and not self.mask.any():
            raise InputError("mask is false everywhere: no component could be anywhere, take kind = 'dirty'")
        if self.auto_mask is not None and self.auto_mask <= self.sigma:
            raise InputError(
                f"auto_mask = {self.auto_mask:g} is not above sigma = {self.sigma:g}: nothing would be left to clean "
                "within it; lower sigma"
            )
        if self.scales and self.algorithm != "multiscale":
            raise InputError("scales are of algorithm = 'multiscale': say so, or leave them out")
        if self.scales and max(self.scales) > self.pixels * self.pixel:
            raise InputError(
                f"scales: {max(self.scales):.4g} rad is wider than the images, {self.pixels * self.pixel:.4g}"
            )
        return self

    @property
    def through_beams(self) -> bool:
        """Where it was asked for."""
        return self.beams

    @property
    def operator_tolerance(self) -> float:
        """As it was asked for."""
        return self.tolerance

    @property
    def operator_passes(self) -> float:
        """The model of each cycle, at most."""
        return float(self.cycles) if self.beams else 0.0

    @property
    def passes(self) -> int:
        """The first images, and those of each cycle."""
        return self.cycles + 1

    @property
    def dirty(self) -> Imager:
        """What makes its dirty images."""
        from astropy import units as u

        same = {name: getattr(self, name) for name in ("pixels", "uv_range", "weighting", "robust", "accuracy")}
        return Imager(pixel=self.pixel * u.rad, **same)
