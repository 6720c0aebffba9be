"""The normal equations of several clusters, with the stations held and all together.

With E_ab = V_ab - sum_c J_a^c Z_ab^c, Z_ab^c = M_ab^c J_b^cH, a step d obeys, for every station a and all clusters,
sum_b (d_a Z_ab + (d_b Z_ba)^H) Z_ab^H = sum_b E_ab Z_ab^H. With the other stations held it falls into a system of 2C
unknowns a row for each station (Smirnov & Tasse 2015).
"""

from __future__ import annotations

from collections.abc import Callable
from functools import cached_property

import numpy as np

from instrument.calibrate.cluster_data import Block
from instrument.units import Complex, Float

RIDGE = 1e-13  # of the diagonal: the answer moves by less, and nothing is divided by zero


class Equations:
    """The equations of one round, at matrices x (A, 2, K, 2), with weights (P, A, A, s)."""

    def __init__(self, block: Block, x: Complex, z: Complex, weight: Float) -> None:
        self.block, self.x, self.z, self.weight = block, x, z, weight
        shape = (*block.v.shape[:2], 1, *block.v.shape[3:])
        spread = np.broadcast_to(weight[:, :, None, :, :, None], shape).reshape(*shape[:3], -1)
        self.weighted = np.conj(z * spread).swapaxes(-1, -2)
        stations, columns = block.stations, block.columns
        normal = np.zeros((stations, columns, 2, columns, 2), complex)
        pairs = z @ self.weighted
        clusters = block.column.shape[1]
        for p, col in enumerate(block.column):
            own = pairs[p].reshape(stations, clusters, 2, clusters, 2)
            normal[:, col[:, None], :, col[None, :]] += own.transpose(1, 3, 0, 2, 4)
        if block.limits.pattern != "full":
            normal = normal * np.eye(2)[:, None, :]
        if block.limits.pattern == "scalar":
            normal[:, :, 0, :, 0] = normal[:, :, 1, :, 1] = (normal[:, :, 0, :, 0] + normal[:, :, 1, :, 1]) / 2
        self.normal = normal.reshape(stations, 2 * columns, 2 * columns)

    @cached_property
    def inverse(self) -> Complex:
        """Of the system of each station, (A, 2K, 2K)."""
        scaled, root = unit_diagonal(self.normal)
        inverse = np.linalg.inv(scaled + RIDGE * np.eye(scaled.shape[-1]))
        return np.asarray(inverse / root[:, :, None] / root[:, None, :])

    def sums(self, values: Complex) -> Complex:
        """sum_b w Y_ab Z_ab^H (A, 2, K, 2) of values Y (P, A, 2, A, s, 2), within the pattern."""
        pieces = values.reshape(*values.shape[:3], -1) @ self.weighted
        return self.within(self._gathered(pieces))

    def held(self, right: Complex) -> Complex:
        """The step of every station with the others held."""
        return self.within(_times(right, self.inverse))

    def own(self, step: Complex) -> Complex:
        """What the steps of stations do to their own sums."""
        return self.within(_times(step, self.normal))

    def both(self, step: Complex) -> Complex:
        """What a step of all stations does to the sums."""
        change = (self.block.rows(step) @ self.z).reshape(self.block.v.shape)
        return self.sums(change + np.conj(change.transpose(0, 3, 5, 1, 4, 2)))

    def curvature(self, left: Complex) -> Complex:
        """Newton's second-order term by what is left: d_b of unknown k to sum_b w E_ab d_b M_ab^H, (K, 4A, 4A)."""
        block = self.block
        stations, samples = block.stations, block.v.shape[4]
        out = np.zeros((block.columns, stations, 2, 2, stations, 2, 2), complex)
        weighted = left * self.weight[:, :, None, :, :, None]
        for p, col in enumerate(block.column):
            here = weighted[p].transpose(0, 2, 1, 4, 3).reshape(stations, stations, 4, samples)  # (a, b, i q, s)
            for c, k in enumerate(col):
                there = np.conj(block.m[p, :, c]).transpose(0, 2, 3, 1, 4).reshape(stations, stations, samples, 4)
                pairs = (here @ there).reshape(stations, stations, 2, 2, 2, 2)  # (a, b, i, q, alpha, r)
                out[k] += pairs.transpose(0, 2, 4, 1, 3, 5)
        whole = out.reshape(block.columns, 4 * stations, -1)
        if block.limits.pattern == "phase":  # unit numbers are bent themselves
            gradient = self._gathered(left.reshape(*left.shape[:3], -1) @ self.weighted)
            bend = (np.conj(self.x) * gradient).real.transpose(2, 0, 1, 3).reshape(block.columns, -1)
            whole[:, range(4 * stations), range(4 * stations)] -= bend
        return whole

    def bent(self, step: Complex, curvature: Complex) -> Complex:
        """What a step does to the sums of what is left over."""
        flat = np.ascontiguousarray(step.transpose(2, 0, 1, 3)).reshape(len(curvature), -1, 1)
        moved = (curvature @ flat).reshape(len(curvature), -1, 2, 2)
        return self.within(moved.transpose(1, 2, 0, 3))

    def _gathered(self, pieces: Complex) -> Complex:
        """Sums (P, A, 2, 2C) of pieces as sums of unknowns (A, 2, K, 2)."""
        block = self.block
        out = np.zeros((block.stations, 2, block.columns, 2), complex)
        for p, col in enumerate(block.column):
            out[:, :, col] += pieces[p].reshape(block.stations, 2, -1, 2)
        return out

    def within(self, step: Complex) -> Complex:
        """The part of a step (A, 2, K, 2) that keeps the pattern."""
        pattern = self.block.limits.pattern
        if pattern == "full":
            return step
        step = step * np.eye(2)[:, None, :]
        if pattern == "scalar":
            step[:, 0, :, 0] = step[:, 1, :, 1] = (step[:, 0, :, 0] + step[:, 1, :, 1]) / 2
        if pattern == "phase":
            step = 1j * self.x * (np.conj(self.x) * step).imag
        return step


