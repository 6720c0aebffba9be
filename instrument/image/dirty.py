"""Imager: dirty images of I, Q, U, V and the PSF, by ducc0's w-gridder, of few samples where times allow."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace
from functools import cached_property
from typing import Annotated, Any

import numpy as np
from pydantic import Field

from instrument.checked import checked
from instrument.errors import InputError, RefusedError, warn
from instrument.image.base import AnyImager, ImageSums
from instrument.image.clock import Clock
from instrument.image.cube import StokesCube
from instrument.image.psf import fit_psf
from instrument.image.sparse import FEW, Comb, Span
from instrument.image.weights import Density, Weighting
from instrument.jones import mueller
from instrument.memory import give_back
from instrument.observe.directions import LIGHT
from instrument.predict.gridding import Gridder
from instrument.predict.operator import ImageOperator
from instrument.units import Complex, Float, Int
from instrument.visibilities import Visibilities, VisibilitySet
from instrument.visibility_sets import as_set

FREED = 64e6  # bytes freed, after which the system gets them back
HELD = 400_000  # visibilities or samples of a channel gridded at once: more makes 512 pixels 6 % cheaper at most
ALL_HELD = 5 * HELD  # visibilities that wait in all channels together, and samples (unless `_few`): 192 and 160 MB
ALIKE = 1e-3  # of the peak, by which the PSF of U and V may differ from that of I unsaid
WAITING = 96  # bytes of a visibility that waits: data, u, v, w, weight


@checked
class Imager(AnyImager):
    """Dirty images of `pixels` x `pixels` of `pixel` each, from baselines within `uv_range` (wavelengths).

    `weighting` "natural", "uniform" or "briggs" (with `robust`). The w-term is always there. `accuracy` is that of
    the images: the error of every pixel is below it times the weighted mean of |V|, which no pixel of an image exceeds.
    Where integrations follow each other regularly and UVW are worked out, slow baselines are brought to few samples in
    time before they are gridded, within the same accuracy; else, or where few are saved, all are gridded as they are.
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
    """Images of one channel: visibilities that wait, sums at samples, and what has been gridded."""

    def __init__(self, freq_hz: float, pixels: int) -> None:
        self.freq_hz, self.pixels = freq_hz, pixels
        self.waiting: list[tuple[Visibilities, Int | None]] = []  # of this channel alone, and their integrations
        self.count = 0  # visibilities that wait
        self.times = 0  # integrations that wait
        self.comb: Comb | None = None  # once visibilities go to samples
        self.most = 0  # samples
        self.span: Span | None = None
        self.sparse = True  # as far as is known
        self.weight = np.zeros(4)  # of I, Q, U, V
        self.crossed: Float | None = None  # the PSF of U and V (N, N), where their weights are not those of I and Q

    @cached_property
    def sums(self) -> Float:
        """Of I, Q, U, V and the PSF (5, N, N); there from the first gridding on."""
        return np.zeros((5, self.pixels, self.pixels))

    @property
    def samples(self) -> int:
        """How many are held."""
        return self.span.samples.count if self.span else 0


def _alone(block: Visibilities, f: int) -> Visibilities:
    """One channel of a block, which does not keep the others in memory."""
    if block.data.shape[1] == 1:
        return block
    one = block.block(slice(None), slice(f, f + 1))
    return replace(one, data=one.data.copy(), weight=one.weight.copy(), flag=one.flag.copy())


