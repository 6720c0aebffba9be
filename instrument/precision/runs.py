"""The contest of whole runs: the tolerance of a scene against its images, every stage of it included."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from instrument.errors import InputError
from instrument.pipeline.planning import plan_run
from instrument.pipeline.run import stream
from instrument.pipeline.scene_file import parse
from instrument.pipeline.scene_text import override, read_tables
from instrument.pipeline.stage import Running
from instrument.pipeline.stages.image import ImageResult
from instrument.precision.contest import Contest, Entry, Form, Trial
from instrument.precision.engines import CHANNELS, STATIONS, TIMES

FULL = tuple(10.0 ** (-k / 2) for k in range(4, 21))  # two a decade, 1e-2 to 1e-10
SHORT = (1e-2, 1e-6)
DEFINITION = "direct"


def contests_of_scene(name: str, engines: Mapping[str, Any], form: Form) -> list[Contest]:
    """One, of a scene that makes images: on its first stations, the middle times and the first channels.

    None where its stages refuse a scene that is so small.
    """
    tables = small(read_tables(name))
    if "image" not in tables:
        return []
    try:
        images = _images(tables, 0.0, DEFINITION)
    except InputError:
        return []
    peak = float(np.nanmax(np.abs(images[:, 0])))

    def judge(found: Any, asked: float) -> Trial:
        apart = (found - images) / peak
        return Trial(float(np.nanmax(np.abs(apart))), float(np.sqrt(np.nanmean(apart[:, 1:3] ** 2))))

    return [
        Contest(
            name=f"run {name}",
            kind="engines",
            knob="tolerance",
            values=SHORT if form.quick else FULL,
            entries=tuple(Entry(e, _answer(tables, e)) for e in engines if e != DEFINITION),
            judge=judge,
            error="largest error of a pixel in I, Q, U, V, over the peak of I",
            error_user="rms error of the images in Q and U, over the peak of I",
            truth="images of the same run whose engine is the definition (a loop over sources), tolerance 0; the "
            "imager is the same, its own accuracy no part of it",
        )
    ]


def small(tables: dict[str, Any]) -> dict[str, Any]:
    """The tables of a scene with its first stations, its middle times and its first channels."""
    scene = parse(tables).scene()
    night, settings = scene.observation, type(scene.instrument).model_fields
    changes = [f"observation.duration={min(TIMES, night.count) * night.interval!r} s"]
    if "channels" in tables["observation"].get("frequency", {}):
        changes.append(f"observation.frequency.channels={min(CHANNELS, len(night.freq_hz))}")
    found = override(tables, changes)
    if "stations" in settings:
        found["instrument"]["stations"] = list(scene.instrument.layout().names[:STATIONS])
    return found


def _answer(tables: dict[str, Any], engine: str) -> Any:
    return lambda tolerance: _images(tables, tolerance, engine)


def _images(tables: dict[str, Any], tolerance: float, engine: str) -> Any:
    """Images (F, 4, Ny, Nx) of a whole run: its plan, and blocks through all stages; figures and page are left out."""
    file = parse(tables | {"tolerance": tolerance, "engine": engine})
    scene = file.scene()
    plan = plan_run(file, scene, verify=False).plan
    running = Running(file.name, file.seed, scene.instrument, plan, file.running)
    stream(running)
    return next(np.array(r.cube.data) for r in running.results.values() if isinstance(r, ImageResult))
