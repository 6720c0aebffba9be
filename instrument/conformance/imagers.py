"""The contract of imagers: one claim per function, its name the sentence."""

from __future__ import annotations

from functools import cache

import numpy as np

from instrument.conformance.bench import demand, demand_repeatable
from instrument.image.base import AnyImager
from instrument.image.cube import StokesCube
from instrument.model import Composed
from instrument.observe.directions import LIGHT
from instrument.observe.layout import Layout
from instrument.observe.observation import Observation
from instrument.scene import Scene
from instrument.sky.points import PointSky
from instrument.units import Direction
from instrument.visibilities import Visibilities

STATIONS, TIMES = 24, 6
CENTRE = Direction(2.15, 0.84)
NEAR = 0.05  # of 1 Jy: what an imager may take off a point that lies on a pixel, as the loop of a CLEAN does


@cache
def _seen(stokes: tuple[float, ...], east: int = 0, north: int = 0, pixel: float = 0.0) -> Visibilities:
    """A point of so many pixels east and north of the centre, seen by 24 stations within 300 m at 150 and 152 MHz."""
    from astropy import units as u

    rng = np.random.default_rng(3)
    enu = np.concatenate([rng.uniform(-150, 150, (STATIONS, 2)), np.zeros((STATIONS, 1))], axis=1)
    layout = Layout.from_enu([f"s{k}" for k in range(STATIONS)], enu * u.m, 0.12 * u.rad, 0.92 * u.rad, 50 * u.m)
    l, m = east * pixel, north * pixel
    n = np.sqrt(1 - l**2 - m**2)
    dec = np.arcsin(m * np.cos(CENTRE.dec_rad) + n * np.sin(CENTRE.dec_rad))
    ra = CENTRE.ra_rad + np.arctan2(l, n * np.cos(CENTRE.dec_rad) - m * np.sin(CENTRE.dec_rad))
    sky = PointSky(names=("a",), ra_rad=[ra], dec_rad=[dec], stokes_jy=[list(stokes)])
    night = Observation(
        phase_centre=CENTRE.skycoord, transit="2012-12-07", duration=TIMES * 600 * u.s, interval=600 * u.s,
        frequencies=[150, 152] * u.MHz, channel_width=0.2 * u.MHz,
    )  # fmt: skip
    return Scene(instrument=Composed(stations=layout), sky=sky, observation=night).plan(workers=1).run()


def _planes(imager: AnyImager, visibilities: Visibilities) -> StokesCube:
    found = imager.image(visibilities)
    demand(isinstance(found, StokesCube), f"image gives a {type(found).__name__}")
    return found


def its_cube_is_channels_4_pixels_pixels_about_the_phase_centre(imager: AnyImager) -> str:
    """Finite, (F, 4, N, N) in Jy/beam, of the frequencies, pixel and phase centre it was asked for."""
    visibilities = _seen((1.0, 0.0, 0.0, 0.0))
    cube = _planes(imager, visibilities)
    demand(cube.data.shape == (2, 4, imager.pixels, imager.pixels), f"{cube.data.shape}")
    demand(np.all(np.isfinite(cube.data)), "not finite")
    demand(bool(np.all(cube.freq_hz == visibilities.freq_hz)), f"frequencies {cube.freq_hz}")
    demand(abs(cube.pixel_rad / imager.pixel - 1) < 1e-12, f"pixels of {cube.pixel_rad:.3g} rad")
    demand(cube.centre == visibilities.phase_centre, f"centre {cube.centre}")
    demand(cube.unit == "Jy/beam", f"in {cube.unit}")
    return f"{cube.data.shape} in {cube.unit}"


def a_point_of_1_jy_has_a_peak_of_1_in_each_stokes_parameter(imager: AnyImager) -> str:
    """I, Q, U, V of a source at the phase centre come out with their sign, within 5 %."""
    due = (1.0, 0.5, -0.25, 0.125)
    half = imager.pixels // 2
    found = _planes(imager, _seen(due)).data[:, :, half, half]
    worst = float(np.abs(found - due).max())
    demand(worst <= NEAR, f"I, Q, U, V of {due} Jy are {np.array2string(found[0], precision=3)}")
    return f"within {worst:.0e}"


def east_is_left_and_north_is_up(imager: AnyImager) -> str:
    """A source 5 pixels east and 3 north of the centre peaks 5 columns below the middle and 3 rows above it."""
    plane = _planes(imager, _seen((1.0, 0.0, 0.0, 0.0), 5, 3, float(imager.pixel))).data[0, 0]
    row, column = np.unravel_index(int(np.argmax(plane)), plane.shape)
    half = imager.pixels // 2
    demand((row, column) == (half + 3, half - 5), f"it peaks {half - column} columns east and {row - half} rows north")
    return ""


