"""What all power spectra share: Stokes planes, tapers, Fourier cells, comoving distances, bins."""

from __future__ import annotations

from typing import Any, Literal, get_args

import numpy as np

from instrument.errors import InputError, did_you_mean, warn
from instrument.image.cube import StokesCube
from instrument.numbers import Real, Whole
from instrument.observe.directions import LIGHT
from instrument.units import Complex, Float, Int, plain, to_si

HYDROGEN = 1420405751.768  # Hz, the 21-cm line at rest
Stokes = Literal["I", "Q", "U", "V", "P"]
Taper = Literal["hann", "blackman-harris", "blackman-harris-7"]
# sums of cosines about the centre pixel; periodic, so that a constant reaches no cell beyond the last term
TAPERS = {
    None: (1.0,),
    "hann": (0.5, 0.5),
    "blackman-harris": (0.35875, 0.48829, 0.14128, 0.01168),  # sidelobes 1e-9 of the power
    # seven terms (Albrecht 2001), sidelobes 1e-18, 1.3 times as wide: for foregrounds 1e6 times the signal
    "blackman-harris-7": (
        0.27105140069342, 0.43329793923448, 0.21812299954311, 0.06592544638803, 0.01081174209837, 0.00077658482522,
        0.00001388721735,
    ),
}  # fmt: skip
MANY = Whole(at_least=1, at_most=1_000_000)  # bins: no cube has more cells along a side


def plane(cube: StokesCube, stokes: str, channel: int) -> Float | Complex:
    """One Stokes parameter of one channel in float64, or Q + iU for "P" (complex), (Ny, Nx)."""
    check_stokes(stokes)
    if not 0 <= channel < len(cube.data):
        raise InputError(f"channel = {channel} is not one of 0 to {len(cube.data) - 1}")
    i, q, u, v = np.asarray(cube.data[channel], float)
    return q + 1j * u if stokes == "P" else {"I": i, "Q": q, "U": u, "V": v}[stokes]


def check_stokes(stokes: str) -> None:
    """Raise `InputError` unless it is I, Q, U, V or P (Q + iU)."""
    if stokes not in get_args(Stokes):
        raise InputError(f"stokes = '{stokes}' is not known; {did_you_mean(str(stokes), get_args(Stokes))}")


def uv_limits(uv_range: Any) -> tuple[float, float]:
    """The two ends of a cut of baselines in wavelengths; 0 and infinity where there is none."""
    cut = np.asarray((0, np.inf) if uv_range is None else uv_range, float)
    if cut.shape != (2,) or not 0 <= cut[0] < cut[1]:
        raise InputError(f"uv_range = {uv_range} must be two numbers of wavelengths, the smaller one first")
    return float(cut[0]), float(cut[1])


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


REDSHIFT = Real(above=0, at_most=1100)  # there was no neutral hydrogen before


def check_redshift(redshift: Any, low_hz: float, high_hz: float) -> float | None:
    """The redshift given for a band, above 0; warns where its 21-cm line is further than 10 % from the band."""
    if redshift is None:
        return None
    z = REDSHIFT.check(redshift, "redshift")
    line = HYDROGEN / (1 + z)
    if not low_hz / 1.1 <= line <= high_hz * 1.1:
        band = f"{low_hz / 1e6:.4g}" + (f" to {high_hz / 1e6:.4g}" if high_hz > low_hz else "")
        right = HYDROGEN / ((low_hz + high_hz) / 2) - 1
        warn(f"redshift = {z:g} has its 21-cm line at {line / 1e6:.4g} MHz, the cube is at {band} MHz, z = {right:.3g}")
    return z


def line_of_sight(redshift: float, cosmology: Any) -> float:
    """Comoving Mpc along the line of sight per Hz, c (1+z)² / (H(z) f_21): k_par = 2 pi delay / it."""
    from astropy.cosmology import Planck15

    hubble = float((cosmology or Planck15).H(redshift).to_value("m / (s Mpc)"))
    return LIGHT * (1 + redshift) ** 2 / (hubble * HYDROGEN)


def per_mpc(k: Any, name: str = "k") -> Float:
    """Wavenumbers (any shape) in 1/Mpc: plain numbers are, a Quantity is converted (h/Mpc is refused: no h here)."""
    return np.asarray(plain(k, float, name) if getattr(k, "unit", None) is None else to_si(k, "1/Mpc", name), float)


def sine(wedge: Any) -> float:
    """Sine of an angle from the phase centre, 0 for None; raises `InputError` unless it is 0 to 90 deg."""
    angle = 0.0 if wedge is None else float(to_si(wedge, "rad", "wedge"))
    if not 0 <= angle <= np.pi / 2 + 1e-9:
        raise InputError(f"wedge = {wedge} is not within 0 to 90 deg")
    return float(np.sin(angle))


def bin_edges(low: float, high: float, bins: Any, log: bool) -> Float:
    """Edges in 1/Mpc (N + 1,): `bins` of them, equal in ln k or in k, or the edges given with their unit."""
    if getattr(bins, "unit", None) is None and np.ndim(bins) == 0:
        edges = (np.geomspace if log else np.linspace)(low, high, MANY.check(bins, "bins") + 1)
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
