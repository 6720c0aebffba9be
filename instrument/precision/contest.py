"""A contest: plugins that do one job, a knob, and a judge who knows the truth; and how its trials are measured."""

from __future__ import annotations

import gc
import time
import tracemalloc
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from instrument.errors import InputError, RefusedError

ROUNDS = (5, 30)  # fewest and most repeats of the full form
QUICK = 3
SPREAD = 0.05  # of the median: the half width of its 95 % interval at which the full form is content
LONG = 20.0  # seconds of one trial that are not repeated beyond the fewest
RIGHT, REFUSED, OVER, WRONG = "right", "refused", "over the tolerance", "said converged, was wrong"
UNSET = float("nan")  # asked of an entry that has no such knob


class Form(NamedTuple):
    """How wide a contest is: `quick` takes fewer values and repeats, `peers` draws other programs in."""

    quick: bool = False
    peers: bool = False


class Trial(NamedTuple):
    """What an answer is worth: its error, that in the user's quantity (rms, largest), and how it ended, in words."""

    error: float
    error_user: float
    outcome: str = RIGHT
    user_max: float = np.nan


@dataclass(frozen=True)
class Entry:
    """A contestant: the name of a plugin, and its answer to a value of the knob; what a `peer` promises is its own."""

    plugin: str
    answer: Callable[[float], Any]
    values: tuple[float, ...] = ()  # of a knob of its own, instead of those of the contest
    peer: bool = False


@dataclass(frozen=True)
class Contest:
    """One job: a `knob` with `values`, entries, and a judge from an answer and what was asked to a `Trial`.

    `error`, `error_user` and `truth` say in words what is measured and against what. With `honoured` the knob is an
    error that was promised: one above it is a fault. Contests of one `family` are the same job at another `size`.
    `peers` are the packages of other programs that may stand here, installed or not.
    """

    name: str
    kind: str
    knob: str
    values: tuple[float, ...]
    entries: tuple[Entry, ...]
    judge: Callable[[Any, float], Trial]
    error: str
    error_user: str
    truth: str
    honoured: bool = False
    family: str = ""
    size: float = np.nan
    size_word: str = ""
    peers: tuple[str, ...] = ()


class Row(NamedTuple):
    """One answer: seconds of wall time (median), their spread relative to it, bytes that Python knows of.

    What stands behind `outcome` is in no column of the table: the largest error in the user's quantity, seconds of the
    first answer in this process, those in which loops were compiled or read from their cache meanwhile, the repeats.
    """

    contest: str
    plugin: str
    knob: str
    asked: float
    error: float
    error_user: float
    seconds: float
    seconds_spread: float
    peak_bytes: float
    outcome: str
    user_max: float = np.nan
    first: float = np.nan
    compiled: float = np.nan
    repeats: int = 0
    peer: bool = False


COLUMNS = Row._fields[: Row._fields.index("outcome") + 1]


