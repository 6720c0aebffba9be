"""The brightest peak of every Faraday spectrum: its depth, polarized intensity and angle, with errors."""

from __future__ import annotations

import os
from dataclasses import dataclass
from typing import Any

import numpy as np

from instrument.analyze.faraday.aliases import sidelobe
from instrument.analyze.faraday.band import number, one
from instrument.analyze.faraday.chunks import in_threads
from instrument.analyze.faraday.file import sky_header
from instrument.analyze.faraday.kernels import brightest, summit
from instrument.analyze.faraday.spectra import FaradaySpectra
from instrument.errors import InputError
from instrument.provenance import fits_cards
from instrument.shown import short_repr
from instrument.units import Bool, Complex, Float, Int
from instrument.whole_file import whole_file

RICEAN = 2.3  # George, Stil & Keller 2012
SURE = 4.5  # sigmas between a peak and its alias: one in 3e5 is taken for the other
FAINT = 0.4  # height of aliases that are no worse than noise to a peak of `snr_min`
CHUNK = 16384


@dataclass(frozen=True, eq=False)
class FaradayPeaks:
    """Brightest peak of each pixel, maps (Ny, Nx): the largest |F|, of a polynomial through the depths about it.

    `depth` and `depth_error` are in rad/m²: for even weights and noise the error is 1 / (2 snr s), s the rms width of
    the band in lambda², that is FWHM / (2 snr) with FWHM = 2 sqrt3 / Delta lambda² (Brentjens & de Bruyn 2005). `peak`
    is |F| there and `polarized` the same without its Ricean bias, sqrt(peak² - 2.3 noise²) (George, Stil & Keller
    2012), both in `unit` and with the error `noise`. `angle_0` is the angle of polarization at lambda²_0, half the
    phase of F, and `angle` the one emitted, angle_0 - depth lambda²_0; both are in rad in [0, pi), north through east.
    Errors are those of one thin source, from weights, noise and flags of the channels of each pixel. All are NaN where
    the peak is not `significant`: below `snr_min` times the noise, without data, at an `edge` of the depths (or of a
    gap in them), where it may be the flank of one outside, or `ambiguous`: another peak of the RMSF, above 0.4 of the
    main one, is taken for it by the noise in one case of 3e5 or more (where `snr_min` is 8 or above). `aliases` are
    those other peaks, (depth apart, height), within the span of the depths, of pixels without flags, above half the
    main one.
    """

    __repr__ = short_repr
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
    ambiguous: Bool
    aliases: tuple[tuple[float, float], ...]
    noise: Float
    unit: str
    lambda2_0: float
    snr_min: float

    def write(self, path: str | os.PathLike[str], cube: FaradaySpectra, overwrite: bool = False) -> None:
        """Write the maps as images of a FITS file, with the coordinates of the cube; whole or not there."""
        from astropy.io import fits

        units = {"depth": "rad/m2", "depth_error": "rad/m2", "snr": "", "significant": "", "edge": "", "ambiguous": ""}
        hdus: list[Any] = [fits.PrimaryHDU(header=fits.Header(fits_cards()))]
        names = ("depth", "depth_error", "peak", "polarized", "angle_0", "angle_0_error", "angle", "angle_error")
        for name in (*names, "snr", "noise", "significant", "edge", "ambiguous"):
            header = sky_header(cube)
            header["BUNIT"] = units.get(name, "rad" if name.startswith("angle") else self.unit)
            header["LAMSQ0"] = (self.lambda2_0, "m2")
            hdus.append(fits.ImageHDU(getattr(self, name).astype(np.float32), header, name=name.upper()))
        with whole_file(path, overwrite) as partial:
            fits.HDUList(hdus).writeto(partial, overwrite=True)


