"""Figures of spectra of cubes: cylindrical power and its ratio to the 21-cm signal, and spherical curves."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
from matplotlib import colormaps
from matplotlib.axes import Axes
from matplotlib.colors import LogNorm, Normalize
from matplotlib.lines import Line2D
from matplotlib.patches import Patch, Rectangle
from matplotlib.patheffects import withStroke

from instrument.errors import InputError
from instrument.report.spectra import LOOKS, log_numbers
from instrument.report.style import INK, axes_of, styled
from instrument.units import Float

if TYPE_CHECKING:
    from collections.abc import Sequence

    from instrument.analyze.power.cylinders import Cylindrical, Spherical
    from instrument.analyze.power.signal import Signal21cm
    from instrument.analyze.power.window import EoRWindow

WEDGES = (2.0, 10.0, 90.0)  # deg from the phase centre; the last is the horizon
NO_DATA = "#bbbbbb"
HALO = [withStroke(linewidth=2.6, foreground="#333333")]  # white alone is lost on yellow


@styled
def cylinder(
    spectrum: Cylindrical,
    title: str = "",
    delta2: bool = True,
    wedges: Sequence[float] = WEDGES,
    ax: Axes | None = None,
) -> Axes:
    """Delta² (the paper's), or P, of every bin (P, L) on logarithmic axes and colours; grey bins are empty.

    Lines are the wedge of sources at `wedges` deg from the phase centre. Bins at k = 0 have no place on the axes.
    """
    unit = "K" if spectrum.unit == "K" else f"({spectrum.unit})"
    values, label = spectrum.power, f"P ({unit}$^2$ Mpc$^3$)"
    if delta2:
        values, label = spectrum.delta2, rf"$\Delta^2$ ({unit}$^2$)"
        if spectrum.unit == "K" and np.nanmax(values, initial=0) < 1:
            values, label = 1e6 * values, r"$\Delta^2$ (mK$^2$)"
    shown = np.where(values > 0, values, np.nan)
    if not np.isfinite(shown).any():
        raise InputError("this spectrum has no power to draw: every bin is empty or zero")
    top = float(np.nanmax(shown))
    # what is a rounding of the largest value is no structure
    norm = LogNorm(max(float(np.nanmin(shown)), 1e-12 * top), top)
    return _mesh(spectrum, shown, (norm, "viridis", "neither"), label, title, wedges, axes_of(ax, (6.8, 5.4)))


@styled
def cylinder_ratio(
    window: EoRWindow, removed: float = 0.0, reduced: float = 0.7, ax: Axes | None = None, name: str = "as it is"
) -> Axes:
    """Leakage and noise over the 21-cm signal (P, L), with contours at 1 for the leakage as it is and reduced.

    Blue is below the signal: the window. Grey bins are unknown, hatched ones are in the wedge. `name` is what the
    leakage is called where none of it is taken away.
    """
    spectrum = window.leakage
    ax = axes_of(ax, (6.8, 5.4))
    values = window.ratio(removed)
    shown = np.where(window.unknown | ~(values > 0), np.nan, values)
    power = np.log10(shown)
    reach = float(np.clip(np.nanmax(np.abs(power), initial=1.0), 1.0, 4.0))
    what = f"{removed:.0%} removed" if removed else f"leakage {name}"
    title = f"leakage over signal, {what}"
    label = "log$_{10}$ ratio of power"
    _mesh(spectrum, power, (Normalize(-reach, reach), "RdBu_r", "both"), label, title, (), ax)
    for i, j in zip(*np.nonzero(window.wedge), strict=True):
        (left, right), (low, high) = spectrum.perp_edges[i : i + 2], spectrum.par_edges[j : j + 2]
        box: Any = {"fill": False, "ec": INK, "lw": 0, "hatch": "///", "zorder": 2}
        ax.add_patch(Rectangle((left, low), right - left, high - low, **box))
    keys: list[Any] = []
    for share, look in ((removed, "-"), (reduced, "--")):
        level = window.ratio(share)
        _rim(ax, spectrum, np.where(window.unknown, np.nan, level), look)
        which = f"{share:.0%} removed" if share else name
        if np.nanmin(level) < 1 < np.nanmax(level):
            keys.append(Line2D([], [], color=INK, ls=look, lw=2, label=f"ratio 1, {which}"))
        else:
            side = "below" if np.nanmax(level) < 1 else "above"
            title += f"\n{which}: all {side} 1"  # no line to name in the legend
    if window.wedge.any():
        keys.append(Patch(fc="none", ec=INK, hatch="///", lw=0, label="wedge: not counted"))
    ax.set_title(title)
    if keys:
        below: Any = {"loc": "upper center", "bbox_to_anchor": (0.5, -0.16), "ncols": 3, "frameon": False}
        ax.legend(handles=keys, handlelength=1.6, **below)
    return ax


@styled
def spheres(curves: dict[str, Spherical], signals: Sequence[Signal21cm] = (), ax: Axes | None = None) -> Axes:
    """Delta² of spherical spectra (N,) against k, log-log, with the curves of 21-cm models; bars are sample errors."""
    if not curves:
        raise InputError("no spectrum was given to draw")
    units = {c.unit for c in curves.values()}
    if len(units) > 1 or (signals and units != {"K"}):
        raise InputError(f"spectra in {', '.join(sorted(units))} have no common axes: give all in K")
    ax = axes_of(ax, (6.8, 5.4))
    ax.set(xscale="log", yscale="log")
    kelvin = units == {"K"}
    factor = 1e6 if kelvin else 1.0
    tops: list[float] = []
    floors: list[float] = []
    for i, (name, curve) in enumerate(curves.items()):
        colour, marker = LOOKS[i % len(LOOKS)]
        values = factor * np.where(curve.power > 0, curve.delta2, np.nan)
        error = values * curve.sigma / curve.power
        label = name if np.isfinite(values).any() else f"{name}: no power"
        line: Any = {"color": colour, "marker": marker, "ms": 5, "lw": 1.4, "ls": ("-", "--")[i // len(LOOKS) % 2]}
        ax.errorbar(curve.k, values, error, elinewidth=1, capsize=0, label=label, **line)
        good = values[np.isfinite(values)]
        tops.extend(good)
        floors.extend(good)
    low, high = (f(f(c.k[c.count > 0]) for c in curves.values()) for f in (min, max))
    for signal, look in zip(signals, ("-", "--", ":", "-."), strict=False):
        use = (signal.k >= low / 1.5) & (signal.k <= high * 1.5)
        ax.plot(signal.k[use], signal.delta2_mk2[use], color=INK, lw=2, ls=look, label=signal.name, zorder=1)
        tops.extend(signal.delta2_mk2[use])
        floors.extend(signal.delta2_mk2[use])
    if floors:
        top = max(tops)
        ax.set_ylim(max(min(floors) / 3, 1e-12 * top), 3 * top)
    ax.set_xlim(low / 1.3, high * 1.3)
    unit = "mK$^2$" if kelvin else f"({next(iter(units))})$^2$"
    ax.set(xlabel="k (Mpc$^{-1}$)", ylabel=rf"$\Delta^2$ ({unit})")
    for axis, (left, right) in ((ax.xaxis, ax.get_xlim()), (ax.yaxis, ax.get_ylim())):
        log_numbers(axis, right / left)
    ax.grid(color="#dddddd", lw=0.6)
    ax.legend(loc="upper center", bbox_to_anchor=(0.46, -0.16), ncols=2, frameon=False)
    return ax


def _mesh(
    spectrum: Cylindrical,
    values: Float,
    look: tuple[Any, str, str],  # norm, name of the map, which ends go on
    label: str,
    title: str,
    wedges: Sequence[float],
    ax: Axes,
) -> Axes:
    norm, cmap, extend = look
    perp, par = spectrum.perp_edges.copy(), spectrum.par_edges.copy()
    # linear bins that begin at 0 or below are drawn from half-way to their end
    for edges in (perp, par):
        edges[0] = edges[0] if edges[0] > 0 else edges[1] / 2
    colours = colormaps[cmap].copy()
    drawn = ax.pcolormesh(perp, par, np.ma.masked_invalid(values.T), norm=norm, cmap=colours, rasterized=True)
    ax.set_facecolor(NO_DATA)
    ax.set(xscale="log", yscale="log", xlim=(perp[0], perp[-1]), ylim=(par[0], par[-1]))
    ax.set(xlabel=r"$k_\perp$ (Mpc$^{-1}$)", ylabel=r"$k_\parallel$ (Mpc$^{-1}$)")
    bar = ax.figure.colorbar(drawn, ax=ax, pad=0.02, extend=extend)
    bar.set_label(label)
    line = np.geomspace(perp[0], perp[-1], 50)
    for angle in wedges:
        height = spectrum.frame.horizon_slope * np.sin(np.deg2rad(angle)) * line
        inside = (height > par[0]) & (height < par[-1])
        if inside.any():
            ax.plot(line, height, color="white", lw=1.6, ls="-" if angle == 90 else "--", path_effects=HALO)
            at = int(np.flatnonzero(inside)[-1] * 0.8 + np.flatnonzero(inside)[0] * 0.2)
            name = "horizon" if angle == 90 else f"{angle:g}°"
            # a name to the left of its line would be cut by the left rim
            side: Any = (
                {"xytext": (-3, 3), "ha": "right"} if at > 20 else {"xytext": (5, -3), "ha": "left", "va": "top"}
            )
            ax.annotate(name, (line[at], height[at]), textcoords="offset points", color="white", size=11,
                        path_effects=HALO, **side)  # fmt: skip
    for axis, (left, right) in ((ax.xaxis, (perp[0], perp[-1])), (ax.yaxis, (par[0], par[-1]))):
        log_numbers(axis, right / left)
    if title:
        ax.set_title(title)
    return ax


def _rim(ax: Axes, spectrum: Cylindrical, ratio: Float, look: str) -> None:
    """The rim of the bins below 1, along their edges: nothing is read into a bin that is not in its number."""
    perp, par = spectrum.perp_edges, spectrum.par_edges
    below = ratio < 1
    known = np.isfinite(ratio)
    line: Any = {"color": INK, "ls": look, "lw": 2, "zorder": 3}
    for i, j in zip(*np.nonzero(known[1:] & known[:-1] & (below[1:] != below[:-1])), strict=True):
        ax.plot([perp[i + 1]] * 2, par[j : j + 2], **line)
    for i, j in zip(*np.nonzero(known[:, 1:] & known[:, :-1] & (below[:, 1:] != below[:, :-1])), strict=True):
        ax.plot(perp[i : i + 2], [par[j + 1]] * 2, **line)
