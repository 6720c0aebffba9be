"""Sparse sums: visibilities of a channel brought to the few samples in time that their baselines need, then gridded.

z = W^T (w V): the adjoint of the interpolation of `predict/time_samples.py`, for I, Q, U, V and the PSF alike, whatever
the weights. What the pixels of an image add to a visibility turns slowly in time: what is gridded is a tenth of the
visibilities and less, each of which is read once.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from typing import Any

import numpy as np

from instrument.compiled import compiled
from instrument.image.clock import Clock, ever_within, turns
from instrument.observe.directions import LIGHT
from instrument.predict.base import Problem
from instrument.predict.time_samples import (
    TimeSamples,
    growth,
    kernels,
    steps,
    taps_for,
    time_samples,
    with_skirts,
)
from instrument.units import Bool, Complex, Float, Int

FEW = 48  # integrations up to which visibilities are gridded as they are
BETWEEN = 0.4  # of the accuracy, for interpolation
SURE = 1.5  # ducc0's error of one visibility over the one that it is asked for: 1.04 at most was found
COLUMNS = 10  # real and imaginary parts of I, Q, U, V; weights of I and of U
SAMPLE = 8.0 * COLUMNS  # bytes
TOGETHER = 128  # baselines whose sums are held at once, until all integrations that share samples are in them
PAYS = 0.5  # samples in place of as many visibilities, at most


def share(problem: Problem, imager: Any) -> float:
    """Samples that are gridded for each visibility of the middle channel of a run, for its plan; 1: all as they are."""
    times, channels, _ = problem.shape
    if not regular(problem):
        return 1.0
    freq_hz = float(problem.at.freq_hz[channels // 2])
    first, places = problem.at.at_centre().block(slice(0, 1), slice(0, 1)), problem.at.layout.positions_m
    baselines = places[problem.antenna1] - places[problem.antenna2]
    use = ever_within(first, baselines, freq_hz, imager.uv_range)
    rates = with_skirts(
        turns(first, baselines[use], freq_hz, imager.pixel * imager.pixels / 2), BETWEEN * imager.accuracy
    )
    each = float(np.mean(1 / steps(rates, problem.interval_s))) if use.any() else 1.0
    found = each + taps_for(BETWEEN * imager.accuracy)[0] / times
    return found if found <= PAYS else 1.0


def regular(problem: Problem) -> bool:
    """Whether a run may bring visibilities to samples: regular times, many, with UVW that are worked out."""
    at = problem.at
    apart = at.own_uvw_m is not None or at.seen_centre is not None
    return not apart and len(at.slots_s) > FEW and bool(np.ptp(np.diff(at.slots_s)) <= 1e-5)


@cache
def _wide(taps: int) -> Float:
    """The kernels of all steps, and zeros up to the next sixteen taps (steps, longest step, wide)."""
    return np.pad(kernels(taps), ((0, 0), (0, 0), (0, -taps % 16)))


@dataclass(frozen=True)
class Comb:
    """Which baselines of a channel may be in its uv range (B,), and how often they turn a second (B,)."""

    clock: Clock
    freq_hz: float
    accuracy: float
    use: Bool
    rates: Float

    @classmethod
    def of(cls, clock: Clock, freq_hz: float, imager: Any) -> Comb:
        """For the pixels of an imager, and its uv range and accuracy."""
        baselines = clock.baselines_m
        rates = turns(clock.first, baselines, freq_hz, imager.pixel * imager.pixels / 2)
        rates = with_skirts(rates, BETWEEN * imager.accuracy)
        use = ever_within(clock.first, baselines, freq_hz, imager.uv_range)
        return cls(clock, freq_hz, imager.accuracy, use, rates)

    def span(self, first: int, most: int) -> Span | None:
        """Sums over integrations from `first` on, as many as `most` samples allow; `None` where that does not pay."""
        if not self.use.any():
            return None
        between, interval = BETWEEN * self.accuracy, self.clock.interval_s
        each = 1 / steps(self.rates[self.use], interval)
        count = int(min(1e6, (most - taps_for(between)[0] * len(each)) / each.sum()))
        if count <= FEW:
            return None
        begin = np.where(self.use, first, 0)
        samples = time_samples(self.rates, begin, begin + count * self.use, interval, between)
        return Span(self, samples, first, count) if samples.count <= PAYS * count * len(each) else None


class Span:
    """Sums of one channel over `count` integrations from `first` on: at samples (N, 10), and of weights."""

    def __init__(self, comb: Comb, samples: TimeSamples, first: int, count: int) -> None:
        self.comb, self.samples, self.first, self.last = comb, samples, first, first + count
        self.sums = np.zeros((samples.count, COLUMNS))
        self.weight = np.zeros(2)  # of I and Q, of U and V
        self.apart = False  # whether they differ

    def add(
        self, data: Complex, weight: Float, flag: Bool, numbers: Int, uv: Float, limits: tuple[float, float] | None
    ) -> None:
        """Add visibilities (T, B, 2, 2) with weights (T, B, 1 or 4) and flags (T, B) at integrations `numbers` (T,).

        `uv` of the stations is in wavelengths (T, A, 2), and so are the limits; other integrations are left out.
        """
        self.apart = self.apart or weight.shape[2] > 1
        low, high = limits or (0.0, np.inf)
        one, other = self.comb.clock.antennas
        samples = self.samples
        _gather(
            (np.ascontiguousarray(data).view(float).reshape(*data.shape[:2], 8), weight, flag, numbers - self.first),
            (uv, one, other, np.array([low, high])),
            (samples.rows, samples.step, samples.offset, _wide(samples.taps), samples.taps),
            self.last - self.first,
            (self.sums, self.weight),
            np.zeros((TOGETHER, COLUMNS, _wide(samples.taps).shape[2])),
        )

    def gridded(self) -> tuple[Float, list[Complex], float]:
        """Baselines in wavelengths (N, 3), I, Q, U, V and two PSF at the samples, and the accuracy left to gridding."""
        rows, slots = self.samples.listed()
        there = np.flatnonzero(self.sums.any(axis=1))
        rows, slots, sums = rows[there], slots[there], self.sums[there]
        if not len(there):
            return np.zeros((0, 3)), [], self.comb.accuracy
        found = np.zeros(slots.max() - slots.min() + 1, int)
        found[slots - slots.min()] = 1
        stations = self.comb.clock.stations(np.flatnonzero(found) + slots.min()) * (self.comb.freq_hz / LIGHT)
        place = (np.cumsum(found) - 1)[slots - slots.min()]
        one, other = (antennas[rows] for antennas in self.comb.clock.antennas)
        uvw = stations[place, one] - stations[place, other]
        columns = [sums[:, k] + 1j * sums[:, k + 1] for k in (0, 2, 4, 6)] + [sums[:, k] + 0j for k in (8, 9)]
        return uvw, columns, (self.comb.accuracy - self.samples.error) / (SURE * growth(self.samples.taps))


# infinities and NaN are looked for
@compiled(nogil=True, fastmath={"contract", "nsz"}, error_model="numpy")
def _gather(given: Any, seen: Any, comb: Any, count: Any, sums: Any, held: Any) -> None:
    """Add visibilities to samples: some baselines after the other, their sums in the cache until they are whole."""
    (data, weight, flag, when), (uv, one, other, limits) = given, seen
    (rows, step, offset, kernels, taps), (out, total) = comb, sums
    apart, row, at = weight.shape[2] > 1, np.zeros(10), np.zeros(held.shape[0], np.int64)
    low, high = limits[0] ** 2, limits[1] ** 2
    for some in range(0, len(rows), len(held)):
        last = min(some + len(held), len(rows))
        at[:] = -1
        for t in range(data.shape[0]):
            after = when[t]
            if after < 0 or after >= count:
                continue
            for n in range(some, last):
                b, k = rows[n], n - some
                u, v = uv[t, one[b], 0] - uv[t, other[b], 0], uv[t, one[b], 1] - uv[t, other[b], 1]
                length = u * u + v * v
                if flag[t, b] or length < low or length > high:
                    continue
                parallel, crossed = weight[t, b, 0], weight[t, b, 2 if apart else 0]
                if not _weighted(data[t, b], parallel, crossed, apart, row):
                    continue
                total[0] += parallel
                total[1] += crossed
                if step[n] == 1:
                    to = out[offset[n] + after]
                    for c in range(10):
                        to[c] += row[c]
                    continue
                first = after // step[n]
                if at[k] != first:
                    if at[k] >= 0:
                        _flush(held[k], out[offset[n] + at[k] : offset[n] + at[k] + taps])
                    at[k] = first
                _hold(held[k], kernels[step[n], after - first * step[n]], row)
        for n in range(some, last):
            if at[n - some] >= 0:
                first = offset[n] + at[n - some]
                _flush(held[n - some], out[first : first + taps])


@compiled(nogil=True, fastmath={"contract", "nsz"}, error_model="numpy")
def _weighted(x: Any, parallel: Any, crossed: Any, apart: Any, row: Any) -> Any:
    """Fill in w I, w Q, w U, w V and the weights (10,) of one visibility (8,); whether it counts."""
    wrong = 0.0
    if not apart:
        for c in range(8):
            wrong += x[c] * 0.0
    if wrong != 0.0 or (parallel == 0.0 and crossed == 0.0):
        return False
    for c in range(8):
        row[c] = 0.0
    half = 0.5 * parallel
    if parallel > 0.0:
        row[0], row[1], row[2], row[3] = x[0] + x[6], x[1] + x[7], x[0] - x[6], x[1] - x[7]
        for c in range(4):
            row[c] *= half
    half = 0.5 * crossed
    if crossed > 0.0:
        row[4], row[5], row[6], row[7] = x[2] + x[4], x[3] + x[5], x[3] - x[5], x[4] - x[2]
        for c in range(4, 8):
            row[c] *= half
    row[8], row[9] = parallel, crossed
    return True


@compiled(nogil=True, fastmath={"contract", "nsz"}, error_model="numpy")
def _hold(held: Any, weights: Any, row: Any) -> None:
    """Add a visibility (10,) to all samples that it is part of (10, wide): loops of sixteen are worked out together."""
    for c in range(10):
        value = row[c]
        for q in range(held.shape[1]):
            held[c, q] += weights[q] * value


@compiled(nogil=True, fastmath={"contract", "nsz"}, error_model="numpy")
def _flush(held: Any, out: Any) -> None:
    """Put what is held (10, wide) to its samples (taps, 10), and hold nothing."""
    for q in range(out.shape[0]):
        for c in range(10):
            out[q, c] += held[c, q]
    held[:] = 0.0
