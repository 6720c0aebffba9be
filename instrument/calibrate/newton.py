"""All stations of an interval at once, by damped Newton steps J_a exp(e_a): for models with weak common directions."""

from __future__ import annotations

from typing import Any, Protocol

import numpy as np
from scipy.linalg import blas, lapack

from instrument import mat2
from instrument.calibrate.als import LANES, matrices, planar, power_of, solve_stations, sweep, unit_diagonal
from instrument.calibrate.common import CommonPart
from instrument.calibrate.factor import Factor
from instrument.calibrate.normal import BASIS, normal_matrix
from instrument.calibrate.steps import downhill, lengths, turned
from instrument.patience import Patience
from instrument.units import Bool, Complex, Float, Int

NEAR = 0.1  # relative step of averaged sweeps below which all stations are solved at once
FACTORS = 256e6  # bytes of normal matrices that a thread may hold: one of 512 stations takes 134 MB
AGAIN = 0.3  # of the last step: where steps shrink by less, the normal matrix is worked out again
STEPS = 4  # that cost as much as a new factor of it
ROUNDING = 4 * mat2.UNIT  # of the power of the data: what sums of a sweep are wrong by along a common direction
MOVED = 0.03  # of a matrix: errors from a normal matrix so far away are right to a percent
EXACT = 1e-9  # of the rms of the data: what is left where there is no noise, and rounding is all there is
EXACT_POWER = 1e-14  # of that of the data: what sums of a sweep leave of an exact fit
STUCK = 3  # steps in a row that rounding alone has made: an end
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
    factors: dict[int, Factor]

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
    patience = Patience(lanes.count)
    for _ in range(lanes.settings.iterations):
        share, left_over, new = sums.at(jones)
        for k, solve in enumerate(solves):
            if not step[k] <= lanes.settings.tolerance:  # not a number: unsolved, and so it stays
                if count[k] and not np.isfinite(step[k]) and not solve.far:
                    continue
                count[k] += 1
                jones[k], step[k] = solve.next(jones[k], share[k], left_over[k], new[k])
        history.append(float(np.nanmax(step, initial=0.0)))
        if not np.any((step > lanes.settings.tolerance) & ~patience.lost(step)):
            break
    lanes.factors = {k: one.factor for k, one in enumerate(solves) if one.factor is not None}
    return jones, step, count, np.array(history)


