"""SelfCal: one matrix (or gain, or phase) per station and interval, for all directions, from data and a model."""

from __future__ import annotations

import os
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import Field

from instrument.calibrate.als import LANES, planar, residual, solve_stations, stations_of, sweep
from instrument.calibrate.base import Calibrator, Solution, pair
from instrument.calibrate.gauge import Gauge, gauge_of
from instrument.errors import InputError, Outcome
from instrument.jones.base import JonesTerm
from instrument.jones.table import JonesTable
from instrument.units import Complex, Float, Int, Metres, Seconds
from instrument.visibilities import Visibilities

FAR = 0.3  # relative step above which sweeps are averaged instead of corrected
UNKNOWNS = {"full": 8, "diagonal": 4, "scalar": 2, "phase": 2}  # real numbers per station


class SelfCal(Calibrator):
    """Direction-independent solve of V_ab = J_a M_ab J_b^H, per `interval` (each integration by default) and channel.

    `pattern` "full", "diagonal", "scalar" (one complex gain) or "phase" (a phase per receptor). `channels` of one
    solution (1 by default). Stops when no station's matrix changes by more than `tolerance` of itself; the corrected
    data then differ from the model by about that much. `min_baseline` leaves out shorter ones. `start` is a term to
    start from (a solution of before, say), the identity otherwise; where that leads nowhere, the leading eigenvectors
    of V M^H are tried, and the better fit is kept. A fit that leaves more than `unexplained` of the rms of the data is
    reported as `Outcome.POOR_FIT`. Intervals are solved many at a time in compiled code; float64 throughout.
    """

    pattern: Literal["full", "diagonal", "scalar", "phase"] = "full"
    interval: Annotated[Seconds | None, Field()] = None
    channels: Annotated[int, Field(ge=1)] = 1
    tolerance: Annotated[float, Field(gt=0, lt=0.1)] = 1e-10
    iterations: Annotated[int, Field(ge=1)] = 200
    min_baseline: Metres | None = None
    unexplained: Annotated[float, Field(gt=0, le=1)] = 0.5
    start: JonesTerm | None = None

    def solve(self, data: Visibilities, model: Visibilities) -> Solution:
        """Solve every interval. Flagged and non-finite data weigh nothing; raises only when the two do not pair."""
        v, m, weight = pair(data, model)
        weight = self._cut(data, weight)
        times, channels = self._groups(data)
        cells = [(t, f) for t in times for f in channels]
        chunks = [cells[i : i + LANES] for i in range(0, len(cells), LANES)]
        job = _Job(self, data, v, m, weight, gauge_of(m, weight, self.pattern))
        with ThreadPoolExecutor(os.cpu_count() or 1) as pool:
            parts = list(pool.map(job.solve, chunks))
        stations = len(data.layout)
        shape = (len(times), len(channels))
        jones = np.concatenate([p.jones for p in parts]).reshape(*shape, stations, 2, 2)
        slots = np.array([data.at.slots_s[t].mean() for t in times])
        freqs = np.array([data.at.freq_hz[f].mean() for f in channels])
        outcome = np.empty(len(cells), object)
        outcome[:] = [o for p in parts for o in p.outcome]
        longest = max(len(p.history) for p in parts)
        history = np.stack([np.pad(p.history, (0, longest - len(p.history))) for p in parts]).max(axis=0)
        return Solution(
            term=JonesTable(values=jones, slots_s=slots, freq_hz=freqs, stations=tuple(data.layout.names)),
            outcome=outcome.reshape(shape),
            iterations=np.concatenate([p.iterations for p in parts]).reshape(shape),
            residual=np.concatenate([p.residual for p in parts]).reshape(shape),
            gauge=job.gauge,
            history=history,
            interval_s=(self.interval or data.interval_s),
        )

    def _cut(self, data: Visibilities, weight: Float) -> Float:
        if self.min_baseline is None:
            return weight
        length = np.linalg.norm(data.uvw_m, axis=-1)[:, None]
        return weight * (length >= self.min_baseline)

    def _groups(self, data: Visibilities) -> tuple[list[slice], list[slice]]:
        """Times and channels of every solution."""
        count, channels = data.data.shape[:2]
        if np.any(np.diff(data.at.slots_s) <= 0) or np.any(np.diff(data.at.freq_hz) <= 0):
            raise InputError("a solve needs times and channels in ascending order")
        step = 1 if self.interval is None else max(1, round(self.interval / data.interval_s))
        if self.channels > channels:
            raise InputError(f"channels = {self.channels} of one solution, but the data have {channels}")
        return (
            [slice(t, min(t + step, count)) for t in range(0, count, step)],
            [slice(f, min(f + self.channels, channels)) for f in range(0, channels, self.channels)],
        )


