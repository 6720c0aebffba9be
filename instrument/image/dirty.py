"""Imager: dirty images of I, Q, U, V and the PSF, on ducc0's w-gridder, block by block."""

from __future__ import annotations

from collections.abc import Iterable
from functools import cached_property
from typing import Annotated, Any

import numpy as np
from pydantic import Field

from instrument.checked import checked
from instrument.errors import InputError, RefusedError, warn
from instrument.image.base import AnyImager, ImageSums
from instrument.image.cube import StokesCube
from instrument.image.psf import fit_psf
from instrument.image.weights import Density, Weighting
from instrument.observe.directions import LIGHT
from instrument.predict.operator import ImageOperator
from instrument.units import Complex, Float
from instrument.visibilities import Visibilities, VisibilitySet
from instrument.visibility_sets import as_set

HELD = 400_000  # visibilities of a channel gridded at once: more makes a call of 512 pixels 6 % cheaper at most
ALL_HELD = 5 * HELD  # visibilities that wait in all channels together: bounds memory (192 MB)
ALIKE = 1e-3  # of the peak, by which the PSF of U and V may differ from that of I unsaid
WAITING = 96  # bytes of a visibility that waits: u, v, w, weight, I, Q, U, V


@checked
class Imager(AnyImager):
    """Dirty images of `pixels` x `pixels` of `pixel` each, from baselines within `uv_range` (wavelengths).

    `weighting` "natural", "uniform" or "briggs" (with `robust`). The w-term is always there. `accuracy` is that of the
    gridding: the error of every pixel is below it times the weighted mean of |V|, which no pixel of an image exceeds.
    Flagged and non-finite visibilities have no weight.
    Where correlations have weights or flags of their own, so have I, Q, U and V (`stokes_weight`); the PSF is then that
    of Stokes I.
    """

    weighting: Weighting = "natural"
    robust: Annotated[float, Field(ge=-4, le=4)] = 0.0
    accuracy: Annotated[float, Field(ge=1e-12, le=1e-2)] = 1e-6

    def image(
        self, visibilities: VisibilitySet | Iterable[Visibilities], operator: ImageOperator | None = None
    ) -> StokesCube:
        """Dirty images in Jy/beam (F, 4, N, N) with their PSF, of visibilities or of blocks of them.

        Blocks must cover channels one after the other or all at once. Weights other than natural go over the blocks
        twice, so an iterator that can be read only once is refused.
        """
        natural = self.weighting == "natural"
        given = as_set(visibilities, twice="" if natural else f"{self.weighting} weights")
        total = self.start(self.density(given))
        for block in given.blocks():
            total.add(block)
        return total.finish()

    def start(self, density: dict[float, Density] | None = None) -> Images:
        """Sums to which blocks are added one by one; `density` is needed for weights other than natural."""
        if (density is None) != (self.weighting == "natural"):
            raise InputError(f"{self.weighting} weights {'take no' if density else 'need the'} density of the uv plane")
        return Images(self, density)

    def density(self, visibilities: VisibilitySet) -> dict[float, Density] | None:
        """Density of the uv plane in every channel (by frequency), for weights other than natural."""
        if self.weighting == "natural":
            return None
        found: dict[float, Density] = {}
        for block in visibilities.coverage():
            for f, freq in enumerate(block.freq_hz):
                uvw, weight, _ = self.chosen_stokes(block, f)
                found.setdefault(float(freq), Density(self.pixels, self.pixel)).add(uvw[:, :2], weight)
        return found

    @property
    def idle(self) -> bool:
        """Whether a robust was given that the weighting does not take."""
        return self.weighting != "briggs" and "robust" in self.model_fields_set

    def error(self) -> str:
        """That of the gridding."""
        return f"gridding {self.accuracy:.0e} of the mean |V|"


class _Channel:
    """Images of one channel: visibilities waiting to be gridded, and what has been."""

    def __init__(self, freq_hz: float, pixels: int) -> None:
        self.freq_hz, self.pixels = freq_hz, pixels
        self.waiting: list[tuple[Float, Float, Complex]] = []
        self.count = 0
        self.weight = np.zeros(4)  # of I, Q, U, V
        self.crossed: Float | None = None  # the PSF of U and V (N, N), where their weights are not those of I and Q

    @cached_property
    def sums(self) -> Float:
        """Of I, Q, U, V and the PSF (5, N, N); there from the first gridding on."""
        return np.zeros((5, self.pixels, self.pixels))


