"""The axes of a FITS cube: which is which, their steps, Stokes parameters."""

from __future__ import annotations

import re
from dataclasses import dataclass, field
from typing import Any, Literal

import numpy as np

from instrument.errors import FileError

Role = Literal["x", "y", "freq", "stokes"]
ROLES: dict[str, Role] = {"RA": "x", "DEC": "y", "FREQ": "freq", "STOKES": "stokes"}
# FITS paper III, and what AIPS called them before
SPECTRAL = {
    "VRAD": "a radio velocity", "VOPT": "an optical velocity", "VELO": "a velocity", "FELO": "a velocity",
    "VELOCITY": "a velocity", "ZOPT": "a redshift", "BETA": "a velocity", "WAVE": "a wavelength",
    "AWAV": "a wavelength in air", "WAVN": "a wavenumber", "ENER": "an energy",
}  # fmt: skip
CODES = {1: "I", 2: "Q", 3: "U", 4: "V", -1: "RR", -2: "LL", -3: "RL", -4: "LR", -5: "XX", -6: "YY", -7: "XY", -8: "YX"}
PARALLEL = 1e-4  # relative: 0.05 of a pixel over 480
ABSENT = "FITS then means 0, most programs 1"  # a CRPIX that is not there


@dataclass
class Notes:
    """What is to be said about a file once it is closed: warnings, and what was not used with the reason."""

    warned: list[str] = field(default_factory=list)
    unused: list[tuple[str, str]] = field(default_factory=list)


def number(file: str, header: Any, key: str, default: float | None = None) -> float:
    """The finite number of a keyword; raises `FileError` where it is none, or missing without a default."""
    value = header.get(key, default)
    if value is None:
        raise FileError(f"{file}: {key} is missing")
    if isinstance(value, bool) or not isinstance(value, int | float):
        raise FileError(f"{file}: {key} = {str(value)[:40]!r} is not a number")
    if not abs(float(value)) < 1e300:
        raise FileError(f"{file}: {key} = {value} is not finite")
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


def matrix_of(header: Any) -> dict[tuple[str, int, int], str]:
    """Keywords of the matrix of axes by kind, row and column: PC1_2, PC01_02 (CASA), PC001002 (AIPS), CD1_2."""
    found = {}
    for key in header:
        if match := re.fullmatch(r"(PC|CD)(?:(\d+)_(\d+)|(\d{3})(\d{3}))", key):
            found[match[1], int(match[2] or match[4]), int(match[3] or match[5])] = key
    return found


def scale_of(file: str, header: Any, axis: int, default: float | None = 1.0) -> float:
    """Step of an axis in its own unit, of CDELT and PC or of CD; raises `FileError` where axes are turned.

    `default` is what a CDELT that is not there means; None refuses.
    """
    matrix = matrix_of(header)
    own = {kind: matrix.get((kind, axis, axis)) for kind in ("PC", "CD")}
    if own["CD"]:
        step = number(file, header, own["CD"])
    elif any(kind == "CD" for kind, _, _ in matrix):  # some write CD for the sky alone, and CDELT for the rest
        step = number(file, header, f"CDELT{axis}", 0.0)
    else:
        step = number(file, header, f"CDELT{axis}", default) * (number(file, header, own["PC"]) if own["PC"] else 1.0)
    for (kind, i, j), key in matrix.items():
        if i == j or axis not in (i, j):
            continue
        value = number(file, header, key)
        if abs(value) > PARALLEL * (abs(step) if kind == "CD" else 1):
            raise FileError(f"{file}: {key} = {value:g}: axes {i} and {j} are turned; regrid, north up")
    if not (np.isfinite(step) and step):
        raise FileError(f"{file}: axis {axis} has the step {step:g} (CDELT{axis}, CD{axis}_{axis})")
    return step


def turned_round(file: str, header: Any, axes: dict[Role, int]) -> bool:
    """Whether CROTA turns the image by 180 deg, before there was PC; raises `FileError` for any other turn."""
    angles = {axis: number(file, header, f"CROTA{axis}", 0.0) for axis in axes.values()}
    said = {axis: angle for axis, angle in angles.items() if abs(np.sin(np.deg2rad(angle / 2))) > PARALLEL}
    if not said:
        return False
    axis, angle = next(iter(said.items()))
    if matrix_of(header):
        raise FileError(
            f"{file}: CROTA{axis} = {angle:g} deg beside PC or CD, which say the same: take out one of them"
        )
    # CROTA of the latitude turns both; the other, if written at all, says the same
    latitude = angles[axes["y"]] or angles[axes["x"]]
    half = abs(np.cos(np.deg2rad(latitude / 2))) < PARALLEL
    if half and set(said) <= {axes["x"], axes["y"]} and all(abs(a - latitude) % 360 < 0.01 for a in said.values()):
        return True
    raise FileError(f"{file}: CROTA{axis} = {angle:g} deg: the image is turned; regrid, north up")


def stokes_of(file: str, header: Any, axis: int | None) -> list[str] | None:
    """Names of the planes of an axis STOKES, or of the keyword STOKES; None where neither is there.

    Correlations (RR, XX) come back by their names, other codes as "code 5".
    """
    if axis is None:
        name = str(header.get("STOKES", "")).strip().upper()
        return [name] if name in ("I", "Q", "U", "V") else None
    planes = int(header[f"NAXIS{axis}"])
    first, pixel = number(file, header, f"CRVAL{axis}"), header.get(f"CRPIX{axis}")
    if pixel is None and (planes > 1 or header.get(f"CDELT{axis}")):
        raise FileError(f"{file}: CRPIX{axis} of STOKES is missing ({ABSENT}): give stokes=, such as stokes='Q'")
    steps = np.arange(1, planes + 1) - (1.0 if pixel is None else number(file, header, f"CRPIX{axis}"))
    # one plane: some write a step of 0
    codes = first + steps * (scale_of(file, header, axis) if steps.any() else 0.0)
    return [CODES.get(round(c), f"code {c:g}") if abs(c - round(c)) < 1e-3 else f"code {c:g}" for c in codes]


def only_iquv(file: str, names: list[str], axis: int | None) -> list[str]:
    """The names; raises `FileError` unless all are I, Q, U, V."""
    for name in names:
        if name not in ("I", "Q", "U", "V"):
            raise FileError(f"{file}: axis {axis} (STOKES) has {name}: make I, Q, U, V of it, or give stokes=")
    return names
