"""PointSky against closed forms: spectra, Faraday rotation, Gaussian shapes, selections, and what it refuses."""

import numpy as np
import pytest
from astropy import units as u
from astropy.coordinates import SkyCoord

from instrument.errors import InputError
from instrument.observe.directions import LIGHT, lmn, offset
from instrument.observe.sampling import Sampling
from instrument.sky.points import PointSky
from instrument.sky.sources import FWHM_TO_SIGMA
from instrument.units import Direction, unit_vectors

CENTRE = Direction(np.deg2rad(123.4), np.deg2rad(48.2175))
ARCSEC = np.deg2rad(1 / 3600)
FREQ = np.array([120e6, 150e6, 177e6])


def one(**fields):
    start = {"names": ("a",), "ra_rad": [CENTRE.ra_rad], "dec_rad": [CENTRE.dec_rad], "stokes_jy": [[2.0, 0, 0, 0]]}
    return PointSky(**(start | fields))


def gaussian(fwhm_a, fwhm_b, angle, l=0.0, m=0.0):
    ra, dec = offset(CENTRE, np.array([l]), np.array([m]))
    return one(ra_rad=ra, dec_rad=dec, major_rad=[fwhm_a], minor_rad=[fwhm_b], angle_rad=[angle])


def where(**known):
    """A Sampling of which only some things are known."""
    at = object.__new__(Sampling)
    at.__dict__.update(known)
    return at


def seen(sky, uvw):
    return sky.envelope(where(centre=CENTRE), np.asarray(uvw, float)[None, None])[0, 0]


def test_logarithmic_terms_follow_their_formula():
    sky = one(reference_hz=[150e6], spectral_terms=[[-0.7, 0.3, -0.2]])
    x = np.log10(FREQ / 150e6)
    expected = 2.0 * 10 ** (x * (-0.7 + 0.3 * x - 0.2 * x**2))
    # rtol: a power and a polynomial in float64
    np.testing.assert_allclose(sky.stokes(FREQ)[:, 0, 0], expected, rtol=1e-14)


def test_linear_terms_follow_their_formula():
    sky = one(reference_hz=[150e6], spectral_terms=[[-0.7, 0.3]], logarithmic=[False])
    y = FREQ / 150e6 - 1
    np.testing.assert_allclose(sky.stokes(FREQ)[:, 0, 0], 2.0 - 0.7 * y + 0.3 * y**2, rtol=1e-14)


def test_logarithmic_and_linear_sources_stand_side_by_side():
    both = PointSky.join(
        one(reference_hz=[150e6], spectral_terms=[[-0.7]], logarithmic=[False]),
        one(reference_hz=[100e6], spectral_terms=[[-0.8, 0.1]]),
        one(),
    )
    x = np.log10(FREQ / 100e6)
    expected = np.stack([2 - 0.7 * (FREQ / 150e6 - 1), 2 * 10 ** (x * (-0.8 + 0.1 * x)), 0 * x + 2], axis=1)
    np.testing.assert_allclose(both.stokes(FREQ)[:, :, 0], expected, rtol=1e-14)


def test_a_rotation_measure_turns_q_and_u_and_nothing_else():
    sky = one(stokes_jy=[[2.0, 0.3, -0.4, 0.1]], reference_hz=[150e6], rotation_measure=[3.5])
    stokes = sky.stokes(FREQ)[:, 0]
    turn = 2 * 3.5 * (LIGHT**2 / FREQ**2 - LIGHT**2 / 150e6**2)
    # atol: a phase of up to 40 rad in float64, times 0.5 Jy
    np.testing.assert_allclose(stokes[:, 1] + 1j * stokes[:, 2], (0.3 - 0.4j) * np.exp(1j * turn), atol=1e-13)
    np.testing.assert_array_equal(stokes[:, [0, 3]], [[2.0, 0.1]] * 3)
    np.testing.assert_array_equal(stokes[1], [2.0, 0.3, -0.4, 0.1])


