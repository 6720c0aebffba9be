"""Rounds of damped Gauss-Newton steps for the matrices of all stations towards several clusters.

What the data hardly see is common to all stations (`cluster_common`): steps along it are exponentials, a prior that
vanishes with the noise holds it near its start, and the preconditioner solves for it apart.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from instrument.calibrate.cluster_common import Common
from instrument.calibrate.cluster_data import Block
from instrument.calibrate.cluster_equations import Equations, conjugate_gradients, dot
from instrument.calibrate.gauge import BLIND, common_form, second_moment
from instrument.patience import Patience
from instrument.units import Complex, Float

HELD = 4  # first rounds, in which each station is solved with the others held, and goes half the way
WAYS = (1.0, 0.3, 0.1, 0.03)  # of a step: a snapshot of five clusters (condition number 1e6) needs short ones at first
GRADIENTS = 300  # most conjugate gradients of one round
TAU = 0.3  # a common direction that noise moves by more than this, relative, is held near the start
NEAR = 0.3  # standard errors: a shorter step is one near the answer
SLOW = 0.3  # a step that is longer than this part of the last: Gauss and Newton have done what they can
FAR = 0.3  # relative step beyond which the start is not yet one that anything is to be held near
LEAST = 0.01  # damping, relative to the equations of each station, after a step that made things worse
MILD, MOST = 1e-4, 1.0  # damping against negative curvature
PLAIN = 1e-3  # of the power of a model that a common direction changes: more is seen as any other
SILENT = 5e-16  # sums, by what the steps of stations held would gain of the rms of the data, that are rounding
ROUNDING = 1e-14  # of the rms of the data, and of the cost: less is no rise


@dataclass
class Rounds:
    """The state of a solve: matrices x (A, 2, K, 2), and what they leave of the data.

    `still`: the last step was whole, undamped and below the tolerance, and so is what the data could still gain,
    sqrt(g^T H^-1 g) of the rms of the data; or steps do not get shorter, and all sums are rounding. `prior` is the
    weight s^2 / tau^2 of the common coordinates.
    """

    block: Block
    x: Complex
    history: list[float] = field(default_factory=list)
    damping: float = 0.0
    prior: float = np.inf
    shift: float = 0.0  # more of it, where the second-order term makes curvatures negative
    newton: bool = False  # whether the second-order term is used
    sigmas: float = np.inf  # length of the last step in standard errors, rms over the unknowns
    still: bool = False

    def __post_init__(self) -> None:
        self.z, self.left = self.block.seen(self.x)
        self.power = self.block.cost(self.block.v, self.block.w)
        self.free = free_directions(self.block)

    def run(self) -> None:
        """Rounds until nothing moves, there have been enough, or many have led no nearer."""
        patience, lost = Patience(), False
        while not (self.still or lost) and len(self.history) < self.block.limits.iterations:
            weight = self.block.weights(self.left)
            equations = Equations(self.block, self.x, self.z, weight)
            gradient = equations.sums(self.left)
            if len(self.history) < HELD:
                self._go(self.block.onto(self.x + equations.held(gradient) / 2))
            else:
                self._together(equations, gradient)
            lost = bool(patience.lost(self.history[-1])[0])

    def _together(self, equations: Equations, gradient: Complex) -> None:
        """A round for all stations at once."""
        block, tolerance = self.block, self.block.limits.tolerance
        common = Common(self.x, block.limits.pattern)
        if len(self.history) == HELD or self.history[-1] > FAR:
            self.start, self.near = self.x, common
        variance = block.variance(self.left, equations.weight)
        self.prior = min(self.prior, variance / TAU**2)
        system = System(equations, common, self.near, self.free, self.prior, self.damping, self.shift)
        right = gradient - self.prior * equations.within(self.near.spread(self.near.coordinates(self.x - self.start)))
        slow = len(self.history) > HELD + 1 and self.history[-1] > SLOW * self.history[-2]
        held = equations.held(right)
        if slow and dot(held, right) <= SILENT**2 * self.power:
            self._go(block.onto(self.x + held / 2))
            self.still = True
            return
        self.newton = (slow or self.newton) and self.sigmas < NEAR
        curvature = equations.curvature(self.left) if self.newton else None
        step = system.solved(right, curvature, min(0.1, self.history[-1]))
        gain = max(dot(step, right), 0.0)
        self.sigmas = np.sqrt(gain / max(variance, 1e-300) / block.unknowns)
        share, new = self._way(common, step, equations.weight)
        whole = share == 1 and system.damping == 0
        self.shift = system.shift / 10 if system.shift > MILD else 0.0
        if share:
            self.damping = self.damping / 10 if self.damping > 0.1 * LEAST else 0.0
        else:
            self.damping = max(10 * self.damping, LEAST)
            new = block.onto(self.x + equations.held(gradient) / 2)
        self._go(new)
        self.still = whole and self.history[-1] <= tolerance and np.sqrt(gain / self.power) <= tolerance

    def _way(self, common: Common, step: Complex, weight: Float) -> tuple[float, Complex]:
        """How much of a step to go, the first share that leaves no more than there is, or 0; and where it leads."""
        now, whole = self._cost(self.x, self.left, weight), np.sqrt(self.power)
        most = now * (1 + ROUNDING) + ROUNDING * whole * (0.1 * np.sqrt(now) + ROUNDING * whole)
        for share in WAYS:
            with np.errstate(over="ignore", invalid="ignore"):
                new = self.block.onto(common.moved(self.x, share * step))
                if relative(new - self.x, self.x) <= self.block.limits.tolerance:
                    return share, new
                if self._cost(new, self.block.seen(new)[1], weight) <= most:
                    return share, new
        return 0.0, self.x

    def _cost(self, x: Complex, left: Complex, weight: Float) -> float:
        y = self.near.coordinates(x - self.start)
        return self.block.cost(left, weight) + self.prior * float((y**2).sum())

    def _go(self, new: Complex) -> None:
        self.history.append(relative(new - self.x, self.x))
        self.x = new
        self.z, self.left = self.block.seen(new)


class System:
    """The equations of one round with the prior, (H + damping D + prior W^T W) d = right, W the common coordinates."""

    def __init__(
        self, equations: Equations, common: Common, near: Common, free: Float | None,
        prior: float, damping: float, shift: float,
    ) -> None:  # fmt: skip
        self.equations, self.common, self.near, self.free = equations, common, near, free
        self.prior, self.least, self.shift = prior, damping, shift

    @property
    def damping(self) -> float:
        """Of the round, and what negative curvature asked for."""
        return self.least + self.shift

    def times(self, step: Complex, curvature: Complex | None) -> Complex:
        """The left side; with Newton's second-order term where there is a `curvature`."""
        prior = self.equations.within(self.near.spread(self.near.coordinates(step)))
        out = self.equations.both(step) + self.prior * prior
        if self.damping:
            out = out + self.damping * self.equations.own(step)
        return out if curvature is None else out - self.equations.bent(step, curvature)

    def solved(self, right: Complex, curvature: Complex | None, reduction: float) -> Complex:
        """The step, by conjugate gradients; negative curvature asks for more damping.

        What no data and no prior see is left as it is: rounding would fill it.
        """
        coarse, dark = self._coarse(curvature) if self.free is None else (None, self._basis(self.free))

        def lit(values: Complex) -> Complex:
            flat = np.ascontiguousarray(values).reshape(-1).view(float)
            return (flat - dark @ (flat @ dark)).view(complex).reshape(values.shape) if dark.size else values

        def near(rest: Complex) -> Complex:
            if coarse is None:
                return lit(self.equations.held(rest))
            y = coarse @ self.common.against(rest).ravel()
            return lit(self.equations.held(rest) + self.common.along(y.reshape(len(self.common.tangents), -1)))

        def steps(second: Complex | None) -> tuple[Complex, bool]:
            return conjugate_gradients(lambda d: lit(self.times(d, second)), near, lit(right), reduction, GRADIENTS)

        while curvature is not None and self.shift <= MOST:
            step, good = steps(curvature)
            if good:
                return step
            self.shift = max(10 * self.shift, MILD)
        self.shift = 0.0
        return steps(None)[0]

    def _coarse(self, curvature: Complex | None) -> tuple[Float, Float]:
        """The inverse (K n, K n) of the equations of common directions alone, and a basis (8 A K, q) of the unseen."""
        columns, many = self.common.tangents.shape[:2]
        own = self.common.own_form(self.equations)
        form = self.common.seen_form(self.equations) + self.damping * own
        form += self.prior * self.near.prior_form(self.common)
        if curvature is not None:
            form -= self.common.bent_form(curvature)
        none = ~(np.diag(own) > 0)  # directions of a cluster without flux: nothing moves along them
        form[none, none] = 1.0
        root = np.sqrt(np.where(none, 1.0, np.diag(own)))
        values, vectors = np.linalg.eigh((form + form.T) / 2 / root[:, None] / root)
        seen = np.abs(values) > BLIND
        turned = vectors / root[:, None]
        unseen = turned[:, ~seen].T.reshape(-1, columns, many)
        return np.asarray((turned[:, seen] / np.abs(values[seen])) @ turned[:, seen].T), self._basis(unseen)

    def _basis(self, unseen: Float) -> Float:
        """Orthonormal steps (8 A K, q) along common directions (q, K, n)."""
        if not len(unseen):
            return np.zeros((0, 0))
        steps = [np.ascontiguousarray(self.common.along(y)).reshape(-1).view(float) for y in unseen]
        return np.asarray(np.linalg.qr(np.array(steps).T)[0])


