"""The error family, the outcome of a solver, and the wording of "did you mean"."""

from __future__ import annotations

import difflib
from collections.abc import Iterable
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


class Outcome(Enum):
    """How a solve ended; the value is the advice."""

    CONVERGED = "converged"
    ITERATION_LIMIT = "stopped at the iteration limit: raise the limit, or start nearer to the answer"
    SINGULAR = "the equations do not determine the answer: remove sources that coincide, or add data"
    NON_FINITE = "the input holds NaN or infinity: flag it first"
    POOR_FIT = "stands still, but most of the data stay unexplained: a wrong model, a wrong start, or noise"
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
