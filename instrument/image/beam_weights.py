"""MuellerWeights: the Mueller matrices with which every pixel was seen, sum w Re M^H M, and what they allow."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial

import numpy as np

from instrument import mat2
from instrument.correlations import ALL_FOUR
from instrument.errors import RefusedError
from instrument.observe.directions import offset
from instrument.observe.grid import ImageGrid
from instrument.predict.base import Problem
from instrument.predict.beam_nodes import chebyshev, lagrange
from instrument.predict.operator import STOKES
from instrument.units import Bool, Complex, Float

ORDERS = (24, 36, 54)  # Chebyshev points a side between which matrices are polynomials: 24 are 1e-6 of LOFAR over 4 deg
PLACES, WRONG = 40, 1e-4  # held against matrices in so many directions, of the largest matrix
WINDOWS = 96  # of time, each with the beams of its middle
PARTS = np.array([[[1, 0], [0, 1]], [[1, 0], [0, -1]], [[0, 1], [1, 0]], [[0, 1j], [-1j, 0]]])  # of I, Q, U, V


@dataclass(frozen=True)
class MuellerWeights:
    """sum w Re M^H M of every pixel, real (Ny, Nx, n, n), from the Stokes parameters of the sky to their own.

    `stokes` are the n of them that are seen anywhere: not U and V, say, where pq and qp are not known. `usable`
    (Ny, Nx) is where the matrix can be undone: the noise of none of them is more than so many times that of the best
    pixel. `amplification` (4, Ny, Nx) is how much more noise I, Q, U, V have than that, `condition` (Ny, Nx) the ratio
    of the singular values of the matrix.
    """

    matrices: Float
    usable: Bool
    amplification: Float
    condition: Float
    stokes: tuple[int, ...] = STOKES

    @property
    def maps(self) -> Float:
        """Amplification of I, Q, U, V and the condition number, float32 (5, Ny, Nx)."""
        return np.asarray(np.concatenate([self.amplification, self.condition[None]]), np.float32)

    def undone(self, images: Float) -> Float:
        """Images (4, Ny, Nx) through the inverse of the matrices; NaN where that is not usable or not seen."""
        out = self.solved(images, self.usable, np.nan)
        out[[s for s in STOKES if s not in self.stokes]] = np.nan
        return out

    def solved(self, images: Float, where: Bool, elsewhere: float = 0.0) -> Float:
        """The same of some usable pixels; 0 for what is not seen."""
        out = np.full(images.shape, elsewhere)
        out[:, where] = 0.0
        for_those = np.ix_(np.array(self.stokes), np.flatnonzero(where))
        given = images.reshape(4, -1)[for_those]
        out.reshape(4, -1)[for_those] = np.linalg.solve(self.matrices[where], given.T[..., None])[..., 0].T
        return out


def mueller_weights(
    problem: Problem,
    grid: ImageGrid,
    weight: Float,
    most: float,
    centre: Complex | None = None,
    known: Bool = ALL_FOUR,
) -> MuellerWeights:
    """Those of one channel of a problem with weights (T, B); raises `RefusedError` where none is above 0.

    `most` is the amplification of noise up to which a pixel is usable, `centre` (T, 1, A, 2, 2) multiplies the beams,
    `known` (2, 2) are the correlations that visibilities have.
    """
    if not weight.any():
        raise RefusedError("no visibility has a weight above 0: nothing to image")
    matrices = _matrices(partial(_sums, problem, grid, weight, centre, known), grid)
    seen = np.diagonal(matrices, axis1=-2, axis2=-1).max(axis=(0, 1))
    stokes = np.flatnonzero(seen * most**2 >= seen.max())
    matrices = np.ascontiguousarray(matrices[..., stokes[:, None], stokes])
    sizes = np.abs(np.linalg.eigvalsh(matrices))
    with np.errstate(divide="ignore"):
        condition = sizes.max(axis=-1) / sizes.min(axis=-1)
    good = condition < 1e12
    variance = np.full((len(stokes), *grid.pixels), np.inf)
    variance[:, good] = np.diagonal(np.linalg.inv(matrices[good]), axis1=-2, axis2=-1).T
    noise = np.sqrt(np.where(variance > 0, variance, np.inf))
    if not np.isfinite(noise).any():
        raise RefusedError("beams let no pixel tell I, Q, U and V apart: a polarization is missing at every station")
    amplification = np.full((4, *grid.pixels), np.inf)
    amplification[stokes] = noise / noise.min()
    usable = np.asarray((amplification[stokes] <= most).all(axis=0))
    return MuellerWeights(matrices, usable, amplification, condition, tuple(stokes.tolist()))


def _matrices(sums: Callable[[Float], Float], grid: ImageGrid) -> Float:
    """sum w Re M^H M of every pixel (Ny, Nx, 4, 4), by polynomials that are held against some of them."""
    half = (grid.pixels[1] / 2 * grid.pixel, grid.pixels[0] / 2 * grid.pixel)
    held = np.random.default_rng(0).uniform(-1, 1, (PLACES, 2)) * half
    due = sums(held)
    for orders in ORDERS:
        points = chebyshev(orders)
        lm = np.stack(np.meshgrid(points * half[0], points * half[1], indexing="ij"), axis=-1).reshape(-1, 2)
        nodes = sums(lm).reshape(orders, orders, 4, 4)
        x, y = (lagrange(points, held[:, k] / half[k]) for k in range(2))
        wrong = float(np.abs(np.einsum("pa,abst,pb->pst", x, nodes, y) - due).max() / np.abs(due).max())
        if wrong <= WRONG:
            x, y = (lagrange(points, a / far) for a, far in zip((grid.east, grid.north), half, strict=True))
            return np.asarray(np.einsum("yb,abst,xa->yxst", y, nodes, x, optimize=True))
    raise RefusedError(
        f"Mueller matrices are carried over {grid} to {wrong:.1e} of the largest, not to {WRONG:.0e}: the field is too "
        "wide, or a horizon goes through it"
    )


def _sums(problem: Problem, grid: ImageGrid, weight: Float, centre: Complex | None, known: Bool, lm: Float) -> Float:
    """The same at places on a grid, (S, 4, 4), the beams of the middle of each window of time for all of it."""
    assert grid.centre is not None  # about the phase centre of the data
    at = problem.at.towards(*offset(grid.centre, lm[:, 0], lm[:, 1]))
    total = np.zeros((len(lm), 4, 4))
    for window in np.array_split(np.arange(len(weight)), min(WINDOWS, len(weight))):
        both = np.zeros((at.shape[2], at.shape[2]))
        np.add.at(both, (problem.antenna1, problem.antenna2), weight[window].sum(axis=0))
        if both.any():
            middle = window[len(window) // 2]
            jones = np.broadcast_to(problem.chain.jones(at.some(np.array([middle]))), (1, 1, *at.shape[2:], 2, 2))[0, 0]
            total += _window(jones if centre is None else mat2.mul(centre[middle, 0, :, None], jones), both, known)
    return total


def _window(jones: Complex, both: Float, known: Bool) -> Float:
    """sum_ab w_ab Re tr(P_s^H H_a P_t H_b), H = J^H J, of Jones matrices (A, S, 2, 2) and weights (A, A): (S, 4, 4)."""
    powers = mat2.mul(mat2.herm(jones), jones)  # (A, S, 2, 2)
    if not known.all():  # each receptor a station of its own: H of its row of J alone
        powers = np.einsum("asij,asik->iasjk", jones.conj(), jones).reshape(-1, *jones.shape[1:])
        both = np.asarray(np.kron(known, both), float)
    other = np.tensordot(both, powers, axes=1)  # sum_b w_ab H_b
    pairs = np.einsum("asij,askm->sijkm", powers, other, optimize=True)
    return np.asarray(np.einsum("pim,sijkm,qjk->spq", PARTS.conj(), pairs, PARTS, optimize=True).real)