def find_peaks(cube: FaradaySpectra, snr: float, noise: Any) -> FaradayPeaks:
    """Peaks of every pixel of a cube of Q + iU; see `FaradayCube.peaks`."""
    if cube.stokes != "P":
        raise InputError(f"peaks are those of Q + iU, this is Stokes {cube.stokes}: rm_synthesis(depths, stokes='P')")
    shape, order = cube.data.shape[1:], np.argsort(cube.depths, kind="stable")
    phi = cube.depths[order]
    ends = _pieces(phi, cube.fwhm)
    sigma = _noise(cube, noise)
    threshold = one(snr, "", "snr")
    data = cube.data.reshape(len(order), -1)
    pixels, level = data.shape[1], sigma.ravel()
    power, place = _largest(data, order)
    height = np.sqrt(np.where(place >= 0, power, np.nan))
    with np.errstate(divide="ignore", invalid="ignore"):
        ratio = height / level
    edge = (place == ends[0, place]) | (place == ends[1, place] - 1)
    use = np.flatnonzero((place >= 0) & ~edge & (ratio >= threshold) & (height > 0))
    band = _Channels(cube)
    depth, value = _climbed(data, (order, phi, ends), 2 * (band.mean - cube.lambda2_0), use, place[use])
    top = np.abs(value)
    found = band.errors(use, top, level[use])
    span = float(phi[-1] - phi[0])
    sides = np.maximum(depth - phi[0], phi[-1] - depth)
    flags = None if cube.flags is None else cube.flags[:, use]
    beside = sidelobe(cube.lambda2, cube.weights, flags, cube.fwhm, span, sides)
    clear = top / level[use] * np.sqrt((1 - beside) / 2) >= min(SURE, threshold * np.sqrt((1 - FAINT) / 2))
    ambiguous = np.zeros(pixels, bool)
    ambiguous[use[~clear]] = True
    angle_0 = np.angle(value) / 2
    maps = {
        "depth": depth,
        "peak": top,
        "polarized": np.sqrt(np.maximum(top**2 - RICEAN * level[use] ** 2, 0)),
        "angle_0": _half_turn(angle_0),
        "angle": _half_turn(angle_0 - depth * cube.lambda2_0),
        **found,
    }

    def chart(values: Float) -> Float:
        out = np.full(pixels, np.nan)
        out[use[clear]] = values[clear]
        return out.reshape(shape)

    good = np.zeros(pixels, bool)
    good[use[clear]] = True
    return FaradayPeaks(
        **{name: chart(values) for name, values in maps.items()},
        snr=ratio.reshape(shape),
        significant=good.reshape(shape),
        edge=edge.reshape(shape),
        ambiguous=ambiguous.reshape(shape),
        aliases=cube.band.aliases(span),
        noise=sigma,
        unit=cube.unit,
        lambda2_0=cube.lambda2_0,
        snr_min=threshold,
    )


def _largest(data: Complex, order: Int) -> tuple[Float, Int]:
    """Largest |F|² over depths (P, n), and its place in their order, -1 where there is none."""
    pixels = data.shape[1]
    power, place = np.empty(pixels), np.empty(pixels, np.int64)

    def search(first: int) -> None:
        here = slice(first, first + CHUNK)
        brightest(data, order, first, power[here], place[here])

    in_threads(search, range(0, pixels, CHUNK))
    return power, place


def _climbed(data: Complex, axis: tuple[Int, Float, Int], turn: float, use: Int, place: Int) -> tuple[Float, Complex]:
    """Depth and F (n,) of the peaks near places (n,) of some pixels (n,); the rest as of `summit`."""
    depth, value = np.empty(len(use)), np.empty(len(use), complex)

    def climb(first: int) -> None:
        here = slice(first, first + CHUNK)
        summit(data, axis, turn, use[here], place[here], depth[here], value[here])

    in_threads(climb, range(0, len(use), CHUNK))
    return depth, value


