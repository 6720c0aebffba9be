"""Figures of Faraday depth: slices of the sky, lines of sight, and the RMSF."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Circle
from matplotlib.patheffects import withStroke
from matplotlib.ticker import MaxNLocator

from instrument.analyze.faraday.band import number
from instrument.errors import InputError
from instrument.report.images import _prefix, _shrunk
from instrument.report.style import BLUE, GREY, INK, ORANGE, axes_of, styled

if TYPE_CHECKING:
    from instrument.analyze.faraday.cube import FaradayCube

PHI = r"Faraday depth $\phi$ (rad m$^{-2}$)"
HALO = [withStroke(linewidth=2.6, foreground="#333333")]  # white alone is lost on what is bright
LINES = ((INK, "-"), (BLUE, "-"), (ORANGE, "--"), ("#009E73", "-."), ("#CC79A7", ":"), (GREY, "-"))


@styled
def faraday_slices(cube: FaradayCube, depths: Any, circles: Sequence[float] = (2.0, 3.8)) -> Figure:
    """Images of |F| (Ny, Nx) at the computed depths nearest to those given (rad/m²), with one scale of colours.

    `circles` are diameters in deg about the centre pixel; the paper's are 2 deg and 3.8 deg, the half-power width of
    the station beam. Those larger than the image are left out. Colours end at the 99.8 percentile. Raises
    `InputError` where no depth is given.
    """
    wanted = np.atleast_1d(number(depths, "rad/m2", "depths"))
    if not wanted.size:
        raise InputError("no Faraday depth was given to draw")
    found = [int(np.argmin(np.abs(cube.depths - d))) for d in wanted.ravel()]
    columns = min(len(found), 3)
    rows = -(-len(found) // columns)
    figure = Figure(figsize=(1.2 + 2.9 * columns, 1.1 + 2.8 * rows), layout="compressed")
    grid = figure.subplots(rows, columns, sharex=True, sharey=True, squeeze=False)
    planes = [_shrunk(np.abs(cube.data[k]).astype(float), np.rad2deg(cube.pixel_rad)) for k in found]
    seen = np.concatenate([p[np.isfinite(p)] for p, _, _ in planes])
    high = (float(np.percentile(seen, 99.8)) or float(seen.max())) if seen.size else 1.0
    factor, prefix = _prefix(high or 1.0)
    drawn: Any = None
    half = 0.0
    for ax, k, (plane, extent, _) in zip(grid.flat, found, planes, strict=False):
        drawn = ax.imshow(
            plane * factor, extent=extent, origin="lower", cmap="magma", vmin=0, vmax=(high or 1) * factor
        )
        ax.set_facecolor("#bbbbbb")  # no data
        ax.set_title(f"$\\phi$ = {cube.depths[k]:.4g}")
        half = min(extent[0] - extent[1], extent[3] - extent[2]) / 2
        for diameter, style in zip(circles, ("-", "--", ":", "-."), strict=False):
            if diameter / 2 <= half:
                look: Any = {"fill": False, "ec": "white", "lw": 1.3, "ls": style, "path_effects": HALO}
                ax.add_patch(Circle((0, 0), diameter / 2, **look))
        for axis in (ax.xaxis, ax.yaxis):
            axis.set_major_locator(MaxNLocator(5, steps=[1, 2, 5, 10]))
    for ax in grid.flat[len(found) :]:
        ax.set_visible(False)
    beyond = "max" if any(np.nanmax(p, initial=0.0) > high for p, _, _ in planes) else "neither"
    bar = figure.colorbar(drawn, ax=grid, pad=0.02, shrink=min(1, 1.2 / rows + 0.2), extend=beyond)
    bar.set_label(f"|F$_{{{cube.stokes}}}$| ({prefix}{cube.unit} per RMSF)")
    bar.ax.yaxis.set_major_locator(MaxNLocator(6))
    figure.supxlabel("offset east (deg)", fontsize=13)
    figure.supylabel("offset north (deg)", fontsize=13)
    shown = " and ".join(f"{d:g}" for d in circles if d / 2 <= half)
    line = ",\n" if columns == 1 else ", "
    figure.suptitle(r"$\phi$ in rad m$^{-2}$" + (f"{line}circles {shown} deg across" if shown else ""), fontsize=13)
    return figure


@styled
def lines_of_sight(
    cubes: dict[str, FaradayCube], offset: tuple[float, float] = (0.0, 0.0), ax: Axes | None = None, log: bool = True
) -> Axes:
    """|F| (N,) along one line of sight, of cubes by name: the pixel at an offset in deg (east, north) of the centre.

    Raises `InputError` for cubes of different units, and for a pixel outside of a cube.
    """
    if not cubes:
        raise InputError("no Faraday cube was given to draw")
    if len({c.unit for c in cubes.values()}) > 1:
        raise InputError("Faraday cubes of different units have no common axes: draw them apart")
    ax = axes_of(ax, (6.4, 4.8))
    tops, floors = [], []
    for i, (name, cube) in enumerate(cubes.items()):
        ny, nx = cube.data.shape[1:]
        pixel = float(np.rad2deg(cube.pixel_rad))
        column, row = round(nx // 2 - offset[0] / pixel), round(ny // 2 + offset[1] / pixel)
        if not (0 <= column < nx and 0 <= row < ny):
            raise InputError(
                f"offset {offset} deg is outside of the {nx * pixel:.3g} x {ny * pixel:.3g} deg of '{name}'"
            )
        order = np.argsort(cube.depths, kind="stable")
        size = np.abs(cube.data[order, row, column]).astype(float)
        colour, style = LINES[i % len(LINES)]
        ax.plot(cube.depths[order], np.where(size > 0, size, np.nan), color=colour, ls=style, lw=1.4, label=name)
        if (size > 0).any():
            tops.append(np.nanmax(size))
            floors.append(np.nanpercentile(size[size > 0], 2))
    if log:
        ax.set_yscale("log")
        if tops:
            ax.set_ylim(max(min(floors) / 2, max(tops) * 1e-6), 2 * max(tops))
    first = next(iter(cubes.values()))
    ax.set(xlabel=PHI, ylabel=f"|F| ({first.unit} per RMSF)")
    east, north = ("east" if offset[0] >= 0 else "west"), ("north" if offset[1] >= 0 else "south")
    ax.set_title(f"{abs(offset[0]):g} deg {east}, {abs(offset[1]):g} deg {north} of the centre")
    ax.margins(x=0)
    ax.grid(color="#dddddd", lw=0.6)
    ax.legend(loc="upper center", bbox_to_anchor=(0.5, -0.16), ncols=min(len(cubes), 4), frameon=False)
    return ax


@styled
def rmsf(cube: FaradayCube, widths: float = 6.0, ax: Axes | None = None) -> Axes:
    """The RMSF of pixels without flags, within `widths` times its FWHM: modulus, real and imaginary part, FWHM."""
    ax = axes_of(ax, (6.4, 4.8))
    fwhm = cube.fwhm
    span = widths * fwhm if np.isfinite(fwhm) else max(float(np.ptp(cube.depths)), 1.0)
    phi = np.linspace(-span, span, 1201)
    r = cube.rmsf_at(phi)
    ax.plot(phi, r.real, color=BLUE, lw=1.2, ls="--", label="real")
    ax.plot(phi, r.imag, color=ORANGE, lw=1.2, ls=":", label="imaginary")
    ax.plot(phi, np.abs(r), color=INK, lw=1.8, label="|R|")
    if np.isfinite(fwhm):
        ax.plot([-fwhm / 2, fwhm / 2], [0.5, 0.5], color=GREY, lw=1.4, marker="|", ms=9)
        ax.annotate(f"FWHM {fwhm:.3g}", (fwhm / 2, 0.5), (8, 0), textcoords="offset points", va="center", color=INK)
    ax.set(xlabel=PHI, ylabel="RMSF")
    ax.margins(x=0)
    ax.grid(color="#dddddd", lw=0.6)
    ax.legend(loc="upper right", frameon=False)
    return ax
