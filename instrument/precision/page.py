"""The page of contests: what to take, figures, tables, on what it was measured, how to repeat it."""

from __future__ import annotations

from collections.abc import Sequence
from datetime import UTC, datetime
from typing import Any, NamedTuple

import numpy as np

from instrument.precision.contest import OVER, REFUSED, WRONG, Contest, Row
from instrument.report.page import Block, Card, Cell, FigureEntry, Figures, Page, Section, Table, Text, duration, number

HEADS = (
    "error",
    "user's, rms",
    "user's, largest",
    "time",
    "spread",
    "repeats",
    "first",
    "compiling",
    "peak MB",
    "outcome",
)
FIRST = (
    "Time is the median of answers whose loops are compiled. First: the first answer of this process; compiling: "
    "the seconds of it in which loops were compiled, or read from where they are kept."
)
CAPTION = (
    "Left: error against wall seconds, the first and the last value that was asked beside the line, the Pareto "
    "front in grey, at the edge a cross and the count of those without an answer; hollow and dashed: programs of "
    "others. Middle: the error in the user's quantity, rms, with a line up to its largest. Right: what was asked and "
    "what came; dotted where there was no answer: the floor."
)


class About(NamedTuple):
    """What was asked for, and on what it ran."""

    what: str
    command: str
    quick: bool
    facts: dict[str, str]
    known: dict[str, str]
    peers: str


def page(
    about: About,
    found: Sequence[tuple[Contest, Sequence[Row], Sequence[Row]]],
    entries: Sequence[FigureEntry],
    advice: Sequence[str],
) -> Page:
    """Of contests with their rows and fronts: one figure of all, or one of all and then one of each."""
    every = [row for _, rows, _ in found for row in rows]
    bad = [row for row in every if row.outcome in (OVER, WRONG)]
    each = dict(enumerate(entries[1:]))
    sections = [Section("What to take", [Text(text) for text in advice])]
    sections.append(Section("Error against time", [Figures([entries[0]]), Text(CAPTION)]))
    for k, (contest, rows, best) in enumerate(found):
        words = [f"Error: {contest.error}.", f"User's error: {contest.error_user}.", f"Truth: {contest.truth}."]
        blocks: list[Block] = [Text(" ".join(words))]
        if k in each:
            blocks.append(Figures([each[k]]))
        body = [_cells(row, row in best) for row in rows]
        blocks.append(Table(["plugin", contest.knob, *HEADS], body, f"Bold marks: the Pareto front. {FIRST}"))
        sections.append(Section(contest.name, blocks))
    ran = "; ".join(f"{name}: {text}" for name, text in about.facts.items())
    known = ", ".join(f"{name} {text}" for name, text in about.known.items())
    last = [about.command, ran, known, about.peers]
    form = (
        "three repeats, spread printed only" if about.quick else "full form: repeated until the median is known to 5 %"
    )
    return Page(
        title=f"Error against run time: {about.what}",
        subtitle=f"{datetime.now(UTC):%Y-%m-%d %H:%M} UTC, {form}",
        verdict="Every promise was kept." if not bad else f"{len(bad)} answers broke their promise.",
        mark="good" if not bad else "bad",
        cards=_cards(every, bad),
        sections=[*sections, Section("Repeat it", [Text(text, code=not k) for k, text in enumerate(last) if text])],
        footer=f"instrument {about.known.get('instrument', '')}",
    )


def _cards(every: Sequence[Row], bad: Sequence[Row]) -> list[Card]:
    refused = sum(row.outcome.startswith(REFUSED) for row in every)
    wrong = sum(row.outcome == WRONG for row in every)
    return [
        Card("answers", str(sum(np.isfinite(row.error) for row in every)), f"of {len(every)} asked for"),
        Card("refused", str(refused), "with a reason"),
        Card("over the tolerance", str(sum(r.outcome == OVER for r in every)), "", "bad" if bad else "good"),
        Card("said converged, was wrong", str(wrong), "", "bad" if wrong else "good"),
    ]


def _cells(row: Row, best: bool) -> list[Any]:
    mark: Any = "bad" if row.outcome in (OVER, WRONG) else "good" if best else ""

    def shown(value: float, text: str) -> str:
        return text if np.isfinite(value) else "–"

    return [
        row.plugin, shown(row.asked, number(row.asked)), Cell(number(row.error), mark=mark, numeric=True),
        number(row.error_user), shown(row.user_max, number(row.user_max)),
        shown(row.seconds, duration(row.seconds)), shown(row.seconds, f"{100 * row.seconds_spread:.0f} %"), row.repeats,
        shown(row.first, duration(row.first)), shown(row.compiled, duration(row.compiled)),
        shown(row.peak_bytes, f"{row.peak_bytes / 1e6:.0f}"), row.outcome,
    ]  # fmt: skip
