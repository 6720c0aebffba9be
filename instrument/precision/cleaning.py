"""The contest of imagers that clean: fluxes that were put in and what is left of the noise, by major cycles."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

import instrument.registry as registry
from instrument.observe.directions import LIGHT
from instrument.observe.grid import ImageGrid
from instrument.observe.observation import Observation
from instrument.precision.contest import Contest, Entry, Form, Trial
from instrument.scene import Scene
from instrument.sky.points import PointSky
from instrument.units import Float
from instrument.visibilities import Visibilities

# stations, integrations, pixels, sources
SIZES = ((30, 16, 128, 30), (59, 32, 480, 150))
CYCLES = (1.0, 2.0, 3.0, 5.0, 8.0, 12.0)
ARCMIN, UV_RANGE = (1.0, 0.5), (30.0, 800.0)
SEFD = 300.0  # of the stations, Jy
BRIGHT = 5.0  # times the noise, from which on fluxes are judged


def contests(imagers: dict[str, Any], form: Form) -> list[Contest]:
    """One a size, of the imagers whose images are restored; none where there is no such imager."""
    known = {name: cls for name, cls in imagers.items() if cls.restores and "cycles" in cls.model_fields}
    sizes = list(zip(SIZES, ARCMIN, strict=True))[: 1 if form.quick else None]
    return [_contest(known, *size, arcmin, form) for size, arcmin in sizes] if known else []


def _contest(
    imagers: dict[str, Any], stations: int, times: int, pixels: int, count: int, arcmin: float, form: Form
) -> Contest:
    from astropy import units as u

    pixel = arcmin * u.arcmin
    seen, y, x, stokes = crowded(stations, times, pixels, count, pixel)
    weight = 4 * seen.data.shape[0] * _inside(seen)
    noise = float(np.asarray(seen.noise_jy(SEFD * u.Jy))) * np.sqrt(2 / weight)
    bright = stokes[:, 0] > BRIGHT * noise

    def judge(planes: Float, asked: float) -> Trial:
        apart = planes[:, y, x].T - stokes
        error = float(np.sqrt(np.mean(apart[bright, 0] ** 2)) / noise)
        leaked = apart[bright, 3] / noise
        return Trial(error, float(np.sqrt(np.mean(leaked**2))), user_max=float(np.abs(leaked).max()))

    common = {"pixels": pixels, "pixel": pixel, "uv_range": UV_RANGE, "sigma": 2.0, "accuracy": 1e-5}
    entries = [
        Entry(f"{name}, {peaks}", _answer(cls, seen, {**common, "peaks": peaks}))
        for name, cls in imagers.items()
        for peaks in ("each", "joint")
    ]
    if form.peers and _there("radler"):
        cleaned = {**common, "peaks": "each", "backend": "radler"}
        entries += [Entry(f"{name} by radler", _answer(cls, seen, cleaned), peer=True) for name, cls in imagers.items()]
    return Contest(
        name=f"CLEAN of {count} sources, {pixels} x {pixels} pixels",
        kind="imagers",
        knob="cycles",
        values=CYCLES[::2] if form.quick else CYCLES,
        entries=tuple(entries),
        judge=judge,
        error="rms error of I at the sources of 5 sigma and more, over the noise of the image",
        error_user="rms error of V there, of sources without V, over the noise",
        truth="the fluxes put in",
        family="CLEAN",
        size=pixels,
        size_word="pixels a side",
        peers=("radler",),
    )


def _inside(seen: Visibilities) -> float:
    """Baselines within the uv range, on the mean of the times."""
    length = np.hypot(seen.uvw_m[..., 0], seen.uvw_m[..., 1]) * seen.freq_hz[0] / LIGHT
    return float(((length >= UV_RANGE[0]) & (length <= UV_RANGE[1])).mean() * len(seen.antenna1))


def _answer(cls: Any, seen: Visibilities, settings: dict[str, Any]) -> Callable[[float], Float]:
    def answer(cycles: float) -> Float:
        return np.asarray(cls(**settings, cycles=int(cycles)).image(seen).data[0])

    return answer


def _there(package: str) -> bool:
    from importlib.util import find_spec

    return find_spec(package) is not None


def crowded(stations: int, times: int, pixels: int, count: int, pixel: Any) -> tuple[Visibilities, Any, Any, Float]:
    """Sources on pixels without beams, in noise; their rows, columns and Stokes fluxes (S, 4), Jy."""
    from astropy import units as u

    rng = np.random.default_rng(7)
    night = Observation(
        phase_centre="08h13m36.0s +48d13m03s", transit="2012-12-07", duration=8 * u.hour, interval=8 * u.hour / times,
        frequencies=[150] * u.MHz, channel_width=0.19 * u.MHz,
    )  # fmt: skip
    # one at most in each cell, and 2 beams from its rim: a neighbour within the beam is no error of a CLEAN
    side, rim = int(np.ceil(np.sqrt(count))), int(4 / pixel.to_value("arcmin"))
    cell = pixels // side
    cells = np.array(np.divmod(rng.permutation(side**2)[:count], side))
    y, x = cells * cell + rng.integers(rim, cell - rim, (2, count))
    ra, dec = ImageGrid(pixels=pixels, pixel=pixel, centre=night.phase_centre).at(y.astype(float), x.astype(float))
    flux = np.minimum(0.05 * (1 - rng.uniform(size=count)) ** (-1 / 1.2), 10)
    stokes = flux[:, None] * [1.0, 0.1, -0.05, 0.0]
    sky = PointSky(names=tuple(map(str, range(count))), ra_rad=ra, dec_rad=dec, stokes_jy=stokes)
    array = registry.load("telescopes", "lofar-hba", beam=None)
    array = array.with_fields(stations=array.layout().names[:stations])
    seen = Scene(instrument=array, sky=sky, observation=night).plan().run()
    return seen.with_noise(SEFD * u.Jy, seed=1), y, x, stokes
