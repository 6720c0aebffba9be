"""Files of sources on disk or of the package, of any known form: which one it is, and its sources."""

from __future__ import annotations

import os
from importlib.resources import files
from pathlib import Path
from typing import Any, Self, TypeVar

import numpy as np
from pydantic import model_validator

from instrument.component import Component
from instrument.errors import FileError, InputError, did_you_mean
from instrument.files_in import GZIP, harmless, read_regular
from instrument.sky.bbs import read_bbs
from instrument.sky.bbs_text import broken, is_bbs
from instrument.sky.binary_tables import fits_table, votable
from instrument.sky.foreign import refuse_foreign
from instrument.sky.programs import demand_plain, program_of
from instrument.sky.skyh5 import HDF5, read_skyh5
from instrument.sky.sources import Sources
from instrument.sky.table_sky import Choices, Incomplete, Sizes, sky_of
from instrument.sky.text_tables import text_table
from instrument.units import Hertz, Radians, SkyDirection

S = TypeVar("S", bound=Sources)
BBS_SUFFIXES = (".skymodel", ".sky", ".bbs")
CARRIED_TABLES = ("mock_150mhz.csv",)  # the other tables of the package are no skies
CATALOGUE_BYTES = 200_000_000  # NVSS has 1.8 million sources in 180 MB; whole surveys beyond that are to be cut


class _Reading(Component):
    """Brings what a reader is told in the forms that fields take."""

    centre: SkyDirection | None = None
    sizes: Sizes | None = None
    beam: Radians | None = None
    frequency: Hertz | None = None
    incomplete: Incomplete = "refuse"

    @model_validator(mode="after")
    def _possible(self) -> Self:
        check_choices(self.beam, self.frequency)
        return self


def check_choices(beam: float | None, frequency: float | None) -> None:
    """Raises `InputError` where a beam in rad or a frequency in Hz is impossible."""
    if beam is not None and not 0 < beam < np.pi:
        raise InputError(f"beam = {np.rad2deg(beam) * 3600:g} arcsec must be above 0 and below 180 deg")
    if frequency is not None and frequency <= 0:
        raise InputError(f"frequency = {frequency:g} Hz must be above 0")


def read_as(
    make: type[S],
    path: Any,
    centre: Any = None,
    sizes: Sizes | None = None,
    beam: Any = None,
    frequency: Any = None,
    incomplete: Incomplete = "refuse",
) -> S:
    """Sources, as a list of the class `make`, of a file on disk, or of one of the package ("3c196_pandey.skymodel").

    BBS text, a model of SAGECal, OSKAR (.osm), Tigger or mwa-reduce (AO), a SkyH5 file, or a table as CSV, ECSV, FITS
    or VOTable, also packed by gzip (but SkyH5); which one is told from the content. A table needs positions and a flux;
    the names and units that are understood, and the surveys that are known by their columns, stand in docs/skies.md.
    Columns that are not read are named in a warning and in the plan. What a table leaves open is asked for: `sizes` =
    "points" or "as given" and `beam` (its FWHM) where there are only sizes fitted to an image, `frequency` of the
    fluxes, and `incomplete` = "leave out" or "no effect" for sources that lack a value (also -999 and the like); the
    usual "refuse" tells the first of them. `centre` (SkyCoord or text) is the phase centre that BBS files may count
    orientations from; see `read_bbs` for what is done without it. Raises `FileError` with file, line, field and remedy.
    """
    told = _Reading(centre=centre, sizes=sizes, beam=beam, frequency=frequency, incomplete=incomplete)
    choices = Choices(told.sizes, told.beam, told.frequency, told.incomplete)
    file = _find(path)
    raw = read_regular(file, CATALOGUE_BYTES, "catalogue", unzip=True)
    if raw.startswith(GZIP):
        raise broken(file, None, "gzip within gzip; unpack it")
    if raw.startswith(HDF5):
        return read_skyh5(make, file, choices.freq_hz)
    start = raw[:1024].lstrip(b"\xef\xbb\xbf").lstrip()
    if start.startswith(b"SIMPLE"):
        return sky_of(make, fits_table(file, raw), choices)
    if b"<VOTABLE" in raw[:4096].upper() or b":VOTABLE" in raw[:4096].upper():
        return sky_of(make, votable(file, raw), choices)
    name = file.name.lower().removesuffix(".gz")
    of_bbs = is_bbs(_head(raw))
    if not of_bbs:
        if (program := program_of(name, _head(raw))) is not None:
            lines = _lines(file, raw)
            demand_plain(file, lines)
            read: S = program(make, file, lines)
            return read
        refuse_foreign(file, raw)
    if b"\0" not in raw[:4096] and (name.endswith(BBS_SUFFIXES) or of_bbs):
        return read_bbs(make, file, _lines(file, raw), told.centre)
    return sky_of(make, text_table(file, raw), choices)


def _find(path: Any) -> Path:
    """The file of a path, or of the package where it is a bare name that is not there."""
    try:
        file = Path(path).expanduser()
    except (TypeError, RuntimeError) as error:  # no path at all; `~` without a home
        raise FileError(f"catalogue {harmless(repr(path), 80)} is no path of a file: {harmless(error)}") from None
    if os.path.lexists(file):
        if (file / "table.dat").is_file():
            raise FileError(
                f"'{harmless(path)}' is a CASA table, which is not read as a sky; write its sources as BBS text or "
                "as a table of named columns"
            )
        return file
    there = files("instrument.data").iterdir()
    carried = {f.name: f for f in there if f.name.endswith(".skymodel") or f.name in CARRIED_TABLES}
    if len(file.parts) == 1 and file.name in carried:
        return Path(str(carried[file.name]))
    near = did_you_mean(harmless(file.name, 60), carried)
    raise FileError(f"no file '{harmless(path, 200)}' on disk, nor among those of the package: {near}")


def _head(raw: bytes) -> list[str]:
    return raw[:65536].decode("utf-8-sig", errors="replace").split("\n")


def _lines(file: Path, raw: bytes) -> list[str]:
    try:
        lines = raw.decode("utf-8-sig").replace("\r\n", "\n").replace("\r", "\n").split("\n")
    except UnicodeDecodeError as error:
        raise broken(file, raw[: error.start].count(b"\n") + 1, "not UTF-8 text; save it as such") from None
    if not any(t.strip() for t in lines):
        raise broken(file, None, "the file is empty")
    return lines
