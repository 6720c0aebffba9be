"""MuellerWeights: the Mueller matrices with which every pixel was seen, sum w Re M^H M, and what they allow."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from instrument import mat2
from instrument.errors import RefusedError
from instrument.observe.directions import offset
from instrument.observe.grid import ImageGrid
from instrument.predict.base import Problem
from instrument.predict.beam_nodes import chebyshev, lagrange
from instrument.units import Bool, Complex, Float

ORDERS = (24, 36, 54)  # Chebyshev points a side between which matrices are polynomials: 24 are 1e-6 of LOFAR over 4 deg
PLACES, WRONG = 40, 1e-4  # held against matrices in so many directions, of the largest matrix
WINDOWS = 96  # of time, each with the beams of its middle
PARTS = np.array([[[1, 0], [0, 1]], [[1, 0], [0, -1]], [[0, 1], [1, 0]], [[0, 1j], [-1j, 0]]])  # of I, Q, U, V


@dataclass(frozen=True)
class MuellerWeights:
    """sum w Re M^H M of every pixel, real (Ny, Nx, 4, 4), from the Stokes parameters of the sky to their own.

    `usable` (Ny, Nx) is where it can be undone: the noise of no Stokes parameter is more than so many times that of the
    best pixel. `amplification` (4, Ny, Nx) is how much more noise I, Q, U, V have than that, `condition` (Ny, Nx) the
    ratio of the singular values of the matrix.
    """

    matrices: Float
    usable: Bool
    amplification: Float
    condition: Float

    @property
    def maps(self) -> Float:
        """Amplification of I, Q, U, V and the condition number, float32 (5, Ny, Nx)."""
        return np.asarray(np.concatenate([self.amplification, self.condition[None]]), np.float32)

    def undone(self, images: Float) -> Float:
        """Images (4, Ny, Nx) through the inverse of the matrices; NaN where that is not usable."""
        out = np.full(images.shape, np.nan)
        use = self.usable
        out[:, use] = np.linalg.solve(self.matrices[use], images[:, use].T[..., None])[..., 0].T
        return out


def mueller_weights(
    problem: Problem, grid: ImageGrid, weight: Float, most: float, centre: Complex | None = None
) -> MuellerWeights:
    """Those of one channel of a problem with weights (T, B); raises `RefusedError` where none is above 0.

    `most` is the amplification of noise up to which a pixel is usable, `centre` (T, 1, A, 2, 2) multiplies the beams.
    """
    if not weight.any():
        raise RefusedError("no visibility has a weight above 0: nothing to image")
    matrices = _matrices(problem, grid, weight, centre)
    sizes = np.abs(np.linalg.eigvalsh(matrices))
    with np.errstate(divide="ignore"):
        condition = sizes.max(axis=-1) / sizes.min(axis=-1)
    good = condition < 1e12
    variance = np.full((4, *grid.pixels), np.inf)
    variance[:, good] = np.diagonal(np.linalg.inv(matrices[good]), axis1=-2, axis2=-1).T
    noise = np.sqrt(np.where(variance > 0, variance, np.inf))
    if not np.isfinite(noise).any():
        raise RefusedError("beams let no pixel tell I, Q, U and V apart: a polarization is missing at every station")
    amplification = noise / noise.min()
    return MuellerWeights(matrices, (amplification <= most).all(axis=0), amplification, condition)


def _matrices(problem: Problem, grid: ImageGrid, weight: Float, centre: Complex | None) -> Float:
    """sum w Re M^H M of every pixel (Ny, Nx, 4, 4), by polynomials that are held against some of them."""
    half = (grid.pixels[1] / 2 * grid.pixel, grid.pixels[0] / 2 * grid.pixel)
    held = np.random.default_rng(0).uniform(-1, 1, (PLACES, 2)) * half
    due = _sums(problem, grid, weight, centre, held)
    for orders in ORDERS:
        points = chebyshev(orders)
        lm = np.stack(np.meshgrid(points * half[0], points * half[1], indexing="ij"), axis=-1).reshape(-1, 2)
        nodes = _sums(problem, grid, weight, centre, lm).reshape(orders, orders, 4, 4)
        x, y = (lagrange(points, held[:, k] / half[k]) for k in range(2))
        wrong = float(np.abs(np.einsum("pa,abst,pb->pst", x, nodes, y) - due).max() / np.abs(due).max())
        if wrong <= WRONG:
            x, y = (lagrange(points, a / far) for a, far in zip((grid.east, grid.north), half, strict=True))
            return np.asarray(np.einsum("yb,abst,xa->yxst", y, nodes, x, optimize=True))
    raise RefusedError(
        f"Mueller matrices are carried over {grid} to {wrong:.1e} of the largest, not to {WRONG:.0e}: the field is too "
        "wide, or a horizon goes through it"
    )


def _sums(problem: Problem, grid: ImageGrid, weight: Float, centre: Complex | None, lm: Float) -> Float:
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
            total += _window(jones if centre is None else mat2.mul(centre[middle, 0, :, None], jones), both)
    return total


def _window(jones: Complex, both: Float) -> Float:
    """sum_ab w_ab Re tr(P_s^H H_a P_t H_b), H = J^H J, of Jones matrices (A, S, 2, 2) and weights (A, A): (S, 4, 4)."""
    powers = mat2.mul(mat2.herm(jones), jones)  # (A, S, 2, 2)
    other = np.tensordot(both, powers, axes=1)  # sum_b w_ab H_b
    pairs = np.einsum("asij,askm->sijkm", powers, other, optimize=True)
    return np.asarray(np.einsum("pim,sijkm,qjk->spq", PARTS.conj(), pairs, PARTS, optimize=True).real)
