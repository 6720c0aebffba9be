"""Forced photometry: Stokes fluxes at known positions, solved together with the PSF between them, from visibilities.

The flux of every source is the least-squares answer of V_ab = sum_s f_s K_ab(s): b = A^H W V is the adjoint sum at the
positions, A^H W A the PSF between them. No image is made, so there is no limit to the field, and the sidelobes of a
100 Jy source do not drown its neighbours of 0.4 Jy.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, field
from typing import Annotated, Any

import numpy as np

from instrument.analyze.told_apart import coincide, positive_solve
from instrument.component import Component
from instrument.errors import InputError, Outcome
from instrument.jones import mueller
from instrument.observe.directions import LIGHT, lmn
from instrument.phasor import station_phases
from instrument.sky.points import PointSky
from instrument.units import Complex, Count, Float, Int, Real, UvRange, unit_vectors
from instrument.visibilities import Visibilities

MOST_DIRECT = 6000  # sources up to which the PSF matrix (300 MB) is formed; above, conjugate gradients
ROWS = 512  # of that matrix at a time
PRODUCTS = 2.5e10  # of a PSF matrix that is made for errors alone: 1 s
CANCELS = 1e-6  # |sum I| over sum |I| of a patch below which its parts cancel
ROUNDING = 4 * float(np.finfo(float).eps)  # of sum w |V|^2, below which nothing is known of what a solution leaves


@dataclass(frozen=True)
class SourceFluxes:
    """Measured Stokes fluxes in Jy (F, G, 4) of G groups of sources (a patch, or a source by itself).

    The sources of a patch keep the shares of its Stokes I that they have in the sky, channel by channel.
    `error_jy` is the rms of what the solution leaves in the real or imaginary part of the visibilities times the root
    of the diagonal of (A^H W A)^-1: right for noise, for sources that are close together or resolved too. The change of
    apparent fluxes with time and baseline, which a constant flux cannot follow, counts as noise here; it is not
    independent, and true errors of simulated fields are 0.7 to 2 times as large in the median. It is never below what
    rounding hides: 3e-8 of the rms visibility.
    """

    names: tuple[str, ...]
    ra_rad: Float
    dec_rad: Float
    model_jy: Float  # (F, G, 4), what the sky has there
    stokes_jy: Float  # (F, G, 4)
    error_jy: Float  # (F, G, 4)
    freq_hz: Float
    outcome: tuple[Outcome, ...]  # per channel
    iterations: int


class ForcedPhotometry(Component):
    """Joint least-squares fluxes at known positions, (F, G, 4); sources of one patch are measured as one.

    `uv_range` in wavelengths; `every` takes only each n-th integration (the answer is the mean over those). Stops when
    the residual of the normal equations is below `accuracy` of its start.
    """

    uv_range: UvRange | None = None
    every: Count = 1
    accuracy: Annotated[float, Real(above=0, below=1)] = 1e-10
    iterations: Count = 200

    def measure(self, visibilities: Visibilities | Iterable[Visibilities], sky: PointSky) -> SourceFluxes:
        """Fluxes of the sources of `sky` in visibilities, or in blocks of them."""
        total = self.start(sky)
        for block in [visibilities] if isinstance(visibilities, Visibilities) else visibilities:
            total.add(block)
        return total.finish()

    def start(self, sky: PointSky) -> PhotometrySums:
        """Sums to which blocks are added one by one."""
        return PhotometrySums(self, sky)


@dataclass
class _Slot:
    """What the normal equations need of one integration and channel: fringes are made anew from it."""

    uvw_lambda: Float  # (A, 3)
    weight: Float  # (B,), or (1,) for the same weight on all baselines of the array
    plain: bool  # whether it is the latter
    mix: Float  # (S,), share of each source in its group: that of the channel
    antenna1: Int
    antenna2: Int

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

    def error(self, flux: Float, spread: Float) -> Float:
        """Errors of the fluxes (G, 4), from |V - A f|^2 = |V|^2 - f . A^H V at the solution and diag (A^H W A)^-1 (G,).

        Of 2 n real data as many degrees of freedom are gone as there are groups.
        """
        left = np.maximum(self.power - (flux * self.right).sum(axis=0), ROUNDING * self.power)
        return np.sqrt(np.multiply.outer(spread, left / max(2 * self.count - len(spread), 1)))


class PhotometrySums:
    """Adjoint sums over blocks of visibilities; `finish` solves for the fluxes."""

    def __init__(self, settings: ForcedPhotometry, sky: PointSky) -> None:
        self.settings = settings
        self.sky = sky
        self.first, self.group, self.names = _groups(sky)
        self.channels: dict[float, _Channel] = {}
        self.lmn: Float | None = None
        self.axes: Float | None = None

    def add(self, block: Visibilities) -> None:
        """Add a block."""
        at = block.at
        if self.lmn is None:
            self.lmn = lmn(unit_vectors(self.sky.ra_rad, self.sky.dec_rad), at.centre)
            self.axes = self.sky.shape_axes(at.centre)
        weights = block.effective_weight
        whole = len(block.antenna1) == len(at.layout) * (len(at.layout) - 1) // 2
        for f, freq in enumerate(block.freq_hz):
            if float(freq) not in self.channels:
                self.channels[float(freq)] = _Channel(np.zeros((len(self.first), 4)), self._mixture(freq))
            channel = self.channels[float(freq)]
            for t in range(-channel.seen % self.settings.every, at.shape[0], self.settings.every):
                uvw = at.uvw_m[t] * (freq / LIGHT)
                cut = self._inside(uvw, block)
                weight = weights[t, f] if cut is None else weights[t, f] * cut
                if not weight.any():
                    continue
                plain = whole and bool(np.all(weight == weight[0]))
                slot = _Slot(uvw, weight[:1] if plain else weight, plain, channel.mix, block.antenna1, block.antenna2)
                # where a weight is zero the data may be NaN
                data = mueller.stokes(np.where(weight[:, None, None] > 0, block.data[t, f], 0.0))
                channel.slots.append(slot)
                channel.right += self._adjoint(slot, data * weight[:, None])
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

    def _mixture(self, freq: float) -> Float:
        """Share of each source in its group, (S,): of the sum of I, of that of |I| where it cancels, or equal parts."""
        flux = self.sky.stokes(np.array([freq]))[0, :, 0]
        size = np.bincount(self.group, np.abs(flux), len(self.first))
        total = np.bincount(self.group, flux, len(self.first))
        signed = (np.abs(total) > CANCELS * size)[self.group]
        part = np.where((size > 0)[self.group], np.where(signed, flux, np.abs(flux)), 1.0)
        return part / np.bincount(self.group, part, len(self.first))[self.group]

    def _fringes(self, slot: _Slot) -> Complex:
        assert self.lmn is not None
        return station_phases(slot.uvw_lambda[None], self.lmn)[0]

    def _adjoint(self, slot: _Slot, values: Complex) -> Float:
        """Re A^H v of weighted values (B, 4): sums towards each group, (G, 4)."""
        out = self._adjoint_sources(slot, self._fringes(slot), values)
        return _gathered(out * slot.mix[:, None], self.group, len(self.first))

    def _adjoint_sources(self, slot: _Slot, z: Complex, values: Complex) -> Float:
        """The same towards each source, (S, n) of values (B, n)."""
        out = np.zeros((z.shape[1], values.shape[1]))
        grid = np.zeros((len(z), len(z)), complex)
        for k in range(values.shape[1]):
            if values[:, k].any():
                grid[slot.antenna1, slot.antenna2] = values[:, k]
                out[:, k] = np.einsum("as,as->s", z.conj(), grid @ z).real
        shaped = np.flatnonzero(self.sky.gaussian)
        if len(shaped):
            out[shaped] = (self._pattern(slot, z).conj().T @ values).real
        return out

    def _pattern(self, slot: _Slot, z: Complex) -> Complex:
        """Visibilities of 1 Jy in each source with a shape, (B, n)."""
        shaped = np.flatnonzero(self.sky.gaussian)
        assert self.axes is not None
        along = np.einsum("bc,skc->kbs", slot.uvw, self.axes[shaped])
        envelope = np.exp(-2 * np.pi**2 * (along[0] ** 2 + along[1] ** 2))
        return z[slot.antenna1][:, shaped] * z[slot.antenna2][:, shaped].conj() * envelope

    def _forward(self, slot: _Slot, flux: Float) -> Complex:
        """A f: visibilities (B, 4) of fluxes of groups (G, 4)."""
        z = self._fringes(slot)
        each = flux[self.group] * slot.mix[:, None]
        points = np.where(self.sky.gaussian[:, None], 0.0, each)
        out = np.zeros((len(slot.antenna1), 4), complex)
        for k in range(4):
            if points[:, k].any():
                out[:, k] = ((z * points[:, k]) @ z.conj().T)[slot.antenna1, slot.antenna2]
        if self.sky.gaussian.any():
            out += self._pattern(slot, z) @ each[self.sky.gaussian]
        return out

    def finish(self) -> SourceFluxes:
        """Solve for the fluxes of every channel; a channel without data is NaN."""
        if not self.channels:
            raise InputError("no visibilities were given to measure fluxes in")
        freqs = np.array(sorted(self.channels))
        channels = [self.channels[float(freq)] for freq in freqs]
        fluxes, spreads, outcomes, counts = zip(*(self._solve(channel) for channel in channels), strict=True)
        return SourceFluxes(
            names=self.names,
            ra_rad=self.sky.ra_rad[self.first],
            dec_rad=self.sky.dec_rad[self.first],
            model_jy=np.stack([_gathered(s, self.group, len(self.first)) for s in self.sky.stokes(freqs)]),
            stokes_jy=np.stack(fluxes),
            error_jy=np.stack(
                [c.error(flux, spread) for c, flux, spread in zip(channels, fluxes, spreads, strict=True)]
            ),
            freq_hz=freqs,
            outcome=outcomes,
            iterations=max(counts),
        )

    def _solve(self, channel: _Channel) -> tuple[Float, Float, Outcome, int]:
        """Fluxes (G, 4), diag (A^H W A)^-1 (G,), how it ended, iterations."""
        nothing = np.full((len(self.first), 4), np.nan), np.full(len(self.first), np.nan)
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
            flux, outcome, count = self._conjugate_gradients(channel)
            return flux, np.full(len(flux), 1 / channel.total), outcome, count
        plain = all(slot.plain for slot in channel.slots)
        found = positive_solve(self._psf_matrix(channel) if plain else self._sampled(channel), channel.right)
        if found is None:
            return *nothing, Outcome.SINGULAR, 0
        flux, spread = found
        if plain:
            return flux, spread, Outcome.CONVERGED, 0
        flux, outcome, count = self._conjugate_gradients(channel)
        return flux, spread, outcome, count

    def _sampled(self, channel: _Channel) -> Float:
        """PSF between all groups (G, G) of any weights, from some of the integrations: all within 1e11 products."""
        groups, shaped = len(self.first), self.sky.gaussian
        baselines = len(channel.slots[0].antenna1)
        fewest = max(4, 4 * groups // baselines)  # twice as many real data as groups, or they look dependent
        count = min(max(int(PRODUCTS / (baselines * groups**2)), fewest), len(channel.slots))
        out, total = np.zeros((groups, groups)), 0.0
        for i in np.linspace(0, len(channel.slots) - 1, count).round().astype(int):
            slot = channel.slots[i]
            z = self._fringes(slot)
            each = z[slot.antenna1] * z[slot.antenna2].conj()
            if shaped.any():
                each[:, shaped] = self._pattern(slot, z)
            columns = _gathered((each * slot.mix).T, self.group, groups) * np.sqrt(slot.weight)
            out += columns.real @ columns.real.T + columns.imag @ columns.imag.T
            total += float(slot.weight.sum()) * (len(slot.antenna1) if slot.plain else 1)
        return out * (channel.total / total)

    def _coincide(self, channel: _Channel) -> bool:
        assert self.lmn is not None and self.axes is not None
        longest = max(float((np.linalg.norm(s.uvw, axis=1) * (s.weight > 0)).max()) for s in channel.slots)
        where = np.concatenate([self.lmn, self.axes.reshape(len(self.group), 6)], axis=1)
        return coincide(where, longest, self.group, channel.mix)

    def _psf_matrix(self, channel: _Channel) -> Float:
        """PSF between all groups, (G, G), for plain slots: sum_{a<b} Re x_a x_b^* = (|sum_a x_a|^2 - A) / 2."""
        sources, groups = len(self.group), len(self.first)
        out = np.zeros((sources, sources))
        shaped = np.flatnonzero(self.sky.gaussian)
        columns = np.zeros((sources, len(shaped)))
        for slot in channel.slots:
            z = self._fringes(slot)
            for first in range(0, sources, ROWS):
                # the upper triangle, in rows: its other half is its mirror
                g = z[:, first : first + ROWS].conj().T @ z[:, first:]
                out[first : first + ROWS, first:] += (g.real**2 + g.imag**2 - len(z)) * (slot.weight[0] / 2)
            if len(shaped):  # a source with a shape is not a product of stations: its own baselines, towards all others
                towards = self._pattern(slot, z)
                columns += self._adjoint_sources(slot, z, towards * slot.weight[0])
        upper = np.triu(out)
        out = upper + np.triu(upper, 1).T
        out[:, shaped], out[shaped] = columns, columns.T
        mixed = _gathered(out * channel.mix[:, None], self.group, groups)
        return _gathered((mixed * channel.mix).T.copy(), self.group, groups)

    def _normal(self, channel: _Channel, flux: Float) -> Float:
        out = np.zeros_like(flux)
        for slot in channel.slots:
            out += self._adjoint(slot, self._forward(slot, flux) * slot.weight[:, None])
        return out

    def _conjugate_gradients(self, channel: _Channel) -> tuple[Float, Outcome, int]:
        """A^H W A f = b for the four Stokes parameters at once, each with its own step."""
        flux = channel.right / channel.total
        residual = channel.right - self._normal(channel, flux)
        direction, power = residual.copy(), (residual**2).sum(axis=0)
        target = (self.settings.accuracy**2) * (channel.right**2).sum(axis=0).max()
        for count in range(1, self.settings.iterations + 1):
            if np.all(power <= target):
                return flux, Outcome.CONVERGED, count
            image = self._normal(channel, direction)
            curve = (direction * image).sum(axis=0)
            step = np.divide(power, curve, out=np.zeros(4), where=curve > 0)
            flux = flux + step * direction
            residual = residual - step * image
            new = (residual**2).sum(axis=0)
            direction = residual + np.divide(new, power, out=np.zeros(4), where=power > 0) * direction
            power = new
        return flux, Outcome.ITERATION_LIMIT, self.settings.iterations


def _groups(sky: PointSky) -> tuple[Int, Int, tuple[str, ...]]:
    """First source of each group, group of each source, names of the groups; a patch is a group."""
    patches = sky.patches or ("",) * len(sky)
    keys = [f"patch {patch}" if patch else f"source {i}" for i, patch in enumerate(patches)]
    order = {key: k for k, key in enumerate(dict.fromkeys(keys))}
    group = np.array([order[key] for key in keys], int)
    first = np.unique(group, return_index=True)[1]
    return first, group, tuple(patches[i] or sky.names[i] for i in first)


def _gathered(values: Any, group: Int, groups: int) -> Any:
    """Sum of rows (S, ...) over the sources of each group, (G, ...)."""
    if groups == len(group):
        return values
    out = np.zeros((groups, *values.shape[1:]), values.dtype)
    np.add.at(out, group, values)
    return out
