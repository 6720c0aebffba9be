"""Figures of stations (rows) against time or frequency: gains and phases, their errors, what a calibration leaves."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import LogNorm
from matplotlib.figure import Figure
from matplotlib.ticker import LogLocator, MaxNLocator, NullFormatter

from instrument.errors import InputError
from instrument.report.style import axes_of, styled
from instrument.units import Complex, Float, Int

if TYPE_CHECKING:
    from instrument.calibrate.base import Solution

COLUMNS = 360  # of a panel: of more intervals the one of largest magnitude is shown for every few
NOTHING = "#bbbbbb"  # no solution, no data
UNITS = (("s", 1.0), ("min", 60.0), ("h", 3600.0), ("d", 86400.0))
FEW = 3  # entries of a station that have a median of their own
TURNED = 100.0  # deg of phase beyond which colours go round
SEEN = 1e-10  # % or deg below which differences are rounding, and have no colours of their own
SMALLEST = 1e-17  # of an axis of shares: below rounding


@dataclass(frozen=True)
class Along:
    """Intervals or channels as even columns of an image: which column each has, what is between first and last."""

    label: str
    ends: tuple[float, float]
    column: Int
    count: int
    ticks: int = 4

    @classmethod
    def times(cls, slots_s: Float, step_s: float) -> Along:
        """Intervals of one length (t,), s, from the first on; gaps are columns too."""
        number = np.rint((slots_s - slots_s[0]) / step_s).astype(int)
        span = (int(number[-1]) + 1) * step_s
        name, unit = next((pair for pair in reversed(UNITS) if span >= 2 * pair[1]), UNITS[0])
        return cls._of(number, f"time since the first interval ({name})", 0.0, span / unit)

    @classmethod
    def channels(cls, freq_hz: Float) -> Along:
        """Channels (f,) in MHz, ascending; gaps are columns too."""
        step = float(np.diff(freq_hz).min(initial=np.inf))
        step = step if np.isfinite(step) else 1e6
        number = np.rint((freq_hz - freq_hz[0]) / step).astype(int)
        low = float(freq_hz[0] - step / 2) / 1e6
        found = cls._of(number, "frequency (MHz)", low, low + (int(number[-1]) + 1) * step / 1e6)
        return replace(found, ticks=2)  # "150.25" side by side met with 3

    @classmethod
    def _of(cls, number: Int, label: str, low: float, high: float) -> Along:
        total = int(number[-1]) + 1
        count = min(total, COLUMNS)
        return cls(label, (low, high), number * count // total, count)

    def gathered(self, values: Float) -> Float:
        """Values (n, A) as columns (A, count): of several the one of largest magnitude; NaN where there is none."""
        known, first = np.unique(self.column, return_index=True)
        high, low = (f.reduceat(values, first, axis=0) for f in (np.fmax, np.fmin))
        out = np.full((values.shape[1], self.count), np.nan)
        out[:, known] = np.where(np.abs(high) >= np.abs(low), high, low).T
        return out


@styled
def gains(solution: Solution, channel: int = 0) -> Figure:
    """Amplitude and phase of both receptors of every station (A rows) against time, as images in one figure.

    Amplitudes over the median of each station, phases relative to the first station that has a solution. Grey is no
    solution. Names of stations are every so many of them, where the solution has names.
    """
    along = Along.times(solution.term.slots_s, solution.interval_s)
    return _gains(solution.jones[:, channel], along, _names(solution))


@styled
def bandpass(solution: Solution, interval: int | None = None) -> Figure:
    """The same against frequency, (A rows, F), of one interval: that with most solutions unless given."""
    there = np.isfinite(solution.jones).all(axis=(-2, -1)).sum(axis=(1, 2))
    row = int(there.argmax()) if interval is None else interval
    return _gains(solution.jones[row], Along.channels(solution.term.freq_hz), _names(solution))


def _gains(jones: Complex, along: Along, names: Sequence[str]) -> Figure:
    """Images of the diagonals of matrices (n, A, 2, 2)."""
    figure = Figure(figsize=(7.2, 8.4), layout="constrained")
    grid = figure.subplots(2, 2, sharex=True, sharey=True)
    first = int(np.isfinite(jones).all(axis=(-2, -1)).sum(axis=0).argmax())
    for k, receptor in enumerate("pq"):
        g = jones[:, :, k, k]
        size = np.abs(g)
        middle = np.full((1, 1), np.nan)
        if np.isfinite(size).any():
            own = len(g) >= FEW  # one interval over its own median would be 1
            there: Any = np.isfinite(size).any(axis=0, keepdims=True)  # stations without any solution have no median
            middle = np.nanmedian(np.where(there, size, 0.0), axis=0, keepdims=True) if own else np.nanmedian(size)
        with np.errstate(invalid="ignore", divide="ignore"):
            amplitude = 100 * (size / middle - 1)
            phase = np.rad2deg(np.angle(g * np.conj(g[:, first : first + 1])))
        _signed(figure, grid[0, k], along.gathered(amplitude), along, f"{receptor}: amplitude, less 1 (%)")
        _signed(figure, grid[1, k], along.gathered(phase), along, f"{receptor}: phase (deg)", turns=True)
    for ax in grid[:, 0]:
        _rows(ax, names)
    figure.supxlabel(along.label, fontsize=13)
    return figure


def _signed(figure: Figure, ax: Axes, shown: Float, along: Along, title: str, turns: bool = False) -> None:
    """An image (A, n) of values on both sides of zero."""
    good = shown[np.isfinite(shown)]
    high = float(np.percentile(np.abs(good), 99)) if good.size else 1.0
    round_ = turns and high > TURNED
    high = 180.0 if round_ else high if high > SEEN else 1.0
    drawn = _image(ax, shown, along, cmap="twilight_shifted" if round_ else "RdBu_r", vmin=-high, vmax=high)
    ax.set_title(title)
    beyond = "neither" if round_ or not good.size or np.abs(good).max() <= high else "both"
    figure.colorbar(drawn, ax=ax, fraction=0.05, pad=0.02, extend=beyond).locator = MaxNLocator(5)


@styled
def gain_errors(solution: Solution, channel: int = 0, ax: Axes | None = None) -> Axes:
    """Standard errors of the gains of every station (A rows) against time, rms of the four elements; log colours.

    Raises `InputError` for a solution that does not know them.
    """
    error = np.asarray(solution.error, float)
    if not np.isfinite(error).any():
        raise InputError("this solution does not know the errors of its gains")
    error = np.broadcast_to(error, solution.jones.shape)[:, channel]
    return _positive(
        np.sqrt((error**2).mean(axis=(-2, -1))),
        Along.times(solution.term.slots_s, solution.interval_s),
        _names(solution),
        "standard error of a gain",
        ax,
    )


@styled
def left_by_stations(
    left: Float, slots_s: Float, step_s: float, names: Sequence[str] = (), ax: Axes | None = None
) -> Axes:
    """What a calibration leaves on the baselines of each station, (t, A), against time; log colours.

    Grey is no data. `slots_s` (t,) are the times of integrations that last `step_s`.
    """
    if left.ndim != 2 or len(left) != len(slots_s):
        raise InputError(f"what is left has shape {left.shape}, needed ({len(slots_s)}, stations)")
    label = "left over, of the model (rms)"
    return _positive(left, Along.times(slots_s, step_s), names or list(map(str, range(left.shape[1]))), label, ax)


def _positive(values: Float, along: Along, names: Sequence[str], label: str, ax: Axes | None) -> Axes:
    """An image of values (n, A) above zero in log colours."""
    ax = axes_of(ax, (6.4, 6.4))
    shown = along.gathered(values)
    shown = np.where(np.isfinite(shown), np.maximum(shown, SMALLEST), np.nan)
    good = shown[np.isfinite(shown)]
    low, high = (float(np.percentile(good, q)) for q in (1, 99.8)) if good.size else (0.1, 1.0)
    if high < 2 * low:  # all alike: colours of one decade about it
        low, high = low / 3, low * 3
    drawn = _image(ax, shown, along, cmap="viridis", norm=LogNorm(low, high))
    ax.set_xlabel(along.label)
    _rows(ax, names)
    bar = ax.figure.colorbar(drawn, ax=ax, fraction=0.045, pad=0.02)
    bar.set_label(label, labelpad=8)
    if high / low < 300:
        bar.ax.yaxis.set_major_locator(LogLocator(subs=(1, 2, 3, 5, 7) if high < 10 * low else (1, 2, 5)))
        bar.ax.yaxis.set_major_formatter("{x:g}")
    bar.ax.yaxis.set_minor_formatter(NullFormatter())
    return ax


def _image(ax: Axes, shown: Float, along: Along, **colours: Any) -> Any:
    extent = (*along.ends, len(shown) - 0.5, -0.5)
    ax.set_facecolor(NOTHING)
    drawn = ax.imshow(shown, aspect="auto", extent=extent, interpolation="none", **colours)
    ax.xaxis.set_major_locator(MaxNLocator(along.ticks))
    ax.ticklabel_format(axis="x", useOffset=False)  # "+1.5e2" MHz says nothing
    return drawn


def _rows(ax: Axes, names: Sequence[str]) -> None:
    """Names of every so many stations."""
    rows = range(0, len(names), max(1, -(-len(names) // 12)))
    ax.set_yticks(rows, [names[k] for k in rows], fontsize=10)


def _names(solution: Solution) -> Sequence[str]:
    return solution.term.stations or [str(k) for k in range(solution.jones.shape[2])]
