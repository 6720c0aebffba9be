"""Q and U as templates of the leakage into I: exact without noise, its error as it says, the signal left alone."""

import numpy as np
import pytest
from astropy import units as u

from instrument import InputError, Outcome, StokesCube, StokesMaps, load, signal_loss
from instrument.errors import PluginError
from instrument.foreground.base import ForegroundRemover
from instrument.foreground.maps import Usable
from instrument.image.mocks import leaked, noise_cube, polarized_screens
from instrument.sky.screens import FINE

LONG = pytest.mark.long
SMALL = {"pixels": 48, "pixel": 2 * u.arcmin, "screens": FINE, "seed": 1}


@pytest.fixture(scope="module")
def truth():
    return leaked(polarized_screens(**SMALL))


def noisy(truth, rms, seed=0, shaped=True):
    return truth.with_data(truth.data + noise_cube(truth, rms * u.K, shaped, seed=seed).data)


def templates(**settings):
    return load("foregrounds", "stokes-templates", **settings)


def test_without_noise_nothing_of_the_leakage_is_left(truth):
    # a quadrupole that grows with the square of distance and frequency: degree 2 in both
    left = templates(order=2).split(truth).residual.data[:, 0]
    assert np.abs(left).max() < 3e-6 * np.abs(truth.data[:, 0]).max()  # float32
    assert templates(order=1).split(truth).residual.data[:, 0].std() > 0.1 * truth.data[:, 0].std()


@pytest.mark.parametrize(
    ("rms", "shaped", "draws"),
    [(60e-3, True, 4), pytest.param(2e-3, True, 24, marks=LONG), pytest.param(60e-3, False, 24, marks=LONG)],
)
def test_its_error_is_as_large_as_it_says(truth, rms, shaped, draws):
    # the power of an error of 90 coefficients scatters by 15 % a draw, and is said to 10 %
    wrong, said = 0.0, 0.0
    for seed in range(draws):
        split = templates().split(noisy(truth, rms, seed, shaped))
        wrong += np.mean((split.foreground.data[:, 0] - truth.data[:, 0]).astype(float) ** 2)
        said += np.trace(split.separation.covariance) / len(truth.data)
    assert abs(wrong / said - 1) < 0.15 + 3 * 0.15 / np.sqrt(draws)


@LONG
def test_it_gains_under_noise_where_projections_do_harm(truth):
    cube = noisy(truth, 60e-3)
    ours, filtered = (remover.split(cube) for remover in (templates(), load("foregrounds", "faraday-filter")))
    assert ours.score(foreground=truth).value < 0.2
    assert filtered.score(foreground=truth).value > 1
    estimate = ours.score()
    assert abs(estimate.value - ours.score(foreground=truth).value) < 3 * estimate.sigma


def test_a_signal_comes_through_at_every_scale(truth):
    cube = noisy(truth, 2e-3, seed=1)
    rng = np.random.default_rng(5)
    signal = cube.with_data(np.zeros_like(cube.data))
    signal.data[:, 0] = rng.normal(scale=5e-3, size=signal.data[:, 0].shape)
    loss = signal_loss(templates(), cube, signal)
    for low, high in ((0.0, 0.03), (0.03, 0.1), (0.1, 1.0)):
        transfer, ratio = loss.within((low, high))
        assert abs(transfer - 1) < 0.02 and abs(ratio - 1) < 0.04
    # the Faraday filter takes what is smooth of it
    assert loss.within((0.0, 0.03))[0] > 0.98 > 0.3 > signal_loss(
        load("foregrounds", "faraday-filter"), cube, signal
    ).within((0.0, 0.03))[0]  # fmt: skip


@LONG
def test_a_smooth_sky_that_is_not_in_q_and_u_needs_smooth_terms(truth):
    maps = np.random.default_rng(3).normal(scale=2.0, size=(48, 48)).astype(np.float32)
    smooth = (truth.freq_hz / 150e6)[:, None, None] ** -2.55 * maps
    data = np.array(truth.data)
    data[:, 0] += smooth
    cube = truth.with_data(data)
    left = [templates(smooth=k).split(cube).residual.data[:, 0].std() for k in (0, 6)]
    assert left[0] > 1 and left[1] < 1e-3 * truth.data[:, 0].std()


