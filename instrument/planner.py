"""Planner: works out the plan of a scene: what its sky, chain and baselines need, by which engine, in which blocks."""

from __future__ import annotations

import os
import warnings
from dataclasses import replace
from typing import Any

import numpy as np

from instrument.errors import InputError, InstrumentWarning, RefusedError, did_you_mean
from instrument.jones.chain import Chain
from instrument.model import Instrument, warn_outside_band
from instrument.observe.directions import EARTH_RATE, LIGHT, separation
from instrument.observe.observation import Observation
from instrument.observe.sampling import Sampling
from instrument.plan import Item, Plan, count_of
from instrument.predict.base import Predictor, Problem, Work
from instrument.registry import available, load
from instrument.sky.base import Sky
from instrument.units import Bool, Float, si_prefix, to_si

BLOCK_BYTES = 64e6
KINDS = ("I", "Q", "U", "V")


def make_plan(
    name: str,
    instrument: Instrument,
    sky: Sky,
    observation: Observation,
    tolerance: float = 0.0,
    engine: str | None = None,
    memory: Any = None,
    workers: int | None = None,
    uv_range: tuple[float, float] | None = None,
) -> Plan:
    """Work out the plan of a scene; see `Scene.plan`."""
    if not (np.isfinite(tolerance) and tolerance >= 0):
        raise InputError(f"tolerance = {tolerance} must be a number not below 0")
    layout, chain = instrument.layout(), instrument.chain()
    sky = sky.about(observation.phase_centre)
    warn_outside_band(chain, observation.freq_hz)
    ra, dec = sky.directions()
    at = Sampling.build(layout, observation.times(layout), observation.freq_hz, ra, dec, observation.phase_centre)
    _must_rise(at)
    a, b = layout.baselines
    full = Problem(at, chain, sky, a, b, observation.interval, observation.width_hz)
    kept: list[Item] = []
    left_out: list[Item] = []
    chain = _simplify_chain(chain, at, kept, left_out)
    problem = _simplify_sky(full, chain, tolerance, left_out)
    problem = _within(problem, uv_range, left_out)
    kept.append(_w_term(problem))
    found, label, refused = _choose(problem, engine)
    limit = _limit(memory)
    workers = workers or os.cpu_count() or 1
    shape, work, peak = _blocks(found, problem, workers, limit)
    rounding = _rounding(problem)
    if 0 < tolerance < rounding:
        warnings.warn(
            f"tolerance = {tolerance:g} is below what float64 can promise here, {rounding:.1e}",
            InstrumentWarning,
            stacklevel=3,
        )
    return Plan(
        name=name,
        full=replace(full, antenna1=problem.antenna1, antenna2=problem.antenna2),
        problem=problem,
        kept=tuple(kept),
        left_out=tuple(left_out),
        not_modelled=tuple(_smearing(problem)),
        engine=found,
        engine_name=label,
        refused=tuple(refused),
        work=work,
        block_shape=shape,
        workers=workers,
        memory=peak,
        limit=limit,
        tolerance=tolerance,
        bounds=(Item(_rounding_name(problem), "", rounding),),
        scale_jy=_total_flux(full),
        seconds=work.seconds / workers,
    )


def _must_rise(at: Sampling) -> None:
    up = np.einsum("tc,ac->ta", at.centre_itrf, at.layout.axes[:, 2])
    if up.max() <= 0:
        highest = np.rad2deg(np.arcsin(up.max()))
        raise InputError(
            f"the phase centre {at.centre} never rises during the observation (highest elevation {highest:.1f} deg): "
            "choose another time or direction"
        )


def _simplify_chain(chain: Chain, at: Sampling, kept: list[Item], left_out: list[Item]) -> Chain:
    smaller, fates = chain.simplified(at)
    for term, fate in fates:
        name = type(term).__name__
        if fate.term is None:
            left_out.append(Item(name, fate.reason, fate.bound))
        else:
            kept.append(Item(name, fate.reason or ", ".join(p.sharing(at) for p in reversed(fate.term.parts()))))
    if not smaller.parts:
        left_out.append(Item("2x2 algebra", "the chain is the identity"))
    elif smaller.structure != "full":
        left_out.append(Item("2x2 algebra", f"the chain is {smaller.structure}"))
    return smaller


