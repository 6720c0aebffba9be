"""ManyDirectionsResult: what solving for clusters of directions at once left of the data, and of the errors."""

from __future__ import annotations

import math
import os
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from instrument.shown import short_repr
from instrument.units import Float, Int
from instrument.whole_file import write_ecsv


@dataclass(frozen=True)
class ManyDirectionsResult:
    """What was measured: C clusters, and rms of visibilities in Jy over those that the solve did not flag.

    `error` (C,) is the rms per element of the solved matrices less the true means of their intervals, the gauge
    removed (what a model hardly sees is no gauge: noise fills it); `failed` (C,) is the share of intervals without a
    solution. `left_jy` remains of the data after subtraction, `due_jy` is what the noise, less the degrees of freedom
    of the solution, and the turning within intervals leave; `wrong_jy` is what was subtracted less the noiseless data.
    `one_*` are those of one direction for all. `failures` says how intervals failed. `apart_jy` (2, C) is the rms of
    what each cluster adds to noiseless data less what is subtracted of it, with many directions and with one, from an
    integration of each interval.
    """

    __repr__ = short_repr
    names: tuple[str, ...]
    sources: Int
    flux_jy: Float
    error: Float
    failed: Float
    data_jy: float
    noise_jy: float
    left_jy: float
    due_jy: float
    wrong_jy: float
    one_left_jy: float
    one_wrong_jy: float
    one_failed: float
    failures: tuple[str, ...] = ()
    apart_jy: Float | None = None

    @property
    def passed(self) -> bool:
        """Whether every solve converged."""
        return not np.any(self.failed > 0)

    @property
    def scale_jy(self) -> float:
        """The rms that others are told in: of the noise or, where there is none, of the data."""
        return self.noise_jy or self.data_jy

    @property
    def left(self) -> float:
        """Rms after subtraction over that of the noise (of the data where there is no noise)."""
        return self.left_jy / self.scale_jy

    @property
    def ratio(self) -> float:
        """How many times more one direction for all leaves."""
        return self.one_left_jy / self.left_jy if self.left_jy else math.inf

    def table(self) -> Any:
        """One row a cluster, and "all" with what holds for the sum: an astropy `QTable` with units."""
        from astropy import units as u
        from astropy.table import QTable

        def last(value: float) -> Float:
            return np.array([*np.full(len(self.names), np.nan), value])

        out = QTable()
        out["cluster"] = [*self.names, "all"]
        out["sources"] = [*self.sources, self.sources.sum()]
        out["flux"] = [*self.flux_jy, self.flux_jy.sum()] * u.Jy
        out["jones_error"] = [*self.error, np.sqrt(np.mean(self.error**2))]
        out["failed"] = 100 * np.array([*self.failed, self.failed.mean()]) * u.percent
        for name in ("data", "noise", "left", "due", "wrong", "one_left", "one_wrong"):
            out[name] = last(getattr(self, f"{name}_jy")) * u.Jy
        out["left_over_noise" if self.noise_jy else "left_over_data"] = last(self.left)
        out["ratio"] = last(self.ratio)
        out["one_failed"] = last(100 * self.one_failed) * u.percent
        return out

    def lines(self) -> list[str]:
        """The short text for the terminal."""
        lines = ["cluster         sources   flux Jy   error of matrices   failed %"]
        for row in zip(self.names, self.sources, self.flux_jy, self.error, 100 * self.failed, strict=True):
            lines.append("{:<15} {:7d} {:9.2f} {:19.2g} {:10.1f}".format(*row))
        lines += [f"intervals that failed       {text}" for text in self.failures]
        unit = "the noise" if self.noise_jy else "the data"
        form = ".3f" if self.noise_jy else ".1e"
        due, wrong, one, one_wrong = (
            f"{x / self.scale_jy:{form}}" for x in (self.due_jy, self.wrong_jy, self.one_left_jy, self.one_wrong_jy)
        )
        return [
            *lines,
            f"left after subtraction      {self.left:{form}} of {unit} ({self.scale_jy:.3g} Jy), {due} is due; "
            f"{wrong} wrongly subtracted",
            f"with one direction for all  {one} of {unit}, {self.ratio:.3g} times as much; "
            f"{one_wrong} wrongly subtracted",
        ]

    def write(self, folder: str | os.PathLike[str]) -> None:
        """Write many_directions.ecsv."""
        target = Path(folder)
        target.mkdir(parents=True, exist_ok=True)
        write_ecsv(self.table(), target / "many_directions.ecsv")
