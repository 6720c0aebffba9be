"""Recovered over injected: what of the power of a known signal is there at the end of the way, bin by bin."""

from __future__ import annotations

import os
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np

from instrument.analyze.power.channel_grid import same_grid
from instrument.analyze.power.cylinders import Cylindrical, Spherical, demand_same
from instrument.analyze.power.transform import Transform, cells_of
from instrument.checked import checked
from instrument.errors import InputError
from instrument.image.cube import StokesCube
from instrument.numbers import brief
from instrument.shown import short_repr
from instrument.units import Float
from instrument.whole_file import write_ecsv

NOTHING = 1e-12  # of the largest power injected in a bin: less is no signal but the spill of others
HOW = Transform(taper_space="hann")


@checked
@dataclass(frozen=True, eq=False)
class Recovered:
    """Spectra of an injected signal s, of what was recovered r, of one across the other, and of noise, of one shape.

    `ratio` = (<r r*> - <n n*>) / <s s*> is 1 where the power that is found is that of the signal: more is foreground or
    leakage that is left, less is signal that was lost. `transfer` = Re <r s*> / <s s*> is what came through of the
    signal itself, whatever else is there. NaN where a bin is empty or nothing was injected in it.
    """

    __repr__ = short_repr
    injected: Spherical | Cylindrical
    recovered: Spherical | Cylindrical
    across: Spherical | Cylindrical
    noise: Spherical | Cylindrical | None = None

    @property
    def ratio(self) -> Float:
        """Power recovered, less that of noise, over power injected: (N,) of k, or (P, L) of k_perp and k_par."""
        return self._over(self.recovered.power - (0.0 if self.noise is None else self.noise.power))

    @property
    def transfer(self) -> Float:
        """Re <r s*> / <s s*>, of the same shape."""
        return self._over(self.across.power)

    @property
    def foreign(self) -> Float:
        """Power that was recovered and is not the signal's, |r|² less its part along s, over power injected."""
        return np.maximum(self._over(self.recovered.power) - self.transfer**2, 0.0)

    @property
    def ratio_sigma(self) -> Float:
        """Scatter of the ratio: over N modes what is foreign beats with itself and with the signal, which is given.

        Var |T s + n|² = P_n² + 2 T² |s|² P_n for each mode, of the powers that its cells have: where few baselines, or
        uneven weights, leave most of it to some cells, few modes count. That of the noise is added in squares. Bins of
        one or two modes have up to 1.5 times as much: T is fitted to them.
        """
        t, (a, x, s) = self.transfer, self._cells
        products = ((1, a, a), (4 * t**2, x, x), (t**4, s, s), (-4 * t, a, x), (2 * t**2, a, s), (-4 * t**3, x, s))
        itself = sum(factor * self._mean(one, two, alone=True) for factor, one, two in products)  # <|n|⁴>
        variance = np.maximum(itself, 0.0) + 2 * t**2 * self._beat
        if self.noise is not None:
            noise = self._placed(self.noise)
            variance = variance + self._mean(noise, noise, alone=True)
        return self._scatter(variance)

    @property
    def transfer_sigma(self) -> Float:
        """Scatter of the transfer: |s|² P_n over 2 N P_s², the mean of the cells."""
        return self._scatter(self._beat / 2)

    @property
    def _cells(self) -> tuple[Float, Float, Float]:
        """Of every cell of the signal |r|², Re r s* and |s|²."""
        return self._placed(self.recovered), self._placed(self.across), self.injected.cells.power

    @property
    def _beat(self) -> Float:
        """Mean of |s|² |n|² over cells, n = r - T s."""
        t, (a, x, s) = self.transfer, self._cells
        return np.maximum(self._mean(s, a) - 2 * t * self._mean(s, x) + t**2 * self._mean(s, s), 0.0)

    def _placed(self, spectrum: Spherical | Cylindrical) -> Float:
        """The powers of its cells where the signal has them; 0 where its PSF is too weak to be divided by."""
        here, there = self.injected.cells, spectrum.cells
        ours, theirs = ((c.v_index, c.u_index) for c in (here, there))
        if np.array_equal(ours, theirs):
            return there.power
        place = {cell: n for n, cell in enumerate(zip(*theirs, strict=True))}
        found = np.array([place.get(cell, -1) for cell in zip(*ours, strict=True)])
        return np.where(found < 0, 0.0, there.power[:, found])

    def _mean(self, one: Float, two: Float, alone: bool = False) -> Float:
        """Mean over the cells of bins of a product of powers, in the square of the largest power injected.

        `alone`: of one power with itself, of which that of a mode is 2 P², and of the mean of two, both signs, 3/2 P².
        """
        unit, folds = self._unit, self.injected.cells.folds
        return self.injected.mean(
            lambda m, cells: (one[m, cells] / unit) * (two[m, cells] / unit) / (1 + 1 / folds[m] if alone else 1)
        )

    def _scatter(self, variance: Float) -> Float:
        """Of the mean over modes of what has so much of it in each, over power injected."""
        with np.errstate(invalid="ignore", divide="ignore"):
            share = self._over(variance * self._unit) / (self.injected.power / self._unit)
            return np.asarray(np.sqrt(share / self._modes))

    @property
    def _unit(self) -> float:
        """The largest power injected, or 1 where none was."""
        most = float(np.nanmax(self.injected.power, initial=0.0))
        return most if most > 0 else 1.0

    @property
    def _modes(self) -> Float:
        with np.errstate(invalid="ignore", divide="ignore"):
            return np.asarray((self.injected.power / self.injected.sigma) ** 2)

    def _over(self, power: Any) -> Float:
        most = np.nanmax(self.injected.power, initial=0.0)
        use = self.injected.power > NOTHING * most
        return np.divide(power, self.injected.power, out=np.full(np.shape(power), np.nan), where=use)

    def table(self) -> Any:
        """One row a bin that has cells: k, power injected, ratio and transfer with their scatter, what is foreign."""
        out = self.injected.table()
        out.rename_column("power", "injected")
        out.remove_columns([name for name in out.colnames if name.startswith("delta2") or name == "sigma"])
        for name in ("ratio", "ratio_sigma", "transfer", "transfer_sigma", "foreign"):
            out[name] = np.ravel(getattr(self, name))
        return out[out["count"] > 0]

    def write(self, path: str | os.PathLike[str], overwrite: bool = False) -> None:
        """Write the table as ECSV; the file is whole or not there."""
        write_ecsv(self.table(), path, overwrite)


