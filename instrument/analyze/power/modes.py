"""How many independent modes a bin of Fourier cells has: behind a taper or a hole neighbours are alike."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from instrument.analyze.power.bins import Plane
from instrument.units import Float, Int

NEAR = 6  # cells: the square of a four-term taper reaches no further
LEAST = 1e-4  # of the correlation of a cell with itself: what is less counts with the far ones
SLACK = 1 + 1e-9  # a cell at the edge of a bin is in it, whatever the rounding of its k
SAMPLE = 400  # cells of a bin whose neighbours are counted: all of a smaller bin, of a larger one to 2 %


def _correlation(window: Float) -> tuple[Int, Float, float]:
    """Shifts (D, axes) and |correlation|² (D,) of the DFT of white noise behind a window, and the sum of the rest.

    |DFT(w²)|² over its value at 0, which is the square of the correlation of two cells that far apart.
    """
    power = np.abs(np.fft.fftn(window**2)) ** 2
    power /= power.flat[0]
    near = np.ones(power.shape, bool)
    for axis, n in enumerate(power.shape):
        shape = [1] * power.ndim
        shape[axis] = n
        near &= (np.abs(np.fft.fftfreq(n, 1 / n)) <= NEAR).reshape(shape)
    near &= power > LEAST
    shifts = np.argwhere(near)
    for axis, n in enumerate(power.shape):
        shifts[:, axis] = (shifts[:, axis] + n // 2) % n - n // 2
    return shifts, power[near], max(float(power.sum() - power[near].sum()), 0.0)


Cell = tuple[Int, Int, Int, Float]  # v, u and delay indices, and how many cells of the full grid each stands for
Inside = Callable[[int, Any, Any, Any], Any]


def independent(across: Float, along: Float, bins: list[Cell], sizes: Float, inside: Inside) -> Float:
    """Cells of bins (B,) that are independent behind windows over images (Ny, Nx) and along frequency (N,).

    The cells squared over the sum of |correlation|² of all pairs. `bins` are all cells of each, or a random sample;
    `sizes` (B,) how many it has. `inside(bin, v, u, delay)` says which neighbours are in it, of indices of either sign.
    """
    shifts, share, rest = _correlation(across)
    steps, weight, other = _correlation(along)
    shape = (*across.shape, len(along))
    itself = np.logical_and.outer((shifts == 0).all(axis=1), (steps == 0).all(axis=1))
    far = (share.sum() + rest) * (weight.sum() + other) - share.sum() * weight.sum()
    out = np.zeros(len(bins))
    for b, (v, u, delay, times) in enumerate(bins):
        if not len(v):
            continue
        row, column = (_wrapped(np.add.outer(x, d), n) for x, d, n in zip((v, u), shifts.T, shape, strict=False))
        later = _wrapped(np.add.outer(delay, steps[:, 0]), shape[2])
        there = inside(b, row[:, :, None], column[:, :, None], later[:, None]) | itself
        alike = np.einsum("cde,d,e->c", there, share, weight, optimize=True)
        out[b] = sizes[b] / (np.average(alike, weights=times) + far * sizes[b] / np.prod(shape))
    return out


@dataclass(frozen=True, eq=False)
class Modes:
    """What makes cells (u, v, delay) alike: windows over images (Ny, Nx) and along frequency (N,), real or not.

    `step` is what an index of v, u and delay is worth, 1/Mpc. The two signs of a real field are one mode.
    """

    across: Float
    along: Float
    step: tuple[float, float, float]
    real: bool

    def cylindrical(self, cells: Plane, perp: Float, bounds: Int, rows: Int, bins_par: int) -> Float:
        """Modes (P, L) of bins of k_perp (edges, and where they begin among the cells) and of delays (their bins)."""
        low, high = cells.k_perp[0] * (1 - 1e-9), cells.k_perp[-1] * SLACK**2
        parts = []
        for b in range(len(perp) - 1):
            k = bounds[b] + some(int(bounds[b + 1] - bounds[b]), b)
            parts.append((cells.v_index[k], cells.u_index[k], 0 * k, cells.times[k]))
        sizes = cells.sums(bounds, np.ones(len(cells.k_perp)))

        def within(b: int, v: Int, u: Int, _: Int) -> Any:
            k = SLACK * np.hypot(v * self.step[0], u * self.step[1])
            return (k >= max(perp[b], low)) & (k <= high) & ((k < perp[b + 1]) | (b == len(perp) - 2))

        plane = independent(self.across, np.ones(1), parts, sizes, within)
        n = len(self.along)
        signed = np.zeros((bins_par, n), bool)
        for m, row in enumerate(rows):
            if row >= 0:
                signed[row, [m % n, -m % n]] = True
        delays = [np.flatnonzero(has) for has in signed]
        line = independent(
            np.ones((1, 1)), self.along, [(0 * d, 0 * d, d, np.ones(len(d))) for d in delays],
            signed.sum(axis=1).astype(float), lambda b, _v, _u, d: signed[b, d % n],
        )  # fmt: skip
        return np.multiply.outer(plane, line) / (2 if self.real else 1)

    def spherical(self, cells: Plane, edges: Float, bounds: Int, slope: float, least: float) -> Float:
        """Modes (N,) of bins of k; `bounds` (M, N + 1) are where they begin among the cells of each delay."""
        low, high = cells.k_perp[0] * (1 - 1e-9), cells.k_perp[-1] * SLACK**2
        parts, sizes = [], np.zeros(len(edges) - 1)
        upto = np.append(0.0, np.cumsum(cells.times))
        for b in range(len(edges) - 1):
            many = np.cumsum(bounds[:, b + 1] - bounds[:, b])
            chosen = some(int(many[-1]), b)
            m = np.searchsorted(many, chosen, "right")
            k = bounds[m, b] + chosen - np.append(0, many)[m]
            parts.append((cells.v_index[k], cells.u_index[k], m, cells.times[k] * cells.folds[m]))
            sizes[b] = cells.folds @ (upto[bounds[:, b + 1]] - upto[bounds[:, b]])

        def within(b: int, v: Int, u: Int, delay: Int) -> Any:
            across, par = np.hypot(v * self.step[0], u * self.step[1]), np.abs(delay) * self.step[2]
            k = SLACK * np.hypot(across, par)
            fits = (across >= low) & (across <= high) & (par >= least) & (across * slope <= par * (1 + 1e-9))
            last = (b == len(edges) - 2) & (k <= SLACK**2 * edges[b + 1])
            return fits & (k > 0) & (k >= edges[b]) & ((k < edges[b + 1]) | last)

        return independent(self.across, self.along, parts, sizes, within) / (2 if self.real else 1)


def _wrapped(index: Int, n: int) -> Int:
    """Indices of a DFT of n cells, of either sign, as -n / 2 to n / 2."""
    return (index + n // 2) % n - n // 2


def some(count: int, seed: int) -> Int:
    """All of `count` cells, or SAMPLE of them by chance."""
    if count <= SAMPLE:
        return np.arange(count)
    return np.sort(np.random.default_rng(seed).integers(count, size=SAMPLE))
