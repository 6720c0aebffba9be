"""DirectionalCal: a matrix per station, interval and cluster of directions, all clusters solved at once."""

from __future__ import annotations

import math
import os
from collections.abc import Iterable, Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import Annotated, Any, Literal, overload

import numpy as np
from pydantic import BeforeValidator

from instrument.calibrate.base import Calibrator, Solution, by_baseline, pair
from instrument.calibrate.clusters import Block, Limits
from instrument.calibrate.directional_solution import DirectionalSolution, Models
from instrument.calibrate.gauge import gauge_of
from instrument.checked import checked
from instrument.errors import InputError, Outcome, did_you_mean
from instrument.jones.base import JonesTerm
from instrument.jones.table import JonesTable
from instrument.predict.threads import ONE_THREAD, look_again
from instrument.units import Bool, Complex, Count, Float, Int, Metres, Positive, PositiveSeconds, Real, to_si
from instrument.visibilities import Visibilities

ALL = "all"  # the cluster of a model that is not in parts


def _seconds_by_name(given: Any) -> Any:
    """Times by name, each written with its unit: what a component can store and read again."""
    if not isinstance(given, Mapping):
        raise InputError(f"intervals takes a dict of cluster names and times, got {given!r}")
    seconds = {name: to_si(value, "s", f"intervals['{name}']") for name, value in given.items()}
    for name, value in seconds.items():
        if not (np.ndim(value) == 0 and np.isfinite(value) and value > 0):
            raise InputError(f"intervals['{name}'] = {value} s must be one positive time")
    return {name: f"{value!r} s" for name, value in seconds.items()}


@checked
class DirectionalCal(Calibrator):
    """Direction-dependent solve of V_ab = sum_c J_a^c M_ab^c J_b^cH for all clusters c at once.

    `pattern` as in `SelfCal`; `interval` (each integration by default) holds for all clusters, `intervals` names
    others for some. `robust` is the degrees of freedom of Student's t: visibilities with outliers (interference,
    sources that no model has) then weigh (nu + 8) / (nu + |r|^2 / sigma^2), sigma being measured; None: Gaussian noise.
    `min_baseline` leaves out shorter ones. `start` is a term to start all clusters from, a `SelfCal` solution say; the
    identity otherwise. Stops when no matrix changes by more than `tolerance` of itself. A fit that leaves more than
    `unexplained` of the rms of the data is `Outcome.POOR_FIT`. Memory: each baseline twice, for every cluster and the
    data, in every thread.
    """

    pattern: Literal["full", "diagonal", "scalar", "phase"] = "full"
    interval: PositiveSeconds | None = None
    intervals: Annotated[dict[str, str], BeforeValidator(_seconds_by_name)] = {}  # noqa: RUF012 - pydantic copies it
    channels: Count = 1
    robust: Positive | None = None
    tolerance: Annotated[float, Real(above=0, below=0.1)] = 1e-8
    iterations: Count = 100
    min_baseline: Metres | None = None
    unexplained: Annotated[float, Real(above=0, at_most=1)] = 0.7
    start: JonesTerm | None = None

    @overload
    def solve(self, data: Visibilities, models: Visibilities) -> Solution: ...

    @overload
    def solve(self, data: Visibilities, models: Models) -> DirectionalSolution: ...

    def solve(self, data: Visibilities, models: Visibilities | Models) -> Solution | DirectionalSolution:
        """Solve every interval; flagged and non-finite data weigh nothing.

        `models`: one `Visibilities` per cluster, by name; or one alone, the same matrices for all of it.
        """
        if isinstance(models, Visibilities):
            return self._solved(data, {ALL: models})[ALL]
        return self._solved(data, models)

    def _solved(self, data: Visibilities, models: Models) -> DirectionalSolution:
        names = self._names(models)
        with np.errstate(invalid="ignore"):  # data may hold infinities
            paired = [pair(data, models[name]) for name in names]
        weight = self._cut(data, paired[0][2])
        stacked = np.stack([m for _, m, _ in paired])
        for name, model in zip(names, stacked, strict=True):
            if not np.any(model):
                raise InputError(f"the model of cluster '{name}' is zero everywhere: leave it out")
        grid = _Grid.of(data, [self._seconds(name) for name in names])
        if self.channels > data.data.shape[1]:
            raise InputError(f"channels = {self.channels} of one solution, but the data have {data.data.shape[1]}")
        cells = [(int(k), f) for k in grid.blocks for f in range(0, data.data.shape[1], self.channels)]
        scale = [_near(x) for x in (data.data[..., None], stacked[..., None], weight)]
        job = _Job(self, data, stacked, weight, grid, scale)
        look_again()
        with ONE_THREAD, ThreadPoolExecutor(os.cpu_count() or 1) as pool:
            parts = list(pool.map(lambda cell: job.solve(*cell), cells))
        suspects = np.zeros(data.data.shape[:3] if any(p.suspects for p in parts) else (1, 1, 1), bool)
        for times, span, mask in (found for p in parts for found in p.suspects):
            suspects[times, span] |= mask
        return DirectionalSolution({name: job.gathered(c, parts, suspects) for c, name in enumerate(names)})

    def _names(self, models: Models) -> list[str]:
        if not models:
            raise InputError("models is empty: give at least one cluster, a dict of name and Visibilities")
        for name in self.intervals:
            if name not in models:
                raise InputError(f"intervals names '{name}', which no model is of: {did_you_mean(name, models)}")
        return list(models)

    def _seconds(self, name: str) -> float | None:
        return to_si(self.intervals[name], "s") if name in self.intervals else self.interval

    def _cut(self, data: Visibilities, weight: Float) -> Float:
        ends = np.stack([data.antenna1, data.antenna2])
        if len(np.unique(np.sort(ends, axis=0), axis=1).T) != ends.shape[1]:
            raise InputError("a baseline occurs twice in the data: a directional solve needs each once")
        weight = np.where(ends[0] == ends[1], 0.0, weight)
        if self.min_baseline is None:
            return weight
        return weight * (np.linalg.norm(data.uvw_m, axis=-1)[:, None] >= self.min_baseline)


