"""FITS and VOTable catalogues: what they declare is held against what is there before a parser of others sees it."""

from __future__ import annotations

import io
import re
import warnings
from pathlib import Path
from typing import Any
from xml.parsers import expat

import numpy as np

from instrument.errors import FileError, unused
from instrument.files_in import SHOWN, harmless
from instrument.sky.bbs_text import broken
from instrument.sky.columns import KEPT, meaning_of
from instrument.sky.tables import ROWS_AT_MOST, Column, Table, entry, first_line, heading, needed, plain_unit
from instrument.units import si_prefix

CELLS_AT_MOST = 50_000_000  # of a VOTable: 400 MB of numbers


def fits_table(path: Path, raw: bytes) -> Table:
    """The first table of a FITS file that has positions; other extensions with data are named."""
    from astropy.io import fits
    from astropy.table import Table as AstropyTable
    from astropy.utils.exceptions import AstropyWarning

    try:
        with warnings.catch_warnings(action="ignore", category=AstropyWarning), fits.open(io.BytesIO(raw)) as hdus:
            chosen = None
            headers, others = [], []
            for k, hdu in enumerate(hdus):
                headers.append(hdu.header)
                if hdu.size > len(raw):
                    there = si_prefix(len(raw), "B")
                    raise broken(path, None, f"extension {k} declares {si_prefix(hdu.size, 'B')}, the file has {there}")
                for card in hdu.header["TUNIT*"].values() if "TFIELDS" in hdu.header else ():
                    _must_be_plain(path, str(card))
                if chosen is None and isinstance(hdu, fits.BinTableHDU | fits.TableHDU) and _has_positions(hdu):
                    chosen = hdu
                elif hdu.size:
                    others.append(harmless(hdu.name, SHOWN) or f"extension {k}")
            if chosen is None:
                raise broken(path, None, "no table with columns of right ascension and declination in it")
            if chosen.header["NAXIS2"] > ROWS_AT_MOST:
                raise broken(path, None, f"{chosen.header['NAXIS2']:,} sources; at most {ROWS_AT_MOST:,} are read")
            cards = {key: h[key] for h in reversed(headers) for key in ("FREQ0", "EQUINOX", "RADESYS") if key in h}
            _must_be_j2000(path, cards)
            found = AstropyTable.read(chosen, format="fits")
            found.convert_bytestring_to_unicode()
            unused(harmless(path.name), others, "only the first table with positions is read")
            freq = cards.get("FREQ0")
            return _columns(path, found, freq_hz=float(freq) if freq and float(freq) > 0 else None)
    except FileError:
        raise
    except Exception as error:  # readers of other people's files fail in many ways
        raise broken(path, None, f"not a fits table that astropy reads: {first_line(error)}") from None


def _columns(path: Path, found: Any, freq_hz: float | None = None) -> Table:
    """The columns of an astropy table."""
    given = {c: str(found[c].unit) for c in found.colnames if found[c].unit is not None}
    top = heading(path, None, list(found.colnames), given)
    needed(path, top)
    columns = {}
    for meaning, k in top.chosen.items():
        column = columns[meaning] = Column(top.names[k], top.units[meaning])
        values = found[top.names[k]]
        if getattr(values, "ndim", 1) != 1:
            raise broken(
                path, None, f"column '{harmless(column.name, SHOWN)}' holds arrays; one number a source is read"
            )
        if KEPT[meaning] is None:
            column.texts = tuple("" if np.ma.is_masked(x) else str(x).strip() for x in values)
        else:
            _numbers_of(path, column, values, meaning == "ra")
    return Table(path, "row", np.arange(1, len(found) + 1), columns, top.others, top.survey, freq_hz)


def _numbers_of(path: Path, column: Column, values: Any, hours: bool) -> None:
    masked = np.ma.getmaskarray(np.ma.asarray(values))
    data = np.asarray(np.ma.getdata(values))
    if data.dtype.kind in "fiu":
        numbers = np.where(masked, np.nan, data.astype(float))
        for kind in (masked, ~masked & ~np.isfinite(numbers)):
            if kind.any():
                k = int(np.argmax(kind))
                column.missing[k] = "empty" if masked[k] else f"{data[k]}, which is not finite"
        column.numbers = np.where(np.isfinite(numbers), numbers, np.nan)
        return
    column.numbers = np.array(
        [entry(path, column, k, "" if masked[k] else str(x).strip(), k + 1, "row", hours) for k, x in enumerate(data)]
    )


