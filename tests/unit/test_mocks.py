"""Generated skies: the grid, random sources and the mock of the 3C196 field against the figures they promise."""

import numpy as np
import pytest
from astropy import units as u
from scipy.stats import kstest

import instrument
from instrument.component import Component
from instrument.errors import InputError
from instrument.observe.directions import LIGHT, lmn
from instrument.sky.mocks import FIELD, FaradaySky, GridSky, MockField, RandomSky, mock_fluxes
from instrument.sky.points import PointSky
from instrument.units import Direction

CENTRE = Direction(np.deg2rad(40.0), np.deg2rad(-30.0))
SEEDS = [196, *range(24)]


def test_a_grid_stands_at_whole_steps_of_its_direction_cosines():
    sky = GridSky(shape=(3, 5), spacing=2 * u.deg, flux=1 * u.Jy).about(CENTRE)
    steps = np.array([(k, j) for j in range(-2, 3) for k in range(-1, 2)])
    # atol: directions go through right ascension and declination
    np.testing.assert_allclose(lmn(sky.vectors, CENTRE)[:, :2], np.deg2rad(2) * steps, atol=1e-15)
    assert sky.names == tuple(f"g{k:+d}{j:+d}" for k, j in steps)


def test_an_even_grid_is_centred_between_its_sources():
    sky = GridSky(shape=(2, 4)).about(CENTRE)
    assert len(sky) == 8
    np.testing.assert_allclose(lmn(sky.vectors, CENTRE)[:, :2].mean(axis=0), 0, atol=1e-15)
    assert sky.names[0] == "g-0.5-1.5"


def test_the_centre_of_a_grid_may_have_its_own_flux():
    sky = GridSky(shape=(15, 15), spacing=0.66 * u.deg, flux=0.4 * u.Jy, centre_flux=100 * u.Jy).about(CENTRE)
    bright = np.flatnonzero(sky.stokes_jy[:, 0] > 1)
    assert [sky.names[k] for k in bright] == ["g+0+0"]
    assert sky.stokes_jy[:, 0].sum() == pytest.approx(100 + 224 * 0.4, rel=1e-14)
    assert sky.distance_rad(CENTRE)[bright[0]] < 1e-15


def test_the_polarised_fraction_of_a_grid_is_the_same_at_every_frequency():
    sky = GridSky(shape=(2, 2), polarization=(0.1, -0.2, 0.05), spectral_index=-0.8).about(CENTRE)
    stokes = sky.stokes(np.array([100e6, 200e6]))
    np.testing.assert_allclose(stokes[..., 1:] / stokes[..., :1], np.broadcast_to([0.1, -0.2, 0.05], (2, 4, 3)))
    np.testing.assert_allclose(stokes[1, :, 0] / stokes[0, :, 0], 2**-0.8)


def test_random_sources_keep_within_their_radius_and_fluxes():
    sky = RandomSky(count=3000, radius=7 * u.deg, polarization=0.3, seed=1).about(CENTRE)
    flux = sky.stokes_jy[:, 0]
    assert np.rad2deg(sky.distance_rad(CENTRE).max()) <= 7
    assert 0.027 <= flux.min() < flux.max() <= 83
    np.testing.assert_allclose(np.hypot(*sky.stokes_jy[:, 1:3].T), 0.3 * flux)


def test_random_sources_are_uniform_over_the_sky_and_follow_their_power_law():
    sky = RandomSky(count=3000, radius=120 * u.deg, slope=2.2, flux_min=1 * u.Jy, flux_max=5 * u.Jy, seed=2).about(
        CENTRE
    )
    share = (1 - np.cos(sky.distance_rad(CENTRE))) / (1 - np.cos(np.deg2rad(120)))
    above = (sky.stokes_jy[:, 0] ** -1.2 - 5**-1.2) / (1 - 5**-1.2)
    # a fixed seed; a wrong law (r ~ sqrt(u), slope 1.9) gives p below 1e-6
    assert kstest(share, "uniform").pvalue > 0.01
    assert kstest(above, "uniform").pvalue > 0.01


