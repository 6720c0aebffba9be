"""The contest of engines: tolerance against the definition in extended precision, on LOFAR's beams or a scene given."""

from __future__ import annotations

from typing import Any

import numpy as np

from instrument.errors import InputError, RefusedError
from instrument.pipeline.scene_file import parse
from instrument.pipeline.scene_text import read_tables
from instrument.precision import diffuse
from instrument.precision.contest import Contest, Entry, Form, Trial
from instrument.precision.diffuse import DEFINITION
from instrument.precision.truth import visibilities
from instrument.registry import load
from instrument.scene import Scene
from instrument.units import Complex

STATIONS, TIMES, CHANNELS = 12, 32, 1  # of which the truth is worked out: 66 baselines
FULL = tuple(10.0 ** (-k / 8) for k in range(16, 97))  # eight a decade, 1e-2 to 1e-12
SHORT = tuple(10.0**-k for k in range(2, 13))


def contests(engines: dict[str, Any], form: Form) -> list[Contest]:
    """Of every engine on a sky that it takes: the grid of sources of the mock observation, and diffuse skies."""
    points = parse(read_tables("mock-grid")).scene().plan(engine=DEFINITION).problem
    fit = {name: cls for name, cls in engines.items() if load("engines", name).refuses(points) is None}
    return [*(contests_of_scene("mock-grid", fit, form) if fit else ()), *diffuse.contests(engines, form)]


def contests_of_scene(name: str, engines: dict[str, Any], form: Form) -> list[Contest]:
    """The contest on the first stations, the middle times and the first channels of a scene."""
    scene = _few_times(parse(read_tables(name)).scene())
    full = scene.plan().full
    if full.sky.kind != "points":
        what = "an image" if full.sky.kind == "image" else "no list of sources"
        raise InputError(f"scene {name}: its sky is {what}, and the truth of engines is of lists of sources so far")
    chosen = np.flatnonzero((full.antenna1 < STATIONS) & (full.antenna2 < STATIONS))
    truth = visibilities(full.between(full.antenna1[chosen], full.antenna2[chosen]))
    scale = float(np.max(scene.plan().scale_jy))
    # the definition sums whatever is asked for, and slowly
    once = SHORT[:2] if form.quick else ()
    entries = tuple(Entry(e, _answer(scene, e, chosen), once if e == DEFINITION else ()) for e in engines)

    def judge(found: Complex, asked: float) -> Trial:
        apart = (found - truth) / scale
        polarized = np.stack([apart[..., 0, 0] - apart[..., 1, 1], apart[..., 0, 1] + apart[..., 1, 0]]) / 2
        return Trial(float(np.abs(apart).max()), float(np.sqrt(np.mean(np.abs(polarized) ** 2))))

    return [
        Contest(
            name=f"predict {name}",
            kind="engines",
            knob="tolerance",
            values=SHORT if form.quick else FULL,
            entries=entries,
            judge=judge,
            error=f"largest error of a visibility of {len(chosen)} of {full.shape[2]} baselines, over the total flux",
            error_user="rms error of Q and U over the total flux",
            truth="the direct sum in extended precision (64-bit mantissa, 2000 times below rounding in float64)",
            honoured=True,
        )
    ]


def _answer(scene: Scene, engine: str, chosen: Any) -> Any:
    def answer(tolerance: float) -> Complex:
        plan = scene.plan(tolerance=tolerance, engine=engine)
        if plan.sum_bound > tolerance:
            raise RefusedError(f"its bound is {plan.sum_bound:.1e}: the floor")
        return np.asarray(plan.run().data[:, :, chosen])

    return answer


def _few_times(scene: Scene) -> Scene:
    from astropy import units as u

    night = scene.observation
    times = min(TIMES, round(night.duration / night.interval))
    few = night.with_fields(
        duration=times * night.interval * u.s, frequencies=np.asarray(night.frequencies)[:CHANNELS] * u.Hz
    )
    return scene.with_fields(observation=few)
