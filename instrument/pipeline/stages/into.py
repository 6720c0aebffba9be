"""The table [into]: visibilities of a run written into a column of a Measurement Set, or as a new file."""

from __future__ import annotations

import os
import weakref
from collections.abc import Mapping
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path
from typing import Any, ClassVar, Literal, Self

import numpy as np

from instrument.errors import InputError, RefusedError
from instrument.files.formats import ENDINGS, demand_free, has_columns, write
from instrument.files.measurement_set import MeasurementSet
from instrument.files.ms_write import demand_column, demand_space
from instrument.partial_folders import beside
from instrument.pipeline.stage import Beside, Running, Stage, StageResult, StageRun
from instrument.pipeline.stages.data import Seen
from instrument.pipeline.work import Items, StageWork
from instrument.plan import Item
from instrument.predict.base import EVERY
from instrument.report.page import Card
from instrument.scene import Scene
from instrument.store import StoreWriter
from instrument.terminal import finished
from instrument.visibilities import Visibilities
from instrument.visibility_sets import BLOCK_BYTES, VisibilityFile

KEEPING, WRITING = 1.0e-6, 1.0e-6  # seconds of a visibility: into the file beside the set, and from there into it
USUAL = {"model": "MODEL_DATA", "difference": "SUBTRACTED_DATA"}  # columns of a set that is there
WHAT = {"data": "the visibilities", "model": "the prediction", "difference": "visibilities less the prediction"}


class Into(Stage):
    """Writes `what` is there at the end into `column` of the Measurement Set `set`, that of [data] where none is given.

    `what` is "data" (visibilities as the stages before have left them), "model" (what was predicted) or "difference"
    (data less model). A set that is not that of [data] is made anew, with the tables of its telescope; where its name
    ends in .uvfits, .uvh5 or .zarr it is of that format. What is there is overwritten with `overwrite` only. All is
    worked out and kept beside the set before anything in it is changed.
    """

    after: ClassVar[tuple[str, ...]] = ("data", "noise", "calibrate", "correct", "image", "analyze")
    set: str
    column: str = "DATA"
    what: Literal["data", "model", "difference"] = "data"
    overwrite: bool = False
    fresh: bool = True

    @classmethod
    def from_table(cls, settings: Mapping[str, Any], beside: Beside) -> Self:
        """The stage; raises `InputError` where nothing says which set, and for a column of a new one."""
        read = beside.tables.get("data", {}).get("set")
        where = settings.get("set", read)
        if where is None:
            raise InputError("needs 'set', the Measurement Set to write, where there is no [data]")
        fresh = read is None or os.path.realpath(where) != os.path.realpath(read)
        if not fresh and not has_columns(str(read)):
            raise InputError(f"{read} is what is read, and has no columns: name a new file, {ENDINGS}")
        usual = "DATA" if fresh else USUAL.get(str(settings.get("what")), "CORRECTED_DATA")
        found = cls(**{"column": usual, **settings, "set": str(where), "fresh": fresh})
        if fresh and found.column != "DATA":
            raise InputError(f"column = '{found.column}': a new set has its visibilities in DATA")
        return found

    @property
    def needs_sky(self) -> bool:
        """Where a prediction is written or taken off."""
        return self.what != "data"

    @property
    def reads(self) -> bool:
        """Not where a prediction is written."""
        return self.what != "model"

    @property
    def named(self) -> str:
        """The file, or the column and its set."""
        return self.set if self.fresh else f"column {self.column} of {self.set}"

    def check(self, scene: Scene) -> None:
        """Refuse what is there already, before anything is computed."""
        if self.fresh:
            demand_free(self.set, self.overwrite)
        else:
            demand_column(self.set, self.column, self.overwrite)

    def work(self, run: Running) -> StageWork:
        """A file beside the set, and the set."""
        return StageWork(
            f"{WHAT[self.what]} into {self.named}",
            seconds=KEEPING * run.visibilities,
            finish_seconds=WRITING * run.visibilities,
            block_bytes=2 * 64.0 * float(np.prod(run.block)),
            finish_bytes=min(4 * BLOCK_BYTES, 4 * 64.0 * run.visibilities),  # as they are here and in the set
        )

    def items(self, run: Running) -> Items:
        """How far the sign of DP3's array factors makes its prediction differ."""
        far = sign_of_dp3(run) if self.needs_sky and not self.fresh else None
        if far is None:
            return Items()
        return Items(
            kept=(Item("phase = 'fringe'", f"DP3's array factors have the other sign: it differs by {far:.2g}"),)
        )

    def start(self, run: Running) -> StageRun:
        """The stage at work."""
        return _IntoRun(self, run)


