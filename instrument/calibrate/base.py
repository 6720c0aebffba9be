"""Calibrator and Solution: what a solver takes and what it gives back, with an outcome for every interval."""

from __future__ import annotations

from abc import abstractmethod
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Annotated, Any, ClassVar

import numpy as np

from instrument import mat2
from instrument.calibrate.fit import doubts
from instrument.calibrate.gauge import Gauge
from instrument.checked import checked
from instrument.component import Component
from instrument.correlations import APART
from instrument.errors import InputError, InstrumentError, Outcome
from instrument.jones.base import JonesTerm
from instrument.jones.chain import Chain
from instrument.jones.table import JonesTable
from instrument.observe.intervals import Intervals
from instrument.observe.sampling import Sampling
from instrument.shown import short_repr
from instrument.units import Bool, Complex, Float, Int, Real
from instrument.visibilities import Visibilities


@checked
@dataclass(frozen=True, eq=False)
class Solution:
    """Solved Jones matrices of every interval: `term` goes into any `Chain`, or into `vis.corrected`.

    `outcome` (t, f) says how each interval ended; intervals and stations without a solution are NaN in `term`, so what
    is corrected with them is flagged. `residual` (t, f) is the rms of V - J_a M J_b^H over the rms of V, weighted.
    `gauge` says what the model leaves undetermined in every interval, `looser` what it does in those that leave more;
    `history` is the largest relative step after each iteration. `suspects` (T, F, B) are visibilities that spoilt the
    fit of an interval: `data.flagged(solution.suspects)`, and solve again; `spoilt` counts them by baseline.
    `unexplained` (t, f) is the largest of `residual`, the same without the strongest baselines, and that of a typical
    baseline, times what J^-1 magnifies it by. `doubts` are sentences about all this, printed with a solution.

    `error` (t, f, A, 2, 2) is the standard error of the real part, and of the imaginary part, of every gain that noise
    makes, once `aligned` has used what is free or weak; `common_error` (t, f, n) those of the common directions
    x_k of exp(sum_k x_k G_k), largest first, infinite where they are free (or, of
    `SelfCal`, above ten times what holds them). Both NaN where they are not known.
    """

    __repr__ = short_repr
    term: JonesTable
    outcome: Any
    iterations: Int
    residual: Float
    gauge: Gauge
    history: Float
    interval_s: float
    looser: dict[tuple[int, int], Gauge] = field(default_factory=dict)
    suspects: Bool = field(default_factory=lambda: np.zeros((1, 1, 1), bool))
    spoilt: Mapping[str, int] = field(default_factory=dict)
    unexplained: Float = field(default_factory=lambda: np.zeros((1, 1)))
    notes: tuple[str, ...] = ()
    error: Float = field(default_factory=lambda: np.full((1, 1, 1, 2, 2), np.nan))
    common_error: Float = field(default_factory=lambda: np.full((1, 1, 1), np.nan))

    @property
    def jones(self) -> Complex:
        """The matrices (t, f, A, 2, 2)."""
        return np.asarray(self.term.values)

    @property
    def converged(self) -> Any:
        """Which intervals converged, bool (t, f)."""
        return self.outcome == Outcome.CONVERGED

    @property
    def doubts(self) -> tuple[str, ...]:
        """What to know before the solution is used, in sentences: what it leaves, and what spoilt it."""
        return (*doubts(self.converged, self.unexplained, self.spoilt), *self.notes)

    def check(self) -> None:
        """Raise `InstrumentError` when an interval has not converged, with how many ended how."""
        lost = self.outcome.size - int(self.converged.sum())
        if lost:
            raise InstrumentError(
                f"{lost} of {self.outcome.size} intervals did not converge: {'; '.join(self._ended())}"
            )

    def _ended(self) -> list[str]:
        """How intervals ended that did not converge, with how many did."""
        ended = Counter(outcome for outcome in self.outcome.ravel() if outcome is not Outcome.CONVERGED)
        return [f"{count} {outcome.value}" for outcome, count in ended.most_common()]

    def truth(self, term: JonesTerm | Chain, at: Sampling) -> Complex:
        """The matrices (t, f, A, 2, 2) of another term at the centres of the intervals; `at` lends the array."""
        where = replace(at, slots_s=self.term.slots_s, freq_hz=self.term.freq_hz)
        found = term.jones(where)[:, :, :, 0]
        return np.broadcast_to(found, self.jones.shape)

    def inverse(self) -> JonesTable:
        """The term that undoes `term`: `vis.corrupted(solution.inverse())` is `vis.corrected(solution.term)`.

        Put it in a chain to take the errors out of it; NaN where there is no solution.
        """
        return self.term.inverse()

    def aligned(self, to: Complex) -> Solution:
        """The same solution, the freedom of its gauge used to come as near as can be to matrices (t, f, A, 2, 2)."""
        to = np.asarray(to)
        if to.shape != self.jones.shape:
            raise InputError(f"the matrices to align to have shape {to.shape}, the solution {self.jones.shape}")
        turn = self.gauge.nearest(self.jones, to)
        alike: dict[int, list[tuple[int, int]]] = {}
        for where, gauge in self.looser.items():
            alike.setdefault(id(gauge), []).append(where)
        for cells in alike.values():
            rows = tuple(np.transpose(cells))
            turn[rows] = self.looser[cells[0]].nearest(self.jones[rows], to[rows])
        turned = mat2.mul(self.jones, turn[:, :, None])
        return replace(self, term=self.term.with_fields(values=turned))

    @classmethod
    def joined(cls, parts: Sequence[Solution]) -> Solution:
        """Solutions of blocks as one: blocks in order of time, and those of one time in order of channels."""
        rows: dict[bytes, list[Solution]] = {}
        for part in parts:
            rows.setdefault(np.asarray(part.term.slots_s).tobytes(), []).append(part)
        return cls._side_by_side([cls._side_by_side(row, 1) for row in rows.values()], 0)

    @classmethod
    def _side_by_side(cls, parts: Sequence[Solution], axis: int) -> Solution:
        """Solutions of blocks that follow each other in time (0) or in channels (1)."""
        if len(parts) == 1:
            return parts[0]
        name = ("slots_s", "freq_hz")[axis]
        tables = [p.term for p in parts]
        longest = max(len(p.history) for p in parts)
        history = np.stack([np.pad(p.history, (0, longest - len(p.history))) for p in parts]).max(axis=0)
        values = np.concatenate([t.values for t in tables], axis)
        places = np.concatenate([getattr(t, name) for t in tables])
        gauge = min((p.gauge for p in parts), key=lambda g: g.count)
        first = np.outer(np.cumsum([0, *(p.outcome.shape[axis] for p in parts)]), np.eye(2, dtype=int)[axis])
        return cls(
            term=tables[0].with_fields(values=values, **{name: places}),
            outcome=np.concatenate([p.outcome for p in parts], axis),
            iterations=np.concatenate([p.iterations for p in parts], axis),
            residual=np.concatenate([p.residual for p in parts], axis),
            gauge=gauge,
            history=history,
            interval_s=parts[0].interval_s,
            looser={
                (int(t) + k, int(c) + f): p.looser.get((k, f), p.gauge)
                for (t, c), p in zip(first, parts, strict=False)
                for k, f in (np.ndindex(p.outcome.shape) if p.gauge.count > gauge.count else p.looser)
            },
            spoilt=sum((Counter(p.spoilt) for p in parts), Counter()),
            unexplained=np.concatenate([np.broadcast_to(p.unexplained, p.outcome.shape) for p in parts], axis),
            notes=tuple(dict.fromkeys(text for p in parts for text in p.notes)),
            error=_along([p.error for p in parts], [p.jones.shape for p in parts], axis),
            common_error=_along([p.common_error for p in parts], [(*p.outcome.shape, 0) for p in parts], axis),
        )

    def __str__(self) -> str:
        times, channels = self.outcome.shape
        good = int(self.converged.sum())
        known = self.residual[np.isfinite(self.residual)]  # none where there was nothing to solve
        left = f"{np.median(known):.1e}" if known.size else "unknown"
        more = sum(g.loose > self.gauge.loose for g in self.looser.values())
        looser = f" (more in {more} intervals)" if more else ""
        return "; ".join(
            (
                f"{good} of {times * channels} intervals converged, {np.median(self.iterations):.0f} iterations "
                f"(median), residual {left}",
                *self._ended(),
                f"{self.gauge}{looser}",
                *self.doubts,
            )
        )