class Images(ImageSums):
    """Sums of images over blocks of visibilities; `finish` gives the cube, with its PSF unless `lobes` is False."""

    def __init__(self, imager: Imager, density: dict[float, Density] | None, lobes: bool = True) -> None:
        self.imager = imager
        self.density = density
        self.lobes = lobes
        self.channels: dict[float, _Channel] = {}
        self.centre: Any = None
        self.waiting = 0  # visibilities, in all channels

    def add(self, block: Visibilities) -> None:
        """Add a block."""
        self.centre = self.centre or block.phase_centre
        if block.phase_centre != self.centre:
            raise InputError("blocks with different phase centres cannot be imaged together")
        stokes = None
        for f, freq in enumerate(block.freq_hz):
            channel = self.channels.setdefault(float(freq), _Channel(float(freq), self.imager.pixels))
            uvw, weight, use = self.imager.chosen_stokes(block, f)
            if not len(weight):
                continue
            if self.density is not None:
                factor = self.density[float(freq)].factor(uvw[:, :2], self.imager.weighting, self.imager.robust)
                weight = weight * factor
            stokes = block.stokes() if stokes is None else stokes
            # of no weight, the data may be NaN
            channel.waiting.append((uvw, weight, np.where(weight > 0, stokes[:, f][use], 0.0)))
            channel.count += len(weight)
            self.waiting += len(weight)
            if channel.count >= HELD:
                self._grid(channel)
        while self.waiting > ALL_HELD:
            self._grid(max(self.channels.values(), key=lambda c: c.count))

    def _grid(self, channel: _Channel) -> None:
        """Sum_k w_k V_k exp(+2 pi i (u l + v m + w (n-1))), real part, for I, Q, U, V and for V = 1."""
        if not channel.count:
            return
        from ducc0.wgridder.experimental import vis2dirty

        most = max(weight.shape[1] for _, weight, _ in channel.waiting)
        waiting = ((uvw, np.broadcast_to(w, (len(w), most)), values) for uvw, w, values in channel.waiting)
        uvw, weight, stokes = (np.concatenate(parts) for parts in zip(*waiting, strict=True))
        columns, images = [*np.moveaxis(stokes, -1, 0)], [*channel.sums]
        if self.lobes:
            columns.append(np.ones(len(weight), complex))
        if self.lobes and (most > 1 or channel.crossed is not None):
            channel.crossed = images[4].copy() if channel.crossed is None else channel.crossed  # alike until now
            images, columns = [*images, channel.crossed], [*columns, columns[-1]]
        weights = np.broadcast_to(weight, (len(weight), 4)).T
        for image, values, k in zip(images, columns, (0, 1, 2, 3, 0, 2), strict=False):
            if not values.any():  # a Stokes parameter that is exactly zero
                continue
            # ducc0 has exp(+2 pi i (u l + v m - w (n-1))) for the adjoint: flip w; x to the west: flip u
            image += vis2dirty(
                uvw=uvw * (LIGHT / channel.freq_hz),
                freq=np.array([channel.freq_hz]),
                vis=np.ascontiguousarray(values)[:, None],
                wgt=np.ascontiguousarray(weights[k])[:, None],
                npix_x=self.imager.pixels,
                npix_y=self.imager.pixels,
                pixsize_x=self.imager.pixel,
                pixsize_y=self.imager.pixel,
                # half of it: ducc0's is an rms, and the largest error, at the edge, was up to 1.5 times that asked for.
                # One visibility is then wrong by 0.52 times the accuracy at most, and errors add up at worst
                epsilon=max(self.imager.accuracy / 2, 1e-12),
                do_wgridding=True,
                divide_by_n=False,
                flip_u=True,
                flip_w=True,
                nthreads=0,
            ).T
        channel.weight += weight.sum(axis=0)
        self.waiting -= channel.count
        channel.waiting, channel.count = [], 0

    def finish(self) -> StokesCube:
        """The cube in Jy/beam; a channel without any visibility is NaN; raises when no channel has one."""
        from astropy import units as u

        freqs = sorted(self.channels)
        if not freqs:
            raise RefusedError("no block of visibilities was given: nothing to image")
        pixels = self.imager.pixels
        planes, psfs = np.empty((len(freqs), 4, pixels, pixels)), np.empty((len(freqs), pixels, pixels))
        apart = 0.0
        for f, freq in enumerate(freqs):
            channel = self.channels[freq]
            self._grid(channel)
            with np.errstate(divide="ignore", invalid="ignore"):
                np.divide(channel.sums[:4], channel.weight[:, None, None], out=planes[f])
                np.divide(channel.sums[4], channel.weight[0], out=psfs[f])
                if channel.crossed is not None and channel.weight[[0, 2]].all():
                    apart = max(apart, float(np.abs(channel.crossed / channel.weight[2] - psfs[f]).max()))
            del channel.sums  # a sum and its image at once: twice the cube for one channel only
        if not any(self.channels[f].weight.any() for f in freqs):
            raise RefusedError(f"no visibility lies within uv_range = {self.imager.uv_range} with a weight above 0")
        if apart > ALIKE:
            warn(f"the PSF of U and V differs by {apart:.2g} of its peak from that of I, which the cube has")
        return StokesCube(
            data=planes,
            frequencies=np.array(freqs) * u.Hz,
            pixel=self.imager.pixel * u.rad,
            unit="Jy/beam",
            centre=self.centre,
            psf=fit_psf(psfs, self.imager.pixel) if self.lobes else None,
        )

    @property
    def weights(self) -> Float:
        """Sums of weights of I, Q, U, V in the channels, in order of frequency (F, 4)."""
        return np.stack([self.channels[freq].weight for freq in sorted(self.channels)])
