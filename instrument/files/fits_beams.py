"""Beams of the channels of a FITS cube: a table BEAMS, BMAJ1 and so on, BMAJ, or the history that AIPS writes."""

from __future__ import annotations

import re
from typing import Any

import numpy as np

from instrument.errors import FileError
from instrument.files.fits_axes import Notes, number
from instrument.files.fits_sky import Grid
from instrument.units import Bool, Float

KEYS = ("BMAJ", "BMIN", "BPA")
AIPS = re.compile(r"AIPS\s+CLEAN\s+BMAJ=\s*(\S+)\s+BMIN=\s*(\S+)\s+BPA=\s*(\S+)")
REMEDY = "give psf=Psf.gaussian(major, minor, angle)"


def beams_of(file: str, header: Any, table: Any, channels: int, grid: Grid, notes: Notes) -> Float:
    """BMAJ, BMIN, BPA of every channel in rad (3, F), NaN where not given.

    Raises `FileError` for a beam that is wider than the image or narrower than a pixel: its unit is not what it says.
    """
    first = next((k for k in (0, 1) if f"BMAJ{k}" in header), None)
    if table is not None and {"BMAJ", "BMIN"} <= set(table.columns.names):
        source, found = "the table BEAMS", _of_table(file, header, table, channels, grid, notes)
    elif first is not None:
        if missing := [f"BMAJ{k}" for k in range(first, first + channels) if f"BMAJ{k}" not in header]:
            raise FileError(f"{file}: BMAJ{first} is there but {missing[0]} is not, of {channels} channels: {REMEDY}")
        source, rows = f"BMAJ{first}", [_row(file, header, str(k)) for k in range(first, first + channels)]
        found = np.deg2rad(np.array(rows).T)
    elif "BMAJ" in header:
        source, found = "BMAJ", np.repeat(np.deg2rad(_row(file, header, ""))[:, None], channels, axis=1)
        if header.get("CASAMBM") is True:
            why = "there is no table BEAMS: BMAJ is taken for every channel"
            notes.unused.append(("CASAMBM = T (a beam a channel)", why))
    else:
        source, found = "its history", _of_history(file, header, channels, notes)
        if header.get("CASAMBM") is True and np.isnan(found).all():
            why = f"there is no table BEAMS, and no beam is known: {REMEDY}"
            notes.unused.append(("CASAMBM = T (a beam a channel)", why))
    return _plausible(file, found, source, grid)


def _row(file: str, header: Any, index: str) -> Float:
    """BMAJ, BMIN and BPA of the header in deg (3,)."""
    major = number(file, header, f"BMAJ{index}")
    return np.array([major, number(file, header, f"BMIN{index}", major), number(file, header, f"BPA{index}", 0.0)])


def _of_history(file: str, header: Any, channels: int, notes: Notes) -> Float:
    """The last beam that AIPS, and MIRIAD after it, left in the history (3, F); NaN where there is none."""
    lines = [str(line) for line in header.get("HISTORY", [])]
    for match in reversed([m for line in lines if (m := AIPS.search(line))]):
        try:
            widths = np.array([float(x) for x in match.groups()])
        except ValueError:
            continue
        if np.isfinite(widths).all():
            notes.warned.append(f"{file}: the beam is that of its history (AIPS CLEAN BMAJ), for every channel")
            return np.repeat(np.deg2rad(widths)[:, None], channels, axis=1)
    return np.full((3, channels), np.nan)