def _noise(cube: FaradaySpectra, noise: Any) -> Float:
    """Noise of every pixel (Ny, Nx), that given or that of the cube."""
    if noise is None:
        return cube.noise_map()
    given, shape = number(noise, cube.unit, "noise"), cube.data.shape[1:]
    if given.shape not in ((), shape) or not (given > 0).all():
        raise InputError(f"noise has shape {given.shape}: give one number or a map {shape}, above 0, in {cube.unit}")
    return np.broadcast_to(given, shape).astype(float)


def _pieces(phi: Float, fwhm: float) -> Int:
    """Where the piece of the axis that each depth lies in begins and ends (2, P): they end where a step is too wide.

    Raises `InputError` where most steps are: peaks between them would be missed, or taken for others.
    """
    steps = np.diff(phi)
    wide = steps > fwhm / 4 * (1 + 1e-6)
    if len(phi) > 2 and np.median(steps) > fwhm / 4 * (1 + 1e-6):
        raise InputError(
            f"depths in steps of {np.median(steps):.4g} rad/m2 are too far apart for peaks: the RMSF is {fwhm:.4g} "
            f"wide (FWHM); give steps of at most {fwhm / 4:.3g}, better {fwhm / 8:.3g}"
        )
    starts = np.append(0, np.flatnonzero(wide) + 1)
    piece = np.searchsorted(starts, np.arange(len(phi)), "right") - 1
    return np.stack([starts[piece], np.append(starts, len(phi))[piece + 1]])


class _Channels:
    """Weighted moments of lambda² of the channels that pixels have, and the errors that follow from them."""

    def __init__(self, cube: FaradaySpectra) -> None:
        self.cube, self.w = cube, cube.weights
        self.mean = float(self.w @ cube.lambda2 / self.w.sum())
        x, sigma = cube.lambda2 - self.mean, cube.channel_noise
        known = np.isfinite(sigma) & (sigma > 0) & (self.w > 0)
        variance = np.where(known, sigma, 1.0) ** 2 if known[self.w > 0].all() else np.ones(len(x))
        square = self.w**2 * variance
        self.terms = np.stack([self.w, self.w * x, self.w * x * x, square, square * x, square * x * x])

    def errors(self, use: Int, top: Float, level: Float) -> dict[str, Float]:
        """Errors of depth and angles (n,) of some pixels with peaks and noise (n,).

        With V = sum w² sigma², S = sum w (x - mean)², x = lambda² and noise² = V / W², W = sum w, of the phase of a
        thin source: var(2 depth) = sum w² sigma² (x - mean)² / (S peak)², var(2 angle at the mean) = (noise / peak)².
        """
        cube = self.cube
        if cube.flags is None:
            w, wx, wxx, v, vx, vxx = self.terms.sum(axis=1)[:, None]
        else:
            sums = np.empty((6, len(use)))
            for first in range(0, len(use), CHUNK):
                here = slice(first, first + CHUNK)
                sums[:, here] = self.terms @ cube.has_pixels(use[here])
            w, wx, wxx, v, vx, vxx = sums
        mean = wx / w  # about the mean of all channels
        spread = wxx - w * mean**2
        across, along = vx - mean * v, vxx - 2 * mean * vx + mean**2 * v
        with np.errstate(divide="ignore", invalid="ignore"):
            inverse = level / (2 * top)
            tilt = along * w**2 / (spread**2 * v)
            cross = across * w / (spread * v)
        out = {"depth_error": inverse * np.sqrt(tilt)}
        for name, at in (("angle_0", cube.lambda2_0 - self.mean), ("angle", -self.mean)):
            away = at - mean
            out[f"{name}_error"] = inverse * np.sqrt(np.maximum(1 + 2 * away * cross + away**2 * tilt, 0))
        return {name: np.broadcast_to(values, len(use)) for name, values in out.items()}


def _half_turn(angle: Float) -> Float:
    """Angles in [0, pi)."""
    out = angle % np.pi
    return np.where(out >= np.pi, 0.0, out)  # -1e-17 % pi is pi
