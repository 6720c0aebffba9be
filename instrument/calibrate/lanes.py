"""Lanes: many solves side by side, swept together; damped quasi-Newton steps with Anderson's mixing."""

from __future__ import annotations

from typing import Any, Protocol

import numpy as np

from instrument.calibrate.als import LANES, matrices, planar, power_of, residual, solve_stations, sweep, unit_diagonal
from instrument.calibrate.common import CommonPart
from instrument.calibrate.errors import gain_errors
from instrument.calibrate.factor import Factor
from instrument.calibrate.fit import Left
from instrument.calibrate.gauge import GENERATORS, HELD_TO, Gauge
from instrument.calibrate.newton import EXACT, solved_together
from instrument.calibrate.normal import BASIS
from instrument.patience import Patience
from instrument.units import Complex, Float, Int

FAR = 0.3  # relative step above which sweeps are averaged instead of corrected
DEPTH = 6  # steps that are mixed


class Settings(Protocol):
    """What lanes need to know of a solver."""

    @property
    def pattern(self) -> str:
        """Pattern of the station matrices."""

    @property
    def tolerance(self) -> float:
        """Relative step at which a lane stands still."""

    @property
    def iterations(self) -> int:
        """Most sweeps."""


class Lanes:
    """Weighted data and model of some intervals, in vector lanes, and the sweeps over them."""

    def __init__(self, v: Complex, m: Complex, a1: Int, a2: Int, active: Any, settings: Settings) -> None:
        self.count = len(v)
        self.lanes = LANES if self.count > LANES // 2 else max(1, self.count)
        self.v, self.m = planar(v, self.lanes), planar(m, self.lanes)
        self.products = (v, m)
        self.total = power_of(v).sum(axis=1)
        each = power_of(m)
        self.common = CommonPart(m, self.total, active, (each > 0).sum(axis=1), settings.pattern)
        power = each.reshape(self.count, -1, len(a1)).sum(axis=1)
        stations = active.shape[1]
        self.power = np.zeros((self.count, stations, stations))
        self.power[:, a1, a2] = power
        self.power += np.swapaxes(self.power, 1, 2)
        self.a1, self.a2, self.active, self.settings = a1, a2, active, settings
        # of the normal matrices of lanes that were solved together
        self.factors: dict[int, Factor] = {}

    def iterate(self, jones: Complex, far: float = FAR) -> tuple[Complex, Float, Int, Float]:
        """Sweeps until all lanes stand still: matrices (L, A, 2, 2), last steps, iterations, worst step of each.

        Where common directions are weak, sweeps only lead near, and all stations are solved at once.
        """
        return solved_together(self, jones) if self.common.weak.any() else self._swept(jones, far)

    def _swept(self, jones: Complex, far: float) -> tuple[Complex, Float, Int, Float]:
        """`iterate` where all common directions are seen well or not at all.

        A step that made the fit worse is taken back and tried again with more damping, as Levenberg and Marquardt do.
        """
        stations = jones.shape[1]
        jones = np.where(self.active[..., None, None], jones, 0.0)
        right, left = np.zeros((stations, 8, self.lanes)), np.zeros((stations, 4, self.lanes))
        count = np.zeros(self.count, int)
        step = np.full(self.count, np.inf)
        damping = np.zeros(self.count)
        best, best_new, best_left, best_cost = jones, jones, jones, np.full(self.count, np.inf)
        near = np.zeros(self.count, bool)
        coupling, of = None, damping
        memory, patience = Memory(self.count), Patience(self.count)
        history = []
        for turn in range(self.settings.iterations):
            sweep(self.v, self.m, self.a1, self.a2, planar(jones, self.lanes), right, left)
            new = solve_stations(right, left, self.settings.pattern)[: self.count]
            cost = self.cost(jones, right, left)
            unsolved = self.active & ~np.isfinite(new).all(axis=(-2, -1))
            new = np.where((self.active & ~unsolved)[..., None, None], new, jones)
            # 1e-12 of the power of the data: rounding. Averaged steps far from the answer are taken as they come
            worse = near & ~(cost <= best_cost + 1e-12)
            keep = worse[:, None, None, None]
            best, best_new = np.where(keep, best, jones), np.where(keep, best_new, new)
            best_cost = np.where(worse, best_cost, cost)
            left_over = matrices(right)[: self.count] - jones @ self.normal(left)
            best_left = np.where(keep, best_left, left_over)
            moved = np.any(step > 0.1) or (turn % 8 == 0 and np.any(step > 1e-3))
            if coupling is None or moved or np.any(damping != of):
                coupling, of = self._coupling(best, damping), damping
            jones, _, near = self._stepped(best, best_new, best_left, coupling, np.where(damping < 3, far, 0))
            jones = memory.mixed(best, jones, near & ~worse)
            last = self._change(best, jones)
            last = np.where(unsolved.any(axis=1), np.nan, last)
            slow = worse | (last > 1.1 * step)
            damping = np.where(slow, np.minimum(np.maximum(4 * damping, 0.02), 3.0), damping / 4)
            damping = np.where(damping < 1e-3, 0.0, damping)
            running = ~(step <= self.settings.tolerance)
            count[running] += 1
            step = np.where(running, last, step)
            history.append(float(np.nanmax(step, initial=0.0)))
            if not np.any((step > self.settings.tolerance) & ~patience.lost(step)):
                break
        return jones, step, count, np.array(history)

    def _change(self, old: Complex, new: Complex) -> Float:
        """Largest relative change of any station in each lane."""
        size = np.sqrt(power_of(new))
        return _relative(new - old, size, 1e-12 * size.max(axis=1, keepdims=True))

    def cost(self, jones: Complex, right: Float, left: Float) -> Float:
        """Power of V - J_a M J_b^H over that of V in each lane, from the sums of a sweep: no pass over the data."""
        n = matrices(right)[: self.count]
        d00, d11, re, im = np.moveaxis(left, 1, 0).transpose(0, 2, 1)[:, : self.count]
        column0, column1 = (np.abs(jones[..., k]) ** 2 for k in range(2))
        cross = (jones[..., 0] * jones[..., 1].conj()).sum(axis=-1)
        fit = d00 * column0.sum(axis=-1) + d11 * column1.sum(axis=-1) + 2 * (cross * (re + 1j * im)).real
        overlap = (jones.conj() * n).real.sum(axis=(-2, -1))
        return 1 + (0.5 * fit - overlap).sum(axis=1) / np.maximum(self.total, 1e-300)

    def _coupling(self, jones: Complex, damping: Float) -> tuple[Float, Float, Float, Float]:
        """What turns the step of a sweep into that of all stations at once, (L, A, A): Hermitian, anti-Hermitian part.

        For a model m_ab 1 and matrices near multiples of unitary ones, J_a (1 + e_a) with e_a the least-squares answer
        of e_a + e_b^H obeys e_a + sum_b W_ab e_b^H / D_a = d_a, the step of the sweep, W_ab = |m_ab|^2 |J_a|^2 |J_b|^2
        and D_a its sum over b: (1 + N) h = d and (1 - N) g = d for the two parts. The common phase, N u = u, is left
        as it is. Damping is added to the 1. Then the share of each station in
        the weight, (L, A), and what the data show of a change of the model, (L,).
        """
        size = power_of(jones)
        weight = self.power * size[:, :, None] * size[:, None, :]
        total = weight.sum(axis=2)
        root = np.sqrt(np.where(total > 0, total, 1.0))
        n = weight / root[:, :, None] / root[:, None, :]
        u = np.where(total > 0, root, 0.0)
        u = u / np.maximum(np.linalg.norm(u, axis=1, keepdims=True), 1e-300)
        # 1e-6: an array that falls into two halves without baselines inside has a singular 1 + N
        one = (1 + 1e-6 + damping)[:, None, None] * np.eye(n.shape[1])
        plus = np.linalg.inv(one + n)
        minus = np.linalg.inv(one - n + u[:, :, None] * u[:, None, :])
        scale = root[:, None, :] / root[:, :, None]
        share = total / np.maximum(total.sum(axis=1, keepdims=True), 1e-300)
        # how much larger a change shows in the data than in the model, the mean |J_a|^2 |J_b|^2
        gain = weight.sum(axis=(1, 2)) / np.maximum(4 * self.power.sum(axis=(1, 2)), 1e-300) * (1 + damping)
        return plus * scale, minus * scale, share, gain

    def errors(self, jones: Complex, share: Float, gauge: Gauge, each: bool) -> tuple[Float, Float]:
        """Standard errors of gains (L, A, 2, 2) and of the common directions of a gauge (L, n), for what is left over.

        Where all stations were solved at once and noise is left, from their normal matrix; elsewhere as for a model
        m_ab 1: the two parts of each e_a have the covariance of `_coupling`, and what is free is left out. Unless
        `each`, those of gains are NaN.
        """
        free = np.arange(len(gauge.seen)) < gauge.count
        variance = np.where(np.isfinite(share), share, 0.0) ** 2 * self.total / (self.common.freedom + gauge.count)
        basis = BASIS[self.settings.pattern]
        plus, minus, _, gain = self._coupling(jones, np.zeros(self.count))
        size = power_of(jones)
        total = (self.power * size[:, :, None] * size[:, None, :]).sum(axis=2) / 8
        root = np.sqrt(size / 2)
        whole = minus / np.where(total > 0, total, np.inf)[:, None] * root[:, :, None] * root[:, None, :]
        q = root / np.maximum(np.linalg.norm(root, axis=1, keepdims=True), 1e-300)
        along = np.einsum("lab,lb->la", whole, q)
        turned = np.einsum("laa->la", whole) - 2 * q * along + q**2 * (q * along).sum(axis=1, keepdims=True)
        grown = np.einsum("laa->la", plus) / np.where(total > 0, total, np.inf) * root**2
        own = np.maximum(turned + (0 if self.settings.pattern == "phase" else grown), 0.0) / 2
        own = np.where(total > 0, own / (2 if self.settings.pattern == "scalar" else 1), np.nan)
        allowed = (BASIS[self.settings.pattern] != 0).any(axis=1)[::2].reshape(2, 2)
        error = np.sqrt(own)[..., None, None] * np.where(allowed, 1.0, 0.0)
        ways = np.einsum("kij,nij->nk", self.common.generators.conj(), gauge.directions).real / 2
        bent = np.einsum("nk,lkm,nm->ln", ways, self.common.form, ways) * gain[:, None]
        with np.errstate(divide="ignore"):
            common = np.where(free, np.inf, 1 / np.sqrt(np.maximum(bent, 0.0)))
        for k, factor in self.factors.items():
            if share[k] <= max(EXACT, self.settings.tolerance):  # no noise that could be told from steps not taken
                common[k, gauge.count :] = np.nan
                continue
            most = HELD_TO / np.sqrt(max(variance[k], 1e-300))
            error[k], common[k] = gain_errors(factor, jones[k], basis, gauge.directions, free, most, each)
        sigma = np.sqrt(variance)
        error = error if each else np.full_like(error, np.nan)
        with np.errstate(invalid="ignore"):  # infinite errors, where nothing is left over
            return error * sigma[:, None, None, None], common * sigma[:, None]

    def normal(self, left: Float) -> Complex:
        """sum Z Z^H of each station (L, A, 2, 2)."""
        d00, d11, re, im = np.moveaxis(left, 1, 0).transpose(0, 2, 1)[:, : self.count]
        return np.stack([np.stack([d00 + 0j, re + 1j * im], -1), np.stack([re - 1j * im, d11 + 0j], -1)], -2)

    def _common(self, old: Complex, left_over: Complex, gain: Float) -> Complex:
        """Step G (L, 2, 2) of J_a (1 + G), the same for all stations: a few parameters that sweeps find slowly."""
        generators = GENERATORS[self.settings.pattern]
        gradient = np.einsum("nij,laki,lakj->ln", generators.conj(), old.conj(), left_over).real
        values, vectors = self.common.eigen
        # what the model does not see is the gauge: it stays where it is
        seen = values > 1e-9 * np.maximum(values[:, -1:], 1e-300)
        scale = np.where(seen, 1.0 / np.where(seen, values, 1.0), 0.0) / np.maximum(gain, 1e-300)[:, None]
        x = (vectors @ (scale * (np.swapaxes(vectors, 1, 2) @ gradient[..., None])[..., 0])[..., None])[..., 0]
        return np.einsum("ln,nij->lij", x, generators)

    def _stepped(
        self, old: Complex, new: Complex, left_over: Complex, coupling: tuple[Float, Float, Float, Float], far: Float
    ) -> tuple[Complex, Float, Any]:
        """The next matrices, the largest relative change of any station in each lane, and where it was a full step."""
        size = np.sqrt(power_of(new))
        floor = 1e-12 * size.max(axis=1, keepdims=True)
        close = _relative(new - old, size, floor) < far
        near = close[:, None, None, None]
        ratio, regular = _right_ratio(old, new)
        delta = np.where(self.active[..., None, None], ratio - np.eye(2), 0.0)
        mirror = np.conj(np.swapaxes(delta, -1, -2))
        parts = ((delta + mirror) / 2, (delta - mirror) / 2)
        shape = (self.count, -1, 4)
        together = sum((c @ p.reshape(shape)).reshape(delta.shape) for c, p in zip(coupling[:2], parts, strict=True))
        # what all stations have in common is solved for by itself
        mean = np.einsum("la,laij->lij", coupling[2], together)
        common = self._common(old, left_over, coupling[3])
        together = together + np.where(self.active[..., None, None], (common - mean)[:, None], 0.0)
        result = np.where(near & regular[..., None, None], old + old @ together, 0.5 * (old + new))
        # a station without any signal is dead: its answer is zero, and half the way would never get there
        result = np.where((new == 0).all(axis=(-2, -1))[..., None, None], 0.0, result)
        if self.settings.pattern == "phase":
            result = unit_diagonal(result)
        result = np.where(self.active[..., None, None], result, 0.0)
        return result, _relative(result - old, size, floor), close

    def eigenvectors(self) -> Complex:
        """Start from data alone: leading eigenvectors of the matrix of V_ab M_ab^H, which is J_a J_b^H for M = 1."""
        v, m = self.products
        baselines, stations = len(self.a1), self.active.shape[1]
        block = (v @ np.conj(np.swapaxes(m, -1, -2))).reshape(self.count, -1, baselines, 2, 2).sum(axis=1)
        if self.settings.pattern != "full":
            block = block * np.eye(2)
        full = np.zeros((self.count, stations, 2, stations, 2), complex)
        full[:, self.a1, :, self.a2, :] = np.moveaxis(block, 1, 0)
        full[:, self.a2, :, self.a1, :] = np.moveaxis(np.conj(np.swapaxes(block, -1, -2)), 1, 0)
        _, vectors = np.linalg.eigh(full.reshape(self.count, 2 * stations, 2 * stations))
        top = vectors[:, :, -2:].reshape(self.count, stations, 2, 2) * np.sqrt(stations)
        if self.settings.pattern == "full":
            return top
        # each receptor by itself: the eigenvectors belong to one receptor each, in either order
        out = np.zeros_like(top)
        for r in range(2):
            sub = full[:, :, r, :, r]
            if self.settings.pattern == "scalar":
                sub = full[:, :, 0, :, 0] + full[:, :, 1, :, 1]
            vector = np.linalg.eigh(sub)[1][:, :, -1] * np.sqrt(stations)
            out[:, :, r, r] = vector
        return unit_diagonal(out) if self.settings.pattern == "phase" else out

    def left(self, jones: Complex, samples: Int) -> Left:
        """What matrices leave of the data, by baseline; `samples` (L, B) count."""
        out = np.zeros((3, len(self.a1), self.lanes))
        residual(self.v, self.m, self.a1, self.a2, planar(jones, self.lanes), out)
        rest, data, fit = np.moveaxis(out[..., : self.count], 2, 1)
        return Left(rest, data, fit, samples)