def blocks_give_the_image_of_the_whole(imager: AnyImager) -> str:
    """Cut in times, given as a list or added one by one: the same to 1e-3 of the peak."""
    whole = _seen((1.0, 0.5, 0.0, 0.0), 5, 3, float(imager.pixel))
    blocks = [whole.block(slice(t, t + 2), slice(None)) for t in range(0, TIMES, 2)]
    sums, due = imager.start(imager.density(whole)), _planes(imager, whole).data
    for block in blocks:
        sums.add(block)
    apart = max(float(np.abs(cube.data - due).max()) for cube in (sums.finish(), imager.image(blocks)))
    demand(apart <= 1e-3, f"they differ by {apart:.1e} of the peak")
    return f"{apart:.0e}"


def what_is_flagged_is_not_seen(imager: AnyImager) -> str:
    """A flagged integration of 1e6 Jy, or of NaN, leaves the image as it is without it."""
    whole = _seen((1.0, 0.0, 0.0, 0.0))
    spoilt = whole.data.copy()
    spoilt[0], spoilt[1] = 1e6, np.nan
    flag = np.zeros((TIMES, 1, 1), bool)
    flag[:2] = True
    found = _planes(imager, whole.with_data(spoilt).flagged(flag))
    due = _planes(imager, whole.block(slice(2, None), slice(None)))
    apart = float(np.abs(found.data - due.data).max())
    demand(apart <= 1e-3, f"it changes the image by {apart:.1e}")
    return ""


def a_flagged_correlation_is_not_seen_and_spoils_no_other(imager: AnyImager) -> str:
    """pq of NaN, flagged by itself, leaves U and V of the other integrations, and I and Q of these or of all."""
    whole = _seen((1.0, 0.5, -0.25, 0.125), 5, 3, float(imager.pixel))
    flag = np.zeros(whole.data.shape, bool)
    flag[:2, ..., 0, 1] = True
    found = _planes(imager, whole.with_data(np.where(flag, np.nan, whole.data)).flagged(flag)).data
    rest, every = (_planes(imager, v).data for v in (whole.block(slice(2, None), slice(None)), whole))
    # an imager may leave out the visibility, or have a weight for each Stokes parameter (`chosen`, `chosen_stokes`)
    parallel = min(float(np.abs((found - due)[:, :2]).max()) for due in (rest, every))
    apart = max(parallel, float(np.abs((found - rest)[:, 2:]).max()))
    demand(apart <= 1e-3, f"it changes the image by {apart:.1e}")
    return ""


def baselines_outside_its_uv_range_are_not_seen(imager: AnyImager) -> str:
    """With a uv range the image is that of the baselines within it."""
    whole = _seen((1.0, 0.5, 0.0, 0.0), 5, 3, float(imager.pixel))
    length = np.hypot(*np.moveaxis(whole.uvw_m[..., :2], -1, 0)) * (150e6 / LIGHT)
    low, high = np.percentile(length, [20, 80])
    one = whole.block(slice(None), slice(0, 1))
    due = _planes(imager.with_fields(uv_range=None), one.flagged(((length < low) | (length > high))[:, None]))
    found = _planes(imager.with_fields(uv_range=(float(low), float(high))), one)
    apart = float(np.abs(found.data - due.data).max())
    demand(apart <= 1e-3, f"they differ by {apart:.1e} of the peak")
    return f"{apart:.0e}"


def a_call_of_image_has_no_side_effects(imager: AnyImager) -> str:
    """The same call twice gives the same to 1e-6, and nothing that was given has changed."""
    visibilities = _seen((1.0, 0.0, 0.0, 0.0))
    # threads add in any order
    return demand_repeatable(lambda: np.round(imager.image(visibilities).data, 6), imager, visibilities)


CLAIMS = (
    its_cube_is_channels_4_pixels_pixels_about_the_phase_centre,
    a_point_of_1_jy_has_a_peak_of_1_in_each_stokes_parameter,
    east_is_left_and_north_is_up,
    blocks_give_the_image_of_the_whole,
    what_is_flagged_is_not_seen,
    a_flagged_correlation_is_not_seen_and_spoils_no_other,
    baselines_outside_its_uv_range_are_not_seen,
    a_call_of_image_has_no_side_effects,
)
