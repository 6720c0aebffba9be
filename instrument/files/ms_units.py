"""Units and frames that columns of a Measurement Set are in: values as they are here, or one line of what is not."""

from __future__ import annotations

from typing import Any

import numpy as np

from instrument.errors import FileError, InputError, warn
from instrument.files.ms_tables import column
from instrument.files_in import harmless
from instrument.sky.tables import unit_scale
from instrument.units import Float

EQUATORIAL = ("J2000", "ICRS")  # of directions: 0.02 arcsec apart
SCALES = {"UTC": "utc", "TAI": "tai", "IAT": "tai", "TT": "tt", "TDT": "tt", "ET": "tt"}  # casacore's, astropy's
CODES = {0: "J2000", 4: "B1950", 8: "GALACTIC", 10: "AZEL", 21: "ICRS"}  # of directions, in casacore's own numbers
LATEST_S = 2e5 * 86400.0  # the year 2406


def in_unit(table: Any, name: str, values: Any, unit: str, path: str) -> Any:
    """Values (..., n) of a column in a unit, from the one, or those of each of n, that its keywords name.

    Without such keywords they are in the unit of the definition. Raises `InputError` for units of another kind.
    """
    words = table.getcolkeywords(name)
    if "VariableUnits" in words:
        raise InputError(f"{path}: {name} has a unit of its own in each row: write it in {unit}")
    known = words.get("QuantumUnits", words.get("UNIT", unit))
    known = [known] if isinstance(known, str) else [str(k) for k in known]
    if all(k in (unit, "") for k in known):
        return values
    factors = np.array([_factor(k, unit, f"{path}: {name}") for k in known])
    if len(factors) > 1 and (np.ndim(values) == 0 or np.shape(values)[-1] != len(factors)):
        raise InputError(f"{path}: {name} has {len(factors)} units, {', '.join(map(harmless, known))}: this takes one")
    return np.asarray(values) * (factors if len(factors) > 1 else factors[0])


def _factor(known: str, unit: str, what: str) -> float:
    scale = unit_scale(known or unit, unit)
    if scale is None:
        raise InputError(f"{what} is in '{harmless(known, 40)}', which is no unit of {unit}: convert the set")
    return scale


def jansky(known: Any, what: str) -> float:
    """How many Jy one of a unit of visibilities is, or of a list of one, 1 where it says nothing.

    What is "uncalib" is taken as Jy, with a warning. Raises `InputError` for units of another kind, and several.
    """
    names = {known} if isinstance(known, str) else {str(name) for name in known}
    if len(names) > 1:
        raise InputError(f"{what} has units of its correlations, {', '.join(map(harmless, sorted(names)))}: write Jy")
    name = "".join(names).strip()
    if name.lower() == "uncalib":
        warn(f"{what}: its visibilities are not calibrated: they are taken as Jy")
    return 1.0 if name.upper() in ("", "JY", "UNCALIB") else _factor(name, "Jy", what)


def unit_of(table: Any, name: str, path: str) -> Any:
    """The unit that a column of visibilities has by its keywords, "" for none."""
    words = table.getcolkeywords(name)
    if "VariableUnits" in words:
        raise InputError(f"{path}: {name} has a unit of its own in each row: write it in Jy")
    return words.get("QuantumUnits", words.get("UNIT", ""))


def frame_named(table: Any, name: str, row: int, usual: str, path: str) -> str:
    """The frame of a column at one row: that of the column, or the one that its rows have each."""
    known = table.getcolkeywords(name).get("MEASINFO", {})
    if "VarRefCol" not in known:
        return str(known.get("Ref", usual)).upper()
    other = str(known["VarRefCol"])
    if other not in table.columns():
        raise FileError(
            f"{path}: the frame of {name} is to stand in a column {harmless(other, 40)}, which is not there"
        )
    told = column(table, other, slice(row, row + 1))[0]
    if isinstance(told, str):
        return told.upper()
    names = dict(zip(map(int, known.get("TabRefCodes", ())), known.get("TabRefTypes", ()), strict=False)) or CODES
    return str(names.get(int(told), f"casacore's {told}")).upper()


def cell(table: Any, name: str, row: int, path: str) -> Any:
    """The value of a column in one row; raises `FileError` for a row that is not there."""
    if not 0 <= row < table.nrow():
        raise FileError(f"{path}: row {row} is asked for {name}, of {table.nrow()} that are there: it is no whole set")
    return column(table, name, slice(row, row + 1))[0]


def direction_at(table: Any, name: str, row: int, path: str) -> tuple[float, float]:
    """Right ascension and declination, rad, of a row; raises `InputError` for frames that are not fixed and equatorial.

    B1950 and galactic are not converted: the axes of UVW would be left in theirs.
    """
    known = frame_named(table, name, row, "J2000", path)
    if known not in EQUATORIAL:
        raise InputError(f"{path}: {name} of the field is in {known}, this takes J2000 or ICRS: convert the set")
    found = np.ravel(cell(table, name, row, path))[:2]
    return angles(in_unit(table, name, found, "rad", path), f"{path}: {name} of the field")


def angles(found: Any, what: str) -> tuple[float, float]:
    """Right ascension in 0 to 2 pi, and declination; raises `FileError` for what is none."""
    ra, dec = map(float, found) if len(found) == 2 else (np.nan, np.nan)
    if not (np.isfinite(ra) and abs(dec) <= np.pi / 2 + 1e-9):
        raise FileError(f"{what} is {ra:g}, {dec:g} rad: no direction")
    return ra % (2 * np.pi), dec


def utc(table: Any, slots_s: Float, path: str) -> Float:
    """Times (T,), MJD seconds, UTC, of those that the column TIME has in its own scale."""
    known = frame_named(table, "TIME", 0, "UTC", path)
    if "VarRefCol" in table.getcolkeywords("TIME").get("MEASINFO", {}) or known not in SCALES:
        raise InputError(f"{path}: TIME is in {known}, this takes UTC, TAI or TT of all rows: convert the set")
    if SCALES[known] == "utc":
        return slots_s
    from astropy.time import Time

    from instrument.observe.sampling import mjd_seconds

    return mjd_seconds(Time(slots_s // 86400, (slots_s % 86400) / 86400, format="mjd", scale=SCALES[known]))
