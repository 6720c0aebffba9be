"""What the matrix engine may do within a tolerance: terms at time nodes, products in 32 bit."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from instrument.predict.base import EVERY, Blockwise, Prepared, Problem, Work
from instrument.predict.time_nodes import EXACT, MOST, PANELS, Panels
from instrument.sky.points import points_of
from instrument.sky.rounding import flux
from instrument.units import Complex, Float

LARGEST_ATOM = 64e6  # bytes of a panel, which is the least a block can be
SINGLE = 2.0**-24  # rounding of 32 bit
WORTH = 0.05  # of the time: what gains less is not worth an error


class Way(NamedTuple):
    """How sums are made: array factors at the nodes of `panels`, products in 32 bit or not."""

    panels: Panels = EXACT
    single: bool = False


WHOLE = Way()


@dataclass(frozen=True)
class Within(Blockwise):
    """Matrix by a way that is not exact; blocks are whole panels."""

    way: Way = WHOLE

    def summed(self, given: Problem) -> Complex:
        """Visibilities in Jy, complex (T, F, B, 2, 2), of whole panels."""
        engine: Any = self.engine  # a Matrix, which knows its ways
        return np.asarray(engine.sums(given, self.way))

    def work(self, times: slice = EVERY, channels: slice = EVERY) -> Work:
        """Cost of some times and channels, as one block."""
        engine: Any = self.engine
        found: Work = engine.work(self.block(times, channels), self.way)
        return found


def quickest(engine: Any, problem: Problem, tolerance: float) -> Prepared:
    """Matrix ready for a problem, by the way that costs least among those whose bound is within a tolerance."""
    exact = Blockwise(engine, problem)
    peak = problem.chain.peak(problem.at)
    if not tolerance > 0 or not np.isfinite(peak):
        return exact
    moving = problem.chain.moving(problem.at, MOST)
    parts, stations = sum(term.phasors() for term, _ in moving), problem.at.shape[2]
    most, slots = exact.work().seconds, float(np.prod(problem.at.shape[:2])) * problem.at.shape[3]
    product = most - engine.work(problem, Way(single=True)).seconds
    costs = {
        Way(panels, single): most
        + slots * (panels.seconds(parts, stations) - EXACT.seconds(parts, stations))
        - single * product
        for panels in (EXACT, *(PANELS if moving else ()))
        for single in (False, True)
        if panels.size <= problem.shape[0]
    }
    jansky = flux(problem.sky, problem.at)[0]
    share = peak * peak * jansky / jansky.sum(axis=-1).max()  # (F, S)
    for way in sorted((way for way, cost in costs.items() if cost < (1 - WORTH) * most), key=costs.__getitem__):
        ready = Within(engine, problem, atom=(way.panels.size, 1), way=way)
        if ready.work(slice(0, way.panels.size), slice(0, 1)).slot_bytes > LARGEST_ATOM:
            continue
        bound = _single(problem, share) if way.single else 0.0
        if bound <= tolerance and way.panels != EXACT:
            apart = way.panels.error(problem.at, [found for _, found in moving])
            bound += float((share * (2 * apart + apart**2)).sum(axis=-1).max())
        if bound <= tolerance:
            names = " and ".join(dict.fromkeys(term.called for term, _ in moving))
            return Within(engine, problem, bound, (way.panels.size, 1), _said(way, names), way)
    return exact


def _single(problem: Problem, share: Float) -> float:
    """Bound on what 32 bit does to products of S points: factors (2 + 1), their product (sqrt 5), 2 S terms added.

    Infinite where the numbers of the stations may be too large or too small for it; brightness and matrices are scaled.
    """
    listed = points_of(problem.sky)
    assert listed is not None  # or the engine would have refused
    count = int((~listed.gaussian).sum())
    if not 1e-6 < float(np.prod([t.peak(problem.at) for t in problem.chain.scalar_terms()])) < 1e6:
        return float("inf")
    return SINGLE * (6 + 2 * np.sqrt(2) * count) * float(share.sum(axis=-1).max())


def _said(way: Way, names: str) -> tuple[str, str]:
    sampled = f"{names} at {way.panels.nodes} of {way.panels.size} times" if way.panels != EXACT else ""
    return "exact sums", ", ".join(filter(None, (sampled, "32-bit products" if way.single else "")))
