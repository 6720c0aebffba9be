"""Contests of imagers that look through beams: what is left of the leakage of known sources, and of a diffuse sky."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple, get_args

import numpy as np

import instrument.registry as registry
from instrument.image.dirty import Imager
from instrument.observe.grid import ImageGrid
from instrument.observe.observation import Observation
from instrument.precision.contest import UNSET, Contest, Entry, Form, Trial
from instrument.precision.diffuse import images_of
from instrument.predict.operator import ImageOperator
from instrument.scene import Scene
from instrument.sky.image import ImageSky
from instrument.units import Bool, Float
from instrument.visibilities import Visibilities

# stations of the core, integrations in 6 h, pixels
SIZES = ((8, 4, 24), (24, 24, 48))
FIELD_ARCMIN, UV_RANGE = 192.0, (20.0, 200.0)
STEPS = (1.0, 2.0, 4.0, 8.0, 16.0, 32.0)
OPERATOR, LEAST = 1e-5, 1e-9  # its tolerance, and what is left of the data at which a solution ends
SOURCES = 3  # a side, 10 Jy
KNOWN, DIFFUSE = ("joint", "CLEAN"), ("predict",)  # ways to correct, by the sky that they are for


class Seen(NamedTuple):
    """A sky seen through beams: visibilities, the operator of its images, and dirty images of it (4, N, N)."""

    data: Visibilities
    operator: ImageOperator
    before: Float


def contests(imagers: dict[str, Any], form: Form) -> list[Contest]:
    """Two a size, of imagers with a way to look through beams; none where there is no such imager."""
    through = {name: cls for name, cls in imagers.items() if _ways(cls)}
    sizes = SIZES[: 1 if form.quick else None]
    return [make(through, *size, form) for size in sizes for make in (_sources, _diffuse)] if through else []


def _ways(cls: Any) -> tuple[str, ...]:
    """The ways of an imager to correct for beams."""
    if "way" in cls.model_fields:
        return get_args(cls.model_fields["way"].annotation)
    return ("CLEAN",) if cls.restores and {"cycles", "peaks"} <= set(cls.model_fields) else ()


def _seen(sky: ImageSky, stations: int, times: int) -> Seen:
    """What stations of LOFAR's core see of it over 6 hours, the exact sums."""
    from astropy import units as u

    names = registry.load("telescopes", "lofar-hba", beam=None).layout().names
    core = [name for name in names if name.startswith("CS")][:stations]
    lofar = registry.load("telescopes", "lofar-hba", stations=core)
    night = Observation(
        phase_centre="08h13m36.0s +48d13m03s", transit="2012-12-07", duration=6 * u.hour, interval=6 * u.hour / times,
        frequencies=[150] * u.MHz, channel_width=0.2 * u.MHz,
    )  # fmt: skip
    plan = Scene(instrument=lofar, sky=sky, observation=night).plan(engine="direct", uv_range=UV_RANGE)
    data = plan.run()
    imager = Imager(pixels=sky.grid.pixels[0], pixel=sky.grid.pixel * u.rad, uv_range=UV_RANGE)
    before = np.asarray(imager.image(data.without_beam(lofar)).data[0])
    return Seen(data, plan.operator(imager.grid(), OPERATOR), before)


def _grid(pixels: int) -> ImageGrid:
    from astropy import units as u

    return ImageGrid(pixels=pixels, pixel=FIELD_ARCMIN / pixels * u.arcmin)


def _answer(cls: Any, way: str, seen: Seen, mask: Bool | None) -> Callable[[float], Float]:
    from astropy import units as u

    grid = seen.operator.sky.grid
    common: dict[str, Any] = {"pixels": grid.pixels[0], "pixel": grid.pixel * u.rad, "uv_range": UV_RANGE}
    if way == "CLEAN":
        more = {"peaks": "joint", "sigma": 0.0, "mask": mask, "accuracy": LEAST}
    else:
        more = {"way": way, "tolerance": LEAST, **({"mask": mask} if way == "joint" else {})} if way else {}

    def answer(steps: float) -> Float:
        knob = {} if np.isnan(steps) else {"cycles" if way == "CLEAN" else "iterations": int(steps)}
        return np.asarray(cls(**common, **more, **knob).image(seen.data, seen.operator).data[0])

    return answer


