"""The page of two runs side by side: what changed, spectra on common axes, figures beside one another."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Protocol

import numpy as np
from matplotlib.axes import Axes

from instrument.errors import FileError
from instrument.report.page import Block, Card, FigureEntry, Figures, Page, Section, Table, Text
from instrument.report.spectra import log_numbers
from instrument.report.style import BLUE, ORANGE, axes_of, styled

TITLES = {
    "scene": "What the scenes say differently",
    "versions": "Versions",
    "checks": "Checks",
    "errors": "How wrong each stage may be",
    "numbers": "What came out",
    "costs": "What it cost",
}


class Run(Protocol):
    """What is needed of a run: its label, its files, and tables by name."""

    @property
    def label(self) -> str:
        """What the run is called."""

    def named(self, *endings: str) -> list[str]:
        """Names of files with such endings."""

    def table(self, name: str) -> Any:
        """A table."""

    @property
    def files(self) -> dict[str, Any]:
        """Paths by name."""


class Compared(Protocol):
    """What is needed of a comparison."""

    first: Any
    second: Any
    columns: list[Any]
    alike: list[str]
    apart: list[str]

    def parts(self) -> list[tuple[str, list[Any]]]:
        """What changed, by what it is."""


def page_of_comparison(found: Compared, draw: Callable[..., FigureEntry]) -> Page:
    """The page; `draw(name, drawing, caption)` makes a figure of its folder."""
    first, second = found.first, found.second
    sections = [
        Section("Spectra", _spectra(first, second, draw)),
        Section("Figures side by side", _figures(first, second)),
    ]
    tables = [Section(TITLES[name], _changes(changes, first, second)) for name, changes in found.parts() if changes]
    sections = [*tables[:1], *sections, *tables[1:], Section("Tables and images", _columns(found))]
    same = [TITLES[name].lower() for name, changes in found.parts() if not changes]
    if same:
        sections.append(Section("The same in both", [Text("; ".join(same))]))
    return Page(
        title=f"{first.label} and {second.label}",
        subtitle="; ".join(f"{run.text('name')}, finished {_when(run)}" for run in (first, second)),
        verdict="Two runs compared.",
        cards=[Card(TITLES[name], str(len(changes)), "differ") for name, changes in found.parts() if changes],
        sections=[section for section in sections if section.blocks],
        footer=f"instrument {first.part('versions').get('instrument', '')}",
    )


def _when(run: Any) -> str:
    return str(run.text("finished")).replace("T", " ").replace("+00:00", " UTC")


def _changes(changes: list[Any], first: Run, second: Run) -> list[Block]:
    rows = [[one.key, _value(one.first), _value(one.second), _ratio(one.first, one.second)] for one in changes]
    if not any(row[3] for row in rows):
        return [Table(["what", first.label, second.label], [row[:3] for row in rows])]
    return [Table(["what", first.label, second.label, "change"], rows)]


def _value(value: Any) -> Any:
    if isinstance(value, int | float) or value is None:
        return value
    text = str(value)
    return text if len(text) <= 120 else f"{text[:117]}..."


def _ratio(a: Any, b: Any) -> str:
    plain = all(isinstance(v, int | float) and not isinstance(v, bool) for v in (a, b))
    return f"{100 * (b / a - 1):+.2g} %" if plain and a and np.isfinite(b / a) else ""


def _columns(found: Compared) -> list[Block]:
    blocks: list[Block] = []
    if found.columns:
        rows = [[one.file, one.column, one.rows, 100 * one.rms, 100 * one.largest, one.where] for one in found.columns]
        heads = ["file", "column", "values", "rms of the difference (%)", "largest (%)", "at"]
        blocks.append(Table(heads, rows, "As shares of the rms of the first."))
    if found.alike:
        blocks.append(Text(f"The same to the last bit: {', '.join(found.alike)}."))
    return [*blocks, *(Text(text) for text in found.apart)]


def _spectra(first: Run, second: Run, draw: Callable[..., FigureEntry]) -> list[Block]:
    """Spectra of one wavenumber that both have, on common axes."""
    entries = []
    for name in first.named(".ecsv"):
        if name not in second.files:
            continue
        try:
            tables = [run.table(name) for run in (first, second)]
        except FileError:
            continue  # named among the files that cannot be compared
        wave = tables[0].colnames[0] if len(tables[0].colnames) else ""
        if wave not in ("k", "k_perp") or "k_par" in tables[0].colnames:
            continue
        if all({wave, "power"} <= set(table.colnames) for table in tables):
            stem = name.removesuffix(".ecsv").replace("/", "_")
            ax = two_spectra(tables[0], tables[1], wave, (first.label, second.label))
            entries.append(draw(f"compare_{stem}", ax, stem.replace("_", " ")))
    return [Figures(entries)] if entries else []


@styled
def two_spectra(one: Any, two: Any, wave: str, labels: tuple[str, str], ax: Axes | None = None) -> Axes:
    """Power (N,) of two tables against their wavenumber, log-log; bins without power are left out."""
    ax = axes_of(ax, (6.4, 4.6))
    ax.set(xscale="log", yscale="log")
    # the first is drawn larger, and seen where both are the same
    for table, label, colour, mark, size in zip((one, two), labels, (BLUE, ORANGE), "os", (9, 4), strict=True):
        k, power = (np.asarray(table[name], float) for name in (wave, "power"))
        good = np.isfinite(k) & (k > 0) & np.isfinite(power) & (power > 0)
        known = label if good.any() else f"{label}: no power"
        ax.plot(k[good], power[good], color=colour, marker=mark, ms=size, lw=size / 3, label=known, alpha=0.85)
    unit = one["power"].unit
    ax.set(
        xlabel=r"$k_\perp$ (1/Mpc)" if wave == "k_perp" else r"$k$ (1/Mpc)",
        ylabel=f"power ({unit:latex_inline})" if unit else "power",
    )
    for axis, (low, high) in ((ax.xaxis, ax.get_xlim()), (ax.yaxis, ax.get_ylim())):
        log_numbers(axis, high / low)
    ax.grid(color="#dddddd", lw=0.6)
    ax.legend(loc="upper center", bbox_to_anchor=(0.46, -0.16), ncols=2, frameon=False)
    return ax


def _figures(first: Run, second: Run) -> list[Block]:
    """Every figure that both have, beside one another."""
    blocks: list[Block] = []
    for name in first.named(".png"):
        if name in second.files:
            pair = [
                FigureEntry(run.files[name], f"{name.removesuffix('.png').replace('_', ' ')}: {run.label}")
                for run in (first, second)
            ]
            blocks.append(Figures(pair))
    lone = [
        f"{name}: in {run.label} alone"
        for run, other in ((first, second), (second, first))
        for name in run.named(".png")
        if name not in other.files
    ]
    return [*blocks, *([Text("; ".join(lone))] if lone else [])]
