"""Writes a cube as FITS: axes, unit, beams, and frequencies that come back to the last bit."""

from __future__ import annotations

import os
from typing import Any, Protocol

import numpy as np

from instrument.image.psf import Psf
from instrument.provenance import fits_cards
from instrument.units import Direction, Float
from instrument.whole_file import whole_file

TABLE = "FREQS"  # of the frequencies of an axis FREQ-TAB


class _Cube(Protocol):
    """What is written of a `StokesCube`."""

    @property
    def data(self) -> Float: ...
    @property
    def freq_hz(self) -> Float: ...
    @property
    def unit(self) -> str: ...
    @property
    def centre(self) -> Direction | None: ...
    @property
    def psf(self) -> Psf | None: ...
    @property
    def wcs(self) -> Any: ...


def write_cube(cube: _Cube, path: str | os.PathLike[str], overwrite: bool = False) -> None:
    """Write a FITS cube in float32, whole or not at all; see `StokesCube.write`."""
    from astropy.io import fits

    wcs, freq = cube.wcs.wcs, cube.freq_hz
    linear = wcs.crval[3] + wcs.cdelt[3] * np.arange(len(freq))
    even = bool(np.allclose(freq, linear, rtol=1e-12, atol=0))
    header = cube.wcs.to_header()
    for name, values in (("CRVAL", wcs.crval), ("CDELT", wcs.cdelt)):  # all digits: astropy writes twelve
        header.update({f"{name}{i + 1}": float(value) for i, value in enumerate(values)})
    if not even:
        # FITS paper III: a linear axis would be believed by everyone who does not look for a table
        header["CTYPE4"], header["CRVAL4"], header["CDELT4"] = "FREQ-TAB", 1.0, 1.0
        header["PS4_0"], header["PS4_1"] = (TABLE, "table of the frequencies"), "FREQ"
    header["BUNIT"] = cube.unit
    header["POLCCONV"] = ("IAU", "x north, y east; V is minus that of the IAU")
    header["ORIGIN"] = "instrument"
    header.extend(fits_cards(), update=True)
    if cube.centre is None:
        header["NOCENTRE"] = (True, "the centre is not known: 0, 0 stands for it")
    hdus = [fits.PrimaryHDU(np.asarray(cube.data, np.float32), header=header)]
    known: Any = [] if cube.psf is None else np.flatnonzero(np.isfinite(cube.psf.major_rad))
    if cube.psf is not None and len(known):  # FITS has no NaN in a header: the first channel with a beam
        beam, first = hdus[0].header, known[0]
        beam["BMAJ"], beam["BMIN"] = np.rad2deg(cube.psf.major_rad[first]), np.rad2deg(cube.psf.minor_rad[first])
        beam["BPA"] = np.rad2deg(cube.psf.angle_rad[first])
    if not even:
        column = fits.Column("FREQ", f"{len(freq)}D", "Hz", dim=f"(1,{len(freq)})", array=freq.reshape(1, -1, 1))
        hdus.append(fits.BinTableHDU.from_columns([column], name=TABLE))
    if len(freq) > 1 and cube.psf is not None:
        widths = {"BMAJ": cube.psf.major_rad, "BMIN": cube.psf.minor_rad, "BPA": cube.psf.angle_rad}
        columns = [fits.Column("FREQ", "D", "Hz", array=freq)]
        columns += [fits.Column(name, "D", "deg", array=np.rad2deg(x)) for name, x in widths.items()]
        hdus.append(fits.BinTableHDU.from_columns(columns, name="BEAMS"))
    with whole_file(path, overwrite) as partial:
        fits.HDUList(hdus).writeto(partial, overwrite=True)
