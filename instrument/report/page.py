"""One self-contained HTML page: building blocks, the page of a run made of them, and the writing of it.

A new stage adds a `Section` of blocks; the template knows the kinds of block and nothing else. Everything is escaped.
"""

from __future__ import annotations

import base64
import os
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, ClassVar, Literal

import numpy as np

from instrument.errors import FileError
from instrument.whole_file import whole_file

Mark = Literal["", "good", "bad"]
MOST_ROWS = 2000  # of a table in the page: a phone still scrolls them


@dataclass(frozen=True)
class Card:
    """One headline number: what it is, its value as text, a line below it, and whether it is good or falls short."""

    label: str
    value: str
    note: str = ""
    mark: Mark = ""


@dataclass(frozen=True)
class Cell:
    """One cell of a table: text, the length 0 to 1 of a bar beside it, a mark, and whether it is a number."""

    text: str
    bar: float | None = None
    mark: Mark = ""
    numeric: bool = False


@dataclass(frozen=True)
class Text:
    """A paragraph, or with `code` preformatted text that scrolls sideways."""

    kind: ClassVar[str] = "text"
    text: str
    code: bool = False


@dataclass(frozen=True)
class Table:
    """Column heads and rows of cells (text, numbers, `Cell`); it scrolls sideways in its own box.

    With `stack` every row is a small list of heads and values on a phone: for tables of few rows.
    """

    kind: ClassVar[str] = "table"
    columns: Sequence[str]
    rows: Sequence[Sequence[Any]]
    caption: str = ""
    stack: bool = False

    @property
    def body(self) -> list[list[Cell]]:
        """The rows with every value as a `Cell`."""
        return [[_cell(value) for value in row] for row in self.rows]

    @classmethod
    def of(cls, table: Any, caption: str = "") -> Table:
        """An astropy table, units in the heads, 5 digits; above 2000 rows the rest is left out, as the caption says."""
        units = {name: table[name].unit for name in table.colnames}
        heads = [name.replace("_", " ") + (f" ({unit})" if unit else "") for name, unit in units.items()]
        columns = [getattr(table[name], "value", table[name])[:MOST_ROWS] for name in table.colnames]
        if len(table) > MOST_ROWS:
            caption = f"{caption} The first {MOST_ROWS} of {len(table)} rows.".strip()
        return cls(heads, [[_cell(value, 5) for value in row] for row in zip(*columns, strict=True)], caption)


@dataclass(frozen=True)
class FigureEntry:
    """A PNG file and what it shows, put into the page as data; a `wide` one takes the whole width of the page."""

    path: str | os.PathLike[str]
    caption: str
    alt: str = ""
    wide: bool = False
    dark: str = ""  # the same for dark screens, as data
    source: str = ""  # this and the size are filled in by read
    size: tuple[int, int] = (0, 0)

    def read(self) -> FigureEntry:
        """The same with the file's content; raises `FileError` when it is not a PNG."""
        try:
            content = Path(self.path).read_bytes()
        except OSError as error:
            raise FileError(f"figure {self.path}: {error.strerror}") from error
        if content[:8] != b"\x89PNG\r\n\x1a\n":
            raise FileError(f"figure {self.path} is not a PNG file")
        size = int.from_bytes(content[16:20], "big"), int.from_bytes(content[20:24], "big")
        return replace(self, source="data:image/png;base64," + base64.b64encode(content).decode(), size=size)


@dataclass(frozen=True)
class Figures:
    """Figures side by side where there is room."""

    kind: ClassVar[str] = "figures"
    entries: Sequence[FigureEntry]

    def read(self) -> list[FigureEntry]:
        """All entries with their content."""
        return [entry.read() for entry in self.entries]


@dataclass(frozen=True)
class Details:
    """Blocks behind a line that opens them."""

    kind: ClassVar[str] = "details"
    summary: str
    blocks: Sequence[Block]


Block = Text | Table | Figures | Details


@dataclass(frozen=True)
class Section:
    """A heading and what is under it."""

    title: str
    blocks: Sequence[Block]


@dataclass(frozen=True)
class Page:
    """A whole page: title, a line below it, the verdict with its mark, headline cards, sections."""

    title: str
    subtitle: str = ""
    verdict: str = ""
    mark: Mark = ""
    cards: Sequence[Card] = ()
    sections: Sequence[Section] = ()
    footer: str = ""


def write_page(page: Page, path: str | os.PathLike[str]) -> Path:
    """Write a page as one HTML file without scripts or outside resources; the file is whole or not there."""
    from jinja2 import Environment, FileSystemLoader, StrictUndefined

    here = Environment(
        loader=FileSystemLoader(Path(__file__).parent),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    with whole_file(path) as partial:
        partial.write_text(here.get_template("page.html").render(page=page), encoding="utf-8")
    return Path(path)


def number(value: Any, digits: int = 3) -> str:
    """A value as text: 3 digits for reals (0.400, not 0.4), a dash for what is not a number, yes or no for truth."""
    if value is None or value is np.ma.masked:
        return "–"
    if isinstance(value, bool | np.bool_):
        return "yes" if value else "no"
    if isinstance(value, float | np.floating):
        real = float(value)
        if not np.isfinite(real):
            return "–" if np.isnan(real) else str(real)
        if real == 0 or (abs(real) < 1e6 and real == round(real)):
            return f"{real:.0f}"
        plain = f"{real:#.{digits}g}".rstrip(".")
        # 12345 reads better than 1.23e+04
        return f"{real:.0f}" if "e+" in plain and abs(real) < 1e6 else plain
    return str(value)


def duration(seconds: float) -> str:
    """Seconds as a person says them: 0.25 s, 48.2 s, 12 min, 3.1 h."""
    if seconds < 10:
        return f"{seconds:.2g} s"
    if seconds < 300:
        return f"{seconds:.0f} s"
    return f"{seconds / 60:.0f} min" if seconds < 7200 else f"{seconds / 3600:.1f} h"


def _cell(value: Any, digits: int = 3) -> Cell:
    if isinstance(value, Cell):
        return value
    numeric = isinstance(value, int | float | np.number) and not isinstance(value, bool)
    return Cell(number(value, digits), numeric=numeric or value is None)
