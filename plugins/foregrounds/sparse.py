"""The search of GMCA: alternating least squares for mixing and sparse maps under a falling threshold, compiled."""

from __future__ import annotations

import os
from concurrent.futures import ThreadPoolExecutor
from typing import Any, NamedTuple

import numpy as np

from instrument.compiled import compiled
from instrument.errors import Outcome
from instrument.foreground.linear import one_thread, pinv, principal
from instrument.units import Float

MAD = 0.6744897501960817  # median |x| of a normal deviate of rms 1
TOLERANCE = 1e-6  # sine of the angle by which an iteration may still turn what the spectra span
SETTLED = 1e-4  # the same at the iteration limit: of a signal 100 times above the noise that moves 1 % of the noise
SLOPE = 0.25  # a coefficient fades out between 1 - SLOPE and 1 + SLOPE of the threshold
BLOCK = 256  # coefficients at once: 20 rows of them are 20 kB
PARTS = 8  # of the coefficients, summed in order: the same sums whatever the number of cores


class Found(NamedTuple):
    """Mixing of unit columns (rows, n) or None where nothing is significant, iterations made, their last change."""

    mixing: Float | None
    iterations: int
    change: float
    outcome: Outcome


@compiled(nogil=True, fastmath=True)
def _step(data: Any, unmix: Any, threshold: Any, first: int, last: int, across: Any, gram: Any) -> None:
    """Sums of D S^T (rows, n) and S S^T (n, n) over the coefficients first <= p < last, S = threshold(unmix D)."""
    rows, n = data.shape[0], unmix.shape[0]
    low, high, soft = threshold
    s = np.empty((n, BLOCK), data.dtype)
    one = np.zeros((rows, n), data.dtype)
    two = np.zeros((n, n), data.dtype)
    for a in range(first, last, BLOCK):
        size = min(BLOCK, last - a)
        s[:] = 0
        for r in range(rows):
            row = data[r, a : a + size]  # a slice of one axis: the loop below becomes vector instructions
            for j in range(n):
                factor, out = unmix[j, r], s[j]
                for p in range(size):
                    out[p] += factor * row[p]
        one[:] = 0
        two[:] = 0
        for p in range(size):
            active = False
            for j in range(n):
                x = abs(s[j, p])
                if x > low[j]:
                    active = True
                    if soft:
                        s[j, p] -= low[j] if s[j, p] > 0 else -low[j]
                    elif x < high[j]:
                        rise = (x - low[j]) / (high[j] - low[j])
                        s[j, p] *= rise * rise * (3 - 2 * rise)
                else:
                    s[j, p] = 0
            if active:
                for j in range(n):
                    if s[j, p] != 0:
                        for r in range(rows):
                            one[r, j] += s[j, p] * data[r, a + p]
                        for k in range(n):
                            two[j, k] += s[j, p] * s[k, p]
        across += one
        gram += two


def step(data: Any, unmix: Float, limit: Float, soft: bool) -> tuple[Float, Float]:
    """D S^T and S S^T for S = threshold(unmix D), smooth or soft; the slow twin is `step_reference`."""
    rows, n = data.shape[0], len(unmix)
    edges = np.linspace(0, data.shape[1], PARTS + 1).astype(int)
    sums = [(np.zeros((rows, n)), np.zeros((n, n))) for _ in range(PARTS)]
    u, (low, high) = unmix.astype(data.dtype), (x.astype(data.dtype) for x in _edges(limit, soft))
    with ThreadPoolExecutor(os.cpu_count() or 1) as pool:
        list(pool.map(lambda i: _step(data, u, (low, high, soft), edges[i], edges[i + 1], *sums[i]), range(PARTS)))
    return np.sum([x for x, _ in sums], axis=0), np.sum([x for _, x in sums], axis=0)


def step_reference(data: Any, unmix: Float, limit: Float, soft: bool) -> tuple[Float, Float]:
    """The same by numpy: the definition."""
    s = unmix @ data
    s = np.sign(s) * np.maximum(np.abs(s) - limit[:, None], 0) if soft else s * share(s, limit[:, None])
    return data @ s.T, s @ s.T


