"""Predictor: an engine that turns a problem (a block of a scene) into visibilities."""

from __future__ import annotations

from abc import abstractmethod
from dataclasses import dataclass, replace
from typing import ClassVar, NamedTuple

import numpy as np

from instrument.checked import checked
from instrument.component import Component
from instrument.jones.chain import Chain
from instrument.observe.sampling import Sampling
from instrument.sky.base import Sky
from instrument.units import Complex, Int
from instrument.visibilities import BeamState, Visibilities


class Work(NamedTuple):
    """What a problem costs: floating point operations, bytes held at once, and an estimate of seconds on one core."""

    flops: float
    bytes: float
    seconds: float


class Prepared(NamedTuple):
    """An engine as it will be run on a problem, and a bound on its own error, relative to the total flux."""

    engine: Predictor
    bound: float = 0.0


@dataclass(frozen=True)
class Problem:
    """What an engine is given: where and when (`at`, with the directions of the sky), the chain, the sky, baselines."""

    at: Sampling
    chain: Chain
    sky: Sky
    antenna1: Int
    antenna2: Int
    interval_s: float
    width_hz: float | None = None

    def block(self, times: slice, channels: slice) -> Problem:
        """The same for some times and channels."""
        return replace(self, at=self.at.block(times, channels))

    def between(self, antenna1: Int, antenna2: Int) -> Problem:
        """The same for some baselines."""
        return replace(self, antenna1=np.asarray(antenna1), antenna2=np.asarray(antenna2))

    @property
    def shape(self) -> tuple[int, int, int]:
        """(T, F, B)."""
        return self.at.shape[0], self.at.shape[1], len(self.antenna1)


@checked
class Predictor(Component):
    """An engine: says what it refuses and what a problem costs, and computes V_ab = sum_s J_a B J_b^H K_ab."""

    plugin_kind: ClassVar[str | None] = "engines"

    def refuses(self, problem: Problem) -> str | None:
        """Why this engine cannot serve a problem; `None` when it can."""
        return None

    def prepare(self, problem: Problem, tolerance: float) -> Prepared:
        """The engine for a whole problem, which it may approximate with an error of at most `tolerance`.

        An exact engine is ready as it is. Blocks of the problem, of any times and channels, are then asked of `sums`.
        """
        return Prepared(self)

    @abstractmethod
    def work(self, problem: Problem) -> Work:
        """Cost of a problem; the bytes are those of one block held at once."""

    @abstractmethod
    def sums(self, problem: Problem) -> Complex:
        """Visibilities in Jy, complex (T, F, B, 2, 2)."""

    def predict(self, problem: Problem) -> Visibilities:
        """The same with their coordinates."""
        return Visibilities(
            data=self.sums(problem),
            at=problem.at.at_centre(),
            antenna1=problem.antenna1,
            antenna2=problem.antenna2,
            interval_s=problem.interval_s,
            width_hz=problem.width_hz,
            beam_state=BeamState(beams=problem.chain.beams()),
        )
