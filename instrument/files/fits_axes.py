"""The axes of a FITS cube: which is which, the grid on the sky, frequencies, Stokes parameters."""

from __future__ import annotations

import re
import warnings
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np

from instrument.errors import FileError, InstrumentWarning
from instrument.files.h5parm import one_line
from instrument.observe.directions import lmn
from instrument.units import Direction, Float

Role = Literal["x", "y", "freq", "stokes"]
ROLES: dict[str, Role] = {"RA": "x", "DEC": "y", "FREQ": "freq", "STOKES": "stokes"}
# FITS paper III, and what AIPS called them before
SPECTRAL = {
    "VRAD": "a radio velocity", "VOPT": "an optical velocity", "VELO": "a velocity", "FELO": "a velocity",
    "VELOCITY": "a velocity", "ZOPT": "a redshift", "BETA": "a velocity", "WAVE": "a wavelength",
    "AWAV": "a wavelength in air", "WAVN": "a wavenumber", "ENER": "an energy",
}  # fmt: skip
FRAMES = {"", "LSR", "LSRK", "LSRD", "BAR", "HEL", "GEO", "TOP", "OBS"}  # AIPS: FREQ-LSR; linear all the same
UNITS = {"": 1.0, "HZ": 1.0, "KHZ": 1e3, "MHZ": 1e6, "GHZ": 1e9}
CODES = {1: "I", 2: "Q", 3: "U", 4: "V", -1: "RR", -2: "LL", -3: "RL", -4: "LR", -5: "XX", -6: "YY", -7: "XY", -8: "YX"}
PARALLEL = 1e-4  # relative: 0.05 of a pixel over 480


@dataclass(frozen=True)
class Grid:
    """The grid on the sky of an image: (Ny, Nx), pixel, centre, and whether x or y must be turned round."""

    shape: tuple[int, int]
    pixel_rad: float
    centre: Direction | None
    flip_x: bool
    flip_y: bool


def number(file: str, header: Any, key: str, default: float | None = None) -> float:
    """The number of a keyword; raises `FileError` where it is none, or missing without a default."""
    value = header.get(key, default)
    if value is None:
        raise FileError(f"{file}: {key} is missing")
    if isinstance(value, bool) or not isinstance(value, int | float):
        raise FileError(f"{file}: {key} = {str(value)!r} is not a number")
    return float(value)


def axes_of(file: str, header: Any, named: bool) -> dict[Role, int]:
    """FITS axes (from 1) by what they are; `named`: the frequencies are known, so a velocity axis will do."""
    found: dict[Role, int] = {}
    for axis in range(1, int(header["NAXIS"]) + 1):
        ctype, size = str(header.get(f"CTYPE{axis}", "")).strip().upper(), int(header[f"NAXIS{axis}"])
        name = ctype.partition("-")[0]
        role = ROLES.get(name)
        if size < 1:
            raise FileError(f"{file}: axis {axis} ({ctype or 'no CTYPE'}) has no pixels")
        if name in SPECTRAL:
            if not named:
                what = f"axis {axis} is {ctype}, {SPECTRAL[name]}, not FREQ"
                raise FileError(f"{file}: {what}: regrid to frequency, or give frequencies=")
            role = "freq"
        if role is None:
            if size == 1:
                continue
            what = f"{ctype!r}" if ctype else "without a name"
            raise FileError(f"{file}: axis {axis} (CTYPE{axis}) is {what}: needed RA, DEC, FREQ and STOKES")
        if role in found:
            raise FileError(f"{file}: axes {found[role]} and {axis} are both {name}")
        found[role] = axis
    missing = [name for name, role in ROLES.items() if role in ("x", "y") and role not in found]
    if missing:
        raise FileError(f"{file}: no axis is {' or '.join(missing)}: needed RA, DEC, FREQ and STOKES, in any order")
    return found


