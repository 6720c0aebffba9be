"""Tables as text: CSV and its kin, ECSV, what PyBDSF and VizieR write."""

from __future__ import annotations

import csv
import io
import re
from array import array
from collections.abc import Callable, Iterable, Iterator
from itertools import chain
from pathlib import Path

import numpy as np

from instrument.files_in import SHOWN, harmless
from instrument.sky.bbs_text import broken
from instrument.sky.columns import KEPT
from instrument.sky.tables import ROWS_AT_MOST, Column, Heading, Table, entry, first_line, heading, needed, number_of

FREQUENCY = re.compile(r"#.*reference frequency.*?([\d.]+(?:e[+-]?\d+)?)\s*([kmg]?hz)", re.IGNORECASE)
EQUINOX = re.compile(r"#\s*equinox\s*:?\s*([\d.]+)", re.IGNORECASE)


def text_table(path: Path, raw: bytes) -> Table:
    """CSV (also with tabs, semicolons, bars or blanks), or ECSV when its first line says so; complaints have a line."""
    if raw.startswith((b"\xff\xfe", b"\xfe\xff")):
        raise broken(path, 1, "UTF-16 text; save it as UTF-8")
    if b"\0" in raw[:4096]:
        raise broken(path, None, "a binary file that is neither FITS nor VOTable: no catalogue that is read here")
    lines = _lines(path, raw)
    comments: list[str] = []
    number, first = _first_of(path, lines, comments)
    units: dict[str, str] = {}
    delimiter = _delimiter(first)
    if comments and comments[0].startswith("# %ECSV"):
        units, delimiter = _ecsv_header(path, comments)
    split = _splitter(path, delimiter)
    names = [n.strip() for n in split(number, first)]
    rest: Iterable[tuple[int, str]] = lines
    if _is_data(names) and (named := _heading_in_comments(comments, len(names), split)):
        names, rest = named, chain([(number, first)], lines)
    elif delimiter != ",":
        rest, units = _vizier_units(rest, names, units, split)
    top = heading(path, number, names, units)
    needed(path, top)
    table = _text_rows(path, rest, split, top)
    for comment in comments:
        if (match := FREQUENCY.match(comment)) and table.freq_hz is None:
            table.freq_hz = float(match[1]) * {"h": 1.0, "k": 1e3, "m": 1e6, "g": 1e9}[match[2][0].lower()]
        if (match := EQUINOX.match(comment)) and float(match[1]) != 2000:
            raise broken(path, None, f"positions are of equinox {match[1]}; convert them to J2000 first")
    return table


def _lines(path: Path, raw: bytes) -> Iterator[tuple[int, str]]:
    """Lines with their numbers, one at a time: a file of newlines alone would else take a hundred times its size."""
    text = io.TextIOWrapper(io.BytesIO(raw), encoding="utf-8-sig", errors="strict", newline=None)
    number = 0
    while True:
        number += 1
        try:
            line = text.readline()
        except UnicodeDecodeError:
            number = _bad_line(raw)
            raise broken(path, number, "not UTF-8 text; save it as such") from None
        if not line:
            return
        yield number, line.rstrip("\n")


def _bad_line(raw: bytes) -> int:
    try:
        raw.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        return raw[: error.start].count(b"\n") + 1
    return 1


def _first_of(path: Path, lines: Iterator[tuple[int, str]], comments: list[str]) -> tuple[int, str]:
    """The first line that is no comment; those before it go to `comments`."""
    for number, line in lines:
        if line.startswith("#"):
            comments.append(line)
        elif line.strip():
            return number, line
    raise broken(path, None, "only comments in it" if comments else "the file is empty")


def _delimiter(line: str) -> str:
    return next((d for d in ",\t;|" if d in line), " ")


