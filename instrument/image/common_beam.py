"""Cubes at one resolution: Gaussian beams as matrices, the smallest that all fit in, and images blurred to it."""

from __future__ import annotations

from typing import Any

import numpy as np

from instrument.errors import InputError, warn
from instrument.image.psf import Psf
from instrument.units import Complex, Float

ALIKE = 1.05  # of the widths: beams of a fit differ by a per cent
SLACK = 1e-9  # of the beam: rounding of a channel that has the common beam already


def beam_ratio(psf: Psf | None) -> float:
    """Largest over smallest width (root of major by minor) of the beams of a cube; 1 where none or one is known."""
    if psf is None:
        return 1.0
    width = np.sqrt(psf.major_rad * psf.minor_rad)
    width = width[np.isfinite(width) & (width > 0)]
    return float(width.max() / width.min()) if width.size else 1.0


def say_unequal_beams(psf: Psf | None) -> None:
    """Warn where the channels of a cube have beams of different widths, with their ratio."""
    if (ratio := beam_ratio(psf)) > ALIKE:
        said = f"the beams of the channels differ by a factor of {ratio:.3g} in width: sources that are not points, and"
        warn(f"{said} close pairs, change along frequency; cube.at_common_beam() makes them equal")


def shapes(major: Float, minor: Float, angle: Float) -> Float:
    """Covariances (F, 2, 2), rows and columns north and east, of Gaussians of these full widths at half maximum."""
    c, s = np.cos(angle), np.sin(angle)
    along, across = np.stack([c, s], axis=-1), np.stack([-s, c], axis=-1)
    scale = 8 * np.log(2)
    return np.asarray(
        (major**2 / scale)[:, None, None] * along[:, :, None] * along[:, None, :]
        + (minor**2 / scale)[:, None, None] * across[:, :, None] * across[:, None, :]
    )


def holds(outer: Float, inner: Float) -> Any:
    """Which Gaussians (F, 2, 2) a Gaussian (2, 2) can be made of by blurring."""
    return np.linalg.eigvalsh(outer - inner)[:, 0] >= -SLACK * np.trace(outer)


def common_beam(psf: Psf) -> Float:
    """A small Gaussian (2, 2) that all beams can be blurred to: the largest beam where it does, else a circle."""
    known = np.isfinite(psf.major_rad) & (psf.major_rad > 0) & (psf.minor_rad > 0)
    if not known.any():
        raise InputError("no channel of this cube has a beam: give psf=Psf.gaussian(major, minor, angle)")
    inner = shapes(psf.major_rad[known], psf.minor_rad[known], psf.angle_rad[known])
    for one in inner[np.argsort(-np.linalg.det(inner), kind="stable")]:
        if holds(one, inner).all():
            return np.asarray(one)
    return np.asarray(np.eye(2) * psf.major_rad[known].max() ** 2 / (8 * np.log(2)))


def at_common_beam(images: Float, psf: Psf, pixel_rad: float, per_beam: bool, size: Any) -> tuple[Float, Psf]:
    """Images (F, 4, Ny, Nx), `per_beam` in Jy/beam, blurred to one beam, and that; see `StokesCube.at_common_beam`."""
    outer = _asked(psf, size)
    known = np.isfinite(psf.major_rad) & (psf.major_rad > 0) & (psf.minor_rad > 0)
    there = np.array([not np.isnan(planes).all() for planes in images])
    if (lacking := there & ~known).any():
        k = int(np.flatnonzero(lacking)[0])
        raise InputError(f"channel {k} has data and no beam: flag it, cube.flagged([{k}]), or give psf=")
    inner = shapes(psf.major_rad, psf.minor_rad, psf.angle_rad)
    usable = there & known
    small = np.zeros(len(known), bool)
    small[usable] = ~holds(outer, inner[usable])
    if small.any():
        k = int(np.flatnonzero(small)[0])
        had = f"{60 * np.rad2deg(psf.major_rad[k]):.4g}' x {60 * np.rad2deg(psf.minor_rad[k]):.4g}' of channel {k}"
        raise InputError(
            f"size = {size} is smaller than the beam {had} in some direction: leave it out, or ask for more"
        )
    data = np.array(images, np.result_type(images, np.float32))
    lobes = None if psf.data is None else np.array(psf.data, float)
    for k in np.flatnonzero(usable).tolist():
        kernel = outer - inner[k]
        # of Jy/beam the beam grows: a point of 1 Jy stays 1
        gain = float(np.sqrt(np.linalg.det(outer) / np.linalg.det(inner[k]))) if per_beam else 1.0
        for plane in data[k]:
            if np.isfinite(plane).any():
                plane[:] = gain * blurred(plane, kernel / pixel_rad**2)
        if lobes is not None:
            grown = float(np.sqrt(np.linalg.det(outer) / np.linalg.det(inner[k])))
            lobes[k] = grown * blurred(lobes[k], kernel / pixel_rad**2)
    powers, axes = np.linalg.eigh(outer)
    minor, major = np.sqrt(8 * np.log(2) * np.maximum(powers, 0))
    angle = np.arctan2(axes[1, 1], axes[0, 1]) % np.pi
    one = (np.full(len(known), float(value)) for value in (major, minor, angle, 0.0))
    return data, Psf(lobes, *one)


def _asked(psf: Psf, size: Any) -> Float:
    if size is None:
        return common_beam(psf)
    parts = [part.strip() for part in size.split(",")] if isinstance(size, str) else size
    three = parts if isinstance(parts, list | tuple) else [parts]
    if not 1 <= len(three) <= 3:
        raise InputError(f"size = {size}: give one width, two, or two and an angle: '4 arcmin, 3 arcmin, 30 deg'")
    given = parts if isinstance(parts, Psf) else Psf.gaussian(*three)
    one = [np.unique(x) for x in (given.major_rad, given.minor_rad, given.angle_rad)]
    if any(len(x) != 1 or not np.isfinite(x[0]) for x in one) or not 0 < one[1][0] <= one[0][0]:
        raise InputError(f"size = {size} is not one beam: write '3 arcmin', or '4 arcmin, 3 arcmin, 30 deg'")
    return np.asarray(shapes(*one)[0])


def blurred(image: Float, kernel: Float) -> Float:
    """An image (Ny, Nx) folded with a Gaussian of integral 1 and this covariance in pixels² (2, 2), north and east.

    Pixels without data weigh nothing and stay NaN; those beside them, and at the rim, are made up for what they lack.
    """
    if np.abs(kernel).max() == 0:
        return image
    reach = int(np.ceil(4 * np.sqrt(max(float(np.trace(kernel)), 0.0)))) + 1
    ny, nx = image.shape
    north, east = np.fft.fftfreq(ny + reach)[:, None], -np.fft.rfftfreq(nx + reach)  # x runs to the west
    power = kernel[0, 0] * north**2 + 2 * kernel[0, 1] * north * east + kernel[1, 1] * east**2
    transfer = np.exp(-2 * np.pi**2 * power)
    good = np.isfinite(image)

    def folded(values: Float) -> Float:
        wide = np.zeros((ny + reach, nx + reach))
        wide[:ny, :nx] = values
        cells: Complex = np.fft.rfft2(wide) * transfer
        return np.asarray(np.fft.irfft2(cells, wide.shape)[:ny, :nx])

    with np.errstate(invalid="ignore", divide="ignore"):
        return np.where(good, folded(np.where(good, image, 0.0)) / folded(good.astype(float)), np.nan)
