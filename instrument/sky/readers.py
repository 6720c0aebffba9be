"""Readers of catalogues: `read` takes a file in any of the known forms, `Catalogue` is a sky made of one.

Forms: BBS text (see bbs.py), and CSV, ECSV, FITS or VOTable tables with named columns. A column is known by its name
in lower case; its unit comes from the file, or from a suffix: `ra_deg`, `i_mjy`, `ref_freq_mhz`, `major_arcsec`.
"""

from __future__ import annotations

import csv
import difflib
from collections.abc import Callable, Sequence
from importlib.resources import files
from pathlib import Path
from typing import Any

import numpy as np
from pydantic import Field

from instrument.component import Component
from instrument.errors import FileError, InputError, did_you_mean
from instrument.sky.bbs import read_bbs
from instrument.sky.bbs_text import broken, is_bbs
from instrument.sky.mocks import GeneratedSky
from instrument.sky.points import PointSky
from instrument.units import Direction, Float, Radians, SkyDirection

# meaning: (unit it is kept in, "" for a plain number, None for text; names it goes by)
MEANINGS: dict[str, tuple[str | None, tuple[str, ...]]] = {
    "ra": ("rad", ("ra", "raj2000", "_raj2000", "ra_j2000", "right_ascension")),
    "dec": ("rad", ("dec", "dej2000", "decj2000", "_dej2000", "dec_j2000", "declination")),
    "i": ("Jy", ("i", "stokes_i", "flux", "total_flux")),
    "q": ("Jy", ("q", "stokes_q")),
    "u": ("Jy", ("u", "stokes_u")),
    "v": ("Jy", ("v", "stokes_v")),
    "spectral_index": ("", ("spectral_index", "spectralindex")),
    "spectral_curvature": ("", ("spectral_curvature",)),
    "ref_freq": ("Hz", ("ref_freq", "reference_frequency", "reffreq", "freq", "frequency")),
    "rotation_measure": ("rad / m2", ("rotation_measure", "rm", "rm_rad_m2", "rotation_measure_rad_m2")),
    "major": ("rad", ("major", "major_axis", "maj")),
    "minor": ("rad", ("minor", "minor_axis", "min")),
    "angle": ("rad", ("angle", "pa", "position_angle")),
    "name": (None, ("name", "source_name")),
    "patch": (None, ("patch",)),
    "rank": (None, ("rank",)),
}
SUFFIXES = {"deg": "deg", "rad": "rad", "arcmin": "arcmin", "arcsec": "arcsec", "jy": "Jy", "mjy": "mJy"}
SUFFIXES |= {"hz": "Hz", "khz": "kHz", "mhz": "MHz", "ghz": "GHz"}
KNOWN = {name: meaning for meaning, (_, names) in MEANINGS.items() for name in names}
BBS_SUFFIXES = (".skymodel", ".sky", ".bbs")
Where = Callable[[int], FileError]


def read(path: Any, centre: Any = None) -> PointSky:
    """Sources of a file on disk, or of one that the package carries ("3c196_pandey.skymodel", "mock_150mhz.csv").

    BBS text or a table; which one is told from the content. A table needs `ra`, `dec` and `i`, and may have q, u, v,
    spectral_index, spectral_curvature (the next logarithmic term), ref_freq, rotation_measure, major, minor, angle,
    name, patch, rank; other columns are not read. Every value of a column that is read must be there and finite: write
    0 where there is no effect. `centre` (SkyCoord or text) is the phase centre that BBS files may count orientations
    from; see `read_bbs` for what is done without it. Raises `FileError` with file, line, field and remedy.
    """
    place = None if centre is None else _Centre(centre=centre).centre
    file = _find(path)
    try:
        raw = file.read_bytes()
    except OSError as error:
        raise FileError(f"{path} cannot be read: {error.strerror}") from None
    start = raw[:1024].lstrip(b"\xef\xbb\xbf").lstrip()
    if start.startswith(b"SIMPLE"):
        return _read_astropy(file, "fits")
    if b"<VOTABLE" in raw[:4096].upper():
        return _read_astropy(file, "votable")
    try:
        lines = raw.decode("utf-8-sig").splitlines()
    except UnicodeDecodeError as error:
        raise broken(file, raw[: error.start].count(b"\n") + 1, "not UTF-8 text; save it as such") from None
    if not any(t.strip() for t in lines):
        raise broken(file, None, "the file is empty")
    if file.suffix.lower() in BBS_SUFFIXES or is_bbs(lines):
        return read_bbs(file, lines, place)
    return _read_text_table(file, lines)


