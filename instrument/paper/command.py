"""The verb `paper`: experiments run one after the other; a table, a page and run.json of what they found."""

from __future__ import annotations

import shutil
import time
from collections.abc import Callable, Sequence
from datetime import UTC, datetime
from typing import Any, NamedTuple

from instrument.errors import InputError, unused_ledger
from instrument.memory import high_water
from instrument.numbers import brief
from instrument.paper.bench import Bench
from instrument.paper.experiments import EXPERIMENTS, chosen, experiment, seconds
from instrument.paper.finding import NOT, Finding, verdict
from instrument.paper.page import page
from instrument.pipeline.folder import RunFolder
from instrument.pipeline.progress import progress_bar
from instrument.pipeline.record import json_text, versions
from instrument.report.page import FigureEntry, duration, number, write_page
from instrument.whole_file import write_ecsv


class Outcome(NamedTuple):
    """What an experiment found, in what time, and the most memory that the process had had by its end."""

    name: str
    findings: list[Finding]
    figures: list[FigureEntry]
    seconds: float
    peak_bytes: float

    @property
    def verdict(self) -> str:
        """Its last line."""
        return verdict(self.findings)


def paper(
    names: Sequence[str] = (),
    quick: bool = False,
    seed: int | None = None,
    out: str | None = None,
    show: Callable[[str], None] = print,
    force: bool = False,
    command: str = "",
) -> bool:
    """Run experiments (default: all) and write their folder; whether every number of the paper was reproduced.

    A number that differs for a reason counts as reproduced. Where an experiment fails or is interrupted, those before
    it are written, in a folder of their own where there was one already, and the error goes on. Raises `InputError`
    for a name that is none, or a seed below 1.
    """
    every = chosen(names)
    if seed is not None and not 1 <= seed < 2**31:
        raise InputError(f"--seed {brief(seed)}: give 1 to 2147483647, or leave it out for the seeds of the scenes")
    outcomes: list[Outcome] = []
    due = {name: seconds(name, quick) for name in every}
    stopped: BaseException | None = None
    with RunFolder("-".join(["paper", *names]), out, force) as folder, progress_bar("paper") as bar, unused_ledger():
        show(announced(due, quick))
        for k, name in enumerate(every):
            bar(sum(due[n] for n in every[:k]) / sum(due.values()), name)
            bench = Bench(folder.partial / name, quick, seed)
            try:
                outcomes.append(_outcome(name, bench))
            except BaseException as error:  # also Ctrl-C: half an hour of others is kept
                if not outcomes:
                    raise
                stopped = error
                shutil.rmtree(bench.folder)
                break
            show("\n".join(lines(outcomes[-1])))
        what = record(outcomes, quick, seed, command) | {"not_run": every[len(outcomes) :]}
        for one in outcomes:
            write_ecsv(table(one.findings), folder.partial / f"{one.name}.ecsv")
        left = f"Not run: {', '.join(what['not_run'])}.\n\n" if stopped else ""
        (folder.partial / "paper.md").write_text(left + markdown(outcomes), encoding="utf-8")
        write_page(page(outcomes, what), folder.partial / "paper.html")
        (folder.partial / "run.json").write_text(json_text(what), encoding="utf-8")
        if stopped is not None:
            folder.beside()
        show(f"written to {folder.finish()}")
        if stopped is not None:
            show(f"of {len(every)} experiments {len(outcomes)} ended; not {', '.join(what['not_run'])}")
            raise stopped
    return not any(f.agreement == NOT for one in outcomes for f in one.findings)


def announced(due: dict[str, float], quick: bool) -> str:
    """What will be done, and in about what time."""
    longest = max(due, key=lambda name: due[name])
    what = f"{len(due)} experiments, '{longest}' {duration(due[longest])} of it" if len(due) > 1 else f"'{longest}'"
    return (
        f"paper         {'quick' if quick else 'full'} form, about {duration(sum(due.values()))} on two cores: {what}"
    )


def _outcome(name: str, bench: Bench) -> Outcome:
    """An experiment run."""
    bench.folder.mkdir()
    begin = time.perf_counter()
    findings = experiment(name)(bench)
    if len({f.what for f in findings}) < len(findings):
        raise ValueError(f"{name}: two findings are called the same, and run.json has them by name")
    return Outcome(name, findings, bench.figures, time.perf_counter() - begin, high_water())


def lines(one: Outcome) -> list[str]:
    """What the terminal shows of an experiment; its verdict is the last line."""
    out = [f"{one.name}: {EXPERIMENTS[one.name][1]}"]
    wide = max((len(f.what) for f in one.findings), default=0)
    for f in one.findings:
        ours = f"{number(f.ours)} {f.unit}".strip()
        paper = f"paper: {f.asked}" if f.asked else ""
        out.append(f"  {f.what:<{wide}}  {ours:<14} {paper:<38} {f.agreement}".rstrip())
        out += [f"      {text}" for text in (f.because, f.since) if text]
    return [*out, f"{one.name}: {one.verdict} ({one.seconds:.0f} s)"]


def record(outcomes: Sequence[Outcome], quick: bool, seed: int | None, command: str) -> dict[str, Any]:
    """What run.json holds; `instrument compare` reads it."""
    return {
        "name": "paper",
        "title": "Asad et al. (2015), run again",
        "finished": datetime.now(UTC).isoformat(timespec="seconds"),
        "command": command,
        "form": "quick" if quick else "full",
        "seed": seed,
        "versions": versions(),
        "numbers": {one.name: {f.what: f.ours for f in one.findings} for one in outcomes},
        "verdicts": {one.name: one.verdict for one in outcomes},
        "seconds": {one.name: round(one.seconds, 2) for one in outcomes},
        "memory": {one.name: one.peak_bytes for one in outcomes},
    }


def table(findings: Sequence[Finding]) -> Any:
    """Findings as an astropy table."""
    from astropy.table import Table

    low, high = ([float("nan") if f.within is None else f.within[k] for f in findings] for k in (0, 1))
    columns = {key: [getattr(f, key) for f in findings] for key in ("what", "ours", "unit", "paper")}
    told = ("asked", "changed", "slip", "agreement", "because", "since")
    last = {key: [getattr(f, key) for f in findings] for key in told}
    return Table({**columns, "low": low, "high": high, **last})


def markdown(outcomes: Sequence[Outcome]) -> str:
    """The tables of all experiments."""
    parts = []
    for one in outcomes:
        title, where = EXPERIMENTS[one.name][1:]
        body = "".join(_row(f) for f in one.findings)
        parts.append(
            f"### `{one.name}`: {title}\n\nThe paper's {where}. **{one.verdict[0].upper()}{one.verdict[1:]}.**\n\n"
            f"| | ours | the paper | |\n|---|---|---|---|\n{body}"
        )
    return "\n".join(parts)


def _row(f: Finding) -> str:
    said = "; ".join(text for text in (f.agreement, f.because, f.since) if text)
    return f"| {f.what} | {number(f.ours)} {f.unit} | {f.asked} | {said} |\n".replace("  ", " ")
