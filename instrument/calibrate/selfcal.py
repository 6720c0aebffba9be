"""SelfCal: one matrix (or gain, or phase) per station and interval, for all directions, from data and a model."""

from __future__ import annotations

import os
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import Field

from instrument.calibrate.als import LANES, stations_of
from instrument.calibrate.base import Calibrator, Solution, pair
from instrument.calibrate.gauge import Gauge, gauge_of
from instrument.calibrate.lanes import Lanes, levels
from instrument.errors import InputError, Outcome
from instrument.jones.base import JonesTerm
from instrument.jones.table import JonesTable
from instrument.units import Complex, Float, Int, Metres, PositiveSeconds
from instrument.visibilities import Visibilities

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
    interval: PositiveSeconds | None = None
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
        # the centre of a whole interval, also of a short last one: nearest must give every integration its own
        reach = 0.5 * (max(t.stop - t.start for t in times) - 1) * data.interval_s
        slots = np.array([data.at.slots_s[t.start] + reach for t in times])
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
        finite: Any = np.isfinite(m).all(axis=(-3, -2, -1)) if m.size else np.ones(len(cells), bool)
        m = np.where(np.isfinite(m), m, 0.0)
        root = np.sqrt(w)[..., None, None]
        v, m = np.where(root > 0, v, 0.0) * root, m * root
        used = w * (np.abs(m) ** 2).sum(axis=(-2, -1)) > 0
        active = stations_of(a1, a2, used.astype(float), stations)
        begin = self._start(cells, active)
        lanes = Lanes(v, m, a1, a2, active, self.settings)
        jones, step, count, history = lanes.iterate(begin)
        left = lanes.unexplained(jones)
        hard = (step > self.settings.tolerance) | ~(left <= self.settings.unexplained)
        hard &= finite & active.any(axis=1)
        if hard.any():
            again = np.flatnonzero(hard)
            # stations of very different gains: bring them to one level first, then weigh the data as they are
            level = levels(v[again], m[again], a1, a2, stations)
            flat = v[again] / np.tile(level[:, a1] * level[:, a2], v.shape[1] // len(a1))[..., None, None]
            second = Lanes(flat, m[again], a1, a2, active[again], self.settings)
            jones2, _, count2, _ = second.iterate(second.eigenvectors(), far=0.02)
            second = Lanes(v[again], m[again], a1, a2, active[again], self.settings)
            jones2, step2, _, _ = second.iterate(jones2 * level[:, :, None, None])
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
                given: Any = self.settings.start.jones(at)[0, 0, :, 0]
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