@dataclass(frozen=True)
class _Grid:
    """Integrations counted on a regular grid (gaps count too), and the lengths of all that is made of them."""

    number: Int  # (T,) of the integration, from 0
    steps: list[int]  # integrations in the interval of each cluster
    whole: int  # in a block: all clusters begin a new interval with it
    piece: int  # in a piece: no cluster begins a new interval within it
    first_s: float
    interval_s: float

    @classmethod
    def of(cls, data: Visibilities, seconds: Iterable[float | None]) -> _Grid:
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
class _Part:
    """What came out of one block of K unknown matrices a station and P pieces."""

    cell: tuple[int, int]
    jones: Complex
    outcome: list[Outcome]  # (K,)
    count: int
    share: Float
    history: Float
    column: Int  # (P, C): the unknown that a cluster has in a piece
    pieces: Int  # (P, C): the interval of the cluster that it belongs to
    suspects: list[tuple[Int, slice, Bool]]  # times, channels and which visibilities of them stand out


@dataclass
class _Job:
    """What all blocks of one solve share."""

    settings: DirectionalCal
    data: Visibilities
    models: Complex
    weight: Float
    grid: _Grid
    scale: list[float]  # of data, models and weights: what 1e170 Jy are divided by, since its square is infinite

    def solve(self, block: int, channel: int) -> _Part:
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
        weight = _even([self.weight[t, span] for t in chosen])
        models = np.stack([_even([m[t, span] for t in chosen]) for m in self.models])
        finite = bool(np.isfinite(models[:, weight > 0]).all())
        weight = weight if finite else np.zeros_like(weight)
        of_data, of_models, of_weight = self.scale
        root = math.sqrt(of_data) / math.sqrt(of_models)
        with np.errstate(invalid="ignore"):  # data may hold infinities
            data = _even([self.data.data[t, span] for t in chosen]) / of_data
        solver = Block(
            data=data,
            models=np.asarray(np.where(np.isfinite(models), models, 0.0) / of_models, complex),
            weight=weight / of_weight, a1=self.data.antenna1, a2=self.data.antenna2, stations=len(self.data.layout),
            column=column, limits=limits,
        )  # fmt: skip
        begin = self._start(rows[:1], span, solver.columns)
        jones, outcome, count, share, history = solver.solve(begin)
        suspects: list[tuple[Int, slice, Bool]] = []
        if outcome is Outcome.POOR_FIT and s.robust is None:
            shape = (-1, span.stop - span.start, weight.shape[2])
            for t, mask in zip(chosen, solver.suspects(begin), strict=True):
                suspects.append((t, span, mask.reshape(shape)[: len(t)]))
        alive = [Outcome.REFUSED if finite else Outcome.NON_FINITE, outcome]
        outcomes = [alive[int(row.any())] for row in solver.active]
        return _Part((block, channel), jones * root, outcomes, count, share, history, column, first, suspects)

    def _start(self, row: Int, span: slice, columns: int) -> Complex:
        begin = np.zeros((columns, len(self.data.layout), 2, 2), complex)
        begin[...] = np.eye(2)
        if self.settings.start is not None and len(row):
            at = self.data.at.block(slice(row[0], row[0] + 1), slice(span.start, span.start + 1))
            given = np.broadcast_to(self.settings.start.jones(at)[0, 0, :, 0], begin.shape)
            begin = np.where(np.isfinite(given).all(axis=(-2, -1), keepdims=True), given, begin)
        return begin

    def gathered(self, cluster: int, parts: list[_Part], suspects: Bool) -> Solution:
        """The solution of one cluster; `suspects` (T, F, B) are those of all, (1, 1, 1) where there are none."""
        data, settings, freqs = self.data, self.settings, self.data.at.freq_hz
        known = self.grid.known(cluster)
        firsts = np.arange(0, len(freqs), settings.channels)
        shape = (len(known), len(firsts))
        jones = np.full((*shape, len(data.layout), 2, 2), np.nan + 0j)
        outcome: Any = np.full(shape, Outcome.REFUSED, object)
        count = np.zeros(shape, int)
        share = np.full(shape, np.nan)
        for part in parts:
            f = part.cell[1] // settings.channels
            for own in np.unique(part.pieces[:, cluster]):
                here = np.flatnonzero(part.pieces[:, cluster] == own)
                k = int(part.column[here[0], cluster])
                t = int(np.searchsorted(known, own))
                count[t, f], share[t, f] = part.count, np.sqrt(np.mean(part.share[here] ** 2))
                outcome[t, f] = part.outcome[k]
                if part.outcome[k] is Outcome.CONVERGED:
                    jones[t, f] = part.jones[k]
        longest = max(len(p.history) for p in parts)
        history = np.stack([np.pad(p.history, (0, longest - len(p.history))) for p in parts]).max(axis=0)
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
            gauge=gauge_of(self.models[cluster], self.weight, settings.pattern),
            history=history,
            interval_s=self.grid.steps[cluster] * data.integration_s,
            suspects=suspects,
            spoilt=by_baseline(suspects, data),
            unexplained=share,
        )


def _even(pieces: list[Any]) -> Any:
    """Arrays (t, f, ...) as one (P, s, ...), the short ones filled up with zeros."""
    flat = [piece.reshape(-1, *piece.shape[2:]) for piece in pieces]
    out = np.zeros((len(flat), max(len(x) for x in flat), *flat[0].shape[1:]), flat[0].dtype)
    for row, x in zip(out, flat, strict=True):
        row[: len(x)] = x
    return out


def _near(values: Any) -> float:
    """A power of four by which values are divided to be near 1; 1.0 where their squares are no trouble."""
    size = np.abs(values.view(float) if np.iscomplexobj(values) else values)
    power = int(np.frexp(size.max(initial=0.0, where=np.isfinite(size)))[1]) // 2 * 2
    return float(np.ldexp(1.0, power)) if abs(power) > 200 and power > -1000 else 1.0
