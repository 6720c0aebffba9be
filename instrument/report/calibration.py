"""Figures of a calibration: how each interval ended, convergence, residuals, errors of common directions."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import BoundaryNorm, ListedColormap
from matplotlib.patches import Patch
from matplotlib.ticker import MaxNLocator

from instrument.errors import InputError, Outcome
from instrument.report.spectra import LOOKS
from instrument.report.stations import NOTHING, SMALLEST, Along
from instrument.report.style import BLUE, GREY, ORANGE, axes_of, styled
from instrument.units import Float

if TYPE_CHECKING:
    from instrument.calibrate.base import Solution

MARKED = 40  # intervals whose values have markers of their own
# the worst last, as it is what a column of several intervals shows; colours that the night leaves alone
ENDED = (
    (Outcome.CONVERGED, "converged", "#56B4E9"),
    (Outcome.POOR_FIT, "poor fit", "#E0522D"),
    (Outcome.ITERATION_LIMIT, "iteration limit", "#E69F00"),
    (Outcome.SINGULAR, "singular", "#CC79A7"),
    (Outcome.NON_FINITE, "not finite", "#F0E442"),
    (Outcome.REFUSED, "refused, no data", "#8E6BBF"),
)


@styled
def outcomes(solution: Solution, ax: Axes | None = None) -> Axes:
    """How every interval and channel ended (t, f), as a map in time and frequency, with how many ended how."""
    times, channels = solution.outcome.shape
    ax = axes_of(ax, (6.4, 2.2 if channels == 1 else 4.8))
    along = Along.times(solution.term.slots_s, solution.interval_s)
    code = np.zeros((times, channels))
    for k, (outcome, _, _) in enumerate(ENDED):
        code[solution.outcome == outcome] = k
    up = Along.channels(solution.term.freq_hz)
    colours = ListedColormap([colour for _, _, colour in ENDED])
    ax.imshow(
        up.gathered(along.gathered(code)).T,
        aspect="auto",
        origin="lower",
        extent=(*along.ends, *up.ends),
        interpolation="none",
        cmap=colours,
        norm=BoundaryNorm(np.arange(len(ENDED) + 1) - 0.5, len(ENDED)),
    )
    ax.set_facecolor(NOTHING)
    ax.set_xlabel(along.label)
    if channels == 1:
        ax.set_yticks([])
    else:
        ax.set_ylabel(up.label)
        ax.ticklabel_format(axis="y", useOffset=False)
    counts = [(name, colour, int((solution.outcome == o).sum())) for o, name, colour in ENDED]
    keys = [Patch(color=colour, label=f"{name} ({count})") for name, colour, count in counts if count]
    ax.legend(handles=keys, frameon=False, loc="lower left", bbox_to_anchor=(0, 1), ncols=2, borderpad=0.2)
    return ax


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
    along, middle = _middles(solution)
    value = np.maximum(solution.residual[:, channel], SMALLEST)
    good = solution.converged[:, channel]
    ax.set_yscale("log")
    if good.any():
        ax.plot(middle[good], value[good], ".", color=BLUE, label="converged")
    if not good.all():
        ax.plot(middle[~good], value[~good], "x", color=ORANGE, label=f"failed ({int((~good).sum())})")
    ax.set(xlabel=along.label, ylabel="residual over data (rms)", xlim=along.ends)
    ax.legend(frameon=False)
    return ax


@styled
def common_errors(solution: Solution, channel: int = 0, ax: Axes | None = None) -> Axes:
    """Standard errors of the common directions of all stations (t, n) against time, log scale; largest first.

    Triangles on the upper edge are directions that the model leaves free. Raises `InputError` where none are known.
    """
    errors = np.asarray(solution.common_error, float)
    if np.isnan(errors).all():
        raise InputError("this solution does not know the errors of its common directions")
    errors = np.broadcast_to(errors, (*solution.outcome.shape, errors.shape[-1]))[:, channel]
    ax = axes_of(ax, (6.4, 4.8))
    along, middle = _middles(solution)
    known = np.isfinite(errors) & (errors > 0)
    top = 3 * float(errors[known].max()) if known.any() else 1.0
    # a line ends at a gap, and has markers where there is room for them
    ahead = np.flatnonzero(np.diff(middle) > 1.5 * np.diff(middle).min(initial=np.inf)) + 1
    few = len(middle) <= MARKED
    for k, each in enumerate(errors.T):
        if np.isnan(each).all():
            continue
        colour, marker = LOOKS[k % len(LOOKS)]
        free = np.flatnonzero(np.isposinf(each))
        shown = np.insert(np.where(known[:, k], each, np.nan), ahead, np.nan)
        line = ("-", "--")[k // len(LOOKS) % 2]
        look: Any = {"color": colour, "marker": marker if few else "", "ms": 5, "lw": 1.4, "ls": line}
        name = f"direction {k + 1}" + (", free" if len(free) == len(each) else "")
        ax.plot(np.insert(middle, ahead, np.nan), shown, label=name, **look)
        some = free[:: -(-len(free) // MARKED) or 1]
        ax.plot(middle[some], np.full(len(some), top), color=colour, marker="^", ms=6, ls="", clip_on=False)
    ax.set(yscale="log", xlabel=along.label, ylabel="standard error of a common direction", xlim=along.ends)
    ax.set_ylim(top=top)
    ax.grid(color="#dddddd", lw=0.6, axis="y")
    ax.legend(frameon=False, loc="lower left", bbox_to_anchor=(0, 1), ncols=3, borderpad=0.2, columnspacing=1.2)
    return ax


def _middles(solution: Solution) -> tuple[Along, Float]:
    """The axis of time, and where the middle of each interval (t,) is on it."""
    along = Along.times(solution.term.slots_s, solution.interval_s)
    slots = solution.term.slots_s
    share = (slots - slots[0] + solution.interval_s / 2) / (slots[-1] - slots[0] + solution.interval_s)
    return along, along.ends[0] + share * (along.ends[1] - along.ends[0])