def _along(given: Sequence[Float], shapes: Sequence[tuple[int, ...]], axis: int) -> Float:
    """Errors of blocks as one, each of its shape or of length 1 where constant; the last axis is the longest."""
    if all(np.isnan(x).all() for x in given):
        return given[0]
    last = max(x.shape[-1] for x in given)
    parts = []
    for x, shape in zip(given, shapes, strict=True):
        longer = np.pad(x, [(0, 0)] * (x.ndim - 1) + [(0, last - x.shape[-1])], constant_values=np.nan)
        parts.append(np.broadcast_to(longer, (*shape[:-1], last)))
    return np.concatenate(parts, axis)


@checked
class Calibrator(Component):
    """A solver: `solve(data, model)` finds the station terms that turn the model into the data.

    It stops when no station's matrix changes by more than `tolerance` of itself; a fit that leaves more than
    `unexplained` of the rms of the data is no solution. `calibrate.judged` makes a `Solution` of the matrices found.
    """

    plugin_kind: ClassVar[str | None] = "calibrators"
    tolerance: Annotated[float, Real(above=0, below=0.1)] = 1e-8
    unexplained: Annotated[float, Real(above=0, at_most=1)] = 0.5

    @abstractmethod
    def solve(self, data: Visibilities, model: Visibilities, /) -> Solution:
        """Solve every interval; raises `InputError` only for input that cannot be paired.

        Flagged and non-finite data weigh nothing; an interval that is not fitted is not CONVERGED, and NaN.
        """


