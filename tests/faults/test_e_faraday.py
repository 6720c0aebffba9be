"""Faraday depth of bands that trip it up: right values where they can be known, and said where they cannot."""

import warnings

import numpy as np
import pytest
from astropy import units as u

from instrument import Analyzer, InputError, StokesCube
from instrument.analyze.faraday.band import FaradayBand
from instrument.errors import InstrumentWarning

WIDE = (800e6 + 9e6 * np.arange(33), 134e6 + 1e6 * np.arange(33))  # 800 to 1088 MHz, and the paper's 134 to 166 MHz


def l2(freq):
    return (299792458.0 / freq) ** 2


def screens(freq, depth, noise=0.0, amplitude=1.0, shape=(12, 12), seed=0, i=None):
    """A cube of thin screens at depths (Ny, Nx), 0 where there is none, and noise."""
    rng = np.random.default_rng(seed)
    depth, amplitude = np.broadcast_to(depth, shape), np.broadcast_to(amplitude, shape)
    data = noise * rng.normal(size=(len(freq), 4, *shape))
    p = amplitude * np.exp(2j * (0.3 + np.multiply.outer(l2(freq), depth)))
    data[:, 1] += p.real
    data[:, 2] += p.imag
    data[:, 0] += 0 if i is None else i
    return StokesCube(data, freq * u.Hz, 0.5 * u.arcmin, "K")


def quiet(call):
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", InstrumentWarning)
        return call()


# E2: the axis, and the noise ----------------------------------------------------------------------------------------


@pytest.mark.parametrize("freq", WIDE)
def test_e2_depths_by_default_are_those_of_the_band(freq):
    found = Analyzer(screens(freq, 3.0, 0.01)).rm_synthesis()
    steps = np.diff(found.depths)
    assert np.allclose(steps, found.fwhm / 8) and found.depths[0] == -found.depths[-1]
    assert found.band.phi_max <= found.depths[-1] < found.band.phi_max + found.fwhm / 8
    assert np.allclose(found.peaks().depth, 3.0, atol=6 * found.peaks().depth_error)


@pytest.mark.parametrize("freq", WIDE)
@pytest.mark.parametrize("source", ["every pixel", "none", "two screens"])
def test_e2_noise_is_that_of_the_channels_whatever_the_axis(freq, source):
    """sigma / sqrt(33), also with a source in every pixel and an axis of two widths: 5 % is 3 sigma of 144 pixels."""
    sigma, depth = 0.03, 20.0
    cube = screens(freq, depth, sigma, 0.0 if source == "none" else 1.0)
    if source == "two screens":
        cube = cube.with_data(cube.data + 0.3 * screens(freq, 15.0, 0.0, seed=1).data)
    for depths in (np.arange(-50, 50.1, 0.25), None):
        found = quiet(lambda depths=depths: Analyzer(cube).rm_synthesis(depths))
        assert found.measured_noise == pytest.approx(sigma / np.sqrt(33), rel=0.05)


def test_e2_sources_are_found_above_the_noise():
    """A screen in 20 of 144 pixels at 800 to 1088 MHz, on the axis that was the default: 20 pixels, not 0."""
    depth = np.full((12, 12), 20.0)
    there = np.zeros((12, 12))
    there.flat[:20] = 1
    found = quiet(lambda: Analyzer(screens(WIDE[0], depth, 0.03, there)).rm_synthesis(np.arange(-50, 50.1, 0.25)))
    peaks = found.peaks()
    assert np.array_equal(peaks.significant, there > 0)
    assert np.allclose(peaks.depth[there > 0], 20.0, atol=5 * np.nanmax(peaks.depth_error))


def test_e2_an_axis_of_few_widths_or_wide_steps_is_warned_of():
    cube = screens(WIDE[0], 3.0, 0.01)
    with pytest.warns(InstrumentWarning, match=r"depths over 100 rad/m2, 1.7 times the FWHM of the RMSF"):
        Analyzer(cube).rm_synthesis(np.linspace(-50, 50, 401))
    with pytest.warns(InstrumentWarning, match=r"depths in steps of 60 rad/m2, but the RMSF is 58.* wide"):
        Analyzer(cube).rm_synthesis(np.arange(-600, 601, 60.0))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        Analyzer(cube).rm_synthesis(np.linspace(-300, 300, 101))
        Analyzer(cube).rm_synthesis([3.0, 200.0])  # two places, not an axis


@pytest.mark.parametrize("channels", [1, 2])
def test_e2_noise_of_two_channels_is_not_known(channels):
    found = quiet(lambda: Analyzer(screens(WIDE[1][:channels], 3.0, 0.01)).rm_synthesis([-1.0, 0.0, 1.0]))
    assert np.isnan(found.measured_noise)