@dataclass
class _Part:
    """Solutions of the lanes of one chunk."""

    jones: Complex
    outcome: list[Outcome]
    iterations: Int
    residual: Float
    history: Float


@dataclass
class _Job:
    """What all chunks of one solve share."""

    settings: SelfCal
    visibilities: Visibilities
    data: Complex
    model: Complex
    weight: Float
    gauge: Gauge

    def solve(self, cells: list[tuple[slice, slice]]) -> _Part:
        """Solve the intervals `cells` (times, channels) side by side."""
        a1, a2 = self.visibilities.antenna1, self.visibilities.antenna2
        stations = len(self.visibilities.layout)
        v, m, w = self._gathered(cells)
        finite = np.isfinite(m).all(axis=(-3, -2, -1)) if m.size else np.ones(len(cells), bool)
        m = np.where(np.isfinite(m), m, 0.0)
        root = np.sqrt(w)[..., None, None]
        v, m = np.where(root > 0, v, 0.0) * root, m * root
        used = w * (np.abs(m) ** 2).sum(axis=(-2, -1)) > 0
        active = stations_of(a1, a2, used.astype(float), stations)
        begin = self._start(cells, active)
        lanes = _Lanes(v, m, a1, a2, active, self.settings)
        jones, step, count, history = lanes.iterate(begin)
        left = lanes.unexplained(jones)
        hard = (step > self.settings.tolerance) | ~(left <= self.settings.unexplained)
        hard &= finite & active.any(axis=1)
        if hard.any():
            again = np.flatnonzero(hard)
            second = _Lanes(v[again], m[again], a1, a2, active[again], self.settings)
            jones2, step2, count2, _ = second.iterate(second.eigenvectors())
            left2 = second.unexplained(jones2)
            # a better fit, or as good a fit that stands still
            better = (left2 < 0.99 * left[again]) | ((left2 <= 1.01 * left[again]) & (step2 < step[again]))
            win = again[better]
            jones[win], step[win], left[win] = jones2[better], step2[better], left2[better]
            count[again] += count2
        outcome = []
        for k in range(len(cells)):
            outcome.append(self._outcome(bool(finite[k]), active[k], used[k], float(step[k]), float(left[k])))
            if outcome[-1] is not Outcome.CONVERGED:
                jones[k] = np.nan
        jones[~active] = np.nan
        return _Part(jones, outcome, count, left, history)

    def _gathered(self, cells: list[tuple[slice, slice]]) -> tuple[Complex, Complex, Float]:
        """Data, model (L, N, 2, 2) and weights (L, N), N samples of all baselines; short intervals are padded."""
        most = max((t.stop - t.start) * (f.stop - f.start) for t, f in cells)
        baselines = self.data.shape[2]
        v = np.zeros((len(cells), most * baselines, 2, 2), complex)
        m = np.zeros_like(v)
        w = np.zeros((len(cells), most * baselines))
        for k, (t, f) in enumerate(cells):
            piece = self.weight[t, f]
            v[k, : piece.size] = self.data[t, f].reshape(-1, 2, 2)
            m[k, : piece.size] = self.model[t, f].reshape(-1, 2, 2)
            w[k, : piece.size] = piece.reshape(-1)
        return v, m, w

    def _start(self, cells: list[tuple[slice, slice]], active: Any) -> Complex:
        begin = np.zeros((*active.shape, 2, 2), complex)
        begin[...] = np.eye(2)
        if self.settings.start is not None:
            for k, (t, f) in enumerate(cells):
                at = self.visibilities.at.block(slice(t.start, t.start + 1), slice(f.start, f.start + 1))
                given = self.settings.start.jones(at)[0, 0, :, 0]
                begin[k] = np.where(np.isfinite(given).all(axis=(-2, -1))[:, None, None], given, np.eye(2))
        return begin

    def _outcome(self, finite: bool, active: Any, used: Any, step: float, left: float) -> Outcome:
        if not finite:
            return Outcome.NON_FINITE
        if not active.any():
            return Outcome.REFUSED
        unknown = UNKNOWNS[self.settings.pattern] * int(active.sum()) - self.gauge.count
        if 8 * int(used.sum()) < unknown:
            return Outcome.SINGULAR
        if not np.isfinite(step):
            return Outcome.SINGULAR
        if step > self.settings.tolerance:
            return Outcome.ITERATION_LIMIT
        return Outcome.CONVERGED if left <= self.settings.unexplained else Outcome.POOR_FIT


