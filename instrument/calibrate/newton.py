"""All stations of an interval at once, by damped Newton steps J_a exp(e_a): for models with weak common directions."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any, Protocol

import numpy as np
from scipy.linalg import blas, lapack

from instrument import mat2
from instrument.calibrate.als import LANES, matrices, planar, power_of, solve_stations, sweep, unit_diagonal
from instrument.calibrate.common import CommonPart
from instrument.calibrate.normal import BASIS, normal_matrix
from instrument.units import Bool, Complex, Float, Int

NEAR = 0.1  # relative step of averaged sweeps below which all stations are solved at once
FACTORS = 256e6  # bytes of normal matrices that a thread may hold: one of 512 stations takes 134 MB
AGAIN = 0.3  # of the last step: where steps shrink by less, the normal matrix is worked out again
ROUNDING = 4 * mat2.UNIT  # of the power of the data: what sums of a sweep are wrong by along a common direction
FLOOR = 1e-13  # of the power of the data, added to what steps along common directions cost: they are held up by 1e-5
SLACK = 1e-12  # of the power of the data: rounding, as it sums up over sweeps


class Side(Protocol):
    """What is needed of lanes: their data, the sums of a sweep, and the settings of the solver."""

    count: int
    lanes: int
    v: Float
    m: Float
    products: tuple[Complex, Complex]
    a1: Int
    a2: Int
    active: Bool
    settings: Any
    total: Float
    common: CommonPart
    factors: dict[int, tuple[Float, float, Float]]

    def cost(self, jones: Complex, right: Float, left: Float) -> Float:
        """Power left over, relative to that of the data (L,)."""

    def normal(self, left: Float) -> Complex:
        """sum Z Z^H of each station (L, A, 2, 2)."""


def lanes_of(stations: int) -> int:
    """How many intervals are solved side by side: as many as there are vector lanes, or as their factors leave room."""
    return int(np.clip(FACTORS / normal_bytes(stations), 1, LANES))


def normal_bytes(stations: int) -> float:
    """Bytes of the normal matrix of an interval."""
    return 8.0 * (8 * stations) ** 2


def solved_together(lanes: Side, jones: Complex) -> tuple[Complex, Float, Int, Float]:
    """Matrices (L, A, 2, 2), last steps, iterations, worst step of each, as `Lanes.iterate`, from a start."""
    jones = np.where(lanes.active[..., None, None], jones, 0.0)
    lanes.common.begin(jones)
    sums = _Sums(lanes)
    solves = [_Lane(lanes, k) for k in range(lanes.count)]
    step, count, history = np.full(lanes.count, np.inf), np.zeros(lanes.count, int), []
    for _ in range(lanes.settings.iterations):
        share, left_over, new = sums.at(jones)
        for k, solve in enumerate(solves):
            if not step[k] <= lanes.settings.tolerance:  # not a number: unsolved, and so it stays
                if count[k] and not np.isfinite(step[k]) and not solve.far:
                    continue
                count[k] += 1
                jones[k], step[k] = solve.next(jones[k], share[k], left_over[k], new[k])
        history.append(float(np.nanmax(step, initial=0.0)))
        if not np.any(step > lanes.settings.tolerance):
            break
    lanes.factors = {k: (one.factor, one.weight, one.prior) for k, one in enumerate(solves) if one.factor is not None}
    return jones, step, count, np.array(history)


def factored(lanes: Side, jones: Complex, share: Float, which: Iterable[int]) -> None:
    """Puts into lanes the factors of some of them at matrices (L, A, 2, 2) that were found another way."""
    lanes.common.begin(jones)
    for k in which:
        lane = _Lane(lanes, k)
        lanes.common.weigh(k, float(share[k]) ** 2)
        lane.moves = lanes.common.moves(k, jones[k])
        lane.factor_at(jones[k])
        lanes.factors[k] = (lane.factor, lane.weight, lane.prior)


class _Sums:
    """The sums of a sweep over all lanes, and what is made of them."""

    def __init__(self, lanes: Side) -> None:
        self.lanes = lanes
        stations = lanes.active.shape[1]
        self.right, self.left = np.zeros((stations, 8, lanes.lanes)), np.zeros((stations, 4, lanes.lanes))

    def at(self, jones: Complex) -> tuple[Float, Complex, Complex]:
        """Share of the power left over (L,), sum E Z^H of each station, and its answer with the others held."""
        lanes, right, left = self.lanes, self.right, self.left
        sweep(lanes.v, lanes.m, lanes.a1, lanes.a2, planar(jones, lanes.lanes), right, left)
        new = solve_stations(right, left, lanes.settings.pattern)[: lanes.count]
        left_over = matrices(right)[: lanes.count] - jones @ lanes.normal(left)
        return lanes.cost(jones, right, left), left_over, new


class _Lane:
    """One interval: sweeps half way until near, then steps of all stations with the same factors as long as they do."""

    def __init__(self, lanes: Side, k: int) -> None:
        self.lanes, self.k = lanes, k
        self.a1, self.a2 = lanes.a1, lanes.a2
        self.active = lanes.active[k]
        self.pattern = lanes.settings.pattern
        self.basis = BASIS[self.pattern]
        self.far, self.damping, self.last, self.fresh = True, 0.0, np.inf, False
        self.factor: Any = None
        self.within = False
        self.best: Any = None  # matrices, cost, gradient (and left over) of the best point
        self.best_cost, self.weight = np.inf, 0.0
        seen = lanes.common.eigen[0][k][~lanes.common.free[k]]
        self.together = self._together_rows()
        self.weakest = float(seen.min(initial=np.inf))  # of what the data see of common directions

    def _together_rows(self) -> Float:
        """Steps of all stations along the common directions, weakest first (n, A k)."""
        common, k = self.lanes.common, self.k
        found = np.einsum("kn,kij->nij", common.eigen[1][k], common.generators)
        each = np.where(self.active[:, None, None], found[:, None], 0.0 + 0j).view(float)
        return (each.reshape(len(found), -1, 8) @ np.linalg.pinv(self.basis).T).reshape(len(found), -1)

    def next(self, jones: Complex, share: float, left_over: Complex, new: Complex) -> tuple[Complex, float]:
        """The next matrices (A, 2, 2), and how long the step is; never short enough where it was damped."""
        unsolved = self.active & ~np.isfinite(new).all(axis=(-2, -1))
        if unsolved.any():
            self.far = False
            return jones, np.nan
        new = np.where(self.active[:, None, None], new, 0.0)
        change = _relative(new - jones, new)
        if self.far and change > NEAR:
            half = (jones + new) / 2
            return np.where(_dead(new), 0.0, unit_diagonal(half) if self.pattern == "phase" else half), change
        if self.far:
            self.far = False
            self.lanes.common.weight[self.k] = np.inf
        return self._together(jones, share, left_over, new)

    def _together(self, jones: Complex, share: float, left_over: Complex, new: Complex) -> tuple[Complex, float]:
        common, k = self.lanes.common, self.k
        weight, y = common.weigh(k, share), common.moved(k, jones)
        cost = share + weight * float(y @ y) / common.total[k]
        if not np.isfinite(cost):
            return np.zeros_like(jones) if self.best is None else self.best[0], np.nan
        if cost <= self.best_cost + SLACK:
            self.best, self.best_cost = (jones.copy(), left_over, new, y), cost
            self.damping = self.damping / 10 if self.damping > 1e-3 else 0.0
        else:
            self.damping, self.factor = max(10 * self.damping, 0.01), None
        jones, left_over, new, y = self.best
        gradient = self._gradient(jones, left_over, y)
        if self.factor is None or self.weight - weight > 0.5 * (weight + self.weakest):
            self.factor_at(jones)
        step, gained = self._step(jones, gradient)
        length = self._length(jones, step, gained)
        # what the data see once the stations follow may be far less than `weakest`: no end with a prior of before
        stale = length <= self.lanes.settings.tolerance and self.weight > 2 * weight + FLOOR * common.total[k]
        if (length > AGAIN * self.last or stale) and not self.fresh:
            self.factor_at(jones)
            step, gained = self._step(jones, gradient)
            length = self._length(jones, step, gained)
        self.last, self.fresh = length, False
        # within the noise what is left over bends as much as the fit does
        self.within = gained**2 * common.freedom[k] < share * common.unknowns[k]
        size = float(np.sqrt((np.abs(step) ** 2).sum(axis=(-2, -1))).max(initial=0.0))
        turned = jones @ mat2.exponential(step * min(1.0, 1.0 / max(size, 1e-300)))
        odd = self.active & (np.abs(mat2.det(jones)) <= 1e-3 * power_of(jones))
        turned = np.where(odd[:, None, None], new, turned)
        if odd.any():
            length = max(length, _relative(np.where(odd[:, None, None], new - jones, 0.0), new))
        if not np.isfinite(turned).all():
            return jones, np.nan
        if self.damping:  # a short step is no sign of an end
            length = max(length, 2 * self.lanes.settings.tolerance)
        return np.where(_dead(new), 0.0, turned), length

    def _length(self, jones: Complex, step: Complex, gained: float) -> float:
        """Largest relative change of a matrix, but for what the data hardly see of it; or what they gain, if more."""
        return max(_relative(jones @ self.lanes.common.seen(self.k, step), jones), gained)

    def _gradient(self, jones: Complex, left_over: Complex, y: Float) -> Float:
        common, k = self.lanes.common, self.k
        self.moves = common.moves(k, jones)
        data = np.ascontiguousarray(mat2.mul(mat2.herm(jones), left_over).reshape(-1)).view(float)
        whole = data - common.weight[k] * (y @ self.moves)
        self.each = whole.view(complex).reshape(jones.shape)
        return (whole.reshape(-1, 8) @ self.basis).ravel()

    def _without_rounding(self, gradient: Float) -> Float:
        """A gradient without what it has along common directions that are free, or weak and within rounding.

        The prior may not turn what is free: it would never come to an end. Taken away as the stations are seen: a weak
        station would be moved by the rounding of a strong one.
        """
        common, k = self.lanes.common, self.k
        along = self.together @ gradient
        idle = common.free[k] | (common.weak[k] & (np.abs(along) < ROUNDING * common.total[k]))
        if not idle.any():
            return gradient
        shares = np.linalg.pinv(self.metric[np.ix_(idle, idle)], hermitian=True) @ along[idle]
        return np.asarray(gradient - (shares @ self.together[idle]) * self.own)

    def factor_at(self, jones: Complex) -> None:
        """Cholesky factors of the normal matrix with the prior, the gauge and the damping."""
        common, k = self.lanes.common, self.k
        v, m = (x[k] for x in self.lanes.products)
        second = self.each if self.within and not self.damping else None
        normal = normal_matrix(v, m, self.a1, self.a2, jones, self.pattern, second)
        diagonal = np.einsum("ii->i", normal)
        prior = (self.moves.reshape(-1, len(jones), 8) @ self.basis).reshape(-1, len(normal))
        self.own = diagonal.copy()
        # what the model does not see stays where it is; through one direction the data see less than common matrices
        self.metric = (self.together * self.own) @ self.together.T
        free = self.together[common.free[k]]
        size = np.maximum((free**2 * self.own).sum(axis=1), 1e-300)[:, None]
        weight = common.weight[k] + FLOOR * common.total[k]
        self.prior = np.sqrt(common.weight[k]) * prior
        rows = np.concatenate([np.sqrt(weight) * prior, free * self.own / np.sqrt(size)])
        upper = blas.dsyrk(1.0, rows.T, beta=1.0, c=normal.T, overwrite_c=1)  # of the transpose: normal is row by row
        diagonal *= 1 + self.damping
        diagonal[:] = np.where(diagonal > 0, diagonal, 1.0)
        self.weight = float(common.weight[k])
        self.factor, bent = lapack.dpotrf(upper, lower=0, overwrite_a=1, clean=0)
        self.fresh = True
        if (
            bent and self.damping < 1e6
        ):  # on a slope that bends down, or singular: the fit alone, or held by what rounding leaves
            self.damping = self.damping if second is not None else max(10 * self.damping, 1e-8)
            self.within = False
            self.factor_at(jones)

    def _step(self, jones: Complex, gradient: Float) -> tuple[Complex, float]:
        """The step e (A, 2, 2), and what the data could gain by it in their rms."""
        gradient = self._without_rounding(gradient)
        found, _ = lapack.dpotrs(self.factor, gradient, lower=0)
        gained = float(np.sqrt(max(found @ gradient, 0.0) / self.lanes.common.total[self.k]))
        step = (found.reshape(len(jones), -1) @ self.basis.T).copy().view(complex).reshape(jones.shape)
        return step, gained


def _dead(new: Complex) -> Bool:
    """Stations (A, 1, 1) without any signal: their answer is zero, and half the way would never get there."""
    return (new == 0).all(axis=(-2, -1))[:, None, None]


def _relative(change: Complex, of: Complex) -> float:
    """Largest change of a matrix (A, 2, 2) relative to itself, but not to less than 1e-12 of the largest."""
    moved, size = np.sqrt(power_of(change)), np.sqrt(power_of(of))
    floor = max(1e-12 * float(size.max(initial=0.0)), 1e-300)
    return float(np.where(size > floor, moved / np.maximum(size, 1e-300), 0.0).max(initial=0.0))
