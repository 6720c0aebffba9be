"""Figures of a run: leakage over the field and against distance, Stokes images, the point spread function.

Every function draws on the axes it is given, or on a new figure, and returns what it drew on; nothing touches pyplot.
"""

from __future__ import annotations

import os
from collections.abc import Callable
from functools import wraps
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, ParamSpec, TypeVar

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import Normalize, SymLogNorm
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Circle, Ellipse, Rectangle
from matplotlib.ticker import MaxNLocator

from instrument.errors import InputError
from instrument.observe.directions import lmn
from instrument.units import Direction, Float, unit_vectors

if TYPE_CHECKING:
    from instrument.analyze.leakage import Leakage
    from instrument.image.cube import StokesCube

P = ParamSpec("P")
R = TypeVar("R")
Kind = Literal["linear", "circular"]

# a figure 6.4 in wide is 370 px on a phone: 13 pt is then 10 px high
STYLE: Any = {
    "font.size": 13,
    "axes.titlesize": 13,
    "legend.fontsize": 11.5,
    "axes.axisbelow": True,
    "axes.linewidth": 0.8,
}
MOST = 600  # pixels of an image that are drawn along an axis: a panel has 350 of its own
BLUE, ORANGE, GREY = "#0072B2", "#D55E00", "#8a8a8a"  # Okabe & Ito: told apart with every colour vision
INK = "#222222"


def _styled(draw: Callable[P, R]) -> Callable[P, R]:
    @wraps(draw)
    def inner(*args: P.args, **kwargs: P.kwargs) -> R:
        with matplotlib.rc_context(STYLE):
            return draw(*args, **kwargs)

    return inner


@_styled
def bubbles(leakage: Leakage, centre: Direction | None = None, kind: Kind = "linear", ax: Axes | None = None) -> Axes:
    """Leakage of every source over the field: area and colour of a bubble are its % (G,), east is left.

    Sources near a null of the beam are grey crosses. The range of colours ends at the 98th percentile. `centre` is the
    phase centre; without it the source nearest to it must be within 0.01 deg of it.
    """
    if kind not in ("linear", "circular"):
        raise InputError(f"kind = '{kind}' is not one of 'linear', 'circular'")
    ax = _axes(ax, (6.4, 6.4))
    percent = leakage.linear_percent if kind == "linear" else leakage.circular_percent
    east, north = offsets_deg(leakage.ra_rad, leakage.dec_rad, _centre(leakage) if centre is None else centre)
    shown = ~leakage.near_null & np.isfinite(percent)
    top = float(np.percentile(percent[shown], 98)) if shown.any() else 0.0
    top = top if top > 0 else 1.0
    power = int(np.floor(np.log10(top))) if top < 0.1 else 0
    values, top = percent / 10.0**power, top / 10.0**power
    unit = "%" if power == 0 else f"× $10^{{{power}}}$ %"

    reach = 1.08 * max(float(np.abs([east, north]).max(initial=0)), 1e-3)
    ax.set(xlim=(reach, -reach), ylim=(-reach, reach), aspect="equal")
    ax.set(xlabel="offset east (deg)", ylabel="offset north (deg)", title=f"{kind.capitalize()} leakage")
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

    # bubbles of a full grid just touch; a crowd of sources gets small ones
    widest = float(np.clip(300 / np.sqrt(max(len(east), 1)), 6, 24))
    cmap, norm = matplotlib.colormaps["viridis_r"], Normalize(0, top)

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
    ax.scatter(
        east[lost], north[lost], s=min(16, widest**2 / 4), marker="x", color=GREY, lw=0.9, zorder=2, label="near a null"
    )
    bar = ax.figure.colorbar(
        drawn, ax=ax, fraction=0.045, pad=0.02, extend="max" if (values[shown] > top).any() else "neither"
    )
    bar.set_label(f"leakage ({unit.removeprefix('× ')} of I)", labelpad=8)
    bar.locator = MaxNLocator(5)
    bar.update_ticks()

    keys = [
        Line2D([], [], ls="", marker="o", ms=area(v) ** 0.5, mfc=cmap(norm(v)), mec=INK, mew=0.4, label=f"{v:g} {unit}")
        for v in MaxNLocator(4).tick_values(0, top)
        if 0 < v <= top
    ][-3:]
    below: Any = {"loc": "upper center", "frameon": False, "borderpad": 0}
    ax.add_artist(ax.legend(handles=keys, bbox_to_anchor=(0.5, -0.15), ncols=3, **below))
    if lost.any():
        text = f"near a null: not measured ({lost.sum()})"
        cross = Line2D([], [], ls="", marker="x", ms=4, color=GREY, label=text)
        ax.legend(handles=[cross], bbox_to_anchor=(0.5, -0.23), **below)
    return ax


