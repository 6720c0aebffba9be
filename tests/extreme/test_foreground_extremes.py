"""Foreground removers on extreme input: each line of the list of extreme cases, with its right answer."""

import warnings

import numpy as np
import pytest
from astropy import units as u

import instrument
from instrument import InputError, InstrumentWarning, Outcome, StokesCube, StokesMaps

FREQ = np.linspace(134e6, 166e6, 41)
NAMES = ("gmca", "pca", "polynomial", "faraday-filter", "gpr")
COUNTED = (("gmca", "components"), ("pca", "components"), ("polynomial", "terms"))


def load(name, **settings):
    return instrument.load("foregrounds", name, **settings)


def cube_of(maps, freq=FREQ):
    data = np.zeros((len(maps), 4, *maps.shape[1:]), maps.dtype)
    data[:, 0] = maps
    return StokesCube(data, freq * u.Hz, 2 * u.arcmin, "K", constants="data")  # removers look for themselves


def smooth(rank, shape=(40, 44), seed=0):
    """Maps of that many power laws (F, Ny, Nx), 1 K, 0.3 K, ..."""
    rng = np.random.default_rng(seed)
    images = rng.standard_normal((rank, *shape))
    return sum(0.3**k * np.multiply.outer((FREQ / 150e6) ** (-2.55 + 0.7 * k), images[k]) for k in range(rank))


def noise(scale, shape=(40, 44), seed=1):
    return np.random.default_rng(seed).normal(0, scale, (len(FREQ), *shape))


def residual(name, maps, freq=FREQ, **settings):
    return load(name, **settings).split(cube_of(maps, freq)).residual.data[:, 0]


# How many components ---------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("name", "field"), COUNTED)
def test_no_component_leaves_the_data(name, field):
    maps = smooth(2) + noise(0.01)
    found = load(name, **{field: 0}).split(cube_of(maps))
    np.testing.assert_array_equal(found.residual.data[:, 0], maps)
    assert found.components.shape == (0, 40, 44)


@pytest.mark.parametrize("more", [0, 5])
@pytest.mark.parametrize(("name", "field"), COUNTED)
def test_as_many_components_as_channels_or_more_leave_exactly_nothing_and_warn(name, field, more):
    with pytest.warns(InstrumentWarning, match="41 components of 41 channels are everything"):
        left = residual(name, smooth(2) + noise(0.01), **{field: 41 + more})
    assert not left.any()


@pytest.mark.parametrize(("name", "field"), COUNTED)
def test_a_negative_number_of_components_is_refused(name, field):
    with pytest.raises(InputError, match=field):
        load(name, **{field: -1})


@pytest.mark.parametrize("settings", [{}, {"mode": "threshold"}, {"paper": True}, {"noise": "white"}], ids=str)
def test_more_components_than_the_rank_leave_rounding_not_nan(settings):
    left = residual("gmca", smooth(1), components=4, **settings)
    # soft thresholds turn the columns together, and 1e-9 is the floor of what tells them apart
    assert np.abs(left).max() < (1e-6 if "paper" in settings else 1e-12)


def test_a_rank_below_the_number_of_components_leaves_rounding_after_principal_components():
    assert np.abs(residual("pca", smooth(1), components=4)).max() < 1e-12


def test_equal_columns_of_the_mixing_are_the_same_as_one():
    from instrument.foreground.linear import projection

    maps, one = smooth(1), ((FREQ / 150e6) ** -2.55)[:, None]
    twice = projection(maps, np.hstack([one, 2 * one, one]), Outcome.CONVERGED, "three times one")
    once = projection(maps, one, Outcome.CONVERGED, "one")
    np.testing.assert_allclose(twice.of(maps), once.of(maps), atol=1e-12)


