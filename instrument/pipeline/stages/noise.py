"""The table [noise]: thermal noise of stations of one `sefd`."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Annotated, Any, ClassVar, Self

import numpy as np
from pydantic import Field

from instrument.errors import InputError
from instrument.pipeline.stage import Beside, EachBlock, Running, Stage, StageRun
from instrument.pipeline.work import StageWork, copies
from instrument.units import Jansky, Real, Seed

STEP = 3  # of the seeds of a scene


class Noise(Stage):
    """Thermal noise of stations whose system equivalent flux density is `sefd`, independent in every visibility.

    With `nights` it is that of the mean of so many nights like this one: its variance over their number.
    """

    after: ClassVar[tuple[str, ...]] = ("data",)
    sefd: Annotated[Jansky, Field(gt=0)]
    nights: Annotated[float, Real(above=0)] = 1.0
    seed: Seed

    @classmethod
    def from_table(cls, settings: Mapping[str, Any], beside: Beside) -> Self:
        """The stage, its seed that of the scene."""
        if beside.width_hz is None:
            raise InputError("needs the width of a channel: give channel_width in [observation]")
        return cls(**{"seed": beside.seed_of(STEP), **settings})

    def ranges(self) -> tuple[tuple[float, float] | None, ...]:
        """None: noise is added to what others ask for."""
        return ()

    def work(self, run: Running) -> StageWork:
        """Eight random numbers a visibility, and another block."""
        nights = f", mean of {self.nights:g} nights" if self.nights != 1 else ""
        return copies(run.visibilities, run.block, 3.0, 0.3e-6, f"{self.sefd:g} Jy a station{nights}")

    def start(self, run: Running) -> StageRun:
        """The stage at work."""
        from astropy import units as u

        sefd = self.sefd / np.sqrt(self.nights) * u.Jy
        return EachBlock(lambda block: block.with_noise(sefd, seed=self.seed))