def test_a_slope_of_one_is_the_limit_of_its_neighbours():
    fluxes = [RandomSky(slope=s).about(CENTRE).stokes_jy[:, 0] for s in (1.0, 1.0 + 1e-6)]
    np.testing.assert_allclose(*fluxes, rtol=1e-4)


@pytest.mark.parametrize("kind", [RandomSky, MockField])
def test_a_seed_names_one_sky(kind):
    first = kind(seed=3).about(FIELD)
    assert kind(seed=3).about(FIELD) == first
    assert not np.array_equal(kind(seed=4).about(FIELD).stokes_jy, first.stokes_jy)


@pytest.mark.parametrize("seed", SEEDS)
def test_the_mock_field_meets_its_figures_for_every_seed(seed):
    slope, drawn = mock_fluxes(np.random.default_rng(seed))
    flux = MockField(seed=seed).about(FIELD).stokes_jy[:, 0]
    np.testing.assert_array_equal(flux[2:], drawn)
    # 1.9327 +- 0.0004 is the scatter over 200 seeds: three of these for the single seed
    assert slope == pytest.approx(1.9327, abs=3 * 0.0004)
    assert len(flux) == 4567
    assert flux.sum() == pytest.approx(796.64, abs=1e-9)
    assert flux.min() == 0.027
    assert np.all(np.diff(flux) <= 0)
    share = 100 * np.cumsum(flux)[[0, 4, 49, 399, 999]] / flux.sum()
    # the ranges found over 200 seeds, which are rounded to 0.01
    assert np.all(share >= np.array([10.43, 13.82, 29.85, 60.14, 75.49]) - 0.005)
    assert np.all(share <= np.array([10.44, 14.01, 30.05, 60.23, 75.52]) + 0.005)


def test_the_slope_of_the_mock_field_scatters_as_little_as_promised():
    slopes = [mock_fluxes(np.random.default_rng(seed))[0] for seed in SEEDS]
    # standard error of a mean of 25: 0.0001; of their width: 15 %
    assert np.mean(slopes) == pytest.approx(1.9327, abs=0.0003)
    assert 0.0002 < np.std(slopes) < 0.0006


def test_seed_196_is_the_catalogue_that_the_package_carries():
    made, carried = MockField().about(FIELD), PointSky.read("mock_150mhz.csv")
    # atol: the file has 6 decimals
    np.testing.assert_allclose(made.stokes_jy, carried.stokes_jy, atol=5.1e-7)
    np.testing.assert_allclose(made.vectors, carried.vectors, atol=np.deg2rad(1e-6))
    np.testing.assert_array_equal(made.spectral_terms, carried.spectral_terms)
    assert made.names == carried.names
    assert [float(f"{made.stokes_jy[r - 1, 0]:.3g}") for r in (5, 50, 400, 1000)] == [6.18, 1.76, 0.332, 0.133]


def test_the_mock_field_lies_within_five_degrees():
    sky = MockField(seed=7).about(FIELD)
    distance = np.rad2deg(sky.distance_rad(FIELD))
    assert distance[0] == 0
    assert distance.max() < 5
    # half of a uniform cap lies beyond 3.54 deg; 4231 random ones scatter by 0.8 %
    assert np.mean(distance[336:] > 5 / np.sqrt(2)) == pytest.approx(0.5, abs=0.03)


def test_components_replace_3c196_and_change_neither_the_total_nor_the_rest():
    whole, parts = MockField().about(FIELD), MockField(components=True).about(FIELD)
    assert parts.patches[:5] == ("3C196",) * 4 + ("",)
    assert parts.names[4:] == whole.names[1:]
    assert parts.stokes_jy[:, 0].sum() == pytest.approx(796.64, abs=1e-9)
    np.testing.assert_array_equal(parts.gaussian, [True] * 4 + [False] * 4566)
    np.testing.assert_array_equal(parts.stokes(np.array([130e6]))[:, 4:], whole.stokes(np.array([130e6]))[:, 1:])


