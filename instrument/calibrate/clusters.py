"""Several clusters of directions solved at once for one stretch of data, and how that ended."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np

from instrument.calibrate.cluster_data import Block, power_of
from instrument.calibrate.cluster_equations import Equations, unit_diagonal
from instrument.calibrate.cluster_errors import Errors, errors_of
from instrument.calibrate.cluster_rounds import Rounds
from instrument.calibrate.fit import Left, strange
from instrument.calibrate.gauge import BLIND
from instrument.calibrate.graph import counted, tied
from instrument.calibrate.reasons import ALIKE, ENOUGH
from instrument.errors import Outcome
from instrument.units import Bool, Complex, Float

COINCIDENT = 1e-10  # smallest eigenvalue, relative to the diagonal, of equations of a station that have an answer


@dataclass
class Found:
    """Matrices (K, A, 2, 2), the outcome, share of the rms left in each piece (P,), the step of each round, errors."""

    jones: Complex
    outcome: Outcome
    share: Float
    history: Float = field(default_factory=lambda: np.zeros(0))
    errors: Errors | None = None

    def times(self, factor: float) -> Found:
        """The same with matrices that are larger by a factor."""
        errors = self.errors and replace(self.errors, gains=self.errors.gains * factor)
        return replace(self, jones=self.jones * factor, errors=errors)


def solved(block: Block, start: Complex) -> Found:
    """The matrices of a block, from a start (K, A, 2, 2)."""
    limits = block.limits
    empty = not block.active.any()
    if empty or 8 * block.used < block.unknowns or _loose(block) or _alike(block):
        outcome = Outcome.REFUSED if empty else Outcome.SINGULAR
        return Found(np.full_like(start, np.nan), outcome, np.full(len(block.v), np.nan))
    live = block.active.T[:, None, :, None]
    rounds = Rounds(block, _level(block, np.where(live, start.transpose(1, 2, 0, 3), 0.0)))
    rounds.run()
    left, history = rounds.left, np.array(rounds.history)
    # interference that the weights have put aside is no misfit
    rest = block.share(left, block.weights(left))
    if not np.isfinite(history[-1]) or _coincident(block, rounds.x):
        outcome = Outcome.SINGULAR
    elif not rounds.still and (np.nanmax(rest) <= limits.unexplained or len(history) < ENOUGH):
        outcome = Outcome.ITERATION_LIMIT
    elif not np.nanmax(rest) <= limits.unexplained or _odd(block, left):
        outcome = Outcome.POOR_FIT
    else:
        outcome = Outcome.CONVERGED
    errors = errors_of(block, rounds.x, left, rounds.prior) if outcome is Outcome.CONVERGED else None
    return Found(np.where(live, rounds.x, np.nan).transpose(2, 0, 1, 3), outcome, rest, history, errors)


def _level(block: Block, x: Complex) -> Complex:
    """A start that is far from the data by a factor, brought to their level: rounds only halve what is too large."""
    if block.limits.pattern == "phase":
        return x
    seen, there = block.cost(block.v - block.seen(x)[1], block.w), block.cost(block.v, block.w)
    factor = (there / seen) ** 0.25 if seen > 0 else 1.0
    return x * factor if abs(np.log2(factor)) > 2 else x


def suspects(block: Block, start: Complex) -> Bool:
    """Samples (P, s, B) that a solve with robust weights puts aside, if they are few; none otherwise."""
    limits = replace(block.limits, robust=2.0, tolerance=max(block.limits.tolerance, 1e-5))
    robust = replace(block, limits=limits)
    x = solved(robust, start).jones.transpose(1, 2, 0, 3)
    left = robust.seen(np.where(np.isfinite(x), x, 0.0))[1]
    aside = (robust.weights(left) < 0.05 * block.w).transpose(0, 3, 1, 2)[..., block.a1, block.a2]
    return aside if aside.sum() <= max(1, 0.1 * (block.weight > 0).sum()) else np.zeros_like(aside)


def _odd(block: Block, left: Complex) -> bool:
    """Whether some baselines, or most of what a station has, do not agree with the fit."""
    weight, limits, used = block.weights(left), block.limits, block.w > 0
    ends = (None, block.a1, block.a2)
    if limits.robust is not None:
        put_aside = used & (weight < 0.05 * block.w)
        if put_aside.sum() <= 0.1 * used.sum():  # few: they are no misfit, though they were all that a baseline has
            weight, used = np.where(put_aside, 0.0, weight), used & ~put_aside
    rest, data, fit = ((weight * power_of(x)).sum(axis=(0, 3))[ends] for x in (left, block.v, block.v - left))
    seen = Left(rest, data, fit, used.sum(axis=(0, 3))[ends])
    sets = block.column.shape[1]
    if strange(seen, block.a1, block.a2, block.stations, limits.tolerance, limits.pattern, sets).any():
        return True
    if limits.robust is None:
        return bool(seen.few_fit(limits.unexplained).any())
    aside = ((weight < 0.1 * block.w) & (block.w > 0)).sum(axis=(0, 2, 3))
    return bool(np.any(aside > 0.5 * (block.w > 0).sum(axis=(0, 2, 3)), where=block.active.any(axis=0)))


def _loose(block: Block) -> bool:
    """Whether the baselines that count leave stations apart, or in two groups, for one of the unknowns."""
    a1, a2 = block.a1, block.a2
    power = np.einsum("psb,cpsbij->cpbij", block.weight, np.abs(block.models) ** 2)
    for k, active in enumerate(block.active):
        here = np.einsum("pc,cpbij->bij", block.column == k, power)[None]
        alive = (active[a1] & active[a2])[None, :, None, None]
        held = tied(counted(here * alive), a1, a2, block.stations, block.limits.pattern)[0]
        if np.any(active & ~held):
            return True
    return False


def _alike(block: Block) -> bool:
    """Whether the models of clusters are alike to the whole array, or one shows a single polarization.

    Noise then mixes their matrices; of a polarization that is not shown nothing is known.
    """
    plain: Complex = np.eye(2)[None, :, None, :] * block.active.T[:, None, :, None] + 0j
    whole = Equations(block, plain, block.seen(plain)[0], block.w).normal.sum(axis=0)
    own = whole.reshape(block.columns, 2, block.columns, 2)[range(block.columns), :, range(block.columns)]
    values = np.linalg.eigvalsh(own)
    dark = np.any(values[:, 0] < BLIND * values[:, 1]) and block.limits.pattern == "full"
    return bool(dark or np.linalg.eigvalsh(unit_diagonal(whole)[0]).min() < ALIKE)


def _coincident(block: Block, x: Complex) -> bool:
    """Whether clusters, corrupted, are alike to a station."""
    each = Equations(block, x, block.seen(x)[0], block.w).normal
    return bool(np.linalg.eigvalsh(unit_diagonal(each)[0]).min() < COINCIDENT)
