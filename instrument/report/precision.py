"""Figures of contests: error against seconds, error in the user's quantity, and what was asked against what came."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from instrument.report.spectra import log_numbers
from instrument.report.style import GREY, INK, styled

# Okabe & Ito, in the order of contestants
COLOURS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9", "#000000", "#7f7f7f", "#994F00")
MARKS = "osD^vP*Xh"


@styled
def precision_figure(
    contests: Sequence[tuple[Any, Sequence[Any], Sequence[Any]]], seconds: str = "wall seconds"
) -> Figure:
    """A row of panels for each contest, given as (contest, rows, rows of the Pareto front); what `seconds` are of."""
    figure = Figure(figsize=(15.5, 5.4 * len(contests)), layout="constrained")
    panels = figure.subplots(len(contests), 3, squeeze=False)
    for axes, (contest, rows, front) in zip(panels, contests, strict=True):
        _against_seconds(axes[0], contest, rows, front, "error")
        _against_seconds(axes[1], contest, rows, (), "error_user")
        _asked_and_got(axes[2], contest, rows)
        axes[0].set_title(contest.name, loc="left", fontweight="bold")
        for ax in axes[:2]:
            ax.set_xlabel(seconds)
        if any(np.isfinite(row.asked) for row in rows):
            axes[0].legend(loc="best", fontsize=10, frameon=False)
        else:  # nothing was asked: the third panel is free
            axes[2].clear()
            axes[2].set_axis_off()
            axes[2].legend(*axes[0].get_legend_handles_labels(), loc="center left", fontsize=11, frameon=False)
    return figure


@styled
def overview_figure(contests: Sequence[tuple[Any, Sequence[Any], Sequence[Any]]]) -> Figure:
    """Error against seconds of many contests, given as for `precision_figure`, three in a row."""
    lines = -(-len(contests) // 3)
    figure = Figure(figsize=(17, 5.6 * lines), layout="constrained")
    panels = figure.subplots(lines, 3, squeeze=False).ravel()
    for ax, (contest, rows, front) in zip(panels, contests, strict=False):
        _against_seconds(ax, contest, rows, front, "error")
        ax.set_title(contest.name, loc="left", fontweight="bold")
        ax.legend(loc="best", fontsize=9, frameon=False)
    for ax in panels[len(contests) :]:
        ax.set_axis_off()
    return figure


def _series(rows: Sequence[Any]) -> list[tuple[str, str, str, list[Any]]]:
    """Name, colour, mark and rows of each contestant."""
    names = list(dict.fromkeys(row.plugin for row in rows))
    return [
        (name, COLOURS[k % len(COLOURS)], MARKS[k % len(MARKS)], [row for row in rows if row.plugin == name])
        for k, name in enumerate(names)
    ]


def _against_seconds(ax: Axes, contest: Any, rows: Sequence[Any], front: Sequence[Any], which: str) -> None:
    ax.set(xscale="log", yscale="log", xlabel="wall seconds", ylabel=_wrapped(getattr(contest, which)))
    for name, colour, mark, own in _series(rows):
        good = [row for row in own if np.isfinite(row.seconds) and getattr(row, which) > 0]
        if good:
            x, y = ([getattr(row, key) for row in good] for key in ("seconds", which))
            style: dict[str, Any] = {"mfc": "none", "ls": "--"} if good[0].peer else {}
            ax.plot(x, y, color=colour, marker=mark, ms=6, lw=1.2, label=name, alpha=0.9, **style)
            if which == "error_user":
                ax.vlines(x, y, [max(row.error_user, row.user_max) for row in good], color=colour, lw=0.8, alpha=0.5)
            for row in (good[0], good[-1])[: (2 if len(good) > 1 else 1) if np.isfinite(good[0].asked) else 0]:
                where = (row.seconds, getattr(row, which))
                ax.annotate(f"{row.asked:.3g}", where, xytext=(5, 4), textcoords="offset points", fontsize=9, color=INK)
        lost = sum(not np.isfinite(row.seconds) for row in own)
        if lost:  # failures stay in: at the edge, with their count
            place = 0.95 - 0.06 * list(dict.fromkeys(row.plugin for row in rows)).index(name)
            ax.plot(1.0, place, "x", color=colour, transform=ax.transAxes, clip_on=False, ms=9, mew=2.5)
            ax.text(1.02, place, str(lost), color=colour, transform=ax.transAxes, va="center", fontsize=10)
    if len(front) > 1:
        ax.plot([r.seconds for r in front], [r.error for r in front], color=GREY, lw=5, alpha=0.35, zorder=0)
    low, high = ax.get_xlim()
    log_numbers(ax.xaxis, high / low)
    ax.grid(color="#dddddd", lw=0.6)


def _asked_and_got(ax: Axes, contest: Any, rows: Sequence[Any]) -> None:
    """What was asked against what came; settings that are no errors have no line of what is right."""
    promised = contest.honoured
    ax.set(yscale="log", xlabel=contest.knob, ylabel="error that came")
    asked = [row.asked for row in rows if row.asked > 0]
    if promised or (asked and max(asked) > 30 * min(asked)):
        ax.set_xscale("log")
    for k, (_, colour, mark, own) in enumerate(_series(rows)):
        good = [row for row in own if row.error > 0]
        style: dict[str, Any] = {"color": colour, "marker": mark, "lw": 1.2, "alpha": 0.9}
        # the first are drawn larger, and seen where several are the same
        ax.plot([r.asked for r in good], [r.error for r in good], ms=max(10 - 2 * k, 4), **style)
        for row in own:
            if not np.isfinite(row.error):
                ax.axvline(row.asked, color=colour, lw=0.8, ls=":", alpha=0.7)
    if promised:
        low, high = ax.get_xlim()
        ax.plot([low, high], [low, high], color=GREY, lw=1.5, ls="--", zorder=0, label="as asked")
        ax.fill_between([low, high], [low, high], 10 * max(high, 1.0), color="#D55E00", alpha=0.06, lw=0)
        found = [r.error for r in rows if r.error > 0]
        if found:
            ax.set_ylim(min(found) / 3, max(*found, high) * 3)
        ax.set_xlim(low, high)
        ax.legend(loc="upper left", fontsize=10, frameon=False)
    ax.grid(color="#dddddd", lw=0.6)


def _wrapped(text: str, width: int = 44) -> str:
    lines, line = [], ""
    for word in text.split():
        if line and len(line) + len(word) >= width:
            lines.append(line)
            line = word
        else:
            line = f"{line} {word}".strip()
    return "\n".join([*lines, line])


@styled
def point_figure(
    rows: Sequence[tuple[str, float, float, float]], engine: str, seconds: float, errors: tuple[float, float]
) -> Figure:
    """Curves of engines, rows of (engine, asked, seconds a visibility, error), and one run with its error and bound."""
    figure = Figure(figsize=(6.4, 4.6), layout="constrained")
    ax = figure.subplots()
    ax.set(xscale="log", yscale="log", xlabel="wall seconds a visibility", ylabel="error over the total flux")
    for k, name in enumerate(dict.fromkeys(row[0] for row in rows)):
        own = [row for row in rows if row[0] == name]
        x, y = ([row[i] for row in own] for i in (2, 3))
        ax.plot(x, y, color=COLOURS[k], marker=MARKS[k], ms=6, lw=1.2, label=name)
        for row in (own[0], own[-1]):
            ax.annotate(f"{row[1]:.2g}", row[2:], xytext=(5, 4), textcoords="offset points", fontsize=10, color=INK)
    error, bound = errors
    ax.plot([seconds, seconds], [error, bound], color=INK, lw=1.2)
    ax.plot(seconds, bound, "_", color=INK, ms=12, mew=1.5)
    ax.plot(seconds, error, "*", color="#E69F00", mec=INK, ms=18, label=f"this run ({engine})", zorder=5)
    low, high = ax.get_xlim()
    log_numbers(ax.xaxis, high / low)
    ax.grid(color="#dddddd", lw=0.6)
    ax.legend(fontsize=11, frameon=False)
    return figure
