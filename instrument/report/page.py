"""One self-contained HTML page: building blocks, the page of a run made of them, and the writing of it.

A new stage adds a `Section` of blocks; the template knows the kinds of block and nothing else. Everything is escaped.
"""

from __future__ import annotations

import base64
import os
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, ClassVar, Literal

import numpy as np

from instrument.errors import FileError

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
    """Column heads and rows of cells (text, numbers, `Cell`); it scrolls sideways in its own box."""

    kind: ClassVar[str] = "table"
    columns: Sequence[str]
    rows: Sequence[Sequence[Any]]
    caption: str = ""

    @property
    def body(self) -> list[list[Cell]]:
        """The rows with every value as a `Cell`."""
        return [[_cell(value) for value in row] for row in self.rows]

    @classmethod
    def of(cls, table: Any, caption: str = "") -> Table:
        """An astropy table, units in the heads, 5 digits; above 2000 rows the rest is left out, as the caption says."""
        heads = [f"{name} ({table[name].unit})" if table[name].unit else name for name in table.colnames]
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
    target = Path(path)
    partial = target.with_name(target.name + ".part")
    partial.write_text(here.get_template("page.html").render(page=page), encoding="utf-8")
    partial.replace(target)
    return target


def page_of_run(
    record: Mapping[str, Any],
    figures: Iterable[FigureEntry] = (),
    sources: Any = None,
    more: Iterable[Section] = (),
) -> Page:
    """The page of a run from what `run.json` holds; a part that is absent there is absent here.

    `sources` is an astropy table of all sources, `more` are sections of other stages, put after the figures. Read are
    name, title, finished, seed, versions, machine, plan (text, engine), seconds, checks, leakage, image, and where
    given command and stage_errors (stage -> how wrong it may be).
    """
    plan = record.get("plan", {})
    sections = [
        Section("Plan", [Text("\n".join(plan.get("text", ())), code=True)] if plan.get("text") else []),
        Section("Leakage by distance", _rings(record.get("leakage", {}))),
        Section("Figures", [Figures(entries)] if (entries := list(figures)) else []),
        *more,
        Section("Checks", _checks(record)),
        Section("What each stage cost, and how wrong it may be", _stages(record)),
        Section("All sources", [_all_sources(sources)] if sources is not None else []),
        Section("To run it again", _again(record)),
    ]
    short = [name for name, check in record.get("checks", {}).items() if not check.get("passed", True)]
    verdict = f"Done, but fell short: {', '.join(short)}." if short else "Done; every check held."
    if not record.get("checks"):
        verdict = "Done; nothing was checked."
    return Page(
        title=record.get("title") or record.get("name", "run"),
        subtitle=f"scene {record.get('name', '')}, finished {record.get('finished', '').replace('T', ' ')}",
        verdict=verdict,
        mark="bad" if short else "good" if record.get("checks") else "",
        cards=_cards(record),
        sections=[section for section in sections if section.blocks],
        footer=f"instrument {record.get('versions', {}).get('instrument', '')}",
    )


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


def _mark(passed: bool, good: str = "held", bad: str = "fell short") -> Cell:
    return Cell(good if passed else bad, mark="good" if passed else "bad")


def _cards(record: Mapping[str, Any]) -> list[Card]:
    cards = []
    leakage, checks = record.get("leakage", {}), record.get("checks", {})
    if inside := leakage.get("inside_4_deg"):
        null = leakage.get("near_null", 0)
        note = f"{null} of the whole field near a null, left out" if null else "none near a null of the beam"
        cards.append(Card("Sources in 4°", str(inside["sources"]), note))
        for kind in ("linear", "circular"):
            median, most = (number(inside[f"{kind}_{what}"]) for what in ("median", "max"))
            cards.append(
                Card(f"{kind.capitalize()} leakage in 4°", f"{median}\u00a0%", f"median; at most {most}\u00a0%")
            )
    if check := checks.get("prediction"):
        note = f"of the {number(check['relative_to_jy'], 4)} Jy in the sky; bound {check['bound']:.1e}"
        cards.append(Card("Prediction error", f"{check['error']:.1e}", note, "good" if check["passed"] else "bad"))
    if "psf_arcmin" in record.get("image", {}):
        major, minor = (number(width) for width in record["image"]["psf_arcmin"])
        cards.append(Card("PSF", f"{major}′ × {minor}′", "width at half maximum"))
    if seconds := record.get("seconds"):
        parts = [record.get("plan", {}).get("engine"), record.get("machine", {}).get("workers")]
        note = f"engine {parts[0]}, {parts[1]} workers" if all(parts) else ""
        cards.append(Card("Wall time", duration(sum(seconds.values())), note))
    return cards