def _simplify_sky(full: Problem, chain: Chain, tolerance: float, left_out: list[Item]) -> Problem:
    """Drop directions that give exactly nothing, and with a tolerance the faintest, by flux times the peak of |J|^2."""
    sky = full.sky.sources()
    if sky is None:
        return replace(full, chain=chain)
    stokes = sky.stokes(full.at.freq_hz)
    use = np.any(stokes != 0, axis=(0, 2))
    if not use.all():
        left_out.append(Item(count_of(int((~use).sum()), "direction"), "no flux"))
    if chain.blind_below_horizon:
        risen = _ever_up(full.at)
        if np.any(use & ~risen):
            below = count_of(int((use & ~risen).sum()), "direction")
            left_out.append(Item(below, "below the antenna planes throughout"))
        use &= risen
    zero = [k for k, there in zip(KINDS, np.any(stokes != 0, axis=(0, 1)), strict=True) if not there]
    if zero:
        left_out.append(Item(f"{', '.join(zero)} of the sky", "zero in every direction"))
    if not use.any():
        raise InputError("nothing of the sky is ever above the antenna planes, or it has no flux at all")
    if tolerance > 0:
        faint, bound = _faint(stokes, use, chain.peak(full.at) ** 2, tolerance)
        if faint.any():
            left_out.append(Item(count_of(int(faint.sum()), "faint direction"), "flux times the peak of |J|^2", bound))
            use &= ~faint
    if use.all():
        return replace(full, chain=chain)
    smaller = sky.select(np.flatnonzero(use))
    return replace(full, chain=chain, sky=smaller, at=full.at.towards(*smaller.directions()))


def _faint(stokes: Float, use: Bool, gain: float, tolerance: float) -> tuple[Bool, float]:
    """The faintest sources whose sum stays below half the tolerance (the rest is for rounding), and that sum."""
    flux = np.abs(stokes[..., 0]) + np.sqrt((stokes[..., 1:] ** 2).sum(axis=-1))
    share = gain * (flux / flux.sum(axis=1).max()).max(axis=0)
    faint = np.zeros(len(use), bool)
    if not np.isfinite(gain):
        return faint, 0.0
    order = np.argsort(np.where(use, share, np.inf), kind="stable")[: int(use.sum()) - 1]
    dropped = order[np.cumsum(share[order]) <= 0.5 * tolerance]
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


def _ever_up(at: Sampling) -> Bool:
    """Which directions (S,) are above the antenna plane of any station at any time."""
    first, _ = at.layout.frames
    up = np.zeros(len(at.ra_rad), bool)
    normals = at.layout.axes[first, 2]
    for t in range(0, len(at.earth), 256):
        earth = at.earth[t : t + 256]
        toward = np.einsum("tij,gi->tgj", earth.matrices, normals).reshape(-1, 3)  # normals in ICRS
        shift = np.einsum("tgj,tj->tg", toward.reshape(len(earth), -1, 3), earth.velocity).reshape(-1)
        # 1e-9 on the safe side: a direction at the very edge is kept
        up |= np.any(toward @ at.vectors.T + shift[:, None] > -1e-9, axis=0)
    return up


def _choose(problem: Problem, name: str | None) -> tuple[Predictor, str, list[Item]]:
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
    chosen = [entry for entry in fit if name in (None, entry[1])]
    if not chosen:
        reasons = "; ".join(f"{i.name}: {i.reason}" for i in refused if name in (None, i.name))
        raise RefusedError(f"no engine serves this scene ({reasons})")
    _, label, engine = min(chosen, key=lambda entry: entry[0])
    return engine, label, refused


