"""What the header of one FITS file says: axes, grid, frequencies, Stokes parameters, unit, beams; what is unused."""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from instrument.errors import FileError, InputError, RefusedError
from instrument.files.fits_axes import Notes, Role, axes_of, only_iquv, stokes_of
from instrument.files.fits_beams import beams_of
from instrument.files.fits_open import opened, units_of
from instrument.files.fits_sky import Grid, grid_of
from instrument.files.fits_spectral import frequencies_of, plausible
from instrument.files_in import harmless
from instrument.image.cube import Unit
from instrument.memory import afford
from instrument.units import Float

# with spaces, dots and asterisks left out; of BUNIT in capitals only what cannot be read in two ways
FLUX = re.compile(r"([mµuμ]?)jy(?:/|per)?(?:(beam|bm)|(pixel|pix))(?:-1|\^-1)?|(?:beam|bm)-1([mµuμ]?)jy")
PREFIX = {"": 1.0, "m": 1e-3, "u": 1e-6, "µ": 1e-6, "μ": 1e-6}
MOST_CHANNELS = 1 << 20
KELVIN = {"K": 1.0, "mK": 1e-3, "uK": 1e-6, "µK": 1e-6, "μK": 1e-6}


@dataclass
class Part:
    """What the header of one file says; the data are read later."""

    path: Path
    hdu: int
    axes: dict[Role, int]
    grid: Grid
    channels: int
    freq_hz: Float | None
    stokes: list[str]
    header_stokes: list[str]  # what the header calls them, where it is not asked
    unit: Unit
    factor: float
    turns_u: bool
    beams: Float | None  # (3, F): BMAJ, BMIN, BPA in rad; NaN where not given
    wide: bool
    notes: Notes

    @property
    def name(self) -> str:
        """The name of the file without its folder."""
        return harmless(self.path.name)


@dataclass(frozen=True)
class Given:
    """What the caller says in the place of the headers."""

    stokes: list[str] | None  # names that are left for this file and those after it
    unit: Unit | None
    frequencies: bool
    beam: bool


def look(path: Path, given: Given) -> Part:
    """What the first image of a file says; raises `FileError` or `InputError` in one line."""
    name = harmless(path.name or path)
    with opened(path) as hdus:
        image, others = None, []
        for k, hdu in units_of(hdus, name):
            if image is None and hdu.is_image and hdu.header.get("NAXIS", 0) >= 2:
                image = k
            elif hdu.size:
                others.append((k, hdu))
        if image is not None:
            return _described(path, image, hdus, others, given)
    raise FileError(f"{name}: there is no image of two axes or more in it")


def _described(path: Path, k: int, hdus: Any, others: list[tuple[int, Any]], given: Given) -> Part:
    file, header, notes = harmless(path.name), hdus[k].header, Notes()
    axes = axes_of(file, header, given.frequencies)
    if "freq" not in axes and not given.frequencies:
        raise FileError(f"{file}: no axis is FREQ: give frequencies=")
    channels = int(header[f"NAXIS{axes['freq']}"]) if "freq" in axes else 1
    affordable(file, channels, header[f"NAXIS{axes['y']}"], header[f"NAXIS{axes['x']}"], header["BITPIX"] == -64)
    found, said = _names(file, header, axes, given)
    table = next((h for _, h in others if h.name == "BEAMS" and not h.is_image), None)
    tables = {str(header.get(f"PS{axes['freq']}_0", "")).strip().upper()} if "freq" in axes else set()
    for number, hdu in others:
        if hdu is not table and (hdu.is_image or hdu.name not in tables - {""}):
            kind = "image" if hdu.is_image else "table"
            notes.unused.append((f"extension {number} ({kind} {hdu.name or 'without a name'})", "the image is another"))
    freq: Float | None = None
    if not given.frequencies:
        if table is not None and "FREQ" in table.columns.names:
            freq = plausible(file, _column(file, table), "the table BEAMS", "FREQ")
        else:
            freq = frequencies_of(file, header, axes["freq"], [h for _, h in others], notes)
        if len(freq) != channels:
            raise FileError(f"{file}: the table BEAMS has {len(freq)} rows, the axis FREQ {channels} channels")
    convention = str(header.get("POLCCONV", "IAU")).strip().upper()
    if convention not in ("IAU", "COSMO"):
        raise FileError(f"{file}: POLCCONV = '{convention}' is neither IAU nor COSMO")
    grid = grid_of(file, header, axes, notes)
    of_unit = _given_unit(file, header, given.unit, notes) if given.unit else _unit(file, header)
    beams = None if given.beam else beams_of(file, header, table, channels, grid, notes)
    wide, turns = header["BITPIX"] == -64, convention == "COSMO"
    return Part(path, k, axes, grid, channels, freq, found, said, *of_unit, turns, beams, wide, notes)