def scale_of(file: str, header: Any, axis: int) -> float:
    """Step of an axis in its own unit, of CDELT and PC or of CD; raises `FileError` where axes are turned."""
    matrix = {}  # PC1_2, PC01_02 (CASA), PC001002 (AIPS)
    for key in header:
        if found := re.fullmatch(r"(PC|CD)(?:(\d+)_(\d+)|(\d{3})(\d{3}))", key):
            matrix[found[1], int(found[2] or found[4]), int(found[3] or found[5])] = key
    own = {kind: matrix.get((kind, axis, axis)) for kind in ("PC", "CD")}
    if own["CD"]:
        step = number(file, header, own["CD"])
    elif any(kind == "CD" for kind, _, _ in matrix):  # some write CD for the sky alone, and CDELT for the rest
        step = number(file, header, f"CDELT{axis}", 0.0)
    else:
        step = number(file, header, f"CDELT{axis}", 1.0) * (number(file, header, own["PC"]) if own["PC"] else 1.0)
    for (kind, i, j), key in matrix.items():
        if i == j or axis not in (i, j):
            continue
        value = number(file, header, key)
        if abs(value) > PARALLEL * (abs(step) if kind == "CD" else 1):
            raise FileError(f"{file}: {key} = {value:g}: axes {i} and {j} are turned; regrid, north up")
    turned = number(file, header, f"CROTA{axis}", 0.0)
    if abs(np.sin(np.deg2rad(turned))) > PARALLEL:
        raise FileError(f"{file}: CROTA{axis} = {turned:g} deg: the image is turned; regrid, north up")
    if not (np.isfinite(step) and step):
        raise FileError(f"{file}: axis {axis} has the step {step:g} (CDELT{axis}, CD{axis}_{axis})")
    return step


