"""DirectionalCal: a matrix per station, interval and cluster of directions, all clusters solved at once."""

from __future__ import annotations

import os
from collections.abc import Mapping
from concurrent.futures import ThreadPoolExecutor
from typing import Annotated, Any, Literal, overload

import numpy as np
from pydantic import BeforeValidator

from instrument.calibrate.base import Calibrator, Solution, pair
from instrument.calibrate.directional_job import Grid, Job, near_one
from instrument.calibrate.directional_solution import DirectionalSolution, Models
from instrument.checked import checked
from instrument.errors import InputError, did_you_mean
from instrument.jones.base import JonesTerm
from instrument.predict.threads import ONE_THREAD, look_again
from instrument.units import Count, Float, Metres, Positive, PositiveSeconds, Real, to_si
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
    identity otherwise. Stops when no matrix changes by more than `tolerance` of itself, and the data could gain no more
    than that of their rms. A fit that leaves more than `unexplained` of the rms of the data is `Outcome.POOR_FIT`.
    Matrices common to all stations that noise would fill, because only the polarization that a beam adds shows them,
    are held near the start by a prior that vanishes without noise (`Gauge.weak`, `Solution.common_error`). Memory: each
    baseline twice, for every cluster and the data, in every thread.
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
        grid = Grid.of(data, [self._seconds(name) for name in names])
        if self.channels > data.data.shape[1]:
            raise InputError(f"channels = {self.channels} of one solution, but the data have {data.data.shape[1]}")
        cells = [(int(k), f) for k in grid.blocks for f in range(0, data.data.shape[1], self.channels)]
        scale = [near_one(x) for x in (data.data[..., None], stacked[..., None], weight)]
        job = Job(self, data, stacked, weight, grid, scale, names)
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
