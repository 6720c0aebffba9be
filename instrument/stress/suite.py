"""The verb `stress`: cases tried one after the other, a table while it goes, stress.ecsv, and how many were right."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from instrument.pipeline.folder import RunFolder
from instrument.pipeline.progress import progress_bar
from instrument.stress import MODULES
from instrument.stress.case import NOT_THERE, REFUSED, RIGHT, WRONG, Case, Row, cases_of, judged
from instrument.stress.subjects import Subject, subjects
from instrument.whole_file import write_ecsv

ENDED = (RIGHT, REFUSED, WRONG)


def all_cases() -> list[Case]:
    """Every case, in the order of the list."""
    from importlib import import_module

    return [c for name in MODULES for c in cases_of(import_module(f"instrument.stress.{name}"))]


def trials(found: Sequence[Subject], cases: Sequence[Case]) -> list[tuple[Case, Subject]]:
    """Which case is tried on what; a case whose subject is not built stands there once."""
    out = []
    for c in cases:
        fitting = [s for s in found if s.stage == c.stage]
        out += [(c, s) for s in (fitting[:1] if c.tried is None else fitting)]
    return out


def rows(todo: Sequence[tuple[Case, Subject]]) -> Iterator[Row]:
    """The verdict of each."""
    several = {s.stage for _, s in todo if len({o.name for _, o in todo if o.stage == s.stage}) > 1}
    for c, s in todo:
        label = f" ({s.name})" if s.stage in several and c.tried is not None else ""
        if s.trouble:
            yield Row(f"{c.key}: {c.name}{label}", c.stage, NOT_THERE, np.nan, np.nan, c.right, s.trouble)
        else:
            yield judged(c, s.plugin, label)


def stress(
    what: str | None,
    out: str | None = None,
    show: Callable[[str], None] = print,
    settings: Mapping[str, Any] | None = None,
    force: bool = False,
) -> bool:
    """Try all cases that fit; with `out` a folder with stress.ecsv is written. True where none came out WRONG."""
    todo = trials(subjects(what, settings), all_cases())
    folder = None if out is None else RunFolder("stress", out, force)
    done: list[Row] = []
    with progress_bar("stress") as progress:
        for row in rows(todo):
            done.append(row)
            show(_line(row))
            progress(len(done) / len(todo), row.case)
    counts = Counter(row.verdict for row in done)
    if folder is not None:
        with folder:
            write_ecsv(_table(done, what, counts), Path(folder.partial) / "stress.ecsv")
            folder.finish()
        show(f"written: {folder.path / 'stress.ecsv'}")
    missing = f", {counts[NOT_THERE]} not there" if counts[NOT_THERE] else ""
    show(", ".join(f"{counts[verdict]} {verdict}" for verdict in ENDED) + missing)
    return not counts[WRONG]


def _line(row: Row) -> str:
    digits = "" if np.isnan(row.digits) else f"{row.digits:.1f}"
    condition = "" if np.isnan(row.condition) else f"{row.condition:.0e}"
    line = f"{row.verdict:<9} {digits:>4}  {condition:>6}  {row.stage:<12} {row.case}"
    if row.verdict == WRONG:
        line += f"\n{'':<25}right: {row.right}"
    return line + (f"\n{'':<25}{row.remark}" if row.remark else "")


def _table(done: Sequence[Row], what: str | None, counts: Mapping[str, int]) -> Any:
    from astropy.table import Table

    columns = ("case", "stage", "verdict", "digits", "condition")
    table = Table({name: [getattr(row, name) for row in done] for name in columns})
    table.meta["what"] = what or "everything"
    table.meta["counts"] = {verdict: counts[verdict] for verdict in (*ENDED, NOT_THERE)}
    table.meta["right"] = {row.case: row.right for row in done}
    table.meta["remarks"] = {row.case: row.remark for row in done if row.remark}
    return table
