"""A number of the paper beside ours: whether they agree, and why not where they do not."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

AGREES, DIFFERS, CORRECTED, NOT, MORE = "agrees", "differs, for a reason", "a slip, corrected", "NOT REPRODUCED", ""
Range = tuple[float, float]


class Finding(NamedTuple):
    """One number. `within` is where it is to lie to be the paper's; `because` the reason where it does not.

    A reason counts where `changed`, the number with the one thing changed that `because` names, lies there. Without
    `within` the number is one that the paper does not have. Of a `slip` `within` is where the right number must lie, by
    other means than ours, and `changed` what the printed form gives: it is one where that lies outside.
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
        ours, changed = (bool(self.within[0] <= x <= self.within[1]) for x in (self.ours, self.changed))
        if self.slip:
            return CORRECTED if ours and np.isfinite(self.changed) and not changed else NOT
        if ours:
            return AGREES
        return DIFFERS if self.because and changed else NOT


def slip(
    what: str, ours: float, unit: str, paper: str, printed: float, because: str, right: tuple[float, float]
) -> Finding:
    """A number that must lie where it is `right` by other means than ours, and where the printed form gives another."""
    return Finding(what, ours, unit, paper, right, because, changed=printed, slip=True)


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
    slips, count = said.count(CORRECTED), said.count(DIFFERS)
    if slips == len(said):
        return f"what is printed is not what is right, in {slips} of {slips} numbers"
    parts = [f"{count} of {len(said)} with a reason for the difference"] * bool(count)
    parts += [f"{slips} of {len(said)} by what the paper should have"] * bool(slips)
    return ", ".join(["reproduced", *parts])
