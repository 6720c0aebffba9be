"""Damped Gauss-Newton steps for the matrices of all stations towards several clusters, for one stretch of data.

With E_ab = V_ab - sum_c J_a^c Z_ab^c, Z_ab^c = M_ab^c J_b^cH, a step d obeys, for every station a and all clusters,
sum_b (d_a Z_ab + (d_b Z_ba)^H) Z_ab^H = sum_b E_ab Z_ab^H. With the other stations held it falls into a system of 2C
unknowns a row for each station (Smirnov & Tasse 2015): that is the first few rounds, the damping, and the
preconditioner of the conjugate gradients that solve the whole.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np

from instrument.calibrate.fit import Left, strange
from instrument.calibrate.gauge import UNKNOWNS
from instrument.calibrate.graph import counted, tied
from instrument.errors import Outcome
from instrument.units import Bool, Complex, Float, Int

HELD = 4  # first rounds, in which each station is solved with the others held, and goes half the way
WAYS = (1.0, 0.3, 0.1, 0.03)  # of a step: a snapshot of five clusters (condition number 1e6) needs short ones at first
GRADIENTS = 300  # most conjugate gradients of one round
MEDIAN_CHI2_8 = 7.344  # of |r|^2 / sigma^2 of a visibility: four complex correlations
RIDGE = 1e-13  # of the diagonal: the answer moves by less, and nothing is divided by zero
COINCIDENT = 1e-10  # smallest eigenvalue, relative to the diagonal, of equations of a station that have an answer
ALIKE = 1e-4  # of the models over the whole array: with less, noise mixes the matrices of two clusters


@dataclass(frozen=True)
class Limits:
    """When to stop, the pattern of the matrices, and the degrees of freedom of Student's t (None: Gaussian)."""

    pattern: str
    tolerance: float
    iterations: int
    robust: float | None
    unexplained: float


