"""Cubes that came from elsewhere and trip an analysis up: as much as they allow is made, the rest is said."""

import dataclasses

import numpy as np
import pytest
from astropy import units as u

import instrument
from instrument import Analyzer, CubeAnalysis, InputError, Psf, Signal21cm, StokesCube, leaked, noise_cube, signal_loss
from instrument.analyze.cube_checks import check_faraday
from instrument.cli import main
from instrument.errors import InstrumentWarning
from instrument.image.mocks import polarized_screens
from instrument.sky.screens import FINE

FREQ = 140e6 + 0.5e6 * np.arange(33)
PIXEL = 4 * u.arcmin
LOOK = {"depths": (-10, 10, 0.5), "bins": 4}


def cube(planes="QU", freq_hz=FREQ, pixels=24, unit="K", psf=None, scale=1.0, pixel=PIXEL):
    """Q and U of a screen at 2 rad/m², I and V of noise, for the planes that are named; NaN for the others."""
    rng = np.random.default_rng(0)
    data = np.full((len(freq_hz), 4, pixels, pixels), np.nan, np.float32)
    p = np.exp(4j * (299792458.0 / freq_hz) ** 2)[:, None, None] + 0.1 * rng.normal(size=(len(freq_hz), pixels, pixels))
    parts = {"I": 1e-2 * rng.normal(size=p.shape), "Q": p.real, "U": p.imag, "V": 1e-3 * rng.normal(size=p.shape)}
    for name in planes:
        data[:, "IQUV".index(name)] = scale * parts[name]
    return StokesCube(data, freq_hz * u.Hz, pixel, unit, psf=psf)


def made(given, **settings):
    return CubeAnalysis(**{**LOOK, **settings}).run(given)


def spoilt(given, *where, value=np.nan):
    data = given.data.copy()
    data[where] = value
    return given.with_data(data)


# As much as there is ----------------------------------------------------------------------------------------------


@pytest.mark.parametrize("planes", ["I", "V", "Q", "QU", "IQUV"])
def test_any_stokes_parameters_give_what_they_allow(planes):
    found = made(cube(planes))
    assert (found.faraday is not None) == ({"Q", "U"} <= set(planes))
    assert bool(found.windows) == ("I" in planes)
    assert found.spheres and found.passed


@pytest.mark.parametrize("channels", [2, 3, 5])
def test_a_few_channels_are_enough(channels):
    found = made(cube("IQU", FREQ[:channels]))
    assert found.faraday is not None and found.cylinders and found.windows


def test_a_channel_without_data_leaves_the_rest(tmp_path):
    found = made(spoilt(cube("IQU"), 16))  # the middle one
    assert found.faraday is not None and found.planes and not found.cylinders
    assert "1 channels are all NaN: fill them in with infill" in found.left_out["spherical"]
    filled = made(spoilt(cube("IQU"), 16), infill=300 * u.ns)
    assert filled.cylinders and filled.windows and filled.planes


def test_channels_that_are_missing_leave_the_rest():
    found = made(cube("IQU", np.delete(FREQ, [5, 6])))
    assert found.faraday is not None and "2 channels are missing" in found.left_out["cylindrical"]
    with pytest.raises(InputError, match="products = 'spherical': 2 channels are missing"):
        made(cube("IQU", np.delete(FREQ, [5, 6])), products=("spherical",))


def test_i_without_data_at_the_brightest_pixel_of_q_and_u():
    given = spoilt(cube("IQU"), slice(None), slice(1, 3), 5, 7, value=9.0)
    found = made(spoilt(given, slice(None), 0, 5, 7), products=("faraday",))
    assert found.brightest == (5, 7) and "I" not in found.sights and "P" in found.sights


def test_a_beam_is_asked_for_where_there_is_data_only():
    width = np.full(33, np.deg2rad(0.1))
    width[4] = np.nan
    psf = Psf.gaussian(width * u.rad)
    given = spoilt(cube("IQU", unit="Jy/beam", psf=psf), 4)
    assert made(given, infill=300 * u.ns).spheres["I"].unit == "K"
    assert made(cube("IQU", unit="Jy/pixel")).spheres["I"].unit == "K"  # pixels are beam enough


def test_values_of_1e18_are_drawn(tmp_path):
    cube("QU", scale=1e18).write(tmp_path / "huge.fits")
    assert main(["analyze", str(tmp_path / "huge.fits"), "--out", str(tmp_path / "out"), "--depths", "-5,5,1"]) == 0


# What cannot be done is said --------------------------------------------------------------------------------------


def test_a_cube_without_data_is_refused():
    for given in (spoilt(cube("IQU"), slice(None)), spoilt(cube("IQUV"), slice(None), value=0)):
        with pytest.raises(InputError, match="the cube has no data: every voxel is NaN or zero"):
            made(given)