@pytest.mark.parametrize("follows", [True, False])
def test_polarization_carries_the_spectrum_of_i_only_where_told(follows):
    sky = one(
        stokes_jy=[[2.0, 0.3, -0.4, 0.1]],
        reference_hz=[150e6],
        spectral_terms=[[-0.8]],
        polarization_follows_i=[follows],
    )
    scale = (FREQ / 150e6) ** -0.8 if follows else np.ones(3)
    np.testing.assert_allclose(sky.stokes(FREQ)[:, 0, 1:], scale[:, None] * [0.3, -0.4, 0.1], rtol=1e-14)


def test_a_source_long_from_north_to_south_loses_more_on_north_south_baselines():
    sky = gaussian(60 * ARCSEC, 0.0, 0.0)
    length = 2000.0
    east_west, north_south = seen(sky, [[length, 0, 0], [0, length, 0]])[:, 0]
    assert east_west == pytest.approx(1.0, abs=1e-15)
    # FWHM a: exp(-2 pi^2 sigma^2 v^2) = exp(-pi^2 a^2 v^2 / (4 ln 2))
    closed = np.exp(-((np.pi * 60 * ARCSEC * length) ** 2) / (4 * np.log(2)))
    assert north_south == pytest.approx(closed, rel=1e-12)
    assert closed < 0.35


def test_position_angles_count_from_north_through_east():
    sky = gaussian(60 * ARCSEC, 10 * ARCSEC, np.deg2rad(30))
    along = 2000 * np.array([np.sin(np.deg2rad(30)), np.cos(np.deg2rad(30)), 0])
    mirrored = along * [-1, 1, 1]
    loss = 1 - seen(sky, [along, mirrored])[:, 0]
    assert loss[0] > 1.2 * loss[1]


def test_axes_may_be_given_in_either_order():
    a, b = gaussian(20 * ARCSEC, 50 * ARCSEC, 0.4), gaussian(50 * ARCSEC, 20 * ARCSEC, 0.4 + np.pi / 2)
    uvw = np.random.default_rng(0).normal(0, 2000, (20, 3))
    np.testing.assert_allclose(seen(a, uvw), seen(b, uvw), rtol=1e-12)


@pytest.mark.parametrize(("l", "m"), [(0.0, 0.0), (0.08, -0.05)])
def test_the_envelope_is_the_fourier_integral_of_the_brightness(l, m):
    major, minor, angle = 40 * ARCSEC, 25 * ARCSEC, 0.7
    sky = gaussian(major, minor, angle, l, m)
    uvw = np.array([[1500.0, 700, 0], [-900, 2100, 300], [200, 100, -2500], [3000, -1000, 50]])
    # the distribution on the sphere about the source, by its own north and east
    x, y = np.meshgrid(*[np.linspace(-4, 4, 161) * major * FWHM_TO_SIGMA] * 2)  # east, north
    ra, dec = offset(Direction(sky.ra_rad[0], sky.dec_rad[0]), x.ravel(), y.ravel())
    a, b = (x * np.sin(angle) + y * np.cos(angle)).ravel(), (x * np.cos(angle) - y * np.sin(angle)).ravel()
    weight = np.exp(-0.5 * ((a / major) ** 2 + (b / minor) ** 2) / FWHM_TO_SIGMA**2)
    where = lmn(unit_vectors(ra, dec), CENTRE) - lmn(sky.vectors, CENTRE)
    integral = np.exp(-2j * np.pi * uvw @ where.T) @ weight / weight.sum()
    # atol: tails beyond 4 sigma 6e-5; curvature of the sphere over the source 1e-5
    np.testing.assert_allclose(seen(sky, uvw)[:, 0], integral, atol=1e-4)
    assert integral.real.min() < 0.7


def test_points_have_no_envelope():
    assert one().envelope(where(centre=CENTRE), np.ones((1, 1, 1, 3))) is None


def test_brightness_matrices_are_those_of_the_stokes_parameters():
    matrix = one(stokes_jy=[[2.0, 0.3, -0.4, 0.1]]).brightness(where(freq_hz=np.array([1e8])))[0, 0, 0]
    np.testing.assert_allclose(matrix, [[2.3, -0.4 + 0.1j], [-0.4 - 0.1j, 1.7]], rtol=1e-15)


