"""A number of the paper beside ours: whether they agree, and why not where they do not."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from instrument.report.page import number

AGREES, DIFFERS, CORRECTED, NOT, MORE = "agrees", "differs, for a reason", "a slip, corrected", "NOT REPRODUCED", ""
DOUBTFUL = "doubtful, not corrected"
Range = tuple[float, float]


class Finding(NamedTuple):
    """One number. `within` is where it is to lie to be the paper's; `because` the reason where it does not.

    A reason counts where `changed`, the number with the one thing changed that `because` names, lies there. Without
    `within` the number is one that the paper does not have. Of a `slip` `within` is where the right number must lie, by
    other means than ours, and `changed` what the printed form gives: it is one where that lies outside. Where what we
    do follows the print all the same, `kept` says what does: it is a doubt, and no correction.

    Where ours is the last value that could be found, `end` says what ends there: ours is a lower limit, which agrees
    only where all that is above it lies in the range too.
    """

    what: str
    ours: float
    unit: str = ""
    paper: str = ""  # as it is printed there
    within: Range | None = None
    because: str = ""
    since: str = ""  # what others have published, to stand beside it
    changed: float = float("nan")
    slip: bool = False
    end: str = ""
    kept: str = ""

    @property
    def value(self) -> str:
        """Ours with its unit, in 3 digits, or more where 3 would lie on the other side of an end of the range."""
        text = number(self.ours)
        if self.within is not None and np.isfinite(self.ours):
            tried = (number(self.ours, digits) for digits in range(3, 17))
            text = next((t for t in tried if self._inside(float(t)) == self._inside(self.ours)), text)
        return f"{'at least ' * bool(self.end)}{text} {self.unit}".strip()

    @property
    def why(self) -> list[str]:
        """What is to be said of it: that it is a limit, the reason, what others have found."""
        limit = f"the end of what was measured: {self.end}" if self.end else ""
        return [text for text in (limit, self.because, self.kept, self.since) if text]

    @property
    def asked(self) -> str:
        """What the paper prints, and the range that this was taken to mean."""
        if self.within is None:
            return self.paper
        low, high = (f"{x:.4g}" for x in self.within)
        span = f"{low} to {high}" if np.isfinite(self.within[1]) else f"above {low}"
        return f"{self.paper} ({'right: ' * self.slip}{span})"

    @property
    def agreement(self) -> str:
        """Whether the paper's number is reproduced."""
        if self.within is None:
            return MORE
        ours, changed = self._inside(self.ours), self._inside(self.changed)
        if self.end and np.isfinite(self.within[1]):
            ours = False  # a lower limit: it may as well lie above
        if self.slip:
            shown = ours and np.isfinite(self.changed) and not changed
            return (DOUBTFUL if self.kept else CORRECTED) if shown else NOT
        if ours:
            return AGREES
        return DIFFERS if self.because and changed else NOT

    def _inside(self, x: float) -> bool:
        return self.within is not None and bool(self.within[0] <= x <= self.within[1])


def slip(
    what: str, ours: float, unit: str, paper: str, printed: float, because: str, right: tuple[float, float]
) -> Finding:
    """A number that must lie where it is `right` by other means than ours, and where the printed form gives another."""
    return Finding(what, ours, unit, paper, right, because, changed=printed, slip=True)


def tally(findings: Sequence[Finding]) -> str:
    """How many numbers of the paper are reproduced, and how many are not."""
    said = [finding.agreement for finding in findings if finding.agreement != MORE]
    names = {AGREES: "reproduced", DIFFERS: "different for a reason", CORRECTED: "corrected as slips"}
    names |= {DOUBTFUL: "doubtful and kept"}
    parts = [f"{said.count(key)} {name}" for key, name in names.items() if key in said]
    parts.append(f"{said.count(NOT)} not reproduced")
    return f"{len(said)} number{'s' * (len(said) != 1)} of the paper: {', '.join(parts)}"


def near(right: float, by: float = 0.01) -> tuple[float, float]:
    """A range about a number."""
    return (1 - by) * right, (1 + by) * right


def verdict(findings: Sequence[Finding]) -> str:
    """The last line of an experiment: reproduced, reproduced with a reason for the difference, or not."""
    said = [finding.agreement for finding in findings if finding.agreement != MORE]
    missed = [finding.what for finding in findings if finding.agreement == NOT]
    if missed:
        return f"{len(missed)} of {len(said)} not reproduced: {'; '.join(missed)}"
    if not said:
        return "beyond the paper: it has no number to hold ours against"
    slips, doubts, count = (said.count(key) for key in (CORRECTED, DOUBTFUL, DIFFERS))
    if slips + doubts == len(said):
        every = len({finding.what.partition(". ")[0] for finding in findings if finding.agreement != MORE})
        doubt = f", in {doubts} it is doubtful and kept" if doubts else ""
        total = f"{every} slip{'s' * (every > 1)}, {len(said)} number{'s' * (len(said) > 1)}"
        return f"{total}: in {slips} what is printed is not what is right{doubt}"
    parts = [f"{count} of {len(said)} with a reason for the difference"] * bool(count)
    parts += [f"{slips} of {len(said)} by what the paper should have"] * bool(slips)
    parts += [f"{doubts} of {len(said)} doubtful and kept"] * bool(doubts)
    return ", ".join(["reproduced", *parts])
