"""Figures of a calibration: solved gains against time for each station, convergence, residual of every interval."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from instrument.report.style import BLUE, GREY, ORANGE, axes_of, styled

if TYPE_CHECKING:
    from instrument.calibrate.base import Solution


@styled
def gains(solution: Solution, channel: int = 0) -> Figure:
    """Amplitude and phase of both receptors of every station (A rows) against time, as images in one figure.

    Departures from the median of each station; phases relative to the first station. Grey is no solution. Names of
    stations are every so many of them, where the solution has names.
    """
    jones = solution.jones[:, channel]
    hours = (solution.term.slots_s - solution.term.slots_s[0]) / 3600
    figure = Figure(figsize=(7.2, 8.4), layout="constrained")
    grid = figure.subplots(2, 2, sharex=True, sharey=True)
    step = solution.interval_s / 3600
    names = solution.term.stations or tuple(map(str, range(jones.shape[1])))
    rows = np.arange(0, len(names), max(1, -(-len(names) // 12)))
    extent = (hours[0] - step / 2, hours[-1] + step / 2, jones.shape[1] - 0.5, -0.5)
    for k, receptor in enumerate("pq"):
        g = jones[:, :, k, k]
        with np.errstate(invalid="ignore", divide="ignore"):
            size = np.where(np.isfinite(g).any(axis=0), np.abs(g), 0.0)  # 0: stations that have no solution at all
            amplitude = size / np.nanmedian(size, axis=0) - 1
            phase = np.rad2deg(np.angle(g * np.conj(g[:, :1])))
        percent = "amplitude, less 1 (%)"
        for ax, values, what in ((grid[0, k], 100 * amplitude, percent), (grid[1, k], phase, "phase (deg)")):
            good = values[np.isfinite(values)]
            high = float(np.percentile(np.abs(good), 99)) if good.size else 1.0
            drawn = ax.imshow(
                values.T,
                aspect="auto",
                extent=extent,
                cmap="RdBu_r",
                vmin=-high or -1,
                vmax=high or 1,
                interpolation="none",
            )
            ax.set_title(f"{receptor}: {what}")
            ax.set_facecolor("#bbbbbb")
            figure.colorbar(drawn, ax=ax, fraction=0.05, pad=0.02).locator = MaxNLocator(5)
    for ax in grid[:, 0]:
        ax.set_yticks(rows, [names[k] for k in rows], fontsize=10)
    for ax in grid[1]:
        ax.set_xlabel("time (h)")
    return figure


@styled
def convergence(solution: Solution, ax: Axes | None = None) -> Axes:
    """Largest relative step of any station in any interval after each iteration (n,), log scale."""
    ax = axes_of(ax, (6.4, 4.6))
    history = solution.history
    shown = np.where(history > 0, history, np.nan)
    ax.semilogy(np.arange(1, len(history) + 1), shown, "o-", color=BLUE, ms=4, label="slowest interval")
    ax.axvline(float(np.median(solution.iterations)), color=GREY, ls="--", label="median interval stands still")
    ax.set(xlabel="iteration", ylabel="largest relative step")
    ax.xaxis.set_major_locator(MaxNLocator(8, integer=True))
    ax.legend(frameon=False)
    return ax


@styled
def residuals(solution: Solution, channel: int = 0, ax: Axes | None = None) -> Axes:
    """Rms of V - J M J^H over the rms of V in each interval (t,), log scale; intervals that failed are crosses."""
    ax = axes_of(ax, (6.4, 4.6))
    hours = (solution.term.slots_s - solution.term.slots_s[0]) / 3600
    value = np.maximum(solution.residual[:, channel], 1e-17)
    good = solution.converged[:, channel]
    ax.semilogy(hours[good], value[good], ".", color=BLUE, label="converged")
    if not good.all():
        ax.semilogy(hours[~good], value[~good], "x", color=ORANGE, label=f"failed ({int((~good).sum())})")
    ax.set(xlabel="time since the first interval (h)", ylabel="residual over data (rms)")
    ax.legend(frameon=False)
    return ax
