"""The EoR window: where leakage, noise and wedge stay below the 21-cm spectrum, and what would open it."""

from __future__ import annotations

import os
from dataclasses import dataclass
from typing import Any

import numpy as np

from instrument.analyze.power.cylinders import Cylindrical, demand_same
from instrument.analyze.power.fourier import per_mpc
from instrument.analyze.power.signal import Signal21cm
from instrument.checked import checked
from instrument.errors import InputError
from instrument.shown import short_repr
from instrument.units import FINITE, Bool, Float, Share
from instrument.whole_file import write_ecsv


@checked
@dataclass(frozen=True, eq=False)
class EoRWindow:
    """Bins (k_perp, k_par) of a spectrum of leakage in K, and the 21-cm power `signal` in them, K² Mpc³ (P, L).

    A bin is open where leakage and noise together stay below the signal. Bins in the wedge, empty ones, and those with
    cells outside the k of the model (`unknown`) are never open and do not count. `removed` is a share of the leakage's
    amplitude: its power falls by (1 - removed)².
    """

    __repr__ = short_repr
    leakage: Cylindrical
    signal: Float
    noise: Float
    wedge: Bool  # (P, L): below the line, or below k_par_min
    model: Signal21cm

    @property
    def unknown(self) -> Bool:
        """Bins without cells, or with cells where the model says nothing (P, L)."""
        return np.isnan(self.signal) | np.isnan(self.leakage.power) | np.isnan(self.noise)

    @property
    def counts(self) -> Bool:
        """Bins that are known and above the wedge (P, L)."""
        return ~self.unknown & ~self.wedge

    def ratio(self, removed: Share = 0.0) -> Float:
        """Power of leakage and noise over that of the signal (P, L): 1 is the rim of the window."""
        return (self.leakage.power * (1 - removed) ** 2 + self.noise) / self.signal

    def mask(self, removed: Share = 0.0) -> Bool:
        """Where the window is open (P, L)."""
        return self.counts & (np.nan_to_num(self.ratio(removed), nan=np.inf) < 1)

    def area(self, removed: Share = 0.0) -> tuple[float, float]:
        """Area of the window in ln k_perp ln k_par, and its share of the area of all bins that count."""
        perp, par = (np.log(np.maximum(e, 1e-12)) for e in (self.leakage.perp_edges, self.leakage.par_edges))
        each = np.multiply.outer(np.diff(perp), np.diff(par))
        whole = float(each[self.counts].sum())
        found = float(each[self.mask(removed)].sum())
        return found, found / whole if whole else 0.0

    def reach(self, removed: Share = 0.0, share: Share = 1.0) -> tuple[float, float]:
        """From and up to which k_par (1/Mpc) the window is open at all k_perp, or at a `share` of those that count.

        The longest run of rows of bins in ln k_par; NaN, NaN where no row is.
        """
        counts, mask = self.counts, self.mask(removed)
        total = counts.sum(axis=0)
        rows = np.flatnonzero(total)  # rows without bins that count do not interrupt
        edges, run, best = self.leakage.par_edges, None, (np.nan, np.nan)
        for row in rows:
            if mask[:, row].sum() < share * total[row]:
                run = None
                continue
            run = (float(max(edges[row], 1e-12)) if run is None else run[0], float(edges[row + 1]))
            best = best if run[1] / run[0] <= best[1] / best[0] else run
        return best

    def removal_needed(self, k_par: Any = 1.0) -> float:
        """Share of the leakage to be removed to open every bin that counts up to k_par (1/Mpc): 0 none, NaN impossible.

        Impossible is what no removal of leakage opens: noise alone is above the signal somewhere.
        """
        use = self.counts & (self.leakage.k_par <= per_mpc(k_par, "k_par"))
        if not use.any():
            raise InputError(
                f"no bin counts up to k_par = {k_par} /Mpc: all are in the wedge, empty or outside the model"
            )
        room = (self.signal - self.noise)[use]
        if np.any(room <= 0):
            return float("nan")
        power = np.maximum(self.leakage.power[use], 0)
        left = np.sqrt(np.divide(room, power, out=np.full(len(room), np.inf), where=power > 0))
        return float(max(0.0, 1 - left.min()))

    def __str__(self) -> str:
        unknown = int(self.unknown.sum())
        lines = [
            f"EoR window: leakage at z = {self.leakage.redshift:.3g} against {self.model.name} "
            f"(z = {self.model.redshift:.3g}), {int(self.counts.sum())} bins"
            + (f", {unknown} unknown (empty, or outside the model)" if unknown else "")
        ]
        for removed in (0.0, 0.7):
            area, share = self.area(removed)
            low, high = self.reach(removed)
            run = (
                f"open at all k_perp for k_par {low:.2g} to {high:.2g} /Mpc"
                if high > low
                else "no k_par open throughout"
            )
            what = f"{removed:.0%} of the leakage removed" if removed else "leakage as it is"
            lines.append(f"{what:<28} {share:4.0%} of the bins' area ({area:.2f} in ln k ln k), {run}")
        top = float(min(1.0, self.leakage.k_par[-1]))
        said = "no bin counts: all are in the wedge, empty or outside the model"
        if (self.counts & (self.leakage.k_par <= top)).any():
            needed = self.removal_needed(top)
            said = f"remove {needed:.0%} of the leakage"
            said = "cannot be done: noise is above the signal" if np.isnan(needed) else said
        lines.append(f"to open it up to k_par = {top:.2g}   {said}")
        return "\n".join(lines)

    def table(self) -> Any:
        """Every bin as a row of an astropy table: spectrum, signal, noise, ratio, whether it counts and is open."""
        from astropy import units as u

        out = self.leakage.table()
        for name, values in (("signal", self.signal), ("noise", self.noise)):
            out[name] = values.ravel() * (u.K**2 * u.Mpc**3)
        out["ratio"], out["ratio_70"] = self.ratio().ravel(), self.ratio(0.7).ravel()
        out["wedge"], out["counts"], out["open"] = self.wedge.ravel(), self.counts.ravel(), self.mask().ravel()
        out.meta |= {"model": self.model.name, "model_redshift": self.model.redshift}
        return out

    def write(self, path: str | os.PathLike[str], overwrite: bool = False) -> None:
        """Write the table as ECSV; the file is whole or not there."""
        write_ecsv(self.table(), path, overwrite)


def eor_window(
    leakage: Cylindrical,
    signal: Signal21cm,
    noise: Cylindrical | None = None,
    wedge: Any = None,
    k_par_min: Any = 0.0,
) -> EoRWindow:
    """The window left by a spectrum of leakage in K; see `Analyzer.eor_window`."""
    if leakage.unit != "K":
        raise InputError(f"the spectrum is in {leakage.unit}, the signal in K: take the spectrum of cube.to_kelvin()")
    if not np.nan_to_num(leakage.power).any():
        stokes = leakage.frame.stokes
        raise InputError(f"the power of Stokes {stokes} is 0 everywhere: no data, which says nothing of a leakage")
    if noise is not None:
        demand_same(leakage, noise)
    least = FINITE.check(float(per_mpc(k_par_min, "k_par_min")), "k_par_min")
    if not least >= 0:
        raise InputError(f"k_par_min = {k_par_min} must be 0 /Mpc or more")
    line = np.zeros(len(leakage.k_perp)) if wedge is None else leakage.wedge(wedge)
    below = (leakage.k_par < np.nan_to_num(line)[:, None]) | (leakage.k_par < least)
    power = leakage.average(signal.power_or_nan)
    flat = np.zeros(leakage.power.shape) if noise is None else noise.power
    return EoRWindow(leakage, power, flat, below, signal)
