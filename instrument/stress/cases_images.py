"""Cases of engines on images, and of imagers through beams: far pixels, long w, a null, a dead polarization, flags."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np

from instrument.errors import RefusedError
from instrument.image.base import AnyImager
from instrument.jones.base import JonesTerm
from instrument.jones.chain import Chain
from instrument.model import Composed
from instrument.observe.grid import ImageGrid
from instrument.observe.observation import Observation
from instrument.predict.base import EVERY, Predictor, Problem
from instrument.predict.direct import Direct
from instrument.registry import load
from instrument.scene import Scene
from instrument.sky.image import ImageSky
from instrument.stress.bench import CENTRE, observed, points, problem, ready, small_array
from instrument.stress.case import Answer, Unfit, both, case, claim, held
from instrument.units import Complex, Direction, Float

PIXELS, PIXEL, PLACE = 32, 8e-3, Direction(2.15, 0.84)


class Falling(JonesTerm):
    """A beam (1 - x) exp(-x), x = (r / null)^2, of both receptors or of the first alone, (1, 1, 1, S, 2, 2)."""

    maps = ("sky", "feed")
    structure = "diagonal"
    per_station = "shared"
    null: float = 0.08
    second: float = 1.0

    def jones(self, at: Any) -> Complex:
        """The matrices; the second receptor times `second`."""
        x = (at.lmn[:, :2] ** 2).sum(axis=-1) / self.null**2
        fall = (1 - x) * np.exp(-x)
        return (fall[:, None, None] * np.diag([1.0, self.second]).astype(complex))[None, None, None]


def _given(pixels: tuple[int, int], pixel: float, uvw_m: Any, stokes: Float) -> Problem:
    """An image about the zenith of the still Earth, waves of 1 m, no beams."""
    from astropy import units as u

    sky = ImageSky(grid=ImageGrid(pixels=pixels, pixel=pixel * u.rad, centre=CENTRE.skycoord), stokes=stokes)
    given = problem(uvw_m, points(0.0, 0.0, [[1.0, 0, 0, 0]]))
    return replace(given, sky=sky, at=given.at.towards(*sky.outline()))


def _against_direct(engine: Predictor, given: Problem) -> Answer:
    """Its sums against the definition, to the bound it gives and rounding, over the total flux."""
    prepared = ready(engine, given)
    flux = float(given.sky.total_jy(given.at.freq_hz).max())
    limit = prepared.bound + 1e-11
    return held(prepared.sums(EVERY, EVERY), Direct().sums(given), limit, scale=flux)


@case("I1", "engines", "an image seen on a w of 1e4 wavelengths", "the sums of its pixels, to the bound given")
def long_w(engine: Predictor) -> Answer:
    """16 x 16 pixels over 9 deg: 60 turns of w from the centre to a corner."""
    stokes = np.random.default_rng(0).normal(size=(1, 4, 16, 16))
    return _against_direct(engine, _given((16, 16), 0.01, [(300, 20, 1e4), (0, 0, 0), (40, -500, -3e3)], stokes))


@case("I2", "engines", "images of 20 deg, odd sides, 5 x 41 pixels; one of 1e8", "the sums of its pixels, to the bound")
def wide(engine: Predictor) -> Answer:
    """One baseline, one time: a pixel of 1e8 Jy at the edge beside 1 Jy in all others; P without I."""
    stokes = np.ones((1, 4, 5, 41)) * [[[[0]], [[1]], [[-1]], [[0.5]]]]
    stokes[0, 1, 0, -1] = 1e8
    answers = [_against_direct(engine, _given((5, 41), 0.35 / 41, [(120, -35, 8), (0, 0, 0)], stokes))]
    stokes[0, 1, 0, -1] = 1.0
    answers.append(_against_direct(engine, _given((5, 41), 0.35 / 41, [(120, -35, 8), (0, 0, 0)], stokes)))
    return both(*answers)


@case("I3", "engines", "an image that is 0; one pixel of it", "0; its fringe, to the bound")
def nothing(engine: Predictor) -> Answer:
    """Every Stokes parameter is left out of the first; the second has V alone."""
    stokes = np.zeros((1, 4, 9, 8))
    uvw = [(100, 30, 5), (0, 0, 0)]
    empty = ready(engine, _given((9, 8), 0.01, uvw, stokes)).sums(EVERY, EVERY)
    stokes[0, 3, 8, 0] = 1.0
    return both(held(empty, np.zeros(1), 0.0, scale=1.0), _against_direct(engine, _given((9, 8), 0.01, uvw, stokes)))


@case("I6", "engines", "an image through which a horizon passes", "as without the pixels below it, to the bound")
def setting(engine: Predictor) -> Answer:
    """Dipoles on the ground, 18 deg about a centre that culminates half a degree above the horizon; one time."""
    from astropy import units as u

    grid = ImageGrid(pixels=(16, 15), pixel=0.02 * u.rad, centre=Direction(2.15, 0.93 - np.pi / 2).skycoord)
    sky = ImageSky(grid=grid, stokes=np.random.default_rng(0).normal(size=(1, 4, 16, 15)))
    night = Observation(
        phase_centre=grid.centre, transit="2012-12-07", duration=10 * u.s, interval=10 * u.s,
        frequencies=[150] * u.MHz, channel_width=0.2 * u.MHz,
    )  # fmt: skip
    dipole = load("elements", "dipole", height=0.5 * u.m)
    dipoles = Composed(stations=small_array(4, spread=60.0), terms=Chain(dipole.in_chain()))
    given = Scene(instrument=dipoles, sky=sky, observation=night).plan(engine="direct", workers=1).problem
    zenith = given.at.layout.axes[given.at.layout.frames[0], 2]
    below = (given.at.towards(*grid.directions()).itrf[0] @ zenith[0] < 0).reshape(grid.pixels)
    above = given.of(sky.with_fields(stokes=np.where(below, 0.0, sky.stokes)))
    flux = float(above.sky.total_jy(given.at.freq_hz).max())
    prepared = ready(engine, given)
    found = prepared.sums(EVERY, EVERY)
    limit = prepared.bound + 1e-11
    share = below.mean()
    return both(
        held(found, Direct().sums(above), limit, scale=flux),
        claim(0.2 < share < 0.8, f"{share:.0%} of the pixels are below"),
        claim(bool(np.abs(found).max() > 1e-3 * flux), "it is dark"),
    )


# Imagers through beams -----------------------------------------------------------------------------------------------


def _through(imager: AnyImager, term: JonesTerm) -> tuple[AnyImager, Any, Any]:
    """The imager, what 8 stations see through a beam of a point of 1 Jy at the centre, and the operator of it."""
    from astropy import units as u

    if not imager.through_beams:
        raise Unfit("it does not look through beams")
    array = Composed(stations=small_array(8, spread=60.0), terms=Chain(term))
    night = Observation(
        phase_centre=PLACE.skycoord, transit="2012-12-07", duration=4 * u.hour, interval=1 * u.hour,
        frequencies=[150, 152] * u.MHz, channel_width=0.2 * u.MHz,
    )  # fmt: skip
    sky = points([PLACE.ra_rad], [PLACE.dec_rad], [[1.0, 0.2, 0, 0]])
    plan = Scene(instrument=array, sky=sky, observation=night).plan(workers=1)
    sized = imager.with_fields(pixels=PIXELS, pixel=PIXEL * u.rad, uv_range=None)
    return sized, plan.run(), plan.operator(sized.grid(), 1e-6)


@case("48", "imagers", "a null of the beam after correction", "masked, what it amplifies is stated; 1 Jy at the centre")
def null(imager: AnyImager) -> Answer:
    """Ten pixels from the centre the beam is 0; noise there would be infinite."""
    sized, data, operator = _through(imager, Falling())
    made = sized.imaged(data, operator)
    half, ring = PIXELS // 2, PIXELS // 2 + 10
    found = made.cube.data[0, :, half, half]
    blank = np.isnan(made.cube.data[:, :, half, ring]).all() and np.isnan(made.cube.data[:, :, ring, half]).all()
    condition = float(made.record["beam"][0]["condition"])
    stated = made.maps["amplification"].data[0, 0, half, ring] > 10 and np.isfinite(condition)
    return both(held(found, [1.0, 0.2, 0, 0], 1e-5, condition=condition), claim(blank and stated, "it has numbers"))


def _refused(make: Callable[[], Any], word: str) -> Answer:
    """Right where it is refused with a reason that has this word in it."""
    try:
        make()
    except RefusedError as error:
        return claim(word in str(error), f"the reason says nothing of '{word}': {error}")
    return claim(False, "it is imaged")


@case("I4", "imagers", "one polarization dead at every station", "refused: I and Q cannot be told apart")
def dead(imager: AnyImager) -> Answer:
    """The second receptor sees nothing, so that every Mueller matrix is singular."""
    sized, data, operator = _through(imager, Falling(second=0.0))
    return _refused(lambda: sized.image(data, operator), "polarization")


@case("I5", "imagers", "every visibility flagged; an empty uv range", "refused, by either name")
def flagged(imager: AnyImager) -> Answer:
    """No weight is left."""
    from astropy import units as u

    data = observed(small_array(4, spread=60.0), points([PLACE.ra_rad], [PLACE.dec_rad], [[1.0, 0, 0, 0]]), 2)
    sized = imager.with_fields(pixels=PIXELS, pixel=PIXEL * u.rad, uv_range=None)
    none = data.flagged(np.ones((1, 1, 1), bool))
    return both(
        _refused(lambda: sized.image(none), "weight"),
        _refused(lambda: sized.with_fields(uv_range=(1e6, 2e6)).image(data), "uv_range"),
    )


@case("47b", "imagers", "pq and qp of one channel flagged, behind beams", "U and V of it NaN; all others as they are")
def without_crossed(imager: AnyImager) -> Answer:
    """The beam is a number, so that I and Q need no other correlation."""
    sized, data, operator = _through(imager, Falling())
    flag = np.zeros(data.data.shape, bool)
    flag[:, 1, :, 0, 1] = flag[:, 1, :, 1, 0] = True
    half = PIXELS // 2
    due, found = (sized.image(v, operator).data[..., half, half] for v in (data, data.flagged(flag)))
    blank = np.isnan(found[1, 2:]).all()
    return both(held(found[0], due[0], 1e-9), held(found[1, :2], due[1, :2], 1e-5), claim(blank, "numbers of U and V"))
