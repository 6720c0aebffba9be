"""What is binned: power of Fourier cells, with their k, their number and the frame they stand in."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from instrument.units import Float, Int


@dataclass(frozen=True)
class Frame:
    """What a cube's cells mean in space: redshift, distances in Mpc, and what was done before the transform."""

    unit: str
    stokes: str
    freq_hz: float  # middle of the band
    redshift: float  # one for the whole band
    distance_mpc: float  # transverse comoving: k_perp = 2 pi uv / distance
    depth_mpc_per_hz: float  # along the line of sight: k_par = 2 pi delay / depth
    taper: str | None
    taper_space: str | None
    uv_range: tuple[float, float] | None  # wavelengths
    missing: float  # share of the lines of sight with NaN, which count as zero
    infilled: int  # channels without data that were filled in
    psf_corrected: bool

    @property
    def horizon_slope(self) -> float:
        """k_par / k_perp of the horizon, D H(z) / (c (1+z)): 3.59 at 150 MHz; of an angle, its sine times that."""
        return self.distance_mpc / (self.freq_hz * self.depth_mpc_per_hz)


@dataclass(frozen=True, eq=False)
class Plane:
    """Power (M, N) in `unit`² Mpc³ of N cells (u, v), by |u|, and M delays from 0 to Nyquist, both signs averaged.

    A cell stands for `times` (N,) cells of the plane and a delay for `folds` (M,); N by M is what a cube has. `auto` is
    the geometric mean of the two powers where `power` is that of one cube across another, and the same without.
    """

    frame: Frame
    k_perp: Float  # (N,), 1/Mpc, growing
    k_par: Float  # (M,), 1/Mpc, growing from 0
    power: Float
    auto: Float
    times: Float
    folds: Float
    v_index: Int  # (N,), place on the grid of the DFT of each cell, rows and columns
    u_index: Int

    def sums(self, bounds: Int, row: Float) -> Float:
        """Sums (P,) over cells bounds[i] <= n < bounds[i+1] of one row (N,), weighted by `times`."""
        filled = np.diff(bounds) > 0
        out = np.zeros(len(bounds) - 1)
        # differences of a running sum would bury a faint bin behind a bright one
        if filled.any():
            part = slice(bounds[0], bounds[-1])
            out[filled] = np.add.reduceat(row[part] * self.times[part], bounds[:-1][filled] - bounds[0])
        return out

    def sums_of(self, bounds: Int, delay: int, of: Callable[[int, slice], Float]) -> Float:
        """The same of what a delay, by its index, has in the cells of all bins."""
        part = slice(bounds[0], bounds[-1])
        values = np.zeros(len(self.k_perp))
        values[part] = of(delay, part)
        return self.sums(bounds, values)
