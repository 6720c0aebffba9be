"""Time samples: the few instants at which a slow baseline is worked out, and the integrations between them.

What a baseline sees of a field of radius R changes no faster than |du/dt| R turns a second: sampled twice as often as
that asks for, a windowed sinc gives the integrations between. Short baselines need one sample in minutes, long ones
every integration. The adjoint of the interpolation carries visibilities back to the samples.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache, cached_property
from typing import Any

import numpy as np

from instrument.compiled import compiled
from instrument.observe.directions import EARTH_RATE
from instrument.phasor import FAST
from instrument.units import Complex, Float, Int

SIGMA = 2.0  # samples are as many times as dense as the band asks for
STEPS = np.array([1, 2, 3, 4, 5, 6, 8, 10, 12, 16, 20, 24, 30, 40, 48, 60])  # integrations from sample to sample
LONGEST_S = 600.0  # from sample to sample: their tails reach as many of them beyond the run as half the taps
WORTH = 0.8  # of the integrations: what saves less is not worth an error


@dataclass(frozen=True)
class TimeSamples:
    """Samples (N,) of some baselines, each over the integrations that it is asked for, one baseline after the other.

    Baseline `rows[n]` has integrations `begin[n]` to `end[n]`, sampled every `step[n]` of them; its samples are
    `offset[n]` to `offset[n + 1]` of the list, the first of them before `begin` and the last beyond `end`, or each
    integration where the step is 1. `error` is the largest that interpolation makes of exp(i w t) within the band.
    """

    taps: int
    error: float
    rows: Int
    step: Int
    begin: Int
    end: Int

    @cached_property
    def offset(self) -> Int:
        """Where the samples of each baseline begin, and the number of all (len(rows) + 1,)."""
        count = np.where(self.step == 1, self.end - self.begin, (self.end - 1 - self.begin) // self.step + self.taps)
        return np.concatenate([[0], np.cumsum(count)])

    @property
    def count(self) -> int:
        """How many samples there are."""
        return int(self.offset[-1])

    def listed(self) -> tuple[Int, Int]:
        """Baseline and integration of every sample, (N,) each; of integrations before the first and after the last."""
        each = np.repeat(np.arange(len(self.rows)), np.diff(self.offset))
        ahead = np.where(self.step == 1, 0, (self.taps // 2 - 1) * self.step)
        number = np.arange(self.count) - self.offset[each]
        return self.rows[each], (self.begin - ahead)[each] + number * self.step[each]

    def spread(self, samples: Complex, out: Complex) -> None:
        """Add to `out` (T, B, C) what lies between samples (N, C)."""
        given = samples.view(float), self.rows, self.step, self.begin, self.end, self.offset  # numbers side by side
        _spread(*given, kernels(self.taps), out.view(float))

    def gather(self, data: Complex) -> Complex:
        """The adjoint of `spread`: samples (N, C) of data (T, B, C)."""
        out = np.zeros((self.count, data.shape[2]), complex)
        _gather(data, self.rows, self.step, self.begin, self.end, self.offset, kernels(self.taps), out)
        return out


def time_samples(turns_per_s: Float, begin: Int, end: Int, interval_s: float, tolerance: float) -> TimeSamples:
    """Samples of baselines whose signals turn at most so often, (B,), with an error of at most `tolerance`.

    Each over integrations `begin` to `end` (B,) of regular times; where they are the same, it has none. Without a
    tolerance, each integration as it is.
    """
    taps, error = taps_for(tolerance) if tolerance else (2, 0.0)
    step = steps(turns_per_s, interval_s)
    few = (end - 1 - begin) // step + taps < WORTH * (end - begin)
    step = np.where(few & (tolerance > 0), step, 1)
    rows = np.flatnonzero(end > begin)
    sparse = bool(np.any(step[rows] > 1))
    return TimeSamples(taps, error if sparse else 0.0, rows, step[rows], begin[rows], end[rows])


def steps(turns_per_s: Float, interval_s: float) -> Int:
    """Integrations from sample to sample of baselines whose signals turn at most so often, (B,)."""
    with np.errstate(divide="ignore"):
        longest = np.minimum(1 / (2 * SIGMA * turns_per_s), LONGEST_S) / interval_s
    return STEPS[np.maximum(np.searchsorted(STEPS, longest, side="right") - 1, 0)]


def with_skirts(turns_per_s: Float, tolerance: float) -> Float:
    """The band that exp(i x sin(w t)) takes, w the Earth's rotation: its harmonics n have J_n(x), and do not end at x.

    Those above it fall as exp(-0.94 (n - x)^1.5 x^-0.5), and the error of interpolation rises beyond its band as
    tolerance^(-1.4 (n - x) / x): a band wider by (0.6 log(tolerance) / x)^2 keeps their product below the tolerance,
    and one that holds all harmonics above it does so too.
    """
    if not tolerance:
        return turns_per_s
    x, digits = 2 * np.pi * turns_per_s / EARTH_RATE, -np.log(tolerance)
    with np.errstate(divide="ignore"):
        more = np.minimum(0.36 * digits**2 / x, 1.1 * digits ** (2 / 3) * np.cbrt(x) + digits / 3)
    return np.asarray(turns_per_s + EARTH_RATE / (2 * np.pi) * more)


def growth(taps: int) -> float:
    """By how much `gather` may raise the sum of moduli: the largest one of the weights of an integration."""
    return float(np.abs(kernels(taps)).sum(axis=-1).max())


@cache
def taps_for(tolerance: float) -> tuple[int, float]:
    """The fewest taps of a windowed sinc, an even number, whose error stays below a tolerance, and that error."""
    for taps in range(6, 64, 2):
        error = worst(taps)
        if error <= tolerance:
            return taps, error
    return taps, error


@cache
def worst(taps: int) -> float:
    """The largest error of any exp(i w t) within the band, at any place between samples."""
    turns = np.linspace(0, 0.5 / SIGMA, 41)[:, None, None]  # a sample
    at = np.linspace(0, 1, 41)[:, None]
    off = at - np.arange(1 - taps // 2, taps // 2 + 1)
    return 1.1 * float(np.abs((_window(off, taps) * np.exp(-2j * np.pi * turns * off)).sum(axis=-1) - 1).max())


def _window(off: Float, taps: int) -> Float:
    """Weights of samples so far off, in steps: a sinc in a Kaiser window."""
    beta = 0.97 * np.pi * taps / 2 * (1 - 1 / SIGMA)
    return np.asarray(np.sinc(off) * np.i0(beta * np.sqrt(np.maximum(0, 1 - (2 * off / taps) ** 2))) / np.i0(beta))


@cache
def kernels(taps: int) -> Float:
    """Weights of the samples in integrations 0 ... step - 1 after one, (steps, longest step, taps)."""
    out = np.zeros((STEPS[-1] + 1, STEPS[-1], taps))
    for step in STEPS[1:]:
        out[step, :step] = _window(np.arange(step)[:, None] / step - np.arange(1 - taps // 2, taps // 2 + 1), taps)
    out.setflags(write=False)  # shared by all
    return out


@compiled(nogil=True, fastmath={"contract"}, error_model="numpy")  # a range may have no end
def windows(uv: Any, one: Any, other: Any, limits: Any, begin: Any, end: Any) -> None:
    """Fill in where baselines (B,) enter a range of lengths squared, and leave it for good, of stations (T, A, 2)."""
    for t in range(uv.shape[0]):
        for b in range(len(one)):
            u, v = uv[t, one[b], 0] - uv[t, other[b], 0], uv[t, one[b], 1] - uv[t, other[b], 1]
            length = u * u + v * v
            if length >= limits[0] and length <= limits[1]:
                if end[b] == 0:
                    begin[b] = t
                end[b] = t + 1


@compiled(nogil=True, fastmath=FAST, error_model="numpy")
def _spread(samples: Any, rows: Any, step: Any, begin: Any, end: Any, offset: Any, kernels: Any, out: Any) -> None:
    taps, columns = kernels.shape[2], out.shape[2]
    total = np.empty(columns, samples.dtype)
    for t in range(out.shape[0]):
        for n in range(len(rows)):
            if t < begin[n] or t >= end[n]:
                continue
            after = t - begin[n]
            if step[n] == 1:
                for c in range(columns):
                    out[t, rows[n], c] += samples[offset[n] + after, c]
                continue
            first = after // step[n]
            weights, begun = kernels[step[n], after - first * step[n]], offset[n] + first
            total[:] = 0.0
            for q in range(taps):
                for c in range(columns):
                    total[c] += weights[q] * samples[begun + q, c]
            for c in range(columns):
                out[t, rows[n], c] += total[c]


@compiled(nogil=True, fastmath=FAST, error_model="numpy")
def _gather(data: Any, rows: Any, step: Any, begin: Any, end: Any, offset: Any, kernels: Any, out: Any) -> None:
    taps = kernels.shape[2]
    for t in range(data.shape[0]):
        for n in range(len(rows)):
            if t < begin[n] or t >= end[n]:
                continue
            row, after = rows[n], t - begin[n]
            if step[n] == 1:
                for c in range(data.shape[2]):
                    out[offset[n] + after, c] += data[t, row, c]
                continue
            first = after // step[n]
            phase = after - first * step[n]
            for q in range(taps):
                w = kernels[step[n], phase, q]
                for c in range(data.shape[2]):
                    out[offset[n] + first + q, c] += w * data[t, row, c]
