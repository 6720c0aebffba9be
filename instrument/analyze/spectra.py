"""Power spectra of images: k_perp in 1/Mpc, tapers, bins, and how far they can be trusted."""

from __future__ import annotations

import os
import warnings
from dataclasses import dataclass
from typing import Any, Literal, get_args

import numpy as np

from instrument.errors import InputError, InstrumentWarning, did_you_mean
from instrument.image.cube import StokesCube
from instrument.units import Complex, Float, Int, to_si
from instrument.whole_file import write_ecsv

HYDROGEN = 1420405751.768  # Hz, the 21-cm line at rest
Stokes = Literal["I", "Q", "U", "V", "P"]
Taper = Literal["hann", "blackman-harris"]
# sums of cosines about the centre pixel; periodic, so that a constant reaches no cell beyond the last term
TAPERS = {None: (1.0,), "hann": (0.5, 0.5), "blackman-harris": (0.35875, 0.48829, 0.14128, 0.01168)}


@dataclass(frozen=True, eq=False)
class Spectrum2D:
    """Power spectrum of an image in N bins of k_perp: P = (area / pixels²) mean |DFT|², in `unit`² Mpc² (N,).

    `k_perp` (1/Mpc) and `uv` (wavelengths) are means over the `count` cells of the Fourier plane in a bin
    `edges[i] <= k < edges[i+1]`, the last one closed; both signs of k count, the cell k = 0 never. Without cells all
    are NaN. `sigma` is power over the root of the independent modes: the scatter of a Gaussian field that fills the
    image (count/2 modes of a real field, count of Q + iU, fewer behind a taper). The PSF is in the power.
    """

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

    def write(self, path: str | os.PathLike[str]) -> None:
        """Write the table as ECSV; the file is whole or not there."""
        write_ecsv(self.table(), path)


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
        warnings.warn(text, InstrumentWarning, stacklevel=3)
    # no interferometer sees the mean, and a taper or a hole would spread it over the first cells
    variance, times = cell_variance(np.where(has, image - image[has].mean(), 0.0), window)
    v, u = (np.fft.fftfreq(n, cube.pixel_rad) for n in image.shape)
    uv = np.hypot(v[:, None], u[: variance.shape[1]])
    z, distance = comoving(cube.freq_hz[channel], redshift, cosmology)
    cut = np.asarray((0, np.inf) if uv_range is None else uv_range, float)
    if cut.shape != (2,) or not 0 <= cut[0] < cut[1]:
        raise InputError(f"uv_range = {uv_range} must be two numbers of wavelengths, the smaller one first")
    low, high = cut.tolist()
    if not (use := (uv > 0) & (uv >= low) & (uv <= high)).any():
        raise InputError(f"uv_range = {uv_range} holds no cell of an image of {image.shape[1]} x {image.shape[0]}")
    uv, weight = uv[use], np.broadcast_to(times, use.shape)[use]
    scale, top = 2 * np.pi / distance, uv.max() if high == np.inf else high
    k, edges = uv * scale, bin_edges((low or uv.min()) * scale, top * scale, bins, log)
    count, (k_mean, uv_mean, mean) = bin_means(k, edges, weight, k, uv, variance[use])
    power = mean * image.size * (distance * cube.pixel_rad) ** 2  # area / pixels^2 |DFT|^2
    # a window makes neighbouring cells alike: mean(w^4)/mean(w^2)^2 of them are one
    modes = count * (1.0 if stokes == "P" else 0.5)
    modes = np.maximum(modes * (window**2).mean() ** 2 / (window**4).mean(), np.minimum(modes, 1))
    about = cube.unit, stokes, float(cube.freq_hz[channel]), z, distance, uv_range and (low, high), taper
    return Spectrum2D(
        k_mean, uv_mean, power, power / np.sqrt(modes), count, edges, *about, missing=1 - float(has.mean())
    )