def test_an_image_of_one_pixel_has_no_k_perp():
    with pytest.raises(InputError, match="one pixel has no k_perp above 0"):
        Analyzer(cube("I", pixels=1)).cylindrical()


def test_channels_of_which_most_are_missing_make_no_grid():
    with pytest.raises(InputError, match="3 channels lie on 10000"):
        Analyzer(cube("I", np.array([140e6, 140e6 + 1, 150e6]))).cylindrical(infill=300 * u.ns)


def test_channels_rounded_to_a_khz_are_even():
    step = 195312.5
    freq = np.round((120e6 + step * np.arange(200)) / 1e3) * 1e3
    assert np.isfinite(Analyzer(cube("I", freq, pixels=6)).spherical(bins=3).power).any()


def test_filling_in_a_wide_gap_warns_of_the_noise_it_makes():
    freq = np.delete(FREQ, np.arange(8, 24))
    with pytest.warns(InstrumentWarning, match=r"filling in makes noise .* times as large"):
        Analyzer(cube("I", freq)).spherical(infill=600 * u.ns)


def test_noise_of_another_grid_is_not_added_to_a_leakage():
    signal = Signal21cm.table()
    given = cube("I")
    for other in (cube("I", FREQ * 1.2), cube("I", pixel=8 * u.arcmin), cube("I", unit="Jy/pixel")):
        with pytest.raises(InputError, match="spectra differ in bins or unit"):
            Analyzer(given).eor_window(signal, noise=other)


def test_a_window_in_which_no_bin_counts_says_so():
    window = Analyzer(cube("I")).eor_window(Signal21cm.table(), k_par_min=99)
    assert "no bin counts: all are in the wedge, empty or outside the model" in str(window)
    for wrong in ({"wedge": 100 * u.deg}, {"wedge": -5 * u.deg}, {"k_par_min": np.nan}):
        with pytest.raises(InputError, match=r"wedge = |k_par_min = "):
            Analyzer(cube("I")).eor_window(Signal21cm.table(), **wrong)


def test_spectra_of_zeros_do_not_make_the_noise_zero():
    given = cube("QU")
    masked = spoilt(given, slice(None), slice(1, 3), slice(0, 18), value=0)
    depths = np.arange(-30, 30.1, 0.5)
    assert Analyzer(masked).rm_synthesis(depths).measured_noise == pytest.approx(
        Analyzer(spoilt(given, slice(None), slice(1, 3), slice(0, 18))).rm_synthesis(depths).measured_noise, rel=1e-6
    )
    assert not Analyzer(masked).rm_synthesis(depths).peaks().significant[:18].any()


def test_a_check_does_not_take_nan_for_right():
    given = cube("QU")
    found = Analyzer(given).rm_synthesis(np.arange(-10, 11.0))
    assert check_faraday(given, found).passed
    assert not check_faraday(given, dataclasses.replace(found, data=found.data * np.nan)).passed


@pytest.mark.parametrize("beam", ["-4 arcmin", "inf arcmin", "0 deg", "nan deg"])
def test_a_beam_that_is_none_is_refused(tmp_path, capsys, beam):
    cube("I", unit="Jy/beam").write(tmp_path / "jy.fits")
    assert main(["analyze", str(tmp_path / "jy.fits"), "--out", str(tmp_path / "out"), f"--beam={beam}"]) == 2
    assert "--beam" in capsys.readouterr().err and not (tmp_path / "out").exists()


def test_a_signal_on_other_pixels_is_not_injected():
    with pytest.raises(InputError, match="pixels of another size"):
        signal_loss(instrument.load("foregrounds", "pca"), cube("I"), cube("I", pixel=9 * u.arcmin))


@pytest.mark.parametrize("name", ["pca", "gpr"])
@pytest.mark.parametrize("holes", ["circle", "stripes"])
def test_a_score_is_right_where_lines_of_sight_are_missing(name, holes):
    """Of noise seen through holes a draw goes through them once more: without care its power is too small."""
    sky = polarized_screens(pixels=48, pixel=1.5 * u.arcmin, screens=FINE, seed=1)
    leakage = leaked(sky)
    data = leakage.data + noise_cube(leakage, 60 * u.mK, seed=2).data
    y, x = np.indices((48, 48)) - 24
    data[:, :, (np.hypot(y, x) > 15) if holes == "circle" else (x % 3 == 0)] = np.nan
    with pytest.warns(InstrumentWarning):
        split = instrument.load("foregrounds", name).split(leakage.with_data(data))
    found, truth = split.score(), split.score(foreground=leakage)
    assert abs(found.value - truth.value) < 3 * found.sigma + 0.15 * truth.value, (found, truth)
    assert found.value > 0.5 * truth.value