def _limit(memory: Any) -> float:
    return 0.75 * machine_memory() if memory is None else float(to_si(memory, "byte", "memory"))


def machine_memory() -> float:
    """Memory of this machine in bytes; 8 GB where it cannot be asked."""
    try:
        return float(os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES"))
    except (AttributeError, ValueError, OSError):
        return 8e9


def _blocks(engine: Predictor, problem: Problem, workers: int, limit: float) -> tuple[tuple[int, int], Work, float]:
    """Times and channels per block, the work of the whole, and the peak of what is held at once."""
    times, channels, baselines = problem.shape
    one = engine.work(problem.block(slice(0, 1), slice(0, 1)))
    result = 64.0 * baselines
    # every worker holds a block and its result, and one more result of each may wait to be taken
    slot = one.bytes + result
    slots = int(min(BLOCK_BYTES, limit / workers) // slot)
    if slots < 1:
        if slot * workers > limit:
            raise RefusedError(
                f"one block needs {si_prefix(slot * workers, 'B')} and the limit is {si_prefix(limit, 'B')}: give "
                "more memory (--memory), or fewer sources (--set sky.brightest=N)"
            )
        slots = 1
    in_block = min(channels, slots)
    shape = (max(1, min(times, slots // in_block)), in_block)
    whole = engine.work(problem)
    held = engine.work(problem.block(slice(0, shape[0]), slice(0, shape[1]))).bytes
    return shape, whole, workers * held + workers * result * shape[0] * shape[1]


def _smearing(problem: Problem) -> list[Item]:
    """The size of what is not modelled: averaging within a channel and an integration."""
    far = float(np.sin(np.minimum(separation(problem.at.vectors, problem.at.centre).max(), np.pi / 2)))
    longest = problem.at.layout.longest_m
    parts = []
    turns = EARTH_RATE * problem.interval_s * longest * float(problem.at.freq_hz.max()) / LIGHT * far
    parts.append(f"time {_percent(1 - np.sinc(turns))}")
    if problem.width_hz:
        parts.append(f"bandwidth {_percent(1 - np.sinc(problem.width_hz * longest / LIGHT * far))}")
    return [Item("smearing", f"{', '.join(parts)} of the farthest source lost on the longest baseline")]


def _percent(lost: float) -> str:
    return "all" if lost >= 0.995 else f"{100 * lost:.2g} %"


def _rounding(problem: Problem) -> float:
    """Bound on the rounding of float64 phases and sums, relative to the total flux."""
    eps = float(np.finfo(float).eps)
    reach = np.abs(problem.at.lmn).max(axis=0).sum() if len(problem.at.lmn) else 0.0
    waves = problem.at.layout.longest_m * float(problem.at.freq_hz.max()) / LIGHT
    peak = problem.chain.peak(problem.at)
    gain = peak**2 if np.isfinite(peak) else 1.0  # the plan then says that it is assumed
    # 4 roundings in each of two phases, and 4 of direction cosines, which are good to eps of 1 and not of themselves;
    # 30 in the Jones matrices; the sum itself over S sources, worst case. Gains above 1 amplify it
    largest = max(1.0, gain)
    return largest * eps * (2 * np.pi * (8 * waves * float(reach) + 4 * waves) + 30 + problem.at.shape[3])


def _rounding_name(problem: Problem) -> str:
    """What the bound on rounding is of, and what it takes for granted where a term knows no bound of its own."""
    unknown = [type(t).__name__ for t in problem.chain.parts if not np.isfinite(t.peak(problem.at))]
    return f"float64 sums where {', '.join(unknown)} stays below 1:" if unknown else "float64 sums"


def _total_flux(problem: Problem) -> float:
    sky = problem.sky.sources()
    if sky is None:
        return float(np.abs(problem.sky.brightness(problem.at)).sum())
    stokes = sky.stokes(problem.at.freq_hz)
    return float((np.abs(stokes[..., 0]) + np.sqrt((stokes[..., 1:] ** 2).sum(axis=-1))).sum(axis=1).max())
