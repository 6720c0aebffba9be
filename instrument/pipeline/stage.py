"""Stage: one table of a scene file as a step of a run; an absent table is an absent stage."""

from __future__ import annotations

import time
from abc import abstractmethod
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, ClassVar, Self, TypeVar

from instrument.component import Component
from instrument.errors import InputError
from instrument.image.base import AnyImager
from instrument.image.weights import Density
from instrument.model import Instrument
from instrument.pipeline.work import Items, StageWork
from instrument.plan import Plan
from instrument.report.page import Card, FigureEntry, Section
from instrument.scene import Scene
from instrument.visibilities import Visibilities, VisibilitySet

SEED_STEP = 1000  # seeds of what a scene draws are derived from its one seed
S = TypeVar("S", bound="Stage")
R = TypeVar("R", bound="StageResult")
Draw = Callable[..., FigureEntry]  # name, drawing, caption, wide: a figure of the run folder, as an entry of its page


@dataclass(frozen=True)
class Beside:
    """What stands in a scene file beside the table of a stage: the other tables as written, the seed, the channels."""

    seed: int
    tables: Mapping[str, Mapping[str, Any]]
    width_hz: float | None

    def seed_of(self, step: int) -> int:
        """A seed for what is drawn in a step of this scene: 1 gains, 2 feeds, 3 noise and laboratories."""
        return SEED_STEP * self.seed + step


class Stage(Component):
    """A step of a run, by the name of its table: takes the blocks of visibilities one by one, then finishes.

    `after` are tables whose stages come before this one where they are there. A stage that is `perfect` compares with
    what a perfect instrument would see: gains and feed errors are put into the blocks, and `Running.model` has none. A
    stage with `alone` makes its own blocks from the plan; the tables named there are its own, all others are not used.
    """

    plugin_kind: ClassVar[str | None] = "stages"
    after: ClassVar[tuple[str, ...]] = ()
    perfect: ClassVar[bool] = False
    alone: ClassVar[tuple[str, ...] | None] = None

    @classmethod
    def from_table(cls, settings: Mapping[str, Any], beside: Beside) -> Self:
        """The stage of a table; raises `InputError` for settings that will not do beside the other tables."""
        return cls(**settings)

    def ranges(self) -> tuple[tuple[float, float] | None, ...]:
        """The uv range, in wavelengths, of each thing that is made here; `None` for all baselines.

        None at all (an empty tuple) where a stage only passes on what others ask for.
        """
        return (None,)

    @property
    def reads(self) -> bool:
        """Whether it looks at the visibilities that pass."""
        return True

    @property
    def needs_sky(self) -> bool:
        """Whether it needs a model of the sky, also where visibilities come from [data]."""
        return self.perfect or self.alone is not None

    def check(self, scene: Scene) -> None:
        """Raise `InputError` for a scene in which this stage cannot work; name what it will not use (`unused`)."""
        return None

    def work(self, run: Running) -> StageWork:
        """What it costs in a run that is planned: seconds and bytes, which go into the plan; nothing unless said."""
        return StageWork()

    def items(self, run: Running) -> Items:
        """What it keeps, leaves out and does not model, with bounds, for the plan."""
        return Items()

    @abstractmethod
    def start(self, run: Running) -> StageRun:
        """The stage at work."""


@dataclass
class Running:
    """What stages are told of the run they are in, and where they find what the others have made."""

    name: str
    seed: int
    instrument: Instrument  # with the errors of its receivers
    plan: Plan
    stages: Mapping[str, Stage]
    results: dict[str, StageResult] = field(default_factory=dict)
    model: Visibilities | None = None  # the present block as it was predicted
    parts: dict[str, dict[str, float]] = field(default_factory=dict)  # seconds, by stage, of what it names
    now: str = ""  # the stage at work
    modelled: bool = True  # else nothing is predicted, and the blocks are those of `source`
    read: bool = False  # whether the blocks of `source` take the place of those that were predicted
    source: VisibilitySet | None = None  # what [data] holds
    _densities: dict[str, dict[float, Density] | None] = field(default_factory=dict)

    @property
    def block(self) -> tuple[int, int, int]:
        """Times, channels and baselines (T, F, B) of a block."""
        return (*self.plan.block_shape, self.plan.problem.shape[2])

    @property
    def visibilities(self) -> float:
        """How many there are in the run."""
        times, channels, baselines = self.plan.problem.shape
        return float(times) * channels * baselines

    @contextmanager
    def timed(self, part: str) -> Iterator[None]:
        """Adds the wall time of what is inside to a part of the stage at work, for the report."""
        begin, parts = time.perf_counter(), self.parts.setdefault(self.now, {})
        try:
            yield
        finally:
            parts[part] = parts.get(part, 0.0) + time.perf_counter() - begin

    def density(self, imager: AnyImager) -> dict[float, Density] | None:
        """Density of the uv plane that the weights of an imager need, over the whole run; `None` for natural ones."""
        key = imager.fingerprint()
        if key not in self._densities:
            with self.timed("weights"):
                self._densities[key] = imager.density(self.source if self.read and self.source else self.plan)
        return self._densities[key]

    def stage(self, name: str, kind: type[S]) -> S | None:
        """The stage of a table where it is there and of a kind."""
        found = self.stages.get(name)
        return found if isinstance(found, kind) else None

    def result(self, name: str, kind: type[R]) -> R:
        """What the stage of a table has made; raises `InputError` where there is none of that kind."""
        found = self.results.get(name)
        if not isinstance(found, kind):
            raise InputError(f"[{self.now}] needs what [{name}] makes: give a table [{name}]")
        return found


