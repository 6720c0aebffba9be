"""DI errors: the seven error parameters of what went in, of what was solved, and of their difference."""

from __future__ import annotations

from dataclasses import dataclass, fields
from typing import Any

import numpy as np

from instrument.calibrate.base import Solution
from instrument.jones.mueller import DIErrors, di_errors, mueller
from instrument.units import Complex, Int

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
    linear, quadratic = {}, {}
    linear["input"] = _linear(truth, antenna1, antenna2, rms)
    for label, solved in (("raw", solution.jones), ("aligned", solution.aligned(to=truth).jones)):
        linear[f"solution, {label}"] = _linear(solved, antenna1, antenna2, rms)
        difference = truth - solved
        linear[f"difference, {label}"] = _linear(np.eye(2) + difference, antenna1, antenna2, rms)
        quadratic[f"difference, {label}"] = _quadratic(difference, antenna1, antenna2, rms)
    return DIComparison(rms, linear, quadratic)


def _percent(values: Complex, rms: float) -> float:
    return float(100 * np.sqrt(np.nanmean(np.abs(values) ** 2)) / rms) if np.isfinite(values).any() else float("nan")


def _linear(jones: Complex, a: Int, b: Int, rms: float) -> dict[str, float]:
    found = di_errors(jones[:, :, a], jones[:, :, b])
    return {name: _percent(getattr(found, name), rms) for name in NAMES}


def _quadratic(difference: Complex, a: Int, b: Int, rms: float) -> dict[str, float]:
    m = mueller(difference[:, :, a], difference[:, :, b])
    return {name: _percent(2 * m[..., i, j], rms) for name, (i, j) in PLACES.items()}
