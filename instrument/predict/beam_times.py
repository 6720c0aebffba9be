"""Beam times: the instants at which beams are worked out, and the polynomials that carry them to all others."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from instrument.compiled import compiled
from instrument.errors import InputError
from instrument.jones.chain import Chain
from instrument.observe.sampling import Sampling
from instrument.phasor import FAST
from instrument.units import Complex, Float, Int

POINTS = 8  # instants that each value is made of
STEPS_S = (1800.0, 1200.0, 900.0, 600.0, 400.0, 300.0, 200.0, 150.0, 100.0, 60.0, 40.0)
NODES = 12  # towards which a step is tried, at most
SAFETY = 2.0


class BeamTimes(NamedTuple):
    """Instants every so many integrations, 0 for each integration as it is; `error` bounds that of J (its norm)."""

    step: int = 0
    error: float = 0.0

    def instants(self, first: int, last: int) -> Int:
        """Integrations of the instants that serve integrations from `first` up to `last`."""
        if self.step == 0:
            return np.arange(first, last)
        return first + self.step * np.arange(-(POINTS // 2), (last - 1 - first) // self.step + POINTS // 2 + 2)

    def between(self, values: Complex, count: int) -> Complex:
        """Values (count, A, 2, 2) at each integration, of those at the instants (N, A, 2, 2)."""
        if self.step == 0:
            return np.ascontiguousarray(values)
        out = np.empty((count, *values.shape[1:]), complex)
        flat = np.ascontiguousarray(values).reshape(len(values), -1)
        _between(flat, self.step, weights(self.step), out.reshape(count, -1))
        return out


EACH = BeamTimes()


def beam_times(beams: Chain, at: Sampling, interval_s: float, span: tuple[int, int], wanted: float) -> BeamTimes:
    """The fewest instants that give beams within `wanted` (the norm of the error of J) at integrations of a span.

    `at` is towards the nodes, of regular times. Every integration where no step will do.
    """
    highest = int(np.argmax(at.freq_hz))
    one = at.block(slice(None), slice(highest, highest + 1))
    few = np.unique(np.linspace(0, at.shape[3] - 1, NODES).astype(int))
    one = one.towards(one.ra_rad[few], one.dec_rad[few])
    for seconds in STEPS_S:
        step = int(seconds / interval_s)
        if step < 2 or step * POINTS > span[1] - span[0]:
            continue
        # all of the span, and every place of it within the middle of some window
        count = 2 + 2 * (span[1] - span[0]) // (POINTS * step)
        first = np.unique(np.linspace(span[0], span[1] - 1 - (POINTS - 1) * step, count).round().astype(int))
        middle = step // 2 + step * (POINTS // 2 - 1)
        offsets = np.append(step * np.arange(POINTS), middle)
        slots = (first[:, None] + offsets).ravel()
        order = np.argsort(slots, kind="stable")
        try:
            j = beams.jones(one.every(interval_s, slots[order]))
        except InputError:  # a table that ends with the run
            return EACH
        if j.shape[0] == 1:
            return BeamTimes(step, 0.0)
        j = j[np.argsort(order)].reshape(len(first), POINTS + 1, *j.shape[1:])
        made = np.tensordot(weights(step)[step // 2], j[:, :POINTS], axes=(0, 1))
        error = SAFETY * float(np.linalg.norm(made - j[:, POINTS], axis=(-2, -1)).max())
        if error <= wanted:
            return BeamTimes(step, error)
    return EACH


def weights(step: int) -> Float:
    """Lagrange's weights of the instants about integrations 0 ... step - 1 after the third, (step, POINTS)."""
    x = np.arange(step) / step + POINTS // 2 - 1
    nodes = np.arange(POINTS)
    return np.stack([np.prod([(x - j) / (i - j) for j in nodes if j != i], axis=0) for i in nodes], axis=-1)


@compiled(nogil=True, fastmath=FAST, error_model="numpy")
def _between(values: Any, step: int, weights: Any, out: Any) -> None:
    points = weights.shape[1]
    for t in range(out.shape[0]):
        first = t // step + 1  # the instants begin three steps before the first integration
        phase = t - (t // step) * step
        for c in range(out.shape[1]):
            total = 0j
            for q in range(points):
                total += weights[phase, q] * values[first + q, c]
            out[t, c] = total