def _must_be_plain(path: Path, unit: str) -> None:
    if not plain_unit(unit):
        raise broken(path, None, f"'{harmless(unit, SHOWN)}' is no unit that is read; write it like mJy or arcsec")


def _has_positions(hdu: Any) -> bool:
    found = {meaning_of(str(name))[0] for name in hdu.columns.names}
    return {"ra", "dec"} <= found


def _must_be_j2000(path: Path, cards: dict[str, Any]) -> None:
    equinox, system = cards.get("EQUINOX"), str(cards.get("RADESYS", "")).strip().upper()
    if (equinox is not None and str(equinox).strip(" BJ") not in ("2000", "2000.0")) or system.startswith("FK4"):
        shown = harmless(system or equinox, SHOWN)
        raise broken(path, None, f"positions are of {shown}; convert them to J2000 first")


def votable(path: Path, raw: bytes) -> Table:
    """The first table of a VOTable; one that points to other files, or declares more than it has, is refused."""
    from astropy.table import Table as AstropyTable

    _look_through(path, raw)
    try:
        with warnings.catch_warnings(action="ignore"):  # most tables of archives break some rule of the standard
            found = AstropyTable.read(io.BytesIO(raw), format="votable")
            found.convert_bytestring_to_unicode()
    except Exception as error:  # readers of other people's files fail in many ways
        raise broken(path, None, f"not a votable table that astropy reads: {first_line(error)}") from None
    return _columns(path, found)


def _look_through(path: Path, raw: bytes) -> None:
    """Raises `FileError` for what a VOTable must not hold: links to data, entities, sizes beyond the file."""
    systems: list[str] = []
    cells, rows, seen = 1, 0, 0

    def start(name: str, given: dict[str, str]) -> None:
        nonlocal cells, rows, seen
        tag = name.rpartition(":")[2].upper()
        marks = {k.lower(): v for k, v in given.items()}
        if tag in ("STREAM", "TABLE", "RESOURCE", "VOTABLE", "FITS", "BINARY", "BINARY2") and "href" in marks:
            raise broken(path, None, "its data lie elsewhere (href), which is never followed; save it with its data")
        if tag == "COOSYS":
            systems.append(f"{marks.get('system', '')} {marks.get('equinox', '')}".upper())
        if tag == "FIELD":
            _must_be_plain(path, marks.get("unit", ""))
            sizes = [int(n[:9]) for n in re.findall(r"\d+", marks.get("arraysize", "")[:99])]
            cells += 1 + max(sizes, default=0) * (1 if len(sizes) < 2 else max(sizes))
        if tag == "TR":
            seen += 1
        if tag == "TABLE":
            declared = marks.get("nrows", "0").strip()
            rows = int(declared) if declared.isdigit() and len(declared) < 12 else 10**12 if declared.isdigit() else 0
            if rows > min(len(raw), ROWS_AT_MOST):
                raise broken(path, None, f"declares {rows:,} rows in a file of {si_prefix(len(raw), 'B')}")
            cells, seen = 1, 0
        if cells * max(rows, seen, 1) > CELLS_AT_MOST:
            declared = f"{cells * max(rows, seen, 1):.2g}"
            raise broken(path, None, f"its columns declare {declared} numbers; cut out what is needed")

    def entity(*_: Any) -> None:
        raise broken(path, None, "an entity of its own, which is not read; save it without")

    parser = expat.ParserCreate()
    parser.StartElementHandler, parser.EntityDeclHandler = start, entity
    try:
        parser.Parse(raw, True)
    except (expat.ExpatError, LookupError) as error:  # an encoding that is none
        raise broken(path, None, f"not a votable table that astropy reads: {first_line(error)}") from None
    if systems and all("FK4" in s or "1950" in s for s in systems):
        raise broken(path, None, "positions are of FK4 (B1950); convert them to J2000 first")