def levels(v: Complex, m: Complex, a1: Int, a2: Int, stations: int, robust: bool = False) -> Float:
    """Rough amplitude of each station (L, A): log |V_ab| - log |M_ab| = log s_a + log s_b by least squares.

    `robust`: by least absolute values, which an outlier does not move.
    """
    power = [power_of(z).reshape(len(z), -1, len(a1)).sum(axis=1) for z in (v, m)]
    good = (power[0] > 0) & (power[1] > 0)
    with np.errstate(divide="ignore", invalid="ignore"):
        ratio = np.where(good, 0.5 * np.log(power[0] / power[1]), 0.0)
    weight = good.astype(float)
    for _ in range(30 if robust else 1):
        normal, right = np.zeros((len(v), stations, stations)), np.zeros((len(v), stations))
        for one, other in ((a1, a2), (a2, a1)):
            rows: Any = slice(None)
            np.add.at(normal, (rows, one, one), weight)
            np.add.at(normal, (rows, one, other), weight)
            np.add.at(right, (rows, one), ratio * weight)
        found = np.linalg.solve(normal + 1e-9 * np.eye(stations), right[..., None])[..., 0]
        # 0.05: scatter of amplitudes that polarization and directions make
        weight = good / np.maximum(np.abs(ratio - found[:, a1] - found[:, a2]), 0.05)
    return np.exp(np.clip(found, -40, 40))