def test_the_brightest_are_those_of_largest_i_plus_p_in_their_own_order():
    sky = PointSky.at(
        SkyCoord([1, 2, 3] * u.deg, [4, 5, 6] * u.deg),
        [[1, 0, 0, 0], [0, 3, 4, 0], [-2, 0, 0, 0]],
        names=("weak", "polarised", "negative"),
    )
    assert sky.brightest(2).names == ("polarised", "negative")
    assert sky.brightest(10) == sky


def test_a_selection_keeps_every_property_of_its_sources():
    sky = PointSky(
        names=("a", "b"), patches=("p", ""), ra_rad=[1, 2], dec_rad=[0.1, 0.2], stokes_jy=[[1, 2, 3, 4], [5, 6, 7, 8]],
        reference_hz=[1e8, 2e8], spectral_terms=[[1], [2]], logarithmic=[True, False], rotation_measure=[1, 2],
        polarization_follows_i=[True, False], major_rad=[1, 2], minor_rad=[3, 4], angle_rad=[5, 6],
    )  # fmt: skip
    again = PointSky.join(sky.select([1]), sky.select([0])).select([1, 0])
    assert again == sky
    assert PointSky.from_json(sky.to_json()) == sky


def test_joining_with_a_constant_sky_changes_no_source():
    rich = one(
        stokes_jy=[[2.0, 0.3, -0.4, 0.1]], reference_hz=[150e6], spectral_terms=[[-0.8]], rotation_measure=[3.0],
        major_rad=[1e-4], minor_rad=[1e-5], angle_rad=[0.3], patches=("p",),
    )  # fmt: skip
    plain = one(stokes_jy=[[1.0, 0.5, 0.2, 0.1]])
    both = PointSky.join(plain, rich)
    np.testing.assert_array_equal(both.stokes(FREQ), np.concatenate([plain.stokes(FREQ), rich.stokes(FREQ)], axis=1))
    assert both.patches == ("", "p")
    np.testing.assert_array_equal(both.gaussian, [False, True])


def test_the_middle_is_weighted_with_the_flux():
    sky = PointSky.at(SkyCoord([10, 10.003] * u.deg, [0, 0] * u.deg), [2.0, 1.0])
    # exact to the second order of the angle: 1e-9
    assert np.rad2deg(sky.middle.ra_rad) == pytest.approx(10.001, abs=1e-9)
    assert PointSky.at(SkyCoord([10, 12] * u.deg, [0, 0] * u.deg), [0.0, 0.0]).middle.ra_rad == pytest.approx(
        np.deg2rad(11)
    )


@pytest.mark.parametrize(
    ("fields", "message"),
    [
        ({"names": (), "ra_rad": [], "dec_rad": [], "stokes_jy": np.zeros((0, 4))}, "sky is empty"),
        ({"patches": ("a", "b")}, "1 sources but 2 patches"),
        ({"ra_rad": [1.0, 2.0]}, "1 sources but 2 entries of ra_rad"),
        ({"stokes_jy": [[np.nan, 0, 0, 0]]}, "stokes_jy of source 'a' is not finite"),
        ({"stokes_jy": [[1.0, 0, 0]]}, r"shape \(1, 3\), needed \(sources, 4\)"),
        ({"dec_rad": [1.6]}, "beyond the pole"),
        ({"spectral_terms": [[-0.7]]}, "need reference_hz"),
        ({"rotation_measure": [1.0]}, "need reference_hz"),
        ({"reference_hz": [0.0]}, "reference_hz must be positive"),
        ({"major_rad": [-1e-5], "minor_rad": [1e-5], "angle_rad": [0.0]}, "major_rad of source 'a' is negative"),
        ({"major_rad": [1e-5]}, "major_rad and minor_rad come together"),
        ({"major_rad": [1e-5], "minor_rad": [2e-5]}, "angle_rad is missing"),
    ],
)
def test_what_is_not_a_sky_is_refused(fields, message):
    with pytest.raises(InputError, match=message):
        one(**fields)


def test_brightest_of_none_is_refused():
    with pytest.raises(InputError, match="brightest = 0 sources"):
        one().brightest(0)
