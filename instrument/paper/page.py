"""The page of the paper's experiments: their verdicts, then tables and figures of each."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from instrument.paper.experiments import EXPERIMENTS
from instrument.paper.finding import AGREES, CORRECTED, DIFFERS, MORE, NOT, Finding
from instrument.report.page import Block, Card, Cell, Figures, Page, Section, Table, Text, duration, number

HEADS = ("", "ours", "the paper", "agreement", "why, and what others found")
MARKS: dict[str, Any] = {AGREES: "good", NOT: "bad"}


def page(outcomes: Sequence[Any], what: Mapping[str, Any]) -> Page:
    """Of the outcomes of experiments and their record."""
    said = [f.agreement for one in outcomes for f in one.findings]
    bad, total = said.count(NOT), len(said) - said.count(MORE)
    cards = [
        Card("the paper's numbers", str(total), f"{said.count(MORE)} more beside them"),
        Card("reproduced", str(said.count(AGREES)), "", "good"),
        Card("differ for a reason", str(said.count(DIFFERS)), "the paper's with one thing changed"),
        Card("slips", str(said.count(CORRECTED)), "what is printed is not what is right"),
        Card("not reproduced", str(bad), "", "bad" if bad else "good"),
        Card("time", duration(sum(one.seconds for one in outcomes)), f"{what['form']} form"),
    ]
    rows = [[one.name, EXPERIMENTS[one.name][1], one.verdict, duration(one.seconds)] for one in outcomes]
    sections = [Section("Experiments", [Table(["", "", "verdict", "time"], rows)])]
    for one in outcomes:
        blocks: list[Block] = [Table(HEADS, [_cells(f) for f in one.findings])]
        if one.figures:
            blocks.append(Figures(one.figures))
        blocks.append(Text(f"{one.verdict[0].upper()}{one.verdict[1:]}."))
        sections.append(Section(f"{one.name}: {EXPERIMENTS[one.name][1]}", blocks))
    known = ", ".join(f"{name} {text}" for name, text in what["versions"].items())
    last = [Text(what["command"], code=True)] if what["command"] else []
    return Page(
        title="Asad et al. (2015), run again",
        subtitle=f"{what['finished']}, {what['form']} form",
        verdict=_verdict(bad, total, what["not_run"]),
        mark="bad" if bad or what["not_run"] else "good",
        cards=cards,
        sections=[*sections, Section("Repeat it", [*last, Text(known)])],
        footer=f"instrument {what['versions']['instrument']}",
    )


def _verdict(bad: int, total: int, not_run: Sequence[str]) -> str:
    """The line under the title."""
    stopped = f" Stopped before the end: {', '.join(not_run)} not run." if not_run else ""
    if bad:
        return f"{bad} of {total} not reproduced.{stopped}"
    every = "Every number is reproduced, or its difference explained." if total else "Beyond the paper."
    return f"Of what was run: {every}{stopped}" if stopped else every


def _cells(f: Finding) -> list[Any]:
    why = " ".join(text for text in (f.because, f.since) if text)
    ours = Cell(f"{number(f.ours)} {f.unit}".strip(), numeric=True)
    return [f.what, ours, f.asked, Cell(f.agreement, mark=MARKS.get(f.agreement, "")), why]
