"""The verb `precision`: contests measured; a table, a figure, a page and a recommendation out of them."""

from __future__ import annotations

import os
import platform
from collections.abc import Callable, Sequence
from datetime import UTC, datetime
from typing import Any

import numpy as np

from instrument.pipeline.folder import RunFolder
from instrument.pipeline.progress import progress_bar
from instrument.pipeline.record import versions
from instrument.precision.contest import OVER, REFUSED, WRONG, Contest, Form, Row, choice, front, measured
from instrument.precision.contests import contests_of
from instrument.report.page import Block, Card, Cell, Figures, Page, Section, Table, Text, duration, number, write_page
from instrument.report.precision import precision_figure
from instrument.report.style import drawer
from instrument.whole_file import write_ecsv

ERRORS = (1e-2, 1e-4, 1e-6, 1e-8, 1e-10)  # at which a choice is named


def precision(
    what: str,
    plugins: Sequence[str] = (),
    form: Form = Form(),  # noqa: B008  a tuple
    out: str | None = None,
    show: Callable[[str], None] = print,
    force: bool = False,
    command: str = "",
) -> bool:
    """Measure the contests of WHAT and write precision.ecsv, .png and .html; whether every promise was kept."""
    with RunFolder(f"precision-{os.path.basename(what).removesuffix('.toml')}", out, force) as folder:
        contests = contests_of(what, tuple(plugins), form)
        found = []
        with progress_bar("precision") as bar:
            for k, contest in enumerate(contests):
                rows = measured(contest, form.quick, lambda text, k=k: bar(k / len(contests), text))  # type: ignore[misc]
                found.append((contest, rows, front(rows)))
                for text in lines(contest, rows):
                    show(text)
        every = [row for _, rows, _ in found for row in rows]
        write_ecsv(table(every, command), folder.partial / "precision.ecsv")
        entry = drawer(folder.partial)("precision", precision_figure(found), _caption(), wide=True)
        advice = [advised(contest, rows) for contest, rows, _ in found]
        write_page(_page(what, found, entry, advice, command, form.quick), folder.partial / "precision.html")
        show("\n".join(advice))
        show(f"written to {folder.finish()}")
    return not any(row.outcome in (OVER, WRONG) for row in every)


def lines(contest: Contest, rows: Sequence[Row]) -> list[str]:
    """What the terminal shows of a contest."""
    out = [f"{contest.name}", f"  error: {contest.error}", f"  truth: {contest.truth}"]
    out.append(f"  {'plugin':<28} {contest.knob:>11} {'error':>9} {'user':>9} {'seconds':>9} {'spread':>7} {'MB':>7}")
    for row in rows:
        numbers = f"{row.error:9.1e} {row.error_user:9.1e} {row.seconds:9.3g} {100 * row.seconds_spread:6.0f}%"
        if not np.isfinite(row.seconds):
            numbers = " " * 37
        size = f"{row.peak_bytes / 1e6:7.0f}" if np.isfinite(row.peak_bytes) else " " * 7
        out.append(f"  {row.plugin:<28} {row.asked:11.2g} {numbers} {size}  {row.outcome}")
    return out


def table(rows: Sequence[Row], command: str = "") -> Any:
    """The rows as an astropy table, with the versions and the machine in its meta data."""
    from astropy.table import QTable

    made = QTable(rows=[tuple(row) for row in rows], names=list(Row._fields))
    made["seconds"].unit, made["peak_bytes"].unit = "s", "byte"
    made.meta = {
        "made": datetime.now(UTC).isoformat(timespec="seconds"),
        "command": command,
        "versions": versions(),
        "machine": f"{platform.machine()}, {os.cpu_count()} cores",
    }
    return made


