"""Plan: what a scene will compute, what it leaves out and with what bound, by which engine, and how to run it."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Executor, Future, ThreadPoolExecutor
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np

from instrument.check import BY_STATIONS, DEFINITION, SHARE, Check, Checker, not_checked, watch
from instrument.checked import checked
from instrument.errors import InputError, RefusedError
from instrument.machine import speed
from instrument.observe.grid import ImageGrid
from instrument.predict.base import Predictor, Prepared, Problem, Work
from instrument.predict.direct import Direct
from instrument.predict.operator import ImageOperator
from instrument.predict.threads import alone, look_again
from instrument.shown import short_repr
from instrument.units import si_prefix
from instrument.visibilities import BeamState, Visibilities, VisibilitySet
from instrument.visibility_sets import as_set


class Item(NamedTuple):
    """One line of a plan: a thing, what happens to it and why, and the bound on the error of leaving it out."""

    name: str
    reason: str
    bound: float = 0.0

    def of(self, member: str) -> Item:
        """The same of a member of a sum of skies, by its name."""
        return self._replace(name=f"{member}: {self.name}") if member else self


@checked
@dataclass(frozen=True)
class Plan(VisibilitySet):
    """What will be done. Print it; `run` it at once or take `blocks` one by one; `verify` it against the definition."""

    __repr__ = short_repr
    name: str
    full: Problem  # as the scene has it: what `direct` would compute
    problem: Problem  # what is computed after the omissions
    kept: tuple[Item, ...]
    left_out: tuple[Item, ...]
    not_modelled: tuple[Item, ...]
    engine: Predictor
    engine_name: str
    engine_tolerance: float  # that the engine was prepared with
    refused: tuple[Item, ...]
    work: Work
    block_shape: tuple[int, int]
    workers: int
    memory: float
    limit: float
    tolerance: float
    bounds: tuple[Item, ...]
    scale_jy: float
    seconds: float = field(compare=False, default=0.0)  # on a machine of speed 1
    decade: Callable[[], str] = field(compare=False, repr=False, default=str)  # works `next_decade` out
    checker: Checker | None = field(compare=False, repr=False, default=None)  # sees the blocks as they pass

    @property
    def error_bound(self) -> float:
        """Sum of the bounds on all errors, relative to the total flux of the sky."""
        return self.sum_bound + sum(item.bound for item in self.not_modelled)

    @property
    def sum_bound(self) -> float:
        """That on what is computed against its definition, `direct` on the scene as given: what `verify` holds.

        What is not modelled is no part of it: the definition leaves it out as well.
        """
        return sum(item.bound for item in (*self.kept, *self.left_out, *self.bounds))

    @cached_property
    def ready(self) -> Prepared:
        """The engine made ready for the problem."""
        return self.engine.prepare(self.problem, self.engine_tolerance)

    @cached_property
    def next_decade(self) -> str:
        """What a tenth of the tolerance would cost, in words: for whoever asks, as its engine must be prepared."""
        return self.decade()

    @property
    def slices(self) -> list[tuple[slice, slice]]:
        """Times and channels of every block, in order of time."""
        times, channels, _ = self.problem.shape
        nt, nf = self.block_shape
        atom = self.ready.atom
        if (nt < times and nt % atom[0]) or (nf < channels and nf % atom[1]):
            raise InputError(f"block_shape = {self.block_shape}: {self.engine_name} takes multiples of {atom}")
        return [
            (slice(t, min(t + nt, times)), slice(f, min(f + nf, channels)))
            for t in range(0, times, nt)
            for f in range(0, channels, nf)
        ]

    def __str__(self) -> str:
        return self.told(True)

    def told(self, predicted: bool) -> str:
        """The lines of the plan; without those of a prediction where none is made."""
        times, channels, baselines = self.full.shape
        stations = self.full.at.shape[2]
        head = (
            f"scene {self.name}: {count_of(stations, 'station')}, {count_of(baselines, 'baseline')}, "
            f"{count_of(times, 'time')}, {count_of(channels, 'channel')} ({band_of(self.full)}), "
            + (f"{self.full.sky.size}, tolerance {self.tolerance:g}" if predicted else "no prediction")
        )
        lines = [head]
        lines += [f"kept          {i.name:<22} {i.reason}" for i in self.kept]
        lines += [f"left out      {i.name:<22} {i.reason:<46} error {i.bound:.2g}" for i in self.left_out]
        if not predicted:
            return "\n".join(lines)
        lines += [
            f"not modelled  {i.name:<22} {i.reason:<46}{f' error {i.bound:.2g}' if i.bound else ''}".rstrip()
            for i in self.not_modelled
        ]
        lines.append(
            f"engine        {self.engine_name:<22} {si_prefix(self.work.flops, 'Flop')}, "
            f"about {spell(self.seconds / speed())}, peak {si_prefix(self.memory, 'B')} "
            f"in {count_of(len(self.slices), 'block')}"
        )
        if self.next_decade:
            lines.append(f"a decade more {self.next_decade}")
        lines += [f"refused       {i.name:<22} {i.reason}" for i in self.refused]
        every = (*self.kept, *self.left_out, *self.bounds, *self.not_modelled)
        inside = ", ".join(f"{i.name} {i.bound:.1e}" for i in every if i.bound)
        above = ", ABOVE the tolerance" if 0 < self.tolerance < self.error_bound else ""
        lines.append(f"bound         {self.error_bound:.1e} of the total flux {self.scale_jy:.4g} Jy ({inside}){above}")
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
        data, flag = np.empty((times, channels, baselines, 2, 2), complex), np.zeros((1, 1, 1), bool)
        for (t, f), block in zip(self.slices, self.blocks(executor, progress), strict=True):
            data[t, f] = block.data
            if block.flag.any():
                flag = np.zeros(data.shape[:3], bool) if flag.size == 1 else flag
                flag[t, f] = block.flag
        return Visibilities(
            data=data,
            at=self.problem.at.at_centre(),
            antenna1=self.problem.antenna1,
            antenna2=self.problem.antenna2,
            interval_s=self.problem.interval_s,
            width_hz=self.problem.width_hz,
            flag=flag,
            beam_state=self._state,
        )

    @property
    def _state(self) -> BeamState:
        """What is known of the data: the beams of the scene as it was given, not as it was simplified."""
        return BeamState(beams=self.full.chain.beams())

    def blocks(
        self, executor: Executor | None = None, progress: Callable[[float], None] | None = None
    ) -> Iterator[Visibilities]:
        """Visibilities block by block, in order; memory does not grow with the length of the observation.

        `progress` is called with the fraction done after every block.
        """
        if executor is not None:
            yield from self._stream(executor, 2 * self.workers, progress)
            return
        with ThreadPoolExecutor(self.workers) as pool:
            yield from self._stream(pool, self.workers, progress)

    def _stream(
        self, executor: Executor, ahead: int, progress: Callable[[float], None] | None
    ) -> Iterator[Visibilities]:
        look_again()
        waiting: deque[Future[Visibilities]] = deque()
        todo, state = self.slices, self._state
        done = 0
        try:
            while todo or waiting:
                while todo and len(waiting) < ahead:
                    waiting.append(executor.submit(alone, self.ready.task(*todo.pop(0))))
                block = waiting.popleft().result()
                done += 1
                if self.checker is not None:
                    self.checker.see(block, self.full)
                if progress is not None:
                    progress(done / len(self.slices))
                yield replace(block, beam_state=state)
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

    def watched(self, samples: int = 64, seed: int = 0) -> Plan:
        """The same plan, whose blocks are checked as they pass by; `check` says what was found."""
        return self.changed(checker=self._checker(samples, seed))

    def changed(self, **fields: Any) -> Plan:
        """The same with other lines, or another checker: the engine stays ready as it is."""
        found = replace(self, **fields)
        if "ready" in vars(self):
            vars(found)["ready"] = self.ready
        return found

    @property
    def check(self) -> Check:
        """What the check of the blocks found so far."""
        if self.checker is not None:
            return self.checker.result()
        return not_checked("nobody looked at the blocks", self.sum_bound, self.scale_jy)

    def verify(
        self, vis: VisibilitySet | Iterable[Visibilities] | None = None, samples: int = 64, seed: int = 0
    ) -> Check:
        """Hold what was produced, `vis` (visibilities or blocks of them), against the definition of the scene as given.

        Times and channels at random, all their baselines: each once before any comes twice, as many as 4 % of
        the planned time buy, `samples` visibilities at least. Without `vis` the engine makes them anew, in whole atoms.
        Raises `InputError` for data of another scene, or from which a beam has been taken out.
        """
        checker = self._checker(samples, seed)
        if vis is not None:
            return watch(checker, as_set(vis).blocks())
        nt, nf = self.ready.atom
        times, channels, _ = self.problem.shape
        atoms = dict.fromkeys((t // nt * nt, f // nf * nf) for t, f in checker.chosen())
        cuts = ((slice(t, min(t + nt, times)), slice(f, min(f + nf, channels))) for t, f in atoms)
        return watch(checker, (alone(self.ready.predict, t, f) for t, f in cuts))

    def operator(self, grid: ImageGrid, tolerance: float = 1e-5) -> ImageOperator:
        """Images of a grid seen by these stations, times and channels through the beams of the scene, and its adjoint.

        What imagers take that correct for beams; gains and other errors of the receivers are no part of it, nor is a
        `BeamError`. The grid is about the phase centre unless it has one. Raises `RefusedError` where the tolerance
        cannot be kept.
        """
        from instrument.predict.gridded import image_operator

        key = grid.pixels, grid.pixel, grid.centre, tolerance
        if key not in self._operators:
            self._operators.clear()  # one is held: a run plans with it, and then works with it
            self._operators[key] = image_operator(self.problem, grid, tolerance)
        return self._operators[key]

    @cached_property
    def _operators(self) -> dict[Any, ImageOperator]:
        return {}

    def _checker(self, samples: int, seed: int) -> Checker:
        against = BY_STATIONS if isinstance(self.engine, Direct) else DEFINITION
        return Checker(self.full, self.scale_jy, self.sum_bound, SHARE * self.seconds, samples, seed, against)


def band_of(problem: Problem) -> str:
    """The band, edge to edge, or from centre to centre where no width is known: "149.905 to 150.095 MHz"."""
    half = (problem.width_hz or 0.0) / 2
    low, high = problem.at.freq_hz.min() - half, problem.at.freq_hz.max() + half
    return f"{_mhz(low)} MHz" if low == high else f"{_mhz(low)} to {_mhz(high)} MHz"


def _mhz(freq_hz: float) -> str:
    """To the nearest 100 Hz, without needless zeros."""
    return f"{freq_hz / 1e6:.4f}".rstrip("0").rstrip(".")


def count_of(n: int, what: str) -> str:
    """A number and what it counts, in the plural where due."""
    return f"{n} {what}" if n == 1 else f"{n} {what}s"


def spell(value: float) -> str:
    """Seconds as one reads them."""
    if value < 1:
        return "1 s"
    return f"{value:.0f} s" if value < 120 else f"{value / 60:.0f} min"