class _Centre(Component):
    """Brings a phase centre in the forms that fields take."""

    centre: SkyDirection


def _find(path: Any) -> Path:
    file = Path(path).expanduser()
    if file.is_file():
        return file
    if file.is_dir():
        raise FileError(f"{path} is a folder; name the file in it")
    carried = {f.name: f for f in files("instrument.data").iterdir() if f.name.endswith((".skymodel", ".csv"))}
    if len(file.parts) == 1 and file.name in carried:
        return Path(str(carried[file.name]))
    raise FileError(f"no file '{path}' on disk, nor among those of the package: {did_you_mean(file.name, carried)}")


def _read_text_table(file: Path, lines: Sequence[str]) -> PointSky:
    """CSV, or ECSV when its header says so; row by row, so that every complaint has a line."""
    units: dict[str, str] = {}
    delimiter = ","
    if lines[0].startswith("# %ECSV"):
        from astropy.table.meta import get_header_from_yaml

        try:
            header = get_header_from_yaml([t[2:] for t in lines if t.startswith("# ")][1:])
        except Exception as error:  # readers of other people's files fail in many ways
            raise broken(file, None, f"the ECSV header does not parse: {_first_line(error)}") from None
        units = {c["name"]: str(c["unit"]) for c in header["datatype"] if c.get("unit")}
        delimiter = header.get("delimiter", " ")
    numbered = [(n, t) for n, t in enumerate(lines, 1) if t.strip() and not t.startswith("#")]
    rows = [(n, next(csv.reader([t], delimiter=delimiter, skipinitialspace=True))) for n, t in numbered]
    if not rows:
        raise broken(file, None, "only comments in it")
    names = [name.strip() for name in rows[0][1]]
    for number, row in rows[1:]:
        if len(row) != len(names):
            raise broken(file, number, f"{len(row)} values for the {len(names)} columns {', '.join(names)}")
    values = {name: [row[k].strip() for _, row in rows[1:]] for k, name in enumerate(names)}
    if len(values) < len(names):
        raise broken(file, rows[0][0], "two columns of one name; rename or remove one")
    return _build(file, "line", [n for n, _ in rows[1:]], values, units)


def _read_astropy(file: Path, form: str) -> PointSky:
    """FITS and VOTable."""
    from astropy.table import Table

    try:
        table = Table.read(file, format=form)
        table.convert_bytestring_to_unicode()
    except Exception as error:  # readers of other people's files fail in many ways
        raise broken(file, None, f"not a {form} table that astropy reads: {_first_line(error)}") from None
    units = {c: str(table[c].unit) for c in table.colnames if table[c].unit is not None}
    values: dict[str, Any] = {c: table[c] for c in table.colnames}
    return _build(file, "row", list(range(1, len(table) + 1)), values, units)


def _first_line(error: Exception) -> str:
    return next(iter(str(error).splitlines()), type(error).__name__)


def _meaning(column: str) -> tuple[str | None, str | None]:
    """Meaning of a column name and the unit of its suffix; `None` for what is not known."""
    name = column.lower()
    if name in KNOWN:
        return KNOWN[name], None
    base, _, suffix = name.rpartition("_")
    return (KNOWN[base], SUFFIXES[suffix]) if base in KNOWN and suffix in SUFFIXES else (None, None)


