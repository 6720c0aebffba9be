"""Lanes that did not come out well, tried from other starts; the better fit stays."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from instrument.calibrate.fit import Left, strange
from instrument.calibrate.lanes import Lanes, Settings, levels
from instrument.units import Bool, Complex, Float, Int

EXACT = 1e-12  # of its power left on every baseline: no weighting can do better


@dataclass
class Fits:
    """Matrices (L, A, 2, 2), last steps, iterations, what is left over, and baselines (L, B) that stand out in that."""

    jones: Complex
    step: Float
    count: Int
    left: Left
    odd: Bool

    def improve(self, lanes: Lanes, again: Int, settings: Settings) -> None:
        """Try lanes `again` from the eigenvectors of V M^H, of the data as they are and at one level; in place."""
        a1, a2, stations, tolerance = lanes.a1, lanes.a2, self.jones.shape[1], settings.tolerance
        v, m = (x[again] for x in lanes.products)
        active, samples = lanes.active[again], self.left.samples[again]
        # stations of very different gains: bring them to one level first, then weigh the data as they are
        level = levels(v, m, a1, a2, stations)
        flat = v / np.tile(level[:, a1] * level[:, a2], v.shape[1] // len(a1))[..., None, None]
        even = Lanes(flat, m, a1, a2, active, settings)
        level_jones, level_step, count, _ = even.iterate(even.eigenvectors(), far=0.02)
        level_jones = level_jones * level[:, :, None, None]
        second = Lanes(v, m, a1, a2, active, settings)
        jones, step, _, _ = second.iterate(level_jones)
        left, level_left = (second.left(j, samples) for j in (jones, level_jones))
        odd = strange(left, a1, a2, stations, tolerance, settings.pattern)
        was_odd, was_still = self.odd[again].any(axis=1), self.step[again] <= tolerance
        fine = ~odd.any(axis=1) & (step <= tolerance)
        before = self.left.share[again]
        uneven = self.left[again].uneven
        # a better fit, or as good a fit that stands still; and one that all baselines agree with before any other
        better = (left.share < 0.99 * before) | ((left.share <= 1.01 * before) & (step < self.step[again]))
        better = (better & ~(odd.any(axis=1) & was_still & ~was_odd)) | ((was_odd | (uneven & ~left.uneven)) & fine)
        exact = np.all(level_left.rest <= EXACT * level_left.data, axis=1) & (level_step <= tolerance)
        self.count[again] += count
        self._put(again[better], jones[better], step[better], left[better], odd[better])
        last = exact & ~(better & fine)
        self._put(again[last], level_jones[last], level_step[last], level_left[last], np.zeros_like(odd[last]))

    def _put(self, to: Int, jones: Complex, step: Float, left: Left, odd: Bool) -> None:
        self.jones[to], self.step[to], self.odd[to] = jones, step, odd
        names = ("rest", "data", "fit")
        parts = {name: np.array(getattr(self.left, name)) for name in names}
        for name in names:
            parts[name][to] = getattr(left, name)
        self.left = Left(**parts, samples=self.left.samples)
