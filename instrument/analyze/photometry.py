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
from pydantic import Field

from instrument.component import Component
from instrument.errors import InputError, Outcome
from instrument.observe.directions import LIGHT, lmn
from instrument.phasor import station_phases
from instrument.sky.points import PointSky
from instrument.units import Complex, Float, Int, unit_vectors
from instrument.visibilities import Visibilities

MOST_DIRECT = 6000  # sources up to which the PSF matrix (300 MB) is formed; above, conjugate gradients
ROWS = 512  # of that matrix at a time


@dataclass(frozen=True)
class SourceFluxes:
    """Measured Stokes fluxes in Jy (F, G, 4) of G groups of sources (a patch, or a source by itself).

    `error_jy` is the rms of what the solution leaves in the real or imaginary part of the visibilities over the root of
    their number: right for noise. The change of apparent fluxes with time and baseline, which a constant flux cannot
    follow, counts as noise here; it is not independent, and true errors of simulated fields are 0.7 to 2 times as
    large in the median.
    """

    names: tuple[str, ...]
    ra_rad: Float
    dec_rad: Float
    model_jy: Float  # (F, G, 4), what the sky has there
    stokes_jy: Float  # (F, G, 4)
    error_jy: Float  # (F, 4), see below
    freq_hz: Float
    outcome: tuple[Outcome, ...]  # per channel
    iterations: int


class ForcedPhotometry(Component):
    """Joint least-squares fluxes at known positions, (F, G, 4); sources of one patch are measured as one.

    `uv_range` in wavelengths; `every` takes only each n-th integration (the answer is the mean over those). Stops when
    the residual of the normal equations is below `accuracy` of its start.
    """

    uv_range: tuple[float, float] | None = None
    every: Annotated[int, Field(ge=1)] = 1
    accuracy: Annotated[float, Field(gt=0, lt=1)] = 1e-10
    iterations: Annotated[int, Field(ge=1)] = 200

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
    weight: Float | None  # (B,), None for the same weight on all baselines of the array
    antenna1: Int
    antenna2: Int


@dataclass
class _Channel:
    right: Float
    slots: list[_Slot] = field(default_factory=list)
    total: float = 0.0
    power: Float = field(default_factory=lambda: np.zeros(4))  # sum of w |V|^2
    count: int = 0


