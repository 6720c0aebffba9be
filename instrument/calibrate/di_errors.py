"""DI errors: the seven error parameters of what went in, of what was solved, and of their difference."""

from __future__ import annotations

from dataclasses import dataclass, fields
from typing import Any

import numpy as np

from instrument.calibrate.base import Solution
from instrument.jones.mueller import DIErrors, di_errors, mueller
from instrument.shown import short_repr
from instrument.units import Complex, Int

HELD = 16e6  # bytes of baselines compared at once
NAMES = tuple(f.name for f in fields(DIErrors))
# where the first-order Mueller matrix holds each parameter, times 2
PLACES = {"s": (0, 0), "iq": (0, 1), "uv": (3, 2), "iu": (0, 2), "qu": (1, 2), "iv": (0, 3), "qv": (3, 1)}


@dataclass(frozen=True)
class DIComparison:
    """Rms over baselines and intervals of the seven parameters, in % of the rms of the errors that were put in.

    `linear` is the definition: parameters of the input, of the solution, and of G_true - G_solved. `quadratic` is the
    recipe of Asad et al. (2015): the same places of the Mueller matrix of dG_a (x) dG_b^*, which is of second order in
    dG. Each with the gauge as the solver left it ("raw") and with the best matrix of the gauge removed ("aligned").
    """

    __repr__ = short_repr
    rms: float
    linear: dict[str, dict[str, float]]
    quadratic: dict[str, dict[str, float]]

    def table(self) -> Any:
        """One row a quantity, one column a parameter, in %."""
        from astropy import units as u
        from astropy.table import QTable

        rows = [
            (f"{kind}, {which}", *values.values()) for kind, part in self._parts() for which, values in part.items()
        ]
        out = QTable(rows=rows, names=("quantity", *NAMES))
        for name in NAMES:
            out[name] = out[name] * u.percent
        out.meta["rms"] = self.rms
        return out

    def _parts(self) -> list[tuple[str, dict[str, dict[str, float]]]]:
        return [("linear", self.linear), ("quadratic", self.quadratic)]


def compare(truth: Complex, solution: Solution, antenna1: Int, antenna2: Int, rms: float) -> DIComparison:
    """Compare true Jones matrices (t, f, A, 2, 2) with a solution on baselines; `rms` is that of the errors put in.

    Intervals and stations without a solution are left out.
    """
    sums = DISums(antenna1, antenna2)
    sums.add(truth, solution)
    return sums.finish(rms)


class DISums:
    """What `compare` sums over intervals, block by block: a few numbers, however long the observation is."""

    def __init__(self, antenna1: Int, antenna2: Int) -> None:
        self.a, self.b = antenna1, antenna2
        self.sums: dict[tuple[str, str], Any] = {}  # by kind and label: of |x|^2 and of the x, (7, 2)

    def add(self, truth: Complex, solution: Solution) -> None:
        """Add the intervals of a block, true matrices (t, f, A, 2, 2)."""
        aligned = solution.aligned(to=truth).jones
        step = max(1, int(HELD // (1000 * truth.shape[1] * len(self.a))))  # a Mueller matrix and its making: 1 kB
        for t in range(0, len(truth), step):
            self._add(truth[t : t + step], solution.jones[t : t + step], aligned[t : t + step])

    def _add(self, truth: Complex, raw: Complex, aligned: Complex) -> None:
        self._linear("input", truth)
        for label, solved in (("raw", raw), ("aligned", aligned)):
            self._linear(f"solution, {label}", solved)
            difference = truth - solved
            self._linear(f"difference, {label}", np.eye(2) + difference)
            m = mueller(difference[:, :, self.a], difference[:, :, self.b])
            self._sum("quadratic", f"difference, {label}", [2 * m[..., i, j] for i, j in PLACES.values()])

    def _linear(self, label: str, jones: Complex) -> None:
        found = di_errors(jones[:, :, self.a], jones[:, :, self.b])
        self._sum("linear", label, [getattr(found, name) for name in NAMES])

    def _sum(self, kind: str, label: str, values: list[Complex]) -> None:
        power = [np.abs(x) ** 2 for x in values]
        found = np.array([(np.nansum(x), np.count_nonzero(~np.isnan(x))) for x in power])
        self.sums[kind, label] = self.sums.get((kind, label), 0.0) + found

    def finish(self, rms: float) -> DIComparison:
        """The rms of all that was added; NaN where there was no solution."""
        found: dict[str, dict[str, dict[str, float]]] = {"linear": {}, "quadratic": {}}
        for (kind, label), (power, count) in ((k, x.T) for k, x in self.sums.items()):
            values = 100 * np.sqrt(power / np.where(count > 0, count, np.nan)) / rms
            found[kind][label] = dict(zip(NAMES, values.tolist(), strict=True))
        return DIComparison(rms, **found)