def _entries(imagers: dict[str, Any], seen: Seen, mask: Bool | None, solving: tuple[str, ...]) -> tuple[Entry, ...]:
    """Each imager in the ways that are for the sky, and in those that have no steps."""
    out = []
    for name, cls in imagers.items():
        for way in _ways(cls):
            if way in solving or way not in (*KNOWN, *DIFFUSE):
                label = f"{name}, {way}" if way else name
                out.append(Entry(label, _answer(cls, way, seen, mask), () if way in solving else (UNSET,)))
    return tuple(out)


def _sources(imagers: dict[str, Any], stations: int, times: int, pixels: int, form: Form) -> Contest:
    """Sources without polarization on pixels: the polarization that is seen of them is leakage."""
    at = (np.arange(SOURCES) - SOURCES // 2) * (pixels // 4) + pixels // 2
    mask = np.zeros((pixels, pixels), bool)
    mask[np.ix_(at, at)] = True
    stokes = np.zeros((1, 4, pixels, pixels))
    stokes[0, 0, mask] = 10.0
    seen = _seen(ImageSky(grid=_grid(pixels), stokes=stokes), stations, times)

    def leaked(planes: Float) -> Float:
        return np.asarray(np.hypot(planes[1], planes[2])[mask] / np.abs(planes[0][mask]))

    before = leaked(seen.before)

    def judge(planes: Float, asked: float) -> Trial:
        left, flux = leaked(planes), np.abs(planes[0][mask] / 10.0 - 1)
        return Trial(float((left / before).max()), _rms(flux), user_max=float(flux.max()))

    return Contest(
        name=f"leakage of {SOURCES**2} sources, {stations} stations, {pixels} x {pixels} pixels",
        kind="imagers",
        knob="iterations or cycles",
        values=STEPS[1:4:2] if form.quick else STEPS,
        entries=_entries(imagers, seen, mask, KNOWN),
        judge=judge,
        error=f"what is left of the linear leakage at the worst source: at most {before.max():.1e} of I before",
        error_user="error of the flux I of a source, before the beam",
        truth="sources of 10 Jy without polarization, seen by exact sums",
        family="leakage of sources",
        size=pixels,
        size_word="pixels a side",
    )


def _diffuse(imagers: dict[str, Any], stations: int, times: int, pixels: int, form: Form) -> Contest:
    """Q and U alone: I is leakage."""
    seen = _seen(ImageSky(grid=_grid(pixels), stokes=images_of(pixels)), stations, times)
    inner = slice(pixels // 4, pixels - pixels // 4)

    def shares(planes: Float) -> tuple[float, float]:
        i, q, u, v = planes[:, inner, inner]
        p = np.hypot(q.std(), u.std())
        return float(i.std() / p), float(v.std() / p)

    before, _ = shares(seen.before)

    def judge(planes: Float, asked: float) -> Trial:
        i, v = shares(planes)
        return Trial(i / before, i, user_max=max(i, v))

    return Contest(
        name=f"leakage of a diffuse sky, {stations} stations, {pixels} x {pixels} pixels",
        kind="imagers",
        knob="iterations or cycles",
        values=STEPS[1:4:2] if form.quick else STEPS,
        entries=_entries(imagers, seen, None, DIFFUSE),
        judge=judge,
        error=f"what is left of the leakage into I in the inner half: {before:.1e} of P before",
        error_user="rms of I over that of P there; the largest: of I or V",
        truth="a sky of Q and U of slope -2.7, seen by exact sums",
        family="leakage of a diffuse sky",
        size=pixels,
        size_word="pixels a side",
    )


def _rms(x: Float) -> float:
    return float(np.sqrt(np.mean(x**2)))
