"""Directions in words, "08h13m36.0s +48d13m03s" or "123.4deg -48.2deg", as astropy reads them, to the last bit.

astropy takes half a second of every process to load what knows all frames and spellings. These two spellings are read
here; all else, and what lies outside of the usual ranges, is astropy's. tests/unit/test_written.py compares them.
"""

from __future__ import annotations

import re

import numpy as np

NUMBER = r"(\d+(?:\.\d*)?|\.\d+)"
HOURS = re.compile(r"\+?(\d+)h(?:(\d+)m(?:" + NUMBER + r"s)?)?")
SIGNED = re.compile(r"([+-]?)(\d+)d(?:(\d+)m(?:" + NUMBER + r"s)?)?")
DEGREES = re.compile(r"([+-]?)" + NUMBER + r"d(?:eg)?")
HOUR_DEG = float(np.pi / 12 / (np.pi / 180))  # astropy's, by way of radians: 14.999999999999998


def icrs_degrees(text: str) -> tuple[float, float] | None:
    """Right ascension and declination in deg of a direction in words; `None` where astropy must be asked."""
    parts = text.split()
    if len(parts) != 2 or not text.isascii():
        return None
    hours, ra, dec = HOURS.fullmatch(parts[0]), DEGREES.fullmatch(parts[0]), _angle(SIGNED.fullmatch(parts[1]))
    if dec is None and (found := DEGREES.fullmatch(parts[1])):
        dec = _signed(found[1], float(found[2]))
    right = _sum(*hours.groups()) if hours else float(ra[2]) if ra and not ra[1] else None
    if right is None or dec is None or right >= (24 if hours else 360) or abs(dec) > 90:
        return None
    return right * HOUR_DEG if hours else right, dec


def _angle(found: re.Match[str] | None) -> float | None:
    if found is None:
        return None
    size = _sum(*found.groups()[1:])
    return None if size is None else _signed(found[1], size)


def _signed(sign: str, size: float) -> float:
    return -size if sign == "-" else size


def _sum(whole: str, minutes: str | None, seconds: str | None) -> float | None:
    """Of sexagesimal parts, in astropy's order; `None` where minutes or seconds are 60 or more."""
    value = float(whole)
    for part, count in ((minutes, 60.0), (seconds, 3600.0)):
        if part is not None:
            if float(part) >= 60:
                return None
            value += float(part) / count
    return value