@dataclass
class Block:
    """Data of one stretch, cut in P pieces of s samples within which no solution changes.

    data (P, s, B, 2, 2), models (C, P, s, B, 2, 2), weight (P, s, B); `column` (P, C) names the unknown, 0 ... K-1,
    that a cluster has in a piece. Each baseline is held twice, seen from either end.
    """

    data: Complex
    models: Complex
    weight: Float
    a1: Int
    a2: Int
    stations: int
    column: Int
    limits: Limits
    v: Complex = field(init=False)
    m: Complex = field(init=False)
    w: Float = field(init=False)
    columns: int = field(init=False)
    active: Bool = field(init=False)

    def __post_init__(self) -> None:
        pieces, samples = self.weight.shape[:2]
        clusters, stations = len(self.models), self.stations
        self.columns = int(self.column.max()) + 1
        good = self.weight > 0
        data = np.where(good[..., None, None], self.data, 0.0)
        models = np.where(good[None, ..., None, None], self.models, 0.0)
        self.v = np.zeros((pieces, stations, 2, stations, samples, 2), complex)
        self.m = np.zeros((pieces, stations, clusters, 2, stations, samples, 2), complex)
        self.w = np.zeros((pieces, stations, stations, samples))
        for here, there, turn in ((self.a1, self.a2, False), (self.a2, self.a1, True)):
            d, m = (np.conj(np.swapaxes(x, -1, -2)) if turn else x for x in (data, models))
            self.v[:, here, :, there] = d.transpose(2, 0, 3, 1, 4)
            self.m[:, here, :, :, there] = m.transpose(3, 1, 0, 4, 2, 5)
            self.w[:, here, there] = self.weight.transpose(0, 2, 1)
        self.active = self._counts(np.abs(self.m) ** 2) > 0
        # a station that gives nothing at all is dead: no matrix describes it
        self.active &= self._spread(np.einsum("pabs,paibsj->pa", self.w, np.abs(self.v) ** 2)) > 0

    def solve(self, jones: Complex) -> tuple[Complex, Outcome, int, Float, Float]:
        """Matrices (K, A, 2, 2), outcome, rounds, share of the rms left in each piece (P,), step of each round."""
        limits = self.limits
        empty = not self.active.any()
        if empty or 4 * int((self.w > 0).sum()) < UNKNOWNS[limits.pattern] * int(self.active.sum()):
            nothing = np.full_like(jones, np.nan), np.full(len(self.v), np.nan)
            return nothing[0], Outcome.REFUSED if empty else Outcome.SINGULAR, 0, nothing[1], np.zeros(0)
        live = self.active.T[:, None, :, None]
        x = np.where(live, jones.transpose(1, 2, 0, 3), 0.0)
        z, left = self._seen(x)
        history: list[float] = []
        damping = 0.0
        for turn in range(limits.iterations):
            weight = self._weight(left)
            equations = _Equations(self, x, z, weight)
            gradient = equations.sums(left)
            step = equations.held(gradient) / 2
            if turn >= HELD:
                together = equations.solved(gradient, damping, min(0.1, history[-1]))
                share = self._way(x, together, left, weight)
                if share:
                    step, damping = share * together, damping / 10 if damping > 1e-3 else 0.0
                else:
                    damping = max(10 * damping, 0.01)
            history.append(_relative(step, x))
            x = self._onto(x + step)
            z, left = self._seen(x)
            if turn >= HELD and not history[-1] > limits.tolerance:
                break
        # interference that the weights have put aside is no misfit
        rest = self._share(left, self._weight(left))
        if not np.isfinite(history[-1]) or self._singular(x) or self._loose():
            outcome = Outcome.SINGULAR
        elif history[-1] > limits.tolerance:
            outcome = Outcome.ITERATION_LIMIT
        elif not np.nanmax(rest) <= limits.unexplained or self._odd(left):
            outcome = Outcome.POOR_FIT
        else:
            outcome = Outcome.CONVERGED
        found = np.where(live, x, np.nan).transpose(2, 0, 1, 3)
        return found, outcome, len(history), rest, np.array(history)

    def _seen(self, x: Complex) -> tuple[Complex, Complex]:
        """Z (P, A, 2C, A s 2), and the data less sum_c J_a^c Z_ab^c (P, A, 2, A, s, 2), for matrices x (A, 2, K, 2)."""
        h = np.conj(x[:, :, self.column].transpose(2, 3, 0, 1, 4))[
            :, None, :, None, :, None
        ]  # (P, 1, C, 1, A, 1, j, k)
        z = self.m[..., 0, None] * h[..., 0] + self.m[..., 1, None] * h[..., 1]
        z = z.reshape(*z.shape[:2], 2 * z.shape[2], -1)
        return z, self.v - (self.rows(x) @ z).reshape(self.v.shape)

    def rows(self, x: Complex) -> Complex:
        """Matrices x (A, 2, K, 2) as they stand in each piece, (P, A, 2, 2C)."""
        here = x[:, :, self.column].transpose(2, 0, 1, 3, 4)
        return here.reshape(*here.shape[:3], -1)

    def _way(self, x: Complex, step: Complex, left: Complex, weight: Float) -> float:
        """How much of a step to go: the first share that leaves no more power than there is, or 0."""
        if _relative(step, x) <= self.limits.tolerance:
            return 1.0
        now = self._cost(left, weight)
        for share in WAYS:
            if self._cost(self._seen(self._onto(x + share * step))[1], weight) <= now:
                return share
        return 0.0

    def _cost(self, left: Complex, weight: Float) -> float:
        return float((weight * _power(left)).sum())

    def _onto(self, x: Complex) -> Complex:
        """The nearest matrices of the pattern that are not a step: phases of unit size."""
        if self.limits.pattern != "phase":
            return x
        size = np.abs(x)
        return np.where(size > 0, x / np.where(size > 0, size, 1), 0.0)

    def _weight(self, left: Complex) -> Float:
        return self.w if self.limits.robust is None else self.w * self._trust(_power(left), self.limits.robust)

    def _trust(self, power: Float, freedom: float) -> Float:
        """Student's weights (nu + 8) / (nu + |r|^2 / sigma^2), sigma from the median over all visibilities."""
        used = self.w > 0
        chi2 = self.w * power
        # the fit takes its share of the scatter
        unknown = UNKNOWNS[self.limits.pattern] * int(self.active.sum())
        taken = 1 - min(0.9, unknown / (4 * int(used.sum())))
        floor = 1e-24 * float(np.einsum("pabs,paibsj->", self.w, np.abs(self.v) ** 2)) / int(used.sum())
        variance = max(float(np.median(chi2[used])) / MEDIAN_CHI2_8 / taken, floor, 1e-300)
        return (freedom + 8) / (freedom + chi2 / variance)

    def _share(self, left: Complex, weight: Float) -> Float:
        one, whole = ((weight * _power(x)).sum(axis=(1, 2, 3)) for x in (left, self.v))
        with np.errstate(invalid="ignore", divide="ignore"):
            return np.sqrt(one / whole)

    def _odd(self, left: Complex) -> bool:
        """Whether some baselines, or most of what a station has, do not agree with the fit."""
        weight = self._weight(left)
        rest, data, fit = (
            (weight * _power(x)).sum(axis=(0, 3))[None, self.a1, self.a2] for x in (left, self.v, self.v - left)
        )
        samples = (self.w > 0).sum(axis=(0, 3))[None, self.a1, self.a2]
        seen, limits = Left(rest, data, fit, samples), self.limits
        sets = self.column.shape[1]
        if strange(seen, self.a1, self.a2, self.stations, limits.tolerance, limits.pattern, sets).any():
            return True
        if limits.robust is None:
            return bool(seen.few_fit(limits.unexplained).any())
        aside = ((weight < 0.1 * self.w) & (self.w > 0)).sum(axis=(0, 2, 3))
        return bool(np.any(aside > 0.5 * (self.w > 0).sum(axis=(0, 2, 3)), where=self.active.any(axis=0)))

    def suspects(self, jones: Complex) -> Bool:
        """Samples (P, s, B) that a solve with robust weights puts aside, if they are few; none otherwise."""
        limits = replace(self.limits, robust=2.0, tolerance=max(self.limits.tolerance, 1e-5))
        found = replace(self, limits=limits)
        x = found.solve(jones)[0].transpose(1, 2, 0, 3)
        left = found._seen(np.where(np.isfinite(x), x, 0.0))[1]
        aside = (found._weight(left) < 0.05 * self.w).transpose(0, 3, 1, 2)[..., self.a1, self.a2]
        return aside if aside.sum() <= max(1, 0.1 * (self.weight > 0).sum()) else np.zeros_like(aside)

    def _loose(self) -> bool:
        """Whether the baselines that count leave stations apart, or in two groups, for one of the unknowns."""
        power = np.einsum("psb,cpsbij->cpbij", self.weight, np.abs(self.models) ** 2)
        for k, active in enumerate(self.active):
            here = np.einsum("pc,cpbij->bij", self.column == k, power)[None]
            alive = (active[self.a1] & active[self.a2])[None, :, None, None]
            held = tied(counted(here * alive), self.a1, self.a2, self.stations, self.limits.pattern)[0]
            if np.any(active & ~held):
                return True
        return False

    def _singular(self, x: Complex) -> bool:
        """Whether clusters are alike: as models to the array (then their matrices mix), or corrupted to a station."""
        plain: Complex = np.eye(2)[None, :, None, :] * self.active.T[:, None, :, None] + 0j
        whole, each = (_Equations(self, y, self._seen(y)[0], self.w).normal for y in (plain, x))
        alike = np.linalg.eigvalsh(_scaled(whole.sum(axis=0))[0]).min() < ALIKE
        return bool(alike or np.linalg.eigvalsh(_scaled(each)[0]).min() < COINCIDENT)

    def _counts(self, power: Float) -> Float:
        """Weighted power of the models for each unknown, (K, A)."""
        return self._spread(np.einsum("pabs,pacibsj->pac", self.w, power))

    def _spread(self, values: Float) -> Float:
        """Sums (P, A) or (P, A, C) of pieces as sums of unknowns (K, A)."""
        if values.ndim == 2:
            values = np.repeat(values[..., None], self.column.shape[1], axis=2)
        out = np.zeros((self.columns, self.stations))
        for p, col in enumerate(self.column):
            out[col] += values[p].T
        return out


