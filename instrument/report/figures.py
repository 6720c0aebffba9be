"""Figures of leakage: over the field, and against the distance from the phase centre.

Every function draws on the axes it is given, or on a new figure, and returns what it drew on; nothing touches pyplot.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Literal

import numpy as np
from matplotlib import colormaps
from matplotlib.axes import Axes
from matplotlib.colors import Normalize
from matplotlib.lines import Line2D
from matplotlib.patches import Circle
from matplotlib.ticker import MaxNLocator

from instrument.errors import InputError
from instrument.observe.directions import lmn
from instrument.report.style import BLUE, GREY, INK, ORANGE, axes_of, styled
from instrument.units import Direction, Float, unit_vectors

if TYPE_CHECKING:
    from instrument.analyze.sources.leakage import Leakage

Kind = Literal["linear", "circular"]
CROWD = 300  # sources not measured whose crosses would drown those that were


@styled
def bubbles(leakage: Leakage, centre: Direction | None = None, kind: Kind = "linear", ax: Axes | None = None) -> Axes:
    """Leakage of every source over the field: area and colour of a bubble are its % (G,), east is left.

    Sources that are not measured (near a null, or too faint) are grey crosses, more than 300 of them faint dots. The
    range of colours ends at the 98th percentile. `centre` is the phase centre; without it the source nearest to it must
    be within 0.01 deg of it.
    """
    if kind not in ("linear", "circular"):
        raise InputError(f"kind = '{kind}' is not one of 'linear', 'circular'")
    ax = axes_of(ax, (6.4, 6.4))
    percent = leakage.linear_percent if kind == "linear" else leakage.circular_percent
    east, north = offsets_deg(leakage.ra_rad, leakage.dec_rad, _centre(leakage) if centre is None else centre)
    shown = leakage.measured & np.isfinite(percent)
    top = float(np.percentile(percent[shown], 98)) if shown.any() else 0.0
    top = top if top > 0 else 1.0
    power = int(np.floor(np.log10(top))) if top < 0.1 else 0
    values, top = percent / 10.0**power, top / 10.0**power
    unit = "%" if power == 0 else f"× $10^{{{power}}}$ %"

    reach = 1.08 * max(float(np.abs([east, north]).max(initial=0)), 1e-3)
    ax.set(xlim=(reach, -reach), ylim=(-reach, reach), aspect="equal")
    ax.set(xlabel="offset east (deg)", ylabel="offset north (deg)", title=f"{kind.capitalize()} leakage")
    _circles(ax, reach, east, north)

    # bubbles of a full grid just touch; a crowd of sources gets small ones
    widest = float(np.clip(300 / np.sqrt(max(len(east), 1)), 6, 24))
    cmap, norm = colormaps["viridis_r"], Normalize(0, top)

    def area(value: Any) -> Any:
        return np.maximum(widest**2 * np.clip(value / top, 0, 1), 2.0)

    order = np.flatnonzero(shown)[np.argsort(-values[shown])]
    drawn = ax.scatter(
        *(east[order], north[order]),
        s=area(values[order]),
        c=values[order],
        cmap=cmap,
        norm=norm,
        ec=INK,
        lw=0.4,
        zorder=3,
    )
    drawn.set_label("measured")
    lost = ~shown
    crowd: Any = {"marker": ".", "s": 3, "lw": 0, "alpha": 0.6}
    cross: Any = {"marker": "x", "s": min(16, widest**2 / 4), "lw": 0.9}
    look = crowd if lost.sum() > CROWD else cross
    ax.scatter(east[lost], north[lost], color=GREY, zorder=2, label="not measured", **look)
    _bar(drawn, ax, bool((values[shown] > top).any()), unit)

    keys = [
        Line2D([], [], ls="", marker="o", ms=area(v) ** 0.5, mfc=cmap(norm(v)), mec=INK, mew=0.4, label=f"{v:g} {unit}")
        for v in MaxNLocator(4).tick_values(0, top)
        if 0 < v <= top
    ][-3:]
    _legends(ax, keys, int(lost.sum()))
    return ax


def _circles(ax: Axes, reach: float, east: Float, north: Float) -> None:
    """Circles of 2 and 4 deg about the centre, their radius written where sources leave room."""
    crowd = len(east) > 500
    above = 3 if crowd else 0  # circles would drown below a crowd of sources
    for radius in (2, 4):
        ax.add_patch(
            Circle((0, 0), radius, fill=False, color=INK if crowd else GREY, lw=1, ls=(0, (4, 3)), zorder=1 + above)
        )
        if radius < reach:
            box = {"boxstyle": "round,pad=0.1", "fc": "white", "ec": "none"}
            x, y = _clearest(radius, east, north)
            ax.text(
                x, y, f"{radius}°", color="#555555", size=11, ha="center", va="center", bbox=box, zorder=1.5 + above
            )


def _bar(drawn: Any, ax: Axes, over: bool, unit: str) -> None:
    """The bar of colours; `over` where some are beyond its end."""
    bar = ax.figure.colorbar(drawn, ax=ax, fraction=0.045, pad=0.02, extend="max" if over else "neither")
    bar.set_label(f"leakage ({unit.removeprefix('× ')} of I)", labelpad=8)
    bar.locator = MaxNLocator(5)
    bar.update_ticks()


def _legends(ax: Axes, keys: list[Line2D], lost: int) -> None:
    """What sizes mean, and how many sources are not measured."""
    below: Any = {"loc": "upper center", "frameon": False, "borderpad": 0}
    ax.add_artist(ax.legend(handles=keys, bbox_to_anchor=(0.5, -0.15), ncols=3, **below))
    if lost:
        text = f"not measured: near a null, or too faint ({lost})"
        cross = Line2D([], [], ls="", marker="." if lost > CROWD else "x", ms=4, color=GREY, label=text)
        ax.legend(handles=[cross], bbox_to_anchor=(0.5, -0.23), **below)


@styled
def profile(leakage: Leakage, ax: Axes | None = None) -> Axes:
    """Linear and circular leakage (log, %) of every source (G,) against its distance from the phase centre.

    Points are measured, open rings expected from the beam model, bars the medians in rings 1 deg wide. Sources near a
    null are left out. Values far below the rest (a centre corrected to nothing) are triangles on the lower edge.
    """
    ax = axes_of(ax, (6.4, 5.2))
    use = leakage.measured
    distance = np.rad2deg(leakage.distance_rad[use])
    measured = {"linear": leakage.linear_percent[use], "circular": leakage.circular_percent[use]}
    positive = np.concatenate([v[np.isfinite(v) & (v > 0)] for v in measured.values()])
    floor = float(np.percentile(positive, 5)) / 3 if len(positive) else 1e-3
    top = float(positive.max()) * 2 if len(positive) else 1.0
    below = 0
    for column, (name, colour) in enumerate((("linear", BLUE), ("circular", ORANGE))):
        values = measured[name]
        low = values < floor
        below += int(low.sum())
        ax.scatter(distance[~low], values[~low], s=13 if len(values) < 500 else 4, color=colour, lw=0, zorder=3)
        edge = np.full(int(low.sum()), floor * 1.15)
        ax.scatter(distance[low], edge, s=34, marker="v", color=colour, lw=0, zorder=3, clip_on=False)
        if leakage.expected is not None:
            model = leakage.expected[use, column]
            ax.scatter(distance, model, s=42, fc="none", ec=colour, lw=0.7, alpha=0.65, zorder=2)
        ring = np.floor(distance)
        for start in np.unique(ring):
            inside = values[(ring == start) & np.isfinite(values)]
            if len(inside) and np.median(inside) >= floor:
                ax.plot([start, start + 1], [np.median(inside)] * 2, color=INK, lw=2, zorder=4)
    ax.set(yscale="log", ylim=(floor, top), xlim=(0, max(float(distance.max(initial=0)) * 1.04, 1e-3)))
    ax.set(xlabel="distance from the phase centre (deg)", ylabel="leakage (% of I)", title="Leakage against distance")
    ax.grid(color="#dddddd", lw=0.6)

    keys = [
        Line2D([], [], ls="", marker="o", ms=5, mec="none", mfc=BLUE, label="linear, measured"),
        Line2D([], [], ls="", marker="o", ms=5, mec="none", mfc=ORANGE, label="circular, measured"),
    ]
    if leakage.expected is not None:
        keys.append(Line2D([], [], ls="", marker="o", ms=7, mfc="none", mec=INK, mew=0.8, label="from the beam model"))
    keys.append(Line2D([], [], color=INK, lw=2, label="median of each degree"))
    if below:
        keys.append(Line2D([], [], ls="", marker="v", ms=6, color=INK, label=f"below the axis ({below})"))
    if not use.all():
        text = f"not measured: left out ({np.count_nonzero(~use)})"
        keys.append(Line2D([], [], ls="", marker="x", ms=5, color=GREY, label=text))
    ax.legend(handles=keys, loc="upper center", bbox_to_anchor=(0.46, -0.16), ncols=2, frameon=False)
    return ax


def offsets_deg(ra_rad: Float, dec_rad: Float, centre: Direction) -> tuple[Float, Float]:
    """Offsets east and north (S,) in deg from a centre; distances from it are true (zenithal equidistant)."""
    l, m, n1 = lmn(unit_vectors(ra_rad, dec_rad), centre).T
    across = np.hypot(l, m)
    with np.errstate(divide="ignore", invalid="ignore"):
        scale = np.where(across > 0, np.rad2deg(np.arctan2(across, 1 + n1)) / across, np.rad2deg(1))
    return l * scale, m * scale


def _centre(leakage: Leakage) -> Direction:
    nearest = int(np.argmin(leakage.distance_rad))
    if np.rad2deg(leakage.distance_rad[nearest]) > 0.01:
        raise InputError("no source is at the phase centre, so it is not known: give centre=")
    return Direction(float(leakage.ra_rad[nearest]), float(leakage.dec_rad[nearest]))


def _clearest(radius: float, east: Float, north: Float) -> tuple[float, float]:
    """The point of a circle about the centre that is farthest from any source."""
    angle = np.linspace(0, 2 * np.pi, 144, endpoint=False)
    x, y = radius * np.cos(angle), radius * np.sin(angle)
    best = int(np.argmax(np.hypot(x[:, None] - east, y[:, None] - north).min(axis=1, initial=np.inf)))
    return float(x[best]), float(y[best])
