"""Tables of other people as named columns: what their headings mean, their entries as numbers or as nothing."""

from __future__ import annotations

import re
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from instrument.errors import unused, warn
from instrument.files_in import SHOWN, harmless
from instrument.sky.bbs_text import broken
from instrument.sky.columns import MEANINGS, Survey, meaning_of, survey_of
from instrument.units import Float

ROWS_AT_MOST = 2_000_000  # about 1 GB of names and numbers; no engine of ours predicts as many
NOTHING = {"", "--", "null", "none", "n/a", "na", "masked", "nan"}
SEXAGESIMAL = re.compile(r"([+-]?)\s*(\d+)(\s+|\s*[:hd]\s*)(\d+)[\s:m]+(\d+(?:\.\d*)?)\s*s?")


@dataclass
class Column:
    """One column: numbers (S,), NaN where there is nothing, or texts; its unit; what stands where there is nothing."""

    name: str
    unit: str | None = None
    numbers: Float | None = None
    texts: tuple[str, ...] | None = None
    missing: dict[int, str] = field(default_factory=dict)  # row: "empty", or what is there; not all rows of tables
    sexagesimal: int = 0  # how many entries were written as 08:13:36.0; they stand as degrees


@dataclass
class Table:
    """Columns whose meaning is known, by it; names of the others; the line or row of each source."""

    path: Path
    kind: str  # what a source stands on: "line" or "row"
    where: Any
    columns: dict[str, Column]
    others: list[str]
    survey: Survey | None = None
    freq_hz: float | None = None

    def __len__(self) -> int:
        return len(self.where)


@dataclass
class Heading:
    """Which places of a row are read as what."""

    names: list[str]
    survey: Survey | None
    chosen: dict[str, int]
    units: dict[str, str | None]

    @property
    def others(self) -> list[str]:
        """Names of the columns that are not read."""
        read = set(self.chosen.values())
        return [name for k, name in enumerate(self.names) if k not in read]


def heading(path: Path, line: int | None, names: list[str], units: dict[str, str] | None = None) -> Heading:
    """What the columns of a table mean; raises `FileError` where two mean the same."""
    lowered = [n.lower() for n in names]
    if len(set(names)) < len(names):
        raise broken(path, line, "two columns of one name; rename or remove one")
    survey = survey_of(names)
    found: dict[str, list[int]] = {}
    within: dict[int, str | None] = {}
    for k, name in enumerate(names):
        meaning, within[k] = meaning_of(name, survey)
        if meaning:
            found.setdefault(meaning, []).append(k)
    chosen = {}
    for meaning, places in found.items():
        if meaning == "name":
            places = [min(places, key=lambda k: _rank(lowered[k], survey))]
        elif meaning == "remark":
            places = places[:1]
        elif len(places) > 1:  # VizieR adds positions that it has worked out itself
            places = [k for k in places if not lowered[k].startswith("_")] or places
        if len(places) > 1:
            first, second = (harmless(names[k], SHOWN) for k in places[:2])
            raise broken(path, None, f"columns '{first}' and '{second}' both mean {meaning}; remove one")
        chosen[meaning] = places[0]
    given = units or {}
    return Heading(
        names, survey, chosen, {m: _one_unit(path, names[k], given.get(names[k]), within[k]) for m, k in chosen.items()}
    )


def _rank(name: str, survey: Survey | None) -> int:
    names = MEANINGS["name"][1]
    return -1 if survey and name in survey.columns else names.index(name) if name in names else len(names)


def plain_unit(unit: str) -> bool:
    """Whether a unit from outside is one that may be parsed: astropy works out 10**99999999 Jy, digit by digit."""
    return len(unit) <= 40 and not re.search(r"\d{4}|(?:\*\*|\^)\s*[({[]*\s*[+-]?\s*\d{2}", unit)