# E3: peaks between depths -------------------------------------------------------------------------------------------


@pytest.mark.parametrize("freq, depths", [(WIDE[0], np.arange(-600, 601, 60.0)), (WIDE[1], np.arange(-50, 51, 2.0))])
def test_e3_peaks_between_steps_wider_than_a_quarter_of_the_rmsf_are_refused(freq, depths):
    found = quiet(lambda: Analyzer(screens(freq, 20.0, 1e-3)).rm_synthesis(depths))
    with pytest.raises(
        InputError, match=r"depths in steps of .* are too far apart for peaks: .* give steps of at most"
    ):
        found.peaks()


@pytest.mark.parametrize("freq", WIDE)
@pytest.mark.parametrize("share", [1 / 4.0001, 1 / 8, 1 / 30])
@pytest.mark.parametrize("dtype", [float, np.float32])
def test_e3_the_depth_of_a_peak_does_not_depend_on_the_steps(freq, share, dtype):
    """Without noise: within 2e-5 of the FWHM at its quarter, 1e-6 of it below (single precision 2e-5)."""
    band = FaradayBand.of(freq * u.Hz)
    depth = np.linspace(-5, 5, 144).reshape(12, 12) * band.fwhm
    cube = screens(freq, depth)
    cube = cube.with_data(cube.data.astype(dtype))
    step = share * band.fwhm
    found = Analyzer(cube).rm_synthesis(step * np.arange(-int(7 / share), int(7 / share)), noise=1e-6)
    peaks = found.peaks()
    most = 1e-6 if dtype is float and share < 0.2 else 2e-5
    assert np.abs(peaks.depth - depth).max() < most * band.fwhm
    assert np.allclose(peaks.peak, 1, atol=most)


def test_e3_a_gap_in_the_depths_is_an_edge_on_both_sides():
    depths = np.concatenate([np.arange(-20, -9.9, 0.25), np.arange(5, 20.1, 0.25)])
    cube = screens(WIDE[1], np.array([[-15.0, 10.0, -9.0, 4.0]]), 1e-3, shape=(1, 4))
    peaks = Analyzer(cube).rm_synthesis(depths).peaks()
    assert peaks.significant.tolist() == [[True, True, False, False]] and peaks.edge[0, 2:].all()
    assert np.allclose(peaks.depth[0, :2], [-15, 10], atol=0.01)


# E4: aliases --------------------------------------------------------------------------------------------------------

TWO_BANDS = np.concatenate([140e6 + 0.2e6 * np.arange(5), 160e6 + 0.2e6 * np.arange(5)])


def test_e4_two_channels_have_an_alias_at_each_turn_and_no_depth():
    """cos(phi (l1 - l2)): |R| is 1 again at pi / (l1 - l2), there is no telling which."""
    freq = np.array([140e6, 160e6])
    turn = np.pi / np.ptp(l2(freq))
    found = Analyzer(screens(freq, 1.0, 0.001)).rm_synthesis(noise=0.001)
    peaks = found.peaks()
    assert not peaks.significant.any() and peaks.ambiguous.any()
    assert peaks.aliases[0] == (pytest.approx(turn, rel=1e-6), pytest.approx(1, abs=1e-9))
    assert np.isnan(peaks.depth_error).all()


def test_e4_two_bands_of_five_channels_have_a_depth_where_their_fringes_can_be_told_apart():
    """The fringe next to the main one is nearly as high: which is which is known from some 180 sigma on."""
    turn = np.pi / (l2(TWO_BANDS[:5]).mean() - l2(TWO_BANDS[5:]).mean())
    band = FaradayBand.of(TWO_BANDS * u.Hz)
    depths = np.arange(-60, 60, band.fwhm / 8)
    (offset, height), *_ = band.aliases(120.0)
    assert offset == pytest.approx(turn, rel=0.01) and 0.99 < height < 1
    snr = 4.5 * np.sqrt(2 / (1 - height))
    for factor, good in ((0.8, 0.0), (1.3, 1.0)):
        sigma = np.sqrt(10) / (factor * snr)
        cube = screens(TWO_BANDS, 7.0, sigma, shape=(20, 20))
        peaks = Analyzer(cube).rm_synthesis(depths, noise=sigma).peaks()
        assert peaks.significant.mean() == pytest.approx(good, abs=0.02) and peaks.aliases[0][0] == pytest.approx(
            offset
        )
        if good:
            pull = (peaks.depth - 7.0) / peaks.depth_error
            assert np.nanstd(pull) == pytest.approx(1, abs=0.1)
        else:
            assert np.isnan(peaks.depth[~peaks.significant]).all() and peaks.ambiguous.any()
    near = Analyzer(cube).rm_synthesis(np.arange(7 - 0.7 * turn, 7 + 0.7 * turn, band.fwhm / 8), noise=0.3).peaks(snr=4)
    assert near.significant.mean() > 0.9  # who knows the depth to a turn has it


