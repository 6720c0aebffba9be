"""The bench of the cases: an Earth that stands still with its axes along u, v, w, wavelengths of 1 m, small arrays.

There closed forms are exact: a station at (u, v, w) m has these as its coordinates in wavelengths, and a source at
(ra, dec) = (x, 0) has l = sin x, m = 0, n = cos x.
"""

from __future__ import annotations

import json
from functools import cache
from importlib.resources import files
from typing import Any

import numpy as np

from instrument.errors import InstrumentError, RefusedError
from instrument.jones.base import JonesTerm
from instrument.jones.chain import Chain
from instrument.model import Composed
from instrument.observe.directions import LIGHT, EarthFrame
from instrument.observe.layout import Layout
from instrument.observe.observation import Observation
from instrument.observe.sampling import Sampling
from instrument.predict.base import EVERY, Predictor, Prepared, Problem
from instrument.predict.operator import ImageOperator
from instrument.scene import Scene
from instrument.sky.points import PointSky
from instrument.stress.case import Unfit
from instrument.units import Complex, Direction, Float
from instrument.visibilities import Visibilities

CENTRE = Direction(0.0, 0.0)  # ITRF x: the w axis, and the zenith of the stations
AXES = np.array([[0.0, 1.0, 0.0], [0.0, 0.0, 1.0], [1.0, 0.0, 0.0]])  # p, q, r are u, v, w
GROUND = 6.4e6
EXACT = 1e-11  # a bound of rounding
TOLERANCES = (0.0, 1e-9, 1e-6, 1e-3)  # that an engine is asked for, one after the other


@cache
def references() -> dict[str, Any]:
    """Values of docs/reports/stress_references.py, by name: 40 digits of mpmath, rounded to float64 once."""
    text = (files("instrument.stress") / "references.json").read_text("utf-8")
    return {name: complex(*v) if isinstance(v, list) else v for name, v in json.loads(text)["values"].items()}


def still(uvw_m: Any, freq_hz: Any = LIGHT, ra: Any = 0.0, dec: Any = 0.0) -> Sampling:
    """Stations at (u, v, w) m, one time, towards directions about the zenith, with 1 m waves unless told."""
    uvw = np.atleast_2d(np.asarray(uvw_m, float))
    places = np.array([GROUND, 0.0, 0.0]) + uvw @ AXES
    ra, dec = np.broadcast_arrays(np.atleast_1d(np.asarray(ra, float)), np.asarray(dec, float))
    names = tuple(f"s{k}" for k in range(len(uvw)))
    layout = Layout(names=names, positions_m=places, axes=np.repeat(AXES[None], len(uvw), axis=0))
    return Sampling(
        layout=layout, earth=EarthFrame(np.eye(3)[None], np.zeros((1, 3))), slots_s=np.array([4.86e9]),
        freq_hz=np.atleast_1d(np.asarray(freq_hz, float)), ra_rad=ra, dec_rad=dec, centre=CENTRE,
    )  # fmt: skip


def towards(freq_hz: Any, angle: Any, azimuth: Any) -> Sampling:
    """One station that sees directions (S,) at zenith angles and azimuths (p to q), exact in its own axes."""
    angle, azimuth = np.broadcast_arrays(np.atleast_1d(angle), np.atleast_1d(azimuth))
    local = np.stack([np.sin(angle) * np.cos(azimuth), np.sin(angle) * np.sin(azimuth), np.cos(angle)], axis=-1)
    return seen(freq_hz, local)


def seen(freq_hz: Any, local: Float) -> Sampling:
    """One station that sees directions given as unit vectors (S, 3) in its own axes."""
    from dataclasses import replace

    ra, dec = np.arctan2(local[:, 0], local[:, 2]), np.arcsin(np.clip(local[:, 1], -1, 1))
    return replace(still([[0, 0, 0]], freq_hz, ra, dec), seen=(local @ AXES)[None])


def points(ra: Any, dec: Any, stokes: Any, **more: Any) -> PointSky:
    """Sources at ra, dec (S,) in rad with Stokes parameters (S, 4) in Jy."""
    ra, dec = np.broadcast_arrays(np.atleast_1d(np.asarray(ra, float)), np.asarray(dec, float))
    stokes = np.broadcast_to(np.atleast_2d(np.asarray(stokes, float)), (len(ra), 4))
    return PointSky(names=tuple(f"p{k}" for k in range(len(ra))), ra_rad=ra, dec_rad=dec, stokes_jy=stokes, **more)