def unit_scale(unit: str, kept: str) -> float | None:
    """Factor from a unit to another; `None` where there is none."""
    from astropy import units as u

    try:
        scale = float(u.Unit(unit).to(kept)) if plain_unit(unit) else np.nan
    except (ValueError, TypeError, OverflowError, u.UnitConversionError):
        return None
    return scale if np.isfinite(scale) and scale > 0 else None


def _one_unit(path: Path, column: str, given: str | None, within: str | None) -> str | None:
    """The unit of a column: of the table, or of its name; raises `FileError` when they differ."""
    if not (given and within):
        return given or within
    scale = unit_scale(given, within)
    if scale is None or not np.isclose(scale, 1.0, rtol=1e-12):
        name, unit = harmless(column, SHOWN), harmless(given, SHOWN)
        raise broken(path, None, f"column '{name}' is in '{unit}' by its unit but not by its name; rename it")
    return given


def number_of(text: str) -> float | None:
    """Text as a number; `None` where it is none (Python's 1_000 is none to anybody else)."""
    try:
        return None if "_" in text else float(text)
    except ValueError:
        return None


def entry(path: Path, column: Column, row: int, text: str, where: int, kind: str, hours: bool) -> float:
    """A number, NaN where there is none (what stands there is kept); sexagesimal text in degrees."""
    try:  # nearly every entry is a plain number
        plain = float(text)
    except ValueError:
        plain = np.nan
    if -np.inf < plain < np.inf and "_" not in text:
        return plain
    if text.lower() in NOTHING:
        column.missing[row] = "empty" if text.lower() != "nan" else f"{text}, which is not finite"
        return float("nan")
    found = number_of(text)
    if found is None and (match := SEXAGESIMAL.fullmatch(text)):
        sign, whole, mark, minutes, seconds = match.groups()
        if float(minutes) < 60 and float(seconds) < 60:
            column.sexagesimal += 1
            size = float(whole) + float(minutes) / 60 + float(seconds) / 3600
            # 08:13:36 is hours in a right ascension and degrees in a declination; letters say it themselves
            of_hours = mark.strip() == "h" or (hours and mark.strip() != "d")
            return size * (-1 if sign == "-" else 1) * (15 if of_hours else 1)
    if found is None:
        name, shown = harmless(column.name, SHOWN), harmless(text, SHOWN)
        raise broken(path, where, f"{name} = '{shown}' is not a number", kind)
    if not np.isfinite(found):
        column.missing[row] = f"{harmless(text, SHOWN)}, which is not finite"
        return float("nan")
    return found


def needed(path: Path, top: Heading) -> None:
    """Raises `FileError` where a table has no positions or no flux; only names that look like names are quoted."""
    for meaning in ("ra", "dec", "i"):
        if meaning in top.chosen or (meaning == "i" and "fallback_i" in top.chosen):
            continue
        known = ", ".join(MEANINGS[meaning][1][:6])
        plain = [n for n in top.names if re.fullmatch(r"[A-Za-z_][\w.\- \[\]()/]{0,40}", n)]
        if top.chosen or (len(plain) == len(top.names) > 1):
            it_has = f"it has {', '.join(harmless(n, SHOWN) for n in top.names[:12])}"
            it_has += f" and {len(top.names) - 12} more" if len(top.names) > 12 else ""
        else:
            it_has = "none of its columns is one that a sky has"
        raise broken(path, None, f"no column for {meaning} (known names: {known}); {it_has}")


def say_unread(table: Table) -> tuple[str, ...]:
    """Names the columns that were not read, in a warning and for the plan."""
    names = [harmless(n, SHOWN) for n in table.others]
    unused(table.path.name, names)
    return tuple(names)


def say(table: Table, text: str) -> None:
    """A warning about a table."""
    warn(f"{harmless(table.path.name)}: {text}")


def first_line(error: Exception) -> str:
    """The first line of somebody else's error, short and harmless."""
    return harmless(next(iter(str(error).splitlines()), type(error).__name__), 160)
