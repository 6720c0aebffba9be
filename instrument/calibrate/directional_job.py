"""Blocks of a directional solve: which integrations share matrices, and what comes out of each as solutions."""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass, replace
from typing import Any, Protocol

import numpy as np

from instrument.calibrate.base import Solution, by_baseline, partly_known
from instrument.calibrate.chunk import SolveSettings
from instrument.calibrate.cluster_data import Block, Limits
from instrument.calibrate.clusters import Found, solved, suspects
from instrument.calibrate.gauge import GENERATORS, Gauge, gauge_of
from instrument.calibrate.reasons import ENOUGH, Asked, faint, noisy, told, unknown
from instrument.errors import InputError, Outcome
from instrument.jones.table import JonesTable
from instrument.units import Bool, Complex, Float, Int
from instrument.visibilities import Visibilities

EMPTY = "its model is zero wherever data count"


class BlockSettings(SolveSettings, Protocol):
    """What the blocks need to know of a solver."""

    @property
    def robust(self) -> float | None:
        """Degrees of freedom of Student's t."""

    @property
    def channels(self) -> int:
        """Of one solution."""


@dataclass(frozen=True)
class Grid:
    """Integrations counted on a regular grid (gaps count too), and the lengths of all that is made of them."""

    number: Int  # (T,) of the integration, from 0
    steps: list[int]  # integrations in the interval of each cluster
    whole: int  # in a block: all clusters begin a new interval with it
    piece: int  # in a piece: no cluster begins a new interval within it
    first_s: float
    interval_s: float

    @classmethod
    def of(cls, data: Visibilities, seconds: Iterable[float | None]) -> Grid:
        """The grid of some data, for the length of the interval of each cluster (None: an integration)."""
        slots = data.at.slots_s
        if np.any(np.diff(slots) <= 0) or np.any(np.diff(data.at.freq_hz) <= 0):
            raise InputError("a solve needs times and channels in ascending order")
        number = np.round((slots - slots[0]) / data.integration_s).astype(int)
        span = int(number[-1]) + 1
        steps = [1 if s is None else min(span, max(1, round(s / data.integration_s))) for s in seconds]
        return cls(number, steps, math.lcm(*steps), math.gcd(*steps), float(slots[0]), data.integration_s)

    @property
    def blocks(self) -> Int:
        """Numbers of the blocks that hold data."""
        return np.unique(self.number // self.whole)

    def known(self, cluster: int) -> Int:
        """Numbers of the intervals of a cluster that hold data."""
        return np.unique(self.number // self.steps[cluster])

    def centres_s(self, cluster: int) -> Float:
        """Centres of those intervals as if they were full: every integration is then nearest to its own."""
        step = self.steps[cluster]
        return np.asarray(self.first_s + (self.known(cluster) * step + (step - 1) / 2) * self.interval_s, float)


@dataclass
class Part:
    """What came out of one block of K unknown matrices a station and P pieces."""

    cell: tuple[int, int]
    found: Found
    outcome: list[Outcome]  # (K,)
    column: Int  # (P, C): the unknown that a cluster has in a piece
    pieces: Int  # (P, C): the interval of the cluster that it belongs to
    suspects: list[tuple[Int, slice, Bool]]  # times, channels and which visibilities of them stand out
    why: str = ""  # there is no solution


@dataclass
class Job:
    """What all blocks of one solve share."""

    settings: BlockSettings
    data: Visibilities
    models: Complex
    weight: Float
    grid: Grid
    scale: list[float]  # of data, models and weights: what 1e170 Jy are divided by, since its square is infinite
    names: list[str]  # of the clusters

    def solve(self, block: int, channel: int) -> Part:
        """Solve one block of integrations, and `channels` channels from `channel` on."""
        s, grid = self.settings, self.grid
        rows = np.flatnonzero(grid.number // grid.whole == block)
        pieces, place = np.unique(grid.number[rows] // grid.piece, return_inverse=True)
        chosen = [rows[place == k] for k in range(len(pieces))]
        span = slice(channel, min(channel + s.channels, self.data.data.shape[1]))
        first = np.stack([pieces * grid.piece // step for step in grid.steps], axis=1)
        column, offset = np.zeros_like(first), 0
        for c in range(first.shape[1]):
            column[:, c] = np.unique(first[:, c], return_inverse=True)[1] + offset
            offset = int(column[:, c].max(initial=-1)) + 1
        limits = Limits(s.pattern, s.tolerance, s.iterations, s.robust, s.unexplained)
        # [piece][time, channel] as samples of pieces of one length, filled up with weight zero
        weight = even([self.weight[t, span] for t in chosen])
        models = np.stack([even([m[t, span] for t in chosen]) for m in self.models])
        finite = bool(np.isfinite(models[:, weight > 0]).all())
        weight = weight if finite else np.zeros_like(weight)
        of_data, of_models, of_weight = self.scale
        root = math.sqrt(of_data) / math.sqrt(of_models)
        with np.errstate(invalid="ignore"):  # data may hold infinities
            data = even([self.data.data[t, span] for t in chosen]) / of_data
        stretch = Block(
            data=data,
            models=np.asarray(np.where(np.isfinite(models), models, 0.0) / of_models, complex),
            weight=weight / of_weight, a1=self.data.antenna1, a2=self.data.antenna2, stations=len(self.data.layout),
            column=column, limits=limits,
        )  # fmt: skip
        begin = self._start(rows[:1], span, stretch.columns)
        found = solved(stretch, begin)
        aside: list[tuple[Int, slice, Bool]] = []
        if found.outcome is Outcome.POOR_FIT and s.robust is None:
            shape = (-1, span.stop - span.start, weight.shape[2])
            for t, mask in zip(chosen, suspects(stretch, begin), strict=True):
                aside.append((t, span, mask.reshape(shape)[: len(t)]))
        why = ""
        enough = found.outcome is Outcome.ITERATION_LIMIT and len(found.history) >= ENOUGH
        if (enough or found.outcome in (Outcome.REFUSED, Outcome.SINGULAR)) and finite:
            why = self._why(stretch)
            if enough and why:
                found.outcome = Outcome.SINGULAR
        alive = [Outcome.REFUSED if finite else Outcome.NON_FINITE, found.outcome]
        outcomes = [alive[int(row.any())] for row in stretch.active]
        return Part((block, channel), found.times(root), outcomes, column, first, aside, why)

    def _why(self, block: Block) -> str:
        """What the data and models of a block do not tell."""
        asked = Asked(block.a1, block.a2, self.data.layout.names, block.limits.pattern, self.names)
        flat = block.weight.reshape(-1, len(block.a1))
        data, models = block.data.reshape(*flat.shape, 2, 2), block.models.reshape(-1, *flat.shape, 2, 2)
        return asked.reason(data, models, flat, ~block.active.any(axis=0))

    def _start(self, row: Int, span: slice, columns: int) -> Complex:
        begin = np.zeros((columns, len(self.data.layout), 2, 2), complex)
        begin[...] = np.eye(2)
        if self.settings.start is not None and len(row):
            at = self.data.at.block(slice(row[0], row[0] + 1), slice(span.start, span.start + 1))
            given = np.broadcast_to(self.settings.start.jones(at)[0, 0, :, 0], begin.shape)
            begin = np.where(np.isfinite(given).all(axis=(-2, -1), keepdims=True), given, begin)
        return begin

    def gathered(self, cluster: int, parts: list[Part], suspects: Bool) -> Solution:
        """The solution of one cluster; `suspects` (T, F, B) are those of all, (1, 1, 1) where there are none."""
        data, settings, freqs = self.data, self.settings, self.data.at.freq_hz
        known = self.grid.known(cluster)
        firsts = np.arange(0, len(freqs), settings.channels)
        shape = (len(known), len(firsts))
        jones = np.full((*shape, len(data.layout), 2, 2), np.nan + 0j)
        error = np.full(jones.shape, np.nan)
        common = np.full((*shape, len(GENERATORS[settings.pattern])), np.nan)
        outcome: Any = np.full(shape, Outcome.REFUSED, object)
        count = np.zeros(shape, int)
        share = np.full(shape, np.nan)
        loose: dict[tuple[int, int], Complex] = {}
        reasons: list[str] = []
        for part in parts:
            f, found = part.cell[1] // settings.channels, part.found
            for own in np.unique(part.pieces[:, cluster]):
                here = np.flatnonzero(part.pieces[:, cluster] == own)
                k = int(part.column[here[0], cluster])
                t = int(np.searchsorted(known, own))
                count[t, f], share[t, f] = len(found.history), np.sqrt(np.mean(found.share[here] ** 2))
                outcome[t, f] = part.outcome[k]
                if part.outcome[k] is not Outcome.CONVERGED:
                    reasons.append(part.why or EMPTY * (part.outcome[k] is Outcome.REFUSED))
                    continue
                jones[t, f] = found.jones[k]
                if found.errors is not None:
                    error[t, f], common[t, f] = found.errors.gains[k], found.errors.common[k]
                    loose[t, f] = found.errors.loose[k]
        gauge, looser = weak_gauges(gauge_of(self.models[cluster], self.weight, settings.pattern), loose)
        return Solution(
            term=JonesTable(
                values=jones,
                slots_s=self.grid.centres_s(cluster),
                freq_hz=freqs[firsts] + (freqs[: settings.channels] - freqs[0]).mean(),
                stations=tuple(data.layout.names),
            ),
            outcome=outcome,
            iterations=count,
            residual=share,
            gauge=gauge,
            looser=looser,
            history=_longest([p.found.history for p in parts]),
            interval_s=self.grid.steps[cluster] * data.integration_s,
            suspects=suspects,
            spoilt=by_baseline(suspects, data),
            unexplained=share,
            error=error,
            common_error=common,
            notes=(*told(reasons), *self._doubts(error, outcome), *partly_known(data)),
        )

    def _doubts(self, error: Float, outcome: Any) -> tuple[str, ...]:
        """Sentences on matrices near 1 that are noise, or of unknown errors."""
        converged, noise = outcome == Outcome.CONVERGED, noisy(np.eye(2) + 0j, error, self.settings.pattern)
        return (*unknown(error, converged), *faint(noise, converged, self.data.layout.names, "the cluster"))


def weak_gauges(gauge: Gauge, loose: dict[tuple[int, int], Complex]) -> tuple[Gauge, dict[tuple[int, int], Gauge]]:
    """The gauge of a model with the weak directions of the interval that has fewest, and those of all others.

    `loose` has the generators (q, 2, 2) that are free or weak in each interval.
    """
    weak = {}
    for where, generators in loose.items():
        flat, free = (g.reshape(len(g), 4).view(float) / np.sqrt(2) for g in (generators, gauge.generators))
        apart = flat - flat @ free.T @ free
        sizes, rows = np.linalg.svd(apart, full_matrices=False)[1:] if len(flat) else (np.zeros(0), apart)
        found = np.ascontiguousarray(np.sqrt(2) * rows[sizes > 0.5]).view(complex).reshape(-1, 2, 2)
        weak[where] = replace(gauge, weak=found)
    if not any(len(g.weak) for g in weak.values()):
        return gauge, {}
    first = min(weak, key=lambda where: len(weak[where].weak))
    return weak.pop(first), weak


def _longest(steps: list[Float]) -> Float:
    """Largest step after each round, of those of all blocks."""
    longest = max(len(x) for x in steps)
    return np.asarray(np.stack([np.pad(x, (0, longest - len(x))) for x in steps]).max(axis=0))


def even(pieces: list[Any]) -> Any:
    """Arrays (t, f, ...) as one (P, s, ...), the short ones filled up with zeros."""
    flat = [piece.reshape(-1, *piece.shape[2:]) for piece in pieces]
    out = np.zeros((len(flat), max(len(x) for x in flat), *flat[0].shape[1:]), flat[0].dtype)
    for row, x in zip(out, flat, strict=True):
        row[: len(x)] = x
    return out


def near_one(values: Any) -> float:
    """A power of four by which values are divided to be near 1; 1.0 where their squares are no trouble."""
    size = np.abs(values.view(float) if np.iscomplexobj(values) else values)
    power = int(np.frexp(size.max(initial=0.0, where=np.isfinite(size)))[1]) // 2 * 2
    return float(np.ldexp(1.0, power)) if abs(power) > 200 and power > -1000 else 1.0
