"""Case: one extreme input with its right answer; what came out of it, and the verdict."""

from __future__ import annotations

import warnings
from collections.abc import Callable
from dataclasses import dataclass
from types import ModuleType
from typing import Any, NamedTuple

import numpy as np

from instrument.errors import InputError, InstrumentError

RIGHT, REFUSED, WRONG, NOT_THERE = "right", "refused", "WRONG", "not there"
MOST_DIGITS = 15.0  # of the logarithmic relative error, as NIST's StRD scores: float64 has no more


class Unfit(Exception):
    """A plugin that does not serve this input says so: the same as a refusal that is right."""


class Answer(NamedTuple):
    """What came out: its relative error, the most that is right, the condition number where there is one.

    A claim that is true or false has `digits` NaN: its error is 0 or infinite.
    """

    error: float
    limit: float
    condition: float = np.nan
    remark: str = ""
    graded: bool = True

    @property
    def right(self) -> bool:
        """Whether the error is within the limit; NaN is not."""
        return bool(self.error <= self.limit)

    @property
    def digits(self) -> float:
        """Correct digits, min(15, -log10 of the error), and none below 0; NaN for what is true or false."""
        if not self.graded:
            return np.nan
        if not np.isfinite(self.error):
            return 0.0
        return float(np.clip(-np.log10(max(self.error, 1e-300)), 0.0, MOST_DIGITS))


def held(found: Any, due: Any, limit: float, scale: float | None = None, condition: float = np.nan) -> Answer:
    """Numbers held to the right ones: the largest error, relative to `scale` or to the largest right one."""
    found, due = np.asarray(found), np.asarray(due)
    size = np.abs(due).max(initial=0.0) if scale is None else scale
    with np.errstate(all="ignore"):
        error = float(np.abs(found - due).max(initial=0.0) / (size or 1.0))
    return Answer(error if np.isfinite(error) else np.inf, limit, condition)


def claim(true: Any, wrong: str = "it does not hold", told: str = "", condition: float = np.nan) -> Answer:
    """An answer that is right (and what is `told` then) or not, without digits."""
    return Answer(0.0 if true else np.inf, 0.0, condition, told if true else wrong, graded=False)


def both(*answers: Answer) -> Answer:
    """Several answers as one: the one that is furthest beyond its limit, or else the one with the fewest digits."""
    wrong = [a for a in answers if not a.right]
    graded = [a for a in answers if a.graded] or list(answers)
    worst = wrong[0] if wrong else max(graded, key=lambda a: a.error)
    known = [a.condition for a in answers if np.isfinite(a.condition)]
    return worst._replace(condition=max(known, default=worst.condition))


@dataclass(frozen=True)
class Case:
    """A named extreme input: its key in the list, the stage that it fits, the right answer in words, how it is tried.

    `stage` is a kind of plugins ("engines", "calibrators", ...) or a part of the framework ("jones", "faraday-depth",
    "spectra", "run"). `tried` takes a plugin of that kind and gives an `Answer`; with `refusal` a refusal in one line
    is right as well. `missing` says what is not built yet, and then nothing is tried.
    """

    key: str
    stage: str
    name: str
    right: str
    tried: Callable[[Any], Answer] | None
    refusal: bool = False
    missing: str = ""


class Row(NamedTuple):
    """One line of the table."""

    case: str
    stage: str
    verdict: str
    digits: float
    condition: float
    right: str
    remark: str


def case(key: str, stage: str, name: str, right: str, refusal: bool = False) -> Callable[[Callable[..., Answer]], Case]:
    """Makes a case of a function of a plugin (of nothing, for a part of the framework)."""
    return lambda tried: Case(key, stage, name, right, tried, refusal)


def not_there(key: str, stage: str, name: str, right: str, missing: str) -> Case:
    """A case whose subject is not built."""
    return Case(key, stage, name, right, None, missing=missing)


def cases_of(module: ModuleType) -> list[Case]:
    """The cases of a module, in their order there; those not built at its end."""
    return [c for c in vars(module).values() if isinstance(c, Case)] + list(getattr(module, "MISSING", ()))


def judged(given: Case, plugin: Any, label: str = "") -> Row:
    """Try a case on a plugin. Whatever it raises is a verdict, never an end."""
    name = f"{given.key}: {given.name}{label}"
    row = Row(name, given.stage, NOT_THERE, np.nan, np.nan, given.right, given.missing)
    if given.tried is None:
        return row
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            found = given.tried(plugin)
    except Unfit as said:
        return row._replace(verdict=REFUSED, remark=_line(said))
    except (InputError, InstrumentError) as said:
        return row._replace(verdict=REFUSED if given.refusal else WRONG, remark=f"refused: {_line(said)}")
    except Exception as error:  # a stranger's plugin may fail in any way
        return row._replace(verdict=WRONG, remark=f"{type(error).__name__}: {_line(error)}")
    remark = found.remark if found.right else (found.remark or f"off by {found.error:.1e}, right is {found.limit:.0e}")
    return row._replace(
        verdict=RIGHT if found.right else WRONG, digits=found.digits, condition=found.condition, remark=remark
    )


def _line(error: Exception) -> str:
    return " ".join(str(error).split())[:200]
