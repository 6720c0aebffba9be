"""The error family, the one way to warn, what was not used, the outcome of a solver, the wording of "did you mean"."""

from __future__ import annotations

import difflib
import sys
import warnings
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from enum import Enum


class InstrumentError(Exception):
    """Anything this package raises on purpose."""


class InputError(InstrumentError, ValueError):
    """What was given is wrong: one line that names the thing, the value and the remedy."""


class UnitError(InputError):
    """A number without a unit, or with one of another kind."""


class BasisError(InputError):
    """Jones terms in an order in which their bases do not meet."""


class BeamStateError(InputError):
    """Visibilities from which different beams have been removed were to be mixed."""


class PluginError(InputError):
    """A plugin is unknown, claimed twice, or does not import."""


class FileError(InputError):
    """A file from outside is broken: file, line and field are named."""


class RefusedError(InputError):
    """What was asked is understood but will not be done (too large, an engine that cannot)."""


class InstrumentWarning(UserWarning):
    """The result is right for what was asked, but the user should know something."""


class UnusedWarning(InstrumentWarning):
    """Something that was given was not used: a column, a row, a header card, a table, a channel, an option."""


_LEDGER: ContextVar[dict[str, list[str]] | None] = ContextVar("unused", default=None)
_OWN = __name__.partition(".")[0]


def warn(text: str, category: type[Warning] = InstrumentWarning) -> None:
    """Warn at the line of the first caller outside this package, its plugins and pydantic."""
    level, frame = 2, sys._getframe(1)
    while frame.f_back is not None:
        root = str(frame.f_globals.get("__name__", "")).partition(".")[0]
        if not (root == "pydantic" or root.startswith(_OWN)):
            break
        level, frame = level + 1, frame.f_back
    warnings.warn(text, category, stacklevel=level)


def unused(source: str, names: Iterable[str], why: str = "") -> None:
    """Say which parts of `source` were not used, in a warning and in the ledger of `unused_ledger`; nothing if none."""
    listed = [str(name) for name in names]
    if not listed:
        return
    ledger = _LEDGER.get()
    if ledger is not None:
        here = ledger.setdefault(source, [])
        here += [name for name in listed if name not in here]
    more = f" and {len(listed) - 20} more" if len(listed) > 20 else ""
    warn(f"{source}: not used: {', '.join(listed[:20])}{more}{f' ({why})' if why else ''}", UnusedWarning)


@contextmanager
def unused_ledger() -> Iterator[dict[str, list[str]]]:
    """Collects what `unused` says inside, by source, with what one around it has: run.json's "unused"."""
    ledger = {source: list(names) for source, names in (_LEDGER.get() or {}).items()}
    token = _LEDGER.set(ledger)
    try:
        yield ledger
    finally:
        _LEDGER.reset(token)


class Outcome(Enum):
    """How a solve ended; the value is the advice."""

    CONVERGED = "converged"
    ITERATION_LIMIT = (
        "stopped at the iteration limit, or long no nearer: raise the limit, or start nearer to the answer"
    )
    SINGULAR = "the equations do not determine the answer: remove sources that coincide, or add data"
    NON_FINITE = "the input holds NaN or infinity: flag it first"
    POOR_FIT = "most of the data stay unexplained: a wrong model, a wrong start, or noise above the signal"
    REFUSED = "refused: the problem has no answer of this kind"

    def check(self) -> None:
        """Raise `InstrumentError` unless converged."""
        if self is not Outcome.CONVERGED:
            raise InstrumentError(self.value)


def did_you_mean(name: str, known: Iterable[str]) -> str:
    """Tail of an error message: the nearest known name, then all of them (the first 12)."""
    names = sorted(known)
    folded = {k.lower(): k for k in names}
    near = difflib.get_close_matches(name.lower(), folded, n=1, cutoff=0.5)
    more = f" and {len(names) - 12} more" if len(names) > 12 else ""
    listing = f"known: {', '.join(names[:12])}{more}" if names else "none is known"
    return f"did you mean '{folded[near[0]]}'? ({listing})" if near else listing