def test_pairs_stand_beside_an_earlier_source():
    sky, single = MockField(pairs=0.3).about(FIELD), MockField().about(FIELD)
    moved = np.flatnonzero(np.abs(sky.vectors - single.vectors).max(axis=1) > 1e-9)
    # 0.3 of 4231 with a binomial scatter of 0.7 %
    assert len(moved) / 4231 == pytest.approx(0.3, abs=0.03)
    assert moved.min() >= 336
    chord = [np.linalg.norm(sky.vectors[:k] - sky.vectors[k], axis=1) for k in moved]
    near = np.rad2deg([c.min() for c in chord]) * 3600
    assert near.max() <= 40.001
    # nearer than 5 arcsec are only chance meetings around one parent: a third have a sibling, 4 % of those that near
    assert np.mean(near < 4.999) < 0.03
    np.testing.assert_array_equal(sky.stokes_jy, single.stokes_jy)


def test_scatter_widens_the_spectral_indices():
    index = MockField(scatter=0.2).about(FIELD).spectral_terms[:, 0]
    # standard errors of mean and width of 4567: 0.003 and 0.002
    assert index.mean() == pytest.approx(-0.75, abs=0.012)
    assert index.std() == pytest.approx(0.2, abs=0.009)


@pytest.mark.parametrize("name", ["grid", "random", "mock-3c196"])
def test_generated_skies_load_by_name_and_go_through_json(name):
    sky = instrument.load("skies", name)
    assert Component.from_json(sky.to_json()) == sky
    assert sky.about(FIELD) is sky.about(FIELD)
    assert sky.about(CENTRE) is sky.about(CENTRE)


@pytest.mark.parametrize(
    "ask", [lambda s: s.directions(), lambda s: s.brightness(None), lambda s: s.envelope(None, None)]
)
def test_a_sky_that_has_not_been_placed_says_so(ask):
    with pytest.raises(InputError, match=r"GridSky has no sources yet: call about\(phase_centre\) first"):
        ask(GridSky())


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: GridSky(shape=(2, 3), centre_flux=1 * u.Jy), "centre_flux needs odd numbers"),
        (lambda: GridSky(spacing=0 * u.deg), "spacing and frequency must be positive"),
        (lambda: GridSky(spacing=0.66), "spacing needs a unit convertible to rad"),
        (lambda: GridSky(polarization=(0.8, 0.8, 0)), "together at most 1"),
        (lambda: GridSky(shape=(0, 3)), "shape = 0"),
        (lambda: GridSky(shape=(21, 1), spacing=10 * u.deg).about(CENTRE), "not on the sky"),
        (lambda: RandomSky(radius=200 * u.deg), "radius = 200 deg"),
        (lambda: RandomSky(flux_min=2 * u.Jy, flux_max=1 * u.Jy), "fluxes must rise"),
        (lambda: RandomSky(polarization=0.9, circular=0.9), "more than 100 % polarised"),
        (lambda: RandomSky(frequency=0 * u.Hz), "frequency must be positive"),
        (lambda: RandomSky(polarization=30), "polarization = 30"),
        (lambda: MockField(pairs=-0.1), "pairs = -0.1"),
    ],
)
def test_impossible_settings_are_refused(make, message):
    with pytest.raises(InputError, match=message):
        make()


def test_a_faraday_sky_has_no_total_intensity_and_turns_with_the_wavelength():
    sky = FaradaySky(count=50, flux=2 * u.Jy, depths=(3.0, 3.0), spectral_index=-1.0, radius=2 * u.deg, seed=4)
    placed = sky.about(CENTRE)
    freq = np.array([150e6, 140e6])
    at = placed.stokes(freq)
    assert not at[..., [0, 3]].any()
    p = at[..., 1] + 1j * at[..., 2]
    np.testing.assert_allclose(np.abs(p[0]), 2, rtol=1e-12)
    np.testing.assert_allclose(np.abs(p[1]), 2 * 150 / 140, rtol=1e-12)
    turn = 2 * 3.0 * np.diff((LIGHT / freq) ** 2)[0]
    np.testing.assert_allclose(np.angle(p[1] / p[0]), np.angle(np.exp(1j * turn)), rtol=1e-9)
    assert np.rad2deg(placed.distance_rad(CENTRE).max()) <= 2 + 1e-9
    for wrong, said in (({"depths": (2.0, 1.0)}, "least and the most"), ({"radius": 0 * u.deg}, "0 to 180 deg")):
        with pytest.raises(InputError, match=said):
            FaradaySky(**wrong)
