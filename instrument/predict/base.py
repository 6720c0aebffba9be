"""Predictor: an engine that turns a problem (a block of a scene) into visibilities; Prepared: one made ready."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import partial
from typing import ClassVar, NamedTuple

import numpy as np

from instrument import mat2
from instrument.checked import checked
from instrument.component import Component
from instrument.jones.chain import Chain
from instrument.observe.sampling import Sampling
from instrument.shown import short_repr
from instrument.sky.base import PlacedSky
from instrument.units import Bool, Complex, Int
from instrument.visibilities import BeamState, Visibilities

EVERY = slice(None)
CHUNK = 4096  # directions summed at once, where a sky has more


class Work(NamedTuple):
    """What a problem costs: floating point operations, bytes, and an estimate of seconds on one core.

    `shared_bytes` are held once, however many workers there are; `slot_bytes` by each worker, for the problem as one
    block.
    """

    flops: float
    shared_bytes: float
    slot_bytes: float
    seconds: float


@dataclass(frozen=True)
class Problem:
    """What an engine is given: where and when (`at`), the chain, the sky, baselines.

    `at` is towards the outline of the sky: all its directions, or a coarse grid of those of an image.
    """

    __repr__ = short_repr
    at: Sampling
    chain: Chain
    sky: PlacedSky
    antenna1: Int
    antenna2: Int
    interval_s: float
    width_hz: float | None = None
    uv_range: tuple[float, float] | None = None  # wavelengths: what lies outside is not asked for

    def block(self, times: slice, channels: slice) -> Problem:
        """The same for some times and channels."""
        return replace(self, at=self.at.block(times, channels))

    def between(self, antenna1: Int, antenna2: Int) -> Problem:
        """The same for some baselines."""
        return replace(self, antenna1=np.asarray(antenna1), antenna2=np.asarray(antenna2))

    def parts(self, most: int = CHUNK) -> Iterator[Problem]:
        """The same in pieces of at most so many directions each, whose sums add up; each towards all of its own."""
        if self.sky.kind not in ("image", "sum") and (self.sky.count <= most or self.at.seen is not None):
            yield self
            return
        for sky in self.sky.parts(most, self.at.freq_hz):
            yield replace(self, sky=sky, at=self.at.towards(*sky.directions()))

    def of(self, sky: PlacedSky) -> Problem:
        """The same of another sky."""
        return replace(self, sky=sky, at=self.at.towards(*sky.outline()))

    def members(self) -> dict[str, Problem]:
        """One for each member of a sum of skies, by its name; itself, without a name, where the sky is none."""
        if self.sky.kind != "sum":
            return {"": self}
        return {name: self.of(sky) for name, sky in self.sky.members().items()}

    def visibilities(self, data: Complex) -> Visibilities:
        """Data (T, F, B, 2, 2) with the coordinates of the problem."""
        return Visibilities(
            data=data,
            at=self.at.at_centre(),
            antenna1=self.antenna1,
            antenna2=self.antenna2,
            interval_s=self.interval_s,
            width_hz=self.width_hz,
            beam_state=BeamState(beams=self.chain.beams()),
        )

    @property
    def shape(self) -> tuple[int, int, int]:
        """(T, F, B)."""
        return self.at.shape[0], self.at.shape[1], len(self.antenna1)


@checked
class Predictor(Component):
    """An engine: says what it refuses and what a problem costs, and computes V_ab = sum_s J_a B J_b^H K_ab.

    One that keeps nothing between blocks gives `sums`; one that does gives `prepare`.
    """

    plugin_kind: ClassVar[str | None] = "engines"

    def refuses(self, problem: Problem) -> str | None:
        """Why this engine cannot serve a problem; `None` when it can."""
        return None

    def skips(self, problem: Problem) -> str | None:
        """Why it need not be tried where no engine is named: to ask it takes longer than it could save."""
        return None

    def prepare(self, problem: Problem, tolerance: float) -> Prepared:
        """The engine made ready for a whole problem, which it may approximate with an error of at most `tolerance`.

        Decides, and leaves what is large to the first sums: most plans are only read. Raises `RefusedError` where the
        tolerance cannot be kept. An engine without state is ready as it is.
        """
        return Blockwise(self, problem)

    @abstractmethod
    def work(self, problem: Problem) -> Work:
        """Cost of a problem, done as one block."""

    def sums(self, problem: Problem) -> Complex:
        """Visibilities in Jy, complex (T, F, B, 2, 2), of an engine without state: blocks may be cut anywhere."""
        raise NotImplementedError(f"{type(self).__name__} has neither sums nor a prepare of its own")


@dataclass(frozen=True)
class Prepared(ABC):
    """An engine ready for one problem, with the `bound` on its own error (relative to the total flux) and its `atom`.

    Sums are asked for whole atoms, from many threads at once: slices of times and channels that begin and end at
    multiples of `atom` (times, channels), or end where the problem does. `work` is the cost of such a block.
    """

    engine: Predictor
    problem: Problem
    bound: float = 0.0
    atom: tuple[int, int] = (1, 1)
    omission: tuple[str, str] = ("", "")  # what the bound is of, and how it is left out, for a plan to say

    @property
    def lines(self) -> tuple[tuple[str, str, float], ...]:
        """What else a plan says is kept: a thing, how, and the part of the bound that is its; of many engines, each."""
        return ()

    @abstractmethod
    def sums(self, times: slice, channels: slice, pairs: tuple[Int, Int] | None = None) -> Complex:
        """Visibilities in Jy, complex (T, F, B, 2, 2), of some times and channels, on `pairs` of antennas or on all."""

    def work(self, times: slice = EVERY, channels: slice = EVERY) -> Work:
        """Cost of some times and channels, as one block; `shared_bytes` are of what was prepared."""
        return self.engine.work(self.block(times, channels))

    def block(self, times: slice, channels: slice, pairs: tuple[Int, Int] | None = None) -> Problem:
        """Some times and channels of the problem, on all baselines or on some."""
        found = self.problem.block(times, channels)
        return found if pairs is None else found.between(*pairs)

    def left_out(self, times: slice, channels: slice) -> Bool | None:
        """Which visibilities of a block it leaves out, as the uv range of the problem allows, (T, F, B); or none."""
        return None

    def predict(self, times: slice, channels: slice) -> Visibilities:
        """The sums of a block with their coordinates; those that are left out are 0 and flagged."""
        data, out = self.sums(times, channels), self.left_out(times, channels)
        if out is not None:
            data[out] = 0
        found = self.block(times, channels).visibilities(data)
        return found if out is None else replace(found, flag=out)

    def task(self, times: slice, channels: slice) -> Callable[[], Visibilities]:
        """`predict` of a block for a worker: all that goes to another process, if that is where the worker is."""
        return partial(self.predict, times, channels)


class Blockwise(Prepared):
    """An engine without state, as it is: every block is a problem of its own, and travels alone."""

    def sums(self, times: slice, channels: slice, pairs: tuple[Int, Int] | None = None) -> Complex:
        """Visibilities in Jy, complex (T, F, B, 2, 2)."""
        given = self.block(times, channels, pairs)
        turned = given.antenna1 > given.antenna2
        if not turned.any():
            return self.summed(given)
        # V_ba is V_ab^H to the last bit: the order of products is that of one of them
        a, b = (pick(given.antenna1, given.antenna2) for pick in (np.minimum, np.maximum))
        out = self.summed(given.between(a, b))
        out[:, :, turned] = mat2.herm(out[:, :, turned])
        return out

    def summed(self, given: Problem) -> Complex:
        """Visibilities in Jy, complex (T, F, B, 2, 2), of a block."""
        return self.engine.sums(given)

    def task(self, times: slice, channels: slice) -> Callable[[], Visibilities]:
        """The engine and the block alone."""
        return partial(replace(self, problem=self.block(times, channels)).predict, EVERY, EVERY)
