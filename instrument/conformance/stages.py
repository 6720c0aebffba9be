"""The contract of stages: one claim per function, its name the sentence."""

from __future__ import annotations

import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from instrument.conformance.bench import demand
from instrument.image.dirty import Imager
from instrument.jones.gain import GainTerm
from instrument.model import Composed
from instrument.observe.layout import Layout
from instrument.observe.observation import Observation
from instrument.pipeline.record import json_text
from instrument.pipeline.run import stream
from instrument.pipeline.stage import Running, Stage, StageResult, StageRun
from instrument.pipeline.stages.image import Image
from instrument.report.page import Section
from instrument.scene import Scene
from instrument.sky.points import PointSky
from instrument.visibilities import Visibilities


def stage_scene() -> Scene:
    """Six stations with gain errors, three sources, six times, two channels: what stages are tried on."""
    from astropy import units as u

    rng = np.random.default_rng(1)
    enu = np.concatenate([rng.uniform(-300, 300, (6, 2)), np.zeros((6, 1))], axis=1)
    layout = Layout.from_enu([f"s{k}" for k in range(6)], enu * u.m, 0.12 * u.rad, 0.92 * u.rad, 50 * u.m)
    sky = PointSky(
        names=("a", "b", "c"), ra_rad=[2.15, 2.17, 2.14], dec_rad=[0.84, 0.85, 0.83],
        stokes_jy=[[9, 1, 0, 0], [3, 0, 0.5, 0], [1, 0, 0, 0.1]],
    )  # fmt: skip
    return Scene(
        name="contract",
        instrument=Composed(stations=layout, gain=GainTerm(rms=0.01, seed=1)),
        sky=sky,
        observation=Observation(
            phase_centre="08h13m36.0s +48d13m03s", transit="2012-12-07", duration=60 * u.min, interval=10 * u.min,
            frequencies=[150, 151] * u.MHz, channel_width=0.2 * u.MHz,
        ),
    )  # fmt: skip


class _Watch(Stage):
    """Stands behind a stage and keeps what it gives on."""

    def start(self, run: Running) -> StageRun:
        """Keeps the blocks."""
        return _WatchRun()


class _WatchRun(StageRun):
    def __init__(self) -> None:
        self.seen: list[Visibilities] = []

    def take(self, block: Visibilities) -> Visibilities:
        """Keep a block."""
        self.seen.append(block)
        return block

    def finish(self) -> _Watched:
        """The blocks."""
        return _Watched(self.seen)


class _Watched(StageResult):
    def __init__(self, seen: list[Visibilities]) -> None:
        self.seen = seen


def _ran(stage: Stage) -> tuple[StageResult, list[Visibilities]]:
    """What a stage makes of the scene, between images and a watch; and the blocks that come out of it."""
    from astropy import units as u

    scene = stage_scene()
    if stage.perfect:
        plan = scene.with_fields(instrument=scene.instrument.with_fields(gain=None)).plan(workers=1)
    else:
        plan = scene.plan(workers=1)
    imager = Image(imager=Imager(pixels=32, pixel=10 * u.arcmin))
    others: dict[str, Stage] = {} if stage.alone is not None else {"image": imager, "watch": _Watch()}
    stages = {"stage": stage, **others} if "image" not in stage.after else {**others, "stage": stage}
    run = Running("contract", 7, scene.instrument, plan, stages)
    stage.check(scene)
    stream(run)
    watched = run.results.get("watch")
    return run.results["stage"], watched.seen if isinstance(watched, _Watched) else []


def it_gives_on_blocks_of_the_same_coordinates_and_changes_none_in_place(stage: Stage) -> str:
    """Blocks come out as Visibilities of the same times, channels and baselines; what came in is as it was."""
    scene = stage_scene()
    plan = scene.plan(workers=1)
    if stage.alone is not None:
        return "it makes its own blocks"
    run = Running("contract", 7, scene.instrument, plan, {"stage": stage}, model=next(plan.blocks()))
    work, block = stage.start(run), next(plan.blocks())
    before = block.data.copy(), np.array(block.weight), np.array(block.flag)
    found = work.take(block)
    demand(isinstance(found, Visibilities), f"take gives a {type(found).__name__}")
    demand(found.data.shape == block.data.shape, f"take gives {found.data.shape} of {block.data.shape}")
    after = block.data, np.array(block.weight), np.array(block.flag)
    demand(all(np.array_equal(a, b) for a, b in zip(before, after, strict=True)), "take changes the block it is given")
    return ""


def it_makes_the_same_of_the_same_blocks(stage: Stage) -> str:
    """Two runs of a scene give on the same blocks, and the same record, numbers to 1e-6."""
    (one, first), (two, second) = _ran(stage), _ran(stage)
    demand(
        all(np.array_equal(a.data, b.data, equal_nan=True) for a, b in zip(first, second, strict=True)), "blocks differ"
    )
    here, there = dict(_leaves(one.record())), dict(_leaves(two.record()))
    demand(here.keys() == there.keys(), f"records have other names: {sorted(here.keys() ^ there.keys())}")
    for name, value in here.items():
        # threads add in any order
        same = np.isclose(value, there[name], 1e-6, 1e-9, True) if isinstance(value, float) else value == there[name]
        demand(same, f"{name} is {value} and then {there[name]}")
    return ""


def _leaves(value: Any, name: str = "") -> Iterator[tuple[str, Any]]:
    """Names and values of all that stands in nested dictionaries and lists."""
    inner = value.items() if isinstance(value, dict) else enumerate(value) if isinstance(value, list | tuple) else None
    if inner is None:
        yield name, value
        return
    for key, item in inner:
        yield from _leaves(item, f"{name}.{key}")


def its_result_can_be_told(stage: Stage) -> str:
    """A record that JSON takes, lines of text, and sections of a page with their figures; nothing beside its folder."""
    found, _ = _ran(stage)
    demand(isinstance(found, StageResult), f"finish gives a {type(found).__name__}")
    demand(isinstance(found.passed, bool), f"passed = {found.passed!r}")
    record = found.record()
    checks = record.get("checks", {})
    demand(all({"outcome", "passed"} <= set(check) for check in checks.values()), f"checks = {checks}")
    json_text(record)
    demand(all(isinstance(line, str) and "\n" not in line for line in found.lines()), "a line is not one line of text")
    with _folder() as folder:
        from instrument.report.style import drawer

        found.write(folder)
        sections = [*found.sections(drawer(folder)), *found.tables()]
        demand(all(isinstance(section, Section) for section in sections), "a section is no Section")
        names = sorted(path.name for path in folder.iterdir())
    return ", ".join(names) or "no file"


@contextmanager
def _folder() -> Iterator[Path]:
    with tempfile.TemporaryDirectory() as name:
        inner = Path(name) / "run"
        inner.mkdir()
        yield inner
        demand([p.name for p in Path(name).iterdir()] == ["run"], "it writes beside its folder")


CLAIMS = (
    it_gives_on_blocks_of_the_same_coordinates_and_changes_none_in_place,
    it_makes_the_same_of_the_same_blocks,
    its_result_can_be_told,
)
