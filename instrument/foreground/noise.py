"""Noise of a cube, measured at delays that no smooth foreground reaches."""

from __future__ import annotations

from typing import Any

import numpy as np

from instrument.analyze.power.fourier import comoving, line_of_sight
from instrument.errors import InputError
from instrument.foreground.linear import apply, covariance, one_thread
from instrument.units import Bool, Float

NOISE_FROM = 0.3  # 1/Mpc: delays beyond it hold noise
PROBES = 32  # spectra of those delays in which the noise of each cell is measured: to 18 %, their sum to far better
LEAST = 4  # delays of noise
RIDGE = 1e-2  # of the least squares for the noise of channels, towards their mean


def noise_power(maps: Any, freq_hz: Float) -> tuple[Float, Float]:
    """Noise power of every cell of the half plane (Ny, Nx // 2 + 1) and its shape over channels (C,), of mean 1.

    From delays beyond 0.3 /Mpc: the complement of what is band-limited to less (eigenvectors of sinc(2 tau (f - f'))
    above 1e-12, so channels may be uneven). Raises `InputError` where fewer than 4 are left.
    """
    return measured_noise(maps, freq_hz)[:2]


def measured_noise(maps: Any, freq_hz: Float) -> tuple[Float, Float, Float]:
    """As `noise_power`, and the spectra (C, K) in which the power was measured."""
    from scipy.linalg import eigh

    tau = delay(freq_hz, NOISE_FROM)
    with one_thread():
        values, vectors = eigh(np.sinc(2 * tau * (freq_hz[:, None] - freq_hz)))
    high = vectors[:, values < 1e-12 * values[-1]]
    if high.shape[1] < LEAST:
        raise InputError(f"{len(freq_hz)} channels leave {high.shape[1]} delays beyond {NOISE_FROM} /Mpc for the noise")
    quiet = high @ high.T
    found = np.diagonal(quiet @ covariance(maps) @ quiet)  # = quiet^2 shape
    mean = max(float(found.sum()) / high.shape[1], np.finfo(float).tiny)
    # these delays hardly reach the outermost channels: there the mean stands in
    even = (quiet**2).T @ quiet**2 + RIDGE * np.eye(len(quiet))
    shape = np.linalg.solve(even, (quiet**2).T @ (found / mean) + RIDGE)
    shape = np.maximum(shape, 1e-3)
    shape /= shape.mean()
    turn = np.random.default_rng(1).standard_normal((high.shape[1], min(PROBES, high.shape[1])))
    probes = high @ np.linalg.qr(turn)[0]
    gain = np.einsum("cp,c,cp->p", probes, shape, probes)
    cells = np.ones((maps.shape[1], maps.shape[2] // 2 + 1), bool)
    power = (np.abs(spectra(probes, maps, cells)) ** 2 / gain[:, None]).mean(axis=0)
    return power.reshape(cells.shape), shape, probes


def delay(freq_hz: Float, k_par: float) -> float:
    """Delay in s of a wavenumber in 1/Mpc, at the middle of the band."""
    z, _ = comoving(float((freq_hz.min() + freq_hz.max()) / 2), None, None)
    return k_par * line_of_sight(z, None) / (2 * np.pi)


def spectra(modes: Float, maps: Any, cells: Bool) -> Any:
    """Modes of the maps, transformed, in some cells (m, N)."""
    from ducc0 import fft

    found = apply(modes.T, maps)
    return np.stack([fft.r2c(image, nthreads=0)[cells] for image in found])
