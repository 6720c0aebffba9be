"""Plan: what a scene will compute, what it leaves out and with what bound, by which engine, and how to run it."""

from __future__ import annotations

import os
from collections import deque
from collections.abc import Callable, Iterator
from concurrent.futures import Executor, Future, ThreadPoolExecutor
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np

from instrument.errors import InputError, RefusedError, did_you_mean
from instrument.jones.chain import Chain
from instrument.model import Instrument, warn_outside_band
from instrument.observe.observation import Observation
from instrument.observe.sampling import Sampling
from instrument.predict.base import Predictor, Problem, Work
from instrument.sky.base import Sky
from instrument.units import si_prefix, to_si
from instrument.visibilities import Visibilities

BLOCK_BYTES = 64e6
KINDS = ("I", "Q", "U", "V")


class Item(NamedTuple):
    """One line of a plan: a thing, what happens to it and why, and the bound on the error of leaving it out."""

    name: str
    reason: str
    bound: float = 0.0


@dataclass(frozen=True)
class Check:
    """What `verify` measured: the largest error of `samples` visibilities against `direct`, and the bound promised.

    Both relative to `scale_jy`, the total flux of the sky.
    """

    error: float
    bound: float
    samples: int
    scale_jy: float

    @property
    def passed(self) -> bool:
        """Whether the measured error lies within the bound."""
        return bool(self.error <= self.bound)

    def __str__(self) -> str:
        verdict = "within" if self.passed else "ABOVE"
        return (
            f"error {self.error:.1e}, {verdict} the bound {self.bound:.1e} ({self.samples} visibilities against direct)"
        )


