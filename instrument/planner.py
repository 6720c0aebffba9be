"""Planner: works out the plan of a scene: what its sky, chain and baselines need, by which engine, in which blocks."""

from __future__ import annotations

import os
from dataclasses import replace
from typing import Any

import numpy as np

from instrument.errors import InputError, RefusedError, did_you_mean, warn
from instrument.jones.chain import Chain
from instrument.memory import afford, usable
from instrument.model import Instrument, warn_outside_band
from instrument.not_modelled import not_modelled
from instrument.numbers import COUNT, TOLERANCE, UV_RANGE, brief
from instrument.observe.directions import LIGHT
from instrument.observe.layout import Layout
from instrument.observe.observation import Observation
from instrument.observe.sampling import Sampling
from instrument.plan import Item, Plan, count_of
from instrument.predict.base import Predictor, Prepared, Problem, Work
from instrument.predict.rounding import known_gain, rounding, total_flux, unknown_peaks
from instrument.registry import available, load
from instrument.sky.base import Sky, power
from instrument.sky.image import ImageSky
from instrument.sky.points import PointSky, points_of
from instrument.units import Bool, Float, si_prefix, to_si

BLOCK_BYTES = 64e6
KINDS = ("I", "Q", "U", "V")


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
    kept: list[Item] = []
    left_out: list[Item] = []
    budget = Budget(tolerance, rounding(full, scale_jy)) if tolerance > 0 else Budget(0.0, 0.0)
    chain = _simplify_chain(full.chain, full.at, budget, kept, left_out)
    problem = _simplify_sky(full, chain, budget, left_out)
    problem = _within(problem, uv_range, left_out)
    kept.append(_w_term(problem))
    ready, label, refused = _choose(problem, engine, budget)
    limit = memory_limit(memory)
    shape, work, peak = _blocks(ready, workers, limit)
    rounded = Item(_rounding_name(problem), "", rounding(problem, scale_jy))
    unmodelled = not_modelled(problem, scale_jy)
    _say_what_exceeds(tolerance, rounded.bound, unmodelled)
    plan = Plan(
        name=name,
        full=replace(full, antenna1=problem.antenna1, antenna2=problem.antenna2),
        problem=problem,
        kept=tuple(kept),
        left_out=tuple(left_out),
        not_modelled=tuple(unmodelled),
        engine=ready.engine,
        engine_name=label,
        engine_tolerance=budget.left,
        refused=tuple(refused),
        work=work,
        block_shape=shape,
        workers=workers,
        memory=peak,
        limit=limit,
        tolerance=tolerance,
        bounds=(Item(label, "", ready.bound), rounded) if ready.bound else (rounded,),
        scale_jy=scale_jy,
        seconds=work.seconds / workers,
    )
    vars(plan)["ready"] = ready  # or it would be prepared a second time
    return plan


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
    at = Sampling.build(layout, observation.times(layout), observation.freq_hz, ra, dec, observation.phase_centre)
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


class Budget:
    """What a tolerance leaves for omissions after rounding; each is offered a part and takes what it needs."""

    def __init__(self, tolerance: float, rounded: float) -> None:
        self.left = max(0.0, tolerance - rounded)

    def take(self, bound: float) -> None:
        """Spend a bound."""
        self.left = max(0.0, self.left - bound)


def _scale(full: Problem) -> float:
    """Total flux, to which all errors are relative; refused where float64 cannot hold products with it."""
    scale_jy = total_flux(full)
    if scale_jy and not 1e-305 < scale_jy < 1e305:
        raise InputError(f"the sky has {scale_jy:.3g} Jy in all: give fluxes between 1e-305 and 1e305 Jy")
    return scale_jy


def _say_what_exceeds(tolerance: float, rounded: float, unmodelled: list[Item]) -> None:
    if not tolerance:
        return
    extra = [i for i in unmodelled if i.bound]
    if rounded > tolerance:
        text = f"tolerance = {tolerance:g} is below what float64 can promise here, {rounded:.1e}"
        warn(text)
    elif rounded + sum(i.bound for i in extra) > tolerance:
        said = "; ".join(f"{i.name}: {i.reason}, {i.bound:.1e}" for i in extra)
        text = f"tolerance = {tolerance:g} is not kept by what is not modelled ({said}): split it into smaller sources"
        warn(text)


def _simplify_chain(chain: Chain, at: Sampling, budget: Budget, kept: list[Item], left_out: list[Item]) -> Chain:
    gain = known_gain(chain, at)
    # n terms each wrong by d of their peak change J B J^H by (1 + d)^2n - 1 of its own: half of what is left
    share = 0.5 * budget.left / gain if gain else 0.0
    smaller, fates = chain.simplified(at, float(np.expm1(np.log1p(share) / (2 * max(len(chain.terms), 1)))))
    grown = 1.0
    for term, fate in fates:
        name = type(term).__name__
        bound = gain * grown * fate.bound * (2 + fate.bound)
        grown *= (1 + fate.bound) ** 2
        budget.take(bound)
        if fate.term is None:
            left_out.append(Item(name, fate.reason, bound))
        else:
            shared = ", ".join(p.sharing(at) for p in reversed(fate.term.parts()))
            kept.append(Item(name, fate.reason or shared, bound))
    if not smaller.parts:
        left_out.append(Item("2x2 algebra", "the chain is the identity"))
    elif smaller.structure != "full":
        left_out.append(Item("2x2 algebra", f"the chain is {smaller.structure}"))
    return smaller