def factored(lanes: Side, jones: Complex, share: Float, hard: list[int], most: float, swept: list[int]) -> None:
    """Factors of lanes anew at matrices (L, A, 2, 2), for their errors.

    Of what was solved from another start since, `hard`, and where noise is left and they went on by `most`; of lanes
    `swept` without any, and so without a prior.
    """
    far = {k: _relative(jones[k] - one.at, one.at) > most and share[k] > EXACT for k, one in lanes.factors.items()}
    lanes.common.begin(jones)
    for k in lanes.factors:
        if k in hard or far[k]:
            lane = _Lane(lanes, k)
            lanes.common.weigh(k, float(share[k]) ** 2)
            lane.factor_at(jones[k], None)
            assert lane.factor is not None
            lanes.factors[k] = lane.factor
    for k in swept:
        if k not in lanes.factors and share[k] > EXACT:
            lane = _Lane(lanes, k)
            lanes.common.weight[k] = 0.0
            lane.factor_at(jones[k], None)
            assert lane.factor is not None
            lanes.factors[k] = lane.factor


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
    """One interval: sweeps half way until near, then steps of all stations with factors kept as long as they pay."""

    def __init__(self, lanes: Side, k: int) -> None:
        self.lanes, self.k = lanes, k
        self.active = lanes.active[k]
        self.pattern = lanes.settings.pattern
        self.basis = BASIS[self.pattern]
        self.far, self.damping, self.fresh, self.renew, self.pays = True, 0.0, False, False, True
        self.last = self.first = np.inf  # length of the last step, and of the first with this factor
        self.stuck = 0  # steps in a row that rounding alone has made
        self.before = np.inf  # the rate at which steps shrunk with the factor before
        self.factor: Factor | None = None
        self.own: Float = np.zeros(0)
        self.metric: Float = self.own
        self.apart: Any = None
        self.idle: Any = None  # directions that `apart` is for
        self.within = False
        self.best: Any = None  # matrices, what is left over, cost and y of the best point
        self.best_cost, self.weight = np.inf, 0.0
        common = lanes.common
        self.free, self.weak = common.free[k], common.weak[k]
        self.seen, self.whole = np.zeros((len(self.active), 2, 2), complex), np.zeros((len(self.active), 2, 2), complex)
        # steps of all stations along the common directions, weakest first (n, A k)
        found = np.einsum("kn,kij->nij", common.eigen[1][k], common.generators)
        each = np.where(self.active[:, None, None], found[:, None], 0.0 + 0j).view(float)
        self.together = (each.reshape(len(found), -1, 8) @ np.linalg.pinv(self.basis).T).reshape(len(found), -1)

    def next(self, jones: Complex, share: float, left_over: Complex, new: Complex) -> tuple[Complex, float]:
        """The next matrices (A, 2, 2), and how long the step is; never short enough where it was damped."""
        if not np.isfinite(new[self.active]).all():
            self.far = False
            return jones, np.nan
        new = np.where(self.active[:, None, None], new, 0.0)
        if self.far:
            change = _relative(new - jones, new)
            if change > NEAR:
                half = (jones + new) / 2
                return np.where(_dead(new), 0.0, unit_diagonal(half) if self.pattern == "phase" else half), change
            self.far = False
            self.lanes.common.weight[self.k] = np.inf
        return self._together(jones, share, left_over, new)

    def _together(self, jones: Complex, share: float, left_over: Complex, new: Complex) -> tuple[Complex, float]:
        common, k = self.lanes.common, self.k
        self.weight, y = common.weigh(k, share), common.moved(k, jones)
        cost = share + self.weight * float(y @ y) / common.total[k]
        if not np.isfinite(cost):
            return np.zeros_like(jones) if self.best is None else self.best[0], np.nan
        if cost <= self.best_cost + SLACK:
            self.best, self.best_cost = (jones.copy(), left_over, new, y), cost
            self.damping = self.damping / 10 if self.damping > 1e-3 else 0.0
        else:
            self.damping, self.factor = max(10 * self.damping, 0.01), None
        jones, left_over, new, y = self.best
        downhill(jones, left_over, common.tangents[k], self.weight * y, self.whole)
        if self.factor is None or self.renew or not self.factor.exact(self.weight):
            self.factor_at(jones, self.whole)
        step, gained, length, size = self._step(jones)
        if length > AGAIN * self.last and not self.fresh:
            self.factor_at(jones, self.whole)
            step, gained, length, size = self._step(jones)
        # within the noise what is left over bends as much as the fit does
        self.within = gained**2 * common.freedom[k] < share * common.unknowns[k]
        # nothing is left but rounding, and steps that only it makes: longer than the tolerance where data see little
        still = share <= EXACT_POWER and gained <= self.lanes.settings.tolerance and length > AGAIN * self.last
        self.stuck = self.stuck + 1 if still else 0
        self._weigh_up(length)
        length = 0.0 if self.stuck > STUCK else length
        turned(jones, step, min(1.0, 1.0 / max(size, 1e-300)), self.seen)
        odd = self.active & (np.abs(mat2.det(jones)) <= 1e-3 * power_of(jones))
        after = np.where((odd[:, None, None]), new, self.seen)
        if odd.any():
            length = max(length, _relative(np.where(odd[:, None, None], new - jones, 0.0), new))
        if not np.isfinite(after).all():
            return jones, np.nan
        if self.damping:  # a short step is no sign of an end
            length = max(length, 2 * self.lanes.settings.tolerance)
        return np.where(_dead(new), 0.0, after), length

    def _weigh_up(self, length: float) -> None:
        """Drops the factor after a step of this length where a new one costs less than the steps that it saves.

        Steps shrink by a rate that goes with the distance from where the factor was made.
        """
        if self.fresh:
            self.first = length
        elif 0 < length < self.last:
            rate = length / self.last
            self.pays = self.pays and rate < self.before / 2  # where noise bends more than steps do it does not
            new_rate = rate * max(length * rate / self.first, 1e-16)
            ends = np.log(max(self.lanes.settings.tolerance, 1e-16) / length)
            if self.pays and ends / np.log(rate) - ends / np.log(new_rate) > STEPS:
                self.renew, self.before = True, rate
        self.last, self.fresh = length, False

    def _without_rounding(self, gradient: Float) -> Float:
        """A gradient without what it has along common directions that are free, or weak and within rounding.

        The prior may not turn what is free: it would never come to an end. Taken away as the stations are seen: a weak
        station would be moved by the rounding of a strong one.
        """
        along = self.together @ gradient
        idle = self.free | (self.weak & (np.abs(along) < ROUNDING * self.lanes.common.total[self.k]))
        if not idle.any():
            return gradient
        if self.idle is None or (self.idle != idle).any():
            self.idle, self.apart = idle, np.linalg.pinv(self.metric[np.ix_(idle, idle)], hermitian=True)
        return np.asarray(gradient - ((self.apart @ along[idle]) @ self.together[idle]) * self.own)

    def factor_at(self, jones: Complex, whole: Complex | None) -> None:
        """Cholesky factors of the normal matrix with the prior, the gauge and the damping; `whole` is the gradient."""
        lanes, common, k = self.lanes, self.lanes.common, self.k
        v, m = (x[k] for x in lanes.products)
        second = whole if self.within and not self.damping else None
        normal = normal_matrix(v, m, lanes.a1, lanes.a2, jones, self.pattern, second)
        diagonal = np.einsum("ii->i", normal)
        prior = (common.moves(k, jones).reshape(-1, len(jones), 8) @ self.basis).reshape(-1, len(normal))
        self.own, self.idle = diagonal.copy(), None
        # what the model does not see stays where it is; through one direction the data see less than common matrices
        self.metric = (self.together * self.own) @ self.together.T
        free = self.together[self.free]
        size = np.maximum((free**2 * self.own).sum(axis=1), 1e-300)[:, None]
        weight = common.weight[k]
        rows = np.concatenate([np.sqrt(weight + FLOOR * common.total[k]) * prior, free * self.own / np.sqrt(size)])
        upper = blas.dsyrk(1.0, rows.T, beta=1.0, c=normal.T, overwrite_c=1)  # of the transpose: normal is row by row
        diagonal *= 1 + self.damping
        diagonal[:] = np.where(diagonal > 0, diagonal, 1.0)
        upper, bent = lapack.dpotrf(upper, lower=0, overwrite_a=1, clean=0)
        self.fresh, self.renew = True, False
        if bent and self.damping < 1e6:
            # on a slope that bends down, or singular: the fit alone, or held by what rounding leaves
            self.damping = self.damping if second is not None else max(10 * self.damping, 1e-8)
            self.within = False
            self.factor_at(jones, whole)
        else:
            self.factor = Factor(upper, prior, float(weight), jones.copy())

    def _step(self, jones: Complex) -> tuple[Complex, float, float, float]:
        """The step e (A, 2, 2), what the data could gain by it in their rms, its length, and the largest |e|.

        Its length is the largest relative change of a matrix, but for what the data hardly see of it; or what they
        gain, if more.
        """
        assert self.factor is not None
        common, k = self.lanes.common, self.k
        gradient = self._without_rounding((self.whole.view(float).reshape(-1, 8) @ self.basis).ravel())
        self.factor.now = self.weight
        found = self.factor.solve(gradient)
        gained = float(np.sqrt(max(found @ gradient, 0.0) / common.total[k]))
        step = (found.reshape(len(jones), -1) @ self.basis.T).view(complex).reshape(jones.shape)
        length, size = lengths(jones, step, self.active, common.generators, common.hidden[k])
        return step, gained, max(length, gained), size


def _dead(new: Complex) -> Bool:
    """Stations (A, 1, 1) without any signal: their answer is zero, and half the way would never get there."""
    return (new == 0).all(axis=(-2, -1))[:, None, None]


def _relative(change: Complex, of: Complex) -> float:
    """Largest change of a matrix (A, 2, 2) relative to itself, but not to less than 1e-12 of the largest."""
    moved, size = np.sqrt(power_of(change)), np.sqrt(power_of(of))
    floor = max(1e-12 * float(size.max(initial=0.0)), 1e-300)
    return float(np.where(size > floor, moved / np.maximum(size, 1e-300), 0.0).max(initial=0.0))
