"""The verb `precision`: contests measured; a table, a figure, a page and a recommendation out of them."""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence
from datetime import UTC, datetime
from typing import Any

import numpy as np

from instrument.pipeline.folder import RunFolder
from instrument.pipeline.progress import progress_bar
from instrument.pipeline.record import versions
from instrument.precision.advice import advised, counted, crossovers, peers_ahead
from instrument.precision.conditions import machine, peers, told
from instrument.precision.contest import COLUMNS, OVER, WRONG, Contest, Form, Row, front, measured
from instrument.precision.contests import contests_of
from instrument.precision.page import About, page
from instrument.report.page import write_page
from instrument.report.precision import overview_figure, precision_figure
from instrument.report.style import drawer
from instrument.whole_file import write_ecsv

ROWS = 3  # contests that share a figure; of more each has its own on the page


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
        facts, contests = machine(), contests_of(what, tuple(plugins), form)
        if form.peers:
            show(told(contests))
        found = []
        with progress_bar("precision") as bar:
            for k, contest in enumerate(contests):
                rows = measured(contest, form.quick, lambda text, k=k: bar(k / len(contests), text))  # type: ignore[misc]
                found.append((contest, rows))
                for text in lines(contest, rows):
                    show(text)
        every = [row for _, rows in found for row in rows]
        known = versions() | (peers(contests)[0] if form.peers else {})
        write_ecsv(table(every, command, facts, known), folder.partial / "precision.ecsv")
        draw, three = drawer(folder.partial), [(contest, rows, front(rows)) for contest, rows in found]
        few = len(three) <= ROWS
        entries = [draw("precision", precision_figure(three) if few else overview_figure(three), "", wide=True)]
        if not few:
            entries += [draw(f"contest-{k}", precision_figure([one]), "", wide=True) for k, one in enumerate(three, 1)]
        advice = [advised(contest, rows) for contest, rows in found] + crossovers(found) + peers_ahead(found)
        about = About(what, command, form.quick, facts, known, told(contests) if form.peers else "")
        write_page(page(about, three, entries, advice), folder.partial / "precision.html")
        show("\n".join(advice))
        show(f"{len(every)} answers: {counted(every)}")
        show(f"written to {folder.finish()}")
    return not any(row.outcome in (OVER, WRONG) for row in every)


def lines(contest: Contest, rows: Sequence[Row]) -> list[str]:
    """What the terminal shows of a contest."""
    out = [f"{contest.name}", f"  error: {contest.error}", f"  truth: {contest.truth}"]
    out.append(f"  {'plugin':<32} {contest.knob:>16} {'error':>9} {'user':>9} {'seconds':>9} {'spread':>7} {'MB':>7}")
    for row in rows:
        numbers = f"{row.error:9.1e} {row.error_user:9.1e} {row.seconds:9.3g} {100 * row.seconds_spread:6.0f}%"
        if not np.isfinite(row.seconds):
            numbers = " " * 37
        size = f"{row.peak_bytes / 1e6:7.0f}" if np.isfinite(row.peak_bytes) else " " * 7
        asked = f"{row.asked:16.2g}" if np.isfinite(row.asked) else " " * 16
        out.append(f"  {row.plugin:<32} {asked} {numbers} {size}  {row.outcome}")
    return out


def table(rows: Sequence[Row], command: str, facts: dict[str, str], known: dict[str, str]) -> Any:
    """The rows as an astropy table; in its meta data versions, machine, and what the page says beyond the columns."""
    from astropy.table import QTable

    made = QTable(rows=[tuple(row)[: len(COLUMNS)] for row in rows], names=list(COLUMNS))
    made["seconds"].unit, made["peak_bytes"].unit = "s", "byte"
    more = ("user_max", "first", "compiled", "repeats")
    made.meta = {
        "made": datetime.now(UTC).isoformat(timespec="seconds"),
        "command": command,
        "versions": known,
        "machine": facts,
        "more": {name: [float(getattr(row, name)) for row in rows] for name in more},
    }
    return made
