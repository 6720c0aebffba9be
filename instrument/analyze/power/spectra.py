"""Power spectra of images: k_perp in 1/Mpc, tapers, bins, and how far they can be trusted."""

from __future__ import annotations

import os
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import numpy as np

from instrument.analyze.power.fourier import (
    Stokes,
    Taper,
    bin_edges,
    bin_means,
    cell_variance,
    check_redshift,
    comoving,
    plane,
    taper_of,
    uv_limits,
)
from instrument.analyze.power.modes import independent, some
from instrument.checked import checked
from instrument.errors import InputError, warn
from instrument.image.cube import StokesCube
from instrument.numbers import squarable
from instrument.shown import short_repr
from instrument.units import Bool, Float, Int
from instrument.whole_file import write_ecsv


@checked
@dataclass(frozen=True, eq=False)
class Spectrum2D:
    """Power spectrum of an image in N bins of k_perp: P = (area / pixels²) mean |DFT|², in `unit`² Mpc² (N,).

    `k_perp` (1/Mpc) and `uv` (wavelengths) are means over the `count` cells of the Fourier plane in a bin
    `edges[i] <= k < edges[i+1]`, the last one closed; both signs of k count, the cell k = 0 never. Without cells all
    are NaN. `sigma` is power over the root of the independent modes: the scatter of a Gaussian field that fills the
    image (count/2 modes of a real field, count of Q + iU, fewer behind a taper or a hole). The PSF is in the power.
    """

    __repr__ = short_repr
    k_perp: Float
    uv: Float
    power: Float
    sigma: Float
    count: Int
    edges: Float  # 1/Mpc (N + 1,)
    unit: str  # of the image
    stokes: str
    freq_hz: float
    redshift: float
    distance_mpc: float  # transverse comoving: k_perp = 2 pi uv / distance
    uv_range: tuple[float, float] | None  # the cut of baselines, wavelengths
    taper: str | None
    missing: float  # fraction of the pixels that are NaN and count as zero

    @property
    def delta2(self) -> Float:
        """Variance per ln k, k_perp² P / 2 pi, in `unit`² (N,)."""
        return self.k_perp**2 * self.power / (2 * np.pi)

    def table(self) -> Any:
        """Everything as an astropy table, one row a bin, with units; `uv` is in wavelengths."""
        from astropy import units as u
        from astropy.table import QTable

        squared = u.Unit(self.unit) ** 2
        out = QTable()
        out["k_perp"] = self.k_perp / u.Mpc
        out["k_low"], out["k_high"] = self.edges[:-1] / u.Mpc, self.edges[1:] / u.Mpc
        out["uv"] = self.uv
        out["power"], out["sigma"] = self.power * (squared * u.Mpc**2), self.sigma * (squared * u.Mpc**2)
        out["delta2"] = self.delta2 * squared
        out["count"] = self.count
        out.meta |= {name: getattr(self, name) for name in ("stokes", "freq_hz", "redshift", "distance_mpc", "taper")}
        out.meta |= {"uv_range": list(self.uv_range) if self.uv_range else None, "missing": self.missing}
        return out

    def write(self, path: str | os.PathLike[str], overwrite: bool = False) -> None:
        """Write the table as ECSV; the file is whole or not there."""
        write_ecsv(self.table(), path, overwrite)


def ratio(a: Spectrum2D, b: Spectrum2D) -> Float:
    """Power of `a` over that of `b` (N,): the PSF cancels. NaN where a bin is empty or `b` is zero; same bins only."""
    same = a.edges.shape == b.edges.shape and np.allclose(a.edges, b.edges, rtol=1e-9, atol=0)
    if not same or a.unit != b.unit:
        raise InputError("spectra differ in bins or unit: make both with the same uv_range, bins, redshift, and unit")
    return np.divide(a.power, b.power, out=np.full(len(a.power), np.nan), where=b.power > 0)


def spectrum_2d(
    cube: StokesCube,
    stokes: Stokes = "I",
    channel: int = 0,
    uv_range: tuple[float, float] | None = None,
    taper: Taper | None = None,
    bins: Any = 15,
    log: bool = True,
    redshift: float | None = None,
    cosmology: Any = None,
) -> Spectrum2D:
    """Spectrum of one plane of a cube; see `Analyzer.spectrum_2d`."""
    has = ~np.isnan(image := plane(cube, stokes, channel))
    window = has * np.multiply.outer(*(taper_of(n, taper) for n in image.shape))
    if np.isinf(image).any():
        raise InputError(f"{stokes} of channel {channel} has {np.isinf(image).sum()} infinite pixels: make them NaN")
    if not window.any():
        raise InputError(f"{stokes} of channel {channel} has no data: all NaN, or NaN where the taper is not 0")
    if not has.all():
        text = f"{1 - has.mean():.2g} of the pixels are NaN and count as zero: rims of holes scatter steep spectra"
        warn(text)
    squarable(float(np.abs(image[has]).max()), stokes)
    # no interferometer sees the mean, and a taper or a hole would spread it over the first cells
    variance, times = cell_variance(np.where(has, image - image[has].mean(), 0.0), window)
    v, u = (np.fft.fftfreq(n, cube.pixel_rad) for n in image.shape)
    uv = np.hypot(v[:, None], u[: variance.shape[1]])
    redshift = check_redshift(redshift, cube.freq_hz[channel], cube.freq_hz[channel])
    z, distance = comoving(cube.freq_hz[channel], redshift, cosmology)
    low, high = uv_limits(uv_range)
    if not (use := (uv > 0) & (uv >= low) & (uv <= high)).any():
        raise InputError(f"uv_range = {uv_range} holds no cell of an image of {image.shape[1]} x {image.shape[0]}")
    uv, weight = uv[use], np.broadcast_to(times, use.shape)[use]
    scale, top = 2 * np.pi / distance, uv.max() if high == np.inf else high
    k, edges = uv * scale, bin_edges((low or uv.min()) * scale, top * scale, bins, log)
    count, (k_mean, uv_mean, mean) = bin_means(k, edges, weight, k, uv, variance[use])
    power = mean * image.size * (distance * cube.pixel_rad) ** 2  # area / pixels^2 |DFT|^2
    row, column = np.nonzero(use)
    cells = [(row[k], column[k], 0 * k, weight[k]) for k in _some_of_bins(k, edges)]

    def inside(b: int, y: Int, x: Int, _: Int) -> Bool:
        there = np.hypot(v[y], u[x]) * scale
        within = (there > 0) & (there >= low * scale) & (there <= high * scale) & (there >= edges[b])
        return within & ((there < edges[b + 1]) | ((b == len(edges) - 2) & (there <= edges[b + 1])))

    modes = independent(window, np.ones(1), cells, count.astype(float), inside) / (1 if stokes == "P" else 2)
    about = cube.unit, stokes, float(cube.freq_hz[channel]), z, distance, uv_range and (low, high), taper
    return Spectrum2D(
        k_mean, uv_mean, power, power / np.sqrt(modes), count, edges, *about, missing=1 - float(has.mean())
    )


def _some_of_bins(k: Float, edges: Float) -> list[Int]:
    """Places of the cells of each bin among k (N,), of a large bin of some by chance."""
    index = np.where(k == edges[-1], len(edges) - 2, np.searchsorted(edges, k, side="right") - 1)
    order = np.argsort(index, kind="stable")
    bounds = np.searchsorted(index[order], np.arange(len(edges)))
    parts = (order[a:b] for a, b in pairwise(bounds))
    return [part[some(len(part), seed)] for seed, part in enumerate(parts)]
