"""Which channels of a cube: indices, flags, bands, and the text of the command line that names them."""

from __future__ import annotations

import re
from typing import Any

import numpy as np

from instrument.errors import InputError
from instrument.units import Bool, Float, Int, to_si

RANGE = re.compile(r"\s*(\d{1,9})\s*(?:-\s*(\d{1,9})\s*)?")


def channel_index(keep: Any, count: int, name: str = "channels") -> Int:
    """Indices (N,) of some of `count` channels: whole numbers (negative from the end), a slice, or (F,) booleans."""
    if isinstance(keep, slice):
        try:
            return np.arange(count)[keep]
        except TypeError:
            raise InputError(f"{name} = {keep} is no slice of whole numbers") from None
    given = np.asarray(keep)
    if given.dtype == bool and given.shape != (count,):
        raise InputError(f"{name} are {given.size} booleans of shape {given.shape}, needed one for each of {count}")
    if given.dtype == bool:
        return np.flatnonzero(given)
    given = np.atleast_1d(given)
    if given.ndim != 1 or (given.size and given.dtype.kind not in "iu"):
        raise InputError(f"{name} = {keep!r} are not whole numbers, a slice, or a boolean a channel")
    if (wrong := (given < -count) | (given >= count)).any():
        raise InputError(f"{name}: {given[wrong][0]} is not one of the channels 0 to {count - 1}")
    return given.astype(int) % count


def channel_numbers(text: str, count: int, name: str = "channels") -> Int:
    """Channels of text such as "3,7-9" (counted from 0, both ends included), each once, in order (N,)."""
    found: set[int] = set()
    for part in text.split(","):
        match = RANGE.fullmatch(part)
        if match is None:
            raise InputError(f"{name} {text}: write channels as 3,7-9, counted from 0")
        first, last = int(match[1]), int(match[2] or match[1])
        if last < first or last >= count:
            raise InputError(f"{name} {text}: {part.strip()} is not within the channels 0 to {count - 1}")
        found.update(range(first, last + 1))
    return np.array(sorted(found))


def in_band(freq_hz: Float, band: Any) -> Bool:
    """Which frequencies (F,) lie in a band, two quantities or text such as "134 MHz,166 MHz", both ends included."""
    ends = [part.strip() for part in band.split(",")] if isinstance(band, str) else band
    low, high = (to_si(end, "Hz", "band") for end in ends) if _pair(ends) else (np.nan, np.nan)
    if not (np.ndim(low) == np.ndim(high) == 0 and 0 <= low < high):
        raise InputError(f"band = {band} must be two frequencies with their unit, the lower first: '134 MHz,166 MHz'")
    # 1e-9: an end written in MHz is that of the header in Hz
    inside = (freq_hz >= low * (1 - 1e-9)) & (freq_hz <= high * (1 + 1e-9))
    if not inside.any():
        have = f"{freq_hz.min() / 1e6:.6g} to {freq_hz.max() / 1e6:.6g} MHz"
        raise InputError(f"band = {low / 1e6:.6g} to {high / 1e6:.6g} MHz holds no channel of the cube, {have}")
    return np.asarray(inside)


def _pair(ends: Any) -> bool:
    try:
        return len(ends) == 2
    except TypeError:
        return False