class Memory:
    """Anderson's mixing of the last steps of each lane: slow and swinging modes are extrapolated away."""

    def __init__(self, lanes: int) -> None:
        self.points: list[Float] = []
        self.steps: list[Float] = []
        self.age = np.zeros(lanes, int)

    def mixed(self, old: Complex, new: Complex, use: Any) -> Complex:
        """The next point (L, A, 2, 2) after a step old -> new; lanes not in `use` take the step and forget the past."""
        lanes = len(old)
        size = np.sqrt(power_of(new))
        share = np.repeat(1 / np.maximum(size, 1e-9 * size.max(axis=1, keepdims=True) + 1e-140), 8, axis=1)
        x, f = (np.ascontiguousarray(z).view(float).reshape(lanes, -1) for z in (old, new - old))
        self.points, self.steps = [*self.points[-DEPTH:], x], [*self.steps[-DEPTH:], f]
        self.age = np.where(use, self.age + 1, 0)
        depth = len(self.steps) - 1
        if not depth:
            return new
        # (L, n, depth) differences; those older than the lane's memory count for nothing
        df, dx = (np.stack([z[k + 1] - z[k] for k in range(depth)], axis=2) for z in (self.steps, self.points))
        fresh = np.arange(depth)[None] >= depth - np.minimum(self.age - 1, depth)[:, None]
        df, dx = (z * fresh[:, None] for z in (df, dx))
        weighed = df * share[..., None]
        gram = np.swapaxes(weighed, 1, 2) @ weighed
        ridge = 1e-12 * np.trace(gram, axis1=1, axis2=2)[:, None, None] + 1e-300
        right = np.swapaxes(weighed, 1, 2) @ (f * share)[..., None]
        weight = np.linalg.solve(gram + ridge * np.eye(depth), right)
        mixed = x + f - ((dx + df) @ weight)[..., 0]
        out = np.ascontiguousarray(mixed).view(complex).reshape(new.shape)
        return np.where((self.age > 1)[:, None, None, None], out, new)


def _relative(change: Complex, size: Float, floor: Float) -> Float:
    moved = np.sqrt(power_of(change))
    with np.errstate(invalid="ignore", divide="ignore"):
        return np.where(size > floor, moved / np.maximum(size, 1e-300), 0.0).max(axis=1)


def _right_ratio(old: Complex, new: Complex) -> tuple[Complex, Any]:
    """old^-1 new, the identity where old is (nearly) singular, and where it is not."""
    det = old[..., 0, 0] * old[..., 1, 1] - old[..., 0, 1] * old[..., 1, 0]
    size = power_of(old)
    good = np.abs(det) > 1e-3 * size
    inverse = (
        np.stack([np.stack([old[..., 1, 1], -old[..., 0, 1]], -1), np.stack([-old[..., 1, 0], old[..., 0, 0]], -1)], -2)
        / np.where(good, det, 1)[..., None, None]
    )
    return np.where(good[..., None, None], inverse @ new, np.eye(2)), good
