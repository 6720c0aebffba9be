"""A scene file run end to end: predict, correct, image, measure, verify, and write the run folder."""

from __future__ import annotations

import json
import platform
import shutil
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np

from instrument.analyze.analyzer import Analyzer
from instrument.analyze.leakage import CLEAR, Leakage, expected_percent
from instrument.analyze.photometry import SourceFluxes
from instrument.doctor import package_version
from instrument.errors import InputError, Outcome
from instrument.image.cube import StokesCube
from instrument.model import Instrument
from instrument.observe.sampling import Sampling
from instrument.plan import Check, Plan
from instrument.report.progress import progress_bar
from instrument.scene_file import SEED_STEP, SceneFile, to_toml
from instrument.units import Float

NOISE_SEED = 3
EXPECTED_JONES = 4e6  # station Jones matrices spent on the leakage expected from the beam model
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
    check: Check | None = None
    seconds: dict[str, float] = field(default_factory=dict)
    notes: list[str] = field(default_factory=list)

    @property
    def passed(self) -> bool:
        """Whether every check held: the bound is met and every solve converged."""
        solved = self.fluxes is None or all(o is Outcome.CONVERGED for o in self.fluxes.outcome)
        return solved and (self.check is None or self.check.passed)

    @contextmanager
    def timed(self, stage: str) -> Iterator[None]:
        """Adds the wall time of what is inside to a stage."""
        begin = time.perf_counter()
        try:
            yield
        finally:
            self.seconds[stage] = self.seconds.get(stage, 0.0) + time.perf_counter() - begin


def run(
    scene_file: SceneFile,
    tables: dict[str, Any],
    out: str | None = None,
    memory: str | None = None,
    workers: int | None = None,
    verify: bool = True,
    show: Callable[[str], None] = lambda text: None,
) -> Result:
    """Run a scene file and write its folder; everything is written beside it first and moved there at the end.

    `tables` are the TOML tables it was made from. Raises `InputError` before anything is computed or written when the
    scene or the folder will not do.
    """
    folder = _folder(scene_file.name, out)
    begin = time.perf_counter()
    scene = scene_file.scene()
    plan = scene_file.plan(scene, memory, workers)
    result = Result(scene_file, scene.instrument, plan, folder, seconds={"plan": time.perf_counter() - begin})
    show(str(plan))
    partial = folder.with_name(f".{folder.name}.partial")
    shutil.rmtree(partial, ignore_errors=True)
    made = [p for p in partial.parents if not p.exists()]
    partial.mkdir(parents=True)
    try:
        _compute(result)
        if verify:
            with result.timed("verify"):
                result.check = plan.verify(samples=64, seed=scene_file.seed)
        with result.timed("write"):
            _write(result, tables, partial)
        if folder.exists():
            folder.rmdir()
        partial.rename(folder)
    finally:
        shutil.rmtree(partial, ignore_errors=True)
        _remove_empty(made)
    show(summary(result))
    return result


def _folder(name: str, out: str | None) -> Path:
    """The folder to write: the one asked for, which must be empty, or the next free one under runs/."""
    if out is not None:
        folder = Path(out)
        if folder.exists() and (not folder.is_dir() or any(folder.iterdir())):
            raise InputError(f"--out {out}: it exists and is not an empty folder; choose another")
        return folder
    folder = Path("runs") / name
    count = 1
    while folder.exists():
        count += 1
        folder = Path("runs") / f"{name}-{count}"
    return folder


def _remove_empty(folders: list[Path]) -> None:
    """Take away folders made for a run that left nothing in them."""
    for folder in folders:
        if folder.exists() and not any(folder.iterdir()):
            folder.rmdir()


