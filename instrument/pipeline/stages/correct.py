"""The table [correct]: the beam towards the phase centre taken out of the visibilities."""

from __future__ import annotations

from typing import ClassVar, Literal

from instrument.errors import unused
from instrument.pipeline.stage import EachBlock, Running, Stage, StageRun
from instrument.pipeline.work import StageWork, copies
from instrument.scene import Scene

BLOCK = 8e-3  # seconds of a block, for where the phase centre stands and the beam there


class Correct(Stage):
    """Takes effects out of the visibilities: `beam = "centre"` the beam towards the phase centre."""

    after: ClassVar[tuple[str, ...]] = ("data", "noise", "calibrate")
    beam: Literal["centre"] = "centre"

    def ranges(self) -> tuple[tuple[float, float] | None, ...]:
        """None: what others ask for is corrected."""
        return ()

    def check(self, scene: Scene) -> None:
        """Name the table where there is no beam."""
        if not scene.instrument.chain().beams().parts:
            unused("scene", ["[correct]"], "the instrument has no beam to take out")

    def work(self, run: Running) -> StageWork:
        """Matrices of the stations on both sides of every visibility."""
        if not run.instrument.chain().beams().parts:
            return StageWork("no beam to take out")
        work = copies(run.visibilities, run.block, 2.0, 0.12e-6, "the beam towards the phase centre taken out")
        return work._replace(seconds=work.seconds + BLOCK * len(run.plan.slices))

    def start(self, run: Running) -> StageRun:
        """The stage at work."""
        return EachBlock(lambda block: block.without_beam(run.instrument))