class StageRun:
    """A stage at work. What it holds must not grow with the length of the run."""

    def take(self, block: Visibilities) -> Visibilities:
        """Look at a block, and give it on as the next stage shall see it."""
        return block

    def blocks(self, progress: Callable[[float], None]) -> Iterator[Visibilities]:
        """The blocks of a run that a stage makes alone; called for no other."""
        raise NotImplementedError

    def finish(self) -> StageResult:
        """What was made of all blocks."""
        return StageResult()


class EachBlock(StageRun):
    """A stage that makes another block of every block, and keeps nothing."""

    def __init__(self, change: Callable[[Visibilities], Visibilities]) -> None:
        self.change = change

    def take(self, block: Visibilities) -> Visibilities:
        """The block as it was changed."""
        return self.change(block)


class StageResult:
    """What a stage has made, and how it is told: in run.json, on the terminal, in files, on the page.

    A scene that has a `leading` one is about it: its part of the page comes first. Others follow from the last that
    was made to the first.
    """

    leading: ClassVar[bool] = False

    @property
    def passed(self) -> bool:
        """Whether everything here held; a run that did not pass ends with status 3."""
        return True

    def record(self) -> dict[str, Any]:
        """What `run.json` holds of it: names and values.

        Under "checks" by name what was checked (outcome, passed: true, false, or null where it was not made), under
        "stage_errors" by name how wrong it may be, in words; everything else under names of its own.
        """
        return {}

    def lines(self) -> list[str]:
        """The short text for the terminal."""
        return []

    def write(self, folder: Path) -> None:
        """Write tables and cubes into the run folder."""

    def cards(self) -> list[Card]:
        """Headline numbers of the page."""
        return []

    def sections(self, draw: Draw) -> list[Section]:
        """Its part of the page, the result first; `draw(name, drawing, caption)` makes a figure of the run folder."""
        return []

    def tables(self) -> list[Section]:
        """Long tables, which the page has near its end."""
        return []


@dataclass(frozen=True)
class Several(StageResult):
    """What a stage has made, in parts."""

    parts: list[StageResult] = field(default_factory=list)

    @property
    def passed(self) -> bool:
        """Whether every part did."""
        return all(part.passed for part in self.parts)

    def record(self) -> dict[str, Any]:
        """Those of all parts together."""
        out: dict[str, Any] = {}
        for part in self.parts:
            merge(out, part.record())
        return out

    def lines(self) -> list[str]:
        """Those of all parts."""
        return [line for part in self.parts for line in part.lines()]

    def write(self, folder: Path) -> None:
        """Write all parts."""
        for part in self.parts:
            part.write(folder)

    def cards(self) -> list[Card]:
        """Those of all parts."""
        return [card for part in self.parts for card in part.cards()]

    def sections(self, draw: Draw) -> list[Section]:
        """Those of all parts."""
        return [section for part in self.parts for section in part.sections(draw)]

    def tables(self) -> list[Section]:
        """Those of all parts."""
        return [section for part in self.parts for section in part.tables()]


def merge(record: dict[str, Any], part: Mapping[str, Any], name: str = "") -> None:
    """Put a part of what run.json holds into the whole: checks and stage errors beside those that are there.

    A name that is taken is written as "STAGE.NAME": nothing that is there is lost, nor what the stage found.
    """
    for key, value in part.items():
        if key in ("checks", "stage_errors"):
            inside = record.setdefault(key, {})
            inside.update({(f"{name}.{k}" if k in inside else k): v for k, v in value.items()})
        else:
            record[f"{name}.{key}" if key in record else key] = value


def in_order(stages: Mapping[str, Stage]) -> dict[str, Stage]:
    """Stages by name, each behind those that its `after` names; by name where that leaves it open."""
    waiting = sorted(stages)
    out: dict[str, Stage] = {}
    while waiting:
        ready = next((n for n in waiting if not set(stages[n].after) & set(waiting) - {n}), None)
        if ready is None:
            raise InputError(f"the stages {', '.join(waiting)} each come after another of them: mend their 'after'")
        out[ready] = stages[ready]
        waiting.remove(ready)
    return out
