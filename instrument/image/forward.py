"""Visibilities of model images, through an operator or by ducc0's w-gridder; and sets of visibilities less them."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np

from instrument import correlations, mat2
from instrument.errors import InputError
from instrument.observe.directions import LIGHT
from instrument.observe.grid import ImageGrid
from instrument.predict.gridding import Gridder
from instrument.predict.operator import ImageOperator
from instrument.units import Bool, Complex, Float
from instrument.visibilities import Visibilities, VisibilitySet

SAME = 1e-9  # of a frequency or a second, by which blocks and an operator may differ


class Forward(ABC):
    """What takes images to the visibilities of a block."""

    @abstractmethod
    def data(self, block: Visibilities, images: Float) -> Complex:
        """Visibilities (T, F, B, 2, 2) in Jy of images (F, 4, Ny, Nx) in Jy/pixel of the channels of a block."""


@dataclass(frozen=True)
class Degridded(Forward):
    """Of points at the pixels without any beam, to an `accuracy` of the total flux; 0 outside `uv_range`."""

    grid: ImageGrid
    accuracy: float
    uv_range: tuple[float, float] | None = None

    def data(self, block: Visibilities, images: Float) -> Complex:
        """sum_p I_p exp(-2 pi i (u l + v m + w (n-1)))."""
        stokes = np.zeros((*block.data.shape[:3], 4), complex)
        low, high = self.uv_range or (0.0, np.inf)
        length = np.hypot(block.uvw_m[..., 0], block.uvw_m[..., 1])
        for f, freq in enumerate(block.freq_hz):
            inside = (length >= low * LIGHT / freq * (1 - SAME)) & (length <= high * LIGHT / freq * (1 + SAME))
            # the error of one visibility, as that of a pixel of `dirty`, whose adjoint this is
            uvw = block.uvw_m[inside] * (freq / LIGHT)
            gridder = Gridder(uvw, self.grid.pixels, self.grid.pixel, self.accuracy / 2, threads=0)
            for k, image in enumerate(images[f]):
                if not (image.any() and inside.any()):
                    continue
                stokes[:, f, :, k][inside] = gridder.visibilities(image)
        i, q, u, v = np.moveaxis(stokes, -1, 0)
        return mat2.pack(i + q, u + 1j * v, u - 1j * v, i - q)


@dataclass(frozen=True)
class Operated(Forward):
    """Through an operator, whose times, channels and stations must hold those of the blocks."""

    operator: ImageOperator

    def data(self, block: Visibilities, images: Float) -> Complex:
        """A x, of whole atoms of the operator, cut to the block."""
        at = self.operator.problem.at
        if block.layout.names != at.layout.names:
            raise InputError("the operator is of other stations than the visibilities, or in another order")
        if block.beam_state.removed != "nothing" and self.operator.problem.chain.terms:
            raise InputError(
                f"these visibilities have had a beam taken out ({block.beam_state}), which the operator has: give them "
                "as they were"
            )
        whole, cuts = [], []
        for axis, (mine, its) in enumerate(((block.at.slots_s, at.slots_s), (block.freq_hz, at.freq_hz))):
            first = int(np.argmin(np.abs(its - mine[0])))
            last, step = first + len(mine), self.operator.atom[axis]
            if last > len(its) or np.any(np.abs(its[first:last] - mine) > SAME * np.abs(mine)):
                what = ("times", "channels")[axis]
                raise InputError(f"the operator has not the {what} of the visibilities: prepare it for the same scene")
            begin, end = first // step * step, min(-(-last // step) * step, len(its))
            whole.append(slice(begin, end))
            cuts.append(slice(first - begin, last - begin))
        planes = np.zeros((whole[1].stop - whole[1].start, *images.shape[1:]))
        planes[cuts[1]] = images
        found = self.operator.forward(planes, whole[0], whole[1], (block.antenna1, block.antenna2))
        return found[tuple(cuts)]


@dataclass(frozen=True)
class Less(VisibilitySet):
    """A set less the visibilities of images (F, 4, Ny, Nx) of channels at `freq_hz`."""

    given: VisibilitySet
    forward: Forward
    images: Float
    freq_hz: Float

    def blocks(self) -> Iterator[Visibilities]:
        """The blocks, less those of the images."""
        for block in self.given.blocks():
            rows = np.searchsorted(self.freq_hz, block.freq_hz)
            yield block.with_data(block.data - self.forward.data(block, self.images[rows]))


@dataclass(frozen=True)
class Alike(VisibilitySet):
    """A set in which every visibility has one weight for all Stokes parameters that its channel has.

    CLEAN takes what it finds in one out of all with one PSF. A visibility of which one correlation is not known is left
    out, unless no visibility of the channel knows it: then the Stokes parameters made of it are not there.
    """

    given: VisibilitySet
    known: dict[float, Bool]  # of each channel: whether any visibility knows I and Q, U and V

    @classmethod
    def of(cls, given: VisibilitySet) -> VisibilitySet:
        """The set as it is where weights are of whole visibilities."""
        known: dict[float, Bool] = {}
        for block in given.coverage():
            if block.weight.ndim < correlations.APART:
                continue
            there = np.asarray((block.stokes_weight > 0).any(axis=(0, 2)))[:, [0, 2]]
            for freq, one in zip(block.freq_hz.tolist(), there, strict=True):
                known[freq] = known.get(freq, np.zeros(2, bool)) | one
        return cls(given, known) if known else given

    def blocks(self) -> Iterator[Visibilities]:
        """The blocks, with weights of their own."""
        for block in self.given.blocks():
            each = np.broadcast_to(block.stokes_weight, (*block.data.shape[:3], 4))[..., [0, 2]]
            known = np.array([self.known.get(freq, np.ones(2, bool)) for freq in block.freq_hz.tolist()])
            both = np.asarray(known.all(axis=1))[None, :, None]
            common = np.where(both, each.min(axis=-1), each.max(axis=-1))
            pair = np.where(known[None, :, None], common[..., None], 0.0)
            weight = np.empty((*block.data.shape[:3], 2, 2))
            weight[..., 0, 0] = weight[..., 1, 1] = pair[..., 0]
            weight[..., 0, 1] = weight[..., 1, 0] = pair[..., 1]
            yield replace(block, weight=weight, flag=np.zeros((1, 1, 1), bool))