def _rings(leakage: Mapping[str, Any]) -> list[Block]:
    if not leakage.get("rings"):
        return []
    rows = [
        [f"{r['from_deg']:g} – {r['to_deg']:g}", r["sources"]]
        + [float(r[f"{kind}_{what}"]) for kind in ("linear", "circular") for what in ("median", "max")]
        for r in leakage["rings"]
    ]
    heads = ["distance (deg)", "sources", "I→P median (%)", "I→P max (%)", "I→V median (%)", "I→V max (%)"]
    return [Table(heads, rows, "P is sqrt(Q² + U²); both in % of the apparent I of the source.")]


def _checks(record: Mapping[str, Any]) -> list[Block]:
    rows: list[list[Any]] = []
    for name, check in record.get("checks", {}).items():
        if name == "prediction":
            found, wanted = f"error {check['error']:.1e}", f"at most {check['bound']:.1e}"
            name = f"prediction, {check['samples']} visibilities against the definition"
        else:
            found, wanted = "; ".join(dict.fromkeys(check.get("outcome", ()))), ""
        rows.append([name, found, wanted, _mark(check.get("passed", True))])
        if "flux_in_jy" in check:
            given, seen = check["flux_in_jy"], check["flux_out_jy"]
            share = f"apparent, {number(100 * seen / given)}\u00a0%" if given else "apparent"
            rows.append(
                ["flux of all sources", f"{number(seen, 4)} Jy {share}", f"{number(given, 4)} Jy in the sky", ""]
            )
    if image := record.get("image"):
        for stokes, rms in image.get("rms", {}).items():
            rows.append([f"rms of the {stokes} image", f"{number(float(rms))} {image['unit']}", "", ""])
    return [Table(["check", "found", "expected", "verdict"], rows)] if rows else []


def _stages(record: Mapping[str, Any]) -> list[Block]:
    seconds, checks = record.get("seconds", {}), record.get("checks", {})
    if not seconds:
        return []
    wrong = dict(record.get("stage_errors", {}))
    if check := checks.get("prediction"):
        wrong.setdefault("predict", f"{check['error']:.1e} measured, {check['bound']:.1e} at most, of the total flux")
    if check := checks.get("photometry"):
        wrong.setdefault("photometry", "; ".join(dict.fromkeys(check["outcome"])))
    longest = max(seconds.values()) or 1.0
    rows = [
        [stage, Cell(duration(spent), bar=spent / longest), wrong.get(stage, "–")]
        for stage, spent in sorted(seconds.items(), key=lambda item: -item[1])
    ]
    return [Table(["stage", "time", "how wrong it may be"], rows)]


def _all_sources(sources: Any) -> Details:
    return Details(f"{len(sources)} sources", [Table.of(sources)])


def _again(record: Mapping[str, Any]) -> list[Block]:
    blocks: list[Block] = [Text(record.get("command", "instrument run scene.toml"), code=True)]
    rows = [["seed", number(record.get("seed"))]]
    rows += [[name, str(value)] for name, value in record.get("machine", {}).items()]
    rows += [[name, str(value)] for name, value in record.get("versions", {}).items()]
    return [Details("Command, seed, versions", [*blocks, Table(["what", "value"], rows)])]