class PhotometrySums:
    """Adjoint sums over blocks of visibilities; `finish` solves for the fluxes."""

    def __init__(self, settings: ForcedPhotometry, sky: PointSky) -> None:
        self.settings = settings
        self.sky = sky
        self.first, self.group, self.names = _groups(sky)
        self.channels: dict[float, _Channel] = {}
        self.lmn: Float | None = None
        self.axes: Float | None = None
        self.seen = 0

    def add(self, block: Visibilities) -> None:
        """Add a block."""
        at = block.at
        if self.lmn is None:
            self.lmn = lmn(unit_vectors(self.sky.ra_rad, self.sky.dec_rad), at.centre)
            self.axes = self.sky.shape_axes(at.centre)
            self.mix = self._mixture(block.freq_hz)
        weights = block.effective_weight
        uniform = weights.shape[2] == 1 or bool(np.all(weights == weights[:, :, :1]))
        whole = len(block.antenna1) == len(at.layout) * (len(at.layout) - 1) // 2
        use = [t for t in range(at.shape[0]) if (self.seen + t) % self.settings.every == 0]
        self.seen += at.shape[0]
        stokes = block.stokes()[use]
        for f, freq in enumerate(block.freq_hz):
            channel = self.channels.setdefault(float(freq), _Channel(np.zeros((len(self.first), 4))))
            for k, t in enumerate(use):
                weight = np.broadcast_to(weights, block.data.shape[:3])[t, f]
                uvw = at.uvw_m[t] * (freq / LIGHT)
                cut = self._inside(uvw, block)
                plain = uniform and whole and cut is None and weight[0] > 0
                shares = weight if cut is None else weight * cut
                slot = _Slot(uvw, None if plain else shares, block.antenna1, block.antenna2)
                used = np.ones(len(weight)) if plain else shares
                # where a weight is zero the data may be NaN
                data: Complex = np.where(used[:, None] > 0, stokes[k, f], 0.0)
                channel.slots.append(slot)
                channel.right += self._adjoint(slot, data * used[:, None])
                channel.power += (np.abs(data) ** 2 * used[:, None]).sum(axis=0)
                channel.total += float(used.sum())
                channel.count += int(np.count_nonzero(used))

    def _inside(self, uvw: Float, block: Visibilities) -> Float | None:
        if self.settings.uv_range is None:
            return None
        low, high = self.settings.uv_range
        length = np.hypot(*(uvw[block.antenna1] - uvw[block.antenna2])[:, :2].T)
        return ((length >= low) & (length <= high)).astype(float)

    def _mixture(self, freq_hz: Float) -> Float:
        """Share of each source in its group, (S,): its part of the sum of |I|, or equal parts where there is none."""
        flux = np.abs(self.sky.stokes(freq_hz[:1])[0, :, 0])
        total = np.bincount(self.group, flux, len(self.first))
        count = np.bincount(self.group, minlength=len(self.first))
        return np.where(total[self.group] > 0, flux / np.where(total > 0, total, 1)[self.group], 1 / count[self.group])

    def _fringes(self, slot: _Slot) -> Complex:
        assert self.lmn is not None
        return station_phases(slot.uvw_lambda[None], self.lmn)[0]

    def _adjoint(self, slot: _Slot, values: Complex) -> Float:
        """Re A^H v of weighted values (B, 4): sums towards each group, (G, 4)."""
        out = self._adjoint_sources(slot, self._fringes(slot), values)
        return _gathered(out * self.mix[:, None], self.group, len(self.first))

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
        uvw = slot.uvw_lambda[slot.antenna1] - slot.uvw_lambda[slot.antenna2]
        along = np.einsum("bc,skc->kbs", uvw, self.axes[shaped])
        envelope = np.exp(-2 * np.pi**2 * (along[0] ** 2 + along[1] ** 2))
        return z[slot.antenna1][:, shaped] * z[slot.antenna2][:, shaped].conj() * envelope

    def _forward(self, slot: _Slot, flux: Float) -> Complex:
        """A f: visibilities (B, 4) of fluxes of groups (G, 4)."""
        z = self._fringes(slot)
        each = flux[self.group] * self.mix[:, None]
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
        found, outcomes, errors, most = [], [], [], 0
        for freq in freqs:
            flux, outcome, count = self._solve(self.channels[float(freq)])
            found.append(flux)
            outcomes.append(outcome)
            channel = self.channels[float(freq)]
            # |V - A f|^2 = |V|^2 - f . A^H V at the solution
            left = np.maximum(channel.power - (flux * channel.right).sum(axis=0), 0.0)
            errors.append(
                np.sqrt(left / 2 / channel.total / max(channel.count, 1)) if channel.total else np.full(4, np.nan)
            )
            most = max(most, count)
        stokes = self.sky.stokes(freqs)
        model = np.stack([_gathered(s, self.group, len(self.first)) for s in stokes])
        return SourceFluxes(
            names=self.names,
            ra_rad=self.sky.ra_rad[self.first],
            dec_rad=self.sky.dec_rad[self.first],
            model_jy=model,
            stokes_jy=np.stack(found),
            error_jy=np.stack(errors),
            freq_hz=freqs,
            outcome=tuple(outcomes),
            iterations=most,
        )

    def _solve(self, channel: _Channel) -> tuple[Float, Outcome, int]:
        groups = len(self.first)
        if channel.total <= 0:
            return np.full((groups, 4), np.nan), Outcome.REFUSED, 0
        if not np.isfinite(channel.right).all():
            return np.full((groups, 4), np.nan), Outcome.NON_FINITE, 0
        if all(slot.weight is None for slot in channel.slots) and len(self.group) <= MOST_DIRECT:
            flux = _positive_solve(self._psf_matrix(channel), channel.right)
            if flux is None:
                return np.full((groups, 4), np.nan), Outcome.SINGULAR, 0
            return flux, Outcome.CONVERGED, 0
        return self._conjugate_gradients(channel)

    def _psf_matrix(self, channel: _Channel) -> Float:
        """PSF between all groups, (G, G), for equal weights: sum_{a<b} Re x_a x_b^* = (|sum_a x_a|^2 - A) / 2."""
        sources, groups = len(self.group), len(self.first)
        out = np.zeros((sources, sources))
        shaped = np.flatnonzero(self.sky.gaussian)
        columns = np.zeros((sources, len(shaped)))
        for slot in channel.slots:
            z = self._fringes(slot)
            for first in range(0, sources, ROWS):
                # the upper triangle, in rows: its other half is its mirror
                g = z[:, first : first + ROWS].conj().T @ z[:, first:]
                out[first : first + ROWS, first:] += (g.real**2 + g.imag**2 - len(z)) / 2
            if len(shaped):  # a source with a shape is not a product of stations: its own baselines, towards all others
                towards = self._pattern(slot, z)
                columns += self._adjoint_sources(slot, z, towards)
        upper = np.triu(out)
        out = upper + np.triu(upper, 1).T
        out[:, shaped], out[shaped] = columns, columns.T
        mixed = _gathered(out * self.mix[:, None], self.group, groups)
        return _gathered((mixed * self.mix).T.copy(), self.group, groups)

    def _normal(self, channel: _Channel, flux: Float) -> Float:
        out = np.zeros_like(flux)
        for slot in channel.slots:
            values = self._forward(slot, flux)
            out += self._adjoint(slot, values if slot.weight is None else values * slot.weight[:, None])
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


def _positive_solve(matrix: Float, right: Float) -> Float | None:
    """matrix^-1 right by Cholesky; `None` where the matrix is singular (condition above 1e10)."""
    from scipy.linalg import LinAlgError, cho_factor, cho_solve, lapack

    size = np.abs(matrix).sum(axis=0).max()
    try:
        factor = cho_factor(matrix, lower=True)
    except LinAlgError:
        return None
    reciprocal, _ = lapack.dpocon(factor[0], size, uplo="L")
    return np.asarray(cho_solve(factor, right)) if reciprocal > 1e-10 else None


def _groups(sky: PointSky) -> tuple[Int, Int, tuple[str, ...]]:
    """First source of each group, group of each source, names of the groups; a patch is a group."""
    order: dict[str, int] = {}
    first: list[int] = []
    group: list[int] = []
    names: list[str] = []
    for i, name in enumerate(sky.names):
        patch = sky.patches[i] if sky.patches else ""
        key = f"patch {patch}" if patch else f"source {i}"
        if key not in order:
            order[key] = len(first)
            first.append(i)
            names.append(patch or name)
        group.append(order[key])
    return np.array(first), np.array(group), tuple(names)


def _gathered(values: Any, group: Int, groups: int) -> Any:
    """Sum of rows (S, ...) over the sources of each group, (G, ...)."""
    if groups == len(group):
        return values
    out = np.zeros((groups, *values.shape[1:]), values.dtype)
    np.add.at(out, group, values)
    return out
