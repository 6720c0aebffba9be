"""The text of BBS sky models: format line, defaults, quotes, brackets and angles, as named fields of each line."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from instrument.errors import FileError, InputError, did_you_mean, unused
from instrument.files_in import harmless

M = TypeVar("M")
FIELDS = (
    "Name", "Type", "Patch", "Ra", "Dec", "I", "Q", "U", "V", "MajorAxis", "MinorAxis", "Orientation",
    "OrientationIsAbsolute", "ReferenceFrequency", "SpectralIndex", "LogarithmicSI", "RotationMeasure",
    "PolarizedFraction", "PolarizationAngle", "ReferenceWavelength", "RefType", "rah", "rad", "ram", "ras", "dech",
    "decd", "decm", "decs",
)  # fmt: skip
KNOWN = {name.lower(): name for name in FIELDS}
SKIPPED = {"", "dummy", "category", "ishapelet", "qshapelet", "ushapelet", "vshapelet"}
LINES_AT_MOST = 500_000  # 2 kB of numbers and names a source: 1 GB
WITHOUT_FORMAT_LINE = "Name,Type,Ra,Dec,I,Q,U,V,MajorAxis,MinorAxis,Orientation"
FORMAT = re.compile(r"\s*(?:#\s*\((?P<hash>.*)\)\s*=\s*format\s*$|format\s*=(?P<plain>.*))", re.IGNORECASE)
FIELD = re.compile(r"(?P<name>[\w:]*)\s*(?:=\s*(?P<fixed>fixed)?\s*(?P<quote>['\"])(?P<value>.*)(?P=quote))?", re.I)
SECONDS = r"(\d+\.?\d*(?:e[+-]?\d+)?)"  # 05.1e-12 is how Python writes a few picoseconds of arc
HOURS = re.compile(rf"([+-]?)(\d+)(?::(\d+):{SECONDS}|h(\d+)m{SECONDS}s?)", re.IGNORECASE)
DEGREES = re.compile(rf"([+-]?)(\d+)(?:\.(\d+)\.{SECONDS}|d(\d+)m{SECONDS}s?)", re.IGNORECASE)
WITH_UNIT = re.compile(r"([+-]?(?:\d+\.?\d*|\.\d+)(?:e[+-]?\d+)?)\s*(deg|rad)", re.IGNORECASE)


def broken(path: Path, line: int | None, message: str, kind: str = "line") -> FileError:
    """The one-line error of a file: its name, the line or row, what is wrong and the remedy."""
    where = f", {kind} {line}" if line is not None else ""
    return FileError(f"{harmless(path.name)}{where}: {harmless(message, 600)}")


def made(make: type[M], path: Path, **fields: Any) -> M:
    """What a file makes, a `make` of these fields; what is impossible in it is a `FileError` of the file."""
    try:
        return make(**fields)
    except InputError as error:
        raise broken(path, None, str(error)) from None


@dataclass(frozen=True)
class Line:
    """One line of data: its fields by lower-case name, "" where empty or absent."""

    path: Path
    number: int
    values: dict[str, str]

    def __getitem__(self, field: str) -> str:
        return self.values.get(field.lower(), "")

    def fail(self, message: str) -> FileError:
        """The error to raise about this line."""
        return broken(self.path, self.number, message)

    def real(self, field: str, default: float | None = None) -> float:
        """A field as a finite number; the default where it is empty."""
        text = self[field]
        if not text:
            if default is None:
                raise self.fail(f"{field} is missing; give its value, or a default {field}='...' in the format line")
            return default
        return self.parsed(field, text)

    def parsed(self, field: str, text: str) -> float:
        """Text of a field as a finite number."""
        try:
            value = float(text)
        except ValueError:
            raise self.fail(f"{field} = '{text}' is not a number") from None
        if not np.isfinite(value):
            raise self.fail(f"{field} = '{text}' is not finite; give its value or remove the source")
        return value

    def flag(self, field: str, default: bool) -> bool:
        """A field as true or false."""
        text = self[field].lower()
        if text in ("", "true", "t", "yes", "1"):
            return bool(text) or default
        if text in ("false", "f", "no", "0"):
            return False
        raise self.fail(f"{field} = '{self[field]}' is neither true nor false")

    def terms(self) -> list[float]:
        """Spectral terms, [] where none are given."""
        text = self["SpectralIndex"]
        inside = text[1:-1].strip() if text.startswith("[") and text.endswith("]") else text
        return [self.parsed("SpectralIndex", t.strip()) for t in inside.split(",")] if inside else []


def split(text: str) -> list[str]:
    """The fields between commas outside brackets and quotes, trimmed; raises `ValueError` when one is not closed."""
    parts, depth, quote, start = [], 0, "", 0
    for k, c in enumerate(text):
        if quote:
            quote = "" if c == quote else quote
        elif c in "'\"":
            quote = c
        elif c in "[]":
            depth += 1 if c == "[" else -1
            if depth < 0:
                break
        elif c == "," and not depth:
            parts.append(text[start:k].strip())
            start = k + 1
    if quote or depth:
        raise ValueError(f"{'a quote' if quote else 'a bracket'} is not closed in '{text.strip()}'")
    return [*parts, text[start:].strip()]


def _format(path: Path, number: int | None, text: str) -> list[tuple[str, str | None, str | None]]:
    """Lower-case name, default and fixed value of each field of a format line."""
    fields: list[tuple[str, str | None, str | None]] = []
    try:
        parts = split(text)
    except ValueError as error:
        raise broken(path, number, str(error)) from None
    for part in parts:
        match = FIELD.fullmatch(part)
        if match is None:
            raise broken(
                path, number, f"'{part}' in the format line is not Field or Field='value', separated by commas"
            )
        name = match["name"].lower()
        if name not in KNOWN and name not in SKIPPED:
            hint = did_you_mean(match["name"], FIELDS)
            raise broken(path, number, f"unknown field '{match['name']}': {hint}; call it 'dummy' to skip it")
        if name in KNOWN and any(name == f[0] for f in fields):
            raise broken(path, number, f"field '{match['name']}' stands twice in the format line; remove one")
        value = match["value"]
        fields.append((name, None if match["fixed"] else value, value if match["fixed"] else None))
    return fields


def is_bbs(lines: Sequence[str]) -> bool:
    """Whether text has a format line, or without one a first source of a type that BBS knows."""
    data = [t for t in lines if t.strip() and not t.lstrip().startswith("#")][:1]
    kind = [p.strip().lower() for p in data[0].split(",")][1:2] if data else []
    return any(FORMAT.match(t) for t in lines[:1000]) or kind in (["point"], ["gaussian"])


def lines_of(path: Path, text: Sequence[str]) -> list[Line]:
    """The data lines with their fields named, defaults filled in."""
    if len(text) > LINES_AT_MOST:
        raise broken(path, None, f"{len(text):,} lines; at most {LINES_AT_MOST:,} are read: cut out what is needed")
    fields = None
    found = []
    skipped: set[str] = set()
    for number, raw in enumerate(text, 1):
        header = FORMAT.match(raw)
        if header and (fields is None or header["plain"] is not None):
            if fields is not None:
                raise broken(path, number, "a format line after the first one, or after a source; keep one, at the top")
            fields = _format(path, number, header["hash"] if header["plain"] is None else header["plain"])
        if header or not raw.strip() or raw.lstrip().startswith("#"):
            continue
        if fields is None:
            if raw.count(",") < 4:  # name, type, position, flux: no source, and nothing of it is shown
                raise broken(path, number, "neither a format line nor a source; write FORMAT = Name, Type, Ra, Dec, I")
            fields = _format(path, None, WITHOUT_FORMAT_LINE)
        try:
            given = split(raw)
        except ValueError as error:
            raise broken(path, number, str(error)) from None
        places = sum(fixed is None for _, _, fixed in fields)
        if any(given[places:]):
            raise broken(path, number, f"{len(given)} values for the {places} fields of the format line")
        values, rest = {}, iter(given)
        for name, default, fixed in fields:
            value = next(rest, "") if fixed is None else fixed  # a fixed value has no place in the line, as in DP3
            if len(value) > 1 and value[0] in "'\"" and value[0] == value[-1]:
                value = value[1:-1].strip()
            values[name] = value or default or ""
            if value and name in SKIPPED and name not in ("", "dummy"):
                skipped.add(name)
        found.append(Line(path, number, values))
    unused(harmless(path.name), sorted(name.capitalize() for name in skipped))
    return found


def _below_sixty(minutes: float, seconds: float) -> bool:
    return minutes < 60 and seconds <= 60  # 12:34:60.0 is what rounding makes of 59.9999


def angle(line: Line, field: str) -> float | None:
    """Ra or Dec in rad, from one field or from its parts; `None` where nothing is given."""
    right = field == "Ra"
    text, pattern = line[field], HOURS if right else DEGREES
    if text:
        if ":" in text and not right:
            raise line.fail(f"Dec = '{text}' has colons, which mean hours; write +dd.mm.ss.s, or degrees like 48.2deg")
        number, sexagesimal = WITH_UNIT.fullmatch(text), pattern.fullmatch(text)
        if number:
            scale = 1.0 if number[2].lower() == "deg" else 180 / np.pi
            degrees = float(number[1]) * scale
        elif sexagesimal and _below_sixty(*(float(x) for x in sexagesimal.groups()[2:] if x)):
            sign, whole, *rest = sexagesimal.groups()
            minutes, seconds = (float(x) for x in rest if x is not None)
            degrees = (float(whole) + minutes / 60 + seconds / 3600) * (-1 if sign == "-" else 1) * (15 if right else 1)
        else:
            form = "hh:mm:ss.s, or degrees like 123.4deg" if right else "+dd.mm.ss.s, or degrees like 48.2deg"
            raise line.fail(f"{field} = '{text}' is not an angle; write {form}")
    else:
        stem = field.lower()
        parts = [f"{stem}{p}" for p in "hdms"]
        if not any(line[p] for p in parts):
            return None
        if line[parts[0]] and line[parts[1]]:
            raise line.fail(f"{parts[0]} and {parts[1]} are both given; keep one")
        first = parts[0] if line[parts[0]] else parts[1]
        size = abs(line.real(first, 0.0)) + line.real(parts[2], 0.0) / 60 + line.real(parts[3], 0.0) / 3600
        degrees = size * (-1 if line[first].startswith("-") else 1) * (15 if first == parts[0] else 1)
    limit = 360 if right else 90
    if abs(degrees) > limit:
        raise line.fail(f"{field} of {degrees:g} deg lies beyond {limit} deg")
    return float(np.deg2rad(degrees))