class _Case:
    """One entry at one value: its answer judged once, its seconds as often as it takes."""

    def __init__(self, contest: Contest, entry: Entry, asked: float, clock: Callable[[], float]) -> None:
        self.contest, self.entry, self.asked, self.clock = contest, entry, asked, clock
        self.seconds: list[float] = []
        self.peak = self.first = self.compiled = np.nan
        try:
            self.trial = contest.judge(self._answer(), asked)
            self.peak = self._peak()
        except (RefusedError, InputError) as error:
            self.trial = Trial(np.nan, np.nan, f"{REFUSED}: {error}")
        except Exception as error:  # a stranger's plugin may fail in any way, and stays in the table
            self.trial = Trial(np.nan, np.nan, f"failed: {type(error).__name__}: {error}")
        if contest.honoured and not entry.peer and self.trial.error > asked and self.trial.outcome == RIGHT:
            self.trial = self.trial._replace(outcome=OVER)

    def _answer(self) -> Any:
        """The first answer, and its seconds."""
        with _compiling() as spent:
            start = self.clock()
            found = self.entry.answer(self.asked)
            self.first = self.clock() - start
        self.compiled = sum(spent)
        return found

    def _peak(self) -> float:
        """Most bytes that Python knows of, in a run of its own."""
        tracemalloc.start()
        try:
            self.entry.answer(self.asked)
            return float(tracemalloc.get_traced_memory()[1])
        finally:
            tracemalloc.stop()

    @property
    def runs(self) -> bool:
        """Whether there is an answer whose time can be taken."""
        return bool(np.isfinite(self.trial.error))

    def run(self) -> None:
        """Take its time once more; what it gives is thrown away outside of the time taken."""
        start = self.clock()
        found = self.entry.answer(self.asked)
        self.seconds.append(self.clock() - start)
        del found

    @property
    def spread(self) -> float:
        """Half width of the 95 % interval of the median, relative to it; without enough repeats that of all."""
        found = np.sort(self.seconds)
        n = len(found)
        if not n:
            return np.nan
        low = max(int(np.floor((n - 1.96 * np.sqrt(n)) / 2)), 0)
        high = min(int(np.ceil(1 + (n + 1.96 * np.sqrt(n)) / 2)), n) - 1
        return float((found[high] - found[low]) / 2 / np.median(found))

    def enough(self, quick: bool) -> bool:
        """Whether its time is known well enough."""
        n = len(self.seconds)
        if not self.runs or quick:
            return not self.runs or n >= QUICK
        if n < ROUNDS[0]:
            return False
        return n >= ROUNDS[1] or self.spread < SPREAD or float(np.median(self.seconds)) > LONG

    def row(self) -> Row:
        """Its line of the table."""
        contest, trial = self.contest, self.trial
        seconds = float(np.median(self.seconds)) if self.seconds else np.nan
        return Row(
            *(contest.name, self.entry.plugin, contest.knob, self.asked, trial.error, trial.error_user),
            *(seconds, self.spread, self.peak, trial.outcome, trial.user_max),
            *(self.first, self.compiled, len(self.seconds), self.entry.peer),
        )


@contextmanager
def _compiling() -> Iterator[list[float]]:
    """Seconds in which loops are compiled, or read from where they are kept, as a list once it has ended."""
    from numba.core import event

    spent: list[float] = []
    with event.install_timer("numba:compiler_lock", spent.append):
        yield spent


def measured(
    contest: Contest,
    quick: bool = False,
    said: Callable[[str], None] = lambda text: None,
    clock: Callable[[], float] | None = None,
) -> list[Row]:
    """All entries at all values: judged once (which compiles what is compiled), then timed in turn, round by round.

    `clock` is that of the wall; on one thread `time.process_time` leaves out what else the machine does.
    """
    cases = []
    for entry in contest.entries:
        for asked in entry.values or contest.values:
            said(f"{contest.name}: {entry.plugin}, {contest.knob} {asked:g}")
            cases.append(_Case(contest, entry, asked, clock or time.perf_counter))
    gc.freeze()  # what is there stays there: a collection before each time then takes 1 ms, not 200
    try:
        for number, due in enumerate(_rounds(cases, quick)):
            said(f"{contest.name}: round {number + 1}, {len(due)} times to take")
            for case in due:
                gc.collect()
                case.run()
    finally:
        gc.unfreeze()
    return [case.row() for case in cases]


def _rounds(cases: Sequence[_Case], quick: bool) -> Iterator[list[_Case]]:
    while due := [case for case in cases if not case.enough(quick)]:
        yield due


def front(rows: Sequence[Row]) -> list[Row]:
    """Those of some rows with an answer that none beats in both error and seconds, quickest first."""
    good = sorted((r for r in rows if np.isfinite(r.error) and np.isfinite(r.seconds)), key=lambda r: r.seconds)
    best: list[Row] = []
    for row in good:
        if not best or row.error < best[-1].error:
            best.append(row)
    return best


def choice(rows: Sequence[Row], error: float) -> Row | None:
    """The quickest of some rows whose error is at most so much."""
    return next((row for row in front(rows) if row.error <= error), None)