def grid_of(file: str, header: Any, axes: dict[Role, int]) -> Grid:
    """Pixel, size and centre of the images; warns where pixels are not where a SIN projection has them.

    The centre is what lies at pixel (Ny // 2, Nx // 2), whatever the reference pixel and the projection are.
    """
    from astropy.io.fits import Header
    from astropy.wcs import WCS

    plain, sizes, steps = Header(), {}, {}
    for new, axis in ((1, axes["x"]), (2, axes["y"])):
        steps[new], sizes[new] = scale_of(file, header, axis), int(header[f"NAXIS{axis}"])
        ctype = str(header[f"CTYPE{axis}"]).strip().upper()
        if len(ctype) < 8:
            if new == 1:
                said = f"{file}: CTYPE{axis} = '{ctype}' names no projection: taken as SIN"
                warnings.warn(said, InstrumentWarning, stacklevel=5)
            ctype = f"{ctype:-<5}SIN"
        plain[f"CTYPE{new}"], plain[f"CDELT{new}"] = ctype, steps[new]
        unit = str(header.get(f"CUNIT{axis}", "")).strip().lower()
        plain[f"CUNIT{new}"] = "deg" if unit in ("", "degree", "degrees") else unit
        for key in ("CRVAL", "CRPIX"):
            plain[f"{key}{new}"] = number(file, header, f"{key}{axis}")
        plain.update({f"PV{new}_{m}": header[f"PV{axis}_{m}"] for m in range(5) if f"PV{axis}_{m}" in header})
    plain.update({k: header[k] for k in ("RADESYS", "RADECSYS", "EQUINOX", "LONPOLE", "LATPOLE") if k in header})
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # of old keywords that astropy mends
            wcs = WCS(plain)
            wcs.wcs.set()
            dx, dy = (float(s) for s in np.deg2rad(np.diag(wcs.pixel_scale_matrix)))
            nx, ny, flip_x, flip_y = sizes[1], sizes[2], dx > 0, dy < 0
            if abs(abs(dx) - abs(dy)) > PARALLEL * abs(dy):
                size = " x ".join(f"{60 * abs(np.rad2deg(d)):.6g}'" for d in (dx, dy))
                raise FileError(f"{file}: pixels are {size} (axes {axes['x']} and {axes['y']}): regrid to square ones")
            # centre, corners, middles of the edges
            x = np.array([nx // 2, 0, 0, 0, nx // 2, nx // 2, nx - 1, nx - 1, nx - 1])
            y = np.array([ny // 2, 0, ny // 2, ny - 1, 0, ny - 1, 0, ny // 2, ny - 1])
            sky = wcs.pixel_to_world(nx - 1 - x if flip_x else x, ny - 1 - y if flip_y else y).icrs
    except FileError:
        raise
    except Exception as error:  # wcslib has many of its own
        raise FileError(f"{file}: the coordinates on the sky cannot be read: {one_line(error)}") from None
    ra, dec = np.asarray(sky.ra.rad), np.asarray(sky.dec.rad)
    if not np.isfinite([ra[0], dec[0]]).all():
        raise FileError(f"{file}: the centre pixel is not on the sky: CRPIX, CRVAL or CDELT are wrong")
    centre = Direction(float(ra[0]), float(dec[0]))
    vectors = np.stack([np.cos(dec) * np.cos(ra), np.cos(dec) * np.sin(ra), np.sin(dec)], axis=-1)
    found = lmn(vectors, centre)[:, :2] / abs(dy)
    off = float(np.nanmax(np.hypot(found[:, 0] + (x - nx // 2), found[:, 1] - (y - ny // 2))))
    what = f"pixels lie up to {off:.2g} pixels from where a SIN projection about the centre has them"
    if off > 0.05 * np.hypot(nx, ny) / 2 and off > 0.5:
        raise FileError(f"{file}: {what}: regrid to one with the reference pixel in the middle, north up")
    if off > 0.5:
        warnings.warn(f"{file}: {what}", InstrumentWarning, stacklevel=5)
    return Grid((ny, nx), abs(dy), None if header.get("NOCENTRE") is True else centre, flip_x, flip_y)


def frequencies_of(file: str, header: Any, axis: int) -> Float:
    """Frequencies in Hz of an axis FREQ (F,); it must be linear, in Hz, kHz, MHz or GHz."""
    ctype, unit = str(header[f"CTYPE{axis}"]).strip().upper(), str(header.get(f"CUNIT{axis}", "")).strip()
    if ctype.partition("-")[2].strip("-") not in FRAMES:
        raise FileError(f"{file}: axis {axis} is {ctype}, which is not linear: give frequencies=")
    if unit.upper() not in UNITS:
        raise FileError(f"{file}: CUNIT{axis} = '{unit}' is not Hz, kHz, MHz or GHz")
    first, reference = number(file, header, f"CRVAL{axis}"), number(file, header, f"CRPIX{axis}", 1.0)
    channels = int(header[f"NAXIS{axis}"])
    try:
        step = scale_of(file, header, axis)
    except FileError:
        if channels > 1 or reference != 1:
            raise
        step = 0.0  # one channel: some write a step of 0
    found = (first + (np.arange(1, channels + 1) - reference) * step) * UNITS[unit.upper()]
    if not (found > 0).all():
        raise FileError(f"{file}: axis {axis} (FREQ) has {found.min():.6g} Hz: CRVAL{axis} or CDELT{axis} is wrong")
    return np.asarray(found)


def stokes_of(file: str, header: Any, axis: int | None) -> list[str] | None:
    """Names of the planes of an axis STOKES, or of the keyword STOKES; None where neither is there."""
    if axis is None:
        name = str(header.get("STOKES", "")).strip().upper()
        return [name] if name in ("I", "Q", "U", "V") else None
    first, reference = number(file, header, f"CRVAL{axis}"), number(file, header, f"CRPIX{axis}", 1.0)
    steps = np.arange(1, int(header[f"NAXIS{axis}"]) + 1) - reference
    # one plane: some write a step of 0
    codes = first + steps * (scale_of(file, header, axis) if steps.any() else 0.0)
    names = [CODES.get(round(code), "") if abs(code - round(code)) < 1e-3 else "" for code in codes]
    for code, name in zip(codes, names, strict=True):
        if name not in ("I", "Q", "U", "V"):
            what = f"{name or 'what is not known'} (code {code:g})"
            raise FileError(f"{file}: axis {axis} (STOKES) has {what}: make I, Q, U, V of it, or give stokes=")
    return names
