"""The figures of a solution on a page, each with its caption: those of which the solution knows something."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING

import numpy as np

from instrument.report.calibration import common_errors, convergence, outcomes, residuals
from instrument.report.page import FigureEntry
from instrument.report.stations import COLUMNS, bandpass, gain_errors, gains

if TYPE_CHECKING:
    from instrument.calibrate.base import Solution


def solution_figures(solution: Solution, draw: Callable[..., FigureEntry]) -> list[FigureEntry]:
    """How it ended, gains (against frequency too where there are channels), their errors, convergence, residual.

    `draw` takes a name, a drawing and a caption, as `report.style.drawer` makes it.
    """
    several = "; of several in one column the worst is shown" if max(solution.outcome.shape) > COLUMNS else ""
    entries = [draw("outcomes", outcomes(solution), f"How the solve of every interval ended{several}; grey: no data.")]
    middle = solution.jones.shape[1] // 2
    where = f" at {solution.term.freq_hz[middle] / 1e6:.6g} MHz" if middle else ""
    if np.isfinite(solution.jones).any():
        text = f"Solved gains of every station{where}: amplitude over its median, less 1, and phase; grey: none."
        entries.append(draw("gains", gains(solution, middle), text))
        if middle:
            text = "The same against frequency, in the interval with most solutions."
            entries.append(draw("bandpass", bandpass(solution), text))
        if np.isfinite(solution.error).any():
            text = f"Standard errors of the gains{where} that noise makes: rms of the four elements of a matrix."
            entries.append(draw("gain_errors", gain_errors(solution, middle), text))
        if not np.isnan(solution.common_error).all():
            text = "Standard errors of what all stations have in common, the largest first; triangles: free."
            entries.append(draw("common_errors", common_errors(solution, middle), text))
    if (solution.history > 0).any():
        entries.append(draw("convergence", convergence(solution), "How the solve converged: the slowest interval."))
    if np.isfinite(solution.residual).any():
        text = f"What the solutions leave of the data they were solved from{where}."
        entries.append(draw("residual", residuals(solution, middle), text))
    return entries
