"""Some intervals of a self-calibration, solved side by side: what counts, where to start, and how it ended."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np

from instrument import correlations, mat2
from instrument.calibrate.again import Fits
from instrument.calibrate.fit import strange
from instrument.calibrate.gauge import UNKNOWNS, Gauge, common, free_counts
from instrument.calibrate.graph import counted, freedom, tied
from instrument.calibrate.lanes import Lanes, Settings
from instrument.calibrate.newton import MOVED, factored
from instrument.calibrate.suspects import suspects
from instrument.errors import Outcome
from instrument.jones.base import JonesTerm
from instrument.units import Bool, Complex, Float, Int
from instrument.visibilities import Visibilities

Cell = tuple[slice, slice]  # times and channels of an interval
LOPSIDED = 0.05  # of the rms of a model: more polarization than that shows in errors, by about as much


class SolveSettings(Settings, Protocol):
    """What a chunk needs to know of a solver."""

    @property
    def unexplained(self) -> float:
        """Share of the rms of the data above which what is left is a poor fit."""

    @property
    def start(self) -> JonesTerm | None:
        """What to start from."""


class SelfSettings(SolveSettings, Protocol):
    """What a chunk of a self-calibration needs to know besides."""

    @property
    def errors(self) -> bool:
        """Whether errors of gains are wanted."""


@dataclass
class Part:
    """Solutions of the lanes of one chunk; `suspects` the samples (N,) of the lanes that have any."""

    jones: Complex
    outcome: list[Outcome]
    iterations: Int
    residual: Float
    worst: Float
    history: Float
    gauges: dict[int, Gauge]
    suspects: dict[int, Bool]
    error: Float
    common_error: Float


@dataclass
class Job:
    """What all chunks of one solve share."""

    settings: SelfSettings
    visibilities: Visibilities
    data: Complex
    model: Complex
    weight: Float
    gauge: Gauge

    def solve(self, cells: list[Cell]) -> Part:
        """Solve the intervals `cells` side by side."""
        a1, a2 = self.visibilities.antenna1, self.visibilities.antenna2
        stations, s = len(self.visibilities.layout), self.settings
        v, m, w = self._gathered(cells)
        finite: Any = np.ones(len(cells), bool)
        with np.errstate(over="ignore", invalid="ignore"):
            sound = m.size > 0 and bool(np.isfinite(m.sum()))  # in one pass; a sum may overflow
        if not sound:
            finite = np.isfinite(m).all(axis=(-3, -2, -1)) if m.size else finite
            m = np.where(np.isfinite(m), m, 0.0)
        v, m, level = _scaled(v, m, w, s.pattern == "phase")
        v, m, active, held, samples = self._tied(v, m)
        lanes = Lanes(v, m, a1, a2, held, s)
        jones, step, count, history = lanes.iterate(self._start(cells, held, level))
        left = lanes.left(jones, samples)
        fit = Fits(jones, step, count, left, strange(left, a1, a2, stations, s.tolerance, s.pattern))
        hard = (
            ((step > s.tolerance) | left.poor(s.unexplained) | left.uneven | fit.odd.any(axis=1))
            & finite
            & held.any(axis=1)
        )
        if hard.any():
            fit.improve(lanes, np.flatnonzero(hard), s)
        jones, poor = fit.jones, fit.left.poor(s.unexplained) | fit.odd.any(axis=1)
        gauges, free = {}, free_counts(lanes.common.eigen[0], lanes.common.model_power)
        few_samples = 8 * samples.sum(axis=1) < UNKNOWNS[s.pattern] * held.sum(axis=1) - free
        thin = (samples > 0).sum(axis=1) < 2 * held.sum(axis=1)
        outcome = []
        for k in range(len(cells)):
            if free[k] > self.gauge.count and held[k].any():
                gauges[k] = common(lanes.common.form[k], float(lanes.common.model_power[k]), s.pattern)
            ended = self._outcome(finite[k], active[k], held[k], few_samples[k], fit.step[k])
            if ended is Outcome.CONVERGED and poor[k]:
                ended = Outcome.POOR_FIT
            if ended is Outcome.CONVERGED and thin[k] and self._loose(cells[k], m[k], held[k], samples[k]):
                ended = Outcome.SINGULAR
            outcome.append(ended)
        few = fit.odd.any(axis=1) | fit.left.few_fit(s.unexplained)
        failed = few & [o in (Outcome.POOR_FIT, Outcome.ITERATION_LIMIT) for o in outcome]
        found = suspects(v[failed], m[failed], a1, a2, held[failed], s) if failed.any() else {}
        # J^-1 magnifies what is left over: by its condition number for either station
        with np.errstate(invalid="ignore"):
            worst = fit.left.worst * np.median(np.where(held, mat2.condition(jones), 1.0), axis=1) ** 2
        named = {int(np.flatnonzero(failed)[k]): mask for k, mask in found.items()}
        lost = np.array([o is not Outcome.CONVERGED for o in outcome])
        lanes.factors = {k: one for k, one in lanes.factors.items() if not lost[k]}
        # of a model of Q/I = 0.5, errors as for one without polarization were 1.2 and 0.5 times those of p and q
        lopsided = _lopsided(m, s.pattern) & ~lost if s.errors else lost & False
        swept = np.flatnonzero(lopsided).tolist()
        factored(lanes, fit.jones, fit.left.share, np.flatnonzero(hard).tolist(), MOVED if s.errors else np.inf, swept)
        jones, error, common_error = _with_errors(lanes, fit, lost, self.gauge, s.errors)
        scale = level[:, None, None, None]
        share, gains = fit.left.share, jones * scale
        return Part(gains, outcome, fit.count, share, worst, history, gauges, named, error * scale, common_error)

    def _tied(self, v: Complex, m: Complex) -> tuple[Complex, Complex, Bool, Bool, Int]:
        """Data and model (L, N, 2, 2) where they count; stations (L, A) with a model, those tied; samples (L, B)."""
        a1, a2, stations = self.visibilities.antenna1, self.visibilities.antenna2, len(self.visibilities.layout)
        power = m.real**2 + m.imag**2
        each = power.reshape(len(m), -1, len(a1), 2, 2).sum(axis=1)
        used = counted(each)
        alive = used[..., 0, 0] | used[..., 0, 1] | used[..., 1, 0] | used[..., 1, 1]
        active = alive @ _ends(a1, a2, stations) > 0
        held = tied(used, a1, a2, stations, self.settings.pattern)
        inside = held[:, a1] & held[:, a2]
        on, rows = alive & inside, v.shape[1] // len(a1)
        if not on.all():  # data without a model count as left over; those of other pieces of the graph do not
            v = np.where(np.tile(inside, rows)[..., None, None], v, 0.0)
            m, power = (np.where(np.tile(on, rows)[..., None, None], x, 0.0) for x in (m, power))
        samples = on.astype(int)
        if rows > 1:
            samples = (power.sum(axis=(2, 3)).reshape(len(m), rows, -1) > 0).sum(axis=1)
        return v, m, active, held, samples

    def _gathered(self, cells: list[Cell]) -> tuple[Complex, Complex, Float]:
        """Data, model (L, N, 2, 2) and weights (L, N), N samples of all baselines; short intervals are padded."""
        most = max((t.stop - t.start) * (f.stop - f.start) for t, f in cells)
        baselines = self.data.shape[2]
        v = np.zeros((len(cells), most * baselines, 2, 2), complex)
        m = np.zeros_like(v)
        w = np.zeros((len(cells), most * baselines))
        for k, (t, f) in enumerate(cells):
            piece = self.weight[t, f]
            v[k, : piece.size] = self.data[t, f].reshape(-1, 2, 2)
            m[k, : piece.size] = self.model[t, f].reshape(-1, 2, 2)
            w[k, : piece.size] = piece.reshape(-1)
        return v, m, w

    def _start(self, cells: list[Cell], active: Bool, level: Float) -> Complex:
        begin: Any = np.zeros((*active.shape, 2, 2), complex)
        begin[...] = np.eye(2)
        given: Any = self.settings.start
        if given is None:  # data far from the model by a factor: it is a start of its own
            return begin / np.where(np.abs(np.log2(level)) > 2, 1.0, level)[:, None, None, None]
        for k, (t, f) in enumerate(cells):
            at = self.visibilities.at.block(slice(t.start, t.start + 1), slice(f.start, f.start + 1))
            first = given.jones(at)[0, 0, :, 0]
            begin[k] = np.where(np.isfinite(first).all(axis=(-2, -1))[:, None, None], first, np.eye(2))
        return begin / level[:, None, None, None]

    def _outcome(self, finite: Any, active: Bool, held: Bool, few_samples: bool, step: Any) -> Outcome:
        if not finite:
            return Outcome.NON_FINITE
        if not active.any():
            return Outcome.REFUSED
        if few_samples or not held.any() or not np.isfinite(step):
            return Outcome.SINGULAR
        return Outcome.ITERATION_LIMIT if step > self.settings.tolerance else Outcome.CONVERGED

    def _loose(self, cell: Cell, model: Complex, held: Bool, samples: Int) -> bool:
        """Whether few baselines leave more open than a common matrix, and others are to be corrected with it."""
        vis, used = self.visibilities, samples > 0
        if self.settings.pattern != "full":
            return False
        flag = np.broadcast_to(correlations.alike(vis.data, vis.flag)[1], vis.data.shape)[cell]
        lost = flag | ~np.isfinite(vis.data[cell]).all(axis=(-2, -1), keepdims=True)
        wanted = ~lost.all(axis=(0, 1, 3, 4)) & held[vis.antenna1] & held[vis.antenna2]
        if not np.any(wanted & ~used):
            return False
        every, alike = freedom(model, np.ones(len(model)), vis.antenna1, vis.antenna2, len(held))
        return every > alike


def _lopsided(model: Complex, pattern: str) -> Bool:
    """Lanes (L,) whose model (L, N, 2, 2) is not nearly a number times 1, as errors take it; one gain sees no more."""
    if pattern == "scalar":
        return np.zeros(len(model), bool)
    number = (model[..., 0, 0] + model[..., 1, 1]) / 2
    apart = model - number[..., None, None] * np.eye(2)
    power, beside = ((np.abs(x) ** 2).sum(axis=(1, 2, 3)) for x in (model, apart))
    return np.asarray(beside > LOPSIDED**2 * power)


def _with_errors(lanes: Lanes, fit: Fits, lost: Any, gauge: Gauge, each: bool) -> tuple[Complex, Float, Float]:
    """Matrices, their errors (L, A, 2, 2) and those of common directions (L, n); NaN where there is no solution."""
    jones = fit.jones
    error, common_error = lanes.errors(jones, fit.left.share, gauge, each)
    jones[lost] = error[lost] = common_error[lost] = np.nan
    jones[~lanes.active] = error[~lanes.active] = np.nan
    return jones, error, common_error


def _ends(a1: Int, a2: Int, stations: int) -> Int:
    """Which stations (B, A) a baseline has."""
    out = np.zeros((len(a1), stations), int)
    out[np.arange(len(a1)), a1] = out[np.arange(len(a2)), a2] = 1
    return out


def _scaled(v: Complex, m: Complex, w: Float, together: bool) -> tuple[Complex, Complex, Float]:
    """Data and model times the root of the weights, each lane near 1, and what its matrices are to be multiplied by.

    Powers of two, of which a root is taken: nothing is rounded. 1e170 Jy squared would be infinite.
    """
    top = np.frexp(w.max(axis=1, initial=0.0))[1] // 2 * 2
    root = np.sqrt(np.ldexp(w, -top[:, None]))[..., None, None]
    if not np.all(root == 1):
        v, m = (np.where(root > 0, x, 0.0) * root for x in (v, m))
    flat = [x.view(float).reshape(len(x), -1) for x in (v, m)]
    sizes = [np.maximum(x.max(axis=1, initial=0.0), -x.min(axis=1, initial=0.0)) for x in flat]
    # an even number: the root of the ratio is a power of two as well
    above, below = (np.clip(np.frexp(np.where(np.isfinite(x), x, 1.0))[1] // 2 * 2, -1000, 1022) for x in sizes)
    if together:
        above = below = np.maximum(above, below)
    far = (np.abs(above) > 40) | (np.abs(below) > 40) | (np.abs(above - below) > 6)
    above, below = above * far, below * far
    if far.any():
        v, m = (x * np.ldexp(1.0, -power)[:, None, None, None] for x, power in ((v, above), (m, below)))
    return v, m, np.ldexp(1.0, (above - below) // 2)
