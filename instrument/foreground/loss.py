"""Signal loss by injection: what a foreground remover leaves of a known signal, per (k_perp, k_par)."""

from __future__ import annotations

import os
from dataclasses import dataclass
from typing import Any

import numpy as np

from instrument.analyze.analyzer import Analyzer
from instrument.analyze.power.fourier import Taper
from instrument.checked import checked
from instrument.errors import InputError
from instrument.foreground.base import ForegroundRemover
from instrument.image.cube import StokesCube
from instrument.shown import short_repr
from instrument.units import Float, Int
from instrument.whole_file import write_ecsv

WEAK = 1e-9  # of the largest power of the signal in a bin: less is rounding of cubes in float32


@checked
@dataclass(frozen=True, eq=False)
class SignalLoss:
    """Spectra of an injected signal s and of what is left of it, d = residual with it - residual without (Np, Nl).

    `transfer` = Re <d s*> / <s s*> is 1 where the signal comes through and 0 where it is removed; `power_ratio` =
    <d d*> / <s s*>. They differ where the removal adds power that is not the signal's: then the ratio is larger than
    the square of the transfer. NaN where a bin is empty or the signal has less than 1e-9 of its power in another.
    """

    __repr__ = short_repr
    remover: str  # as JSON
    k_perp: Float  # 1/Mpc (Np,)
    k_par: Float  # 1/Mpc (Nl,)
    count: Int  # cells of each bin
    signal: Float  # <s s*>, unit² Mpc³
    left: Float  # <d d*>
    across: Float  # Re <d s*>
    unit: str
    stokes: str

    @property
    def transfer(self) -> Float:
        """Re <d s*> / <s s*> (Np, Nl)."""
        return _over(self.across, self.signal)

    @property
    def power_ratio(self) -> Float:
        """<d d*> / <s s*> (Np, Nl)."""
        return _over(self.left, self.signal)

    def within(self, k_par: tuple[float, float], k_perp: tuple[float, float] = (0.0, np.inf)) -> tuple[float, float]:
        """Transfer and power ratio over all cells with low <= k < high (1/Mpc); NaN without any."""
        use = (self.count > 0) & np.isfinite(self.signal)
        use &= ((self.k_par >= k_par[0]) & (self.k_par < k_par[1]))[None, :]
        use &= ((self.k_perp >= k_perp[0]) & (self.k_perp < k_perp[1]))[:, None]
        total, across, left = ((x[use] * self.count[use]).sum() for x in (self.signal, self.across, self.left))
        return (float(across / total), float(left / total)) if total > 0 else (np.nan, np.nan)

    def table(self) -> Any:
        """One row a bin that has cells: k_perp, k_par, count, transfer, power ratio, power of the signal."""
        from astropy import units as u
        from astropy.table import QTable

        use = self.count > 0
        out = QTable()
        for name, k in (("k_perp", self.k_perp[:, None]), ("k_par", self.k_par[None, :])):
            out[name] = np.broadcast_to(k, use.shape)[use] / u.Mpc
        out["count"], out["transfer"], out["power_ratio"] = (
            x[use] for x in (self.count, self.transfer, self.power_ratio)
        )
        out["signal"] = self.signal[use] * (u.Unit(self.unit) ** 2 * u.Mpc**3)
        out.meta |= {"remover": self.remover, "stokes": self.stokes}
        return out

    def write(self, path: str | os.PathLike[str], overwrite: bool = False) -> None:
        """Write the table as ECSV; the file is whole or not there."""
        write_ecsv(self.table(), path, overwrite)


@checked
def signal_loss(
    remover: ForegroundRemover,
    cube: StokesCube,
    signal: StokesCube,
    taper: Taper | None = "blackman-harris",
    bins: Any = 10,
    bins_par: Any = None,
    infill: Any = None,
) -> SignalLoss:
    """Split a cube with and without a known signal added, and compare what that leaves with the signal.

    `signal` has the shape, channels and unit of the cube (such as `Signal21cm.table(...).cube(...)`); bins, taper and
    infill are those of `Analyzer.cylindrical`. The remover sees the signal, so the loss includes what its choice of
    components adapts to it: inject a signal of the strength that is expected.
    """
    if signal.data.shape != cube.data.shape or signal.unit != cube.unit:
        raise InputError(
            f"the signal is {signal.data.shape} in {signal.unit}, the cube {cube.data.shape} in {cube.unit}: "
            "make them alike"
        )
    if not np.allclose(signal.freq_hz, cube.freq_hz, rtol=1e-9, atol=0):
        raise InputError("the signal has other channels than the cube")
    if not np.isclose(signal.pixel_rad, cube.pixel_rad, rtol=1e-9, atol=0):
        raise InputError("the signal has pixels of another size than the cube")
    s = "IQUV".index(remover.stokes)
    if not np.isfinite(signal.data[:, s]).all() or not signal.data[:, s].any():
        raise InputError(f"{remover.stokes} of the signal is not finite everywhere, or zero everywhere")
    data = np.array(cube.data, np.result_type(cube.data.dtype, signal.data.dtype))
    data[:, s] = cube.data[:, s] + signal.data[:, s]
    left = remover.split(cube.with_data(data)).residual.data[:, s]
    data[:] = 0
    data[:, s] = left - remover.split(cube).residual.data[:, s]
    difference = cube.with_data(data)
    injected = np.zeros_like(data)
    injected[:, s] = np.where(np.isfinite(data[:, s]), signal.data[:, s], np.nan)
    known = cube.with_data(injected)
    same = (remover.stokes, taper, None, None, bins, bins_par)
    one = Analyzer(known).cylindrical(*same, infill=infill)
    two = Analyzer(difference).cylindrical(*same, infill=infill)
    both = Analyzer(difference).cylindrical(*same, cross=known, infill=infill)
    return SignalLoss(
        remover.to_json(), one.k_perp, one.k_par, one.count, one.power, two.power, both.power, cube.unit, remover.stokes
    )


def _over(a: Float, b: Float) -> Float:
    return np.divide(a, b, out=np.full(np.shape(b), np.nan), where=b > WEAK * np.nanmax(b, initial=0.0))
