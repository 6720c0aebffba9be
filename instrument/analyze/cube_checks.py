"""Samples of Faraday spectra and of Fourier cells, computed again from their definitions."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from instrument.analyze.faraday.cube import FaradayCube
from instrument.analyze.power.cells import Cells
from instrument.analyze.power.fourier import taper_of
from instrument.image.cube import StokesCube
from instrument.units import Complex, Float


class CubeCheck(NamedTuple):
    """Largest difference found between a product and its definition, what it may be, and of how many samples."""

    error: float
    bound: float
    samples: int

    @property
    def passed(self) -> bool:
        """Whether the bound is met."""
        return self.error <= self.bound

    def __str__(self) -> str:
        return f"error {self.error:.1e}, at most {self.bound:.0e}, of {self.samples} samples"


def check_faraday(cube: StokesCube, found: FaradayCube, samples: int = 64, seed: int = 0) -> CubeCheck:
    """Random spectra of P as plain sums in double precision; errors relative to the largest |F| of each."""
    ny, nx = cube.data.shape[2:]
    rng = np.random.default_rng(seed)
    y, x = rng.integers(ny, size=samples), rng.integers(nx, size=samples)
    order = slice(None)
    p = cube.data[order, 1, y, x].astype(complex) + 1j * cube.data[order, 2, y, x]
    weight = np.where(np.isnan(p), 0.0, found.weights[:, None])
    turn = np.exp(-2j * np.multiply.outer(found.depths, found.lambda2 - found.lambda2_0))
    with np.errstate(invalid="ignore", divide="ignore"):
        wanted = turn @ (weight * np.nan_to_num(p)) / weight.sum(axis=0)
        apart = np.abs(found.data[:, y, x] - wanted).max(axis=0) / np.abs(wanted).max(axis=0)
        apart = np.where(np.isnan(wanted).any(axis=0) | ~np.abs(wanted).any(axis=0), 0.0, apart)
    # rounding of n products of float32 (or float64) grows as its root at most times a few
    unit = float(np.finfo(found.data.dtype).eps)
    return CubeCheck(float(np.nan_to_num(apart, nan=np.inf).max(initial=0.0)), 20 * unit, samples)


def check_cells(cube: StokesCube, cells: Cells, samples: int = 16, seed: int = 0) -> CubeCheck | None:
    """Random cells as plain sums over voxels; errors of amplitudes relative to the largest. None where filled in."""
    frame = cells.frame
    if frame.infilled or frame.psf_corrected or cells.auto is not cells.power:
        return None
    rng = np.random.default_rng(seed)
    n, m = rng.integers(len(cells.k_perp), size=samples), rng.integers(len(cells.k_par), size=samples)
    order = np.argsort(cube.freq_hz, kind="stable")
    names = "QU" if frame.stokes == "P" else frame.stokes
    ny, nx = cube.data.shape[2:]

    def image(channel: int) -> Complex | Float:
        parts = [np.asarray(cube.data[channel, "IQUV".index(name)], float) for name in names]
        return parts[0] if len(parts) == 1 else parts[0] + 1j * parts[1]

    has = np.ones((ny, nx), bool)
    for channel in order:
        if np.isnan((found := image(channel)).sum()):
            has &= ~np.isnan(found)
    window = has * np.multiply.outer(taper_of(ny, frame.taper_space), taper_of(nx, frame.taper_space))
    rows = np.exp(-2j * np.pi * np.multiply.outer(cells.v_index[n], np.arange(ny)) / ny)
    turn = 2 * np.pi * np.multiply.outer(np.arange(nx), cells.u_index[n]) / nx
    columns = np.concatenate([np.cos(turn), -np.sin(turn)], axis=1)  # real: most images are

    def cell(plane: Complex | Float) -> Complex:
        real, imag = np.split(plane @ columns, 2, axis=1)
        return np.asarray(np.einsum("sy,ys->s", rows, real + 1j * imag))

    sums = np.empty((len(order), samples), complex)
    ones = cell(window)  # the mean goes through the window too
    total = 0j
    for k, channel in enumerate(order):
        found = image(channel)
        total += found[has].mean()
        sums[k] = cell(found * window if has.all() else np.where(has, found, 0) * window)
    sums -= total / len(order) * ones
    along = taper_of(len(order), frame.taper)
    delays = np.exp(-2j * np.pi * np.multiply.outer(m, np.arange(len(order))) / len(order))
    power = [np.abs(np.einsum("sf,fs->s", d * along, sums)) ** 2 for d in (delays, delays.conj())]
    step = float(np.ptp(cube.freq_hz)) / (len(order) - 1)
    square = (window**2).mean() * (along**2).mean()
    voxel = (frame.distance_mpc * cube.pixel_rad) ** 2 * frame.depth_mpc_per_hz * step
    wanted = (power[0] + power[1]) / 2 * voxel / (len(order) * ny * nx * square)
    top = float(np.sqrt(cells.power.max())) or 1.0
    error = float(np.abs(np.sqrt(wanted) - np.sqrt(cells.power[m, n])).max()) / top
    return CubeCheck(error, 1e-11, samples)
