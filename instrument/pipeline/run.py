"""A scene file run end to end: a loop over the stages that are there, a check, and the run folder."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, nullcontext
from pathlib import Path
from typing import Any

from instrument.errors import unused_ledger
from instrument.jones.chain import Chain
from instrument.memory import give_back, quick_give_back
from instrument.pipeline.folder import RunFolder
from instrument.pipeline.on_curve import on_curve
from instrument.pipeline.planning import plan_run
from instrument.pipeline.progress import Progress, progress_bar
from instrument.pipeline.record import Result, costs, json_text, record, summary
from instrument.pipeline.scene_file import SceneFile
from instrument.pipeline.scene_text import to_toml
from instrument.pipeline.stage import EachBlock, Running, StageRun
from instrument.pipeline.work import PREDICT, RECEIVERS, VERIFY, WRITE
from instrument.provenance import provenance
from instrument.visibilities import Visibilities


def run(
    scene_file: SceneFile,
    tables: dict[str, Any],
    out: str | None = None,
    memory: str | None = None,
    workers: int | None = None,
    verify: bool = True,
    show: Callable[[str], None] = lambda text: None,
    force: bool = False,
) -> Result:
    """Run a scene file and write its folder; everything is written beside it first and moved there at the end.

    `tables` are the TOML tables it was made from. Raises `InputError` before anything is computed or written when the
    scene or the folder will not do. With `force` an earlier run folder is replaced.
    """
    folder = RunFolder(scene_file.name, out, force, scene_file.files())
    with unused_ledger() as ledger:
        result = _planned(scene_file, folder.path, memory, workers, verify)
        result.unused = ledger
        show(str(result.whole))
        with folder, progress_bar(scene_file.name) as bar:
            progress = _forward(bar)
            with provenance(**_known(result)):
                _compute(result, progress)
            progress(1 - result.whole.share(WRITE) if result.whole else 1.0, WRITE)
            with result.timed(WRITE), provenance(**_known(result)):
                _write(result, tables, folder.partial)
            result.folder = folder.finish()
    show(summary(result))
    return result


def computed(scene_file: SceneFile, verify: bool = True) -> Result:
    """A scene file run end to end in memory: nothing is written."""
    with unused_ledger() as ledger:
        result = _planned(scene_file, Path(), None, None, verify)
        result.unused = ledger
        _compute(result, lambda done, name: None)
    return result


def _planned(scene_file: SceneFile, path: Path, memory: str | None, workers: int | None, verify: bool) -> Result:
    """What will be filled: the scene and its plan."""
    begin = time.perf_counter()
    scene = scene_file.scene()
    whole = plan_run(scene_file, scene, memory, workers, verify)
    plan = whole.plan
    if verify and scene_file.modelled:  # the blocks as the stages get them, before any corruption
        plan = plan.watched(samples=64, seed=scene_file.seed)
    return Result(scene_file, scene.instrument, plan, path, whole, seconds={"plan": time.perf_counter() - begin})


def _known(result: Result) -> dict[str, str | int]:
    """What the files of a run say of it."""
    from instrument.units import mjd_text

    scene, problem = result.scene, result.plan.problem
    start = mjd_text(float(problem.at.slots_s[0]) - problem.interval_s / 2)
    return {"object": scene.name, "start": start, "seed": scene.seed, "scene": scene.fingerprint()}


def _book(result: Result) -> None:
    """Give the check the seconds that it took of the stage whose blocks it saw."""
    spent = result.plan.checker.spent if result.plan.checker else 0.0
    result.seconds[result.scene.alone or PREDICT] -= spent
    result.seconds[VERIFY] = spent


def _compute(result: Result, progress: Progress) -> None:
    """Stream the blocks through the stages that the scene has."""
    stages = result.scene.running
    run = Running(result.scene.name, result.scene.seed, result.instrument, result.plan, stages, parts=result.parts)
    run.modelled, run.read = result.scene.modelled, result.scene.read
    assert result.whole is not None
    stream(run, result.timed, progress, result.whole.share)
    result.stages = run.results
    if result.plan.checker:
        result.check = result.plan.check
        _book(result)


def stream(
    run: Running,
    timed: Callable[[str], AbstractContextManager[None]] = lambda name: nullcontext(),
    progress: Progress = lambda done, name: None,
    share: Callable[[str | None], float] = lambda name: 0.0 if name else 1.0,
) -> None:
    """Let the blocks of a plan go through stages one by one and fill in their results; `timed` clocks each stage.

    `progress` is told the fraction done and the step at work; `share` the part of the time that is the blocks'
    (`None`), or that a stage takes to finish.
    """
    passing = share(None)

    def at_work(name: str) -> AbstractContextManager[None]:
        run.now = name
        return timed(name)

    work: dict[str, StageRun] = {}
    if not run.read and any(stage.perfect for stage in run.stages.values()):
        errors = Chain(*run.instrument.receivers())
        work[RECEIVERS] = EachBlock(lambda block: block.corrupted(errors))
    for name, stage in run.stages.items():
        with at_work(name):
            work[name] = stage.start(run)
    alone = next((name for name, stage in run.stages.items() if stage.alone is not None), None)
    source = alone or (PREDICT if run.modelled else "data")
    named = ", ".join(dict.fromkeys([source, *work])) if alone is None else alone

    def passed(done: float) -> None:
        progress(passing * done, named)

    if alone is not None:
        blocks = work[alone].blocks(passed)
    elif run.modelled or run.source is None:
        blocks = run.plan.blocks(progress=passed)
    else:
        blocks = _counted(run.source.blocks(), len(run.plan.slices), passed)
    end = object()
    while True:
        with at_work(source):
            block = next(blocks, end)
        if not isinstance(block, Visibilities):
            break
        run.model = block
        for name, one in work.items():
            with at_work(name):
                block = one.take(block)
    run.model = None
    for name, one in work.items():
        progress(passing, name)
        with at_work(name):
            give_back()  # what the blocks took, up to 300 MB, stays with the threads that are gone
            run.results[name] = one.finish()
        passing += share(name)


def _forward(progress: Progress) -> Progress:
    """Progress that never goes back: sums of the shares of a run in two orders differ in their last bit."""
    most = 0.0

    def told(done: float, name: str | None = None) -> None:
        nonlocal most
        most = max(most, min(done, 1.0))
        progress(most, name)

    return told


def _counted(blocks: Iterator[Visibilities], count: int, passed: Callable[[float], None]) -> Iterator[Visibilities]:
    """Blocks of data, with the fraction that is done."""
    for k, block in enumerate(blocks, 1):
        yield block
        passed(k / count)


@quick_give_back()
def _write(result: Result, tables: dict[str, Any], folder: Path) -> None:
    """Everything of the run folder: scene, what the stages write, run.json, figures, report."""
    from instrument.report.page import write_page
    from instrument.report.run_page import page_of_run
    from instrument.report.style import drawer

    begin = time.perf_counter()
    (folder / "scene.toml").write_text(to_toml(tables), encoding="utf-8")
    for stage in result.stages.values():
        give_back()
        stage.write(folder)
    give_back()
    what = record(result, tables)
    draw = drawer(folder)
    # what the scene is about comes first, then the last that was made of it
    made = [*reversed(result.stages.values())]
    made.sort(key=lambda stage: not stage.leading)
    sections = [section for stage in made for section in stage.sections(draw)]
    long = [section for stage in made for section in stage.tables()]
    cards = [card for stage in made for card in stage.cards()]
    # all but the page itself is written by now
    what |= costs(result.seconds | {WRITE: time.perf_counter() - begin}, result.grown, result.whole)
    sections += on_curve(what, draw)
    page = page_of_run(what, cards, sections, long)
    write_page(page, folder / "report.html")
    what |= costs(result.seconds | {WRITE: time.perf_counter() - begin}, result.grown, result.whole)
    (folder / "run.json").write_text(json_text(what), encoding="utf-8")
