"""Power spectra of cubes: cylindrical (k_perp, k_par) and spherical (k), made from Fourier cells."""

from __future__ import annotations

import os
from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any, Self

import numpy as np

from instrument.analyze.power.bins import Frame, Plane
from instrument.analyze.power.fourier import sine
from instrument.checked import checked
from instrument.errors import InputError
from instrument.shown import short_repr
from instrument.units import Float, Int
from instrument.whole_file import write_ecsv


class _Spectrum(ABC):
    """What both spectra have: the unit and redshift of their cube, noise taken off, a table written."""

    frame: Frame
    power: Float
    sigma: Float
    __repr__ = short_repr

    @property
    def unit(self) -> str:
        """Unit of the cube."""
        return self.frame.unit

    @property
    def redshift(self) -> float:
        """The redshift that serves the whole band."""
        return self.frame.redshift

    def less(self, noise: Self) -> Self:
        """The same less the power of noise (its bias taken off); errors add in squares. Raises for other bins."""
        demand_same(self, noise)
        sigma = np.hypot(self.sigma, noise.sigma)
        return replace(self, power=self.power - noise.power, sigma=sigma)  # type: ignore[type-var]

    @abstractmethod
    def edges_of(self) -> tuple[Float, ...]:
        """Edges of the bins, an array for each axis, 1/Mpc."""

    @abstractmethod
    def table(self) -> Any:
        """Everything as an astropy table, one row a bin, with units."""

    def write(self, path: str | os.PathLike[str], overwrite: bool = False) -> None:
        """Write the table as ECSV; the file is whole or not there."""
        write_ecsv(self.table(), path, overwrite)


@checked
@dataclass(frozen=True, eq=False, repr=False)
class Cylindrical(_Spectrum):
    """Power spectrum of a cube in bins of k_perp (P,) and |k_par| (L,): P = V / N² mean |DFT|², `unit`² Mpc³ (P, L).

    `k_perp` and `k_par` (1/Mpc) are means over the cells of a bin `edges[i] <= k < edges[i+1]`, the last one closed;
    `count` is their number, both signs of every k counted, and NaN stands where it is 0. `sigma` is the scatter of a
    Gaussian field that all cells see alike: power over the root of the independent modes. `left_out` counts the cells
    in no bin.
    """

    k_perp: Float
    k_par: Float
    power: Float
    sigma: Float
    count: Int
    perp_edges: Float  # 1/Mpc (P + 1,)
    par_edges: Float  # 1/Mpc (L + 1,)
    frame: Frame
    left_out: dict[str, int]
    cells: Plane

    @property
    def delta2(self) -> Float:
        """k_perp² k_par P / (2 pi)², `unit`² (P, L): the paper's; half the variance per ln k_perp and ln k_par."""
        return self.k_perp[:, None] ** 2 * self.k_par * self.power / (2 * np.pi) ** 2

    @property
    def delta2_standard(self) -> Float:
        """k³ P / 2 pi² with k² = k_perp² + k_par², `unit`² (P, L): what a spherical spectrum has at that k."""
        k = np.hypot(self.k_perp[:, None], self.k_par)
        return k**3 * self.power / (2 * np.pi**2)

    def edges_of(self) -> tuple[Float, ...]:
        """Edges of the bins of k_perp and of k_par, 1/Mpc."""
        return self.perp_edges, self.par_edges

    def wedge(self, angle: Any) -> Float:
        """k_par (P,) below which smooth sources within `angle` of the phase centre lie; 90 deg is the horizon."""
        return self.frame.horizon_slope * sine(angle) * self.k_perp

    def average(self, model: Callable[[Float], Float]) -> Float:
        """Mean of a spectrum P(k) (function of k in 1/Mpc) over the cells of each bin (P, L).

        At the mean k of a bin a steep spectrum is another, by 2 to 7 % for bins of ratio 1.37.
        """
        return self.mean(lambda m, part: model(np.hypot(self.cells.k_perp[part], self.cells.k_par[m])))

    def mean(self, of: Callable[[int, slice], Float]) -> Float:
        """Mean over the cells of each bin (P, L) of what a delay, by its index, has in some cells (u, v)."""
        cells, sums = self.cells, np.zeros(self.power.shape)
        bounds, rows = bounds_of(cells.k_perp, self.perp_edges), rows_of(cells.k_par, self.par_edges)
        for m, (row, fold) in enumerate(zip(rows, cells.folds, strict=True)):
            if row >= 0:
                sums[:, row] += fold * cells.sums_of(bounds, m, of)
        return divided(sums, self.count)

    def table(self) -> Any:
        """Everything as an astropy table, one row a bin, with units."""
        from astropy import units as u
        from astropy.table import QTable

        squared, per_mpc = u.Unit(self.unit) ** 2, 1 / u.Mpc
        shape = self.power.shape
        out = QTable()
        axes = (("k_perp", self.k_perp, self.perp_edges, 0), ("k_par", self.k_par, self.par_edges, 1))
        for name, values, edges, axis in axes:
            for part, column in ((name, values), (f"{name}_low", edges[:-1]), (f"{name}_high", edges[1:])):
                wide = column[:, None] if axis == 0 else column
                out[part] = np.broadcast_to(wide, shape).ravel() * per_mpc
        out["power"], out["sigma"] = (x.ravel() * (squared * u.Mpc**3) for x in (self.power, self.sigma))
        out["delta2"], out["delta2_standard"] = (x.ravel() * squared for x in (self.delta2, self.delta2_standard))
        out["count"] = self.count.ravel()
        out.meta |= _about(self.frame, self.left_out)
        return out


