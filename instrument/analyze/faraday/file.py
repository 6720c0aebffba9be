"""Faraday cubes as FITS files: planes written one by one, so that no second copy is held."""

from __future__ import annotations

import os
from typing import Any

import numpy as np

from instrument.analyze.faraday.spectra import FaradaySpectra
from instrument.observe.grid import ImageGrid
from instrument.provenance import fits_cards
from instrument.whole_file import whole_file


def sky_header(cube: FaradaySpectra) -> Any:
    """FITS header of the first two axes, RA and DEC, SIN projection about the centre pixel."""
    from astropy.io import fits

    header = fits.Header()
    grid = ImageGrid.of(cube.data.shape, cube.pixel_rad, cube.centre)
    for i, (kind, value, delta, middle) in enumerate(grid.fits_axes, 1):
        header[f"CTYPE{i}"], header[f"CUNIT{i}"] = kind, "deg"
        header[f"CRVAL{i}"], header[f"CDELT{i}"], header[f"CRPIX{i}"] = value, delta, middle
    header["RADESYS"] = "ICRS"
    return header


def write_faraday(cube: FaradaySpectra, path: str | os.PathLike[str], overwrite: bool = False) -> None:
    """Write a cube; see `FaradayCube.write`."""
    from astropy.io import fits

    n, ny, nx = cube.data.shape
    single = cube.data.dtype.itemsize == 8
    head = fits.Header([("SIMPLE", True), ("BITPIX", -32 if single else -64), ("NAXIS", 4)])
    for i, size in enumerate((nx, ny, n, 2), 1):
        head[f"NAXIS{i}"] = size
    head["EXTEND"] = True
    head.extend(sky_header(cube), end=True)
    step = float(cube.depths[-1] - cube.depths[0]) / max(1, n - 1) or 1.0
    even = np.abs(cube.depths - cube.depths[0] - step * np.arange(n)).max() <= 1e-4 * abs(step)
    axis = ("FDEP", "rad/m2", float(cube.depths[0]), step) if even else ("DEPTHNUM", "", 1.0, 1.0)
    # FITS has no complex images: Q and U as Stokes 2 and 3, real and imaginary part as its axis COMPLEX 1 and 2
    last = ("STOKES", "", 2.0, 1.0) if cube.stokes == "P" else ("COMPLEX", "", 1.0, 1.0)
    for i, (kind, unit, value, delta) in ((3, axis), (4, last)):
        head[f"CTYPE{i}"], head[f"CUNIT{i}"], head[f"CRVAL{i}"] = kind, unit, value
        head[f"CDELT{i}"], head[f"CRPIX{i}"] = delta, 1.0
    head["BUNIT"] = (cube.unit, "per RMSF")
    head["POLCCONV"] = ("IAU", "x north, y east; V is minus that of the IAU")
    head["STOKESIN"] = (cube.stokes, "what was transformed; P is Q + iU")
    head["LAMSQ0"] = (cube.lambda2_0, "lambda^2_0, m2")
    if np.isfinite(cube.fwhm):
        head["FWHM"] = (cube.fwhm, "of |RMSF|, rad/m2")
    if cube.noise is not None:
        head["NOISE"] = (cube.noise, "of real and imaginary part")
    head["ORIGIN"] = "instrument"
    head.extend(fits_cards(), update=True)
    rmsf = [
        fits.Column("FDEP", "D", "rad/m2", array=cube.rmsf_depths),
        fits.Column("RMSF", "M", array=cube.rmsf),
    ]
    channels = [
        fits.Column("FREQ", "D", "Hz", array=cube.freq_hz),
        fits.Column("LAMBDASQ", "D", "m2", array=cube.lambda2),
        fits.Column("WEIGHT", "D", array=cube.weights),
    ]
    depths = [fits.Column("FDEP", "D", "rad/m2", array=cube.depths)]
    with whole_file(path, overwrite) as partial:
        stream = fits.StreamingHDU(str(partial), head)
        for part in ("real", "imag"):
            for plane in cube.data:
                stream.write(np.ascontiguousarray(getattr(plane, part), np.float32 if single else np.float64))
        stream.close()
        for name, columns in (("DEPTHS", depths), ("RMSF", rmsf), ("CHANNELS", channels)):
            table = fits.BinTableHDU.from_columns(columns, name=name)
            fits.append(str(partial), table.data, table.header)