def test_e4_missing_voxels_may_make_a_pixel_ambiguous():
    """Two channels at either end are left of 33: a fringe whose neighbour is 0.99 of it, at 40 sigma."""
    cube = screens(WIDE[1], 5.0, 0.05, shape=(1, 3))
    data = cube.data.copy()
    data[2:-2, :, 0, 1] = np.nan
    peaks = Analyzer(cube.with_data(data)).rm_synthesis(noise=0.05).peaks()
    assert peaks.ambiguous.tolist() == [[False, True, False]] and peaks.significant.tolist() == [[True, False, True]]


# E12: Stokes I at low signal ----------------------------------------------------------------------------------------


@pytest.mark.parametrize("signal, voxel", [(3.0, None), (30.0, 1.05)])
def test_e12_division_by_a_faint_i_does_not_make_noise(signal, voxel):
    """I of 3 sigma a channel: F is as noisy as without the division, to 5 %; divided voxel by voxel 3 times or more."""
    freq, shape = WIDE[1], (40, 40)
    rng = np.random.default_rng(3)
    i = signal * (freq / 150e6)[:, None, None] ** -0.8 + rng.normal(size=(33, *shape))
    cube = screens(freq, 0.0, 1.0, 0.0, shape, i=i).with_data(
        np.concatenate([i[:, None], rng.normal(size=(33, 3, *shape))], axis=1)
    )
    depths = np.array([-30.0, -20.0, 20.0, 30.0])
    plain = np.abs(Analyzer(cube).rm_synthesis(depths).data).std()
    auto = np.abs(Analyzer(cube).rm_synthesis(depths, divide_by_i=True).data)
    assert np.isfinite(auto).all() and auto.std() == pytest.approx(plain, rel=0.05)
    fit = np.abs(Analyzer(cube).rm_synthesis(depths, divide_by_i="fit").data).std()
    assert fit == pytest.approx(plain, rel=0.05)
    each = np.nanstd(np.abs(Analyzer(cube).rm_synthesis(depths, divide_by_i="voxel").data))
    assert each > 3 * plain if voxel is None else each == pytest.approx(plain, rel=0.05)


def test_e12_the_fitted_power_law_is_unbiased_at_low_signal():
    """A screen of 0.5 I, I of 3 sigma a channel and index -2.5: 0.5 I at the reference, within 3 sigma and 1 %."""
    freq, shape = WIDE[1], (40, 40)
    rng = np.random.default_rng(4)
    spectrum = 3.0 * (freq / 150e6)[:, None, None] ** -2.5
    p = 0.5 * spectrum * np.exp(2j * 7 * l2(freq))[:, None, None]
    data = rng.normal(size=(33, 4, *shape))
    data[:, 0] += spectrum
    data[:, 1] += p.real
    data[:, 2] += p.imag
    cube = StokesCube(data, freq * u.Hz, 0.5 * u.arcmin, "K")
    found = Analyzer(cube).rm_synthesis([7.0], divide_by_i=True)
    level = (found.data[0] * np.exp(-2j * 7 * found.lambda2_0)).mean()
    wanted = 1.5 * (found.reference_hz / 150e6) ** -2.5
    assert abs(level - wanted) < 3 * np.sqrt(2 / 33 / 1600) + 0.01 * wanted
    assert found.measured_noise == pytest.approx(1 / np.sqrt(33), rel=0.05)


def test_e12_a_division_that_is_none_is_refused():
    cube = screens(WIDE[1], 1.0, 0.01)
    with pytest.raises(InputError, match="divide_by_i = 'power' is not one of True, False, 'voxel'"):
        Analyzer(cube).rm_synthesis([0.0], divide_by_i="power")


# Priced before it is allocated --------------------------------------------------------------------------------------


def test_a_faraday_cube_that_is_too_large_is_refused_with_its_size(monkeypatch):
    monkeypatch.setattr("instrument.memory.usable", lambda: 1e6)
    with pytest.raises(
        InputError, match=r"Faraday cube of 1001 depths and 144 pixels would take 2.31 MB .* fewer depths"
    ):
        Analyzer(screens(WIDE[1], 1.0, 0.01)).rm_synthesis(np.linspace(-50, 50, 1001))