def affordable(file: str, channels: int, ny: int, nx: int, wide: bool) -> None:
    """Raises `RefusedError` for a cube (F, 4, Ny, Nx) that this machine does not hold, before any of it is made."""
    if channels > MOST_CHANNELS:
        raise RefusedError(f"{file}: {channels} channels, at most {MOST_CHANNELS} are read: cut out a part")
    size = channels * 4.0 * ny * nx * (8 if wide else 4)
    afford(size, f"{file}: a cube of {channels} x 4 x {ny} x {nx}", "cut out channels or a part of the image")


def _names(file: str, header: Any, axes: dict[Role, int], given: Given) -> tuple[list[str], list[str]]:
    """Stokes parameters of the planes: those given, or those of the header; and what the header says, if anything."""
    axis = axes.get("stokes")
    planes = int(header[f"NAXIS{axis}"]) if axis else 1
    if given.stokes is None:
        found = stokes_of(file, header, axis)
        if found is None:
            raise FileError(f"{file}: no axis is STOKES: say what it is, such as stokes='I'")
        return only_iquv(file, found, axis), []
    if len(given.stokes) < planes:
        raise InputError(f"stokes names too few: {file} has {planes}, of which {len(given.stokes)} are left to name")
    try:
        said = stokes_of(file, header, axis) or []
    except FileError:
        said = []  # it is not asked
    return given.stokes[:planes], said


def _column(file: str, table: Any) -> Float:
    """Frequencies in Hz of the column FREQ of a table BEAMS."""
    import numpy as np
    from astropy import units as u

    unit = u.Unit(str(table.columns["FREQ"].unit or "Hz"), parse_strict="silent")
    if not unit.is_equivalent(u.Hz):
        raise FileError(f"{file}: FREQ of the table BEAMS has the unit '{unit}': needed Hz: give frequencies=")
    return np.asarray(table.data["FREQ"], float) * float(unit.to(u.Hz))


def _unit(file: str, header: Any) -> tuple[Unit, float]:
    """Unit and factor of BUNIT: 'mJy/beam' is Jy/beam, 1e-3."""
    text = str(header.get("BUNIT", "")).strip()
    remedy = "give unit='Jy/beam', 'Jy/pixel' or 'K'"
    if not text:
        raise FileError(f"{file}: BUNIT is missing: {remedy}")
    plain = re.sub(r"[\s.*()]", "", text)
    if plain in KELVIN or plain.lower() == "kelvin":
        return "K", KELVIN.get(plain, 1.0)
    # MK, MJY/BEAM: mega or milli?
    if (flux := FLUX.fullmatch(plain.lower())) and not plain.startswith("M"):
        return "Jy/pixel" if flux[3] else "Jy/beam", PREFIX[flux[1] or flux[4] or ""]
    raise FileError(f"{file}: BUNIT = '{text}' is not K, Jy/beam or Jy/pixel, or milli or micro of them: {remedy}")


def _given_unit(file: str, header: Any, unit: Unit, notes: Notes) -> tuple[Unit, float]:
    """The unit that the caller says; what the header says against it is noted."""
    try:
        said = _unit(file, header)
    except FileError:
        return unit, 1.0
    if said != (unit, 1.0):
        notes.unused.append((f"BUNIT = '{str(header['BUNIT']).strip()}'", f"unit = '{unit}' is given"))
    return unit, 1.0