def conjugate_gradients(
    times: Callable[[Complex], Complex], near: Callable[[Complex], Complex], right: Complex, reduction: float, most: int
) -> tuple[Complex, bool]:
    """The solution of `times`(x) = right until the rest falls by `reduction`, and whether all curvatures are positive.

    `near` is the preconditioner, an inverse of something near `times`.
    """
    step, rest = np.zeros_like(right), right
    turned = near(rest)
    along, size = turned, dot(rest, turned)
    goal = size * reduction**2
    for _ in range(most):
        if not size > goal:
            break
        seen = times(along)
        curve = dot(along, seen)
        if not curve > 0:
            return step, False
        step, rest = step + size / curve * along, rest - size / curve * seen
        turned = near(rest)
        before, size = size, dot(rest, turned)
        along = turned + size / before * along
    return step, True


def unit_diagonal(normal: Complex) -> tuple[Complex, Float]:
    """Matrices (..., n, n) scaled to a unit diagonal, and the roots of it; unknowns without equations stand alone."""
    diagonal = np.einsum("...ii->...i", normal).real
    empty = ~(diagonal > 0)
    root = np.sqrt(np.where(empty, 1.0, diagonal))
    scaled = normal / root[..., :, None] / root[..., None, :]
    return scaled + empty[..., None] * np.eye(normal.shape[-1]), root


def dot(a: Complex, b: Complex) -> float:
    """The sum of products of all real and imaginary parts of two arrays of one shape."""
    return float(np.vdot(a, b).real)


def _times(step: Complex, matrices: Complex) -> Complex:
    """Rows of each station (A, 2, K, 2) times its matrix (A, 2K, 2K)."""
    return (step.reshape(*step.shape[:2], -1) @ matrices).reshape(step.shape)