def share(values: Any, limit: Any) -> Any:
    """What is kept of coefficients: 0 below 1 - SLOPE of the limit, 1 above 1 + SLOPE, u^2 (3 - 2u) between them.

    A hard threshold drops or keeps a coefficient by the last bit: of 60 mK noise in float32 one ulp of the cube then
    changed the residual by 0.054 K, and with this by 1e-7.
    """
    low, high = _edges(limit, False)
    rise = np.clip((np.abs(values) - low) / np.where(high > low, high - low, 1), 0, 1)
    return np.where(high > low, rise * rise * (3 - 2 * rise), 1).astype(np.result_type(values))


def _edges(limit: Any, soft: bool) -> tuple[Any, Any]:
    return (limit, limit) if soft else ((1 - SLOPE) * limit, (1 + SLOPE) * limit)


def chance(threshold: float) -> float:
    """Power that thresholds leave of noise of rms 1."""
    x = np.linspace(0, 12, 4801)
    return float(np.trapezoid((x * share(x, threshold)) ** 2 * np.exp(-(x**2) / 2), x) * np.sqrt(2 / np.pi))


def search(data: Any, sample: Any, noise: Float, n: int, iterations: int, threshold: float, paper: bool) -> Found:
    """Mixing of n components that are sparse in the data (rows, coefficients); contiguous, one precision.

    The threshold falls as the cube of what is left of the iterations from the largest coefficient to `threshold` times
    the noise of each component (its median in the `sample`, some of the columns); then it stays until what the mixing
    spans does, for as many iterations again. The spectra may go on turning within that span, which changes no residual.
    `paper`: soft, and such that a growing share of the coefficients above the noise is kept.
    """
    with one_thread():
        start = principal(data, n)[1]
        a = start.copy()
        hold = 0.0 if paper else chance(threshold) * data.shape[1]
        change, last = np.inf, iterations if paper else 2 * iterations
        limit = np.zeros(n)
        for i in range(last):
            unmix = pinv(a.T @ a) @ a.T
            if i < iterations:
                sizes = np.abs(unmix.astype(data.dtype) @ sample)
                least = threshold * np.median(sizes, axis=1).astype(float) / MAD
                limit = _limit(sizes, least, i, iterations, paper)
            across, gram = step(data, unmix, limit, paper)
            active = np.diagonal(gram) > 0
            if not active.any():
                return Found(None, i + 1, change, Outcome.REFUSED)
            held = hold * ((unmix * noise) ** 2).sum(axis=1)
            across, gram = across + start * held, gram + np.diag(held)
            size = np.sqrt(np.diagonal(gram)[active])
            even = gram[np.ix_(active, active)] / np.multiply.outer(size, size)  # components of any strength
            new = across[:, active] @ (pinv(even) / np.multiply.outer(size, size))
            length = np.sqrt((new**2).sum(axis=0))
            before = np.linalg.qr(a)[0]
            a[:, active] = np.where(length > 0, new / np.where(length > 0, length, 1.0), a[:, active])
            after = np.linalg.qr(a)[0]
            change = float(np.linalg.norm(after - before @ (before.T @ after), 2))
            if i >= iterations - 1 and change < TOLERANCE:
                return Found(a, i + 1, change, Outcome.CONVERGED)
    settled = not paper and change < SETTLED
    return Found(a, last, change, Outcome.CONVERGED if settled else Outcome.ITERATION_LIMIT)


def _limit(sizes: Any, least: Float, i: int, iterations: int, paper: bool) -> Float:
    """Threshold of every component (n,) in one iteration, from sizes of some of its coefficients (n, N)."""
    if paper:
        part = (i + 1) / iterations
        return np.array([_kept(row, low, part) for row, low in zip(sizes, least, strict=True)])
    top = np.maximum(sizes.max(axis=1), least)
    return np.asarray(least + (top - least) * max(1 - i / (iterations - 1), 0.0) ** 3)


def _kept(size: Any, least: float, part: float) -> float:
    """The threshold that keeps the largest part of the coefficients above `least`, 5 or more."""
    above = np.sort(size[size > least])[::-1]
    return float(above[min(max(int(part * len(above)), 5), len(above)) - 1]) if len(above) else np.inf
