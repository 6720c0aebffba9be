"""What a run has made: its result, the record that goes into run.json, and the short text for the terminal."""

from __future__ import annotations

import platform
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np

from instrument.analyze.leakage import CLEAR, Leakage
from instrument.analyze.photometry import SourceFluxes
from instrument.analyze.spectra import Spectrum2D
from instrument.analyze.subtraction import ManyDirectionsResult
from instrument.analyze.sweep import Sweep
from instrument.calibration_run import CalibrationResult
from instrument.cube_results import CubeResults
from instrument.doctor import package_version
from instrument.errors import Outcome
from instrument.image.cube import StokesCube
from instrument.model import Instrument
from instrument.plan import Check, Plan
from instrument.scene_file import SceneFile

PACKAGES = ("instrument", "numpy", "scipy", "astropy", "astropy-iers-data", "pyerfa", "numba", "ducc0", "pydantic")


@dataclass
class Result:
    """What a run made: its plan, cube, leakage, checks and timings, and the folder they are in."""

    scene: SceneFile
    instrument: Instrument
    plan: Plan
    folder: Path
    cube: StokesCube | None = None
    fluxes: SourceFluxes | None = None
    leakage: Leakage | None = None
    calibration: CalibrationResult | None = None
    spectra: dict[str, Spectrum2D] = field(default_factory=dict)
    products: CubeResults | None = None
    sweep: Sweep | ManyDirectionsResult | None = None
    check: Check | None = None
    seconds: dict[str, float] = field(default_factory=dict)
    notes: list[str] = field(default_factory=list)
    unused: dict[str, list[str]] = field(default_factory=dict)  # what was given and not used, by where it was given

    @property
    def passed(self) -> bool:
        """Whether every check held: the bound is met and every solve converged."""
        solved = self.fluxes is None or all(o is Outcome.CONVERGED for o in self.fluxes.outcome)
        solved = solved and (self.calibration is None or self.calibration.passed)
        solved = solved and (self.sweep is None or self.sweep.passed)
        solved = solved and (self.products is None or self.products.passed)
        return solved and (self.check is None or not self.check.made or self.check.passed)

    @contextmanager
    def timed(self, stage: str) -> Iterator[None]:
        """Adds the wall time of what is inside to a stage."""
        begin = time.perf_counter()
        try:
            yield
        finally:
            self.seconds[stage] = self.seconds.get(stage, 0.0) + time.perf_counter() - begin


def record(result: Result, tables: dict[str, Any]) -> dict[str, Any]:
    """What `run.json` holds: versions, seed, plan, timings, checks, headline figures."""
    plan = result.plan
    out: dict[str, Any] = {
        "name": result.scene.name,
        "title": result.scene.title,
        "finished": datetime.now(UTC).isoformat(timespec="seconds"),
        "seed": result.scene.seed,
        "versions": {"python": platform.python_version(), **{p: package_version(p) for p in PACKAGES}},
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
        "seconds": {k: round(v, 3) for k, v in result.seconds.items()},
        "checks": {},
        "stage_errors": _stage_errors(result),
    }
    if result.check is not None:
        out["checks"]["prediction"] = {
            "error": result.check.error,
            "bound": result.check.bound,
            "samples": result.check.samples,
            "relative_to_jy": result.check.scale_jy,
            "seen": {n: list(getattr(result.check, n)) for n in ("times", "channels", "stations", "baselines")},
            "text": str(result.check),
            "passed": result.check.passed if result.check.made else None,
        }
    if result.fluxes is not None:
        out["checks"]["photometry"] = {
            "outcome": [o.value for o in result.fluxes.outcome],
            "passed": all(o is Outcome.CONVERGED for o in result.fluxes.outcome),
            "flux_in_jy": float(result.fluxes.model_jy[0, :, 0].sum()),
            "flux_out_jy": float(result.fluxes.stokes_jy[0, :, 0].sum()),
        }
    if result.calibration is not None:
        out["calibration"] = result.calibration.record()
        out["checks"]["calibration"] = {
            "outcome": [o.value for o in set(result.calibration.solution.outcome.ravel())],
            "passed": result.calibration.passed,
        }
    if result.sweep is not None:
        out["checks"]["solutions"] = {"outcome": [], "passed": result.sweep.passed}
    if result.products is not None:
        found = result.products.record()
        out["checks"] |= found.pop("checks")
        out["stage_errors"] |= found.pop("stage_errors")
        out["cube"] = found
    if result.leakage is not None:
        out["leakage"] = {
            "inside_4_deg": result.leakage.inside(4.0),
            "rings": result.leakage.rings(),
            "near_null": int(result.leakage.near_null.sum()),
            "too_faint": int((~result.leakage.measured & ~result.leakage.near_null).sum()),
        }
    if result.cube is not None and result.cube.psf is not None:
        psf = result.cube.psf
        out["image"] = {
            "unit": result.cube.unit,
            "psf_arcmin": [round(float(np.rad2deg(x[0]) * 60), 3) for x in (psf.major_rad, psf.minor_rad)],
            "rms": {s: float(np.nanstd(result.cube.data[0, k])) for k, s in enumerate("IQUV")},
        }
    return out