@_styled
def profile(leakage: Leakage, ax: Axes | None = None) -> Axes:
    """Linear and circular leakage (log, %) of every source (G,) against its distance from the phase centre.

    Points are measured, open rings expected from the beam model, bars the medians in rings 1 deg wide. Sources near a
    null are left out. Values far below the rest (a centre corrected to nothing) are triangles on the lower edge.
    """
    ax = _axes(ax, (6.4, 5.2))
    use = ~leakage.near_null
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
        text = f"near a null: left out ({np.count_nonzero(~use)})"
        keys.append(Line2D([], [], ls="", marker="x", ms=5, color=GREY, label=text))
    ax.legend(handles=keys, loc="upper center", bbox_to_anchor=(0.46, -0.16), ncols=2, frameon=False)
    return ax


@_styled
def stokes_images(cube: StokesCube, channel: int = 0) -> Figure:
    """Images of I, Q, U, V (Ny, Nx each) of one channel in one figure, each with its own colours and SI prefix.

    Colours of I end at its 0.1 and 99.8 percentiles, those of Q, U, V at the 99.8 percentile of the magnitude. Images
    above 600 pixels are shown by the value of largest magnitude of every few pixels, so that no source is lost.
    """
    figure = Figure(figsize=(7.2, 6.4), layout="compressed")
    grid = figure.subplots(2, 2, sharex=True, sharey=True)
    step = 1
    for k, (name, ax) in enumerate(zip("IQUV", grid.flat, strict=True)):
        plane, extent, step = _shrunk(np.asarray(cube.data[channel, k], float), np.rad2deg(cube.pixel_rad))
        low, high = _range(plane, symmetric=name != "I")
        factor, prefix = _prefix(max(abs(low), abs(high)))
        drawn = ax.imshow(
            plane * factor,
            extent=extent,
            origin="lower",
            cmap="RdBu_r" if name != "I" else "magma",
            vmin=low * factor,
            vmax=high * factor,
        )
        ax.set_facecolor("#bbbbbb")  # no data
        ax.set_title(f"{name} ({prefix}{cube.unit})")
        bar = figure.colorbar(drawn, ax=ax, fraction=0.046, pad=0.02, extend=_beyond(plane, low, high))
        bar.locator = MaxNLocator(5)
        bar.update_ticks()
        ax.xaxis.set_major_locator(MaxNLocator(6, steps=[1, 2, 5, 10]))
        ax.yaxis.set_major_locator(MaxNLocator(6, steps=[1, 2, 5, 10]))
        if cube.psf is not None and np.isfinite(cube.psf.major_rad[channel]):
            _draw_psf(ax, cube, channel)
    figure.supxlabel("offset east (deg)", fontsize=13)
    figure.supylabel("offset north (deg)", fontsize=13)
    title = f"{cube.freq_hz[channel] / 1e6:.6g} MHz"
    if cube.psf is not None and np.isfinite(cube.psf.major_rad[channel]):
        title += f", PSF {_size(cube, channel)}"
    if step > 1:
        title += f"\neach dot: the largest of {step} x {step} pixels"
    figure.suptitle(title, fontsize=13)
    return figure


