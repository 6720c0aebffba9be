"""Contests of engines on diffuse polarized skies: visibilities, their leakage alone, the floor it leaves in P(k)."""

from __future__ import annotations

import warnings
from collections.abc import Iterable
from dataclasses import replace
from typing import Any

import numpy as np

import instrument.registry as registry
from instrument.analyze.analyzer import Analyzer
from instrument.analyze.power.signal import Signal21cm
from instrument.image.dirty import Imager, Images
from instrument.image.mocks import polarized_screens
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
from instrument.units import Complex, Float

FULL = tuple(10.0 ** (-k / 2) for k in range(4, 19))  # two a decade, 1e-2 to 1e-9
SHORT = (1e-2, 1e-6)
# stations, integrations in 8 h, pixels, degrees across
SIZES = ((10, 64, 16, 1.0), (16, 240, 24, 4.0))
LOOKED = 4  # integrations of which the truth is worked out
DEFINITION = "direct"
# the floor: the same, with channels of 0.2 MHz about 150 MHz
CHANNELS = 9
FLOORS = ((8, 24, 16, 2.0), (20, 96, 32, 4.0))
UV_RANGE = (30.0, 230.0)
SMOOTH = 3  # terms of the polynomials along frequency that are taken for coherent
THERE = 0.01  # of the signal's power that these must leave in a bin


def contests(engines: Iterable[str], form: Form) -> list[Contest]:
    """Of the engines that take images, by name; none where there is no such engine."""
    size, wide = (of[0 if form.quick else 1] for of in (SIZES, FLOORS))
    scene = _scene(*size)
    problem = scene.plan(engine=DEFINITION).problem
    known = [name for name in engines if load("engines", name).refuses(problem) is None]
    others = [name for name in known if name != DEFINITION]  # which is the truth of the floor
    return [
        *([_visibilities(scene, problem, known, size[2], form)] if known else ()),
        *([_floor(others, *wide, form)] if others else ()),
    ]


def _scene(stations: int, times: int, pixels: int, across: float) -> Scene:
    """Q and U of slope -2.7 without I and V, seen by stations of LOFAR from all of it."""
    from astropy import units as u

    grid = ImageGrid(pixels=pixels, pixel=across / pixels * u.deg)
    sky = ImageSky(grid=grid, stokes=images_of(pixels))
    return Scene(name="diffuse", instrument=_lofar(stations), sky=sky, observation=_night(times))


def images_of(pixels: int) -> Float:
    """Images (1, 4, N, N) of Q and U whose power falls as k^-2.7, and of nothing in I and V."""
    k = np.hypot(*np.meshgrid(np.fft.fftfreq(pixels), np.fft.fftfreq(pixels)))
    k[0, 0] = k[0, 1]
    rng, images = np.random.default_rng(0), np.zeros((1, 4, pixels, pixels))
    for s in (1, 2):
        images[0, s] = np.fft.ifft2(np.fft.fft2(rng.normal(size=(pixels, pixels))) * k**-1.35).real
    return images


def _lofar(stations: int, core: bool = False) -> Any:
    """So many stations of LOFAR with their beams, from the core to the last one, or of the core alone."""
    names = registry.load("telescopes", "lofar-hba", beam=None).layout().names
    names = [name for name in names if name.startswith("CS") or not core]
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


def _floor(engines: Iterable[str], stations: int, times: int, pixels: int, across: float, form: Form) -> Contest:
    """What errors add to the power of I, over that of a 21-cm signal in the same images; galactic Q and U alone."""
    from astropy import units as u

    pixel, freq = across / pixels * u.deg, (150 + 0.2 * (np.arange(CHANNELS) - CHANNELS // 2)) * u.MHz
    night, lofar = _night(times).with_fields(frequencies=freq), _lofar(stations, core=True)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # it has no power at the largest scales, and none is asked for there
        signal = Signal21cm.table().cube(pixels, pixel, freq, 1)
    galaxy = polarized_screens(pixels, pixel, freq, 196)
    scene, other = (Scene(instrument=lofar, sky=cube.sky(), observation=night) for cube in (galaxy, signal))
    exact = scene.plan(engine=DEFINITION, uv_range=UV_RANGE).run()
    imager = Imager(pixels=pixels, pixel=pixel, uv_range=UV_RANGE)

    def power(data: Complex) -> tuple[Float, Float]:
        """Of the images of I per bin: of all, and of what no polynomial along frequency takes."""
        sums = Images(imager, None, lobes=False)
        sums.add(exact.with_data(data))
        cube = sums.finish()
        whole, rough = (
            Analyzer(cube.with_data(data)).spherical(taper=None, bins=6).power
            for data in (cube.data, np.einsum("fg,gsyx->fsyx", _without_smooth(), cube.data))
        )
        return whole, rough

    due, incoherent = power(other.plan(engine=DEFINITION, uv_range=UV_RANGE).run().data)
    there = incoherent > THERE * due

    def judge(found: Complex, asked: float) -> Trial:
        whole, rough = power(found - exact.data)
        share = rough[there] / incoherent[there]
        return Trial(float((whole / due).max()), _rms(share), user_max=float(share.max()))

    def answer(engine: str) -> Any:
        return lambda tolerance: np.asarray(_plan(scene, engine, tolerance, UV_RANGE).run().data)

    return Contest(
        name=f"floor in P(k), {CHANNELS} channels of {pixels} x {pixels} pixels",
        kind="engines",
        knob="tolerance",
        values=SHORT if form.quick else FULL[::2],
        entries=tuple(Entry(e, answer(e)) for e in engines),
        judge=judge,
        error="largest power in a bin of k that the error of I leaves, over that of a 21-cm signal at z = 8.5",
        error_user=f"of the spectrally incoherent part of the error: less {SMOOTH} terms along frequency in both",
        truth="the sum over all pixels in float64, good to 1e-12; I of a sky of Q and U is what leaks",
    )


def _without_smooth() -> Float:
    """What takes polynomials out of channels (F, F)."""
    terms = np.vander(np.linspace(-1, 1, CHANNELS), SMOOTH)
    return np.asarray(np.eye(CHANNELS) - terms @ np.linalg.pinv(terms))


def _plan(scene: Scene, engine: str, tolerance: float, uv_range: tuple[float, float] | None = None) -> Any:
    """A plan to a tolerance, or of the exact sums."""
    return scene.plan(tolerance=0.0 if np.isnan(tolerance) else tolerance, engine=engine, uv_range=uv_range)


def _rms(x: Any) -> float:
    return float(np.sqrt(np.mean(np.abs(x) ** 2)))
