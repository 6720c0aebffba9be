"""Forced photometry: Stokes fluxes at known positions, solved together with the PSF between them, from visibilities.

The fluxes are the least-squares answer of V_ab = sum_s f_s K_ab(s): b = A^H W V is the adjoint sum at the positions,
A^H W A the PSF between them. No image is made: the field has no limit, and a source of 100 Jy drowns none of 0.4 Jy.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, field
from typing import Annotated

import numpy as np

from instrument.analyze.sources.blanks import CHUNKS, FREE, PLACES, excess, places
from instrument.analyze.sources.fluxes import SourceFluxes, StokesSums
from instrument.analyze.sources.patches import gathered, gathered_square, groups, mixture
from instrument.analyze.sources.told_apart import coincide, conjugate_gradients, mirrored, positive_solve
from instrument.component import Component
from instrument.errors import InputError, Outcome
from instrument.jones import mueller
from instrument.observe.directions import LIGHT, lmn
from instrument.phasor import station_phases
from instrument.sky.points import PointSky
from instrument.units import Complex, Count, Float, Int, Real, UvRange, unit_vectors
from instrument.visibilities import Visibilities, VisibilitySet
from instrument.visibility_sets import as_set

MOST_DIRECT = 6000  # sources up to which the PSF matrix (300 MB) is formed; above, conjugate gradients
ROWS = 512  # of that matrix at a time
PRODUCTS = 2.5e10  # of a PSF matrix that is made for errors alone: 1 s
ROUNDING = 4 * float(np.finfo(float).eps)  # of sum w |V|^2, below which nothing is known of what a solution leaves


class ForcedPhotometry(Component):
    """Joint least-squares fluxes at known positions, (F, G, 4); sources of one patch are measured as one.

    Where correlations have weights of their own, each Stokes parameter is solved with the weights that it has.
    `uv_range` in wavelengths; `every` takes only each n-th integration (the answer is the mean over those). Stops when
    the residual of the normal equations is below `accuracy` of its start.
    """

    uv_range: UvRange | None = None
    every: Count = 1
    accuracy: Annotated[float, Real(above=0, below=1)] = 1e-10
    iterations: Count = 200

    def measure(self, visibilities: VisibilitySet | Iterable[Visibilities], sky: PointSky) -> SourceFluxes:
        """Fluxes of the sources of `sky` in visibilities, or in blocks of them."""
        total = self.start(sky)
        for block in as_set(visibilities).blocks():
            total.add(block)
        return total.finish()

    def start(self, sky: PointSky) -> StokesSums:
        """Sums to which blocks are added one by one."""
        return StokesSums(PhotometrySums(self, sky))


@dataclass
class _Slot:
    """What the normal equations need of one integration and channel: fringes are made anew from it."""

    uvw_lambda: Float  # (A, 3)
    weight: Float  # (B,), or (1,) for the same weight on all baselines of the array
    plain: bool  # whether it is the latter
    mix: Float  # (S,), share of each source in its group: that of the channel
    antenna1: Int
    antenna2: Int
    beside: Float = field(default_factory=lambda: np.zeros((PLACES, 4)))  # adjoint sums towards blank places

    @property
    def uvw(self) -> Float:
        """Of the baselines, (B, 3)."""
        return self.uvw_lambda[self.antenna1] - self.uvw_lambda[self.antenna2]


@dataclass
class _Channel:
    right: Float
    mix: Float
    seen: int = 0  # integrations, also those left out
    slots: list[_Slot] = field(default_factory=list)
    total: float = 0.0
    power: Float = field(default_factory=lambda: np.zeros(4))  # sum of w |V|^2
    count: int = 0

    @property
    def chunk(self) -> Int:
        """The chunk of time that each slot is in."""
        return np.arange(len(self.slots)) * min(CHUNKS, len(self.slots)) // len(self.slots)

    def error(self, flux: Float, spread: Float, scores: Float, free: Float) -> Float:
        """Errors of the fluxes (G, 4), from |V - A f|^2 = |V|^2 - f . A^H V at the solution and diag (A^H W A)^-1 (G,).

        Of 2 n real data as many degrees of freedom are gone as there are groups. `scores` (C, M, 4) at blank places
        and the share `free` (M,) of their weight that no source takes tell what the residuals are beyond noise.
        """
        data = max(2 * self.count - len(spread), 1)
        least = ROUNDING * self.power / data
        variance = np.maximum((self.power - (flux * self.right).sum(axis=0)) / data, least)
        found = variance * excess(scores, np.where(free > FREE, free * self.total, 0.0), variance, data)
        return np.sqrt(np.multiply.outer(spread, np.maximum(found, least)))


class PhotometrySums:
    """Adjoint sums over blocks of visibilities; `finish` solves for the fluxes."""

    def __init__(self, settings: ForcedPhotometry, sky: PointSky) -> None:
        self.settings = settings
        self.sky = sky
        self.first, self.group, self.names = groups(sky)
        self.shaped = np.flatnonzero(sky.gaussian)
        self.channels: dict[float, _Channel] = {}
        self.lmn: Float | None = None
        self.axes: Float | None = None

    def add(self, block: Visibilities) -> None:
        """Add a block."""
        at = block.at
        if self.lmn is None:
            ra, dec, stations = self.sky.ra_rad, self.sky.dec_rad, at.layout.positions_m * (block.freq_hz[0] / LIGHT)
            beside = places(ra[self.first], dec[self.first], stations, self.settings.uv_range)
            self.lmn = lmn(np.concatenate([unit_vectors(ra, dec), beside]), at.centre)
            self.axes = self.sky.shape_axes(at.centre)
        weights = block.effective_weight
        whole = len(block.antenna1) == len(at.layout) * (len(at.layout) - 1) // 2
        for f, freq in enumerate(block.freq_hz):
            if float(freq) not in self.channels:
                mix = mixture(self.sky.stokes(np.array([freq]))[0, :, 0], self.group, len(self.first))
                self.channels[float(freq)] = _Channel(np.zeros((len(self.first), 4)), mix)
            channel = self.channels[float(freq)]
            for t in range(-channel.seen % self.settings.every, at.shape[0], self.settings.every):
                uvw = block.station_uvw_m[t] * (freq / LIGHT)
                cut = self._inside(uvw, block)
                weight = weights[t, f] if cut is None else weights[t, f] * cut
                if not weight.any():
                    continue
                plain = whole and bool(np.all(weight == weight[0]))
                slot = _Slot(uvw, weight[:1] if plain else weight, plain, channel.mix, block.antenna1, block.antenna2)
                # of no weight, the data may be NaN
                data = mueller.stokes(np.where(weight[:, None, None] > 0, block.data[t, f], 0.0))
                channel.slots.append(slot)
                seen = self._adjoint_sources(slot, self._fringes(slot), data * weight[:, None])
                channel.right += self._gathered(slot, seen)
                slot.beside = seen[len(self.group) :]
                channel.power += (np.abs(data) ** 2 * weight[:, None]).sum(axis=0)
                channel.total += float(weight.sum())
                channel.count += int(np.count_nonzero(weight))
            channel.seen += at.shape[0]

    def _inside(self, uvw: Float, block: Visibilities) -> Float | None:
        if self.settings.uv_range is None:
            return None
        low, high = self.settings.uv_range
        length = np.hypot(*(uvw[block.antenna1] - uvw[block.antenna2])[:, :2].T)
        return ((length >= low) & (length <= high)).astype(float)

    def _fringes(self, slot: _Slot, count: int | None = None) -> Complex:
        """Of the stations towards the sources and the blank places, or the first `count` of them, (A, S + M)."""
        assert self.lmn is not None
        return station_phases(slot.uvw_lambda[None], self.lmn[:count])[0]

    def _gathered(self, slot: _Slot | _Channel, sums: Float) -> Float:
        """Sums (S, n) towards sources, and more rows, as sums (G, n) towards groups."""
        return gathered(sums[: len(self.group)] * slot.mix[:, None], self.group, len(self.first))

    def _adjoint_sources(self, slot: _Slot, z: Complex, values: Complex) -> Float:
        """Re A^H v of weighted values (B, n) towards each column of the fringes, (S, n) or (S + M, n)."""
        out = np.zeros((z.shape[1], values.shape[1]))
        grid = np.zeros((len(z), len(z)), complex)
        for k in range(values.shape[1]):
            if values[:, k].any():
                grid[slot.antenna1, slot.antenna2] = values[:, k]
                out[:, k] = np.einsum("as,as->s", z.conj(), grid @ z).real
        if len(self.shaped):
            out[self.shaped] = (self._pattern(slot, z).conj().T @ values).real
        return out

    def _pattern(self, slot: _Slot, z: Complex) -> Complex:
        """Visibilities of 1 Jy in each source with a shape, (B, n)."""
        assert self.axes is not None
        along = np.einsum("bc,skc->kbs", slot.uvw, self.axes[self.shaped])
        envelope = np.exp(-2 * np.pi**2 * (along[0] ** 2 + along[1] ** 2))
        z = z[:, self.shaped]
        return z[slot.antenna1] * z[slot.antenna2].conj() * envelope

    def _forward(self, slot: _Slot, flux: Float) -> Complex:
        """A f: visibilities (B, 4) of fluxes of groups (G, 4)."""
        z = self._fringes(slot, len(self.group))
        each = flux[self.group] * slot.mix[:, None]
        points = np.where(self.sky.gaussian[:, None], 0.0, each)
        out = np.zeros((len(slot.antenna1), 4), complex)
        for k in range(4):
            if points[:, k].any():
                out[:, k] = ((z * points[:, k]) @ z.conj().T)[slot.antenna1, slot.antenna2]
        if len(self.shaped):
            out += self._pattern(slot, z) @ each[self.shaped]
        return out

    def finish(self) -> SourceFluxes:
        """Solve for the fluxes of every channel; a channel without data is NaN."""
        if not self.channels:
            raise InputError("no visibilities were given to measure fluxes in")
        freqs = np.array(sorted(self.channels))
        channels = [self.channels[float(freq)] for freq in freqs]
        fluxes, errors, outcomes, counts = zip(*(self._solve(channel) for channel in channels), strict=True)
        return SourceFluxes(
            names=self.names,
            ra_rad=self.sky.ra_rad[self.first],
            dec_rad=self.sky.dec_rad[self.first],
            model_jy=np.stack([gathered(s, self.group, len(self.first)) for s in self.sky.stokes(freqs)]),
            stokes_jy=np.stack(fluxes),
            error_jy=np.stack(errors),
            freq_hz=freqs,
            outcome=outcomes,
            iterations=max(counts),
        )

    def _solve(self, channel: _Channel) -> tuple[Float, Float, Outcome, int]:
        """Fluxes and their errors (G, 4), how it ended, iterations."""
        nothing = np.full((2, len(self.first), 4), np.nan)
        if channel.total <= 0:
            return *nothing, Outcome.REFUSED, 0
        if not np.isfinite(channel.right).all():
            return *nothing, Outcome.NON_FINITE, 0
        if 2 * channel.count < len(self.first):
            return *nothing, Outcome.SINGULAR, 0
        if len(self.group) > MOST_DIRECT:
            # conjugate gradients share a flux between groups that cannot be told apart, and converge
            if self._coincide(channel):
                return *nothing, Outcome.SINGULAR, 0
            spread, free = np.full(len(self.first), 1 / channel.total), 1 - len(self.first) / (2 * channel.count)
            return self._iterated(channel, spread, np.full(PLACES, free))
        plain = all(slot.plain for slot in channel.slots)
        matrix, towards = self._psf_matrix(channel) if plain else self._sampled(channel)
        taken = self._gathered(channel, towards.sum(axis=0)) if plain else towards[0]
        found = positive_solve(matrix, np.concatenate([channel.right, taken], axis=1))
        if found is None:
            return *nothing, Outcome.SINGULAR, 0
        both, spread = found
        free = 1 - (taken * both[:, 4:]).sum(axis=0) / channel.total
        if not plain:
            return self._iterated(channel, spread, free)
        flux, scores = both[:, :4], np.zeros((len(towards), PLACES, 4))
        np.add.at(scores, channel.chunk, np.stack([slot.beside for slot in channel.slots]))
        scores -= towards.transpose(0, 2, 1) @ (flux[self.group] * channel.mix[:, None])
        return flux, channel.error(flux, spread, scores, free), Outcome.CONVERGED, 0

    def _iterated(self, channel: _Channel, spread: Float, free: Float) -> tuple[Float, Float, Outcome, int]:
        """The same by conjugate gradients, given diag (A^H W A)^-1 (G,) and the free share of blank places (M,)."""
        start, accuracy, most = channel.right / channel.total, self.settings.accuracy, self.settings.iterations
        flux, outcome, count = conjugate_gradients(
            lambda flux: self._normal(channel, flux), channel.right, start, accuracy, most
        )
        scores = np.zeros((channel.chunk[-1] + 1, PLACES, 4))
        for chunk, slot in zip(channel.chunk, channel.slots, strict=True):
            model = self._forward(slot, flux) * slot.weight[:, None]
            scores[chunk] += slot.beside - self._adjoint_sources(slot, self._fringes(slot), model)[len(self.group) :]
        return flux, channel.error(flux, spread, scores, free), outcome, count

    def _sampled(self, channel: _Channel) -> tuple[Float, Float]:
        """As `_psf_matrix`, of any weights, from some integrations: all within 2.5e10 products; in one chunk of time.

        What is summed is between groups (G, G), and between these and the blank places (1, G, M).
        """
        count = len(self.first)
        baselines = len(channel.slots[0].antenna1)
        fewest = max(4, 4 * count // baselines)  # twice as many real data as groups, or they look dependent
        picked = min(max(int(PRODUCTS / (baselines * count**2)), fewest), len(channel.slots))
        out, total = np.zeros((count + PLACES, count)), 0.0
        for i in np.linspace(0, len(channel.slots) - 1, picked).round().astype(int):
            slot = channel.slots[i]
            z = self._fringes(slot)
            each = z[slot.antenna1] * z[slot.antenna2].conj()
            if len(self.shaped):
                each[:, self.shaped] = self._pattern(slot, z)
            sources = len(self.group)
            columns = gathered((each[:, :sources] * slot.mix).T, self.group, count)
            columns = np.concatenate([columns, each[:, sources:].T]) * np.sqrt(slot.weight)
            out += columns.real @ columns[:count].real.T + columns.imag @ columns[:count].imag.T
            total += float(slot.weight.sum()) * (len(slot.antenna1) if slot.plain else 1)
        out *= channel.total / total
        return out[:count].copy(), out[count:].T[None]

    def _coincide(self, channel: _Channel) -> bool:
        assert self.lmn is not None and self.axes is not None
        longest = max(float((np.linalg.norm(s.uvw, axis=1) * (s.weight > 0)).max()) for s in channel.slots)
        where = np.concatenate([self.lmn[: len(self.group)], self.axes.reshape(len(self.group), 6)], axis=1)
        return coincide(where, longest, self.group, channel.mix)

    def _psf_matrix(self, channel: _Channel) -> tuple[Float, Float]:
        """PSF between all groups (G, G), for plain slots: sum_{a<b} Re x_a x_b^* = (|sum_a x_a|^2 - A) / 2.

        And between sources and blank places in each chunk of time, (C, S, M).
        """
        sources, shaped = len(self.group), self.shaped
        out = np.zeros((sources, sources))
        columns = np.zeros((sources, len(shaped)))
        beside = np.zeros((int(channel.chunk[-1]) + 1, sources, PLACES))
        wide = np.zeros((len(beside), PLACES, len(shaped)))
        for chunk, slot in zip(channel.chunk, channel.slots, strict=True):
            z = self._fringes(slot)
            for first in range(0, sources, ROWS):
                # the upper triangle, in rows: its other half is its mirror
                last = min(first + ROWS, sources)
                g = z[:, first:last].conj().T @ z[:, first:]
                g = (g.real**2 + g.imag**2 - len(z)) * (slot.weight[0] / 2)
                out[first:last, first:] += g[:, : sources - first]
                beside[chunk, first:last] += g[:, sources - first :]
            if len(shaped):  # a source with a shape is not a product of stations: its own baselines, towards all others
                towards = self._adjoint_sources(slot, z, self._pattern(slot, z) * slot.weight[0])
                columns += towards[:sources]
                wide[chunk] += towards[sources:]
        mirrored(out, ROWS)
        out[:, shaped], out[shaped] = columns, columns.T
        beside[:, shaped] = wide.transpose(0, 2, 1)
        return gathered_square(out, self.group, self.first, channel.mix), beside

    def _normal(self, channel: _Channel, flux: Float) -> Float:
        out = np.zeros_like(flux)
        for slot in channel.slots:
            values = self._forward(slot, flux) * slot.weight[:, None]
            out += self._gathered(slot, self._adjoint_sources(slot, self._fringes(slot, len(self.group)), values))
        return out
