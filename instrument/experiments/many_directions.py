"""ManyDirections: clusters of sources, each behind station matrices of its own, solved all at once and subtracted."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from typing import Annotated

import numpy as np
from pydantic import Field

from instrument import mat2
from instrument.calibrate.directional import DirectionalCal
from instrument.calibrate.gauge import UNKNOWNS
from instrument.calibrate.selfcal import SelfCal
from instrument.component import Component
from instrument.errors import InputError, Outcome, did_you_mean
from instrument.experiments.incomplete_model_result import ranks
from instrument.experiments.many_directions_result import ManyDirectionsResult
from instrument.jones.chain import Chain
from instrument.jones.table import JonesTable
from instrument.observe.sampling import Sampling
from instrument.plan import Plan
from instrument.planner import BLOCK_BYTES
from instrument.sky.points import PointSky, points_of
from instrument.units import Bool, Complex, Int, Jansky, Seconds, to_si
from instrument.visibilities import Visibilities

Models = dict[str, Visibilities]
ONE_TOLERANCE = 1e-5  # one direction for all is wrong by percents: no need to wait for what the model hardly sees


class ManyDirections(Component):
    """Puts matrices of its own on every cluster of a sky, solves for all of them at once, and measures what is left.

    The `clusters` brightest sources are the centres (a patch counts as one), every other source belongs to the nearest.
    Matrices are 1 + full errors of rms `rms` per element that turn over once in `period`, drawn from `seed`; those of
    the instrument come on top. `sefd` adds noise. For comparison one direction is solved with `SelfCal`, same interval.
    """

    clusters: Annotated[int, Field(ge=1, le=100)] = 5
    rms: Annotated[float, Field(ge=0, lt=1)] = 0.1
    period: Annotated[Seconds, Field(gt=0)] = 3600.0
    calibrator: DirectionalCal = DirectionalCal(interval="60 s", tolerance=1e-6)
    sefd: Annotated[Jansky, Field(gt=0)] | None = None
    seed: Annotated[int, Field(ge=0)] = 0

    def run(self, plan: Plan, progress: Callable[[float], None] | None = None) -> ManyDirectionsResult:
        """Solve the scene of a plan (made without `uv_range`: solves need all baselines) in blocks of times.

        `progress` is called with the fraction done. Raises `InputError` where the sky is no list of sources, or has
        fewer than `clusters`.
        """
        sky = points_of(plan.problem.sky)
        if sky is None:
            raise InputError(f"clusters need a list of sources, not {type(plan.problem.sky).__name__}")
        job = _Job(self, plan, sky, cluster_of(sky, self.clusters))
        for done, models in job.blocks():
            job.add(models)
            if progress is not None:
                progress(done)
        return job.finish()

    def errors(self, cluster: int, at: Sampling, start_s: float) -> JonesTable:
        """The matrices put on a cluster at the times of a sampling, in an observation that begins at `start_s`."""
        drawn = np.random.default_rng([self.seed, cluster]).normal(size=(2, len(at.layout), 2, 2, 2))
        a, b = self.rms / np.sqrt(2) * drawn.view(complex)[..., 0]
        phase = 2 * np.pi * (at.slots_s - start_s)[:, None, None, None] / self.period
        turned = np.eye(2) + a * np.cos(phase) + b * np.sin(phase)
        return JonesTable(values=turned[:, None], slots_s=at.slots_s, freq_hz=at.freq_hz[:1])


def cluster_of(sky: PointSky, count: int) -> Int:
    """The cluster of every source (S,), from 0 for that of the brightest; a patch goes where its middle goes."""
    rank = ranks(sky)
    if count > rank.max() + 1:
        raise InputError(f"clusters = {count}, but the sky has {int(rank.max()) + 1} sources")
    middle = np.stack([np.bincount(rank, sky.power_jy * x) for x in sky.vectors.T], axis=1)
    length = np.linalg.norm(middle, axis=1, keepdims=True)
    if not np.all(length[:count] > 0):
        raise InputError(f"clusters = {count}, but the sky has {int((length > 0).sum())} sources with flux")
    towards = middle / np.where(length > 0, length, 1.0)
    return np.asarray(np.argmax(towards @ towards[:count].T, axis=1)[rank])


class _Job:
    """One run: the clusters, what is predicted of them, and all sums."""

    def __init__(self, settings: ManyDirections, plan: Plan, sky: PointSky, cluster: Int) -> None:
        self.settings, self.plan, self.sky = settings, plan, sky
        chain, rank = plan.problem.chain, ranks(sky)
        self.beams = chain.beams()
        self.gains = Chain(*chain.terms[: len(chain.terms) - len(self.beams.terms)])
        first = [int(np.flatnonzero(rank == k)[0]) for k in range(settings.clusters)]
        names = [(sky.patches and sky.patches[i]) or sky.names[i] for i in first]
        self.names = names if len(set(names)) == len(names) else [f"cluster {k + 1}" for k in range(len(names))]
        cal = settings.calibrator
        for name in cal.intervals:
            if name not in self.names:
                raise InputError(f"intervals names '{name}', which no cluster is: {did_you_mean(name, self.names)}")
        shared = ("pattern", "interval", "channels", "min_baseline", "unexplained", "start")
        settled = max(cal.tolerance, ONE_TOLERANCE)
        self.selfcal = SelfCal(**{k: v for k, v in cal.to_dict().items() if k in shared}, tolerance=settled)
        times = plan.problem.shape[0]
        seconds = [to_si(cal.intervals[n], "s") if n in cal.intervals else cal.interval for n in self.names]
        every = [1 if s is None else max(1, round(s / plan.problem.interval_s)) for s in (*seconds, cal.interval)]
        self.steps = [min(step, times) for step in every[:-1]]
        self.whole = min(times, math.lcm(*every))  # integrations after which all intervals begin anew
        rows = [np.flatnonzero(cluster == k) for k in range(len(names))]
        self.sources = np.array([len(np.unique(rank[r])) for r in rows])
        self.flux_jy = np.array([sky.power_jy[r].sum() for r in rows])
        self.plans = [self._part(r) for r in rows]
        self.powers: dict[str, float] = {}  # sums of |x|^2, and over which visibilities
        self.kinds: dict[str, str] = {}
        self.outcomes: Counter[Outcome] = Counter()  # of intervals that failed
        self.samples = dict.fromkeys(("all", "many", "one"), 0)
        self.unknowns = 0
        # of each cluster, and of one direction for all: intervals and those that failed; |error|^2 and elements
        self.solved, self.errors = np.zeros((len(names) + 1, 2)), np.zeros((len(names), 2))
        self.apart = np.zeros((2, 2, len(names)))  # with many directions and with one: sums of |x|^2, and how many

    @property
    def slots(self) -> int:
        """Integrations of a block: whole solution intervals, as many as memory allows and workers can use."""
        times, channels, baselines = self.plan.problem.shape
        room = BLOCK_BYTES / (64.0 * channels * baselines * self.whole * len(self.names))
        return min(times, self.whole * int(max(1, min(room, 4 * self.plan.workers))))

    def _part(self, rows: Int) -> Plan:
        """The plan of some sources, seen through the beams only, in blocks that fit those of the run."""
        whole, part = self.plan.problem, self.sky.select(rows)
        problem = replace(whole, chain=self.beams, sky=part, at=whole.at.towards(*part.directions()))
        times = max(d for d in range(1, self.slots + 1) if self.slots % d == 0 and d <= self.plan.block_shape[0])
        return replace(self.plan, full=problem, problem=problem, block_shape=(times, self.plan.block_shape[1]))

    def blocks(self) -> Iterator[tuple[float, Models]]:
        """Fraction done, and what is predicted of every cluster in a block."""
        times, channels, _ = self.plan.problem.shape
        with ThreadPoolExecutor(self.plan.workers) as pool:
            streams = [(p.block_shape, p.blocks(pool)) for p in self.plans]
            for begin in range(0, times, self.slots):
                end = min(begin + self.slots, times)
                problem = self.plan.problem.block(slice(begin, end), slice(None))
                models = {}
                for name, ((nt, nf), parts) in zip(self.names, streams, strict=True):
                    data = np.zeros((*problem.shape, 2, 2), complex)
                    for t in range(0, end - begin, nt):
                        for f in range(0, channels, nf):
                            data[t : t + nt, f : f + nf] = next(parts).data
                    models[name] = Visibilities(
                        data=data, at=problem.at.at_centre(), antenna1=problem.antenna1, antenna2=problem.antenna2,
                        interval_s=problem.interval_s, width_hz=problem.width_hz,
                    )  # fmt: skip
                yield end / times, models

    def add(self, models: Models) -> None:
        """Solve a block, and add what comes out."""
        from astropy import units as u

        settings = self.settings
        start_s = float(self.plan.problem.at.slots_s[0])
        first = models[self.names[0]]
        terms = {name: settings.errors(k, first.at, start_s) for k, name in enumerate(self.names)}
        clean = first.with_data(np.sum([m.corrupted(terms[name]).data for name, m in models.items()], axis=0))
        clean = clean.corrupted(self.gains) if self.gains.terms else clean
        data = clean if settings.sefd is None else clean.with_noise(settings.sefd * u.Jy, settings.seed)
        solution = settings.calibrator.solve(data, models)
        steady = np.zeros_like(clean.data)  # with the true means over intervals: what a perfect solution predicts
        for k, name in enumerate(self.names):
            own = solution[name]
            true = terms[name].jones(first.at)[:, :, :, 0]
            if self.gains.terms:
                true = mat2.mul(self.gains.jones(first.at)[:, :, :, 0], true)
            held = _means(true, self.steps[k], 0)
            if held.shape[1] > 1:
                held = _means(held, settings.calibrator.channels, 1)
            held = np.broadcast_to(held, own.jones.shape)
            steady += models[name].corrupted(own.term.with_fields(values=held)).data
            wrong = np.abs(own.aligned(held).jones - held) ** 2
            good = np.isfinite(wrong)
            self.errors[k] += wrong[good].sum(), good.sum()
            self.outcomes.update(o for o in own.outcome.ravel() if o is not Outcome.CONVERGED)
            self.solved[k] += own.outcome.size, (own.outcome != Outcome.CONVERGED).sum()
            self.unknowns += own.converged.sum() * (
                UNKNOWNS[settings.calibrator.pattern] * len(first.layout) - own.gauge.count
            )
        left = solution.subtracted(data, models)
        use = np.broadcast_to(~left.flag, left.data.shape[:3])
        noise = data.data - clean.data
        self._sum("all", np.ones_like(use), {"data": data.data, "noise": noise})
        self._sum("many", use, {"turning": clean.data - steady, "left": left.data, "wrong": left.data - noise})
        model = first.with_data(np.sum([m.data for m in models.values()], axis=0))
        one = self.selfcal.solve(data, model)
        single = model.corrupted(one.term).data
        use = np.asarray(np.isfinite(single).all(axis=(-2, -1)))
        self._sum("one", use, {"one_left": data.data - single, "one_wrong": clean.data - single})
        self.solved[-1] += one.outcome.size, (one.outcome != Outcome.CONVERGED).sum()
        for k, (name, whole) in enumerate(models.items()):
            some = whole.block(slice(self.steps[k] // 2, None, self.steps[k]), slice(None))  # one of each interval
            seen = some.corrupted(terms[name])
            seen = seen.corrupted(self.gains) if self.gains.terms else seen
            for j, term in enumerate((solution[name].term, one.term)):
                gap = np.abs(seen.data - some.corrupted(term).data) ** 2
                good = np.isfinite(gap)
                self.apart[j, :, k] += gap[good].sum(), good.sum()

    def _sum(self, kind: str, use: Bool, parts: dict[str, Complex]) -> None:
        self.samples[kind] += 4 * int(use.sum())
        for name, part in parts.items():
            self.kinds[name] = kind
            self.powers[name] = self.powers.get(name, 0.0) + float((np.abs(part[use]) ** 2).sum())

    def finish(self) -> ManyDirectionsResult:
        """What was measured."""
        power = {name: value / (self.samples[self.kinds[name]] or np.nan) for name, value in self.powers.items()}
        taken = min(1.0, self.unknowns / max(2 * self.samples["many"], 1))
        power["due"] = power["noise"] * (1 - taken) + power.pop("turning")
        with np.errstate(divide="ignore", invalid="ignore"):
            error = np.sqrt(self.errors[:, 0] / self.errors[:, 1])
            apart = np.sqrt(self.apart[:, 0] / self.apart[:, 1])
        failed = self.solved[:, 1] / self.solved[:, 0]
        return ManyDirectionsResult(
            names=tuple(self.names), sources=self.sources, flux_jy=self.flux_jy, error=error, failed=failed[:-1],
            one_failed=float(failed[-1]), failures=tuple(f"{n} {o.value}" for o, n in self.outcomes.most_common()),
            apart_jy=apart, **{f"{name}_jy": float(np.sqrt(value)) for name, value in power.items()},
        )  # fmt: skip


def _means(values: Complex, step: int, axis: int) -> Complex:
    """Means over runs of `step` entries along an axis; the last may be short."""
    starts = np.arange(0, values.shape[axis], step)
    count = np.diff([*starts, values.shape[axis]])
    shape = [-1 if k == axis else 1 for k in range(values.ndim)]
    return np.asarray(np.add.reduceat(values, starts, axis=axis) / count.reshape(shape))