def _stage_errors(result: Result) -> dict[str, str]:
    """How wrong each stage may be, in words, for the report."""
    out = {}
    if result.scene.image is not None and result.cube is not None:
        out["image"] = f"gridding {result.scene.image.accuracy:.0e} of the image rms asked for"
    if result.leakage is not None and result.leakage.expected is not None:
        use = result.leakage.measured
        use &= np.rad2deg(result.leakage.distance_rad) <= 4
        gap = np.abs(result.leakage.linear_percent - result.leakage.expected[:, 0])[use]
        if gap.size:
            out["photometry"] = (
                f"within 4 deg it differs from the beam model by {np.median(gap):.1e} percentage points in the median, "
                f"{gap.max():.1e} at most (linear)"
            )
    return out


def json_ready(value: Any) -> Any:
    """The same without NaN and infinity, which JSON does not have."""
    if isinstance(value, dict):
        return {k: json_ready(v) for k, v in value.items()}
    if isinstance(value, list | tuple):
        return [json_ready(v) for v in value]
    return None if isinstance(value, float) and not np.isfinite(value) else value


def summary(result: Result) -> str:
    """The short text that matters, for the terminal."""
    lines = []
    if result.leakage is not None:
        lines.append("")
        lines.append("distance      sources   I->P median   max %     I->V median   max %")
        for row in result.leakage.rings():
            lines.append(
                f"{row['from_deg']:4.1f}-{row['to_deg']:3.1f} deg  {row['sources']:7d}   {row['linear_median']:11.5f}"
                f" {row['linear_max']:8.5f}   {row['circular_median']:11.5f} {row['circular_max']:8.5f}"
            )
        near = int(result.leakage.near_null.sum())
        faint = int((~result.leakage.measured).sum()) - near
        if near:
            lines.append(f"left out: {near} sources near a null of the beam (apparent flux below 1 %)")
        if faint:
            lines.append(f"left out: {faint} sources too faint beside the others (error above {CLEAR:g} % of I)")
    if result.calibration is not None:
        lines += ["", *result.calibration.summary()]
    if result.sweep is not None:
        lines += ["", *result.sweep.lines()]
    if result.products is not None:
        lines += ["", *result.products.lines_of_text(), ""]
    if result.fluxes is not None:
        bad = [o.value for o in result.fluxes.outcome if o is not Outcome.CONVERGED]
        lines += [f"photometry fell short: {text}" for text in bad]
    if result.check is not None:
        lines.append(f"prediction    {result.check}")
    total = sum(result.seconds.values())
    stages = ", ".join(f"{k} {v:.1f}" for k, v in sorted(result.seconds.items(), key=lambda kv: -kv[1]))
    lines.append(f"time          {total:.1f} s ({stages})")
    lines.append(f"written       {result.folder}/report.html, run.json, tables, figures and cubes")
    return "\n".join(lines)
