"""Rising: how high and low directions come, and how near zeniths and horizons, over all times and stations.

Not every time is looked at: between two of them a sine of an elevation, turned with the Earth, bends by no more than
(rate x seconds)² / 8 from the chord, and where that is no extreme of a direction nothing between counts.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any, NamedTuple

import numpy as np

from instrument.observe.directions import EARTH_RATE, EarthFrame
from instrument.units import Float, Int

STRIDE_S = 480.0  # between times at which all directions are looked at
SLACK = 1.05  # of the bend: a leap second, light that is bent otherwise at another time
BLOCK = 4096  # times held at once
SINES = 4_000_000  # sines held at once: 32 MB
MANY = 0.3  # of the spans of a direction: where more may hold an extreme of it, all times are looked at
STEEP = 1e-6  # from 1: 1 - up² has lost 6 digits there, and all of them at the zenith


class Rising(NamedTuple):
    """Extremes of each direction over all times and stations, (S,): of the sine of its elevation and of its distance.

    `zenith` is its least distance from a zenith or nadir and `horizon` its least from an antenna plane, as sines.
    """

    highest: Float
    lowest: Float
    zenith: Float
    horizon: Float

    @classmethod
    def unknown(cls, count: int) -> Rising:
        """Of so many directions, before any time was looked at."""
        return cls(*(np.full(count, x) for x in (-1.0, 1.0, np.inf, 1.0)))

    def some(self, directions: slice) -> Rising:
        """Of some directions, of the same memory."""
        return Rising(*(x[directions] for x in self))

    def take(self, up: Float) -> None:
        """Look at sines (S, T, G) of every direction."""
        np.maximum(self.highest, up.max(axis=(1, 2)), out=self.highest)
        np.minimum(self.lowest, up.min(axis=(1, 2)), out=self.lowest)
        np.minimum(self.horizon, np.abs(up).min(axis=(1, 2)), out=self.horizon)

    def take_some(self, directions: Int, up: Float) -> None:
        """Look at one sine (K,) of each of some directions, which may come more than once."""
        np.maximum.at(self.highest, directions, up)
        np.minimum.at(self.lowest, directions, up)
        np.minimum.at(self.horizon, directions, np.abs(up))

    def whole(self) -> Rising:
        """With distances from zeniths where none is so near that it was looked at: 1 - up² is good enough there."""
        steepest = np.maximum(self.highest, -self.lowest)
        far = np.sqrt(np.maximum(1.0 - steepest**2, 0.0))
        return self._replace(zenith=np.where(np.isinf(self.zenith), far, self.zenith))


def rising(earth: EarthFrame, slots_s: Float, vectors: Float, normals: Float) -> Rising:
    """Of ICRS unit vectors (S, 3) at times (T,) over planes whose ITRF normals are (G, 3)."""
    found = Rising.unknown(len(vectors))
    for begin in range(0, len(earth), BLOCK):
        block = slice(begin, begin + BLOCK + 1)  # with the first of the next
        looked = _looked(slots_s[block])
        step = max(1, int(SINES / (len(looked) * len(normals))))
        some = _Turned.of(earth[block], slots_s[block], normals)
        for first in range(0, len(vectors), step):
            here = slice(first, first + step)
            _look(found.some(here), vectors[here], some, looked)
    return found.whole()


def rising_seen(seen: Float, normals: Float) -> Rising:
    """Of directions whose apparent ITRF unit vectors (T, S, 3) are known, every one of them looked at."""
    found = Rising.unknown(seen.shape[1])
    step = max(1, int(SINES / max(1, seen.shape[1] * len(normals))))
    for begin in range(0, len(seen), step):
        here = seen[begin : begin + step]
        up = here @ normals.T
        found.take(np.swapaxes(up, 0, 1))
        t, s, g = np.nonzero(np.abs(up) > 1 - STEEP)
        np.minimum.at(found.zenith, s, np.linalg.norm(np.cross(normals[g], here[t, s]), axis=-1))
    return found.whole()


def _looked(slots_s: Float) -> Int:
    """Times at which all directions are looked at, the first and the last of them; all where they do not follow."""
    steps = np.diff(slots_s)
    if not len(steps) or not (steps > 0).all():
        return np.arange(len(slots_s))
    stride = max(1, round(STRIDE_S / float(np.median(steps))))
    return np.append(np.arange(0, len(slots_s) - 1, stride), len(slots_s) - 1)


class _Turned(NamedTuple):
    """The Earth at some times, by how much it has turned until each (T,), and normals of planes (G, 3)."""

    earth: EarthFrame
    turned: Float
    normals: Float

    @classmethod
    def of(cls, earth: EarthFrame, slots_s: Float, normals: Float) -> _Turned:
        """By its matrices, and by the clock where that is more: a turn and a half is not half a turn."""
        cosine = (np.einsum("tcd,tcd->t", earth.matrices[1:], earth.matrices[:-1]) - 1) / 2
        turns = np.maximum(np.arccos(np.clip(cosine, -1, 1)), EARTH_RATE * np.diff(slots_s))
        return cls(earth, np.append(0.0, np.cumsum(turns)), normals)

    def sines(self, vectors: Float, times: Int, planes: Int) -> tuple[Float, Float]:
        """Of directions (K, 3) at times (K,) over planes (K,), and how far they are from the normals, both (K,)."""
        normal = np.einsum("kc,kcd->kd", self.normals[planes], self.earth.matrices[times])
        moved = vectors + self.earth.velocity[times]
        size = np.sqrt(np.einsum("kc,kc->k", moved, moved))
        up = np.einsum("kc,kc->k", normal, moved) / size
        far = np.full(len(up), np.inf)
        steep = np.abs(up) > 1 - STEEP
        far[steep] = np.linalg.norm(np.cross(normal[steep], moved[steep]), axis=-1) / size[steep]
        return up, far


def _look(found: Rising, vectors: Float, some: _Turned, looked: Int) -> None:
    """Look at directions at some times, then in the middle between those where an extreme of one may lie, and so on."""
    up = some.earth[looked].sines(vectors, some.normals)
    found.take(up)
    _look_up(found, vectors, some, looked, up)
    if len(looked) == len(some.earth):
        return
    bend = _bend(np.diff(some.turned[looked]))[:, None]
    top, low = np.maximum(up[:, :-1], up[:, 1:]) + bend, np.minimum(up[:, :-1], up[:, 1:]) - bend
    spans = _may_hold(top, low, *(x[:, None, None] for x in found))
    if (still := spans.mean(axis=(1, 2)) > MANY).any():  # a pole overhead: heights that never change
        every = Rising(*(x[still] for x in found))
        _look_at_all(every, vectors[still], some)
        for here, there in zip(found, every, strict=True):
            here[still] = there
        spans[still] = False
    s, t, g = np.nonzero(spans)
    for part in _pieces(len(s)):
        where, plane, first = s[part], g[part], t[part]
        ends = up[where, first, plane], up[where, first + 1, plane]
        _halve(found, vectors, some, where, plane, (looked[first], looked[first + 1]), ends)


def _look_up(found: Rising, vectors: Float, some: _Turned, times: Int, up: Float) -> None:
    """Distances from zeniths where sines (S, T, G) at some times tell that they are small."""
    s, t, g = np.nonzero(np.abs(up) > 1 - STEEP)
    for part in _pieces(len(s)):
        np.minimum.at(found.zenith, s[part], some.sines(vectors[s[part]], times[t[part]], g[part])[1])


def _look_at_all(found: Rising, vectors: Float, some: _Turned) -> None:
    """Look at every time."""
    step = max(1, int(SINES / (len(vectors) * len(some.normals))))
    for begin in range(0, len(some.earth), step):
        times = np.arange(begin, min(begin + step, len(some.earth)))
        up = some.earth[times].sines(vectors, some.normals)
        found.take(up)
        _look_up(found, vectors, some, times, up)


def _halve(
    found: Rising, vectors: Float, some: _Turned, s: Int, g: Int, times: tuple[Int, Int], ends: tuple[Float, Float]
) -> None:
    """Look in the middle of spans of directions `s` over planes `g`, until nothing between can be an extreme."""
    while True:
        bend = _bend(some.turned[times[1]] - some.turned[times[0]])
        top, low = np.maximum(*ends) + bend, np.minimum(*ends) - bend
        keep = (times[1] - times[0] > 1) & _may_hold(top, low, *(x[s] for x in found))
        if not keep.any():
            return
        s, g, (a, b), (up_a, up_b) = s[keep], g[keep], (x[keep] for x in times), (x[keep] for x in ends)
        middle = (a + b) // 2
        up, far = some.sines(vectors[s], middle, g)
        found.take_some(s, up)
        np.minimum.at(found.zenith, s, far)
        s, g = np.tile(s, 2), np.tile(g, 2)
        times = np.append(a, middle), np.append(middle, b)
        ends = np.append(up_a, up), np.append(up, up_b)


def _bend(turns: Float) -> Float:
    """How far a sine may be from its chord over turns of so many rad."""
    return SLACK * turns**2 / 8


def _may_hold(top: Float, low: Float, highest: Float, lowest: Float, _: Float, horizon: Float) -> Any:
    """Whether an extreme of a direction may be within a span of sines from `low` to `top`."""
    return (top > highest) | (low < lowest) | ((low < horizon) & (top > -horizon))


def _pieces(count: int) -> Iterator[slice]:
    step = SINES // 16
    return (slice(k, k + step) for k in range(0, count, step))
