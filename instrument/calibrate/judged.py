"""A solution from the matrices that a solver found: what they leave of the data, and how each interval ended."""

from __future__ import annotations

from typing import Any, Literal

import numpy as np

from instrument import mat2
from instrument.calibrate.base import Calibrator, Solution, other_length, pair, partly_known
from instrument.calibrate.fit import Left, strange
from instrument.calibrate.gauge import UNKNOWNS, gauge_of
from instrument.calibrate.graph import counted, tied
from instrument.checked import checked
from instrument.errors import InputError, Outcome
from instrument.jones.table import JonesTable
from instrument.observe.intervals import intervals
from instrument.units import Bool, Complex, Float
from instrument.visibilities import Visibilities


@checked
def usable(data: Visibilities, model: Visibilities) -> tuple[Complex, Complex, Float]:
    """Data and model (T, F, B, 2, 2) and weights (T, F, B) of a solve, all finite: 0 where they do not count."""
    v, m, weight = pair(data, model)
    use = (weight > 0) & np.isfinite(m).all(axis=(-2, -1))
    v, m = (np.where(use[..., None, None], x, 0.0) for x in (v, m))
    return v, m, np.where(use, weight, 0.0)


@checked
def judged(
    solver: Calibrator,
    data: Visibilities,
    model: Visibilities,
    jones: Complex,
    still: Bool,
    history: Float,
    interval_s: float | None = None,
    pattern: Literal["full", "diagonal", "scalar", "phase"] = "full",
) -> Solution:
    """The solution of station matrices (t, F, A, 2, 2), held against the data they were solved from.

    One for each channel and each of `observe.intervals(data.at.slots_s, interval_s, data.integration_s)`; `still`
    (t, F) is where the solve stands still, `history` (n,) the largest step after each iteration, `pattern` which
    matrices it looks for. An interval that leaves too much (`Calibrator.unexplained`, or baselines that stand out) is a
    poor fit; stations without data have no solution.
    """
    v, m, weight = usable(data, model)
    times = intervals(data.at.slots_s, interval_s, data.integration_s)
    a, b, stations = data.antenna1, data.antenna2, len(data.layout)
    shape = (len(times), v.shape[1])
    if jones.shape != (*shape, stations, 2, 2) or still.shape != shape:
        raise InputError(
            f"matrices of shape {jones.shape} and `still` {still.shape} are not those of {shape} intervals"
        )
    good: Any = np.isfinite(jones).all(axis=(-2, -1))
    each = np.where(good[..., None, None], jones, 0.0)[times.group]
    fit = mat2.between(each, m, a, b)
    power = weight[..., None, None] * (m.real**2 + m.imag**2)
    held = tied(counted(_sums(power, times.slices)), a, b, stations, pattern)
    inside = held.reshape(good.shape)[times.group]  # data of stations that nothing ties to the others do not count
    empty = ~_sums(weight > 0, times.slices).any(axis=1)
    left = _left([v - fit, v, fit], weight * (inside[:, :, a] & inside[:, :, b]), times.slices)
    outcome = _outcomes(left, held, good.reshape(held.shape), still.reshape(-1), pattern, solver.unexplained)
    odd = strange(left, a, b, stations, solver.tolerance, pattern).any(axis=1)
    for wrong, ended in (
        (odd & (outcome == Outcome.CONVERGED), Outcome.POOR_FIT),
        (empty, Outcome.REFUSED),
        (_sums((pair(data, model)[2] > 0) & (weight == 0), times.slices).any(axis=1), Outcome.NON_FINITE),
    ):
        outcome[wrong] = ended
    known = (held & (outcome == Outcome.CONVERGED)[:, None]).reshape(good.shape)
    spread = np.where(known, mat2.condition(np.where(known[..., None, None], jones, np.eye(2))), 1.0)
    return Solution(
        term=JonesTable(
            values=np.where(known[..., None, None], jones, np.nan),
            slots_s=times.centres_s,
            freq_hz=data.at.freq_hz,
            stations=tuple(data.layout.names),
        ),
        outcome=outcome.reshape(shape),
        iterations=np.full(shape, len(history)),
        residual=left.share.reshape(shape),
        gauge=gauge_of(m, weight, pattern),
        history=history,
        interval_s=times.length_s,
        unexplained=left.worst.reshape(shape) * np.median(spread, axis=-1) ** 2,
        notes=(*other_length(times, interval_s), *partly_known(data)),
    )


def _outcomes(left: Left, held: Bool, good: Bool, still: Bool, pattern: str, unexplained: float) -> Any:
    """How each interval ended (L,), of the stations that the data tie together and those of a finite matrix (L, A)."""
    outcome = np.full(len(held), Outcome.CONVERGED, object)
    for wrong, ended in (  # the last that holds
        (left.poor(unexplained), Outcome.POOR_FIT),
        (~still, Outcome.ITERATION_LIMIT),
        # fewer numbers than unknowns: others would fit as well
        (8 * left.samples.sum(axis=1) < UNKNOWNS[pattern] * held.sum(axis=1), Outcome.SINGULAR),
        ((held & ~good).any(axis=1) | ~held.any(axis=1), Outcome.SINGULAR),
    ):
        outcome[wrong] = ended
    return outcome


def _left(parts: list[Complex], weight: Float, slices: list[slice]) -> Left:
    """Powers (L, B) of what is left, data and fit (T, F, B, 2, 2), summed over intervals; and how many samples."""
    rest, data, fit = (_sums(weight * (x.real**2 + x.imag**2).sum(axis=(-2, -1)), slices) for x in parts)
    return Left(rest, data, fit, _sums((weight > 0).astype(int), slices))


def _sums(values: Any, slices: list[slice]) -> Any:
    """Sums of (T, F, B, ...) over intervals, (L, B, ...): one row an interval and channel."""
    return np.stack([values[piece].sum(axis=0) for piece in slices]).reshape(-1, *values.shape[2:])