class Images(ImageSums):
    """Sums of images over blocks of visibilities; `finish` gives the cube, with its PSF unless `lobes` is False."""

    def __init__(self, imager: Imager, density: dict[float, Density] | None, lobes: bool = True) -> None:
        self.imager = imager
        self.density = density
        self.lobes = lobes
        self.channels: dict[float, _Channel] = {}
        self.centre: Any = None
        self.clock: Clock | None = None
        self.waiting = 0  # visibilities, in all channels
        self.together = 1  # channels of a block

    def add(self, block: Visibilities) -> None:
        """Add a block."""
        self.centre = self.centre or block.phase_centre
        if block.phase_centre != self.centre:
            raise InputError("blocks with different phase centres cannot be imaged together")
        times, _, baselines = block.data.shape[:3]
        if not times * baselines:
            return
        self.clock = self.clock or Clock(block)
        numbers = self.clock.count(block)
        here = [
            self.channels.setdefault(float(freq), _Channel(float(freq), self.imager.pixels)) for freq in block.freq_hz
        ]
        self.together = max(self.together, len(here))
        for f, channel in enumerate(here):
            if channel.comb is not None and numbers is not None:
                self._compress(channel, block, f, numbers)
                continue
            channel.waiting.append((_alone(block, f), numbers))
            channel.sparse = channel.sparse and numbers is not None
            channel.count, channel.times = channel.count + times * baselines, channel.times + times
            self.waiting += times * baselines
            if channel.count >= HELD or (channel.sparse and channel.times > FEW):
                self._take(channel)
        while self.waiting > ALL_HELD:
            self._take(max(self.channels.values(), key=lambda c: c.count))
        while sum(channel.samples for channel in self.channels.values()) > max(
            ALL_HELD, len(self.channels) * self._few
        ):
            self._close(full := max(self.channels.values(), key=lambda c: c.samples))
            full.most = min(full.most, self._share(len(self.channels)))  # if more of it comes, then piece by piece

    def _share(self, channels: int) -> int:
        """Samples of a channel where so many take turns."""
        return min(HELD, max(ALL_HELD // channels, self._few))

    @property
    def _few(self) -> int:
        """Samples that a channel may hold in any case: as large as two and a half of its images."""
        return self.imager.pixels**2 // 4

    def _take(self, channel: _Channel) -> None:
        """Bring what waits to samples where that pays, or grid it as it is."""
        if channel.sparse and channel.comb is None:
            assert self.clock is not None
            comb = Comb.of(self.clock, channel.freq_hz, self.imager)
            # channels that come one after the other, each with all of its times, need not share what may be held
            channel.most = self._share(self.together)
            channel.sparse = comb.span(0, self._share(len(self.channels))) is not None
            channel.comb = comb if channel.sparse else None
        if not channel.sparse:
            return self._grid(channel)
        for block, numbers in channel.waiting:
            assert numbers is not None
            self._compress(channel, block, 0, numbers)
        self._taken(channel)

    def _taken(self, channel: _Channel) -> None:
        self.waiting -= channel.count
        channel.waiting, channel.count, channel.times = [], 0, 0

    def _compress(self, channel: _Channel, block: Visibilities, f: int, numbers: Int) -> None:
        """Add a channel of a block to its samples, span by span."""
        assert channel.comb is not None
        weight, flag = self._weights(block, f)
        uv = block.at.uvw_m[..., :2] * (channel.freq_hz / LIGHT)
        left = np.sort(numbers)
        while len(left):
            if channel.span is None or not channel.span.first <= left[0] < channel.span.last:
                self._close(channel)
                channel.span = channel.comb.span(int(left[0]), channel.most)
                assert channel.span is not None  # as before, elsewhere
            channel.span.add(block.data[:, f], weight, flag, numbers, uv, self.imager.uv_range)
            left = left[left >= channel.span.last]

    def _weights(self, block: Visibilities, f: int) -> tuple[Any, Any]:
        """Weights (T, B, 1 or 4) and flags (T, B) of a channel of a block; for the whole uv range where natural."""
        shape = block.data.shape[0], block.data.shape[2]
        weight, flag = (x[:, f if x.shape[1] > 1 else 0] for x in (block.weight, block.flag))
        if self.density is None and weight.ndim == flag.ndim == len(shape):
            return np.broadcast_to(weight[..., None], (*shape, 1)), np.broadcast_to(flag, shape)
        _, found, use = self._chosen(block, f)
        full = np.zeros((*shape, found.shape[1]))
        full[use] = found
        return full, np.broadcast_to(np.zeros((), bool), shape)

    def _chosen(self, block: Visibilities, f: int) -> tuple[Float, Float, Any]:
        """Baselines in wavelengths (N, 3), their weights (N, 1 or 4), and which ones (T, B) they are."""
        uvw, weight, use = self.imager.chosen_stokes(block.block(slice(None), slice(f, f + 1)), 0)
        if self.density is not None:
            density = self.density[float(block.freq_hz[f])]
            weight = weight * density.factor(uvw[:, :2], self.imager.weighting, self.imager.robust)
        return uvw, weight, use

    def _grid(self, channel: _Channel) -> None:
        """Grid what waits, visibility by visibility."""
        found = []
        for block, _ in channel.waiting:
            uvw, weight, use = self._chosen(block, 0)
            # of no weight, the data may be NaN
            values = np.where(weight > 0, mueller.stokes(block.data[:, 0][use]), 0.0)
            found.append((uvw, weight, values))
        self._taken(channel)
        most = max((weight.shape[1] for _, weight, _ in found), default=1)
        found = [(uvw, np.broadcast_to(w, (len(w), most)), values) for uvw, w, values in found if len(w)]
        if not found:
            return
        uvw, weight, stokes = (np.concatenate(parts) for parts in zip(*found, strict=True))
        channel.weight += weight.sum(axis=0)
        # half of it: ducc0's is an rms, and the largest error, at the edge, was up to 1.5 times that asked for.
        # One visibility is then wrong by 0.52 times the accuracy at most, and errors add up at worst
        columns = [*(weight * stokes).T, *(weight.T[::2] + 0j)]
        self._sum(channel, uvw, columns, most > 1, self.imager.accuracy / 2)

    def _close(self, channel: _Channel) -> None:
        """Grid the samples that are held."""
        if (span := channel.span) is None:
            return
        uvw, columns, accuracy = span.gridded()
        channel.weight += np.repeat(span.weight, 2)
        channel.span = None
        if len(uvw):
            self._sum(channel, uvw, columns, span.apart, accuracy)

    def _sum(self, channel: _Channel, uvw: Float, columns: list[Complex], apart: bool, accuracy: float) -> None:
        """Re sum_k z_k exp(+2 pi i (u l + v m + w (n-1))) of I, Q, U, V, the PSF and, if `apart`, that of U and V."""
        images, columns = [*channel.sums[:4]], [*columns]
        if self.lobes:
            images.append(channel.sums[4])
        if self.lobes and (apart or channel.crossed is not None):
            channel.crossed = images[4].copy() if channel.crossed is None else channel.crossed  # alike until now
            images.append(channel.crossed)
        gridder = Gridder(uvw, (self.imager.pixels,) * 2, self.imager.pixel, accuracy, threads=0)
        for k, image in enumerate(images):
            values = columns[min(k, len(columns) - 1)]
            if values.any():  # or a Stokes parameter that is exactly zero
                image += gridder.image(values)

    def finish(self) -> StokesCube:
        """The cube in Jy/beam; a channel without any visibility is NaN; raises when no channel has one."""
        from astropy import units as u

        freqs = sorted(self.channels)
        if not freqs:
            raise RefusedError("no block of visibilities was given: nothing to image")
        pixels = self.imager.pixels
        planes, psfs = np.empty((len(freqs), 4, pixels, pixels)), np.empty((len(freqs), pixels, pixels))
        apart, freed = 0.0, 0
        for f, freq in enumerate(freqs):
            channel = self.channels[freq]
            self._grid(channel)
            self._close(channel)
            with np.errstate(divide="ignore", invalid="ignore"):
                np.divide(channel.sums[:4], channel.weight[:, None, None], out=planes[f])
                np.divide(channel.sums[4], channel.weight[0], out=psfs[f])
                if channel.crossed is not None and channel.weight[[0, 2]].all():
                    apart = max(apart, float(np.abs(channel.crossed / channel.weight[2] - psfs[f]).max()))
            freed += channel.sums.nbytes
            del channel.sums  # a sum and its image at once: twice the cube for one channel only
            if freed > FREED:
                give_back()  # or the C library keeps what was freed between what was not
                freed = 0
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