@checked
@dataclass(frozen=True, eq=False, repr=False)
class Spherical(_Spectrum):
    """Power spectrum of a cube in bins of k (N,), `unit`² Mpc³; fields as those of `Cylindrical`."""

    k: Float
    power: Float
    sigma: Float
    count: Int
    edges: Float  # 1/Mpc (N + 1,)
    frame: Frame
    left_out: dict[str, int]
    cells: Plane
    bounds: Int  # of each delay, where bins begin among the cells (M, N + 1)

    def edges_of(self) -> tuple[Float, ...]:
        """Edges of the bins of k, 1/Mpc."""
        return (self.edges,)

    @property
    def delta2(self) -> Float:
        """Variance per ln k, k³ P / 2 pi², in `unit`² (N,)."""
        return self.k**3 * self.power / (2 * np.pi**2)

    def average(self, model: Callable[[Float], Float]) -> Float:
        """Mean of a spectrum P(k) over the cells of each bin (N,); see `Cylindrical.average`."""
        return self.mean(lambda m, part: model(np.hypot(self.cells.k_perp[part], self.cells.k_par[m])))

    def mean(self, of: Callable[[int, slice], Float]) -> Float:
        """The same as `Cylindrical.mean` (N,)."""
        cells, sums = self.cells, np.zeros(len(self.k))
        for m, (bounds, fold) in enumerate(zip(self.bounds, cells.folds, strict=True)):
            sums += fold * cells.sums_of(bounds, m, of)
        return divided(sums, self.count)

    def table(self) -> Any:
        """Everything as an astropy table, one row a bin, with units."""
        from astropy import units as u
        from astropy.table import QTable

        squared = u.Unit(self.unit) ** 2
        out = QTable()
        out["k"] = self.k / u.Mpc
        out["k_low"], out["k_high"] = self.edges[:-1] / u.Mpc, self.edges[1:] / u.Mpc
        out["power"], out["sigma"] = (x * (squared * u.Mpc**3) for x in (self.power, self.sigma))
        out["delta2"], out["count"] = self.delta2 * squared, self.count
        out.meta |= _about(self.frame, self.left_out)
        return out


def length(k_perp: Any, k_par: Any) -> Float:
    """|k|, the same to the last digit wherever a cell is put in a bin; np.hypot takes three times as long."""
    return np.asarray(np.sqrt(k_perp * k_perp + k_par * k_par))


def ratio(a: Cylindrical, b: Cylindrical) -> Float:
    """Power of `a` over that of `b` (P, L): the PSF cancels. NaN where a bin is empty or `b` is not above 0."""
    demand_same(a, b)
    return np.divide(a.power, b.power, out=np.full(a.power.shape, np.nan), where=b.power > 0)


def demand_same(a: _Spectrum, b: _Spectrum) -> None:
    """Raise `InputError` unless two spectra have the same bins and unit."""
    pairs = list(zip(a.edges_of(), b.edges_of(), strict=False))
    same = a.unit == b.unit and all(x.shape == y.shape and np.allclose(x, y, rtol=1e-9, atol=0) for x, y in pairs)
    if not same:
        raise InputError("spectra differ in bins or unit: make both with the same uv_range, bins, redshift, and unit")


def bounds_of(k: Float, edges: Float) -> Int:
    """Where bins [low, high), the last closed, begin among growing k (N + 1,)."""
    bounds = np.searchsorted(k, edges, "left")
    bounds[-1] = np.searchsorted(k, edges[-1], "right")
    return bounds


def rows_of(k: Float, edges: Float) -> Int:
    """The bin (M,) of every delay, -1 where none."""
    index = np.where(k == edges[-1], len(edges) - 2, np.searchsorted(edges, k, side="right") - 1)
    return np.where((index >= 0) & (index < len(edges) - 1), index, -1)


def divided(sums: Any, count: Any) -> Float:
    """Sums over counts of one shape, NaN where there are none."""
    return np.divide(sums, count, out=np.full(np.shape(sums), np.nan), where=np.asarray(count) > 0)


def _about(frame: Frame, left_out: dict[str, int]) -> dict[str, Any]:
    from dataclasses import asdict

    about = {k: list(v) if isinstance(v, tuple) else v for k, v in asdict(frame).items()}
    return {**about, "horizon_slope": frame.horizon_slope, "left_out": left_out}