def _scale(file: Path, column: str, kept: str, unit: str | None, suffix: str | None) -> float:
    """Factor from the unit of a column to the one its meaning is kept in."""
    from astropy import units as u

    if unit is None and suffix is None:
        if kept in ("", "rad / m2"):
            return 1.0
        raise broken(file, None, f"column '{column}' has no unit; name it like {_example(column, kept)}")
    scales = []
    for name in (x for x in (unit, suffix) if x):
        try:
            scales.append(float(u.Unit(name).to(kept)))
        except (ValueError, u.UnitConversionError):
            wanted = kept or "no unit"
            message = f"column '{column}' is in '{name}', which is not convertible to {wanted}"
            raise broken(file, None, message) from None
    if not np.isclose(scales[0], scales[-1], rtol=1e-12):
        raise broken(file, None, f"column '{column}' is in '{unit}' by its unit but not by its name; rename it")
    return scales[0]


def _example(column: str, kept: str) -> str:
    return {"rad": f"{column}_deg or {column}_arcsec", "Jy": f"{column}_jy", "Hz": f"{column}_hz"}[kept]


def _build(file: Path, kind: str, where: list[int], values: dict[str, Any], units: dict[str, str]) -> PointSky:
    """The sky of named columns: texts or numbers (S,) each, with their units and the line or row of each source."""
    columns: dict[str, str] = {}
    data: dict[str, Any] = {}
    for column, entries in values.items():
        meaning, suffix = _meaning(column)
        if meaning is None:
            _refuse_misspelt(file, column)
            continue
        if meaning in columns:
            raise broken(file, None, f"columns '{columns[meaning]}' and '{column}' both mean {meaning}; remove one")
        columns[meaning] = column
        kept = MEANINGS[meaning][0]
        if kept is None:
            data[meaning] = tuple(str(x).strip() for x in entries)
        else:
            scale = _scale(file, column, kept, units.get(column), suffix)
            data[meaning] = scale * _numbers(file, kind, where, column, entries)
    for needed in ("ra", "dec", "i"):
        if needed not in data:
            known = ", ".join(MEANINGS[needed][1])
            raise broken(file, None, f"no column for {needed} (known names: {known}); it has {', '.join(values)}")
    if not where:
        raise broken(file, None, "no source in it")
    for meaning, limit in (("ra", 2 * np.pi), ("dec", np.pi / 2)):
        beyond = np.abs(data[meaning]) > limit * (1 + 1e-12)
        if beyond.any():
            k = int(np.argmax(beyond))
            raise broken(file, where[k], f"{columns[meaning]} = {values[columns[meaning]][k]} is beyond the sky", kind)
    _need(file, data, "ref_freq", ("spectral_index", "spectral_curvature", "rotation_measure"))
    _need(file, data, "spectral_index", ("spectral_curvature",))
    _need(file, data, "minor", ("major", "angle"))
    _need(file, data, "major", ("minor", "angle"))
    if "major" in data and np.any(data["major"] != data["minor"]):
        _need(file, data, "angle", ("major",))
    return _table_sky(file, data, len(where))


def _table_sky(file: Path, data: dict[str, Any], count: int) -> PointSky:
    none = np.zeros(count)
    terms = [data[t] for t in ("spectral_index", "spectral_curvature") if t in data]
    try:
        return PointSky(
            names=data.get("name") or data.get("rank") or tuple(f"s{k}" for k in range(count)),
            patches=data["patch"] if any(data.get("patch", ())) else (),
            ra_rad=data["ra"],
            dec_rad=data["dec"],
            stokes_jy=np.stack([data["i"], *(data.get(s, none) for s in "quv")], axis=1),
            reference_hz=data.get("ref_freq"),
            spectral_terms=np.stack(terms, axis=1) if terms else None,
            rotation_measure=data.get("rotation_measure"),
            major_rad=data.get("major"),
            minor_rad=data.get("minor"),
            angle_rad=data.get("angle"),
        )
    except InputError as error:
        raise broken(file, None, str(error)) from None