def _scaled(normal: Complex) -> tuple[Complex, Float]:
    """Matrices (..., n, n) scaled to a unit diagonal, and the roots of it; unknowns without equations stand alone."""
    diagonal = np.einsum("...ii->...i", normal).real
    empty = ~(diagonal > 0)
    root = np.sqrt(np.where(empty, 1.0, diagonal))
    scaled = normal / root[..., :, None] / root[..., None, :]
    return scaled + empty[..., None] * np.eye(normal.shape[-1]), root


class _Equations:
    """The equations of one round, at matrices x (A, 2, K, 2), with weights (P, A, A, s)."""

    def __init__(self, block: Block, x: Complex, z: Complex, weight: Float) -> None:
        self.block, self.x, self.z = block, x, z
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
        scaled, root = _scaled(self.normal)
        inverse = np.linalg.inv(scaled + RIDGE * np.eye(2 * columns))
        self.inverse = inverse / root[:, :, None] / root[:, None, :]

    def sums(self, values: Complex) -> Complex:
        """sum_b w Y_ab Z_ab^H (A, 2, K, 2) of values Y (P, A, 2, A, s, 2), within the pattern."""
        block = self.block
        pieces = values.reshape(*values.shape[:3], -1) @ self.weighted
        out = np.zeros((block.stations, 2, block.columns, 2), complex)
        for p, col in enumerate(block.column):
            out[:, :, col] += pieces[p].reshape(block.stations, 2, -1, 2)
        return self._within(out)

    def held(self, right: Complex) -> Complex:
        """The step of every station with the others held."""
        return self._within((right.reshape(*right.shape[:2], -1) @ self.inverse).reshape(right.shape))

    def both(self, step: Complex, damping: float) -> Complex:
        """What a step of all stations does to the sums."""
        change = (self.block.rows(step) @ self.z).reshape(self.block.v.shape)
        out = self.sums(change + np.conj(change.transpose(0, 3, 5, 1, 4, 2)))
        if damping:
            out = out + damping * self._within((step.reshape(*step.shape[:2], -1) @ self.normal).reshape(step.shape))
        return out

    def solved(self, right: Complex, damping: float, reduction: float) -> Complex:
        """The step of all stations at once: conjugate gradients, until the equations hold to `reduction`."""
        step, rest = np.zeros_like(right), right
        turned = self.held(rest)
        along, size = turned, _dot(rest, turned)
        goal = size * reduction**2
        for _ in range(GRADIENTS):
            if not size > goal:
                break
            seen = self.both(along, damping)
            curve = _dot(along, seen)
            if not curve > 0:
                break
            step, rest = step + size / curve * along, rest - size / curve * seen
            turned = self.held(rest)
            before, size = size, _dot(rest, turned)
            along = turned + size / before * along
        return step

    def _within(self, step: Complex) -> Complex:
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


def _dot(a: Complex, b: Complex) -> float:
    return float(np.vdot(a, b).real)


def _power(values: Complex) -> Float:
    """Power of visibilities (P, A, 2, A, s, 2) over the four correlations, (P, A, A, s)."""
    return np.asarray((values.real**2 + values.imag**2).sum(axis=(2, 5)))


def _relative(step: Complex, x: Complex) -> float:
    """Largest change of a matrix of x (A, 2, K, 2), relative to itself, but not to less than 1e-12 of its column."""
    moved, size = (np.sqrt((np.abs(a) ** 2).sum(axis=(1, 3))) for a in (step, x))
    return float((moved / np.maximum(size, np.maximum(1e-12 * size.max(axis=0), 1e-300))).max())
