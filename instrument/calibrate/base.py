"""Calibrator and Solution: what a solver takes and what it gives back, with an outcome for every interval."""

from __future__ import annotations

from abc import abstractmethod
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from instrument import mat2
from instrument.calibrate.gauge import Gauge
from instrument.component import Component
from instrument.errors import InputError, InstrumentError, Outcome
from instrument.jones.base import JonesTerm
from instrument.jones.chain import Chain
from instrument.jones.table import JonesTable
from instrument.observe.sampling import Sampling
from instrument.units import Complex, Float, Int
from instrument.visibilities import Visibilities


@dataclass(frozen=True, eq=False)
class Solution:
    """Solved Jones matrices of every interval: `term` goes into any `Chain`, or into `vis.corrected`.

    `outcome` (t, f) says how each interval ended; intervals and stations without a solution are NaN in `term`, so what
    is corrected with them is flagged. `residual` (t, f) is the rms of V - J_a M J_b^H over the rms of V, weighted.
    `gauge` says what the model leaves undetermined; `history` is the largest relative step after each iteration.
    """

    term: JonesTable
    outcome: Any
    iterations: Int
    residual: Float
    gauge: Gauge
    history: Float
    interval_s: float

    @property
    def jones(self) -> Complex:
        """The matrices (t, f, A, 2, 2)."""
        return np.asarray(self.term.values)

    @property
    def converged(self) -> Any:
        """Which intervals converged, bool (t, f)."""
        return self.outcome == Outcome.CONVERGED

    def check(self) -> None:
        """Raise `InstrumentError` when an interval has not converged, with how many ended how."""
        ended = Counter(outcome for outcome in self.outcome.ravel() if outcome is not Outcome.CONVERGED)
        if ended:
            ways = "; ".join(f"{count} {outcome.value}" for outcome, count in ended.most_common())
            raise InstrumentError(f"{sum(ended.values())} of {self.outcome.size} intervals did not converge: {ways}")

    def truth(self, term: JonesTerm | Chain, at: Sampling) -> Complex:
        """The matrices (t, f, A, 2, 2) of another term at the centres of the intervals; `at` lends the array."""
        where = replace(at, slots_s=self.term.slots_s, freq_hz=self.term.freq_hz)
        found = term.jones(where)[:, :, :, 0]
        return np.broadcast_to(found, self.jones.shape)

    def aligned(self, to: Complex) -> Solution:
        """The same solution, the freedom of its gauge used to come as near as can be to matrices (t, f, A, 2, 2)."""
        to = np.asarray(to)
        if to.shape != self.jones.shape:
            raise InputError(f"the matrices to align to have shape {to.shape}, the solution {self.jones.shape}")
        turned = mat2.mul(self.jones, self.gauge.nearest(self.jones, to)[:, :, None])
        return replace(self, term=self.term.with_fields(values=turned))

    @classmethod
    def joined(cls, parts: Sequence[Solution]) -> Solution:
        """Solutions of blocks as one: blocks of the same channels, in order of time."""
        tables = [p.term for p in parts]
        longest = max(len(p.history) for p in parts)
        history = np.stack([np.pad(p.history, (0, longest - len(p.history))) for p in parts]).max(axis=0)
        values, slots = (np.concatenate([getattr(t, k) for t in tables]) for k in ("values", "slots_s"))
        return cls(
            term=tables[0].with_fields(values=values, slots_s=slots),
            outcome=np.concatenate([p.outcome for p in parts]),
            iterations=np.concatenate([p.iterations for p in parts]),
            residual=np.concatenate([p.residual for p in parts]),
            gauge=parts[0].gauge,
            history=history,
            interval_s=parts[0].interval_s,
        )

    def __str__(self) -> str:
        times, channels = self.outcome.shape
        good = int(self.converged.sum())
        return (
            f"{good} of {times * channels} intervals converged, {np.median(self.iterations):.0f} iterations (median), "
            f"residual {np.nanmedian(self.residual):.1e}; {self.gauge}"
        )


class Calibrator(Component):
    """A solver: `solve(data, model)` finds the station terms that turn the model into the data."""

    @abstractmethod
    def solve(self, data: Visibilities, model: Visibilities) -> Solution:
        """Solve every interval; raises `InputError` only for input that cannot be paired."""


def pair(data: Visibilities, model: Visibilities) -> tuple[Complex, Complex, Float]:
    """Data and model (T, F, B, 2, 2) and weights (T, F, B) of a solve; flagged and non-finite data weigh nothing.

    Raises when coordinates or beam states differ.
    """
    if data.data.shape != model.data.shape:
        raise InputError(f"data and model do not pair: they have shapes {data.data.shape} and {model.data.shape}")
    data - replace(model, data=data.data)  # checks coordinates and beam states
    weight = np.broadcast_to(data.effective_weight, data.data.shape[:3])
    return data.data, model.data, weight