@pytest.mark.parametrize("name", ["gmca", "pca"])
def test_components_of_a_millionth_are_removed_in_double_precision(name):
    rng = np.random.default_rng(4)
    spectra = np.linalg.qr(rng.standard_normal((41, 4)))[0]
    images = rng.laplace(size=(4, 40, 44)) ** 3  # sparse
    maps = sum(10.0 ** (-2 * k) * np.multiply.outer(spectra[:, k], images[k]) for k in range(4))
    left = residual(name, maps, components=4)
    assert np.abs(left).max() < 1e-5 * 1e-6 * np.abs(images).max()  # the weakest is 1e-6


# Noise alone, bright pixels --------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", ["gmca", "pca"])
def test_four_components_of_noise_take_four_dimensions_and_little_more(name):
    maps = noise(1.0, (64, 64))
    left = residual(name, maps).var() / maps.var()
    # the largest of 41 eigenvalues of 4096 pixels are up to (1 + sqrt(41/4096))^2 = 1.21 times the mean
    assert 1 - 1.21 * 4 / 41 < left < 1 - 0.9 * 4 / 41


def test_thresholds_take_half_a_percent_of_noise_at_most():
    maps = noise(1.0, (100, 100))
    assert residual("gmca", maps, mode="threshold").var() / maps.var() > 0.995


# sparse components share the bright pixel among them beyond 1e6: mask it first
@pytest.mark.parametrize(("name", "bright"), [("gmca", 1e6), ("pca", 1e12)])
def test_a_pixel_as_bright_as_that_takes_one_component_and_spoils_no_other(name, bright):
    maps = smooth(2)
    maps[:, 7, 9] += bright * np.random.default_rng(2).uniform(0.5, 1, 41)
    left = residual(name, maps, components=3)
    left[:, 7, 9] = 0
    assert np.abs(left).max() < 1e-3  # 1e12 by the rounding of float64 is 1e-4
    masked = maps.copy()
    masked[:, 7, 9] = np.nan
    with pytest.warns(InstrumentWarning, match="1 of 1760 lines of sight have NaN"):
        left = residual(name, masked, components=2)
    assert np.nanmax(np.abs(left)) < 1e-10


# Channels and pixels without data --------------------------------------------------------------------------------


@pytest.mark.parametrize("name", NAMES)
def test_a_cube_of_zeros_stays_zero_and_a_constant_channel_is_left_as_it_is(name):
    with pytest.warns(InstrumentWarning, match="41 of 41 channels do not vary"):
        found = load(name).split(cube_of(np.zeros((41, 20, 20))))
    assert not found.residual.data.any() and not found.foreground.data.any()
    assert "nothing was taken away" in str(found)
    maps = smooth(2) + noise(0.01)
    maps[5] = 3.0
    with pytest.warns(InstrumentWarning, match="1 of 41 channels do not vary"):
        left = residual(name, maps)
    np.testing.assert_array_equal(left[5], 3.0)
    rest = np.delete(np.arange(41), 5)
    due = residual(name, maps[rest], FREQ[rest])
    np.testing.assert_allclose(left[rest], due, atol=1e-9)


@pytest.mark.parametrize("name", NAMES)
def test_a_component_without_variance_is_no_component(name):
    maps = smooth(1) + 1e-6 * noise(1.0)
    assert np.isfinite(residual(name, maps)).all()


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
def test_what_has_no_data_is_nan_there_and_the_same_elsewhere(value):
    maps = smooth(3) + noise(0.01)
    good = residual("pca", np.delete(maps, 8, axis=0), np.delete(FREQ, 8))
    maps[8] = value
    with pytest.warns(InstrumentWarning, match="1 of 41 channels and 0 of 1760"):
        left = residual("pca", maps)
    assert np.isnan(left[8]).all()
    np.testing.assert_allclose(np.delete(left, 8, axis=0), good, atol=1e-12)


