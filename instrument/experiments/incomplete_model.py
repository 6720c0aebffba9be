"""IncompleteModel: what calibrating on too few sources does to all of them; a sweep over the size of the model.

The sky is predicted once, in shells of sources between one model and the next: their partial sums are the models, their
sum is the data, so a complete model is exact. What is measured is the difference between the data corrected with the
solution and the data corrected with the truth: zero for a perfect calibration, and free of the gauge where the sky is
unpolarized.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Annotated

import numpy as np
from pydantic import Field, field_validator

from instrument.analyze.sources.offsets import OffsetSums
from instrument.calibrate.base import Solution
from instrument.calibrate.selfcal import SelfCal
from instrument.checked import checked
from instrument.component import Component
from instrument.errors import InputError, Outcome
from instrument.experiments.incomplete_model_result import Sweep, find_ghosts, ranks
from instrument.image.cube import StokesCube
from instrument.image.dirty import Imager, Images
from instrument.jones.chain import Chain
from instrument.jones.towards import Towards
from instrument.observe.sampling import Sampling
from instrument.plan import Plan
from instrument.planner import BLOCK_BYTES
from instrument.predict.base import Problem
from instrument.sky.points import PointSky, points_of
from instrument.units import Complex, Int, Jansky, Seed
from instrument.visibilities import Visibilities

SOLVED_TOGETHER = 16  # solutions of a block for each worker: the vector lanes of SelfCal


@checked
class IncompleteModel(Component):
    """Calibrates on the n brightest sources for every n of `models`, and measures what that does to the sky.

    A patch counts as one source. Data are predicted with all terms of the chain, models with its beams only. Images
    are made when `image` is given. Flux and position errors are those of `watched` sources: the `bright` brightest and
    the others spread evenly in the logarithm of their rank; `every` takes each n-th integration for them, `uv_range`
    (wavelengths) some baselines. `sefd` adds noise to the data.
    """

    models: tuple[int, ...]
    selfcal: SelfCal = SelfCal(tolerance=1e-5)  # an incomplete model changes the data by 1e-4 and more
    image: Imager | None = None
    watched: Annotated[int, Field(ge=1, le=3000)] = 300
    bright: Annotated[int, Field(ge=1)] = 50
    uv_range: tuple[float, float] | None = None
    every: Annotated[int, Field(ge=1)] = 1
    sefd: Jansky | None = None
    seed: Seed = 0

    @field_validator("models")
    @classmethod
    def _ascending(cls, value: tuple[int, ...]) -> tuple[int, ...]:
        if not value or min(value) < 1 or sorted(set(value)) != list(value):
            raise InputError(f"models = {list(value)} must be numbers of sources from 1 up, each once, ascending")
        return value

    def run(self, plan: Plan, progress: Callable[[float], None] | None = None) -> Sweep:
        """Sweep over the models on the scene of a plan (made without `uv_range`: solves need all baselines), in blocks.

        `progress` is called with the fraction done. Raises `InputError` where the sky is no list of sources, or has
        fewer than a model asks for.
        """
        sky = points_of(plan.problem.sky)
        if sky is None:
            raise InputError(
                f"a model of the n brightest needs a list of sources, not {type(plan.problem.sky).__name__}"
            )
        rank = ranks(sky)
        count = int(rank.max()) + 1
        if self.models[-1] > count:
            raise InputError(f"models = {list(self.models)}, but the sky has {count} sources")
        job = _Job(self, plan, sky, rank)
        for done, problem, shells in job.blocks():
            job.add(problem, shells)
            if progress is not None:
                progress(done)
        return job.finish()

    def watch(self, count: int) -> Int:
        """Ranks, from 0, of the sources that are measured, of `count`."""
        wanted = min(self.watched, count)
        head = min(self.bright, wanted)
        steps = np.arange(wanted - head)
        tail = np.geomspace(head + 1, count, len(steps)).round().astype(int) - 1
        # where several fall on one rank they move on to the next free ones
        tail = np.minimum(np.maximum.accumulate(tail - steps) + steps, count - len(steps) + steps)
        return np.concatenate([np.arange(head), tail])


@dataclass
class _Sums:
    """What is summed for one model."""

    power: float = 0.0  # |corrected - truth|^2, weighted
    truth: float = 0.0  # |truth|^2 over the same visibilities
    used: float = 0.0  # weight of them
    failed: int = 0
    solved: int = 0
    iterations: int = 0


class _Job:
    """One sweep: shells of the sky, what is predicted of them, and all sums."""

    def __init__(self, settings: IncompleteModel, plan: Plan, sky: PointSky, rank: Int) -> None:
        self.settings, self.plan, self.sky, self.rank = settings, plan, sky, rank
        chain = plan.problem.chain
        self.beams = chain.beams()
        self.gains = Chain(*chain.terms[: len(chain.terms) - len(self.beams.terms)])
        edges = (0, *settings.models, int(rank.max()) + 1)
        shells = [np.flatnonzero((rank >= a) & (rank < b)) for a, b in pairwise(edges)]
        watched = settings.watch(int(rank.max()) + 1)
        rows = np.flatnonzero(np.isin(rank, watched))
        rows = rows[np.argsort(rank[rows], kind="stable")]
        self.watched, self.rows = watched, rows
        self.plans = [self._part(s) if len(s) else None for s in (*shells, rows)]
        self.offsets = OffsetSums(sky.select(rows), np.searchsorted(watched, rank[rows]), settings.uv_range)
        self.sums = [_Sums() for _ in settings.models]
        self.images: list[Images] = (
            [settings.image.start() for _ in range(len(self.sums) + 1)] if settings.image else []
        )
        self.seen = 0

    @property
    def step(self) -> int:
        """Integrations of a solution."""
        interval = self.settings.selfcal.interval
        return 1 if interval is None else max(1, round(interval / self.plan.problem.interval_s))

    @property
    def slots(self) -> int:
        """Integrations of a block: whole solution intervals, as many as memory and the solver like."""
        times, channels, baselines = self.plan.problem.shape
        room = BLOCK_BYTES / (64.0 * channels * baselines * self.step)
        return min(times, self.step * int(max(1, min(room, SOLVED_TOGETHER * self.plan.workers))))

    def _part(self, rows: Int) -> Plan:
        """The plan of some sources, seen through the beams only, in blocks that fit those of the sweep."""
        whole = self.plan.problem
        part = self.sky.select(rows)
        problem = replace(whole, chain=self.beams, sky=part, at=whole.at.towards(*part.directions()))
        times = max(d for d in range(1, self.slots + 1) if self.slots % d == 0 and d <= self.plan.block_shape[0])
        return replace(self.plan, full=problem, problem=problem, block_shape=(times, self.plan.block_shape[1]))

    def blocks(self) -> Iterator[tuple[float, Problem, list[Complex]]]:
        """Fraction done, coordinates of a block, and what is predicted of the shells in it, (T, F, B, 2, 2) each."""
        times, channels, _ = self.plan.problem.shape
        with ThreadPoolExecutor(self.plan.workers) as pool:
            streams = [None if p is None else (p.block_shape, p.blocks(pool)) for p in self.plans]
            for begin in range(0, times, self.slots):
                end = min(begin + self.slots, times)
                problem = self.plan.problem.block(slice(begin, end), slice(None))
                shells = []
                for stream in streams:
                    data = np.zeros((*problem.shape, 2, 2), complex)
                    if stream is not None:
                        (nt, nf), parts = stream
                        for t in range(0, end - begin, nt):
                            for f in range(0, channels, nf):
                                data[t : t + nt, f : f + nf] = next(parts).data
                    shells.append(data)
                yield end / times, problem, shells

    def add(self, problem: Problem, shells: list[Complex]) -> None:
        """Calibrate a block on every model, and add what comes out."""
        *shells, watched = shells
        sky = Visibilities(
            data=np.sum(shells, axis=0),
            at=problem.at.at_centre(),
            antenna1=problem.antenna1,
            antenna2=problem.antenna2,
            interval_s=problem.interval_s,
            width_hz=problem.width_hz,
        )
        data = sky.corrupted(self.gains) if self.gains.terms else sky
        if self.settings.sefd is not None:
            from astropy import units as u

            data = data.with_noise(self.settings.sefd * u.Jy, self.settings.seed)
        truth = self._seen(data.corrected(self.gains) if self.gains.terms else data)
        chosen = slice(-self.seen % self.settings.every, None, self.settings.every)
        self.seen += len(sky.data)
        if self.images:
            self.images[-1].add(truth)
        columns = [self._seen(sky.with_data(watched)).stokes()[..., 0]]
        model = np.zeros_like(sky.data)
        for k, shell in enumerate(shells[:-1]):
            model = model + shell
            solution = self._aligned(self.settings.selfcal.solve(data, sky.with_data(model)), data.at)
            change = self._seen(data.corrected(solution.term)) - truth
            self._count(self.sums[k], change, truth, solution)
            if self.images:
                self.images[k].add(change)
            good = change.effective_weight > 0
            columns.append(np.where(good, change.stokes()[..., 0], 0.0))
        self.offsets.add(_chosen(truth, chosen), np.stack(columns)[:, chosen])

    def _seen(self, visibilities: Visibilities) -> Visibilities:
        """With the beam towards the phase centre taken out."""
        return visibilities.corrected(Towards(chain=self.beams)) if self.beams.terms else visibilities

    def _aligned(self, solution: Solution, at: Sampling) -> Solution:
        """The gauge of the model turned to the truth: what no data can tell is not counted as an error."""
        at = replace(at, earth=at.earth[:: self.step], slots_s=solution.term.slots_s, freq_hz=solution.term.freq_hz)
        true = self.gains.jones(at)[:, :, :, 0]
        return solution.aligned(to=np.broadcast_to(true, solution.jones.shape))

    def _count(self, sums: _Sums, change: Visibilities, truth: Visibilities, solution: Solution) -> None:
        weight = change.effective_weight[..., None, None]
        good = weight > 0
        sums.power += float((weight * np.abs(np.where(good, change.data, 0.0)) ** 2).sum())
        sums.truth += float((weight * np.abs(np.where(good, truth.data, 0.0)) ** 2).sum())
        sums.used += float(np.count_nonzero(good)) / max(good.size, 1) * len(change.data)
        sums.failed += int((solution.outcome != Outcome.CONVERGED).sum())
        sums.solved += solution.outcome.size
        sums.iterations += int(solution.iterations.sum())

    def finish(self) -> Sweep:
        """What was measured."""
        sums, settings = self.sums, self.settings
        flux, moved, _ = self.offsets.finish()
        # intervals that failed count as unchanged in the sums: make up for their share
        lived = np.array([s.used / self.seen if s.used else np.nan for s in sums])
        with np.errstate(divide="ignore", invalid="ignore"):
            change = flux[1:] / lived[:, None]
            shift = moved[1:] / lived[:, None, None] / flux[0][:, None]
        first = self.rows[np.flatnonzero(np.diff(self.rank[self.rows], prepend=-1))]
        power = np.asarray(np.bincount(self.rank, self.sky.power_jy), float)
        cubes = self._cubes()
        names = tuple((self.sky.patches and self.sky.patches[i]) or self.sky.names[i] for i in first)
        return Sweep(
            models=settings.models,
            sources=len(power),
            bright=settings.bright,
            flux_share=np.cumsum(power)[np.array(settings.models) - 1] / power.sum(),
            failed=np.array([s.failed / s.solved for s in sums]),
            iterations=np.array([s.iterations / s.solved for s in sums]),
            visibility_share=np.array([np.sqrt(s.power / s.truth) if s.truth else np.nan for s in sums]),
            names=names,
            rank=self.watched + 1,
            ra_rad=self.sky.ra_rad[first],
            dec_rad=self.sky.dec_rad[first],
            model_jy=power[self.watched],
            flux_jy=flux[0],
            change_jy=change,
            shift_rad=shift,
            reference=cubes[-1] if cubes else None,
            residuals=tuple(cubes[:-1]),
            ghosts=tuple(find_ghosts(cube, self.sky) for cube in cubes[:-1]),
        )

    def _cubes(self) -> list[StokesCube]:
        """Residual images of all models and the true image; NaN where every interval failed."""
        if not self.images:
            return []
        from astropy import units as u

        truth = self.images[-1].finish()
        nothing = StokesCube(
            data=np.full_like(truth.data, np.nan),
            frequencies=truth.freq_hz * u.Hz,
            pixel=truth.pixel_rad * u.rad,
            unit=truth.unit,
            centre=truth.centre,
            psf=truth.psf,
        )
        return [i.finish() if s.used else nothing for i, s in zip(self.images, self.sums, strict=False)] + [truth]


def _chosen(block: Visibilities, times: slice) -> Visibilities:
    """Some of the integrations."""
    return block.block(times, slice(None))
