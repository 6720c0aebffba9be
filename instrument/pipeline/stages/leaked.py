"""What of the polarization of a sky without total intensity is seen in the images of I and V."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Self

import numpy as np

from instrument.image.cube import StokesCube
from instrument.pipeline.stage import StageResult
from instrument.predict.base import Problem
from instrument.report.page import Card, number
from instrument.units import Float


@dataclass(frozen=True)
class Leaked(StageResult):
    """Rms of I and of V over that of sqrt(Q² + U²) in the images of each channel (F,); one is empty where it is there.

    A Stokes parameter that the sky does not have is leakage wherever it is seen.
    """

    shares: dict[str, Float]

    @classmethod
    def of(cls, problem: Problem, cube: StokesCube) -> Self:
        """Those of a cube; none where the sky has the Stokes parameter itself, or no polarization."""
        there = problem.sky.nonzero(problem.at.freq_hz)
        if not any(there[1:3]):
            return cls({})
        rms = np.array([[_rms(plane) for plane in planes] for planes in cube.data])
        with np.errstate(invalid="ignore", divide="ignore"):
            share = rms[:, [0, 3]] / np.hypot(rms[:, 1], rms[:, 2])[:, None]
        found = {name: share[:, k] for k, name in enumerate("IV") if not there[(0, 3)[k]]}
        return cls({name: values for name, values in found.items() if np.isfinite(values).any()})

    def record(self) -> dict[str, Any]:
        """The shares of every channel."""
        return {"leaked": {name: values.tolist() for name, values in self.shares.items()}} if self.shares else {}

    def lines(self) -> list[str]:
        """The medians of the channels."""
        said = ", ".join(f"{self._percent(name)} % of P in {name}" for name in self.shares)
        return [f"leaked        {said}: rms of the images, median of the channels; the sky has none"] if said else []

    def cards(self) -> list[Card]:
        """What has leaked into I."""
        if "I" not in self.shares:
            return []
        v = f"; V\u00a0{self._percent('V')}\u00a0%" if "V" in self.shares else ""
        return [Card("Leaked into I", f"{self._percent('I')}\u00a0%", f"of P, rms of the images{v}")]

    def _percent(self, name: str) -> str:
        return number(100 * float(np.nanmedian(self.shares[name])), 2)


def _rms(plane: Float) -> float:
    good = plane[np.isfinite(plane)]
    return float(np.std(good)) if good.size else float("nan")
