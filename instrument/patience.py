"""Patience: when work that should come nearer with every round has long not done so, and more rounds would not help."""

from __future__ import annotations

import numpy as np

from instrument.units import Bool, Float

ROUNDS = 100  # of which the geometric mean is taken
GAIN = 0.8  # of the least mean so far: what counts as nearer. A step of 1e-10 would else be thousands of rounds away


class Patience:
    """Watches a number (L,) that should fall, of L solves side by side, by its mean over `ROUNDS` after `ROUNDS`.

    Means, for what goes round without an answer now and then takes a step shorter than all before, by chance.
    """

    def __init__(self, count: int = 1) -> None:
        self.least, self.sum = np.full(count, np.inf), np.zeros(count)
        self.rounds, self.over = 0, np.zeros(count, bool)

    def lost(self, now: Float | float) -> Bool:
        """Which do not come nearer, this round counted; nor does what is not a number."""
        self.rounds += 1
        with np.errstate(divide="ignore", invalid="ignore"):
            self.sum = self.sum + np.log(np.atleast_1d(now))
            if self.rounds % ROUNDS == 0:
                self.over = ~(self.sum / ROUNDS < self.least + np.log(GAIN))
                self.least, self.sum = np.where(self.over, self.least, self.sum / ROUNDS), np.zeros_like(self.sum)
        return self.over