def _compute(result: Result) -> None:
    """Stream the blocks through the stages that the scene has."""
    scene, plan = result.scene, result.plan
    centre = plan.problem.at.centre
    wants = scene.analyze.products if scene.analyze else ()
    images = photometry = density = None
    if scene.image is not None:
        if scene.image.weighting != "natural":
            with result.timed("weights"):
                density = scene.image.density(plan.coverage())
        images = scene.image.start(density)
    if "leakage" in wants:
        sky = plan.problem.sky.sources()
        if sky is None or scene.analyze is None:
            raise InputError("[analyze] products = ['leakage'] needs a sky that is a list of sources")
        photometry = scene.analyze.photometry().start(sky)
    begin = time.perf_counter()
    others = sum(result.seconds.values())
    with progress_bar(f"{scene.name}: predict, correct, image, measure") as update:
        for block in plan.blocks(progress=update):
            if scene.noise is not None:
                from astropy import units as u

                block = block.with_noise(scene.noise.sefd * u.Jy, seed=SEED_STEP * scene.seed + NOISE_SEED)
            if scene.correct is not None:
                with result.timed("correct"):
                    block = block.without_beam(result.instrument)
            if images is not None:
                with result.timed("image"):
                    images.add(block)
            if photometry is not None:
                with result.timed("photometry"):
                    photometry.add(block)
    spent = sum(result.seconds.values()) - others
    result.seconds["predict"] = time.perf_counter() - begin - spent
    if images is not None:
        with result.timed("image"):
            result.cube = images.finish()
    if photometry is not None:
        with result.timed("photometry"):
            result.fluxes = photometry.finish()
        with result.timed("expected leakage"):
            expected = _expected(result.fluxes, plan, scene.correct is not None)
        found = Analyzer(result.cube, fluxes=result.fluxes, centre=centre).leakage()
        result.leakage = replace(found, expected=expected)


def _expected(fluxes: SourceFluxes, plan: Plan, differential: bool) -> Float:
    """Leakage (G, 2) in % expected from the beam model at the first channel, from evenly spread integrations."""
    at = plan.problem.at.block(slice(None), slice(0, 1)).towards(fluxes.ra_rad, fluxes.dec_rad)
    times, _, stations, sources = at.shape
    step = max(1, round(times * stations * sources / EXPECTED_JONES))
    chosen: Sampling = at.block(slice(step // 2, None, step), slice(None))
    return expected_percent(plan.problem.chain.beams(), chosen, fluxes.model_jy[0], differential=differential)


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
            "passed": result.check.passed,
        }
    if result.fluxes is not None:
        out["checks"]["photometry"] = {
            "outcome": [o.value for o in result.fluxes.outcome],
            "passed": all(o is Outcome.CONVERGED for o in result.fluxes.outcome),
            "flux_in_jy": float(result.fluxes.model_jy[0, :, 0].sum()),
            "flux_out_jy": float(result.fluxes.stokes_jy[0, :, 0].sum()),
        }
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


def _write(result: Result, tables: dict[str, Any], folder: Path) -> None:
    """Everything of the run folder: scene, run.json, FITS cubes, tables, figures, report."""
    from instrument.report.run_page import write_report

    (folder / "scene.toml").write_text(to_toml(tables), encoding="utf-8")
    if result.cube is not None:
        result.cube.write(folder / "cube.fits")
    if result.leakage is not None:
        result.leakage.write(folder / "leakage.ecsv")
    what = record(result, tables)
    write_report(what, result.leakage, result.cube, result.plan.problem.at.centre, folder)
    (folder / "run.json").write_text(json.dumps(what, indent=2), encoding="utf-8")


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
    if result.fluxes is not None:
        bad = [o.value for o in result.fluxes.outcome if o is not Outcome.CONVERGED]
        lines += [f"photometry fell short: {text}" for text in bad]
    if result.check is not None:
        lines.append(f"prediction    {result.check}")
    total = sum(result.seconds.values())
    stages = ", ".join(f"{k} {v:.1f}" for k, v in sorted(result.seconds.items(), key=lambda kv: -kv[1]))
    lines.append(f"time          {total:.1f} s ({stages})")
    lines.append(f"written       {result.folder}/report.html, leakage.ecsv, cube.fits, run.json")
    return "\n".join(lines)
