"""The product "recovered": how much of the 21-cm signal of a sky is there at the end of the way, bin by bin."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from instrument.analyze.power.recovered import Recovered, recovered_power
from instrument.analyze.power.signal_sky import SignalSky
from instrument.analyze.power.transform import Transform
from instrument.errors import InputError
from instrument.image.cube import StokesCube
from instrument.image.present import in_kelvin
from instrument.pipeline.stage import Draw, Running, StageResult
from instrument.pipeline.stages.cube_page import CubeResults
from instrument.pipeline.stages.image import Image, ImageResult, imaging
from instrument.pipeline.stages.noise import Noise
from instrument.pipeline.work import StageWork
from instrument.plan import Plan
from instrument.predict.choice import SumReady, cheapest
from instrument.report.page import Card, Figures, Section, Table, Text, number
from instrument.sky.base import Sky

ANOTHER = 1  # added to the seed of the noise of the run, for noise that is not that of the run


def signal_of(sky: Sky) -> str:
    """The name of the member of a sum that is a 21-cm signal; raises `InputError` where there is not one, or two."""
    members: Mapping[str, Sky] = getattr(sky, "skies", {})
    found = [name for name, one in members.items() if isinstance(getattr(one, "maker", one), SignalSky)]
    if len(found) != 1:
        have = "no such member" if not found else f"{len(found)} of them: {', '.join(found)}"
        raise InputError(
            "[analyze] products = ['recovered'] needs a sky that is a sum with one 21-cm signal, [sky.NAME] kind = "
            f"'signal-21cm'; this one has {have}"
        )
    return found[0]


def shown_alone(run: Running, name: str) -> tuple[StokesCube, StokesCube | None]:
    """A member of the sky as the perfect instrument and the imager of a run show it, and noise of the run alone.

    In K where the beam is known. The beam towards the centre is taken out where the run does; the noise is another
    draw than that of the run.
    """
    alone = replace(run, plan=_plan_of(run, name), results={}, parts={})
    noise, correct = run.stage("noise", Noise), run.stages.get("correct")
    last = run.stages["image"].start(alone)
    after = [] if correct is None else [correct.start(alone)]
    ways = [[*after, last]]
    if noise is not None:
        ways.append(
            [noise.with_fields(seed=noise.seed + ANOTHER).start(alone), *after, run.stages["image"].start(alone)]
        )
    for block in alone.plan.blocks():
        passing = [block, block.with_data(np.zeros_like(block.data))]
        for one, way in zip(passing, ways, strict=False):
            for stage in way:
                one = stage.take(one)
    cubes = []
    for way in ways:
        made = way[-1].finish()
        assert isinstance(made, ImageResult)
        cubes.append(in_kelvin(made.cube))
    return cubes[0], cubes[1] if len(cubes) > 1 else None


def _plan_of(run: Running, name: str) -> Plan:
    """The plan of one member of a sum of skies without errors of receivers, by the engine that is ready for it."""
    plan = run.plan
    errors = run.instrument.errors() and not any(stage.perfect for stage in run.stages.values())
    problem = plan.problem.members()[name]
    if isinstance(plan.ready, SumReady) and not errors:
        ready = dict(plan.ready.ready)[name].ready
    else:
        problem = replace(problem, chain=run.instrument.perfect().chain())
        ready = cheapest(problem, None, plan.engine_tolerance).ready
    found = replace(plan, full=plan.full.members()[name], problem=problem, engine=ready.engine, checker=None)
    vars(found)["ready"] = ready
    return found


def recovered(run: Running, name: str, images: ImageResult, cube: CubeResults) -> RecoveredResult:
    """The power of the signal in the cube of a run as it is, and in what a removal of foregrounds has left."""
    settings = cube.settings
    how = Transform(
        "I", settings.taper, settings.taper_space, settings.uv_range, infill=settings.infill_time(),
        redshift=settings.redshift,
    )  # fmt: skip
    injected, noise = shown_alone(run, name)
    ends = {"with foregrounds": in_kelvin(images.cube)}
    if cube.split is not None and cube.split.remover.stokes == "I":
        ends["foregrounds removed"] = cube.split.residual
    found = {what: recovered_power(end, injected, noise, how, settings.bins) for what, end in ends.items()}
    return RecoveredResult(name, found)


def recovering(run: Running) -> StageWork:
    """What it costs to predict the signal once more, and to image it, and noise where there is some."""
    image = run.stage("image", Image)
    assert image is not None
    count = 2 if run.stage("noise", Noise) is not None else 1
    one = imaging(image.imager, run, count)
    voxels = float(run.plan.problem.shape[1]) * image.imager.pixels**2
    return StageWork(
        "the 21-cm signal alone, predicted and imaged again",
        finish_seconds=run.plan.seconds + one.seconds + one.finish_seconds + 4e-7 * voxels,
        finish_bytes=run.plan.memory + one.held_bytes + max(one.block_bytes, one.finish_bytes) + 60 * voxels,
        figures=1,
        remedy=one.remedy,
    )


@dataclass(frozen=True)
class RecoveredResult(StageResult):
    """Recovered over injected power of the signal `name`, at one end of the way or more, by what the end is called."""

    name: str
    ends: Mapping[str, Recovered]

    def record(self) -> dict[str, Any]:
        """Wavenumbers, ratio and transfer with their scatter of every bin that has cells, at each end."""
        out = {}
        for what, one in self.ends.items():
            rows = one.table()
            out[what] = {key: np.round(np.asarray(rows[key], float), 6).tolist() for key in rows.colnames}
        return {"recovered": out}

    def lines(self) -> list[str]:
        """The middle half of the bins at each end."""
        return [f"recovered     {what}: {self._said(one)}" for what, one in self.ends.items()]

    def _said(self, one: Recovered) -> str:
        ratio, transfer = (f"{np.nanmedian(values):.3g}" for values in (one.ratio, one.transfer))
        return f"{ratio} of the power of '{self.name}', {transfer} of the signal itself (medians of the bins of k)"

    def write(self, folder: Path) -> None:
        """recovered.ecsv of the end of the way, and recovered_with_foregrounds.ecsv where these were removed."""
        *before, (_, last) = self.ends.items()
        last.write(folder / "recovered.ecsv")
        for what, one in before:
            one.write(folder / f"recovered_{what.replace(' ', '_')}.ecsv")

    def cards(self) -> list[Card]:
        """What came through of the signal, at the end."""
        (what, one) = list(self.ends.items())[-1]
        found, power = (number(100 * float(np.nanmedian(values))) for values in (one.transfer, one.ratio))
        return [Card("21-cm signal recovered", f"{found}\u00a0%", f"{power}\u00a0% of its power, {what}")]

    def sections(self, draw: Draw) -> list[Section]:
        """Ratio and transfer against k, and the table of the end."""
        from instrument.report.recovered import recovered_over_injected

        text = (
            f"The sky holds a known 21-cm signal, '{self.name}'. Ratio: power at the end of the way over that of the "
            "signal as the perfect instrument and the same imager show it alone; above 1 is foreground, leakage or "
            "noise that is left, below 1 signal that was lost. Transfer: what came through of the signal itself, "
            "whatever else is there."
        )
        drawn = draw("recovered", recovered_over_injected(self.ends), "Recovered over injected, by k; bars: scatter.")
        what, last = list(self.ends.items())[-1]
        table = Table.of(last.table(), f"{what[0].upper()}{what[1:]}.")
        return [Section("Signal recovered", [Text(text), Figures([drawn]), table])]
