"""The 21-cm signal: tabulated spectra, their share in a cylindrical spectrum, and random cubes of a given spectrum."""

from __future__ import annotations

from dataclasses import dataclass
from importlib.resources import files
from typing import Any

import numpy as np

from instrument.analyze.power.fourier import comoving, line_of_sight, per_mpc
from instrument.checked import checked
from instrument.errors import InputError, did_you_mean, warn
from instrument.image.cube import StokesCube
from instrument.shown import short_repr
from instrument.units import Count, Float, Int, Seed, to_si

TABLE = "eor_21cm_z9.ecsv"
DEFAULT = "21cmFAST_2011_z9.50"  # closest public table to the curve of Asad et al. (2015)


@checked
@dataclass(frozen=True, eq=False)
class Signal21cm:
    """A spherical spectrum of the 21-cm signal: Delta² = k³ P / 2 pi² in mK² (N,) at `k` in 1/Mpc (N,), growing.

    `Signal21cm.table("21cmFAST_2011_z9.50")` is one of those that come along (`Signal21cm.names()`); 21cmFAST runs of
    Mesinger, Furlanetto & Cen (2011) and Mesinger, Greig & Sobacchi (2016). Between its points ln Delta² is linear in
    ln k; outside it there is no answer.
    """

    __repr__ = short_repr
    name: str
    redshift: float
    k: Float
    delta2_mk2: Float
    neutral_fraction: float = np.nan

    def __post_init__(self) -> None:
        k, delta2 = (np.asarray(x, float) for x in (self.k, self.delta2_mk2))
        good = k.ndim == 1 and k.shape == delta2.shape and len(k) > 1 and np.all(np.diff(k) > 0) and k[0] > 0
        if not good or not (np.isfinite(delta2).all() and np.all(delta2 > 0)):
            raise InputError(
                f"signal '{self.name}' needs growing k above 0 and as many delta2_mk2 above 0, two at least"
            )
        object.__setattr__(self, "k", k)
        object.__setattr__(self, "delta2_mk2", delta2)

    @staticmethod
    def names() -> dict[str, str]:
        """The models that come along and what they are."""
        return {str(name): str(text) for name, text in _shipped().meta["models"].items()}

    @classmethod
    def table(cls, name: str = DEFAULT) -> Signal21cm:
        """A model that comes along, by name; raises `InputError` with the known ones."""
        rows = _shipped()
        rows = rows[rows["model"] == name]
        if not len(rows):
            raise InputError(f"no 21-cm model is called '{name}': {did_you_mean(str(name), cls.names())}")
        return cls(name, float(rows["z"][0]), rows["k"].value, rows["delta2"].value, float(rows["x_HI"][0]))

    def inside(self, k: Any) -> Any:
        """Whether k (any shape, 1/Mpc) is within the table, its ends included to rounding."""
        k = per_mpc(k)
        return (k >= self.k[0] * (1 - 1e-9)) & (k <= self.k[-1] * (1 + 1e-9))

    def delta2(self, k: Any) -> Any:
        """Delta² in mK² at k (any shape) in 1/Mpc, or a Quantity; raises `InputError` outside the table."""
        k = per_mpc(k)
        if not np.all(self.inside(k)):
            least, most = float(np.min(k)), float(np.max(k))
            raise InputError(
                f"k = {least:.4g} to {most:.4g} /Mpc is not within the {self.k[0]:.4g} to {self.k[-1]:.4g} /Mpc of "
                f"'{self.name}': choose bins inside, or another model"
            )
        return np.exp(np.interp(np.log(k), np.log(self.k), np.log(self.delta2_mk2)))

    def power(self, k: Any) -> Any:
        """P(k) = 2 pi² Delta² / k³ in K² Mpc³; raises `InputError` outside the table."""
        return 2e-6 * np.pi**2 * self.delta2(k) / per_mpc(k) ** 3

    def power_or_nan(self, k: Float) -> Float:
        """`power`, and NaN outside the table: for sums over cells of which some are outside."""
        use = self.inside(k)
        out = np.full(np.shape(k), np.nan)
        out[use] = self.power(k[use])
        return out

    def cylindrical(self, k_perp: Any, k_par: Any) -> Float:
        """The paper's cylindrical Delta² in mK² (P, L): Delta²(k) k_perp² k_par / 2 k³, as `Cylindrical.delta2`."""
        k_perp, k_par = np.atleast_1d(per_mpc(k_perp, "k_perp"))[:, None], np.atleast_1d(per_mpc(k_par, "k_par"))
        k = np.hypot(k_perp, k_par)
        return np.asarray(self.delta2(k) * k_perp**2 * k_par / (2 * k**3))

    def cube(
        self,
        pixels: Count | tuple[Count, Count],
        pixel: Any,
        frequencies: Any,
        seed: Seed,
        periodic: bool = True,
        redshift: float | None = None,
        cosmology: Any = None,
    ) -> StokesCube:
        """A Gaussian random field of this spectrum as Stokes I in K, float32 (F, 4, Ny, Nx); other Stokes are 0.

        `pixels` is a side or (Ny, Nx); `frequencies` grow evenly. One redshift, of the middle of the band unless given,
        turns pixels and channels into Mpc. `periodic=False` cuts it out of a field of twice the size along every axis
        (8 times the memory). k outside the table get no power, and a warning says how many.
        """
        shape = (pixels, pixels) if isinstance(pixels, int | np.integer) else tuple(pixels)
        freq = np.atleast_1d(to_si(frequencies, "Hz", "frequencies"))
        steps = np.diff(freq)
        if len(freq) < 2 or not (steps > 0).all() or np.ptp(steps) > 0.01 * steps.mean():
            raise InputError("frequencies of a 21-cm cube must be two or more that grow evenly")
        z, distance = comoving(float(freq.mean()), redshift, cosmology)
        cell = np.array(
            [line_of_sight(z, cosmology) * steps.mean(), *[distance * float(to_si(pixel, "rad", "pixel"))] * 2]
        )
        size = np.array([len(freq), *shape]) * (1 if periodic else 2)
        field = self._field(size, cell, seed)[tuple(slice(n) for n in (len(freq), *shape))]
        data = np.zeros((len(freq), 4, *shape), np.float32)
        data[:, 0] = field
        from astropy import units as u

        return StokesCube(data, freq * u.Hz, pixel, "K")

    def _field(self, size: Int, cell_mpc: Float, seed: int) -> Float:
        """A periodic field (F, Ny, Nx), float32: white noise, each cell times the root of its power."""
        from ducc0 import fft

        white = np.random.default_rng(seed).standard_normal(tuple(size), np.float32)
        cells: Any = fft.r2c(white, axes=(0, 1, 2), nthreads=0)
        k = [2 * np.pi * np.fft.fftfreq(n, d) for n, d in zip(size, cell_mpc, strict=True)]
        across = np.hypot(k[1][:, None], np.abs(k[2][: size[2] // 2 + 1]))
        outside = 0
        for plane, k_par in zip(cells, k[0], strict=True):
            power = self.power_or_nan(np.hypot(across, k_par))
            outside += int(np.isnan(power).sum())
            plane *= np.sqrt(np.nan_to_num(power) / cell_mpc.prod())
        if outside > 1:  # k = 0 never has any
            text = f"{outside / cells.size:.2g} of the cells are outside the {self.k[0]:.3g} to {self.k[-1]:.3g} /Mpc"
            warn(f"{text} of '{self.name}' and get no power")
        return np.asarray(fft.c2r(cells, axes=(0, 1, 2), lastsize=int(size[2]), inorm=2, forward=False, nthreads=0))


def _shipped() -> Any:
    from astropy.table import QTable

    return QTable.read(str(files("instrument.data") / TABLE), format="ascii.ecsv")