def _splitter(path: Path, delimiter: str) -> Callable[[int, str], list[str]]:
    def split(number: int, line: str) -> list[str]:
        try:
            if '"' not in line and "\0" not in line:
                return line.split() if delimiter == " " else line.split(delimiter)
            return next(csv.reader([line], delimiter=delimiter, skipinitialspace=True, strict=True))
        except (csv.Error, StopIteration) as error:  # a NUL, a field of more than 128 kB
            raise broken(path, number, f"not a row of a table: {error or 'nothing in it'}") from None

    return split


def _is_data(values: list[str]) -> bool:
    """Whether a row holds numbers where names should be."""
    return sum(number_of(v) is not None for v in values) * 2 > len(values)


def _heading_in_comments(comments: list[str], count: int, split: Callable[[int, str], list[str]]) -> list[str] | None:
    """PyBDSF names its columns in the last comment."""
    for comment in reversed(comments):
        names = [n.strip() for n in split(0, comment.lstrip("# ").strip())] if comment.strip("# ") else []
        if len(names) == count and "ra" in {n.lower() for n in names}:
            return names
    return None


def _vizier_units(
    rest: Iterable[tuple[int, str]], names: list[str], units: dict[str, str], split: Callable[[int, str], list[str]]
) -> tuple[Iterable[tuple[int, str]], dict[str, str]]:
    """VizieR writes a line of units and one of dashes below the names."""
    rest = iter(rest)
    ahead = [line for _, line in zip(range(2), (x for x in rest if x[1].strip()), strict=False)]
    if len(ahead) == 2 and set(ahead[1][1].strip()) <= set("-\t;| "):
        given = [u.strip() for u in split(*ahead[0])]
        return rest, units | {n: u for n, u in zip(names, given, strict=False) if u}
    return chain(ahead, rest), units


def _ecsv_header(path: Path, comments: list[str]) -> tuple[dict[str, str], str]:
    """Units and delimiter of an ECSV header."""
    from astropy.table.meta import get_header_from_yaml

    try:
        header = get_header_from_yaml([c[2:] for c in comments if c.startswith("# ")][1:])
        columns = header["datatype"]
        units = {str(c["name"]): str(c["unit"]) for c in columns if c.get("unit")}
        names, delimiter = [str(c["name"]) for c in columns], header.get("delimiter", " ")
    except Exception as error:  # readers of other people's files fail in many ways
        raise broken(path, None, f"the ECSV header does not parse: {first_line(error)}") from None
    if delimiter not in (" ", ",") or not names:
        raise broken(path, None, "the ECSV header does not parse: delimiter is neither blank nor comma, or no columns")
    return units, delimiter


def _text_rows(
    path: Path, rest: Iterable[tuple[int, str]], split: Callable[[int, str], list[str]], top: Heading
) -> Table:
    columns = {m: Column(top.names[k], top.units[m]) for m, k in top.chosen.items()}
    numbers = {m: array("d") for m in columns if KEPT[m] is not None}
    texts: dict[str, list[str]] = {m: [] for m in columns if KEPT[m] is None}
    where = array("q")
    for number, line in rest:
        if not line.strip() or line.startswith("#"):
            continue
        row = split(number, line)
        if len(row) != len(top.names):
            listed = ", ".join(harmless(n, SHOWN) for n in top.names[:20])
            raise broken(path, number, f"{len(row)} values for the {len(top.names)} columns {listed}")
        if len(where) == ROWS_AT_MOST:
            raise broken(path, number, f"more than {ROWS_AT_MOST:,} sources; cut out what is needed")
        for meaning, k in top.chosen.items():
            if meaning in texts:
                texts[meaning].append(row[k].strip())
            else:
                value = entry(path, columns[meaning], len(where), row[k].strip(), number, "line", meaning == "ra")
                numbers[meaning].append(value)
        where.append(number)
    for meaning, column in columns.items():
        if meaning in texts:
            column.texts = tuple(texts[meaning])
        else:
            column.numbers = np.array(numbers[meaning])
    return Table(path, "line", np.array(where), columns, top.others, top.survey)