def _need(file: Path, data: dict[str, Any], needed: str, by: Sequence[str]) -> None:
    for meaning in by:
        if meaning in data and needed not in data:
            raise broken(file, None, f"column {meaning} needs a column {needed} ({', '.join(MEANINGS[needed][1])})")


def _refuse_misspelt(file: Path, column: str) -> None:
    """A name that is nearly a known one is refused; any other column is none of our business."""
    name = column.lower()
    near = difflib.get_close_matches(name, [k for k in KNOWN if len(k) > 4], n=1, cutoff=0.9)
    if near and not name.startswith(("e_", "err")) and not name.endswith(("err", "error")):
        raise broken(file, None, f"column '{column}' is not known; did you mean '{near[0]}'? Rename it")


def _numbers(file: Path, kind: str, where: list[int], column: str, entries: Any) -> Float:
    """A column as finite numbers (S,), or the row that is not."""
    out = np.empty(len(where))
    for k, entry in enumerate(entries):
        try:
            out[k] = np.nan if np.ma.is_masked(entry) or entry == "" else float(entry)
        except (TypeError, ValueError):
            raise broken(file, where[k], f"{column} = '{entry}' is not a number", kind) from None
    bad = ~np.isfinite(out)
    if bad.any():
        k = int(np.argmax(bad))
        shown = "empty" if np.ma.is_masked(entries[k]) or entries[k] == "" else f"{entries[k]}, which is not finite"
        raise broken(file, where[k], f"{column} is {shown}; give the value (0 for none) or remove the source", kind)
    return out


class Catalogue(GeneratedSky):
    """The sources of a file, placed about a phase centre.

    `brightest` keeps that many of largest |I| + P at their reference frequencies. `model` names a file whose components
    (one source) replace what the catalogue has within `match` of their mean direction, as one patch, called as in that
    file or else as the file; the model counts as one source. Raises `FileError`, and `InputError` when nothing is there
    to be replaced.
    """

    path: str
    brightest: int | None = Field(default=None, ge=1)
    model: str | None = None
    match: Radians = float(np.deg2rad(30 / 3600))  # 30 arcsec, well below the beam of the surveys of the field

    def place(self, centre: Direction) -> PointSky:
        """The sources; the centre matters to orientations in BBS files that count from it."""
        sky = read(self.path, centre)
        if self.model is None:
            return sky if self.brightest is None else sky.brightest(self.brightest)
        model = read(self.model, centre)
        name = model.patches[0] if len(set(model.patches)) == 1 and model.patches[0] else Path(self.model).stem
        return _with_model(sky, model, name, self.match, self.brightest)


def _with_model(sky: PointSky, model: PointSky, name: str, match_rad: float, brightest: int | None) -> PointSky:
    """A sky in which a model, as the patch `name`, stands for the sources within `match_rad` of its mean direction."""
    apart, width = sky.distance_rad(model.middle), model.distance_rad(model.middle).max()
    arcsec = np.rad2deg(1) * 3600
    if width > match_rad:
        raise InputError(
            f"model '{name}' is not one source: it reaches {width * arcsec:.3g} arcsec from its middle, more than "
            f"match = {match_rad * arcsec:.3g} arcsec"
        )
    replaced = apart <= match_rad
    if not replaced.any():
        raise InputError(
            f"no source within {match_rad * arcsec:.3g} arcsec of model '{name}' to be replaced; the nearest is "
            f"{apart.min() * arcsec:.3g} arcsec away"
        )
    first, rest = int(np.argmax(replaced)), np.flatnonzero(~replaced)
    power = np.append(sky.power_jy[rest], model.power_jy.sum())
    kept = np.sort(np.argsort(-power, kind="stable")[:brightest])
    if kept[-1] < len(rest):  # the model, which stands last, is not among the brightest
        return sky.select(rest[kept])
    rest = rest[kept[:-1]]
    model = model.with_fields(patches=(name,) * len(model))
    parts = [sky.select(rest[rest < first])] if (rest < first).any() else []
    parts.append(model)
    parts += [sky.select(rest[rest > first])] if (rest > first).any() else []
    return PointSky.join(*parts)