def free_directions(block: Block) -> Float | None:
    """Common directions (q, K, n) that the models leave free; None where they hardly show others.

    Without those nothing is gained by solving for common directions apart, and that costs as much as all else.
    """
    moments = np.zeros((block.columns, 4, 4), complex)
    for p, col in enumerate(block.column):
        for c, k in enumerate(col):
            moments[k] += second_moment(block.models[c, p].reshape(-1, 2, 2), block.weight[p].reshape(-1))
    power = np.einsum("kii->k", moments).real
    flux = power > 0
    values, vectors = np.linalg.eigh(common_form(moments, block.limits.pattern))
    share = values / np.where(flux, power, 1.0)[:, None]
    if np.any((share > BLIND) & (share < PLAIN)):
        return None
    out = [(k, vectors[k][:, n]) for k, n in zip(*np.nonzero((share <= BLIND) & flux[:, None]), strict=True)]
    free = np.zeros((len(out), block.columns, vectors.shape[-1]))
    for row, (k, y) in zip(free, out, strict=True):
        row[k] = y
    return free


def relative(step: Complex, x: Complex) -> float:
    """Largest change of a matrix of x (A, 2, K, 2), relative to itself, but not to less than 1e-12 of its column."""
    moved, size = (np.sqrt((np.abs(a) ** 2).sum(axis=(1, 3))) for a in (step, x))
    return float((moved / np.maximum(size, np.maximum(1e-12 * size.max(axis=0), 1e-300))).max())
