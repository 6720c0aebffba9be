"""The page of the paper's experiments: their verdicts, then tables and figures of each."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from instrument.paper.experiments import EXPERIMENTS, WORDS
from instrument.paper.finding import AGREES, CORRECTED, DIFFERS, DOUBTFUL, MORE, NOT, Finding, tally
from instrument.report.page import Block, Card, Cell, Figures, Page, Section, Table, Text, duration

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
        Card("corrected as slips", str(said.count(CORRECTED)), "what is printed is not what is right"),
        *[Card("doubtful", str(said.count(DOUBTFUL)), "what is printed is kept")] * (DOUBTFUL in said),
        Card("not reproduced", str(bad), "", "bad" if bad else "good"),
        Card("time", duration(sum(one.seconds for one in outcomes)), f"{what['form']} form"),
    ]
    rows = [[one.name, EXPERIMENTS[one.name][1], one.verdict, duration(one.seconds)] for one in outcomes]
    sections = [Section("Experiments", [Table(["", "what", "verdict", "time"], rows, stack=True)])]
    for one in outcomes:
        blocks: list[Block] = [Text(WORDS[one.name])] if one.name in WORDS else []
        blocks.append(Table(HEADS, [_cells(f) for f in one.findings], stack=True))
        if one.figures:
            blocks.append(Figures(one.figures))
        blocks.append(Text(f"{one.verdict[0].upper()}{one.verdict[1:]}."))
        sections.append(Section(f"{one.name}: {EXPERIMENTS[one.name][1]}", blocks))
    known = ", ".join(f"{name} {text}" for name, text in what["versions"].items())
    return Page(
        title="Asad et al. (2015), run again",
        subtitle=f"{what['finished']}, {what['form']} form",
        verdict=_verdict([f for one in outcomes for f in one.findings], what["not_run"]),
        mark="bad" if bad or what["not_run"] else "good",
        cards=cards,
        sections=[*sections, Section("Repeat it", [Text(_repeat(outcomes, what), code=True), Text(known)])],
        footer=f"instrument {what['versions']['instrument']}",
    )


def _verdict(findings: Sequence[Finding], not_run: Sequence[str]) -> str:
    """The line under the title."""
    stopped = f" Stopped before the end: {', '.join(not_run)} not run." if not_run else ""
    every = f"{tally(findings)}." if any(f.within for f in findings) else "Beyond the paper."
    return f"Of what was run: {every}{stopped}" if stopped else every


def _repeat(outcomes: Sequence[Any], what: Mapping[str, Any]) -> str:
    """The command that does the same once more, into the next free folder."""
    names = [one.name for one in outcomes] + list(what["not_run"])
    words = ["instrument", "paper", *([] if names == list(EXPERIMENTS) else names)]
    words += ["--quick"] * (what["form"] == "quick")
    return " ".join(words + [f"--seed {what['seed']}"] * isinstance(what["seed"], int))


def _cells(f: Finding) -> list[Any]:
    agreement = Cell(f.agreement, mark=MARKS.get(f.agreement, ""))
    return [f.what, Cell(f.value, numeric=True), f.asked, agreement, "; ".join(f.why)]
