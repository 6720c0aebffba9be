"""Figures of images: the four Stokes parameters, and the point spread function with its fitted Gaussian."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import LogNorm, Normalize, SymLogNorm
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Ellipse, Rectangle
from matplotlib.patheffects import withStroke
from matplotlib.ticker import MaxNLocator

from instrument.errors import InputError
from instrument.report.spectra import log_numbers
from instrument.report.style import INK, axes_of, styled
from instrument.units import Float

if TYPE_CHECKING:
    from instrument.image.cube import StokesCube
    from instrument.image.pixel_map import PixelMap

FIT, HALF = "#ffe000", "#0026ff"
MOST = 600  # pixels of an image that are drawn along an axis: a panel has 350 of its own


@styled
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
        ax.xaxis.set_major_locator(MaxNLocator(4, steps=[1, 2, 5, 10]))  # "-0.5" and "-1.0" met with 6
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


@styled
def pixel_maps(maps: Mapping[str, PixelMap], channel: int = 0) -> Figure:
    """Maps of one channel side by side, of the Stokes parameter with the largest value; pixels without data in grey.

    Colours end at the values of pixels that have data; they are logarithmic where these span more than a factor 10.
    """
    figure = Figure(figsize=(6.4 * len(maps), 5.6), layout="compressed")
    for ax, (name, one) in zip(figure.subplots(1, len(maps), squeeze=False)[0], maps.items(), strict=True):
        values = np.asarray(one.data[channel].max(axis=0), float)
        values, extent, _ = _shrunk(values, np.rad2deg(one.cube.pixel_rad))
        there = np.isfinite(one.cube.data[channel]).all(axis=0)
        there, _, _ = _shrunk(there.astype(float), np.rad2deg(one.cube.pixel_rad))
        inside = values[(there > 0) & np.isfinite(values)]
        low, high = (float(inside.min()), float(inside.max())) if len(inside) else (1.0, 10.0)
        norm = LogNorm(low, high) if high > 10 * low else Normalize(low, max(high, 1.01 * low))
        shown = np.where(np.isfinite(values) & (there > 0), values, np.nan)
        drawn = ax.imshow(shown, extent=extent, origin="lower", cmap="viridis", norm=norm, interpolation="nearest")
        ax.set_facecolor("#bbbbbb")
        bar = figure.colorbar(drawn, ax=ax, fraction=0.046, pad=0.02)
        if isinstance(norm, LogNorm):
            log_numbers(bar.ax.yaxis, high / low)
        ax.set_title(name + (", the largest of I, Q, U, V" if one.data.shape[1] > 1 else ""))
        ax.set(xlabel="offset east (deg)", ylabel="offset north (deg)")
    figure.suptitle(f"{next(iter(maps.values())).freq_hz[channel] / 1e6:.6g} MHz")
    return figure


@styled
def psf_image(cube: StokesCube, channel: int = 0, ax: Axes | None = None) -> Axes:
    """Central part of the PSF (Ny, Nx) of one channel, with the fitted Gaussian and the PSF itself at half maximum.

    Colours are linear up to 0.01 of the peak and logarithmic beyond. Raises `InputError` for a cube without a PSF, or
    whose PSF is known by its widths alone.
    """
    if cube.psf is None or cube.psf.data is None:
        raise InputError(f"this cube has no {'PSF' if cube.psf is None else 'image of the PSF'} to draw")
    ax = axes_of(ax, (6.4, 6.0))
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
        ax.contour(east, north, part, levels=[0.5], colors=HALF, linewidths=1.4, linestyles="--", zorder=3)
        keys.append(Line2D([], [], color=HALF, ls="--", lw=1.4, label="PSF at half maximum"))
    if fitted:
        # black is lost on the dark red of the main lobe, white on the line below where the two agree
        rim = [withStroke(linewidth=4.4, foreground="black")]
        ax.add_patch(_ellipse((0, 0), cube, channel, 60, fill=False, ec=FIT, lw=2.2, zorder=2, path_effects=rim))
        text = f"fitted Gaussian, {_size(cube, channel)}"
        keys.append(Line2D([], [], color=FIT, lw=2.2, path_effects=rim, label=text))
    ax.set(xlabel="offset east (arcmin)", ylabel="offset north (arcmin)")
    ax.set_title(f"PSF, {cube.freq_hz[channel] / 1e6:.6g} MHz")
    if keys:
        ax.legend(
            handles=keys, loc="lower left", facecolor="#a9a9a9", framealpha=0.9, edgecolor="none", labelcolor="black"
        )
    return ax


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
    """The factor that brings a value to 1 to 1000, and the metric prefix or power of ten it stands for."""
    for factor, prefix in ((1e-3, "k"), (1, ""), (1e3, "m"), (1e6, "µ"), (1e9, "n"), (1e12, "p")):
        if value * factor >= 1:
            return factor, prefix
    if not value > 0:
        return 1.0, ""
    power = math.floor(math.log10(value))  # below the prefixes: what rounding leaves of a Stokes parameter
    return 10.0**-power, f"$10^{{{power}}}$ "


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
