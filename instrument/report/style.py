"""What all figures share: fonts that read on a phone, colours for every eye, axes to draw on, and saving."""

from __future__ import annotations

import os
from collections.abc import Callable
from functools import wraps
from pathlib import Path
from typing import Any, ParamSpec, TypeVar

import matplotlib
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from instrument.memory import give_back
from instrument.report.night import night
from instrument.report.page import FigureEntry
from instrument.whole_file import whole_file

P = ParamSpec("P")
R = TypeVar("R")

# a figure 6.4 in wide is 370 px on a phone: 13 pt is then 10 px high
STYLE: Any = {
    "font.size": 13,
    "axes.titlesize": 13,
    "legend.fontsize": 11.5,
    "axes.axisbelow": True,
    "axes.linewidth": 0.8,
}
BLUE, ORANGE, GREY = "#0072B2", "#D55E00", "#8a8a8a"  # Okabe & Ito: told apart with every colour vision
INK = "#222222"


def styled(draw: Callable[P, R]) -> Callable[P, R]:
    """Draws with the style of this package, whatever the user's own is."""

    @wraps(draw)
    def inner(*args: P.args, **kwargs: P.kwargs) -> R:
        with matplotlib.rc_context(STYLE):
            return draw(*args, **kwargs)

    return inner


def axes_of(ax: Axes | None, size: tuple[float, float]) -> Axes:
    """The axes given, or those of a new figure of a size in inches."""
    return ax if ax is not None else Figure(figsize=size).add_subplot()


def drawer(folder: Path) -> Callable[..., FigureEntry]:
    """A function (name, drawing, caption, wide) that writes a figure into a folder and gives the entry of its page.

    The page shows it in the colours of the night too, where the reader's screen asks for them.
    """

    def draw(name: str, drawing: Figure | Axes, caption: str, wide: bool = False) -> FigureEntry:
        figure = figure_of(drawing)
        entry = FigureEntry(save(figure, folder / f"{name}.png"), caption, wide=wide, dark=night(figure))
        figure.clear()  # its parts hold each other: up to 15 MB a figure that would wait for the collector
        give_back()
        return entry

    return draw


def figure_of(drawing: Figure | Axes) -> Figure:
    """A figure, or the one that axes belong to."""
    figure: Any = drawing if isinstance(drawing, Figure) else drawing.figure
    while not isinstance(figure, Figure):  # axes of a subfigure
        figure = figure.figure
    return figure


def save(drawing: Figure | Axes, path: str | os.PathLike[str], overwrite: bool = False) -> Path:
    """Write a figure, or the one that axes belong to, as PNG of 150 dots an inch; the file is whole or not there."""
    with whole_file(path, overwrite) as partial:
        figure_of(drawing).savefig(partial, format="png", dpi=150, bbox_inches="tight", facecolor="white")
    return Path(path)