def _of_table(file: str, header: Any, table: Any, channels: int, grid: Grid, notes: Notes) -> Float:
    rows, names = table.data, table.columns.names
    if {"CHAN", "POL"} <= set(names):  # CASA: one row a channel and Stokes parameter
        every = rows[np.lexsort((rows["CHAN"], rows["POL"]))]
        rows = every[every["POL"] == every["POL"].min()]
        if len(every) > len(rows) and len(every) % len(rows) == 0:
            widths = np.asarray(every["BMAJ"], float).reshape(-1, len(rows))
            if not np.allclose(widths, widths[0], rtol=1e-3, atol=0, equal_nan=True):
                first = int(rows["POL"][0])
                notes.warned.append(f"{file}: beams differ between Stokes parameters: those of POL {first} are taken")
    if len(rows) != channels:
        raise FileError(f"{file}: the table BEAMS has {len(rows)} beams, the axis FREQ {channels} channels")
    values = [np.asarray(rows[k], float) if k in names else np.zeros(channels) for k in KEYS]
    units = [str(table.columns[k].unit or "") if k in names else "deg" for k in KEYS]
    if not units[0]:
        units[:2] = [_guessed(file, header, values[0], grid, notes)] * 2
    return np.stack(
        [
            value * _radians(file, unit or ("deg" if k == "BPA" else units[0]))
            for k, value, unit in zip(KEYS, values, units, strict=True)
        ]
    )


def _guessed(file: str, header: Any, major: Float, grid: Grid, notes: Notes) -> str:
    """The unit of widths without TUNIT: deg as FITS has it or arcsec as CASA, whichever fits the image alone."""
    fits = []
    for unit, scale in (("deg", 1.0), ("arcsec", 1 / 3600)):
        wide, narrow = _odd(np.deg2rad(major * scale), grid)
        given = float(header.get("BMAJ") or np.nan) if isinstance(header.get("BMAJ"), float) else np.nan
        unlike = np.isfinite(given) and not 0.2 < np.nanmedian(major) * scale / given < 5
        if not (wide.any() or narrow.any() or unlike):
            fits.append(unit)
    if len(fits) != 1:
        said = "in deg and in arcsec alike" if fits else "neither in deg nor in arcsec"
        raise FileError(f"{file}: the table BEAMS has no TUNIT for BMAJ, and fits the image {said}: {REMEDY}")
    notes.warned.append(f"{file}: the table BEAMS has no TUNIT: BMAJ and BMIN are taken as {fits[0]}, which fits")
    return fits[0]


def _radians(file: str, text: str) -> float:
    from astropy import units as u

    unit = u.Unit(text, parse_strict="silent")
    if not unit.is_equivalent(u.rad):
        raise FileError(f"{file}: the table BEAMS has the unit '{text}': needed deg, arcsec or rad")
    return float(unit.to(u.rad))


def _odd(major_rad: Float, grid: Grid) -> tuple[Bool, Bool]:
    """Which beams (F,) are wider than the image is across, and which are narrower than a pixel; 0 is none."""
    across = min(float(np.hypot(*grid.shape)) * grid.pixel_rad, np.pi)
    with np.errstate(invalid="ignore"):
        return major_rad > across, (major_rad > 0) & (major_rad < grid.pixel_rad * (1 - 1e-6))


def _plausible(file: str, beams: Float, source: str, grid: Grid) -> Float:
    """The beams (3, F), the wider axis first, NaN in channels where some have a width and they have none."""
    major, minor, angle = beams
    with np.errstate(invalid="ignore"):
        if (bad := (major < 0) | (minor < 0) | np.isinf(major) | np.isinf(minor)).any():
            k = int(np.flatnonzero(bad)[0])
            raise FileError(f"{file}: {source} has a beam of {np.rad2deg(major[k]):.4g} deg (channel {k}): {REMEDY}")
        crossed = minor > major
    major, minor = np.where(crossed, minor, major), np.where(crossed, major, minor)
    angle = np.where(crossed, angle + np.pi / 2, angle)
    for wrong, what, limit in zip(
        _odd(major, grid),
        ("wider than the image, {} across", "narrower than a pixel of {}"),
        (np.hypot(*grid.shape) * grid.pixel_rad, grid.pixel_rad),
        strict=True,
    ):
        if wrong.any():
            k = int(np.flatnonzero(wrong)[0])
            said = what.format(f"{np.rad2deg(limit):.4g} deg")
            beam = f"{source} has a beam of {np.rad2deg(major[k]):.4g} deg (channel {k})"
            raise FileError(f"{file}: {beam}, {said}: in another unit? {REMEDY}")
    none = ~((major > 0) & (minor > 0))
    if none.any() and not none.all():
        return np.where(none, np.nan, np.stack([major, minor, angle]))
    return np.stack([major, minor, angle])
