"""SelfCal: one matrix (or gain, or phase) per station and interval, for all directions, from data and a model."""

from __future__ import annotations

import os
from concurrent.futures import ThreadPoolExecutor
from typing import Annotated, Any, Literal

import numpy as np

from instrument.calibrate.base import Calibrator, Solution, by_baseline, other_length, pair, partly_known
from instrument.calibrate.chunk import Cell, Job, Part
from instrument.calibrate.gauge import gauge_of
from instrument.calibrate.newton import lanes_of
from instrument.calibrate.reasons import ENOUGH, Asked, faint, noisy, told
from instrument.checked import checked
from instrument.errors import InputError, Outcome
from instrument.jones.base import JonesTerm
from instrument.jones.table import JonesTable
from instrument.observe.intervals import intervals
from instrument.predict.threads import ONE_THREAD
from instrument.units import Bool, Count, Float, Metres, PositiveSeconds, Real
from instrument.visibilities import Visibilities


@checked
class SelfCal(Calibrator):
    """Direction-independent solve of V_ab = J_a M_ab J_b^H, per `interval` (each integration by default) and channel.

    `pattern` "full", "diagonal", "scalar" (one complex gain) or "phase" (a phase per receptor). `channels` of one
    solution (1 by default). Stops when no station's matrix changes by more than `tolerance` of itself; the corrected
    data then differ from the model by about that much. Or after `iterations`, or where 100 more lead hardly nearer.
    `min_baseline` leaves out shorter ones. `start` is a term to start from (a solution of before, say), the identity
    otherwise; where that leads nowhere, the leading eigenvectors of V M^H are tried, and the better fit is kept. A fit
    that leaves more than `unexplained` of the rms of the data is reported as `Outcome.POOR_FIT`. Without `errors` those
    of gains are not worked out, which with beams in the model may take as long as the solve (those of common directions
    are). Intervals are solved many at a time in compiled code; float64 throughout.
    """

    pattern: Literal["full", "diagonal", "scalar", "phase"] = "full"
    interval: PositiveSeconds | None = None
    channels: Count = 1
    tolerance: Annotated[float, Real(above=0, below=0.1)] = 1e-10
    iterations: Count = 200
    min_baseline: Metres | None = None
    unexplained: Annotated[float, Real(above=0, at_most=1)] = 0.5
    start: JonesTerm | None = None
    errors: bool = True

    def solve(self, data: Visibilities, model: Visibilities) -> Solution:
        """Solve every interval. Flagged and non-finite data weigh nothing; raises only when the two do not pair."""
        v, m, weight = pair(data, model)
        weight = self._cut(data, weight)
        grouped = intervals(data.at.slots_s, self.interval, data.integration_s)
        channels = self._channels(data)
        cells = [(t, f) for t in grouped.slices for f in channels]
        size = lanes_of(len(data.layout))
        chunks = [cells[i : i + size] for i in range(0, len(cells), size)]
        job = Job(self, data, v, m, weight, gauge_of(m, weight, self.pattern))
        with ONE_THREAD, ThreadPoolExecutor(os.cpu_count() or 1) as pool:
            parts = list(pool.map(job.solve, chunks))
        stations = len(data.layout)
        shape = (len(grouped), len(channels))
        jones = np.concatenate([p.jones for p in parts]).reshape(*shape, stations, 2, 2)
        freqs = np.array([data.at.freq_hz[f].mean() for f in channels])
        outcome = np.empty(len(cells), object)
        outcome[:] = [o for p in parts for o in p.outcome]
        why = self._why(outcome, cells, data, (v, m, weight), parts)
        longest = max(len(p.history) for p in parts)
        history = np.stack([np.pad(p.history, (0, longest - len(p.history))) for p in parts]).max(axis=0)
        error = np.concatenate([p.error for p in parts]).reshape(jones.shape)
        noise = noisy(jones, error, self.pattern)
        common_error = np.concatenate([p.common_error for p in parts]).reshape(*shape, -1)
        gauge, others = job.gauge.with_errors(common_error)
        looser = _by_cell({i * size + k: g for i, p in enumerate(parts) for k, g in p.gauges.items()}, shape)
        suspects = _mask({i * size + k: x for i, p in enumerate(parts) for k, x in p.suspects.items()}, cells, data)
        return Solution(
            term=JonesTable(values=jones, slots_s=grouped.centres_s, freq_hz=freqs, stations=tuple(data.layout.names)),
            outcome=outcome.reshape(shape),
            iterations=np.concatenate([p.iterations for p in parts]).reshape(shape),
            residual=np.concatenate([p.residual for p in parts]).reshape(shape),
            gauge=gauge,
            history=history,
            interval_s=grouped.length_s,
            looser=others | looser,
            suspects=suspects,
            spoilt=by_baseline(suspects, data),
            unexplained=np.concatenate([p.worst for p in parts]).reshape(shape),
            notes=(
                *why,
                *faint(noise, outcome == Outcome.CONVERGED, data.layout.names, "the model"),
                *other_length(grouped, self.interval),
                *partly_known(data),
            ),
            error=error,
            common_error=common_error,
        )

    def _why(
        self, outcome: Any, cells: list[Cell], data: Visibilities, given: tuple[Any, ...],
        parts: list[Part],
    ) -> tuple[str, ...]:  # fmt: skip
        """Sentences on intervals without a solution; the limit of iterations is no reason where there is another."""
        asked = Asked(data.antenna1, data.antenna2, data.layout.names, self.pattern)
        share, count = (np.concatenate([getattr(p, name) for p in parts]) for name in ("residual", "iterations"))
        reasons = []
        for k, ended in enumerate(outcome):
            if ended not in (Outcome.REFUSED, Outcome.SINGULAR, Outcome.ITERATION_LIMIT):
                continue
            if ended is Outcome.ITERATION_LIMIT and count[k] < ENOUGH:
                continue
            v, m, weight = (x[cells[k]].reshape(-1, *x.shape[2:]) for x in given)
            reasons.append(asked.reason(v, m[None], weight))
            if ended is Outcome.ITERATION_LIMIT and reasons[-1]:
                outcome[k] = Outcome.SINGULAR
            elif ended is Outcome.ITERATION_LIMIT and share[k] > self.unexplained:
                outcome[k] = Outcome.POOR_FIT
        return told(reasons)

    def _cut(self, data: Visibilities, weight: Float) -> Float:
        if self.min_baseline is None:
            return weight
        length = np.linalg.norm(data.uvw_m, axis=-1)[:, None]
        return weight * (length >= self.min_baseline)

    def _channels(self, data: Visibilities) -> list[slice]:
        """Channels of every solution."""
        channels = data.data.shape[1]
        if np.any(np.diff(data.at.freq_hz) <= 0):
            raise InputError("a solve needs channels in ascending order")
        if self.channels > channels:
            raise InputError(f"channels = {self.channels} of one solution, but the data have {channels}")
        return [slice(f, min(f + self.channels, channels)) for f in range(0, channels, self.channels)]


def _by_cell(found: dict[int, Any], shape: tuple[int, int]) -> dict[tuple[int, int], Any]:
    return {divmod(cell, shape[1]): value for cell, value in found.items()}


def _mask(found: dict[int, Bool], cells: list[Cell], data: Visibilities) -> Bool:
    """Samples of some cells as flags (T, F, B); (1, 1, 1) where there are none."""
    out = np.zeros(data.data.shape[:3] if found else (1, 1, 1), bool)
    for cell, samples in found.items():
        piece = out[cells[cell]]
        piece[...] = samples[: piece.size].reshape(piece.shape)
    return out
