"""A scene file run end to end: predict, correct, image, measure, verify, and write the run folder."""

from __future__ import annotations

import json
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

from instrument.analyze.analyzer import Analyzer
from instrument.analyze.leakage import expected_percent
from instrument.analyze.photometry import SourceFluxes
from instrument.analyze.spectra import Spectrum2D
from instrument.calibration_run import IMAGES, CalibrationStage
from instrument.errors import InputError, unused_ledger
from instrument.observe.sampling import Sampling
from instrument.plan import Plan
from instrument.report.progress import progress_bar
from instrument.run_folder import RunFolder
from instrument.run_record import Result, json_ready, record, summary
from instrument.scene_file import SEED_STEP, SceneFile
from instrument.scene_text import to_toml
from instrument.units import Float

NOISE_SEED = 3
EXPECTED_JONES = 4e6  # station Jones matrices spent on the leakage expected from the beam model


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
    folder = RunFolder(scene_file.name, out)
    with unused_ledger() as ledger:
        result = _planned(scene_file, folder.path, memory, workers, verify)
        result.unused = ledger
        show(str(result.plan))
        with folder:
            _compute(result)
            if verify:
                result.check = result.plan.check
                _book(result)
            with result.timed("write"):
                _write(result, tables, folder.partial)
            result.folder = folder.finish()
    show(summary(result))
    return result


def _planned(scene_file: SceneFile, path: Path, memory: str | None, workers: int | None, verify: bool) -> Result:
    """What will be filled: the scene and its plan."""
    begin = time.perf_counter()
    scene = scene_file.scene()
    # a run that calibrates predicts the perfect instrument: its errors are put in block by block, and are the truth
    solved = scene_file.calibrator() is not None
    perfect = scene.with_fields(instrument=scene.instrument.with_fields(gain=None, feed=None)) if solved else scene
    plan = scene_file.plan(perfect, memory, workers)
    if verify:  # the blocks as the stages get them, before any corruption
        plan = plan.watched(samples=64, seed=scene_file.seed)
    return Result(scene_file, scene.instrument, plan, path, seconds={"plan": time.perf_counter() - begin})


def _book(result: Result) -> None:
    """Give the check the seconds that it took of the stage whose blocks it saw."""
    spent = result.plan.checker.spent if result.plan.checker else 0.0
    stage = "sweep" if "sweep" in result.seconds else "predict"
    result.seconds[stage] -= spent
    result.seconds["verify"] = spent


def _compute(result: Result) -> None:
    """Stream the blocks through the stages that the scene has."""
    scene, plan = result.scene, result.plan
    laboratory = scene.laboratory()
    if laboratory is not None:
        with result.timed("sweep"), progress_bar(f"{scene.name}: predict, solve and measure every model") as update:
            result.sweep = laboratory.run(plan, progress=update)
        return
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
    solver = scene.calibrator()
    stage = None
    if solver is not None:
        extra = {name: scene.image.start(density) for name in IMAGES} if scene.image else {}
        stage = CalibrationStage(solver, result.instrument, extra)
    begin = time.perf_counter()
    others = sum(result.seconds.values())
    with progress_bar(f"{scene.name}: predict, calibrate, correct, image, measure") as update:
        for model in plan.blocks(progress=update):
            block = model if stage is None else stage.corrupt(model)
            if scene.noise is not None:
                from astropy import units as u

                block = block.with_noise(scene.noise.sefd * u.Jy, seed=SEED_STEP * scene.seed + NOISE_SEED)
            if stage is not None:
                with result.timed("calibrate"):
                    block = stage.correct(block, model)
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
            if scene.analyze and scene.image and "spectrum-2d" in scene.analyze.products:
                for stokes in ("I", "P", "V"):
                    found_spectrum = Analyzer(result.cube).spectrum_2d(
                        stokes=stokes, uv_range=scene.image.uv_range, taper="hann"
                    )
                    result.spectra[stokes] = found_spectrum
        if scene.analyze and scene.analyze.cube:
            result.products = scene.analyze.cube.run(result.cube)
            result.seconds |= result.products.seconds
    if stage is not None:
        with result.timed("calibrate"):
            result.calibration = stage.finish()
    if photometry is not None:
        with result.timed("photometry"):
            result.fluxes = photometry.finish()
        with result.timed("expected leakage"):
            expected = _expected(result.fluxes, plan, scene.correct is not None)
        found = Analyzer(result.cube, fluxes=result.fluxes, centre=centre).leakage()
        result.leakage = replace(found, expected=expected)


def _expected(fluxes: SourceFluxes, plan: Plan, differential: bool) -> Float:
    """Leakage (G, 2) in % the beam model has in the first channel of the fluxes, from evenly spread integrations."""
    channel = int(abs(plan.problem.at.freq_hz - fluxes.freq_hz[0]).argmin())
    at = plan.problem.at.block(slice(None), slice(channel, channel + 1)).towards(fluxes.ra_rad, fluxes.dec_rad)
    times, _, stations, sources = at.shape
    step = max(1, round(times * stations * sources / EXPECTED_JONES))
    chosen: Sampling = at.block(slice(step // 2, None, step), slice(None))
    return expected_percent(plan.problem.chain.beams(), chosen, fluxes.model_jy[0], differential=differential)


def _write(result: Result, tables: dict[str, Any], folder: Path) -> None:
    """Everything of the run folder: scene, run.json, FITS cubes, tables, figures, report."""
    from instrument.report.run_page import write_report

    (folder / "scene.toml").write_text(to_toml(tables), encoding="utf-8")
    if result.cube is not None:
        result.cube.write(folder / "cube.fits")
    if result.leakage is not None:
        result.leakage.write(folder / "leakage.ecsv")
    if result.calibration is not None:
        result.calibration.write(folder)
    if result.sweep is not None:
        result.sweep.write(folder)
    if result.products is not None:
        result.products.write(folder)
    for stokes, spectrum in result.spectra.items():
        spectrum.write(folder / f"spectrum_2d_{stokes}.ecsv")
    what = record(result, tables)
    curves: dict[str, Spectrum2D] = dict(result.spectra)
    if result.calibration is not None and result.scene.image is not None and result.spectra:
        curves = result.calibration.spectra(result.scene.image.uv_range)
    solved = result.calibration
    write_report(
        what,
        result.leakage,
        result.cube,
        result.plan.problem.at.centre,
        folder,
        solution=solved.solution if solved else None,
        errors=solved.errors if solved else None,
        spectra=curves,
        sweep=result.sweep,
        products=result.products,
    )
    (folder / "run.json").write_text(json.dumps(json_ready(what), indent=2, allow_nan=False), encoding="utf-8")
