"""Beam nodes: directions at which beams are worked out, and smooth functions that carry them over an image.

Products of two beams, M_ab = J_a (x) conj(J_b), are smooth over a field, and so K directions (some 25 for LOFAR over
4 deg at 1e-5) give them everywhere, for all stations, times and channels: M_ab(p) = sum_k c_k(p) M_ab(p_k). The nodes
are chosen among Chebyshev points of a rectangle about the image by a pivoted QR factorisation of products of some
baselines; how wrong they are is measured on others, in other directions.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from instrument.errors import RefusedError
from instrument.jones.chain import Chain
from instrument.observe.directions import lmn, offset
from instrument.observe.grid import ImageGrid
from instrument.observe.sampling import Sampling
from instrument.predict.base import Problem
from instrument.shown import short_repr
from instrument.units import Complex, Float, Int

MIXTURES = 32  # products of which nodes are chosen: 32 numbers each
DRAWS = 160  # products that they are held against
INSTANTS, BANDS = 8, 3  # at which they are drawn
PLACES = 160  # directions in which nodes are held against beams, half of them on the edge
ORDERS = (16, 24, 36, 54)  # Chebyshev points a side that are tried
SAFETY = 2.0  # over the largest error of the products that were looked at
TO_STOKES = np.array([[1, 0, 0, 1], [1, 0, 0, -1], [0, 1, 1, 0], [0, -1j, 1j, 0]]) / 2  # of pp, pq, qp, qq
# of the 16 entries of M those that take Q, U, V to I, and I to Q, U, V (3, 16)
INTO_I = np.kron(TO_STOKES[:1], 2 * TO_STOKES[1:].conj())
OUT_OF_I = np.kron(TO_STOKES[1:], 2 * TO_STOKES[:1].conj())


@dataclass(frozen=True)
class BeamNodes:
    """K directions (l, m) about the centre of a grid (K, 2), and how beams everywhere on it are made of those at them.

    `error` bounds the error of M (its norm), `leakage` that of the part of it that takes Q, U and V to I and back;
    `peak` is the largest M, `growth` the largest sum of |c_k|.
    """

    __repr__ = short_repr
    lm: Float
    series: Float  # (K, d + 1, d + 1): their Chebyshev series over the rectangle, along l and m, i + j <= d
    reach: tuple[float, float]  # half sides of the rectangle
    error: float = 0.0
    leakage: float = 0.0
    peak: float = 1.0
    growth: float = 1.0

    def __len__(self) -> int:
        return len(self.lm)

    def on(self, grid: ImageGrid) -> Float:
        """The functions c_k on all pixels, (K, Ny, Nx)."""
        x, y = (self._terms(a / far) for a, far in zip((grid.east, grid.north), self.reach, strict=True))
        return np.ascontiguousarray(np.einsum("yb,kab,xa->kyx", y, self.series, x, optimize=True))

    def at(self, lm: Float) -> Float:
        """The functions in some directions (S, 2): (K, S)."""
        x, y = (self._terms(lm[:, i] / self.reach[i]) for i in range(2))
        return self.summed(x, y)

    def summed(self, x: Any, y: Any) -> Any:
        """Their sums of some values (S, d + 1) of the terms along l and of those along m: (K, S)."""
        count, orders = self.series.shape[:2]
        half = x @ np.moveaxis(self.series, 0, 1).reshape(orders, -1).astype(x.dtype)
        return np.ascontiguousarray((half.reshape(-1, count, orders) @ y[:, :, None])[:, :, 0].T)

    def _terms(self, at: Float) -> Float:
        return np.asarray(np.polynomial.chebyshev.chebvander(at, self.series.shape[1] - 1), float)


ONE = BeamNodes(np.zeros((1, 2)), np.ones((1, 1, 1)), (1.0, 1.0))  # for beams that are the same everywhere


def chebyshev(count: int) -> Float:
    """Chebyshev points between -1 and 1, (count,)."""
    return np.asarray(np.cos((2 * np.arange(count) + 1) * np.pi / (2 * count)))


def lagrange(points: Float, at: Float) -> Float:
    """Weights of values at Chebyshev points (n,) in those at other places (N, n): the barycentric formula."""
    n = len(points)
    w = (-1.0) ** np.arange(n) * np.sin((2 * np.arange(n) + 1) * np.pi / (2 * n))
    apart = at[:, None] - points
    on: Any = np.abs(apart) < 1e-14
    weights = np.where(on.any(axis=1, keepdims=True), on, w / np.where(on, 1.0, apart))
    return np.asarray(weights / weights.sum(axis=1, keepdims=True))


def beam_nodes(problem: Problem, grid: ImageGrid, tolerance: float) -> BeamNodes:
    """Nodes for the beams of a problem with an error of at most `tolerance`, relative to the peak of M if that is less.

    Raises `RefusedError` where beams are not smooth enough over the grid.
    """
    beams = problem.chain.beams()
    if not any(part.directional for part in beams.parts):
        return ONE
    half = _half(grid)
    at_zenith, zenith = _zenith(problem.at, grid)
    some = _some(problem.at, _risen(problem, grid), at_zenith)
    pairs = problem.antenna1, problem.antenna2
    rng = np.random.default_rng(0)
    places = rng.uniform(-1, 1, (PLACES, 2))
    on_edge, side = np.arange(PLACES // 2), rng.integers(2, size=PLACES // 2)
    places[on_edge, side] = np.sign(places[on_edge, side]) * (1 - 1e-9)
    places = np.concatenate([places * half, zenith])
    due = _products(beams, _towards(some, grid, places), pairs, seed=2)
    peak = float(np.linalg.norm(due, axis=1).max()) / 2  # |M| = 2 for the identity, whose largest singular value is 1
    wanted = tolerance * min(1.0, peak)
    orders, lm, drawn = _smooth(beams, some, grid, half, (due, pairs, places), wanted)
    chosen = _chosen(_products(beams, _towards(some, grid, lm), None, seed=1), wanted)

    def measured(k: int, degree: int | None = None) -> BeamNodes:
        nodes, card = chosen[k]
        found = BeamNodes(lm[nodes], _series(card.reshape(len(nodes), orders, orders), degree), half)
        return _measured(found, due, drawn[:, :, nodes], places)

    best, low, high = measured(-1), -1, len(chosen) - 1
    kept = high
    if best.error > wanted:
        raise _rough(grid, best.error, wanted)
    while high - low > 1:
        middle = (low + high) // 2
        found = measured(middle)
        low, high, best, kept = (low, middle, found, middle) if found.error <= wanted else (middle, high, best, kept)
    for degree in range(2, orders):  # what is beyond is noise of the choice of nodes, most of it
        found = measured(kept, degree)
        if found.error <= wanted:
            best = found
            break
    return replace(best, peak=peak, growth=float(np.abs(best.on(_coarse(grid))).sum(axis=0).max()))


def _series(values: Float, degree: int | None) -> Float:
    """Chebyshev series (K, d + 1, d + 1) of values at Chebyshev points (K, n, n), without terms above a degree."""
    n = values.shape[1]
    turn = np.polynomial.chebyshev.chebvander(chebyshev(n), n - 1).T * (2 / n)
    turn[0] /= 2
    series = np.asarray(turn @ values @ turn.T)
    if degree is None:
        return series
    total = np.add.outer(np.arange(degree + 1), np.arange(degree + 1))
    return np.ascontiguousarray(np.where(total <= degree, series[:, : degree + 1, : degree + 1], 0.0))


def _smooth(
    beams: Chain,
    at: Sampling,
    grid: ImageGrid,
    half: tuple[float, float],
    held: tuple[Complex, Any, Float],
    wanted: float,
) -> tuple[int, Float, Complex]:
    """How many Chebyshev points a side carry beams over a grid, these points (S, 2), and products at them (N, 16, S).

    `held` is what they are held against: products, of which baselines, in which directions.
    """
    due, pairs, places = held
    error = np.inf
    for orders in ORDERS:
        points = chebyshev(orders)
        lm = np.stack(np.meshgrid(points * half[0], points * half[1], indexing="ij"), axis=-1).reshape(-1, 2)
        x, y = (lagrange(points, places[:, i] / half[i]) for i in range(2))
        drawn = _products(beams, _towards(at, grid, lm), pairs, seed=2)
        made = np.einsum("nab,sa,sb->ns", drawn.reshape(-1, orders, orders), x, y, optimize=True).reshape(due.shape)
        error = SAFETY * float(np.linalg.norm(made - due, axis=1).max())
        if error <= wanted / 4:
            return orders, lm, drawn
    raise _rough(grid, error, wanted)


def _rough(grid: ImageGrid, found: float, wanted: float) -> RefusedError:
    return RefusedError(
        f"beams are carried over {grid} to {found:.1e} of their peak, not to {wanted:.1e}: they are not smooth there "
        "(a zenith or a celestial pole among them, a term drawn for each direction), or the field is too wide"
    )


def _half(grid: ImageGrid) -> tuple[float, float]:
    """Half sides of the rectangle about a grid in l and m, which no pixel goes beyond."""
    return grid.pixels[1] / 2 * grid.pixel, grid.pixels[0] / 2 * grid.pixel


def heights(at: Sampling, grid: ImageGrid) -> tuple[Float, Float]:
    """Sines of the least and the largest elevation of a grid at each time, over all stations, (T,) both."""
    sides = np.linspace(-1, 1, 17)
    edge = np.concatenate([np.stack([sides, np.full(17, s)], 1)[:, ::k] for s in (-1, 1) for k in (-1, 1)])
    zeniths = at.layout.axes[at.layout.frames[0], 2]
    up = _towards(at, grid, edge * _half(grid)).itrf @ zeniths.T
    return up.min(axis=(1, 2)), up.max(axis=(1, 2))


def _risen(problem: Problem, grid: ImageGrid) -> Int:
    """The times at which beams are not zero all over a grid, all where none is; raises where a horizon is within it."""
    every = np.arange(problem.at.shape[0])
    if not problem.chain.blind_below_horizon:
        return every
    low, high = heights(problem.at, grid)
    if (across := int(((low < 0) & (high > 0)).sum())) > 0:
        raise RefusedError(
            f"{grid} rise or set while observed (at {across} of {len(every)} times a horizon goes through them): beams "
            "are not smooth there; observe while all of them are above it"
        )
    return every[high > 0] if (high > 0).any() else every


def _zenith(at: Sampling, grid: ImageGrid) -> tuple[int, Float]:
    """The time at which a zenith comes nearest to a grid, and places (l, m) about it where it lies within, (N, 2).

    Axes of azimuth turn about it, and published elements differ there by the azimuth from which they are seen.
    """
    assert grid.centre is not None  # placed, or it would have been refused
    axes = at.layout.axes[at.layout.frames[0], 2]
    found = lmn((axes @ at.earth.matrices).reshape(-1, 3), grid.centre).reshape(len(at.earth), -1, 3)
    beyond = (np.abs(found[..., :2]) / _half(grid)).max(axis=-1) + 9.0 * (found[..., 2] < -1)
    t, g = np.unravel_index(int(np.argmin(beyond)), beyond.shape)
    ring = np.exp(2j * np.pi * np.arange(8) / 8)[:, None] * [1e-4, 1e-3, 1e-2]
    near = found[t, g, :2] + np.stack([ring.real, ring.imag], axis=-1).reshape(-1, 2)
    return int(t), near[(np.abs(near) < _half(grid)).all(axis=1)]


def _some(at: Sampling, among: Int, one: int) -> Sampling:
    """A few instants among some times and `one`, and channels, of a sampling, the first and the last among them."""
    times = among[np.linspace(0, len(among) - 1, INSTANTS).round().astype(int)]
    times = np.unique(np.append(times, one))
    channels = np.unique(np.linspace(0, at.shape[1] - 1, BANDS).round().astype(int))
    ranked = np.argsort(at.freq_hz)[channels]
    return replace(at.some(times), freq_hz=at.freq_hz[np.sort(ranked)])


def _towards(at: Sampling, grid: ImageGrid, lm: Float) -> Sampling:
    """The same towards places on a grid, (S, 2)."""
    if np.any((lm**2).sum(axis=1) >= 1):
        raise RefusedError(f"{grid} reach the horizon of their centre: beams there are not smooth")
    assert grid.centre is not None  # placed, or it would have been refused
    return at.towards(*offset(grid.centre, lm[:, 0], lm[:, 1]))


def _coarse(grid: ImageGrid) -> ImageGrid:
    """The same field in few pixels."""
    from astropy import units as u

    side = 48 / max(grid.pixels)
    if side >= 1:
        return grid
    pixels = tuple(max(2, int(n * side)) for n in grid.pixels)
    return ImageGrid(pixels=pixels, pixel=grid.pixel / side * u.rad, centre=grid.centre)


def _products(beams: Chain, at: Sampling, pairs: tuple[Int, Int] | None, seed: int) -> Complex:
    """M at each instant and channel, (N, 16, S): of some baselines, or of random mixtures of the stations of all.

    Mixtures hold what any pair may need, where so many baselines would leave some out. The same for the same seed.
    """
    times, channels, stations, count = at.shape
    rng = np.random.default_rng(seed)
    each = max(2, DRAWS // (times * channels)) if pairs else max(2, MIXTURES // (times * channels))
    out = np.empty((times * channels * each, 4, 4, count), complex)
    for n, (t, f) in enumerate(np.ndindex(times, channels)):
        j = beams.jones(at.block(slice(t, t + 1), slice(f, f + 1)))[0, 0]
        j = np.broadcast_to(j, (len(j), count, 2, 2))
        if len(j) == 1:
            one, other = (np.broadcast_to(j, (each, count, 2, 2)) for _ in range(2))
        elif pairs is not None:
            pick = rng.integers(len(pairs[0]), size=each)
            one, other = (j[p[pick]] for p in pairs)  # (each, S, 2, 2)
        else:
            mix = rng.normal(size=(2, each, stations, 2)).view(complex)[..., 0] / np.sqrt(2 * stations)
            one, other = (np.tensordot(m, j, axes=1) for m in mix)
        found = np.einsum("nsij,nskl->nikjls", one, other.conj())
        out[n * each : (n + 1) * each] = found.reshape(each, 4, 4, count)
    return out.reshape(-1, 16, count)


def _chosen(products: Complex, wanted: float) -> list[tuple[Int, Float]]:
    """Nodes among the directions of products (N, 16, S) and their functions (K, S), ever more of them."""
    from scipy.linalg import qr, solve_triangular

    rows = products.reshape(-1, products.shape[-1])
    r, order = qr(np.concatenate([rows.real, rows.imag]), mode="r", pivoting=True, check_finite=False)
    size = np.abs(np.diag(r)) / np.sqrt(len(products))  # of what is left at the worst place, rms over baselines
    found: list[tuple[Int, Float]] = []
    for share in 0.7 ** np.arange(24):  # down to 3e-4
        count = max(1, int(np.count_nonzero(size > share * wanted)))
        if found and count == len(found[-1][0]):
            continue
        card = np.empty((count, len(order)))
        card[:, order] = np.concatenate([np.eye(count), solve_triangular(r[:count, :count], r[:count, count:])], axis=1)
        found.append((order[:count], card))
    return found


def _measured(nodes: BeamNodes, due: Complex, at_nodes: Complex, places: Float) -> BeamNodes:
    """The same with the largest error of products (N, 16, S) at some places, made of those at the nodes (N, 16, K)."""
    # one product of two matrices, and not N of stacked ones, which are no BLAS: 10 times as quick
    made = at_nodes.reshape(-1, len(nodes)) @ nodes.at(places).astype(complex)
    wrong = made.reshape(due.shape) - due
    error = float(np.linalg.norm(wrong, axis=1).max())
    parts = (np.linalg.norm(rows @ wrong, axis=1) for rows in (INTO_I, OUT_OF_I))
    return replace(nodes, error=SAFETY * error, leakage=SAFETY * float(np.maximum(*parts).max()))