def test_a_channel_that_is_mostly_empty_costs_itself_not_the_pixels_of_all_others():
    maps = smooth(3) + noise(0.01)
    maps[8, :, 3:] = np.nan
    with pytest.warns(InstrumentWarning, match="1 of 41 channels and 0 of 1760"):
        left = residual("pca", maps)
    assert np.isnan(left[8]).all() and np.isfinite(np.delete(left, 8, axis=0)).all()


def test_the_same_rim_of_nan_in_every_channel_is_left_out_of_everything():
    maps = smooth(3) + noise(0.01)
    due = residual("pca", maps[:, 4:-4, 4:-4])
    maps[:, :4] = maps[:, -4:] = maps[:, :, :4] = maps[:, :, -4:] = np.nan
    with pytest.warns(InstrumentWarning, match="0 of 41 channels"):
        left = residual("pca", maps)
    np.testing.assert_allclose(left[:, 4:-4, 4:-4], due, atol=1e-12)
    assert np.isnan(left[:, :4]).all()


def test_a_cube_without_any_data_is_refused():
    for maps in (np.full((41, 8, 8), np.nan), np.full((41, 8, 8), np.inf)):
        with pytest.raises(InputError, match="no pixel with data in every channel"):
            residual("pca", maps)
    maps = smooth(1)
    maps[:20, :, :22] = np.nan
    maps[20:, :, 22:] = np.nan
    with pytest.raises(InputError, match="no pixel with data in every channel"):
        residual("pca", maps)


# Scales and orders -----------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", NAMES)
def test_a_power_of_two_scales_the_residual_exactly_and_1e6_to_rounding(name):
    maps = smooth(3) + noise(0.01)
    before = residual(name, maps)
    np.testing.assert_array_equal(residual(name, maps * 2.0**20), before * 2.0**20)
    np.testing.assert_allclose(residual(name, maps * 1e6), before * 1e6, atol=1e-6 * 1e6)


@pytest.mark.parametrize("scale", [1e-30, 1e30])
@pytest.mark.parametrize("name", NAMES)
def test_float32_cubes_of_any_size_are_split_alike(name, scale):
    maps = (smooth(3) + noise(0.01)).astype(np.float32)
    left = residual(name, maps * np.float32(scale))
    assert left.dtype == np.float32
    np.testing.assert_allclose(left / np.float32(scale), residual(name, maps), atol=1e-4)


def test_a_cube_beyond_what_squares_can_hold_is_refused():
    for scale in (1e160, 1e-160):
        with pytest.raises(InputError, match="beyond what squares can hold: scale the cube"):
            residual("pca", smooth(1) * scale)


@pytest.mark.parametrize("name", NAMES)
def test_integers_are_numbers(name):
    maps = np.round(1000 * (smooth(2) + noise(0.01))).astype(int)
    np.testing.assert_allclose(residual(name, maps), residual(name, maps.astype(float)), rtol=1e-12)


def test_complex_cubes_are_refused():
    with pytest.raises(InputError, match="needed real numbers"):
        residual("pca", smooth(1).astype(complex))


@pytest.mark.parametrize("name", NAMES)
def test_one_channel_one_pixel_one_row(name):
    rng = np.random.default_rng(0)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", InstrumentWarning)
        assert np.isfinite(residual(name, rng.standard_normal((1, 9, 9)), FREQ[:1])).all()
        assert np.isfinite(residual(name, rng.standard_normal((41, 1, 1)))).all()
        for shape in ((1, 30), (30, 1)):
            left = residual(name, rng.standard_normal((41, *shape)))
            assert left.shape == (41, *shape) and np.isfinite(left).all()


def test_fewer_pixels_than_channels_are_all_foreground_to_four_components_of_them():
    assert np.abs(residual("pca", np.random.default_rng(0).standard_normal((41, 2, 2)))).max() < 1e-12


# Basis -----------------------------------------------------------------------------------------------------------