def sign_of_dp3(run: Running) -> float | None:
    """Rms of the prediction less that with "everybeam", the sign of DP3, over its rms: of two times of one channel.

    None where the telescope has no such sign, or has DP3's.
    """
    instrument = run.instrument
    if getattr(instrument, "phase", None) != "fringe" or not instrument.chain().beams().parts:
        return None
    other = instrument.with_fields(phase="everybeam").chain()
    power = np.zeros(2)
    times, channels, _ = run.plan.problem.shape
    for t in {0, times // 2}:
        problem = run.plan.problem.block(slice(t, t + 1), slice(channels // 2, channels // 2 + 1))
        ours, theirs = (
            run.plan.engine.prepare(replace(problem, chain=chain), run.plan.engine_tolerance).sums(EVERY, EVERY)
            for chain in (instrument.chain(), other)
        )
        power += (np.abs(ours - theirs) ** 2).sum(), (np.abs(ours) ** 2).sum()
    return float(np.sqrt(power[0] / power[1])) if power[1] else None


class _IntoRun(StageRun):
    """Keeps the blocks in a file beside the set."""

    def __init__(self, stage: Into, run: Running) -> None:
        self.stage, self.run = stage, run
        place = Path(stage.set).absolute()
        if not place.parent.is_dir():
            raise InputError(f"[into] set = '{stage.set}': there is no folder {place.parent}")
        if not stage.fresh:
            self._set.demand_column(stage.column, stage.overwrite)
        demand_space(str(place), run.visibilities)
        self.open = ExitStack()
        weakref.finalize(self, self.open.close)  # also where the run is stopped
        self.kept = self.open.enter_context(beside(place)) / "blocks.h5"
        self.writer: StoreWriter | None = None
        self.usable = False

    def take(self, block: Visibilities) -> Visibilities:
        """Keep it, or what was predicted, or the one less the other."""
        model = self.run.model
        assert model is not None
        made = {"data": lambda: block, "model": lambda: model, "difference": lambda: block - model}[self.stage.what]()
        if not self.stage.fresh:
            assert isinstance(self.run.source, Seen)
            made = self.run.source.back(made)
        self.writer = self.writer or StoreWriter(self.kept, made)
        self.writer.add(made)
        self.usable = self.usable or not made.flag.all()
        return block

    def finish(self) -> StageResult:
        """Write the column, or the set."""
        assert self.writer is not None
        self.writer.finish()
        stage, kept = self.stage, VisibilityFile(self.kept)
        if not self.usable:
            self.open.close()
            raise RefusedError(f"every visibility is flagged, or has no solution: {stage.named} is not written")
        lacking = 0
        if stage.fresh:
            write(stage.set, kept, stage.overwrite, self.run.instrument)
        else:
            lacking = self._set.write(stage.column, kept, stage.overwrite)
        self.open.close()
        finished.append(f"{stage.named} is written")
        return IntoResult(stage, lacking / (4 * float(np.prod(kept.store.shape))))

    @property
    def _set(self) -> MeasurementSet:
        """The set that has the column."""
        assert isinstance(self.run.source, Seen)
        assert isinstance(self.run.source.source, MeasurementSet)
        return self.run.source.source


class IntoResult(StageResult):
    """Where it was written."""

    def __init__(self, stage: Into, lacking: float) -> None:
        self.stage, self.lacking = stage, lacking

    def record(self) -> dict[str, Any]:
        """The set and column."""
        stage = {name: getattr(self.stage, name) for name in ("set", "column", "what")}
        return {"into": stage | {"not_a_number": self.lacking}}

    def cards(self) -> list[Card]:
        """Where it was written."""
        stage = self.stage
        return [Card("Written", Path(stage.set).name if stage.fresh else stage.column, WHAT[stage.what])]

    def lines(self) -> list[str]:
        """The same in words."""
        stage = self.stage
        said = f"; {100 * self.lacking:.3g} % has no data or no solution: NaN there" if self.lacking else ""
        return [f"into          {WHAT[stage.what]}: {stage.named}{said}"]
