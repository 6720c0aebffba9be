"""Planner: works out the plan of a scene: what its sky, chain and baselines need, by which engine, in which blocks."""

from __future__ import annotations

import os
from functools import partial
from typing import Any, NamedTuple

import numpy as np

from instrument.errors import InputError, RefusedError, warn
from instrument.memory import afford, usable
from instrument.model import Instrument, warn_outside_band
from instrument.not_modelled import not_modelled
from instrument.numbers import COUNT, TOLERANCE, UV_RANGE, brief
from instrument.observe.layout import Layout
from instrument.observe.observation import Observation
from instrument.observe.sampling import Sampling
from instrument.omissions import Budget, simplify_chain, simplify_sky, w_term, within
from instrument.plan import Item, Plan
from instrument.predict.base import Prepared, Problem, Work
from instrument.predict.choice import cheapest
from instrument.predict.rounding import rounding, total_flux, unknown_peaks
from instrument.sky.base import Sky
from instrument.units import si_prefix, to_si

BLOCK_BYTES = 64e6


def make_plan(
    name: str,
    given: tuple[Instrument, Sky, Observation],
    tolerance: float = 0.0,
    engine: str | None = None,
    memory: Any = None,
    workers: int | None = None,
    uv_range: tuple[float, float] | None = None,
) -> Plan:
    """Work out the plan of a scene; see `Scene.plan`."""
    tolerance = TOLERANCE.check(tolerance, "tolerance")
    workers = (os.cpu_count() or 1) if workers is None else COUNT.check(workers, "workers")
    uv_range = None if uv_range is None else UV_RANGE.check(uv_range, "uv_range")
    full = _as_given(*given)
    scale_jy = _scale(full)
    outside: list[Item] = []
    full = within(full, uv_range, outside)
    rounded = rounding(full, scale_jy) if tolerance > 0 and scale_jy else 0.0
    _refuse_below(tolerance, rounded)
    found = _decided(full, tolerance, rounded, engine)
    problem, ready = found.problem, found.ready
    said = ready.omission[0] or ready.lines  # the bound stands there
    limit = memory_limit(memory)
    shape, work, peak = _blocks(ready, workers, limit)
    last = Item(_rounding_name(problem), "", rounding(problem, scale_jy))
    unmodelled = not_modelled(problem, scale_jy)
    _say_what_exceeds(tolerance, last.bound, unmodelled)
    plan = Plan(
        name=name,
        full=full,
        problem=problem,
        kept=(*found.kept, w_term(problem)),
        left_out=(*found.left_out, *outside),
        not_modelled=tuple(unmodelled),
        engine=ready.engine,
        engine_name=found.label,
        engine_tolerance=found.left,
        refused=found.refused,
        work=work,
        block_shape=shape,
        workers=workers,
        memory=peak,
        limit=limit,
        tolerance=tolerance,
        bounds=(Item(found.label, "", ready.bound), last) if ready.bound and not said else (last,),
        scale_jy=scale_jy,
        seconds=work.seconds / workers,
        decade=partial(_next_decade, full, tolerance, rounded, engine, work.seconds),
    )
    vars(plan)["ready"] = ready  # or it would be prepared a second time
    return plan


class Decided(NamedTuple):
    """What a tolerance allows: the problem that is left, its engine, what is kept and left out, what is not spent."""

    problem: Problem
    ready: Prepared
    label: str
    kept: tuple[Item, ...]
    left_out: tuple[Item, ...]
    refused: tuple[Item, ...]
    left: float


def _decided(full: Problem, tolerance: float, rounded: float, engine: str | None) -> Decided:
    """The omissions of a tolerance, each within its part of it, and the cheapest engine of what they leave."""
    kept: list[Item] = []
    left_out: list[Item] = []
    budget = Budget(tolerance, rounded) if tolerance > 0 else Budget(0.0, 0.0)
    chain = simplify_chain(full.chain, full.at, budget, kept, left_out)
    problem = simplify_sky(full, chain, budget, left_out)
    ready, label, refused = cheapest(problem, engine, budget.left)
    if ready.omission[0]:
        left_out.append(Item(*ready.omission, ready.bound))
    kept += [Item(*line) for line in ready.lines]
    said = tuple(Item(*pair) for pair in refused)
    return Decided(problem, ready, label, tuple(kept), tuple(left_out), said, budget.left)


def _next_decade(full: Problem, tolerance: float, rounded: float, engine: str | None, seconds: float) -> str:
    """What a tenth of the tolerance would cost, in words."""
    if not tolerance:
        return ""
    if rounded > tolerance / 10:
        return f"no decade more: float64 promises {rounded:.1e} here"
    try:
        more = _decided(full, tolerance / 10, rounded, engine).ready.work().seconds / max(seconds, 1e-12)
    except RefusedError as error:
        return f"no decade more: {error}"
    return f"tolerance {tolerance / 10:g} would take {more:.2f} times as long"


