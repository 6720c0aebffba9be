"""Sky models of OSKAR, SAGECal, Tigger and mwa-reduce ("AO"): their text, with the angles and logarithms of each.

In all of them the spectrum of I is that of Q, U and V too. SAGECal and Tigger have natural logarithms, OSKAR and AO an
index alone. Position angles of OSKAR, Tigger and AO count from north through east, and sizes are full widths at half
maximum. SAGECal's are refused: its predictor makes a Gaussian 0.53 times as wide as it is documented, and pi/2 as
bright.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from instrument.errors import unused
from instrument.files_in import SHOWN, harmless
from instrument.sky.ao_text import components
from instrument.sky.bbs_text import LINES_AT_MOST, broken, made
from instrument.sky.sources import Sources

S = TypeVar("S", bound=Sources)
ARCSEC = np.pi / 180 / 3600
LN10 = np.log(10.0)
EXTENDED = {"g": "a Gaussian", "d": "a disk", "r": "a ring", "s": "a shapelet"}
SAGECAL_ROW = re.compile(
    r"[a-z]\S*(?:\s+[+-]?\d+){2}\s+[\d.]+(?:\s+[+-]?\d+){2}\s+[\d.]+(?:\s+[-+.\de]+){7}", re.IGNORECASE
)
ANGLES = {"rad": 1.0, "d": np.pi / 180, "h": np.pi / 12, "m": np.pi / 180 / 60, "s": ARCSEC}
TIGGER_KNOWN = re.compile(
    r"name|[iquv]|rm|spi[2-9]?|freq0|(?:ra|dec)_(?:rad|[dhms])|dec_sign|e(?:maj|min)_(?:rad|[dms])|pa_(?:rad|d)",
)
TIGGER_REFUSED = re.compile(r"pol_frac|pol_pa_\w+|sbeta[lm]\w*|shapelet_coeffs")
LONGEST_LINE = 10_000
OSKAR = 12  # numbers a line


@dataclass
class Row:
    """One source: radians, Jy, Hz (0 where none is given), spectral terms of common logarithms."""

    where: int
    name: str
    place: tuple[float, float]
    stokes: Sequence[float]
    freq_hz: float
    terms: Sequence[float] = ()
    rotation: float = 0.0
    shape: tuple[float, float, float] = (0.0, 0.0, 0.0)
    patch: str = ""


def program_of(name: str, lines: Sequence[str]) -> Callable[..., Any] | None:
    """The reader of a program's text, told from its first lines (OSKAR's: from its name); `None` where it is none."""
    written = [t.strip()[:1000] for t in lines[:1000] if t.strip()]
    data = next((t for t in written if not t.startswith("#")), "")
    if re.match(r"skymodel\s+fileformat", data, re.IGNORECASE):
        return read_ao
    if any(re.match(r"#\s*format\s*:", t, re.IGNORECASE) for t in written[:1]):
        return read_tigger
    headed = any(re.match(r"##\s*lsm file|#+\s*name\s*\|?\s*(?:h\s+m\s+s|ra\s*\()", t, re.I) for t in written[:4])
    if headed or SAGECAL_ROW.match(data):
        return read_sagecal
    return read_oskar if name.endswith(".osm") else None


def demand_plain(path: Path, lines: Sequence[str]) -> None:
    """Raises `FileError` for text that would take gigabytes as names and numbers: too many lines, or too long ones."""
    if len(lines) > LINES_AT_MOST:
        raise broken(path, None, f"{len(lines):,} lines; at most {LINES_AT_MOST:,} are read: cut out what is needed")
    long = next((k for k, t in enumerate(lines, 1) if len(t) > LONGEST_LINE), None)
    if long is not None:
        raise broken(path, long, f"more than {LONGEST_LINE:,} characters; a source takes a few hundred")


def listed(make: type[S], path: Path, rows: list[Row]) -> S:
    """The sky of some rows, a list of the class `make`: Q, U and V follow the spectrum of I."""
    if not rows:
        raise broken(path, None, "no source in it")
    for row in rows:
        numbers = [*row.place, *row.stokes, row.freq_hz, *row.terms, row.rotation, *row.shape]
        if not np.all(np.isfinite(numbers)):
            raise broken(path, row.where, f"a value of '{harmless(row.name, SHOWN)}' is not finite")
        if not (abs(row.place[0]) <= 2 * np.pi + 1e-12 and abs(row.place[1]) <= np.pi / 2 + 1e-12):
            degrees = np.rad2deg(row.place)
            shown = f"right ascension {degrees[0]:g}, declination {degrees[1]:g}"
            raise broken(path, row.where, f"{shown} are beyond the sky")
        if min(row.shape[:2]) < 0 or row.freq_hz < 0:
            raise broken(path, row.where, f"a size or the frequency of '{harmless(row.name, SHOWN)}' is negative")
    width = max(len(r.terms) for r in rows)
    terms = np.array([[*r.terms, *[0.0] * (width - len(r.terms))] for r in rows]).reshape(len(rows), width)
    freq, turn = np.array([r.freq_hz for r in rows]), np.array([r.rotation for r in rows])
    still = freq == 0
    if np.any(lost := still & (np.any(terms != 0, axis=1) | (turn != 0))):
        where = [f"line {rows[k].where}" for k in np.flatnonzero(lost)[:20]]
        unused(harmless(path.name), where, "spectra and rotation without a reference frequency")
        terms, turn = np.where(still[:, None], 0.0, terms), np.where(still, 0.0, turn)
    curved = bool(terms.any())
    shape = np.array([r.shape for r in rows])
    # a source without a reference is constant in frequency: any does for it
    known = freq[~still]
    return made(
        make,
        path,
        names=tuple(r.name for r in rows),
        patches=tuple(r.patch for r in rows) if any(r.patch for r in rows) else (),
        ra_rad=np.array([r.place[0] for r in rows]),
        dec_rad=np.array([r.place[1] for r in rows]),
        stokes_jy=np.array([r.stokes for r in rows], float),
        reference_hz=np.where(still, known[0], freq) if len(known) else None,
        spectral_terms=terms if curved else None,
        rotation_measure=turn if turn.any() else None,
        polarization_follows_i=np.ones(len(rows), bool) if curved else None,
        **(
            {"major_rad": shape[:, 0], "minor_rad": shape[:, 1], "angle_rad": shape[:, 2]} if shape[:, :2].any() else {}
        ),
    )


def _data(lines: Sequence[str]) -> Iterator[tuple[int, list[str]]]:
    """Numbers of lines and their values, between blanks or commas, without comments."""
    for number, line in enumerate(lines, 1):
        text = line.partition("#")[0].replace(",", " ").split()
        if text:
            yield number, text


def _number(path: Path, line: int, what: str, text: str) -> float:
    try:
        return float(text)
    except ValueError:
        raise broken(path, line, f"{what} = '{harmless(text, SHOWN)}' is not a number") from None


def read_oskar(make: type[S], path: Path, lines: Sequence[str]) -> S:
    """Sources of an OSKAR sky model, as `make`: up to 12 numbers a line in its order and units, missing ones are 0.

    Q, U and V carry the spectrum of I and turn with the rotation measure; without a reference frequency (0) nothing
    changes with frequency, as OSKAR takes it.
    """
    rows: list[Row] = []
    for number, text in _data(lines):
        try:
            found = [float(t) for t in text]
        except ValueError:
            raise broken(path, number, "an OSKAR sky model holds numbers alone, 3 to 12 a line") from None
        if not 3 <= len(found) <= OSKAR or not np.all(np.isfinite(found)):
            raise broken(path, number, f"{len(found)} values; OSKAR has 3 to 12 a line, all of them finite")
        ra, dec, i, q, u, v, freq, index, turn, *shape = found + [0.0] * (OSKAR - len(found))
        place = float(np.deg2rad(ra)), float(np.deg2rad(dec))
        size = shape[0] * ARCSEC, shape[1] * ARCSEC, float(np.deg2rad(shape[2]))
        rows.append(Row(number, f"s{len(rows)}", place, (i, q, u, v), max(freq, 0.0), (index,), turn, size))
    return listed(make, path, rows)


def read_sagecal(make: type[S], path: Path, lines: Sequence[str]) -> S:
    """Point sources of a SAGECal sky model, as `make`: 17 columns, or 19 with three spectral terms.

    A first term of 0 switches all of them off, as in SAGECal, which takes no notice of the rotation measure either.
    """
    rows: list[Row] = []
    turned = []
    for number, text in _data(lines):
        if len(text) not in (17, 19):
            raise broken(path, number, f"{len(text)} values; a SAGECal sky model has 17 a line, or 19")
        name, *rest = text
        if name[0].lower() in EXTENDED:
            raise broken(
                path, number, f"'{harmless(name, SHOWN)}' is {EXTENDED[name[0].lower()]} to SAGECal, by its first "
                "letter: its sizes and fluxes are not those of its documentation, so it is not read; write it as BBS "
                "text, or begin the name of a point with P"
            )  # fmt: skip
        found = [_number(path, number, "a column", t) for t in rest]
        terms, (turn, *shape, freq) = found[10:-5], found[-5:]
        if any(shape):
            raise broken(
                path, number, f"'{harmless(name, SHOWN)}' is a point to SAGECal but has a size; if this is a model of "
                "Tigger, begin it with '#format: name ra_h ra_m ra_s dec_d dec_m dec_s i q u v spi rm emaj_s emin_s "
                "pa_d freq0'"
            )  # fmt: skip
        if turn:
            turned.append(f"line {number}")
        place = _sexagesimal(rest[:3], found[:3]) * np.pi / 12, _sexagesimal(rest[3:6], found[3:6]) * np.pi / 180
        common = [t * LN10**k for k, t in enumerate(terms)] if terms[0] else []
        rows.append(Row(number, name, place, found[6:10], freq, common))
    unused(harmless(path.name), turned, "SAGECal takes no notice of rotation measures")
    _once(path, rows)
    return listed(make, path, rows)


def _sexagesimal(text: Sequence[str], found: Sequence[float]) -> float:
    size = abs(found[0]) + found[1] / 60 + found[2] / 3600
    return -size if text[0].startswith("-") else size


def _once(path: Path, rows: list[Row]) -> None:
    there: dict[str, int] = {}
    for row in rows:
        if row.name in there:
            name = harmless(row.name, SHOWN)
            raise broken(path, row.where, f"source '{name}' was there before, on line {there[row.name]}; rename one")
        there[row.name] = row.where


def read_tigger(make: type[S], path: Path, lines: Sequence[str]) -> S:
    """Sources of Tigger's text, as `make`: columns by the names of its "#format:" line; others are named as not read.

    As MeqTrees predicts them: Q, U and V carry the spectrum of I, and turn from the reference frequency on.
    """
    first = next(k for k, t in enumerate(lines) if t.strip())
    fields = re.sub(r"^\s*#\s*format\s*:", "", lines[first], flags=re.IGNORECASE).split()
    tail = bool(fields) and fields[-1].endswith("...")
    named = fields[:-1] if tail else fields
    columns = {f: k for k, f in enumerate(named)}
    if twice := [f for f in columns if f not in ("-", "dummy") and named.count(f) > 1]:
        raise broken(path, first + 1, f"column '{harmless(twice[0], SHOWN)}' stands twice in the format line")
    if shown := [f for f in columns if TIGGER_REFUSED.fullmatch(f)]:
        raise broken(path, first + 1, f"column '{shown[0]}' is not read; give q and u, and Gaussians as emaj, emin, pa")
    plain = {f for f in columns if TIGGER_KNOWN.fullmatch(f)}
    sizes = {axis: [f for f in columns if f in plain and f.startswith(axis)] for axis in ("emaj_", "emin_", "pa_")}
    shaped = all(sizes.values())  # Tigger takes all three or none
    places = [_tigger_place(path, first + 1, columns, axis) for axis in ("ra", "dec")]
    if "i" not in columns:
        raise broken(path, first + 1, "the format line of a Tigger sky model needs i")
    plain -= set() if shaped else {f for found in sizes.values() for f in found}
    skipped = [harmless(f, SHOWN) for f in columns if f not in plain and f not in ("-", "dummy", "tags")]
    rows: list[Row] = []
    for number, line in enumerate(lines, 1):
        text = line.partition("#")[0].split()
        if not text:
            continue
        if len(text) < len(named) or (len(text) > len(named) and not tail):
            raise broken(path, number, f"{len(text)} values for the {len(named)} columns of the format line")
        of = {f: _number(path, number, f, text[k]) for f, k in columns.items() if f in plain - {"name", "dec_sign"}}
        signs = text[columns["ra_" + places[0]]], text[columns.get("dec_sign", columns["dec_" + places[1]])]
        ra, dec = (_tigger_angle(of, a, u, s) for a, u, s in zip(("ra", "dec"), places, signs, strict=True))
        major, minor, turn = (
            sum(of[f] * ANGLES[f.partition("_")[2]] for f in found) if shaped else 0.0 for found in sizes.values()
        )
        terms = [of.get(f, 0.0) * LN10**k for k, f in enumerate(("spi", *(f"spi{n}" for n in range(2, 10))))]
        freq = of.get("freq0", rows[0].freq_hz if rows else 0.0)
        name = text[columns["name"]] if "name" in columns else f"s{len(rows)}"
        stokes = [of.get(s, 0.0) for s in "iquv"]
        rows.append(
            Row(
                number,
                name,
                (ra, dec),
                stokes,
                freq,
                np.trim_zeros(terms, "b"),
                of.get("rm", 0.0),
                (major, minor, turn),
            )
        )
    unused(harmless(path.name), skipped)
    _once(path, rows)
    return listed(make, path, rows)


def _tigger_place(path: Path, line: int, columns: dict[str, int], axis: str) -> str:
    """The unit of the first column of a coordinate; minutes and seconds may follow."""
    there = [u for u in (("rad", "d", "h") if axis == "ra" else ("rad", "d")) if f"{axis}_{u}" in columns]
    if len(there) != 1:
        units = "ra_h, ra_d or ra_rad" if axis == "ra" else "dec_d or dec_rad"
        raise broken(path, line, f"the format line of a Tigger sky model needs one of {units}")
    return there[0]


def _tigger_angle(of: dict[str, float], axis: str, unit: str, sign: str) -> float:
    size = abs(of[f"{axis}_{unit}"]) + of.get(f"{axis}_m", 0.0) / 60 + of.get(f"{axis}_s", 0.0) / 3600
    return size * ANGLES[unit] * (-1 if sign.startswith("-") else 1)


def read_ao(make: type[S], path: Path, lines: Sequence[str]) -> S:
    """Sources of an AO sky model ("skymodel fileformat 1.x"), as `make`: points and Gaussians, each of one spectrum.

    Components of one source make a patch. Fluxes at several frequencies, and curved spectra, which programs take
    differently, are refused.
    """
    rows = []
    for one in components(path, lines):
        rows.append(Row(one.line, one.name, one.place, one.stokes, one.freq_hz, one.terms, 0.0, one.shape, one.patch))
    _once(path, rows)
    return listed(make, path, rows)
