"""The plan of a whole run: what each step costs, in blocks so small that the whole fits into the memory it may take."""

from __future__ import annotations

from typing import Any

from instrument.check import SHARE, cell_seconds
from instrument.errors import RefusedError
from instrument.machine import speed
from instrument.memory import high_water, resident
from instrument.numbers import brief
from instrument.pipeline.scene_file import SceneFile
from instrument.pipeline.stage import Running
from instrument.pipeline.work import (
    PREDICT,
    RECEIVERS,
    VERIFY,
    WRITE,
    RunPlan,
    StageWork,
    copies,
    predicting,
)
from instrument.plan import Plan, count_of
from instrument.planner import memory_limit
from instrument.predict.direct import Direct
from instrument.scene import Scene
from instrument.units import si_prefix

HALVINGS = 12  # of blocks until the run fits
LIBRARIES = 130e6  # bytes of numba, compiled loops and the libraries that stages load at their first block
PAGE_BYTES, PAGE_SECONDS, FIGURE_SECONDS = 120e6, 0.8, 0.7  # matplotlib and jinja2 loaded; a figure, day and night


def plan_run(
    file: SceneFile, scene: Scene, memory: Any = None, workers: int | None = None, verify: bool = True
) -> RunPlan:
    """The plan of a run of `scene`; `memory` (as "8 GB", by default three quarters of the machine) binds the whole.

    Raises `RefusedError` that names the largest step where even the smallest blocks do not fit.
    """
    limit = memory_limit(memory)
    found = whole(file, scene, file.plan(scene, None, workers), verify)
    for _ in range(HALVINGS):
        if found.memory <= limit:
            return found
        try:
            found = whole(file, scene, file.plan(scene, f"{found.plan.memory / 2:.0f} byte", workers), verify)
        except RefusedError:
            break
    raise RefusedError(_too_much(found, limit, memory))


def _too_much(found: RunPlan, limit: float, memory: Any) -> str:
    need = si_prefix(found.memory, "B")
    most, work = max(found.works.items(), key=lambda item: item[1].peak_bytes)
    asked = f"--memory {brief(memory)}" if memory is not None else "three quarters of this machine"
    remedy = work.remedy or "ask for less there, or give more memory (--memory)"
    return (
        f"the run takes about {need} of memory in the smallest blocks, {si_prefix(found.base_bytes, 'B')} of them the "
        f"interpreter's, and may take {si_prefix(limit, 'B')} ({asked}); most is of {most}, "
        f"{si_prefix(work.peak_bytes, 'B')} ({work.does}): {remedy}"
    )


def whole(file: SceneFile, scene: Scene, plan: Plan, verify: bool = True) -> RunPlan:
    """What every step of a run costs on a plan of its prediction."""
    run = Running(file.name, file.seed, scene.instrument, plan, file.running)
    works = {PREDICT: predicting(plan)} if file.modelled and not file.alone else {}
    if not file.read and any(stage.perfect for stage in file.running.values()):
        works[RECEIVERS] = copies(run.visibilities, run.block, 2.0, 0.55e-6, "their errors put into the blocks")
    items = {}
    for name, stage in file.running.items():
        works[name], items[name] = stage.work(run), stage.items(run)
    if verify and file.modelled:
        works[VERIFY] = _verifying(plan)
    figures = sum(work.figures for work in works.values())
    works[WRITE] = StageWork(
        f"tables, page, {count_of(figures, 'figure')}",
        finish_seconds=PAGE_SECONDS + FIGURE_SECONDS * figures,
        finish_bytes=PAGE_BYTES,
    )
    base = resident() + LIBRARIES
    return RunPlan(plan, works, items, base, max(base, high_water()), speed())


def _verifying(plan: Plan) -> StageWork:
    cell = Direct().work(plan.full.block(slice(0, 1), slice(0, 1))).slot_bytes
    seconds = max(cell_seconds(plan.full), SHARE * plan.seconds)
    return StageWork("against the definition", seconds=seconds, block_bytes=cell)