def problem(uvw_m: Any, sky: PointSky, *terms: JonesTerm, freq_hz: Any = LIGHT) -> Problem:
    """Every baseline of such an array, looking at a sky."""
    at = still(uvw_m, freq_hz, *sky.directions())
    a, b = at.layout.baselines
    return Problem(at, Chain(*terms), sky, a, b, interval_s=10.0, width_hz=1e5)


def ready(engine: Predictor, given: Problem) -> Prepared:
    """An engine made ready for a problem at the least tolerance that it takes: 0, or one above it if it approximates.

    Raises `Unfit` with its reason where it refuses the problem, or all tolerances; `InstrumentError` where its bound is
    above what it was asked for.
    """
    if why := engine.refuses(given):
        raise Unfit(why)
    said: Exception | None = None
    for tolerance in TOLERANCES:
        try:
            found = engine.prepare(given, tolerance)
        except RefusedError as error:
            said = error
            continue
        if not found.bound <= max(tolerance, EXACT):
            raise InstrumentError(f"it takes a tolerance of {tolerance:g}, and then gives a bound of {found.bound:.1e}")
        return found
    raise Unfit(str(said))


def operator(engine: Predictor, given: Problem) -> ImageOperator:
    """The same of a problem with an image; raises `Unfit` where the engine has no adjoint."""
    found = ready(engine, given)
    if not isinstance(found, ImageOperator):
        raise Unfit("it has no adjoint")
    return found


def sums(engine: Predictor, given: Problem) -> Complex:
    """What an engine makes of a problem as well as it can, (T, F, B, 2, 2)."""
    return claimed(engine, given)[0]


def claimed(engine: Predictor, given: Problem) -> tuple[Complex, float]:
    """The same, and what the engine says that it is wrong by at most, Jy: 0 unless it approximates."""
    found = ready(engine, given)
    return found.sums(EVERY, EVERY), found.bound * float(given.sky.total_jy(given.at.freq_hz).max())


def fringe(cycles: Any) -> Complex:
    """exp(-2 pi i cycles)."""
    return np.asarray(np.exp(-2j * np.pi * np.asarray(cycles)))


# An array on a real Earth, for what takes visibilities --------------------------------------------------------------


def small_array(stations: int = 8, seed: int = 1, spread: float = 500.0) -> Layout:
    """Stations within so many metres, on the ground at 53 deg north."""
    from astropy import units as u

    rng = np.random.default_rng(seed)
    enu = np.concatenate([rng.uniform(-spread, spread, (stations, 2)), np.zeros((stations, 1))], axis=1)
    names = [f"s{k}" for k in range(stations)]
    return Layout.from_enu(names, enu * u.m, 0.12 * u.rad, 0.92 * u.rad, 50 * u.m)


def observed(
    array: Any, sky: PointSky, times: int = 4, freq_mhz: tuple[float, ...] = (150.0,), interval: float = 60.0
) -> Visibilities:
    """Visibilities of a sky without errors, about RA 2.15, declination 0.84, around its transit."""
    from astropy import units as u

    instrument = Composed(stations=array) if isinstance(array, Layout) else array
    night = Observation(
        phase_centre=Direction(2.15, 0.84).skycoord, transit="2012-12-07", duration=times * interval * u.s,
        interval=interval * u.s, frequencies=list(freq_mhz) * u.MHz, channel_width=0.2 * u.MHz,
    )  # fmt: skip
    return Scene(instrument=instrument, sky=sky, observation=night).plan(workers=1).run()


def field(polarized: bool = True) -> PointSky:
    """Three sources about that phase centre, 9, 3 and 1 Jy."""
    stokes = np.array([[9, 1, 0, 0], [3, 0, 0.5, 0], [1, 0, 0, 0.1]], float)
    return points([2.15, 2.17, 2.14], [0.84, 0.85, 0.83], stokes * ([1, 1, 1, 1] if polarized else [1, 0, 0, 0]))