@LONG
def test_channels_weigh_by_their_noise(truth):
    cube = noisy(truth, 1e-3, seed=2, shaped=False)
    data = np.array(cube.data)
    data[20:40, 0] += np.random.default_rng(1).normal(scale=10e-3, size=data[20:40, 0].shape)
    keep = np.r_[0:20, 40:161]
    without = StokesCube(cube.data[keep], cube.freq_hz[keep] * u.Hz, cube.pixel_rad * u.rad, "K")
    errors = []
    for one, rows in ((cube.with_data(data), keep), (without, slice(None))):
        found = templates().split(one).foreground.data[rows, 0]
        errors.append((found - truth.data[keep, 0]).std())
    assert errors[0] < 1.3 * errors[1]  # all alike: 3.4


def test_zeros_are_no_templates_and_a_cube_without_them_is_refused(truth):
    data = np.array(truth.data)
    data[:, 1:3] = 0
    bare = StokesCube(data, truth.freq_hz * u.Hz, truth.pixel_rad * u.rad, "K", constants="data")
    split = templates().split(bare)
    assert split.outcome is Outcome.REFUSED and "Q and U are zero" in split.remark
    assert np.array_equal(split.residual.data, bare.data)
    data[:, 1] = truth.data[:, 1]
    one = templates().split(bare.with_data(data))
    assert one.outcome is Outcome.CONVERGED
    data[:, 2] = np.nan
    with pytest.raises(InputError, match="U has no pixel with data in every channel"):
        templates().split(bare.with_data(data))
    with pytest.raises(InputError, match="stokes"):
        templates(stokes="Q")


def test_the_same_template_twice_is_told(truth):
    data = np.array(truth.data)
    data[:, 2] = data[:, 1]
    split = templates().split(truth.with_data(data))
    assert split.outcome is Outcome.SINGULAR and split.remark.startswith("45 of 90 coefficients")


# What every remover is given -------------------------------------------------------------------------------------


def test_the_noise_of_maps_is_that_of_each_channel(truth):
    rng = np.random.default_rng(0)
    rms = np.where(np.arange(161) < 80, 1e-3, 3e-3)
    data = truth.data.astype(float)
    data[:, 0] += rms[:, None, None] * rng.normal(size=data[:, 0].shape)
    data[:, 2] += 5e-3 * rng.normal(size=data[:, 2].shape)
    data[3, 0, :12] = np.nan  # a quarter are holes
    given = Usable.of(truth.with_data(data), "I", ("U",)).maps
    assert np.allclose(np.r_[given.noise()[5:75], given.noise()[85:155]], np.r_[rms[5:75], rms[85:155]], rtol=0.2)
    assert abs(given.noise().mean() / rms.mean() - 1) < 0.05
    assert len(given) == 161 and given.unit == "K" and given.psf.major_rad.shape == (161,)
    assert not given["U"][:, :12].any() and given["U"][:, 12:].all()
    with pytest.raises(InputError, match="Stokes Q was not asked for: name it in the `planes`"):
        given["Q"]


def test_the_psf_goes_with_the_channels_that_are_left(truth):
    data = np.array(truth.data)
    data[[3, 90]] = np.nan
    given = Usable.of(truth.with_data(data), "I").maps
    keep = np.delete(np.arange(161), [3, 90])
    assert np.array_equal(given.psf.major_rad, truth.psf.major_rad[keep])
    assert set(given.planes) == {"I"}


def test_a_remover_of_before_is_told_what_to_write():
    with pytest.raises(PluginError, match=r"Old.separate\(maps, freq_hz\) .* write separate\(self, given\)"):

        class Old(ForegroundRemover):
            def separate(self, maps, freq_hz):
                raise NotImplementedError


def test_maps_to_be_split_can_be_given_anew():
    given = StokesMaps("Q", {"Q": np.zeros((2, 3, 4)), "I": np.ones((2, 3, 4))}, np.array([1e8, 2e8]), 1e-4, "K")
    other = given.with_plane(np.full((2, 3, 4), 7.0))
    assert other.plane[0, 0, 0] == 7 and other["I"] is given["I"] and not given.plane.any()
