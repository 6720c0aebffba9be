"""Frequencies of a FITS cube: a linear axis, an axis -TAB with its table, or a column of a table of beams."""

from __future__ import annotations

from typing import Any

import numpy as np

from instrument.errors import FileError
from instrument.files.fits_axes import ABSENT, Notes, matrix_of, number, scale_of
from instrument.units import Float

FRAMES = {"", "LSR", "LSRK", "LSRD", "BAR", "HEL", "GEO", "TOP", "OBS"}  # AIPS: FREQ-LSR; linear all the same
UNITS = {"": 1.0, "HZ": 1.0, "KHZ": 1e3, "MHZ": 1e6, "GHZ": 1e9}
LOWEST, HIGHEST = 1e6, 1e13  # Hz: from the ground nothing is imaged below, and no radio telescope sees above
FINEST = 1e-7  # channels closer than this, relative: 15 Hz at 150 MHz, where lines of cold gas are 1e-6 wide


def frequencies_of(file: str, header: Any, axis: int, hdus: Any, notes: Notes) -> Float:
    """Frequencies in Hz of an axis FREQ (F,): linear in Hz, kHz, MHz or GHz, or of a table (FREQ-TAB)."""
    ctype, unit = str(header[f"CTYPE{axis}"]).strip().upper(), str(header.get(f"CUNIT{axis}", "")).strip()
    kind = ctype.partition("-")[2].strip("-")
    if unit.upper() not in UNITS:
        raise FileError(f"{file}: CUNIT{axis} = '{unit}' is not Hz, kHz, MHz or GHz")
    channels = int(header[f"NAXIS{axis}"])
    if kind == "TAB":
        found = _tabulated(file, header, axis, channels, hdus)
    elif kind not in FRAMES:
        raise FileError(f"{file}: axis {axis} is {ctype}, which is not linear: give frequencies=")
    else:
        found = _linear(file, header, axis, channels)
    frame = str(header.get("SPECSYS", kind if kind != "TAB" else "")).strip().upper()
    if frame and frame not in ("TOPOCENT", "TOP", "OBS"):
        # the Earth moves at 30 km/s about the Sun, which moves at 20 km/s
        why = "frequencies are taken as they stand; at the telescope they differ by up to 1.7e-4"
        notes.unused.append((f"SPECSYS = '{frame}'", why))
    return plausible(
        file,
        found * UNITS[unit.upper()],
        f"axis {axis} (FREQ)",
        f"CUNIT{axis} = '{unit}'" if unit else f"CUNIT{axis} is missing",
    )


def plausible(file: str, freq_hz: Float, what: str, unit: str) -> Float:
    """The frequencies (F,); raises `FileError` where they are none that a radio telescope sees."""
    wrong = ~((freq_hz >= LOWEST) & (freq_hz <= HIGHEST))
    if wrong.any():
        said = f"{what} has {freq_hz[wrong][0]:.6g} Hz ({unit}), not 1 MHz to 10 THz"
        raise FileError(f"{file}: {said}: correct CRVAL, CDELT and CUNIT, or give frequencies=")
    steps = np.abs(np.diff(freq_hz))
    steps = steps[steps > 0]
    if steps.size and steps.max() < FINEST * freq_hz.max():
        said = f"{what} has {len(freq_hz)} channels at most {steps.max():.3g} Hz apart at {freq_hz.max() / 1e6:.6g} MHz"
        raise FileError(f"{file}: {said}: if CDELT has another unit than CRVAL, give frequencies=")
    return freq_hz


def _linear(file: str, header: Any, axis: int, channels: int) -> Float:
    first, pixel = number(file, header, f"CRVAL{axis}"), header.get(f"CRPIX{axis}")
    step = header.get(f"CDELT{axis}")
    if step is None and not any(i == axis for _, i, _ in matrix_of(header)):
        if channels > 1:
            raise FileError(f"{file}: CDELT{axis} of FREQ is missing (FITS then means 1 Hz): give frequencies=")
        return np.array([first])
    if pixel is None and (channels > 1 or step):
        raise FileError(f"{file}: CRPIX{axis} of FREQ is missing ({ABSENT}): give frequencies=")
    reference = 1.0 if pixel is None else number(file, header, f"CRPIX{axis}")
    try:
        width = scale_of(file, header, axis)
    except FileError:
        if channels > 1 or reference != 1:
            raise
        width = 0.0  # one channel: some write a step of 0
    return np.asarray(first + (np.arange(1, channels + 1) - reference) * width)


def _tabulated(file: str, header: Any, axis: int, channels: int, hdus: Any) -> Float:
    """Coordinates of an axis -TAB (FITS paper III, section 6): a column of a table of one row in the same file."""
    where = f"axis {axis} (FREQ-TAB)"
    names = [str(header.get(f"PS{axis}_{m}", "")).strip() for m in range(3)]
    version = int(number(file, header, f"PV{axis}_1", 1.0))
    table = next(
        (h for h in hdus if not h.is_image and h.name == names[0].upper() and h.header.get("EXTVER", 1) == version),
        None,
    )
    if table is None or names[1] not in table.columns.names:
        asked = f"table '{names[0]}', column '{names[1]}' (PS{axis}_0, PS{axis}_1)"
        raise FileError(f"{file}: {where}: there is no {asked}: give frequencies=")
    values = np.asarray(table.data[names[1]], float).ravel()
    index = np.arange(1.0, len(values) + 1)
    if names[2]:
        if names[2] not in table.columns.names:
            raise FileError(f"{file}: {where}: there is no column '{names[2]}' (PS{axis}_2): give frequencies=")
        index = np.asarray(table.data[names[2]], float).ravel()
    if len(values) < 1 or len(index) != len(values) or number(file, header, f"PV{axis}_3", 1.0) != 1:
        raise FileError(f"{file}: {where}: its table is not one of a single axis: give frequencies=")
    steps = np.arange(1, channels + 1) - number(file, header, f"CRPIX{axis}", 1.0)
    place = number(file, header, f"CRVAL{axis}") + steps * (scale_of(file, header, axis) if steps.any() else 0.0)
    order = np.argsort(index)
    rising = index[order]
    if (np.diff(rising) <= 0).any() or place.min() < rising[0] - 1e-6 or place.max() > rising[-1] + 1e-6:
        span = f"{rising[0]:g} to {rising[-1]:g}"
        raise FileError(f"{file}: {where}: {channels} channels do not lie in its table ({span}): give frequencies=")
    return np.asarray(np.interp(place, rising, values[order]))