@dataclass(frozen=True)
class Plan:
    """What will be done. Print it; `run` it at once or take `blocks` one by one; `verify` it against the definition."""

    name: str
    full: Problem  # as the scene has it: what `direct` would compute
    problem: Problem  # what is computed after the omissions
    kept: tuple[Item, ...]
    left_out: tuple[Item, ...]
    not_modelled: tuple[Item, ...]
    engine: Predictor
    engine_name: str
    refused: tuple[Item, ...]
    work: Work
    block_shape: tuple[int, int]
    workers: int
    memory: float
    limit: float
    tolerance: float
    bounds: tuple[Item, ...]
    scale_jy: float
    seconds: float = field(compare=False, default=0.0)

    @property
    def error_bound(self) -> float:
        """Sum of the bounds on all errors, relative to the total flux of the sky."""
        return sum(item.bound for item in (*self.left_out, *self.bounds))

    @property
    def slices(self) -> list[tuple[slice, slice]]:
        """Times and channels of every block, in order of time."""
        times, channels, _ = self.problem.shape
        nt, nf = self.block_shape
        return [
            (slice(t, min(t + nt, times)), slice(f, min(f + nf, channels)))
            for t in range(0, times, nt)
            for f in range(0, channels, nf)
        ]

    def __str__(self) -> str:
        times, channels, baselines = self.full.shape
        stations, sources = self.full.at.shape[2:]
        head = (
            f"scene {self.name}: {_count(stations, 'station')}, {_count(baselines, 'baseline')}, "
            f"{_count(times, 'time')}, {_count(channels, 'channel')}, {_count(sources, 'direction')}, "
            f"tolerance {self.tolerance:g}"
        )
        lines = [head]
        lines += [f"kept          {i.name:<22} {i.reason}" for i in self.kept]
        lines += [f"left out      {i.name:<22} {i.reason:<46} error {i.bound:.2g}" for i in self.left_out]
        lines += [f"not modelled  {i.name:<22} {i.reason}" for i in self.not_modelled]
        lines.append(
            f"engine        {self.engine_name:<22} {si_prefix(self.work.flops, 'Flop')}, "
            f"about {_seconds(self.seconds)}, peak {si_prefix(self.memory, 'B')} in {_count(len(self.slices), 'block')}"
        )
        lines += [f"refused       {i.name:<22} {i.reason}" for i in self.refused]
        inside = ", ".join(f"{i.name} {i.bound:.1e}" for i in (*self.left_out, *self.bounds) if i.bound)
        lines.append(f"bound         {self.error_bound:.1e} of the total flux {self.scale_jy:.4g} Jy ({inside})")
        return "\n".join(lines)

    def run(self, executor: Executor | None = None, progress: Callable[[float], None] | None = None) -> Visibilities:
        """All visibilities in memory; blocks run on threads, or on any `concurrent.futures.Executor`."""
        times, channels, baselines = self.problem.shape
        whole = 64.0 * times * channels * baselines
        if whole + self.memory > self.limit:
            raise RefusedError(
                f"{si_prefix(whole + self.memory, 'B')} of visibilities and blocks exceed the limit of "
                f"{si_prefix(self.limit, 'B')}: take blocks one by one with plan.blocks(), or fewer times or channels"
            )
        data = np.empty((times, channels, baselines, 2, 2), complex)
        for (t, f), block in zip(self.slices, self.blocks(executor, progress), strict=True):
            data[t, f] = block.data
        return Visibilities(
            data=data,
            at=self.problem.at.at_centre(),
            antenna1=self.problem.antenna1,
            antenna2=self.problem.antenna2,
            interval_s=self.problem.interval_s,
            width_hz=self.problem.width_hz,
        )

    def blocks(
        self, executor: Executor | None = None, progress: Callable[[float], None] | None = None
    ) -> Iterator[Visibilities]:
        """Visibilities block by block, in order; memory does not grow with the length of the observation.

        `progress` is called with the fraction done after every block.
        """
        if executor is not None:
            yield from self._stream(executor, 2 * self.workers, progress)
            return
        from threadpoolctl import threadpool_limits

        with threadpool_limits(1), ThreadPoolExecutor(self.workers) as pool:
            yield from self._stream(pool, self.workers, progress)

    def _stream(
        self, executor: Executor, ahead: int, progress: Callable[[float], None] | None
    ) -> Iterator[Visibilities]:
        waiting: deque[Future[Visibilities]] = deque()
        todo = self.slices
        done = 0
        try:
            while todo or waiting:
                while todo and len(waiting) < ahead:
                    waiting.append(executor.submit(self.engine.predict, self.problem.block(*todo.pop(0))))
                block = waiting.popleft().result()
                done += 1
                if progress is not None:
                    progress(done / len(self.slices))
                yield block
        finally:
            for future in waiting:
                future.cancel()

    def coverage(self) -> Iterator[Visibilities]:
        """Coordinates of all blocks with data of zero, which take no memory: for weights before any prediction."""
        for times, channels in self.slices:
            block = self.problem.block(times, channels)
            yield Visibilities(
                data=np.broadcast_to(np.zeros((), complex), (*block.shape, 2, 2)),
                at=block.at.at_centre(),
                antenna1=block.antenna1,
                antenna2=block.antenna2,
                interval_s=block.interval_s,
                width_hz=block.width_hz,
            )

    def verify(self, samples: int = 64, seed: int = 0) -> Check:
        """Recompute random visibilities of the scene as it was given with `direct`, and compare.

        Takes up to 8 baselines at each of samples/8 random times and channels.
        """
        from instrument.predict.direct import Direct

        if samples < 1:
            raise InputError(f"verify needs at least one sample, got {samples}")
        rng = np.random.default_rng(seed)
        times, channels, baselines = self.problem.shape
        each = min(8, baselines, samples)
        worst, count = 0.0, 0
        while count < samples:
            t, f = (slice(k, k + 1) for k in (rng.integers(times), rng.integers(channels)))
            pick = np.sort(rng.choice(baselines, each, replace=False))
            chosen = self.problem.antenna1[pick], self.problem.antenna2[pick]
            fast = self.engine.sums(self.problem.block(t, f).between(*chosen))
            slow = Direct().sums(self.full.block(t, f).between(*chosen))
            worst = max(worst, float(np.abs(fast - slow).max()))
            count += each
        error = worst / self.scale_jy if self.scale_jy else worst
        return Check(error, self.error_bound, count, self.scale_jy)