def pair(data: Visibilities, model: Visibilities) -> tuple[Complex, Complex, Float]:
    """Data and model (T, F, B, 2, 2) and weights (T, F, B) of a solve; flagged and non-finite data weigh nothing.

    Weights of correlations are those of the visibility as a whole (`whole_weight`): it counts where all four are known.
    Raises when coordinates or beam states differ.
    """
    if data.data.shape != model.data.shape:
        raise InputError(f"data and model do not pair: they have shapes {data.data.shape} and {model.data.shape}")
    for count, what in zip(data.data.shape, ("integrations", "channels", "baselines"), strict=False):
        if count == 0:
            raise InputError(f"the data have no {what}: there is nothing to solve for")
    data.check_same(model)
    weight = np.broadcast_to(data.whole_weight, data.data.shape[:3])
    return data.data, model.data, weight


def partly_known(data: Visibilities) -> tuple[str, ...]:
    """A sentence where single correlations are flagged or not finite: a solve leaves all four out (see `pair`)."""
    weight = data.effective_weight
    if weight.ndim < APART:
        return ()
    known = (weight > 0).sum(axis=(-2, -1))
    lost, there = int(((known > 0) & (known < 4)).sum()), int((known > 0).sum())
    if not lost:
        return ()
    return (f"{100 * lost / there:.2g} % of the visibilities are left out: not all of their correlations are known",)


def other_length(found: Intervals, asked_s: float | None) -> tuple[str, ...]:
    """A sentence where intervals are not as long as asked: a whole number of integrations lasts otherwise."""
    if (
        asked_s is None
        or abs(found.length_s - asked_s) <= 1e-6 * asked_s
        or found.length_s < asked_s - found.length_s / found.step
    ):
        return ()
    return (f"intervals last {found.length_s:.6g} s, not {asked_s:.6g} s: a whole number of integrations",)


def by_baseline(suspects: Bool, data: Visibilities) -> dict[str, int]:
    """How many visibilities (T, F, B) are marked on each baseline that has any, by its name."""
    names, count = data.layout.names, suspects.sum(axis=(0, 1))
    return {f"{names[data.antenna1[b]]}-{names[data.antenna2[b]]}": int(count[b]) for b in np.flatnonzero(count)}
