"""The verb `paper`: experiments run one after the other; a table, a page and run.json of what they found."""

from __future__ import annotations

import shutil
import time
from collections.abc import Callable, Sequence
from datetime import UTC, datetime
from typing import Any, NamedTuple

from instrument.errors import unused_ledger
from instrument.memory import high_water
from instrument.paper.bench import Bench
from instrument.paper.experiments import EXPERIMENTS, WORDS, chosen, experiment, seconds, seed_of
from instrument.paper.finding import NOT, Finding, tally, verdict
from instrument.paper.page import page
from instrument.pipeline.folder import RunFolder
from instrument.pipeline.progress import progress_bar
from instrument.pipeline.record import json_text, versions
from instrument.report.page import FigureEntry, duration, write_page
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
    seed = seed_of(seed)
    outcomes: list[Outcome] = []
    due = {name: seconds(name, quick) for name in every}
    stopped: BaseException | None = None
    with RunFolder("-".join(["paper", *names]), out, force) as folder, progress_bar("paper") as bar, unused_ledger():
        for k, name in enumerate(every):
            bar(sum(due[n] for n in every[:k]) / sum(due.values()), name)
            show(f"{k + 1} of {len(every)}        {name}, about {duration(due[name])}")
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
            write_ecsv(table(one, what), folder.partial / f"{one.name}.ecsv")
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
        paper = f"paper: {f.asked}" if f.asked else ""
        out.append(f"  {f.what:<{wide}}  {f.value:<14} {paper:<38} {f.agreement}".rstrip())
        out += [f"      {text}" for text in f.why]
    return [*out, f"{one.name}: {one.verdict} ({one.seconds:.0f} s)"]


def record(outcomes: Sequence[Outcome], quick: bool, seed: int | None, command: str) -> dict[str, Any]:
    """What run.json holds; `instrument compare` reads it."""
    return {
        "name": "paper",
        "title": "Asad et al. (2015), run again",
        "finished": datetime.now(UTC).isoformat(timespec="seconds"),
        "command": command,
        "form": "quick" if quick else "full",
        "seed": "those of the scenes" if seed is None else seed,
        "versions": versions(),
        "numbers": {one.name: {f.what: f.ours for f in one.findings} for one in outcomes},
        "paper": {one.name: {f.what: _printed(f) for f in one.findings if f.within} for one in outcomes},
        "verdicts": {one.name: one.verdict for one in outcomes},
        "seconds": {one.name: round(one.seconds, 2) for one in outcomes},
        "memory": {one.name: one.peak_bytes for one in outcomes},
    }


def _printed(f: Finding) -> dict[str, Any]:
    """What the paper has of a number; a range without an upper end has None there."""
    assert f.within is not None
    return {"printed": f.paper, "low": f.within[0], "high": f.within[1], "agreement": f.agreement}


COLUMNS = {
    "what": "the number; the key of run.json",
    "ours": "what was found, all digits",
    "unit": "of ours, low, high and changed",
    "paper": "what the paper prints",
    "low": "least value that is taken to be the paper's; of a slip, that is right by other means",
    "high": "largest such value",
    "asked": "paper, low and high in words",
    "changed": "ours with the one thing changed that `because` names; of a slip, what the printed form gives",
    "slip": "whether the paper's is held to be a slip",
    "agreement": "the verdict; empty where the paper has no such number",
    "because": "the reason of a difference",
    "since": "what others have found, and remarks",
    "end": "where ours is a lower limit: what ends there",
    "kept": "of a doubtful slip: what follows the printed number all the same",
}


def table(one: Outcome, what: dict[str, Any]) -> Any:
    """Findings of an experiment as an astropy table that says where it is from; `what` is the record of the run."""
    from astropy.table import Table

    ends = [f.within or (float("nan"),) * 2 for f in one.findings]
    limits = {"low": [low for low, _ in ends], "high": [high for _, high in ends]}
    out = Table({key: limits.get(key) or [getattr(f, key) for f in one.findings] for key in COLUMNS})
    for key, text in COLUMNS.items():
        out[key].description = text
    out.meta |= {"experiment": one.name, "title": EXPERIMENTS[one.name][1], "verdict": one.verdict}
    out.meta |= {key: what[key] for key in ("form", "seed", "command")}
    return out


def markdown(outcomes: Sequence[Outcome]) -> str:
    """The tables of all experiments."""
    parts = [tally([f for one in outcomes for f in one.findings]) + ".\n"]
    for one in outcomes:
        title, where = EXPERIMENTS[one.name][1:]
        body = "".join(row(f) for f in one.findings)
        said = f"{one.verdict[0].upper()}{one.verdict[1:]}"
        words = f"{WORDS[one.name]}\n\n" if one.name in WORDS else ""
        parts.append(
            f"### `{one.name}`: {title}\n\nThe paper's {where}. **{said}.**\n\n{words}"
            f"| | ours | the paper | |\n|---|---|---|---|\n{body}"
        )
    return "\n".join(parts)


def row(f: Finding) -> str:
    """A number as a row of a table in Markdown."""
    said = "; ".join(text for text in (f.agreement, *f.why) if text)
    return f"| {f.what} | {f.value} | {f.asked} | {said} |\n".replace("  ", " ")
