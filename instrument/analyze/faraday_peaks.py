"""The brightest peak of every Faraday spectrum: its depth, polarized intensity and angle, with errors."""

from __future__ import annotations

import os
from dataclasses import dataclass
from typing import Any

import numpy as np

from instrument.analyze.faraday_band import number, one
from instrument.analyze.faraday_chunks import in_threads
from instrument.analyze.faraday_cube import FaradayCube
from instrument.analyze.faraday_kernels import brightest
from instrument.errors import InputError
from instrument.units import Bool, Float
from instrument.whole_file import whole_file

RICEAN = 2.3  # George, Stil & Keller 2012
CHUNK = 16384


@dataclass(frozen=True, eq=False)
class FaradayPeaks:
    """Brightest peak of each pixel, maps (Ny, Nx): a parabola through |F| at the largest value and its two neighbours.

    `depth` and `depth_error` are in rad/m², the error 1 / (2 snr s), s the rms width of the band in lambda²: that is
    FWHM / (2 snr) with FWHM = 2 sqrt3 / Delta lambda², of an evenly filled band (Brentjens & de Bruyn 2005). `peak` is
    |F| there and `polarized` the same without its Ricean bias, sqrt(peak² - 2.3 noise²) (George, Stil & Keller 2012),
    both in `unit`. `angle_0` is the angle of polarization at lambda²_0, half the phase of F, and `angle` the one
    emitted, angle_0 - depth lambda²_0; both are in rad in [0, pi), north through east. Their errors are 1 / (2 snr) at
    the mean lambda², where angle and depth do not correlate, and that of the depth times the distance from it. All are
    NaN where the peak is not `significant`: below `snr_min` times the noise, without data, or at an `edge` of the
    depths, where it may be the flank of one outside.
    """

    depth: Float
    depth_error: Float
    peak: Float
    polarized: Float
    angle_0: Float
    angle_0_error: Float
    angle: Float
    angle_error: Float
    snr: Float  # of the largest |F| of every pixel, significant or not
    significant: Bool
    edge: Bool
    noise: Float
    unit: str
    lambda2_0: float
    snr_min: float

    def write(self, path: str | os.PathLike[str], cube: FaradayCube) -> None:
        """Write the maps as images of a FITS file, with the coordinates of the cube; whole or not there."""
        from astropy.io import fits

        from instrument.analyze.faraday_file import sky_header

        units = {"depth": "rad/m2", "depth_error": "rad/m2", "snr": "", "significant": "", "edge": ""}
        hdus: list[Any] = [fits.PrimaryHDU()]
        names = ("depth", "depth_error", "peak", "polarized", "angle_0", "angle_0_error", "angle", "angle_error")
        for name in (*names, "snr", "noise", "significant", "edge"):
            header = sky_header(cube)
            header["BUNIT"] = units.get(name, "rad" if name.startswith("angle") else self.unit)
            header["LAMSQ0"] = (self.lambda2_0, "m2")
            hdus.append(fits.ImageHDU(getattr(self, name).astype(np.float32), header, name=name.upper()))
        with whole_file(path) as partial:
            fits.HDUList(hdus).writeto(partial, overwrite=True)


def find_peaks(cube: FaradayCube, snr: float, noise: Any) -> FaradayPeaks:
    """Peaks of every pixel of a cube of Q + iU; see `FaradayCube.peaks`."""
    if cube.stokes != "P":
        raise InputError(f"peaks are those of Q + iU, this is Stokes {cube.stokes}: rm_synthesis(depths, stokes='P')")
    shape, order = cube.data.shape[1:], np.argsort(cube.depths, kind="stable")
    sigma = (
        cube.noise_map() if noise is None else np.broadcast_to(number(noise, cube.unit, "noise"), shape).astype(float)
    )
    threshold = one(snr, "", "snr")
    data, phi = cube.data.reshape(len(order), -1), cube.depths[order]
    pixels, level = data.shape[1], sigma.ravel()
    power, place = np.empty(pixels), np.empty(pixels, np.int64)

    def search(first: int) -> None:
        here = slice(first, first + CHUNK)
        brightest(data, order, first, power[here], place[here])

    in_threads(search, range(0, pixels, CHUNK))
    height = np.sqrt(np.where(place >= 0, power, np.nan))
    with np.errstate(divide="ignore", invalid="ignore"):
        ratio = height / level
    edge = (place == 0) | (place == len(phi) - 1)
    good = (place >= 0) & ~edge & (ratio >= threshold) & (height > 0)
    use = np.flatnonzero(good)
    at = place[use] + np.arange(-1, 2)[:, None]  # (3, n)
    left, middle, right = phi[at]
    z = data[order[at], use].astype(complex)
    # Lagrange: the parabola's slope and curvature about the middle, for depths that need not be evenly spaced
    h, k = middle - left, right - middle
    a = np.abs(z)
    down, up = (a[1] - a[0]) / h, (a[2] - a[1]) / k
    curve, slope = (up - down) / (h + k), (down * k + up * h) / (h + k)
    x = np.divide(-slope, 2 * curve, out=np.zeros(len(use)), where=curve < 0)
    top = a[1] + 0.5 * slope * x
    # the phase of F turns with depth where lambda²_0 is not the mean: interpolate what does not
    mean = float(cube.weights @ cube.lambda2 / cube.weights.sum())
    spread = float(np.sqrt(cube.weights @ (cube.lambda2 - mean) ** 2 / cube.weights.sum()))
    turn = 2 * (mean - cube.lambda2_0)
    z *= np.exp(1j * turn * (phi[at] - middle))
    shares = x * (x - k) / (h * (h + k)), (x + h) * (k - x) / (h * k), x * (x + h) / (k * (h + k))
    value = (np.array(shares) * z).sum(axis=0) * np.exp(-1j * turn * x)
    depth, strong = middle + x, top / level[use]
    with np.errstate(divide="ignore", invalid="ignore"):
        depth_error = 1 / (2 * strong * spread)
        polarized = np.sqrt(np.maximum(top**2 - RICEAN * level[use] ** 2, 0))
        angle_error = 1 / (2 * strong)
    angle_0 = np.angle(value) / 2

    def chart(values: Float) -> Float:
        out = np.full(pixels, np.nan)
        out[use] = values
        return out.reshape(shape)

    maps = {
        "depth": depth,
        "depth_error": depth_error,
        "peak": top,
        "polarized": polarized,
        "angle_0": _half_turn(angle_0),
        "angle_0_error": np.hypot(angle_error, depth_error * (cube.lambda2_0 - mean)),
        "angle": _half_turn(angle_0 - depth * cube.lambda2_0),
        "angle_error": np.hypot(angle_error, depth_error * mean),
    }
    return FaradayPeaks(
        **{name: chart(values) for name, values in maps.items()},
        snr=ratio.reshape(shape),
        significant=good.reshape(shape),
        edge=edge.reshape(shape),
        noise=sigma,
        unit=cube.unit,
        lambda2_0=cube.lambda2_0,
        snr_min=threshold,
    )


def _half_turn(angle: Float) -> Float:
    """Angles in [0, pi)."""
    out = angle % np.pi
    return np.where(out >= np.pi, 0.0, out)  # -1e-17 % pi is pi
