"""The contract of engines: one claim per function, its name the sentence."""

from __future__ import annotations

import numpy as np

from instrument.check import definition
from instrument.conformance.bench import ROUNDING, demand, demand_repeatable, demand_same
from instrument.predict.base import EVERY, Predictor, Problem
from instrument.predict.direct import Direct
from instrument.units import Complex


def it_serves_some_problem_and_refuses_others_in_a_sentence(engine: Predictor, some: dict[str, Problem]) -> str:
    """`refuses`: `None` for what it serves, else a sentence."""
    answers = [engine.refuses(problem) for problem in some.values()]
    demand(None in answers, "it refuses every problem")
    demand(all(a is None or (isinstance(a, str) and a.strip()) for a in answers), f"it refuses with {answers}")
    return f"serves {answers.count(None)} of {len(answers)}"


def it_agrees_with_direct(engine: Predictor, problem: Problem) -> str:
    """The definition, relative to the total flux, for any order of baselines: to rounding, or to the bound it gave.

    `direct` is not held to itself but to the same terms summed by stations.
    """
    back = problem.between(problem.antenna2[::2], problem.antenna1[::2])
    flux = np.abs(problem.sky.brightness(problem.at)).sum(axis=2).max()
    exact = 0.0
    for tolerance in (0.0, 1e-3):
        for turned, p in enumerate((problem, back)):
            ready = engine.prepare(p, tolerance)
            demand(0 <= ready.bound <= tolerance, f"bound {ready.bound} at tolerance {tolerance:g}")
            error = float(np.abs(ready.sums(EVERY, EVERY) - _due(engine, p)).max() / flux)
            where = " with baselines turned" if turned else ""
            demand(error <= ROUNDING + ready.bound, f"off by {error:.1e} of the flux at tolerance {tolerance:g}{where}")
            exact = max(exact, error) if not tolerance else exact
    itself = "; it is the definition, so by stations" if isinstance(engine, Direct) else ""
    return f"to {exact:.0e} of the flux{itself}"


def _due(engine: Predictor, problem: Problem) -> Complex:
    if not isinstance(engine, Direct):
        return Direct().sums(problem)
    out = np.empty((*problem.shape, 2, 2), complex)
    for t, f in np.ndindex(*problem.shape[:2]):
        out[t, f] = definition(problem.block(slice(t, t + 1), slice(f, f + 1)))
    return out


def a_block_of_its_sums_equals_the_slice_of_the_whole(engine: Predictor, problem: Problem) -> str:
    """A run may be cut anywhere."""
    whole = engine.sums(problem)
    demand(whole.shape == (*problem.shape, 2, 2), f"shape {whole.shape}, due {(*problem.shape, 2, 2)}")
    block = engine.sums(problem.block(slice(1, 3), slice(2, 3)))
    return demand_same(block, whole[1:3, 2:3], "a block of times and channels")


def its_work_is_positive_and_grows_with_the_problem(engine: Predictor, problem: Problem) -> str:
    """Operations, bytes and seconds: finite, above 0, and not less for the whole than for a block."""
    one, whole = engine.work(problem.block(slice(0, 1), slice(0, 1))), engine.work(problem)
    for name, small, large in zip(one._fields, one, whole, strict=True):
        least = small >= 0 if name == "shared_bytes" else small > 0  # what keeps nothing has 0
        text = f"{name}: {small:g} for one time and channel, {large:g} for {problem.shape}"
        demand(least and small <= large < np.inf, text)
    return f"{whole.flops:.2g} Flop"


def its_visibilities_carry_their_coordinates(engine: Predictor, problem: Problem) -> str:
    """`predict` gives `sums` with antennas, times, channels and interval of the problem."""
    found = engine.predict(problem)
    demand_same(found.data, engine.sums(problem), "predict and sums")
    given = (problem.antenna1, problem.antenna2, problem.at.slots_s, problem.at.freq_hz)
    kept = (found.antenna1, found.antenna2, found.at.slots_s, found.freq_hz)
    demand(all(np.array_equal(x, y) for x, y in zip(given, kept, strict=True)), "its coordinates are others")
    demand(found.interval_s == problem.interval_s and found.width_hz == problem.width_hz, "interval or width differ")
    return ""


def a_call_of_its_sums_has_no_side_effects(engine: Predictor, problem: Problem) -> str:
    """The same call twice gives the same, and nothing that was given has changed."""
    return demand_repeatable(lambda: engine.sums(problem), engine, problem)


CLAIMS = (
    a_block_of_its_sums_equals_the_slice_of_the_whole,
    its_work_is_positive_and_grows_with_the_problem,
    its_visibilities_carry_their_coordinates,
    a_call_of_its_sums_has_no_side_effects,
)