@checked
def recovered_power(
    recovered: StokesCube,
    injected: StokesCube,
    noise: StokesCube | None = None,
    how: Transform = HOW,
    bins: Any = 12,
    bins_par: Any = None,
    shape: Literal["spherical", "cylindrical"] = "spherical",
) -> Recovered:
    """Compare the cube at the end of the way with the signal that was put into the sky at its beginning.

    `injected` is the signal as the same instrument and imager show it alone, so that the PSF is in both; `noise` a cube
    of noise alone, whose power is taken off. All on the same axes and in one unit. A pixel without data in one counts
    in none. `how` is the transform of `Analyzer.cells`, `bins` and `bins_par` are those of its spectra, the latter of
    "cylindrical" ones alone.
    """
    if bins_par is not None and shape == "spherical":
        raise InputError(f"bins_par = {brief(bins_par)} is of shape = 'cylindrical': say so, or leave it out")
    cubes = [recovered, injected, *(() if noise is None else (noise,))]
    for cube in cubes[1:]:
        if cube.unit != recovered.unit:
            raise InputError(f"cubes are in {recovered.unit} and {cube.unit}: bring them to one, as by to_kelvin()")
    cubes = [recovered, *(same_grid(recovered, cube) for cube in cubes[1:])]
    plane = "IQUV".index(how.stokes) if how.stokes in "IQUV" else None
    if plane is not None and not np.nan_to_num(injected.data[:, plane]).any():
        raise InputError(f"nothing was injected in Stokes {how.stokes}: its data are 0 or NaN")
    blank = np.logical_or.reduce([np.isnan(cube.data) for cube in cubes])
    same = [cube.with_data(np.where(blank, np.nan, cube.data)) for cube in cubes]

    def spectrum(cube: StokesCube, cross: StokesCube | None = None) -> Spherical | Cylindrical:
        cells = cells_of(cube, how, cross)
        return cells.spherical(bins) if shape == "spherical" else cells.cylindrical(bins, bins_par)

    found = [spectrum(cube) for cube in same]
    across = spectrum(same[0], same[1])
    for one in (*found[1:], across):
        demand_same(found[0], one)
    return Recovered(found[1], found[0], across, found[2] if noise is not None else None)
