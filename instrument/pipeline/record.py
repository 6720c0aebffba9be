"""What a run has made: its result, the record that goes into run.json, and the short text for the terminal."""

from __future__ import annotations

import platform
import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field
from datetime import UTC, datetime
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any, TypeVar

from pydantic_core import to_json

from instrument.memory import high_water
from instrument.model import Instrument
from instrument.pipeline.scene_file import SceneFile
from instrument.pipeline.stage import StageResult, merge
from instrument.pipeline.work import RunPlan
from instrument.plan import Check, Plan, spell
from instrument.units import si_prefix

PACKAGES = ("instrument", "numpy", "scipy", "astropy", "astropy-iers-data", "pyerfa", "numba", "ducc0", "pydantic")
R = TypeVar("R", bound=StageResult)


@dataclass
class Result:
    """What a run made: its plan, the results of its stages by table, checks and timings, and the folder they are in."""

    scene: SceneFile
    instrument: Instrument
    plan: Plan
    folder: Path
    whole: RunPlan | None = None
    stages: dict[str, StageResult] = field(default_factory=dict)
    check: Check | None = None
    seconds: dict[str, float] = field(default_factory=dict)  # by stage
    grown: dict[str, float] = field(default_factory=dict)  # bytes, by stage, by which it raised the most of the process
    parts: dict[str, dict[str, float]] = field(default_factory=dict)  # of those, by stage, what each part took
    unused: dict[str, list[str]] = field(default_factory=dict)  # what was given and not used, by where it was given

    @property
    def passed(self) -> bool:
        """Whether every check held: the bound is met and every stage has passed."""
        told = self.check is None or not self.check.made or self.check.passed
        return told and all(stage.passed for stage in self.stages.values())

    @contextmanager
    def timed(self, stage: str) -> Iterator[None]:
        """Adds the wall time of what is inside to a stage, and by how much memory it outdid all before it."""
        begin, top = time.perf_counter(), high_water()
        try:
            yield
        finally:
            self.seconds[stage] = self.seconds.get(stage, 0.0) + time.perf_counter() - begin
            self.grown[stage] = self.grown.get(stage, 0.0) + high_water() - top


def record(result: Result, tables: dict[str, Any]) -> dict[str, Any]:
    """What `run.json` holds: versions, seed, plan, timings, checks, and what every stage tells of itself."""
    plan = result.plan
    out: dict[str, Any] = {
        "name": result.scene.name,
        "title": result.scene.title,
        "finished": datetime.now(UTC).isoformat(timespec="seconds"),
        "seed": result.scene.seed,
        "scene_hash": result.scene.fingerprint(),
        "versions": versions(),
        "machine": {"system": platform.platform(), "workers": plan.workers},
        "scene": tables,
        "plan": {
            "text": str(plan).splitlines(),
            "engine": plan.engine_name,
            "flops": plan.work.flops,
            "peak_bytes": plan.memory,
            "error_bound": plan.error_bound,
            "left_out": [i._asdict() for i in plan.left_out],
            "not_modelled": [i._asdict() for i in plan.not_modelled],
        },
        "unused": result.unused,
        "parts": {
            k: {n: round(v, 3) for n, v in parts.items() if v > 5e-4} for k, parts in result.parts.items() if parts
        },
        "checks": {},
        "stage_errors": {},
    }
    out |= costs(result.seconds, result.grown, result.whole)
    check = result.check
    if check is not None:
        out["checks"]["prediction"] = {
            "error": check.error,
            "bound": check.bound,
            "samples": check.samples,
            "relative_to_jy": check.scale_jy,
            "seen": {n: list(getattr(check, n)) for n in ("times", "channels", "stations", "baselines")},
            "text": str(check),
            "passed": check.passed if check.made else None,
        }
    for name, stage in result.stages.items():
        merge(out, stage.record(), name)
    return out


def costs(seconds: Mapping[str, float], grown: Mapping[str, float], plan: RunPlan | None = None) -> dict[str, Any]:
    """Seconds and bytes, planned and measured: "stages" by step, and "seconds" and "memory" of the whole.

    Bytes of a step are those by which it raised the most that the process has had; what came before the first step
    is in the whole. The seconds of the whole are those of the steps that were planned, where any were.
    """
    due, rise = (plan.seconds, plan.growth) if plan else ({}, {})
    steps = {
        name: {
            "seconds": {"planned": due.get(name), "measured": round(spent, 3)},
            "memory": {"planned_bytes": rise.get(name), "measured_bytes": grown.get(name, 0.0)},
        }
        for name, spent in seconds.items()
    }
    return {
        "stages": steps,
        "seconds": {
            "planned": sum(due.values()) if plan else None,
            "measured": round(sum(spent for name, spent in seconds.items() if not plan or name in due), 3),
        },
        "memory": {"planned_bytes": plan.memory if plan else None, "measured_bytes": high_water()},
    }


def versions() -> dict[str, str]:
    """Of Python and of the packages that matter."""
    return {"python": platform.python_version(), **{p: package_version(p) for p in PACKAGES}}


def package_version(name: str) -> str:
    """Version of an installed package, or "not installed"."""
    try:
        return version(name)
    except PackageNotFoundError:
        return "not installed"


def json_text(value: Any) -> str:
    """A record as JSON text; NaN and infinity, which JSON does not have, are null."""
    return to_json(value, indent=2, inf_nan_mode="null", fallback=float).decode()


def summary(result: Result) -> str:
    """The short text that matters, for the terminal."""
    lines = [line for stage in result.stages.values() for line in stage.lines()]
    if result.check is not None:
        lines.append(f"prediction    {result.check}")
    lines += spent(result.seconds, result.whole)
    lines.append(f"written       {result.folder}/report.html, run.json, tables, figures and cubes")
    return "\n".join(lines)


def spent(seconds: Mapping[str, float], plan: RunPlan | None = None) -> list[str]:
    """Lines on the time and the memory that were taken, beside what was planned."""
    steps = ", ".join(f"{k} {v:.1f}" for k, v in sorted(seconds.items(), key=lambda kv: -kv[1]))
    due = f", {spell(sum(plan.seconds.values()))} planned" if plan else ""
    room = f", {si_prefix(plan.memory, 'B')} planned" if plan else ""
    return [
        f"time          {sum(seconds.values()):.1f} s{due} ({steps})",
        f"memory        {si_prefix(high_water(), 'B')} at most{room}",
    ]
