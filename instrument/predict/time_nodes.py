"""Time nodes: integrations at which what moves with the Earth is worked out, and what lies between them, with a bound.

An array factor is a mean of exp(i phase), and its phases turn with the Earth: over minutes it is a polynomial of low
degree. Panels of some integrations each have a few nodes among them; polynomials through those give the others.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from functools import cache, reduce
from math import factorial
from typing import Any, NamedTuple

import numpy as np

from instrument.compiled import compiled
from instrument.jones.base import JonesTerm
from instrument.jones.motion import product
from instrument.observe.directions import EARTH_RATE, EarthFrame
from instrument.observe.sampling import Sampling
from instrument.phasor import FAST
from instrument.units import Complex, Float, Int

RATE = EARTH_RATE * (1 + 1e-4)  # rad/s, of everything that is smooth: precession and aberration are slower by 1e4
MOST = 12  # nodes of a panel
LOST = 1e-14  # what rounding makes of some nodes and their weights, each below 3


class Panels(NamedTuple):
    """Integrations (T,) in panels of `size`, each with so many nodes (fewer in a last one that is short)."""

    size: int
    nodes: int

    @property
    def share(self) -> float:
        """Of the integrations at which terms are worked out."""
        return self.nodes / self.size

    @property
    def between(self) -> int:
        """Nodes that each value is made of; none where all are worked out."""
        return self.nodes if self.size > 1 else 0

    def seconds(self, parts: float, stations: int) -> float:
        """Of terms with so many phasors, for each time, channel and source: 2.5 ns each, 0.5 ns for each node."""
        return 2.5e-9 * parts * self.share + 5e-10 * stations * self.between

    def cut(self, times: int) -> Iterator[tuple[slice, Int]]:
        """Each panel of so many integrations, and its nodes as indices of all."""
        for first in range(0, times, self.size):
            size = min(self.size, times - first)
            yield slice(first, first + size), first + _nodes(size, self.nodes)

    def alike(self, times: int) -> Iterator[tuple[Int, Int]]:
        """Integrations (panels, size) of panels of one size, and the nodes within each (count,)."""
        whole = times // self.size * self.size
        for first, last, size in ((0, whole, self.size), (whole, times, times - whole)):
            if first < last:
                yield np.arange(first, last).reshape(-1, size), _nodes(size, self.nodes)

    def multiply(self, out: Complex, at: Sampling, terms: Sequence[JonesTerm]) -> None:
        """`out` (T, F, A, S) times scalar terms, at the nodes of each panel as they are and between them, in place."""
        for times, nodes in self.cut(at.shape[0]):
            few = at.some(nodes)
            values = reduce(np.multiply, (term.scalar(few) for term in terms))
            shape = (len(nodes), *out.shape[1:])
            rows = np.ascontiguousarray(np.broadcast_to(values, shape)).reshape(len(nodes), -1)
            share = weights(at.slots_s[times], nodes - times.start)
            _multiply(out[times].reshape(times.stop - times.start, -1), rows, share)

    def error(self, at: Sampling, motions: Sequence[tuple[Float, Float]]) -> Float:
        """Bound on the error of a product of terms between the nodes, (S,), of their motions to that order.

        The remainder of polynomials, what the Earth does beside turning smoothly, and the rounding of weights.
        """
        count = self.nodes
        derivatives = reduce(product, (found[: count + 1] for found, _ in motions))[count]
        per_rad = sum(found for _, found in motions)
        reach = RATE**count * spread(at.slots_s, self) / factorial(count)
        return np.asarray(derivatives * reach + per_rad * unsteady(at.earth, at.slots_s, self) + LOST)


EXACT = Panels(1, 1)
# sizes and nodes that are tried
PANELS = tuple(Panels(size, count) for size in (4, 8, 16, 32, 64, 128) for count in range(2, min(size, MOST + 1)))


@cache
def _nodes(size: int, count: int) -> Any:
    """The integrations nearest to Chebyshev's points, where products of distances are least, (count,)."""
    if count >= size:
        return np.arange(size)
    at = (size - 1) / 2 * (1 - np.cos(np.pi * (np.arange(count) + 0.5) / count) / np.cos(np.pi / 2 / count))
    found = np.rint(at).astype(int)
    for k in range(1, count):  # no two the same: there are enough for all
        found[k] = max(found[k], found[k - 1] + 1)
    for k in range(count - 1, 0, -1):
        found[k] = min(found[k], size - count + k)
    return found


def weights(slots_s: Float, nodes: Int) -> Float:
    """Of the values at the nodes in those at all integrations (..., T), (..., T, count): Lagrange's polynomials."""
    at = slots_s[..., nodes]
    out = np.ones((*slots_s.shape, len(nodes)))
    for k in range(len(nodes)):
        for j in range(len(nodes)):
            if j != k:
                with np.errstate(divide="ignore", invalid="ignore"):
                    out[..., k] *= (slots_s - at[..., j, None]) / (at[..., k] - at[..., j])[..., None]
    return out


def spread(slots_s: Float, panels: Panels) -> float:
    """Largest product over the nodes of |t - node|, s^count, in any panel: f is wrong by that times |f^(n)| / n!."""
    largest = 0.0
    for which, nodes in panels.alike(len(slots_s)):
        found = slots_s[which]
        apart = np.abs(found[..., None] - found[:, None, nodes]).prod(axis=-1)
        largest = float(np.maximum(largest, apart.max()))
    return largest


def unsteady(earth: EarthFrame, slots_s: Float, panels: Panels) -> float:
    """How far the Earth is from polynomials through the nodes once its rotation is taken out, rad.

    Tables of UT1 and of the pole have a kink a day, and times are kept to a microsecond; what is smooth leaves nothing.
    NaN where two times of a panel are the same: no polynomial goes through them.
    """
    angle = EARTH_RATE * (slots_s - slots_s[0])
    cos, sin = np.cos(angle)[:, None], np.sin(angle)[:, None]
    x, y, z = np.moveaxis(earth.matrices, 1, 0)
    still = np.stack([cos * x - sin * y, sin * x + cos * y, z], axis=1).reshape(len(slots_s), 9)
    largest = 0.0
    for which, nodes in panels.alike(len(slots_s)):
        found = still[which]
        apart = found - weights(slots_s[which], nodes) @ found[:, nodes]
        largest = float(np.maximum(largest, np.linalg.norm(apart, axis=-1).max()))
    return largest


@compiled(nogil=True, fastmath=FAST, error_model="numpy")
def _multiply(out: Any, values: Any, share: Any) -> None:
    times, cells = out.shape
    count = values.shape[0]
    step = 512
    re, im = np.empty(step), np.empty(step)
    for first in range(0, cells, step):
        n = min(step, cells - first)
        for t in range(times):
            re[:n] = 0.0
            im[:n] = 0.0
            for k in range(count):
                w = share[t, k]
                for i in range(n):
                    re[i] += w * values[k, first + i].real
                    im[i] += w * values[k, first + i].imag
            for i in range(n):
                z = out[t, first + i]
                out[t, first + i] = complex(z.real * re[i] - z.imag * im[i], z.real * im[i] + z.imag * re[i])