def _as_given(instrument: Instrument, sky: Sky, observation: Observation) -> Problem:
    """The whole scene as a problem; refused where it cannot be observed or held."""
    layout, chain = instrument.layout(), instrument.chain()
    if len(layout) < 2:
        raise InputError(
            f"an interferometer needs at least two stations, got {', '.join(layout.names)}: one alone has a beam and "
            "no visibilities"
        )
    placed = sky.about(observation.phase_centre)
    warn_outside_band(chain, observation.freq_hz)
    ra, dec = placed.outline()
    channels = observation.freq_hz.size
    afford(
        300.0 * channels * len(ra), f"a sky of {len(ra)} directions in {channels} channels", "ask for fewer of either"
    )
    at = observation.sampling(layout, ra, dec)
    _must_rise(at)
    _say_coincident(layout)
    a, b = layout.baselines
    return Problem(at, chain, placed, a, b, observation.interval, observation.width_hz)


def _say_coincident(layout: Layout) -> None:
    """Stations within 1 mm of each other are allowed and said: more likely one was listed twice."""
    a, b = layout.baselines
    close = np.flatnonzero(np.linalg.norm(layout.positions_m[a] - layout.positions_m[b], axis=1) < 1e-3)
    if close.size:
        pair = " and ".join(layout.names[k] for k in (a[close[0]], b[close[0]]))
        more = f" (and {close.size - 1} pairs more)" if close.size > 1 else ""
        warn(f"stations {pair} stand in the same place{more}: their baseline sees the total flux and nothing else")


def _must_rise(at: Sampling) -> None:
    up = np.einsum("tc,ac->ta", at.centre_itrf, at.layout.axes[:, 2])
    if up.max() <= 0:
        highest = np.rad2deg(np.arcsin(up.max()))
        raise InputError(
            f"the phase centre {at.centre} never rises during the observation (highest elevation {highest:.1f} deg): "
            "choose another time or direction"
        )


def _scale(full: Problem) -> float:
    """Total flux, to which all errors are relative; refused where float64 cannot hold products with it."""
    scale_jy = total_flux(full)
    if scale_jy and not 1e-305 < scale_jy < 1e305:
        raise InputError(f"the sky has {scale_jy:.3g} Jy in all: give fluxes between 1e-305 and 1e305 Jy")
    return scale_jy


def _refuse_below(tolerance: float, rounded: float) -> None:
    """A tolerance that rounding alone may exceed is refused, with the floor."""
    if 0 < tolerance < rounded:
        raise RefusedError(
            f"tolerance = {tolerance:g} is below what float64 can promise here, {rounded:.1e}: give that or more, or 0 "
            "for the exact sums and their bound"
        )


def _say_what_exceeds(tolerance: float, rounded: float, unmodelled: list[Item]) -> None:
    if not tolerance:
        return
    extra = [i for i in unmodelled if i.bound]
    if rounded + sum(i.bound for i in extra) > tolerance:
        said = "; ".join(f"{i.name}: {i.reason}, {i.bound:.1e}" for i in extra)
        text = f"tolerance = {tolerance:g} is not kept by what is not modelled ({said}): split it into smaller sources"
        warn(text)


def memory_limit(memory: Any) -> float:
    """Bytes that may be taken: a size such as "8 GB", or three quarters of the machine."""
    if memory is None:
        return usable()
    found = to_si(memory, "byte", "memory", above=0)
    if np.ndim(found):
        raise InputError(f"memory = {brief(memory)} must be one size, such as '8 GB'")
    return float(found)


def _blocks(ready: Prepared, workers: int, limit: float) -> tuple[tuple[int, int], Work, float]:
    """Times and channels per block, whole atoms; the work of the whole, in such blocks; the peak of what is held."""
    times, channels, baselines = ready.problem.shape
    nt, nf = min(ready.atom[0], times), min(ready.atom[1], channels)
    result = 64.0 * baselines
    whole, one = ready.work(), ready.work(slice(0, nt), slice(0, nf))
    # every worker holds a block and its result, and one more result of each may wait to be taken
    slot = one.slot_bytes + result * nt * nf
    atoms = int(min(BLOCK_BYTES, (limit - whole.shared_bytes) / workers) // slot)
    if atoms < 1:
        if (least := whole.shared_bytes + slot * workers) > limit:
            fewer = f"fewer threads than {workers} (--workers), " if whole.shared_bytes + slot <= limit else ""
            raise RefusedError(
                f"one block needs {si_prefix(least, 'B')} and the limit is {si_prefix(limit, 'B')}: give "
                f"{fewer}more memory (--memory), or fewer sources (--set sky.brightest=N)"
            )
        atoms = 1
    across = min(-(-channels // nf), atoms)
    shape = (min(times, nt * max(1, atoms // across)), min(channels, nf * across))
    held = ready.work(slice(0, shape[0]), slice(0, shape[1])).slot_bytes
    work = whole._replace(slot_bytes=held)
    return shape, work, work.shared_bytes + workers * (held + result * shape[0] * shape[1])


def _rounding_name(problem: Problem) -> str:
    """What the bound on rounding is of, and what it takes for granted where a term knows no bound of its own."""
    unknown = unknown_peaks(problem)
    return f"float64 sums where {', '.join(unknown)} stays below 1:" if unknown else "float64 sums"