def test_the_polynomial_is_as_good_with_ten_terms_as_with_one():
    # powers of nu in Hz have a condition of 1e28 for four terms; the operator of an orthonormal basis is a projection
    operator = load("polynomial", terms=10).separate(StokesMaps("I", {"I": smooth(1)}, FREQ, 1e-4, "K")).operator
    np.testing.assert_allclose(operator @ operator, operator, atol=1e-12)
    assert np.trace(operator) == pytest.approx(10, abs=1e-10)


def test_the_polynomial_fits_negative_pixels_as_it_fits_positive_ones():
    maps = smooth(1)
    np.testing.assert_allclose(residual("polynomial", -maps), -residual("polynomial", maps), atol=0)
    assert (maps < 0).any() and np.abs(residual("polynomial", maps)).max() < 1e-3  # fourth order of 2.55 x 0.107


def test_channels_of_one_frequency_have_one_term():
    maps = np.ones((41, 3, 3)) * np.arange(9).reshape(3, 3) + noise(0.1, (3, 3))
    left = residual("polynomial", maps, np.full(41, 150e6), terms=1)
    np.testing.assert_allclose(left, maps - maps.mean(axis=0), atol=1e-12)


# The Gaussian process --------------------------------------------------------------------------------------------


def test_the_gaussian_process_refuses_one_channel_in_words():
    found = load("gpr").split(cube_of(np.random.default_rng(0).standard_normal((1, 9, 9)), FREQ[:1]))
    assert found.outcome is Outcome.REFUSED and "one channel" in found.remark
    assert not found.foreground.data.any()


def test_without_noise_the_gaussian_process_stays_finite():
    assert np.abs(residual("gpr", smooth(1))).max() < 1e-3  # jitter and the least noise: 1e-9 of the variance


def test_a_flat_likelihood_takes_little_and_ends():
    # white noise: no length says anything
    maps = noise(1.0)
    found = load("gpr").split(cube_of(maps))
    assert np.isfinite(found.residual.data).all()
    assert found.residual.data[:, 0].var() > 0.95 * maps.var()


def test_a_limit_on_the_likelihoods_is_said():
    found = load("gpr", iterations=1).split(cube_of(smooth(3) + noise(0.01)))
    assert found.outcome is Outcome.ITERATION_LIMIT


# Nothing significant ---------------------------------------------------------------------------------------------


def test_gmca_with_nothing_above_its_threshold_takes_nothing_and_says_so():
    maps = noise(1.0)
    found = load("gmca", threshold=50.0).split(cube_of(maps))
    assert found.outcome is Outcome.REFUSED and "nothing was taken away" in str(found)
    np.testing.assert_array_equal(found.residual.data[:, 0], maps)


def test_gmca_ends_alike_from_the_same_data_and_says_when_it_does_not_settle():
    maps = smooth(3) + noise(0.01)
    np.testing.assert_array_equal(residual("gmca", maps), residual("gmca", maps))
    assert load("gmca", iterations=2).split(cube_of(noise(1.0))).outcome is Outcome.ITERATION_LIMIT


def test_a_remover_that_makes_nan_is_caught():
    from instrument import ForegroundRemover, Separation

    class Bad(ForegroundRemover):
        def separate(self, given):
            maps = given.plane
            none = np.zeros((0, *maps.shape[1:]))
            return Separation(Outcome.CONVERGED, "bad", np.zeros((len(maps), 0)), none, foreground=maps * np.nan)

    maps = smooth(1)
    found = Bad().split(cube_of(maps))
    assert found.outcome is Outcome.SINGULAR and "NaN" in found.remark
    np.testing.assert_array_equal(found.residual.data[:, 0], maps)


def test_a_gaussian_process_states_its_jitter():
    """Where the noise goes to zero it is what is left of it, and an answer is no better than that."""
    split = load("gpr").split(cube_of(smooth(2)))
    jitter = float(split.remark.split("jitter ")[1])
    assert 1e-6 < jitter / smooth(2).std() < 1e-4
