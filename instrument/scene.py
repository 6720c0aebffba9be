"""Scene: an instrument looking at a sky during an observation; from it comes the plan."""

from __future__ import annotations

from typing import Any

from instrument.checked import checked
from instrument.component import Component
from instrument.model import Instrument
from instrument.observe.observation import Observation
from instrument.plan import Plan
from instrument.planner import make_plan
from instrument.sky.base import Sky


@checked
class Scene(Component):
    """What is observed, with what, and when; `plan()` says what would be done, nothing is computed before `run`."""

    name: str = "scene"
    instrument: Instrument
    sky: Sky
    observation: Observation

    def plan(
        self,
        tolerance: float = 0.0,
        engine: str | None = None,
        memory: Any = None,
        workers: int | None = None,
        uv_range: tuple[float, float] | None = None,
    ) -> Plan:
        """What is kept, what is left out and why, by which engine, at what cost and error bound.

        `tolerance` bounds the error that may be made, relative to the total flux of the sky (0: exact omissions only);
        `engine` names one instead of the cheapest; `memory` ("8 GB") is the most the run may take, three quarters of
        the machine by default; `workers` the number of threads; `uv_range` (wavelengths) is
        all that is asked for: baselines never within it are left out. Raises `InputError` for impossible scenes and
        `RefusedError` when no engine or not enough memory serves.
        """
        return make_plan(
            self.name,
            (self.instrument, self.sky, self.observation),
            tolerance=tolerance,
            engine=engine,
            memory=memory,
            workers=workers,
            uv_range=uv_range,
        )
