"""Contests of engines on diffuse polarized skies: visibilities, their leakage alone, the floor it leaves in P(k)."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace
from typing import Any

import numpy as np

import instrument.registry as registry
from instrument.jones.mueller import stokes
from instrument.observe.grid import ImageGrid
from instrument.observe.observation import Observation
from instrument.precision.contest import UNSET, Contest, Entry, Form, Trial
from instrument.precision.truth import visibilities
from instrument.predict.base import Problem
from instrument.registry import load
from instrument.scene import Scene
from instrument.sky.image import ImageSky
from instrument.sky.points import PointSky
from instrument.units import Complex

FULL = tuple(10.0 ** (-k / 8) for k in range(16, 73))  # eight a decade, 1e-2 to 1e-9
SHORT = (1e-2, 1e-5, 1e-8)
# stations, integrations in 8 h, pixels, degrees across
SIZES = ((12, 64, 16, 2.0), (24, 720, 24, 4.0))
LOOKED = 4  # integrations of which the truth is worked out
DEFINITION = "direct"


def contests(engines: Iterable[str], form: Form) -> list[Contest]:
    """Of the engines that take images, by name; none where there is no such engine."""
    size = SIZES[0 if form.quick else 1]
    scene = _scene(*size)
    problem = scene.plan(engine=DEFINITION).problem
    known = [name for name in engines if load("engines", name).refuses(problem) is None]
    return [_visibilities(scene, problem, known, size[2], form)] if known else []


def _scene(stations: int, times: int, pixels: int, across: float) -> Scene:
    """Q and U of slope -2.7 without I and V, seen by stations of LOFAR from all of it."""
    from astropy import units as u

    k = np.hypot(*np.meshgrid(np.fft.fftfreq(pixels), np.fft.fftfreq(pixels)))
    k[0, 0] = k[0, 1]
    rng, images = np.random.default_rng(0), np.zeros((1, 4, pixels, pixels))
    for s in (1, 2):
        images[0, s] = np.fft.ifft2(np.fft.fft2(rng.normal(size=(pixels, pixels))) * k**-1.35).real
    grid = ImageGrid(pixels=pixels, pixel=across / pixels * u.deg)
    sky = ImageSky(grid=grid, stokes=images)
    return Scene(name="diffuse", instrument=_lofar(stations), sky=sky, observation=_night(times))


def _lofar(stations: int) -> Any:
    """So many stations of LOFAR, from the core to the last one, with their beams."""
    names = registry.load("telescopes", "lofar-hba", beam=None).layout().names
    some = np.linspace(0, len(names) - 1, stations).round().astype(int)
    return registry.load("telescopes", "lofar-hba", stations=[names[k] for k in some])


def _night(times: int) -> Observation:
    """8 hours about the transit of 3C196, in so many integrations."""
    from astropy import units as u

    return Observation(
        phase_centre="08h13m36.0s +48d13m03s", transit="2012-12-07", duration=8 * u.hour, interval=8 * u.hour / times,
        frequencies=[150] * u.MHz, channel_width=0.2 * u.MHz,
    )  # fmt: skip


def _truth(problem: Problem) -> Complex:
    """The sums over all pixels in extended precision, of a problem of one channel."""
    sky: Any = problem.sky
    ra, dec = sky.directions()
    flux = sky.planes(problem.at.freq_hz)[0].reshape(4, -1).T
    points = PointSky(names=tuple(map(str, range(len(flux)))), ra_rad=ra, dec_rad=dec, stokes_jy=flux)
    return np.asarray(visibilities(replace(problem, sky=points, at=problem.at.towards(ra, dec))), complex)


def _visibilities(scene: Scene, problem: Problem, engines: Iterable[str], pixels: int, form: Form) -> Contest:
    """Tolerance against sums over all pixels; I of a sky of Q and U is what leaks, and nothing else."""
    times, _, baselines = problem.shape
    looked = np.linspace(0, times - 1, LOOKED).round().astype(int)
    due = _truth(replace(problem, at=problem.at.some(looked)))
    scale, leaked = float(np.max(scene.plan(engine=DEFINITION).scale_jy)), _rms(stokes(due)[..., 0])

    def judge(found: Complex, asked: float) -> Trial:
        wrong = found[looked] - due
        alone = np.abs(stokes(wrong)[..., 0]) / leaked
        return Trial(float(np.abs(wrong).max() / scale), _rms(alone), user_max=float(alone.max()))

    def answer(engine: str) -> Any:
        return lambda tolerance: np.asarray(_plan(scene, engine, tolerance).run().data)

    values = SHORT if form.quick else FULL
    return Contest(
        name=f"predict a diffuse sky of {pixels} x {pixels} pixels",
        kind="engines",
        knob="tolerance",
        values=values,
        entries=tuple(Entry(e, answer(e), (UNSET,) if e == DEFINITION else ()) for e in engines),
        judge=judge,
        error=f"largest error of {baselines} baselines at {LOOKED} of {times} times, over the total flux",
        error_user="of the leakage alone: error of I of a sky of Q and U, over the rms of that I",
        truth="the sum over all pixels in extended precision",
        honoured=True,
    )


def _plan(scene: Scene, engine: str, tolerance: float) -> Any:
    """A plan to a tolerance, or of the exact sums."""
    return scene.plan(tolerance=0.0 if np.isnan(tolerance) else tolerance, engine=engine)


def _rms(x: Any) -> float:
    return float(np.sqrt(np.mean(np.abs(x) ** 2)))