@_styled
def psf_image(cube: StokesCube, channel: int = 0, ax: Axes | None = None) -> Axes:
    """Central part of the PSF (Ny, Nx) of one channel, with the fitted Gaussian and the PSF itself at half maximum.

    Colours are linear up to 0.01 of the peak and logarithmic beyond. Raises `InputError` for a cube without a PSF.
    """
    if cube.psf is None:
        raise InputError("this cube has no PSF to draw")
    ax = _axes(ax, (6.4, 6.0))
    data, pixel = np.asarray(cube.psf.data[channel], float), 60 * np.rad2deg(cube.pixel_rad)
    ny, nx = data.shape
    major = float(cube.psf.major_rad[channel]) / cube.pixel_rad
    fitted = bool(np.isfinite(major))
    half = int(min(max(12, np.ceil(6 * major)) if fitted else 64, MOST // 2, ny // 2, nx // 2))
    # whole pixels on both sides of the centre pixel
    y, x = (slice(max(n // 2 - half, 0), n // 2 + half + 1) for n in (ny, nx))
    part = data[y, x]
    left, low = (nx // 2 - x.start + 0.5) * pixel, -(ny // 2 - y.start + 0.5) * pixel
    extent = (left, left - part.shape[1] * pixel, low, low + part.shape[0] * pixel)
    norm = SymLogNorm(0.01, linscale=0.6, vmin=-1, vmax=1, base=10)
    drawn = ax.imshow(part, extent=extent, origin="lower", cmap="RdBu_r", norm=norm, interpolation="nearest")
    ax.set_facecolor("#bbbbbb")
    bar = ax.figure.colorbar(drawn, ax=ax, fraction=0.045, pad=0.02, ticks=[-1, -0.1, -0.01, 0, 0.01, 0.1, 1])
    bar.ax.set_yticklabels(["-1", "-0.1", "-0.01", "0", "0.01", "0.1", "1"])
    bar.ax.minorticks_off()
    bar.set_label("PSF (peak 1)")
    east = left - (np.arange(part.shape[1]) + 0.5) * pixel
    north = low + (np.arange(part.shape[0]) + 0.5) * pixel
    keys = []
    if np.nanmax(part) > 0.5:
        ax.contour(east, north, part, levels=[0.5], colors="white", linewidths=1.6, linestyles="--", zorder=3)
        keys.append(Line2D([], [], color="white", ls="--", lw=1.6, label="PSF at half maximum"))
    if fitted:
        ax.add_patch(_ellipse((0, 0), cube, channel, 60, fill=False, ec="black", lw=1.8, zorder=2))
        keys.append(Line2D([], [], color="black", lw=1.8, label=f"fitted Gaussian, {_size(cube, channel)}"))
    ax.set(xlabel="offset east (arcmin)", ylabel="offset north (arcmin)")
    ax.set_title(f"PSF, {cube.freq_hz[channel] / 1e6:.6g} MHz")
    if keys:
        ax.legend(handles=keys, loc="lower left", facecolor="#a9a9a9", framealpha=0.9, edgecolor="none")
    return ax


def save(drawing: Figure | Axes, path: str | os.PathLike[str]) -> Path:
    """Write a figure, or the one that axes belong to, as PNG of 150 dots an inch; the file is whole or not there."""
    figure: Any = drawing if isinstance(drawing, Figure) else drawing.figure
    while not isinstance(figure, Figure):  # axes of a subfigure
        figure = figure.figure
    target = Path(path)
    partial = target.with_name(target.name + ".part")
    figure.savefig(partial, format="png", dpi=150, bbox_inches="tight", facecolor="white")
    partial.replace(target)
    return target


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


def _axes(ax: Axes | None, size: tuple[float, float]) -> Axes:
    return ax if ax is not None else Figure(figsize=size).add_subplot()


def _shrunk(plane: Float, step_deg: float) -> tuple[Float, tuple[float, float, float, float], int]:
    """An image of at most MOST pixels a side, its extent in deg (left, right, bottom, top), and the pixels in one."""
    ny, nx = plane.shape
    n = -(-max(ny, nx) // MOST)
    # x runs to the west from the centre pixel (ny // 2, nx // 2)
    left, bottom = (nx // 2 + 0.5) * step_deg, -(ny // 2 + 0.5) * step_deg
    if n > 1:
        padded = np.pad(plane, ((0, -ny % n), (0, -nx % n)), constant_values=np.nan)
        cells = padded.reshape(padded.shape[0] // n, n, -1, n).swapaxes(1, 2).reshape(-(-ny // n), -(-nx // n), n * n)
        largest = np.argmax(np.where(np.isnan(cells), -1.0, np.abs(cells)), axis=-1)
        plane = np.take_along_axis(cells, largest[..., None], axis=-1)[..., 0]
    width, height = plane.shape[1] * n * step_deg, plane.shape[0] * n * step_deg
    return plane, (left, left - width, bottom, bottom + height), n


def _range(plane: Float, symmetric: bool) -> tuple[float, float]:
    good = plane[np.isfinite(plane)]
    if not len(good):
        return (-1.0, 1.0) if symmetric else (0.0, 1.0)
    if symmetric:
        high = float(np.percentile(np.abs(good), 99.8)) or float(np.abs(good).max()) or 1.0
        return -high, high
    low, high = (float(v) for v in np.percentile(good, [0.1, 99.8]))
    return (low, high) if high > low else (low - 1, low + 1)


def _beyond(plane: Float, low: float, high: float) -> str:
    under, over = bool(np.nanmin(plane, initial=low) < low), bool(np.nanmax(plane, initial=high) > high)
    return {(True, True): "both", (True, False): "min", (False, True): "max"}.get((under, over), "neither")


def _prefix(value: float) -> tuple[float, str]:
    """The factor that brings a value to 1 to 1000, and the metric prefix it stands for."""
    for factor, prefix in ((1e-3, "k"), (1, ""), (1e3, "m"), (1e6, "µ"), (1e9, "n"), (1e12, "p")):
        if value * factor >= 1:
            return factor, prefix
    return 1.0, ""


def _ellipse(at: tuple[float, float], cube: StokesCube, channel: int, per_deg: float, **look: Any) -> Ellipse:
    assert cube.psf is not None
    major, minor = (np.rad2deg(w[channel]) * per_deg for w in (cube.psf.major_rad, cube.psf.minor_rad))
    # x is the offset east: a position angle, north through east, turns clockwise in (x, y)
    return Ellipse(at, minor, major, angle=-float(np.rad2deg(cube.psf.angle_rad[channel])), **look)


def _draw_psf(ax: Axes, cube: StokesCube, channel: int) -> None:
    """The PSF at half maximum, true to scale, in a box in the lower left corner."""
    assert cube.psf is not None
    left, right = ax.get_xlim()
    bottom, top = ax.get_ylim()
    box = max(1.5 * float(np.rad2deg(cube.psf.major_rad[channel])), 0.05 * (left - right))
    x, y = left - 0.02 * (left - right), bottom + 0.02 * (top - bottom)
    ax.add_patch(Rectangle((x - box, y), box, box, fc="white", ec=INK, lw=0.6, zorder=3))
    ax.add_patch(_ellipse((x - box / 2, y + box / 2), cube, channel, 1, fc=INK, ec="none", zorder=4))


def _size(cube: StokesCube, channel: int) -> str:
    assert cube.psf is not None
    major, minor = (60 * np.rad2deg(w[channel]) for w in (cube.psf.major_rad, cube.psf.minor_rad))
    if minor < 1:
        return f"{60 * major:.3g}″ x {60 * minor:.3g}″"
    return f"{major:.3g}′ x {minor:.3g}′"
