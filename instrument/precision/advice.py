"""What follows from contests, in words: what to take at which error, from which size on another, where a peer leads."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np

from instrument.precision.contest import REFUSED, RIGHT, WRONG, Contest, Row, choice

ERRORS = (1e-2, 1e-4, 1e-6, 1e-8, 1e-10)  # at which a choice is named
Found = Sequence[tuple[Contest, Sequence[Row]]]


def advised(contest: Contest, rows: Sequence[Row]) -> str:
    """What to take at which error, in one line."""
    picks: dict[str, list[float]] = {}
    for error in ERRORS:
        row = choice(rows, error)
        if row is not None:
            picks.setdefault(_named(contest, row), []).append(error)
    if picks:
        ways = (
            f"for an error of {' to '.join(dict.fromkeys(f'{e:.0e}' for e in (errors[0], errors[-1])))} take {pick}"
            for pick, errors in picks.items()
        )
        return f"{contest.name}: {'; '.join(ways)}"
    best = min((r for r in rows if np.isfinite(r.error)), key=lambda r: r.error, default=None)
    if best is None:
        return f"{contest.name}: no answer from anyone"
    return f"{contest.name}: nobody comes below {ERRORS[0]:g}; least error {best.error:.2g}, by {_named(contest, best)}"


def _named(contest: Contest, row: Row) -> str:
    """A plugin with what it was asked for and its seconds."""
    asked = f", {contest.knob} {row.asked:.2g}" if np.isfinite(row.asked) else ""
    return f"{row.plugin}{asked} ({row.seconds:.2g} s)"


def crossovers(found: Found) -> list[str]:
    """Of contests that are one job at several sizes: who is quickest up to which size, and from which on."""
    out = []
    for family, sizes in _families(found):
        said: dict[str, list[float]] = {}
        for error in ERRORS:
            picks = [(contest, choice(rows, error)) for contest, rows in sizes]
            runs: list[tuple[Contest, str]] = []  # the first size of each run of one winner
            for contest, row in picks:
                if row is not None and (not runs or runs[-1][1] != row.plugin):
                    runs.append((contest, row.plugin))
            if runs:
                word = sizes[0][0].size_word
                text = ", ".join([runs[0][1], *(f"{name} from {c.size:g} {word} on" for c, name in runs[1:])])
                said.setdefault(text if len(runs) > 1 else f"{text} at every size", []).append(error)
        for text, errors in said.items():
            ends = " to ".join(dict.fromkeys(f"{e:.0e}" for e in (errors[0], errors[-1])))
            out.append(f"{family}, error {ends}, quickest: {text}")
    return out


def _families(found: Found) -> Iterator[tuple[str, list[tuple[Contest, Sequence[Row]]]]]:
    """Families of two sizes or more, each by growing size."""
    for family in dict.fromkeys(contest.family for contest, _ in found if contest.family):
        sizes = sorted(((c, rows) for c, rows in found if c.family == family), key=lambda pair: pair[0].size)
        if len(sizes) > 1:
            yield family, sizes


def peers_ahead(found: Found) -> list[str]:
    """Where a program of others is quicker than all of ours at one error, and how many times."""
    out = []
    for contest, rows in found:
        leads: dict[str, list[tuple[float, float]]] = {}
        for error in ERRORS:
            ours, theirs = (choice([r for r in rows if r.peer is peer], error) for peer in (False, True))
            if theirs is not None and (ours is None or theirs.seconds < ours.seconds):
                ratio = np.inf if ours is None else ours.seconds / theirs.seconds
                leads.setdefault(theirs.plugin, []).append((error, ratio))
        for name, pairs in leads.items():
            each = ", ".join(f"{e:.0e} {f'{r:.2g} times' if np.isfinite(r) else 'alone'}" for e, r in pairs)
            out.append(f"{contest.name}: {name} is ahead, at {each}")
    return out


def counted(rows: Sequence[Row]) -> str:
    """How many answers there are, and what became of the others, in one line."""
    kinds = {
        "right": sum(row.outcome == RIGHT for row in rows),
        "refused": sum(row.outcome.startswith(REFUSED) for row in rows),
        "failed": sum(row.outcome.startswith("failed") for row in rows),
        WRONG: sum(row.outcome == WRONG for row in rows),
    }
    rest = len(rows) - sum(kinds.values())
    return ", ".join(f"{n} {word}" for word, n in {**kinds, "other": rest}.items() if n or word in ("right", WRONG))