def make_plan(
    name: str,
    instrument: Instrument,
    sky: Sky,
    observation: Observation,
    tolerance: float = 0.0,
    engine: str | None = None,
    memory: Any = None,
    workers: int | None = None,
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
    chain = _simplify_chain(chain, at, tolerance, kept, left_out)
    problem = _simplify_sky(full, chain, left_out)
    if chain.structure != "full" or not chain.parts:
        left_out.append(Item("2x2 algebra", f"the chain is {chain.structure if chain.parts else 'the identity'}"))
    found, label, refused = _choose(problem, engine)
    limit = _limit(memory)
    workers = workers or os.cpu_count() or 1
    shape, work, peak = _blocks(found, problem, workers, limit)
    return Plan(
        name=name,
        full=full,
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
        bounds=(Item("float64 sums", "", _rounding(problem)),),
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


def _simplify_chain(chain: Chain, at: Sampling, tolerance: float, kept: list[Item], left_out: list[Item]) -> Chain:
    terms = []
    for term in chain.terms:
        simpler, reason, bound = term.simplify(at, tolerance)
        label = type(term).__name__
        if simpler is None:
            left_out.append(Item(label, reason, bound))
            continue
        terms.append(simpler)
        kept.append(Item(label, reason or _sharing(simpler, at)))
    return Chain(*terms)


def _sharing(term: Any, at: Sampling) -> str:
    """How many different matrices the stations need of a term."""
    count = len(at.layout)
    notes = []
    for part in term.parts():
        if part.per_station == "frame":
            _, group = at.layout.frames
            sizes = "+".join(str(n) for n in sorted(np.bincount(group), reverse=True))
            notes.append(f"{type(part).__name__} shared by {sizes} stations")
        elif part.per_station == "own" and hasattr(part, "distinct_count"):
            notes.append(f"{part.distinct_count} array factors")
        elif part.per_station == "own" and count > 1:
            notes.append("one per station")
    return ", ".join(reversed(notes))


def _simplify_sky(full: Problem, chain: Chain, left_out: list[Item]) -> Problem:
    """Drop directions that give exactly nothing: no flux, or below the antenna planes for the whole run."""
    from dataclasses import replace

    sky = full.sky.sources()
    if sky is None:
        return replace(full, chain=chain)
    stokes = sky.stokes(full.at.freq_hz)
    use = np.any(stokes != 0, axis=(0, 2))
    if not use.all():
        left_out.append(Item(f"{_count(int((~use).sum()), 'direction')}", "no flux"))
    if chain.blind_below_horizon:
        risen = _ever_up(full.at)
        if np.any(use & ~risen):
            left_out.append(
                Item(f"{_count(int((use & ~risen).sum()), 'direction')}", "below the antenna planes throughout")
            )
        use &= risen
    zero = [k for k, there in zip(KINDS, np.any(stokes != 0, axis=(0, 1)), strict=True) if not there]
    if zero:
        left_out.append(Item(f"{', '.join(zero)} of the sky", "zero in every direction"))
    if not use.any():
        raise InputError("nothing of the sky is ever above the antenna planes, or it has no flux at all")
    if use.all():
        return replace(full, chain=chain)
    smaller = sky.select(np.flatnonzero(use))
    return replace(full, chain=chain, sky=smaller, at=full.at.towards(*smaller.directions()))


def _ever_up(at: Sampling) -> Any:
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
    from instrument.registry import available, load

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
    # every worker holds its block; twice as many results can wait to be taken
    most = min(BLOCK_BYTES, (limit - 2 * workers * result) / workers)
    slots = int(most // one.bytes)
    if slots < 1:
        if one.bytes * workers + 2 * workers * result > limit:
            raise RefusedError(
                f"one block needs {si_prefix(one.bytes * workers, 'B')} and the limit is {si_prefix(limit, 'B')}: give "
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
    from instrument.observe.directions import EARTH_RATE, LIGHT, separation

    far = float(np.sin(np.minimum(separation(problem.at.vectors, problem.at.centre).max(), np.pi / 2)))
    longest = problem.at.layout.longest_m
    parts = []
    turns = EARTH_RATE * problem.interval_s * longest * float(problem.at.freq_hz.max()) / LIGHT * far
    parts.append(f"time {100 * (1 - np.sinc(turns)):.3g} %")
    if problem.width_hz:
        parts.append(f"bandwidth {100 * (1 - np.sinc(problem.width_hz * longest / LIGHT * far)):.3g} %")
    return [Item("smearing", f"{', '.join(parts)} of the farthest source on the longest baseline")]


def _rounding(problem: Problem) -> float:
    """Bound on the rounding of float64 phases and sums, relative to the total flux."""
    from instrument.observe.directions import LIGHT

    eps = float(np.finfo(float).eps)
    reach = np.abs(problem.at.lmn).max(axis=0).sum() if len(problem.at.lmn) else 0.0
    turns = problem.at.layout.longest_m * float(problem.at.freq_hz.max()) / LIGHT * float(reach)
    # 4 roundings in each of two phases; 30 in the Jones matrices; the sum itself over S sources, worst case
    return eps * (2 * np.pi * 8 * turns + 30 + problem.at.shape[3])


def _total_flux(problem: Problem) -> float:
    sky = problem.sky.sources()
    if sky is None:
        return float(np.abs(problem.sky.brightness(problem.at)).sum())
    stokes = sky.stokes(problem.at.freq_hz)
    return float((np.abs(stokes[..., 0]) + np.sqrt((stokes[..., 1:] ** 2).sum(axis=-1))).sum(axis=1).max())


def _count(n: int, what: str) -> str:
    return f"{n} {what}" if n == 1 else f"{n} {what}s"


def _seconds(value: float) -> str:
    if value < 1:
        return "1 s"
    return f"{value:.0f} s" if value < 120 else f"{value / 60:.0f} min"