def advised(contest: Contest, rows: Sequence[Row]) -> str:
    """What to take at which error, in one line."""
    picks: dict[str, list[float]] = {}
    for error in ERRORS:
        row = choice(rows, error)
        if row is not None:
            picks.setdefault(f"{row.plugin}, {contest.knob} {row.asked:.2g} ({row.seconds:.2g} s)", []).append(error)
    if picks:
        ways = (
            f"for an error of {' to '.join(dict.fromkeys(f'{e:.0e}' for e in (errors[0], errors[-1])))} take {pick}"
            for pick, errors in picks.items()
        )
        return f"{contest.name}: {'; '.join(ways)}"
    best = min((r for r in rows if np.isfinite(r.error)), key=lambda r: r.error, default=None)
    if best is None:
        return f"{contest.name}: no answer from anyone"
    return (
        f"{contest.name}: nobody comes below {ERRORS[0]:g}; least error {best.error:.2g}, by {best.plugin}, "
        f"{contest.knob} {best.asked:.2g} ({best.seconds:.2g} s)"
    )


def _caption() -> str:
    return (
        "Left: error against wall seconds, the first and the last value that was asked beside the line, the Pareto "
        "front in grey, at the edge a cross and the count of those without an answer. Middle: the error in the user's "
        "quantity. Right: what was asked and what came; dotted where there was no answer."
    )


def _page(what: str, found: Sequence[Any], entry: Any, advice: Sequence[str], command: str, quick: bool) -> Page:
    every = [row for _, rows, _ in found for row in rows]
    bad = [row for row in every if row.outcome in (OVER, WRONG)]
    refused = sum(row.outcome.startswith(REFUSED) for row in every)
    wrong = sum(row.outcome == WRONG for row in every)
    cards = [
        Card("answers", str(sum(np.isfinite(row.error) for row in every)), f"of {len(every)} asked for"),
        Card("refused", str(refused), "with a reason"),
        Card("over the tolerance", str(sum(r.outcome == OVER for r in every)), "", "bad" if bad else "good"),
        Card("said converged, was wrong", str(wrong), "", "bad" if wrong else "good"),
    ]
    sections = [
        Section("What to take", [Text(text) for text in advice]),
        Section("Error against time", [Figures([entry])]),
    ]
    for contest, rows, best in found:
        heads = ["plugin", contest.knob, "error", "user's error", "time", "spread", "peak MB", "outcome"]
        body = [_cells(row, row in best) for row in rows]
        words = [f"Error: {contest.error}.", f"User's error: {contest.error_user}.", f"Truth: {contest.truth}."]
        blocks: list[Block] = [Text(" ".join(words)), Table(heads, body, "Bold marks: the Pareto front.")]
        sections.append(Section(contest.name, blocks))
    known = ", ".join(f"{name} {number}" for name, number in versions().items())
    form = (
        f"three repeats, spread printed only ({os.cpu_count()} cores)"
        if quick
        else f"full form ({os.cpu_count()} cores)"
    )
    return Page(
        title=f"Error against run time: {what}",
        subtitle=f"{datetime.now(UTC):%Y-%m-%d %H:%M} UTC, {form}",
        verdict="Every promise was kept." if not bad else f"{len(bad)} answers broke their promise.",
        mark="good" if not bad else "bad",
        cards=cards,
        sections=[*sections, Section("Repeat it", [Text(command, code=True), Text(known)])],
        footer=f"instrument {versions().get('instrument', '')}",
    )


def _cells(row: Row, best: bool) -> list[Any]:
    mark: Any = "bad" if row.outcome in (OVER, WRONG) else "good" if best else ""
    size = f"{row.peak_bytes / 1e6:.0f}" if np.isfinite(row.peak_bytes) else "–"
    spread = f"{100 * row.seconds_spread:.0f} %" if np.isfinite(row.seconds_spread) else "–"
    time = duration(row.seconds) if np.isfinite(row.seconds) else "–"
    return [
        row.plugin, number(row.asked), Cell(number(row.error), mark=mark, numeric=True), number(row.error_user),
        time, spread, size, row.outcome,
    ]  # fmt: skip
