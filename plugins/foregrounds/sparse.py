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
SAMPLE = 32768  # coefficients of which the median is taken: to 0.7 %
TOLERANCE = 1e-6  # of 1 - cosine between mixing vectors of two iterations
BLOCK = 256  # coefficients at once: 20 rows of them are 20 kB
PARTS = 8  # of the coefficients, summed in order: the same sums whatever the number of cores


class Found(NamedTuple):
    """Mixing of unit columns (rows, n) or None where nothing is significant, iterations made, their last change."""

    mixing: Float | None
    iterations: int
    change: float
    outcome: Outcome


@compiled(nogil=True, fastmath=True)
def _step(data: Any, unmix: Any, limit: Any, soft: bool, first: int, last: int, across: Any, gram: Any) -> None:
    """Sums of D S^T (rows, n) and S S^T (n, n) over the coefficients first <= p < last, S = threshold(unmix D)."""
    rows, n = data.shape[0], unmix.shape[0]
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
                if abs(s[j, p]) >= limit[j]:
                    active = True
                    if soft:
                        s[j, p] -= limit[j] if s[j, p] > 0 else -limit[j]
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
    """D S^T and S S^T for S = threshold(unmix D), hard or soft; the slow twin is `step_reference`."""
    rows, n = data.shape[0], len(unmix)
    edges = np.linspace(0, data.shape[1], PARTS + 1).astype(int)
    sums = [(np.zeros((rows, n)), np.zeros((n, n))) for _ in range(PARTS)]
    u, t = unmix.astype(data.dtype), limit.astype(data.dtype)
    with ThreadPoolExecutor(os.cpu_count() or 1) as pool:
        list(pool.map(lambda i: _step(data, u, t, soft, edges[i], edges[i + 1], *sums[i]), range(PARTS)))
    return np.sum([x for x, _ in sums], axis=0), np.sum([x for _, x in sums], axis=0)


def step_reference(data: Any, unmix: Float, limit: Float, soft: bool) -> tuple[Float, Float]:
    """The same by numpy: the definition."""
    s = unmix @ data
    s = np.where(np.abs(s) >= limit[:, None], s - (limit[:, None] * np.sign(s) if soft else 0), 0)
    return data @ s.T, s @ s.T


def search(data: Any, n: int, iterations: int, threshold: float, paper: bool) -> Found:
    """Mixing of n components that are sparse in the data (rows, coefficients); contiguous, one precision.

    The threshold falls as the cube of what is left of the iterations from the largest coefficient to `threshold` times
    the noise of each component (its median); then it stays until the mixing does, for as many iterations again.
    `paper`: soft, and such that a growing share of the coefficients above the noise is kept.
    """
    with one_thread():
        a = principal(data, n)[1].copy()
        sample = np.ascontiguousarray(data[:, :: max(data.shape[1] // SAMPLE, 1)])
        change, last = np.inf, iterations if paper else 2 * iterations
        for i in range(last):
            unmix = pinv(a.T @ a) @ a.T
            s = np.abs(unmix.astype(data.dtype) @ sample)
            least = threshold * np.median(s, axis=1) / MAD
            if paper:
                share = (i + 1) / iterations
                limit = np.array([_kept(row, low, share) for row, low in zip(s, least, strict=True)])
            else:
                top = np.maximum(s.max(axis=1), least)
                limit = least + (top - least) * max(1 - i / (iterations - 1), 0.0) ** 3
            across, gram = step(data, unmix, limit, paper)
            active = np.diagonal(gram) > 0
            if not active.any():
                return Found(None, i + 1, change, Outcome.REFUSED)
            size = np.sqrt(np.diagonal(gram)[active])
            even = gram[np.ix_(active, active)] / np.multiply.outer(size, size)  # components of any strength
            new = across[:, active] @ (pinv(even) / np.multiply.outer(size, size))
            length = np.sqrt((new**2).sum(axis=0))
            new = np.where(length > 0, new / np.where(length > 0, length, 1.0), a[:, active])
            change = float(1 - np.abs((new * a[:, active]).sum(axis=0)).min())
            a[:, active] = new
            if i >= iterations - 1 and change < TOLERANCE:
                return Found(a, i + 1, change, Outcome.CONVERGED)
    return Found(a, last, change, Outcome.ITERATION_LIMIT)


def _kept(size: Any, least: float, share: float) -> float:
    """The threshold that keeps the largest `share` of the coefficients above `least`, 5 or more."""
    above = np.sort(size[size > least])[::-1]
    return float(above[min(max(int(share * len(above)), 5), len(above)) - 1]) if len(above) else np.inf
