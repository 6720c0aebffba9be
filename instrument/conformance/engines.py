"""The contract of engines: one claim per function, its name the sentence."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from functools import cache

import numpy as np

from instrument.check import definition
from instrument.conformance.bench import ROUNDING, demand, demand_repeatable, demand_same, longer, problems
from instrument.errors import RefusedError
from instrument.predict.base import EVERY, Predictor, Prepared, Problem, Work
from instrument.predict.direct import Direct
from instrument.predict.operator import ImageOperator
from instrument.units import Complex

TOLERANCES = (0.0, 1e-6, 1e-3)
DOT = 1e-12  # of the norms: what is left of Re <A x, y> - <x, A^H y>, however coarse A is


def it_serves_some_problem_and_refuses_others_in_a_sentence(engine: Predictor, some: dict[str, Problem]) -> str:
    """`refuses`: `None` for what it serves, else a sentence."""
    answers = [engine.refuses(problem) for problem in some.values()]
    demand(None in answers, "it refuses every problem")
    demand(all(a is None or (isinstance(a, str) and a.strip()) for a in answers), f"it refuses with {answers}")
    return f"serves {answers.count(None)} of {len(answers)}"


def it_agrees_with_direct(engine: Predictor, problem: Problem, due: tuple[Complex, Complex]) -> str:
    """The definition, relative to the total flux, for any order of baselines: to rounding and the bound it gave.

    `due` is what `due_of` gives. An engine may refuse a tolerance (`RefusedError`), though not all of 0, 1e-6 and 1e-3.
    """
    flux = float(problem.sky.total_jy(problem.at.freq_hz).max())
    errors: list[float] = []
    for p, wanted, where in zip((problem, turned(problem)), due, ("", " with baselines turned"), strict=True):
        for tolerance in TOLERANCES:
            if 0 < tolerance < TOLERANCES[-1] and errors:
                continue  # it serves a smaller one
            try:
                ready = engine.prepare(p, tolerance)
            except RefusedError:
                continue
            demand(0 <= ready.bound <= tolerance, f"bound {ready.bound} at tolerance {tolerance:g}")
            error = float(np.abs(ready.sums(EVERY, EVERY) - wanted).max() / flux)
            demand(error <= ROUNDING + ready.bound, f"off by {error:.1e} of the flux at tolerance {tolerance:g}{where}")
            errors.append(error)
    demand(errors, "it refuses every tolerance")
    itself = "; it is the definition, so by stations" if isinstance(engine, Direct) else ""
    return f"to {errors[0]:.0e} of the flux{itself}"


def turned(problem: Problem) -> Problem:
    """Every other baseline, its stations the other way round."""
    return problem.between(problem.antenna2[::2], problem.antenna1[::2])


@cache
def due_of(name: str, by_stations: bool) -> tuple[Complex, Complex]:
    """Visibilities of a problem of the bench, and of it turned, by `direct` or, for `direct` itself, by stations."""
    both = []
    for problem in (problems()[name], turned(problems()[name])):
        out = np.empty((*problem.shape, 2, 2), complex)
        if by_stations:
            for t, f in np.ndindex(*problem.shape[:2]):
                out[t, f] = definition(problem.block(slice(t, t + 1), slice(f, f + 1)))
        else:
            out = Direct().sums(problem)
        out.setflags(write=False)  # shared by all checks
        both.append(out)
    return both[0], both[1]


def prepared(engine: Predictor, problem: Problem) -> Prepared:
    """An engine ready for a problem, at the least tolerance that it takes."""
    for tolerance in TOLERANCES:
        try:
            return engine.prepare(problem, tolerance)
        except RefusedError:
            continue
    raise RefusedError("it refuses every tolerance")


def its_adjoint_is_that_of_its_sums(engine: Predictor, problem: Problem) -> str:
    """Re sum conj(y) A x = sum x A^H y, to 1e-12 of |A x| |y|, for images that are not those of the sky.

    y is A x and as much noise: a random y alone is nearly orthogonal to A x and would tell nothing.
    """
    ready = prepared(engine, problem)
    if not isinstance(ready, ImageOperator):
        return "it has none"
    rng = np.random.default_rng(0)
    x = rng.normal(size=(problem.shape[1], 4, *ready.sky.grid.pixels))
    seen = ready.forward(x, EVERY, EVERY)
    noise = rng.normal(size=(*seen.shape, 2)).view(complex)[..., 0]
    y = seen + np.linalg.norm(seen) / np.linalg.norm(noise) * noise
    back = ready.adjoint(y, EVERY, EVERY)
    demand(back.shape == x.shape and np.isrealobj(back), f"{back.dtype} of shape {back.shape}, due real {x.shape}")
    off = abs(float(np.vdot(y, seen).real) - float(np.vdot(x, back)))
    scale = float(np.linalg.norm(seen) * np.linalg.norm(y))
    demand(off <= DOT * scale, f"Re <A x, y> and <x, A^H y> are {off / scale:.1e} of |A x| |y| apart")
    nt, nf = ready.atom
    parts = np.zeros_like(back)
    for t in range(0, problem.shape[0], nt):
        for f in range(0, problem.shape[1], nf):
            here = slice(t, t + nt), slice(f, f + nf)
            parts[here[1]] += ready.adjoint(y[here], *here)
    demand_same(parts, back, "adjoints of its atoms, added, and that of the whole")
    return f"{off / scale:.0e} apart"


def a_block_of_whole_atoms_equals_the_slice_of_the_whole(engine: Predictor, problem: Problem) -> str:
    """A run may be cut anywhere between atoms: at least two of them along each axis, and a rest, are looked at."""
    nt, nf = prepared(engine, problem).atom
    ready = prepared(engine, longer(problem, 2 * nt + 1, 2 * nf + 1))
    (nt, nf), full = ready.atom, ready.problem.shape
    whole = ready.sums(EVERY, EVERY)
    demand(whole.shape == (*full, 2, 2), f"shape {whole.shape}, due {(*full, 2, 2)}")
    for t in range(0, full[0], nt):
        for f in range(0, full[1], nf):
            here = slice(t, min(t + nt, full[0])), slice(f, min(f + nf, full[1]))
            demand_same(ready.sums(*here), whole[here], f"the block of times {here[0]} and channels {here[1]}")
    return f"atoms of {nt} x {nf}"


def some_pairs_of_antennas_have_the_sums_they_have_among_all(engine: Predictor, problem: Problem) -> str:
    """`pairs`: any baselines of the problem, in any order."""
    ready = prepared(engine, problem)
    some = np.arange(len(problem.antenna1))[::-2]
    found = ready.sums(EVERY, EVERY, (problem.antenna1[some], problem.antenna2[some]))
    return demand_same(found, ready.sums(EVERY, EVERY)[:, :, some], "some baselines alone and among all")


def its_work_is_positive_and_grows_with_the_problem(engine: Predictor, problem: Problem) -> str:
    """Operations, bytes and seconds: finite, above 0 (what is shared may be 0), no less for the whole than a block."""
    ready = prepared(engine, problem)
    kinds = [(engine.work(problem.block(slice(0, 1), slice(0, 1))), engine.work(problem))]
    kinds.append((ready.work(*(slice(0, n) for n in ready.atom)), ready.work()))
    for one, whole in kinds:
        for name, small, large in zip(Work._fields, one, whole, strict=True):
            text = f"{name}: {small:g} for one block, {large:g} for {problem.shape}"
            demand((small > 0 or (name == "shared_bytes" and small == 0)) and small <= large < np.inf, text)
    return f"{whole.flops:.2g} Flop"


def its_visibilities_carry_their_coordinates(engine: Predictor, problem: Problem) -> str:
    """What a worker makes has the antennas, times, channels and interval of the problem."""
    ready = prepared(engine, problem)
    found = ready.task(EVERY, EVERY)()
    demand_same(found.data, ready.sums(EVERY, EVERY), "what a worker makes and its sums")
    given = (problem.antenna1, problem.antenna2, problem.at.slots_s, problem.at.freq_hz)
    kept = (found.antenna1, found.antenna2, found.at.slots_s, found.freq_hz)
    demand(all(np.array_equal(x, y) for x, y in zip(given, kept, strict=True)), "its coordinates are others")
    same = problem.visibilities(found.data)
    demand(np.array_equal(found.interval_s, same.interval_s), "its interval differs")
    demand(np.all(np.asarray(found.width_hz) == np.asarray(same.width_hz)), "its width differs")
    return ""


def a_call_of_its_sums_has_no_side_effects(engine: Predictor, problem: Problem) -> str:
    """The same call twice gives the same, from two threads at once too, and nothing that was given has changed."""
    ready = prepared(engine, problem)
    demand_repeatable(lambda: ready.sums(EVERY, EVERY), engine, problem)
    alone, fresh = ready.sums(EVERY, EVERY), prepared(engine, problem)
    with ThreadPoolExecutor(2) as pool:
        both = [pool.submit(fresh.sums, EVERY, EVERY) for _ in range(2)]
        demand_same(both[0].result(), alone, "sums of two threads at once")
        return demand_same(both[1].result(), alone, "sums of two threads at once")


CLAIMS = (
    a_block_of_whole_atoms_equals_the_slice_of_the_whole,
    some_pairs_of_antennas_have_the_sums_they_have_among_all,
    its_work_is_positive_and_grows_with_the_problem,
    its_visibilities_carry_their_coordinates,
    a_call_of_its_sums_has_no_side_effects,
)