def plane(cube: StokesCube, stokes: str, channel: int) -> Float | Complex:
    """One Stokes parameter of one channel in float64, or Q + iU for "P" (complex), (Ny, Nx)."""
    if stokes not in get_args(Stokes):
        raise InputError(f"stokes = '{stokes}' is not known; {did_you_mean(str(stokes), get_args(Stokes))}")
    if not 0 <= channel < len(cube.data):
        raise InputError(f"channel = {channel} is not one of 0 to {len(cube.data) - 1}")
    i, q, u, v = np.asarray(cube.data[channel], float)
    return q + 1j * u if stokes == "P" else {"I": i, "Q": q, "U": u, "V": v}[stokes]


def taper_of(n: int, name: str | None) -> Float:
    """Taper of n pixels, 1 at the centre pixel n // 2 and periodic in n (n,)."""
    if name not in TAPERS:
        raise InputError(f"taper = '{name}' is not known; {did_you_mean(str(name), filter(None, TAPERS))}")
    phase = 2 * np.pi * (np.arange(n) - n // 2) / n
    return sum((a * np.cos(i * phase) for i, a in enumerate(TAPERS[name])), np.zeros(n))


def cell_variance(field: Float | Complex, window: Float) -> tuple[Float, Float]:
    """|DFT(w x)|² / (N² mean w²) of any number of axes, and how many cells each column of the last axis stands for.

    Times the volume it is P(k); its sum over all cells is mean |w x|² / mean w² (Parseval). Of a real field only half
    of the last axis is made: columns count twice but for k = 0 and, of an even size, Nyquist.
    """
    from ducc0 import fft

    values, n, axes = field * window, field.shape[-1], tuple(range(field.ndim))
    if np.iscomplexobj(values):
        found, times = fft.c2c(values, axes=axes, nthreads=0), np.ones(n)
    else:
        found, times = fft.r2c(values, axes=axes, nthreads=0), np.full(n // 2 + 1, 2.0)
        times[[0] if n % 2 else [0, -1]] = 1
    return (found.real**2 + found.imag**2) / (field.size**2 * (window**2).mean()), times


def comoving(freq_hz: float, redshift: float | None, cosmology: Any) -> tuple[float, float]:
    """Redshift, of the 21-cm line unless given, and transverse comoving distance in Mpc (no h); Planck15 by default."""
    from astropy.cosmology import FLRW, Planck15

    z = HYDROGEN / freq_hz - 1 if redshift is None else float(redshift)
    if not 0 < z < np.inf:
        raise InputError(f"redshift = {z:.4g} for {freq_hz / 1e6:.6g} MHz is not above 0: give redshift=")
    if not isinstance(cosmology, FLRW | None):
        raise InputError(f"cosmology = {cosmology!r} is not one of astropy.cosmology, such as Planck18")
    return float(z), float((cosmology or Planck15).comoving_transverse_distance(z).to_value("Mpc"))


def bin_edges(low: float, high: float, bins: Any, log: bool) -> Float:
    """Edges in 1/Mpc (N + 1,): `bins` of them, equal in ln k or in k, or the edges given with their unit."""
    if isinstance(bins, int | np.integer):
        edges = (np.geomspace if log else np.linspace)(low, high, max(int(bins), 0) + 1)
    else:
        edges = np.atleast_1d(to_si(bins, "1/Mpc", "bins"))
    if edges.ndim != 1 or len(edges) < 2 or not (np.diff(edges) > 0).all() or edges[0] < 0:
        raise InputError(f"bins = {bins} (from {low:.4g} to {high:.4g} /Mpc) are not one or more, or edges that grow")
    return np.asarray(edges)


def bin_means(k: Float, edges: Float, weight: Float, *values: Float) -> tuple[Int, list[Float]]:
    """Cells (N,) in bins [low, high), the last closed, and weighted means of values in them; NaN where none is."""
    index = np.where(k == edges[-1], len(edges) - 2, np.searchsorted(edges, k, side="right") - 1)
    inside = (index >= 0) & (index < len(edges) - 1)
    first, *sums = (
        np.bincount(index[inside], (weight * x)[inside], len(edges) - 1) for x in (np.ones(len(k)), *values)
    )
    count = first.round().astype(int)
    return count, [np.divide(s, count, out=np.full(len(count), np.nan), where=count > 0) for s in sums]
