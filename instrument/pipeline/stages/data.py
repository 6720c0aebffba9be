"""The table [data]: visibilities that a file holds take the place of those that would be simulated."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from instrument import correlations
from instrument.errors import BeamStateError, InputError
from instrument.files.by_rows import RowFile
from instrument.files.formats import source
from instrument.jones.towards import Towards
from instrument.memory import give_back
from instrument.observe.recorded import Recorded
from instrument.pipeline.stage import Running, Stage, StageResult, StageRun
from instrument.pipeline.work import Items, StageWork
from instrument.plan import Item
from instrument.report.page import Card
from instrument.scene import Scene
from instrument.units import Bool, Int, SkyDirection
from instrument.visibilities import Visibilities, VisibilitySet

READING = 1.0e-6  # seconds of a visibility
STORED = 60.0  # bytes of a visibility as the file has it
TILES = 50e6  # bytes that the library of sets keeps of what it has read
TAKEN = 200.0  # of one that is taken: as a matrix, in the order of the plan, with weight and flag


class Data(Stage):
    """Reads the blocks of `set`: a Measurement Set, a UVFITS or UVH5 file, or a set of version 4 in Zarr.

    Chosen are `column`, `window` and `field` of a Measurement Set (DATA, and the only ones); `window`, `field` and the
    `centre` that a drift scan is phased to of UVFITS and UVH5; `part` and `column` (its group of data, base) of version
    4. The observation of the scene is that of the set, with its UVW; the stations are its stations.
    """

    set: str
    column: str | None = None
    window: int | None = None
    field: int | None = None
    part: str | None = None
    centre: SkyDirection | None = None

    @cached_property
    def source(self) -> RowFile:
        """The set."""
        return source(
            self.set, column=self.column, window=self.window, field=self.field, part=self.part, centre=self.centre
        )

    @cached_property
    def observation(self) -> Recorded:
        """Its observation; what was read on the way is given back before the run is planned by what is taken."""
        found = self.source.observed()
        give_back()
        return found

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
            f"from {self.source.named}",
            seconds=READING * run.visibilities,
            held_bytes=TILES,
            block_bytes=run.block[0] * run.block[1] * (STORED * self.source.shape[2] + TAKEN * run.block[2]),
        )

    def items(self, run: Running) -> Items:
        """The beam that is put back into data from which it has been taken out; refuse what cannot be compared."""
        if any(stage.needs_sky for stage in run.stages.values()):
            self.source.demand_closing()
        state = self.source.beam_state
        if not _compared(run) or state.removed == "nothing":
            return Items()
        remedy = "read a column that has it (column, --column)"
        if state.other:
            raise BeamStateError(
                f"{self.source.named}: a part of the beam has been taken out, the model has it: {remedy}"
            )
        if not run.instrument.chain().beams().terms:
            remedy += ", or give [instrument] its beam, which is put back"
            raise BeamStateError(f"{self.source.named}: the beam has been taken out, the model has none: {remedy}")
        return Items(kept=(Item("beam", f"was taken out towards {state.towards}: put back, as the model has it"),))

    def start(self, run: Running) -> StageRun:
        """The stage at work."""
        run.source = seen = Seen(self.source, run)
        return _DataRun(seen, run)


def _compared(run: Running) -> bool:
    """Whether a stage compares the data with a model."""
    return any(stage.needs_sky and stage.reads for stage in run.stages.values())


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

    def cards(self) -> list[Card]:
        """The set, and the share that is flagged."""
        text = f"{100 * self.flagged:.3g}\u00a0% flagged, missing or not finite"
        return [Card("Data", Path(self.source.path).name, f"{self.source.column} {text}".strip())]

    def lines(self) -> list[str]:
        """The same in words."""
        return [f"data          {self.source}: {100 * self.flagged:.3g} % flagged, missing or not finite"]


class Seen(VisibilitySet):
    """The data of a set in the blocks, and with the stations and baselines, of a plan; what is missing is flagged."""

    def __init__(self, source: RowFile, run: Running) -> None:
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
        self.wanted = np.unique(self.place[self.there])
        self.straight = np.array_equal(self.place, self.wanted) and bool(self.there.all())
        self.put_back = None  # the beam, where it has been taken out and the model has it
        if _compared(run) and source.beam_state.removed != "nothing":
            self.put_back = run.instrument.chain().beams()
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
        found = self.source.part(block, self.wanted)
        data, weight, flag = (self._mine(values) for values in (found.data, found.weight, found.flag))
        if self.turned.any():
            data[:, :, self.turned] = np.conj(np.swapaxes(data[:, :, self.turned], -1, -2))
            for values in (weight, flag):
                if values.ndim == data.ndim:
                    values[:, :, self.turned] = np.swapaxes(values[:, :, self.turned], -1, -2)
        bad = ~np.isfinite(data)
        if bad.any():
            data[bad] = 0.0
            if np.array_equal(bad.any(axis=(3, 4)), bad.all(axis=(3, 4))):
                bad = bad[..., 0, 0]
            else:
                weight, flag = (
                    np.broadcast_to(x, data.shape).copy() for x in correlations.alike(weight, flag, data)[:2]
                )
            weight[bad], flag[bad] = 0.0, True
        weight[:, :, ~self.there], flag[:, :, ~self.there] = 0.0, True
        own = found.interval_s if np.ptp(self.source.rows.interval_s) else block.interval_s
        made = replace(block, data=data, weight=weight, flag=flag, interval_s=own, beam_state=found.beam_state)
        if not self.source.closes:  # nothing is predicted: all that follows has the UVW of the baselines
            uvw = block.uvw_m.copy()
            uvw[:, self.there] = found.uvw_m[:, np.searchsorted(self.wanted, self.place[self.there])]
            uvw[:, self.there & self.turned] *= -1
            made = replace(made, given_uvw_m=uvw)
        if self.put_back is None:
            return made
        return made.corrupted(Towards(chain=self.put_back, direction=found.beam_state.towards))

    def _mine(self, values: Any) -> Any:
        """What was found of the baselines `wanted`, as those of the plan; 0 for those that are not there."""
        if self.straight:
            return values
        out = np.zeros((*values.shape[:2], len(self.place), *values.shape[3:]), values.dtype)
        out[:, :, self.there] = values[:, :, np.searchsorted(self.wanted, self.place[self.there])]
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
        axes = block.flag.shape[3:]
        flag = np.ones((*shape[:2], baselines, *axes), bool)
        wide = np.broadcast_to(block.flag, (*shape[:3], *axes))
        if axes:
            wide = np.where(self.turned[:, None, None], np.swapaxes(wide, -1, -2), wide)
        flag[:, :, self.place[self.there]] = wide[:, :, self.there]
        uvw = None
        if block.given_uvw_m is not None:
            uvw = np.zeros((shape[0], baselines, 3))
            uvw[:, self.place[self.there]] = (np.where(self.turned[:, None], -1, 1) * block.uvw_m)[:, self.there]
        return Visibilities(
            data, source.sampling(block), source.rows.antenna1, source.rows.antenna2, block.interval_s, block.width_hz,
            flag=flag, beam_state=block.beam_state, given_uvw_m=uvw,
        )  # fmt: skip