def _simplify_sky(full: Problem, chain: Chain, budget: Budget, left_out: list[Item]) -> Problem:
    """Drop directions that give exactly nothing, and with a tolerance the faintest, by flux times the peak of |J|^2."""
    problem, sky = replace(full, chain=chain), points_of(full.sky)
    if sky is not None:
        return _fewer(problem, sky, budget, left_out)
    there = full.sky.nonzero(full.at.freq_hz)
    if not any(there):
        raise InputError(f"the sky ({full.sky.size}) has no flux at all")
    if isinstance(full.sky, ImageSky) and (dark := len(full.sky.grid) - full.sky.count):
        left_out.append(Item(count_of(dark, "pixel"), "no flux"))
    if not all(there):
        zero = ", ".join(kind for kind, has in zip(KINDS, there, strict=True) if not has)
        left_out.append(Item(f"{zero} of the sky", "zero in every direction"))
    return problem


def _fewer(full: Problem, sky: PointSky, budget: Budget, left_out: list[Item]) -> Problem:
    """A list without the sources that are below the horizon or have no flux, nor, with a tolerance, the faintest."""
    chain = full.chain
    stokes = sky.stokes(full.at.freq_hz)
    use = np.any(stokes != 0, axis=(0, 2))
    if not use.all():
        left_out.append(Item(count_of(int((~use).sum()), "direction"), "no flux"))
    if chain.blind_below_horizon:
        risen = full.at.rising.highest > -1e-9  # on the safe side: a direction at the very edge is kept
        if np.any(use & ~risen):
            below = count_of(int((use & ~risen).sum()), "direction")
            left_out.append(Item(below, "below the antenna planes throughout"))
        use &= risen
    zero = [k for k, there in zip(KINDS, np.any(stokes != 0, axis=(0, 1)), strict=True) if not there]
    if zero:
        left_out.append(Item(f"{', '.join(zero)} of the sky", "zero in every direction"))
    if not use.any():
        raise InputError("nothing of the sky is ever above the antenna planes, or it has no flux at all")
    if budget.left > 0:
        faint, bound = _faint(stokes, use, chain.peak(full.at), 0.5 * budget.left)
        if faint.any():
            budget.take(bound)
            left_out.append(Item(count_of(int(faint.sum()), "faint direction"), "flux times the peak of |J|^2", bound))
            use &= ~faint
    if use.all():
        return replace(full, chain=chain)
    smaller = sky.select(np.flatnonzero(use))
    return replace(full, chain=chain, sky=smaller, at=full.at.towards(*smaller.directions()))


def _faint(stokes: Float, use: Bool, peak: float, tolerance: float) -> tuple[Bool, float]:
    """The faintest sources whose sum stays below a tolerance, and that sum."""
    flux = power(stokes)
    share = peak * (peak * flux / flux.sum(axis=1).max()).max(axis=0)
    faint = np.zeros(len(use), bool)
    if not np.isfinite(peak):
        return faint, 0.0
    order = np.argsort(np.where(use, share, np.inf), kind="stable")[: int(use.sum()) - 1]
    dropped = order[np.cumsum(share[order]) <= tolerance]
    faint[dropped] = True
    return faint, float(share[dropped].sum())


def _within(problem: Problem, uv_range: tuple[float, float] | None, left_out: list[Item]) -> Problem:
    """Drop baselines that never come within the uv range (wavelengths) that the products ask for."""
    if uv_range is None:
        return problem
    at = problem.at
    low, high = (r * LIGHT / f for r, f in zip(uv_range, (at.freq_hz.max(), at.freq_hz.min()), strict=True))
    use = np.zeros(len(problem.antenna1), bool)
    for t in range(0, at.shape[0], 64):
        uv = at.block(slice(t, t + 64), slice(None)).uvw_m[..., :2]
        length = np.linalg.norm(uv[:, problem.antenna1] - uv[:, problem.antenna2], axis=-1)
        use |= np.any((length >= low) & (length <= high), axis=0)
    if use.all():
        return problem
    if not use.any():
        raise InputError(f"no baseline ever lies within uv_range = {list(uv_range)} wavelengths")
    text = f"never within {uv_range[0]:g} to {uv_range[1]:g} wavelengths"
    left_out.append(Item(count_of(int((~use).sum()), "baseline"), text))
    return problem.between(problem.antenna1[use], problem.antenna2[use])


def _w_term(problem: Problem) -> Item:
    """The w-term is always kept: it costs nothing here; what leaving it out would do is said."""
    low = float(problem.at.lmn[:, 2].min())
    turns = problem.at.layout.longest_m * float(problem.at.freq_hz.max()) / LIGHT * abs(low)
    return Item("w-term", f"without it phases could be wrong by {turns:.2g} turns")


def _choose(problem: Problem, name: str | None, budget: Budget) -> tuple[Prepared, str, list[Item]]:
    """The cheapest engine, prepared, with its name, and the engines that refuse."""
    plugins = available("engines")
    if name is not None and name not in plugins:
        raise InputError(f"no engine is called '{name}': {did_you_mean(name, plugins)}")
    fit: list[tuple[float, str, Predictor]] = []
    refused = []
    for label, plugin in plugins.items():
        if plugin.broken:
            refused.append(Item(label, plugin.broken))
            continue
        engine = load("engines", label)
        if why := engine.refuses(problem):
            refused.append(Item(label, why))
        else:
            fit.append((engine.work(problem).seconds, label, engine))
    for _, label, engine in sorted(fit, key=lambda entry: entry[0]):
        if name not in (None, label):
            continue
        try:
            return engine.prepare(problem, budget.left), label, refused
        except RefusedError as error:
            refused.append(Item(label, str(error)))
    reasons = "; ".join(f"{i.name}: {i.reason}" for i in refused if name in (None, i.name))
    raise RefusedError(f"no engine serves this scene ({reasons})")


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
