"""The table [data]: visibilities that a Measurement Set holds take the place of those that would be simulated."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from functools import cached_property
from typing import Any

import numpy as np

from instrument.errors import InputError
from instrument.files.by_rows import short
from instrument.files.measurement_set import MeasurementSet
from instrument.observe.recorded import Recorded
from instrument.pipeline.stage import Running, Stage, StageResult, StageRun
from instrument.pipeline.work import StageWork
from instrument.scene import Scene
from instrument.units import Bool, Int
from instrument.visibilities import Visibilities, VisibilitySet

READING = 1.0e-6  # seconds of a visibility
COPIES = 9  # of a block: as the file has it, as matrices, in the order of the plan; with weights and flags


class Data(Stage):
    """Reads the blocks from `column` of the Measurement Set `set`: a window and field where it has several.

    The observation of the scene is that of the set, with its UVW; the stations are its stations.
    """

    set: str
    column: str = "DATA"
    window: int | None = None
    field: int | None = None

    @cached_property
    def source(self) -> MeasurementSet:
        """The set."""
        return MeasurementSet(self.set, self.column, self.window, self.field)

    @cached_property
    def observation(self) -> Recorded:
        """Its observation."""
        return self.source.observation()

    def ranges(self) -> tuple[tuple[float, float] | None, ...]:
        """None: what others ask for is read."""
        return ()

    @property
    def reads(self) -> bool:
        """Only for the stages that follow."""
        return False

    def check(self, scene: Scene) -> None:
        """Refuse stations that are elsewhere."""
        told, layout = self.source.frame.layout, scene.instrument.layout()
        if lacking := [name for name in layout.names if name not in told.names]:
            raise InputError(f"{self.set} has no station {lacking[0]}: it has {', '.join(told.names[:5])}, ...")
        apart = np.linalg.norm(
            layout.positions_m - told.positions_m[[told.names.index(n) for n in layout.names]], axis=1
        )
        if (far := float(apart.max())) > 1.0:
            name = layout.names[int(apart.argmax())]
            raise InputError(f"[instrument] has {name} {far:.3g} m from where {self.set} has it: another telescope?")

    def work(self, run: Running) -> StageWork:
        """Data, flags and weights of a block, as the file has them and as they are here."""
        return StageWork(
            f"from {self.column} of {self.set}",
            seconds=READING * run.visibilities,
            block_bytes=COPIES * 64.0 * float(np.prod(run.block)),
        )

    def start(self, run: Running) -> StageRun:
        """The stage at work."""
        run.source = seen = Seen(self.source, run)
        return _DataRun(seen, run)


class _DataRun(StageRun):
    def __init__(self, seen: Seen, run: Running) -> None:
        self.seen, self.run = seen, run

    def take(self, block: Visibilities) -> Visibilities:
        """The data of the times, channels and baselines of a block."""
        if not self.run.read:
            return block
        found = self.seen.like(block) if self.run.modelled else block
        self.seen.looked(found)
        return found

    def finish(self) -> StageResult:
        """How much was read and flagged."""
        return DataResult(self.seen) if self.run.read else StageResult()


class DataResult(StageResult):
    """How much of the data is flagged."""

    def __init__(self, seen: Seen) -> None:
        self.flagged, self.source = seen.flagged / max(seen.count, 1.0), seen.source

    def record(self) -> dict[str, Any]:
        """The set, its column, and the share that is flagged."""
        return {"data": {"set": self.source.path, "column": self.source.column, "flagged": self.flagged}}

    def lines(self) -> list[str]:
        """The same in words."""
        return [f"data          {self.source}: {100 * self.flagged:.3g} % flagged, missing or not finite"]


class Seen(VisibilitySet):
    """The data of a set in the blocks, and with the stations and baselines, of a plan; what is missing is flagged."""

    def __init__(self, source: MeasurementSet, run: Running) -> None:
        self.source, self.plan = source, run.plan
        problem = run.plan.problem
        theirs, stations = source.frame.layout.names, len(source.frame.layout)
        number = np.array([theirs.index(name) for name in problem.at.layout.names])
        one, two = number[problem.antenna1], number[problem.antenna2]
        rows = source.rows
        known = rows.antenna1 * stations + rows.antenna2
        asked = np.minimum(one, two) * stations + np.maximum(one, two)
        self.place: Int = np.minimum(np.searchsorted(known, asked), len(known) - 1)
        self.there: Bool = known[self.place] == asked
        self.turned: Bool = one > two
        self.flagged = self.count = 0.0

    def blocks(self) -> Iterator[Visibilities]:
        """The data, block by block."""
        for times, channels in self.plan.slices:
            yield self._found(times, channels)

    def _found(self, times: slice, channels: slice) -> Visibilities:
        problem = self.plan.problem.block(times, channels)
        shape = (*problem.at.shape[:2], len(problem.antenna1), 2, 2)
        like = Visibilities(
            np.broadcast_to(np.zeros((), complex), shape), problem.at, problem.antenna1, problem.antenna2,
            problem.interval_s, problem.width_hz,
        )  # fmt: skip
        return self.like(like)

    def like(self, block: Visibilities) -> Visibilities:
        """The data of the times, channels and baselines of a block, which has the coordinates."""
        found = self.source.part(block)
        data = found.data[:, :, self.place]
        weight, flag = (self._of(x, found.data.shape) for x in (found.weight, found.flag))
        if self.turned.any():
            data[:, :, self.turned] = np.conj(np.swapaxes(data[:, :, self.turned], -1, -2))
        bad = ~self.there[:, None, None] | ~np.isfinite(data)
        data = np.where(bad, 0.0, data)
        weight, flag = short(np.where(bad, 0.0, weight)), short(flag | bad)
        return replace(block, data=data, weight=weight, flag=flag, beam_state=found.beam_state)

    def _of(self, values: Any, shape: tuple[int, ...]) -> Any:
        """Weights or flags of the baselines asked for, of correlations."""
        whole = values if values.ndim == len(shape) else values[..., None, None]
        out = np.broadcast_to(whole, shape)[:, :, self.place].copy()
        if self.turned.any():
            out[:, :, self.turned] = np.swapaxes(out[:, :, self.turned], -1, -2)
        return out

    def looked(self, block: Visibilities) -> None:
        """Count what is flagged."""
        self.flagged += float(block.flag.sum())
        self.count += block.flag.size

    def back(self, block: Visibilities) -> Visibilities:
        """A block of the plan with the stations and baselines of the set, as it writes them."""
        source = self.source
        baselines, shape = len(source.rows.antenna1), block.data.shape
        if not np.isin(np.arange(baselines), self.place[self.there]).all():
            raise InputError(
                f"[instrument] has fewer stations than {source.path}: what the others would get is unknown"
            )
        data = np.zeros((*shape[:2], baselines, 2, 2), complex)
        mine = np.where(self.turned[:, None, None], np.conj(np.swapaxes(block.data, -1, -2)), block.data)
        data[:, :, self.place[self.there]] = mine[:, :, self.there]
        return Visibilities(
            data, source.sampling(block), source.rows.antenna1, source.rows.antenna2, block.interval_s, block.width_hz,
            beam_state=block.beam_state,
        )  # fmt: skip