class _Lanes:
    """Weighted data and model of some intervals, in vector lanes, and the sweeps over them."""

    def __init__(self, v: Complex, m: Complex, a1: Int, a2: Int, active: Any, settings: SelfCal) -> None:
        self.count = len(v)
        self.lanes = LANES if self.count > LANES // 2 else max(1, self.count)
        self.v, self.m = planar(v, self.lanes), planar(m, self.lanes)
        self.products = (v, m)
        power = (np.abs(m) ** 2).sum(axis=(-2, -1)).reshape(self.count, -1, len(a1)).sum(axis=1)
        stations = active.shape[1]
        self.power = np.zeros((self.count, stations, stations))
        self.power[:, a1, a2] = power
        self.power += np.swapaxes(self.power, 1, 2)
        self.a1, self.a2, self.active, self.settings = a1, a2, active, settings

    def iterate(self, jones: Complex) -> tuple[Complex, Float, Int, Float]:
        """Sweeps until all lanes stand still: matrices (L, A, 2, 2), last steps, iterations, worst step of each."""
        stations = jones.shape[1]
        jones = np.where(self.active[..., None, None], jones, 0.0)
        right, left = np.zeros((stations, 8, self.lanes)), np.zeros((stations, 4, self.lanes))
        count = np.zeros(self.count, int)
        step = np.full(self.count, np.inf)
        careful = np.zeros(self.count, int)
        history = []
        for turn in range(self.settings.iterations):
            if turn == 0 or ((turn % 8 == 0 or turn < 4) and np.any(step > 0.03)):
                coupling = self._coupling(jones)
            sweep(self.v, self.m, self.a1, self.a2, planar(jones, self.lanes), right, left)
            new = solve_stations(right, left, self.settings.pattern)[: self.count]
            open_ = self.active & ~np.isfinite(new).all(axis=(-2, -1))
            new = np.where((self.active & ~open_)[..., None, None], new, jones)
            jones, last = self._stepped(jones, new, careful, coupling)
            last = np.where(open_.any(axis=1), np.nan, last)
            # a step that does not shrink: average for a while
            careful = np.where(last > 0.9 * step, 6, np.maximum(careful - 1, 0))
            running = ~(step <= self.settings.tolerance)
            count[running] += 1
            step = np.where(running, last, step)
            history.append(float(np.nanmax(step, initial=0.0)))
            if not np.any(step > self.settings.tolerance):
                break
        return jones, step, count, np.array(history)

    def _coupling(self, jones: Complex) -> tuple[Float, Float]:
        """What turns the step of a sweep into that of all stations at once, (L, A, A): Hermitian, anti-Hermitian part.

        For a model m_ab 1 and matrices near multiples of unitary ones, J_a (1 + e_a) with e_a the least-squares answer
        of e_a + e_b^H obeys e_a + sum_b W_ab e_b^H / D_a = d_a, the step of the sweep, W_ab = |m_ab|^2 |J_a|^2 |J_b|^2
        and D_a its sum over b: (1 + N) h = d and (1 - N) g = d for the two parts. The common phase, N u = u, is left
        as it is.
        """
        size = (np.abs(jones) ** 2).sum(axis=(-2, -1))
        weight = self.power * size[:, :, None] * size[:, None, :]
        total = weight.sum(axis=2)
        root = np.sqrt(np.where(total > 0, total, 1.0))
        n = weight / root[:, :, None] / root[:, None, :]
        u = np.where(total > 0, root, 0.0)
        u = u / np.maximum(np.linalg.norm(u, axis=1, keepdims=True), 1e-300)
        eye = np.eye(n.shape[1])
        # 1e-6: an array that falls into two halves without baselines inside has a singular 1 + N
        plus = np.linalg.inv((1 + 1e-6) * eye + n)
        minus = np.linalg.inv((1 + 1e-6) * eye - n + u[:, :, None] * u[:, None, :])
        scale = root[:, None, :] / root[:, :, None]
        return plus * scale, minus * scale

    def _stepped(
        self, old: Complex, new: Complex, careful: Int, coupling: tuple[Float, Float]
    ) -> tuple[Complex, Float]:
        """The next matrices, and the largest relative change of any station in each lane."""
        size = np.sqrt((np.abs(new) ** 2).sum(axis=(-2, -1)))
        floor = 1e-12 * size.max(axis=1, keepdims=True)
        raw = _relative(new - old, size, floor)
        near = ((raw < FAR) & (careful == 0))[:, None, None, None]
        delta = np.where(self.active[..., None, None], _right_ratio(old, new) - np.eye(2), 0.0)
        mirror = np.conj(np.swapaxes(delta, -1, -2))
        parts = ((delta + mirror) / 2, (delta - mirror) / 2)
        shape = (self.count, -1, 4)
        together = sum((c @ part.reshape(shape)).reshape(delta.shape) for c, part in zip(coupling, parts, strict=True))
        result = np.where(near, old + old @ together, 0.5 * (old + new))
        if self.settings.pattern == "phase":
            result = _unit_diagonal(result)
        result = np.where(self.active[..., None, None], result, 0.0)
        return result, _relative(result - old, size, floor)

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
        return _unit_diagonal(out) if self.settings.pattern == "phase" else out

    def unexplained(self, jones: Complex) -> Float:
        """Rms of V - J_a M J_b^H over the rms of V, weighted, in each lane."""
        out = np.zeros((2, self.lanes))
        residual(self.v, self.m, self.a1, self.a2, planar(jones, self.lanes), out)
        with np.errstate(invalid="ignore", divide="ignore"):
            return np.sqrt(out[0] / out[1])[: self.count]


def _relative(change: Complex, size: Float, floor: Float) -> Float:
    moved = np.sqrt((np.abs(change) ** 2).sum(axis=(-2, -1)))
    with np.errstate(invalid="ignore", divide="ignore"):
        return np.where(size > floor, moved / np.maximum(size, 1e-300), 0.0).max(axis=1)


def _right_ratio(old: Complex, new: Complex) -> Complex:
    """old^-1 new, the identity where old is singular."""
    det = old[..., 0, 0] * old[..., 1, 1] - old[..., 0, 1] * old[..., 1, 0]
    size = (np.abs(old) ** 2).sum(axis=(-2, -1))
    good = np.abs(det) > 1e-6 * size
    inverse = (
        np.stack([np.stack([old[..., 1, 1], -old[..., 0, 1]], -1), np.stack([-old[..., 1, 0], old[..., 0, 0]], -1)], -2)
        / np.where(good, det, 1)[..., None, None]
    )
    return np.where(good[..., None, None], inverse @ new, np.eye(2))


def _unit_diagonal(jones: Complex) -> Complex:
    size = np.abs(jones)
    out = np.where(size > 0, jones / np.where(size > 0, size, 1), 0.0)
    return np.where((size > 0) | (np.eye(2) == 0), out, 1.0)
