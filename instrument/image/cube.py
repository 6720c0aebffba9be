"""StokesCube: images of the four Stokes parameters in every channel, with coordinates, unit and PSF."""

from __future__ import annotations

import os
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np

from instrument.errors import InputError
from instrument.observe.directions import LIGHT
from instrument.units import Direction, Float, to_si
from instrument.whole_file import whole_file

BOLTZMANN = 1.380649e-23  # J/K
JY = 1e-26  # W m^-2 Hz^-1
Unit = Literal["Jy/beam", "K"]


@dataclass(frozen=True, eq=False)
class Psf:
    """Point spread function (F, Ny, Nx), peak 1 at the centre pixel, and the Gaussian fitted to its main lobe.

    `major_rad`, `minor_rad` are full widths at half maximum, `angle_rad` is the position angle of the major axis, north
    through east, (F,) each; `residual` is the largest difference between lobe and Gaussian above half maximum.
    """

    data: Float
    major_rad: Float
    minor_rad: Float
    angle_rad: Float
    residual: Float

    @property
    def solid_angle_sr(self) -> Float:
        """Solid angle of the fitted Gaussian, sr (F,)."""
        return np.pi / (4 * np.log(2)) * self.major_rad * self.minor_rad


@dataclass(frozen=True, eq=False, init=False)
class StokesCube:
    """Stokes I, Q, U, V images, real (F, 4, Ny, Nx); x runs to the west, y to the north; NaN is no data.

    `StokesCube(data=array, frequencies=freqs, pixel=0.5 * u.arcmin, unit="K")` makes one from anywhere. The centre is
    pixel (Ny // 2, Nx // 2).
    """

    data: Float
    freq_hz: Float
    pixel_rad: float
    unit: Unit
    centre: Direction | None
    psf: Psf | None

    def __init__(
        self,
        data: Any,
        frequencies: Any,
        pixel: Any,
        unit: Unit = "Jy/beam",
        centre: Direction | None = None,
        psf: Psf | None = None,
    ) -> None:
        put = object.__setattr__
        cube = np.asarray(data)
        if cube.ndim != 4 or cube.shape[1] != 4:
            raise InputError(f"data has shape {cube.shape}, needed (channels, 4 Stokes, y, x)")
        freq = np.atleast_1d(np.asarray(to_si(frequencies, "Hz", "frequencies"), float))
        if len(freq) != len(cube):
            raise InputError(f"{len(cube)} channels but {len(freq)} frequencies")
        if unit not in ("Jy/beam", "K"):
            raise InputError(f"unit = '{unit}' is not one of 'Jy/beam', 'K'")
        put(self, "data", cube)
        put(self, "freq_hz", freq)
        put(self, "pixel_rad", float(to_si(pixel, "rad", "pixel")))
        put(self, "unit", unit)
        put(self, "centre", centre)
        put(self, "psf", psf)

    @property
    def wcs(self) -> Any:
        """World coordinates of the axes (x, y, Stokes, frequency), SIN projection about the centre."""
        from astropy.wcs import WCS

        out = WCS(naxis=4)
        ny, nx = self.data.shape[2:]
        out.wcs.ctype = ["RA---SIN", "DEC--SIN", "STOKES", "FREQ"]
        out.wcs.cunit = ["deg", "deg", "", "Hz"]
        step = np.rad2deg(self.pixel_rad)
        spacing = float(np.diff(self.freq_hz).mean()) if len(self.freq_hz) > 1 else 1.0
        out.wcs.cdelt = [-step, step, 1.0, spacing]
        out.wcs.crpix = [nx // 2 + 1, ny // 2 + 1, 1, 1]
        centre = self.centre or Direction(0.0, 0.0)
        out.wcs.crval = [np.rad2deg(centre.ra_rad), np.rad2deg(centre.dec_rad), 1.0, float(self.freq_hz[0])]
        out.wcs.radesys = "ICRS"
        return out

    def to_kelvin(self) -> StokesCube:
        """The same in K, Rayleigh-Jeans, with the solid angle of each channel's PSF; raises without a PSF."""
        if self.unit == "K":
            return self
        if self.psf is None:
            raise InputError("a cube in Jy/beam needs its PSF to become K: the solid angle of the beam is not known")
        factor = JY * LIGHT**2 / (2 * BOLTZMANN * self.freq_hz**2 * self.psf.solid_angle_sr)
        return self._with(data=self.data * factor[:, None, None, None], unit="K")

    def _with(self, **changes: Any) -> StokesCube:
        from astropy import units as u

        given = {"data": self.data, "unit": self.unit, "centre": self.centre, "psf": self.psf, **changes}
        return StokesCube(frequencies=self.freq_hz * u.Hz, pixel=self.pixel_rad * u.rad, **given)

    def write(self, path: str | os.PathLike[str]) -> None:
        """Write a FITS cube (Stokes and frequency axes, IAU polarization, restoring beam); replaces nothing half."""
        from astropy.io import fits

        uneven = len(self.freq_hz) > 2 and np.ptp(np.diff(self.freq_hz)) > 1e-6 * abs(np.diff(self.freq_hz)[0])
        header = self.wcs.to_header()
        header["BUNIT"] = self.unit
        header["POLCCONV"] = ("IAU", "U and V: x north, y east, V right-handed")
        header["ORIGIN"] = "instrument"
        hdus = [fits.PrimaryHDU(np.asarray(self.data, np.float32), header=header)]
        known: Any = [] if self.psf is None else np.flatnonzero(np.isfinite(self.psf.major_rad))
        if self.psf is not None and len(known):  # FITS has no NaN in a header: the first channel with a beam
            beam, first = hdus[0].header, known[0]
            beam["BMAJ"], beam["BMIN"] = np.rad2deg(self.psf.major_rad[first]), np.rad2deg(self.psf.minor_rad[first])
            beam["BPA"] = np.rad2deg(self.psf.angle_rad[first])
        if uneven or (self.psf is not None and len(self.freq_hz) > 1):
            columns = [fits.Column("FREQ", "D", "Hz", array=self.freq_hz)]
            if self.psf is not None:
                for name, values in (
                    ("BMAJ", self.psf.major_rad),
                    ("BMIN", self.psf.minor_rad),
                    ("BPA", self.psf.angle_rad),
                ):
                    columns.append(fits.Column(name, "D", "deg", array=np.rad2deg(values)))
            hdus.append(fits.BinTableHDU.from_columns(columns, name="BEAMS"))
        with whole_file(path) as partial:
            fits.HDUList(hdus).writeto(partial, overwrite=True)
