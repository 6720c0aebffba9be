"""Cases of imagers that clean: gains that do not end, skies below 0, polarization alone, a range of 1e8."""

from __future__ import annotations

from typing import Any

import numpy as np

from instrument.errors import InputError
from instrument.image.base import AnyImager
from instrument.observe.grid import ImageGrid
from instrument.stress.bench import observed, points, small_array
from instrument.stress.case import Answer, Unfit, both, case, claim, held
from instrument.units import Direction, Float
from instrument.visibilities import Visibilities

PIXELS, PIXEL = 64, 4e-3
HALF = PIXELS // 2


def _seen(stokes: list[list[float]], places: list[tuple[int, int]]) -> Visibilities:
    """Points on pixels (rows, columns from the middle), seen by 12 stations within 60 m eight times in 7 hours."""
    layout = small_array(12, spread=60.0)
    first = observed(layout, points([0.0], [0.0], [[1.0, 0, 0, 0]]), 6)
    grid = ImageGrid.of((PIXELS, PIXELS), PIXEL, Direction(*first.phase_centre))
    y, x = (np.array([HALF + place[k] for place in places], float) for k in (0, 1))
    ra, dec = grid.at(y, x)
    return observed(layout, points(ra, dec, stokes), 8, interval=3000.0)


def _cleaning(imager: AnyImager, **settings: Any) -> AnyImager:
    """The imager, small, without a threshold; raises `Unfit` where it does not clean."""
    from astropy import units as u

    if not imager.restores or "gain" not in type(imager).model_fields:
        raise Unfit("it does not clean")
    usual = {"pixels": PIXELS, "pixel": PIXEL * u.rad, "uv_range": None, "weighting": "natural", "cycles": 20}
    return imager.with_fields(**{**usual, "sigma": 0.0, **settings})


def _at(images: Float, places: list[tuple[int, int]]) -> Float:
    return np.stack([images[0, :, HALF + y, HALF + x] for y, x in places])


@case("45", "imagers", "CLEAN of gain 2; an all-negative sky", "refused; found, or stops with a reason")
def gains(imager: AnyImager) -> Answer:
    """A gain of 2 is no setting; of -1 Jy the restored image is -1 Jy, and where no component may be below 0, dirty."""
    cleaning = _cleaning(imager)
    try:
        imager.with_fields(gain=2.0)
        refused = False
    except InputError:
        refused = True
    places = [(5, -7)]
    data = _seen([[-1.0, 0, 0, 0]], places)
    found = _at(cleaning.image(data).data, places)[:, 0]
    made = _cleaning(imager, negative=False, cycles=3).imaged(data)
    said = [end["ended"] for end in made.record.get("clean", ())]
    told = claim(refused and all(said), "a gain of 2 is taken, or no reason is given")
    return both(held(found, [-1.0], 1e-4), told)


@case("46", "imagers", "I = 0, P alone, joint CLEAN", "Q and U as they are, I of 0: no division by I")
def polarized_alone(imager: AnyImager) -> Answer:
    """Two sources of Q and U alone, in each way of looking for peaks that the imager has but that of I."""
    places, stokes = [(5, -7), (-12, 10)], [[0, 0.5, -0.25, 0], [0, 0.1, 0.2, 0.0]]
    data = _seen(stokes, places)
    answers = []
    for peaks in ("each", "joint"):
        found = _cleaning(imager, peaks=peaks).image(data).data
        answers.append(held(_at(found, places), stokes, 1e-4))
    return both(*answers)


@case("K9", "imagers", "1 Jy beside 1e8 Jy, CLEAN", "both to 1e-3 Jy where an accuracy of 1e-12 is asked for")
def range_of_1e8(imager: AnyImager) -> Answer:
    """Down to 1 mJy; the sidelobes of the bright one are 1e7 times the faint one."""
    from astropy import units as u

    places = [(5, -7), (-12, 10)]
    data = _seen([[1e8, 0, 0, 0], [1.0, 0, 0, 0]], places)
    cleaning = _cleaning(imager, accuracy=1e-12, threshold=1e-3 * u.Jy, cycles=40)
    return held(_at(cleaning.image(data).data, places)[:, 0], [1e8, 1.0], 1e-3, scale=1.0)
