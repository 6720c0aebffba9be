"""A number of the paper beside ours: whether they agree, and why not where they do not."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

AGREES, DIFFERS, NOT, MORE = "agrees", "differs, for a reason", "NOT REPRODUCED", ""
Range = tuple[float, float]


class Finding(NamedTuple):
    """One number. `within` is where it is to lie to be the paper's; `because` the reason where it does not.

    A reason has a number that was measured where one thing is changed; that it accounts for all of the difference is
    for the reader to judge. Without `within` the number is one that the paper does not have.
    """

    what: str
    ours: float
    unit: str = ""
    paper: str = ""  # as it is printed there
    within: Range | None = None
    because: str = ""
    since: str = ""  # what others have published, to stand beside it

    @property
    def agreement(self) -> str:
        """Whether the paper's number is reproduced."""
        if self.within is None:
            return MORE
        low, high = self.within
        if np.isfinite(self.ours) and low <= self.ours <= high:
            return AGREES
        return DIFFERS if self.because else NOT


def verdict(findings: Sequence[Finding]) -> str:
    """The last line of an experiment: reproduced, reproduced with a reason for the difference, or not."""
    said = [finding.agreement for finding in findings if finding.agreement != MORE]
    if NOT in said:
        missed = "; ".join(finding.what for finding in findings if finding.agreement == NOT)
        return f"not reproduced: {missed}"
    count = said.count(DIFFERS)
    if not said:
        return "beyond the paper: it has no number to hold ours against"
    return f"reproduced, {count} of {len(said)} with a reason for the difference" if count else "reproduced"
