"""Faraday synthesis of bad and extreme input: right, or one clear line."""

import subprocess
import sys
import warnings

import numpy as np
import pytest
from astropy import units as u

from instrument import Analyzer, InputError, StokesCube
from instrument.analyze.faraday.band import FaradayBand, depth_of_k_par, k_par_of_depth
from instrument.errors import UnitError
from instrument.observe.directions import LIGHT

PAPER = 134e6 + 0.2e6 * np.arange(161)
SHORT = PAPER[::5]
WIDE = np.linspace(-50, 50, 401)


def l2(freq):
    return (LIGHT / np.asarray(freq, float)) ** 2


def thin(depth, freq=SHORT):
    return np.exp(2j * np.multiply.outer(l2(freq), np.atleast_2d(depth)))


def analyzer(p, freq=SHORT, dtype=float, i=0.0):
    data = np.zeros((len(p), 4, *p.shape[1:]), dtype)
    data[:, 0], data[:, 1], data[:, 2] = i, p.real, p.imag
    return Analyzer(StokesCube(data, freq * u.Hz, 0.5 * u.arcmin, "K"))


def direct(p, freq, depths, lambda2_0=None):
    x = l2(freq) - (l2(freq).mean() if lambda2_0 is None else lambda2_0)
    return np.tensordot(np.exp(-2j * np.outer(depths, x)), p, axes=1) / len(p)


# Dynamic range ----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("precision, most", [("double", 1e-9), ("single", 1.0)])
def test_a_component_beside_one_a_million_times_brighter(precision, most):
    """1e6 at -30 and 1 at 20 in one spectrum: what the bright one leaves there is known, the rest is the weak one.

    complex128 within 1e-9 of the weak component; complex64 has 7 digits of the bright one and no more.
    """
    p = 1e6 * thin(-30.0, PAPER) + thin(20.0, PAPER)
    found = analyzer(p, PAPER).rm_synthesis(WIDE, precision=precision)
    at = np.flatnonzero(WIDE == 20.0)[0]
    weak = found.data[at, 0, 0] - 1e6 * np.exp(2j * -30 * found.lambda2_0) * found.rmsf_at(50.0)
    assert weak * np.exp(-2j * 20 * found.lambda2_0) == pytest.approx(1, abs=most)
    exact = direct(p, PAPER, WIDE)
    assert np.abs(found.data - exact).max() < most


@pytest.mark.parametrize("dtype", [np.float32, float])
def test_a_pixel_beside_one_1e12_times_brighter_keeps_its_digits(dtype):
    rng = np.random.default_rng(1)
    p = thin([[7.0, -12.0, 3.0]]) + 0.1 * rng.normal(size=(33, 1, 3))
    scaled = p * np.array([1e12, 1, 1e-12])
    found = analyzer(scaled, dtype=dtype).rm_synthesis(WIDE).data / np.array([1e12, 1, 1e-12])
    exact = direct(p, SHORT, WIDE)
    assert (np.abs(found - exact).max(axis=0) < 1e-6 * np.abs(exact).max(axis=0)).all()


def test_a_channel_of_little_weight_may_be_a_million_times_louder():
    """1e6 in one of 161 channels of weight 1e-6, the others thin sources of 1: single precision as ever."""
    p = thin(7.0, PAPER)
    p[50] *= 1e6
    weights = np.where(np.arange(161) == 50, 1e-6, 1.0)
    found = analyzer(p, PAPER).rm_synthesis(WIDE, weights=weights, precision="single", lambda2_0=4.0)
    x = l2(PAPER) - 4.0
    exact = np.exp(-2j * np.outer(WIDE, x)) @ (weights * p[:, 0, 0]) / weights.sum()
    assert np.abs(found.data[:, 0, 0] - exact).max() < 3e-7 * np.abs(exact).max()


@pytest.mark.parametrize("precision, most", [("double", 4e-8), ("single", 1e-6)])
def test_a_depth_of_2000_and_absolute_phases(precision, most):
    """20000 rad of phase: made in float64 they cost 1e-11, in float32 they would cost 1e-3."""
    p = thin(2000.0, PAPER)
    found = analyzer(p, PAPER).rm_synthesis([1999.0, 2000.0, -2000.0], lambda2_0=0, precision=precision)
    assert np.abs(found.data - direct(p, PAPER, found.depths, 0.0)).max() < most
    assert np.abs(found.data[1, 0, 0]) == pytest.approx(1, abs=most)


def test_a_source_beyond_the_largest_depth_is_seen_when_sampled_at_points_and_its_aliases_are_weaker():
    """At 116 rad/m² a point-sampled source keeps 1; lambda² is uneven, so no depth repeats another up to 1000."""
    depths = np.arange(-200, 1000, 0.5)
    size = np.abs(analyzer(thin(116.0, PAPER), PAPER).rm_synthesis(depths).data[:, 0, 0])
    assert depths[np.argmax(size)] == 116 and size.max() == pytest.approx(1)
    assert 0.1 < size[np.abs(depths - 116) > 100].max() < 0.2


def test_frequencies_in_float32_are_squared_in_float64():
    freq = np.float32([150e6, 151e6, 152e6])
    cube = StokesCube(np.ones((3, 4, 1, 1)), u.Quantity(freq, "Hz", dtype=np.float32), 1 * u.arcmin, "K")
    assert np.array_equal(Analyzer(cube).rm_synthesis([0]).lambda2, l2(freq.astype(float)))


# Nothing, next to nothing -----------------------------------------------------------------------------------------


def test_pixels_of_zeros_are_zero_and_pixels_without_data_nan():
    p = np.ones((33, 1, 3), complex)
    p[:, 0, 0], p[:, 0, 1] = 0, np.nan
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        found = analyzer(p).rm_synthesis(WIDE)
        cleaned = found.clean(cutoff=0.01)
        peaks = found.peaks(noise=1e-3)
        chart = found.noise_map()
    assert (
        not found.data[:, 0, 0].any() and np.isnan(found.data[:, 0, 1]).all() and np.isfinite(found.data[:, 0, 2]).all()
    )
    assert not cleaned.restored[:, 0, 0].any() and np.isnan(cleaned.components[:, 0, 1]).all()
    assert peaks.significant.tolist() == [[False, False, True]]
    assert np.isnan(chart[0, 1]) and np.isfinite(chart[0, 0])
    cleaned.check()  # a pixel without data is not one that failed


@pytest.mark.parametrize("shape", [(1, 6), (6, 1), (1, 1)])
def test_images_of_one_row_or_column_keep_their_axes(shape):
    found = analyzer(np.ones((33, *shape), complex)).rm_synthesis([1.0, 2.0])
    cleaned, peaks = found.clean(cutoff=0.1), found.peaks()
    assert found.data.shape == cleaned.restored.shape == (2, *shape)
    assert cleaned.iterations.shape == cleaned.fwhm.shape == peaks.depth.shape == found.noise_map().shape == shape


def test_q_of_zero_and_u_of_one_is_an_angle_of_45_degrees():
    found = analyzer(np.full((33, 1, 1), 1j)).rm_synthesis(WIDE, noise=0.01)
    assert found.data[200, 0, 0] == pytest.approx(1j, abs=1e-14)
    assert found.peaks().angle_0[0, 0] == pytest.approx(np.pi / 4) and found.peaks().depth[0, 0] == pytest.approx(
        0, abs=1e-9
    )


def test_one_channel_one_depth_and_everything_else_works():
    found = analyzer(np.full((1, 1, 2), 3 + 4j), SHORT[:1]).rm_synthesis(7.0)
    assert found.data.shape == (1, 1, 2) and np.allclose(found.data, 3 + 4j)
    assert found.rmsf_depths.tolist() == [0] and found.rmsf.tolist() == [1] and found.fwhm == np.inf
    cleaned = found.clean(cutoff=0.01)
    assert cleaned.components.sum() == pytest.approx(2 * (3 + 4j), abs=0.02) and np.isinf(cleaned.fwhm).all()
    peaks = found.peaks(noise=0.1)
    assert peaks.edge.all() and np.isnan(peaks.depth).all()


def test_clean_with_one_channel_restores_what_was_there():
    found = analyzer(np.full((1, 1, 1), 3 + 4j), SHORT[:1]).rm_synthesis(WIDE)
    assert np.allclose(found.clean(cutoff=1e-6).restored, 3 + 4j)


def test_a_flag_pattern_raises_the_first_sidelobe_of_its_own_rmsf():
    p = np.ones((161, 1, 2), complex)
    p[40:120, 0, 1] = np.nan
    found = analyzer(p, PAPER).rm_synthesis(WIDE)
    cleaned = found.clean(cutoff=0.5)
    size = np.abs(found.data[:, 0])
    assert size[200].tolist() == pytest.approx([1, 1])
    beyond = np.abs(WIDE) > found.fwhm
    assert size[beyond, 0].max() < 0.25 < 0.5 < size[beyond, 1].max()
    assert cleaned.fwhm[0, 1] < cleaned.fwhm[0, 0] == pytest.approx(found.fwhm)


def test_every_pixel_may_have_flags_of_its_own():
    rng = np.random.default_rng(2)
    p = np.broadcast_to(thin(7.0), (33, 40, 50)).copy()
    p[rng.random(p.shape) < 0.2] = np.nan
    found = analyzer(p, dtype=np.float32).rm_synthesis(np.linspace(-20, 20, 161))
    assert len(np.unique(found.flags, axis=1).T) > 1900
    cleaned = found.clean(cutoff=1e-3)
    cleaned.check()
    at = np.flatnonzero(found.depths == 7)[0]
    assert np.allclose(np.abs(cleaned.components[at]), 1, atol=2e-3)
    assert np.abs(cleaned.components).sum(axis=0) == pytest.approx(1, abs=2e-3)  # no sidelobe became a component


# Memory -----------------------------------------------------------------------------------------------------------

MAPPED = """
import sys
import numpy as np
from astropy import units as u
from instrument import Analyzer, StokesCube
from instrument.memory import high_water
data = np.random.default_rng(0).normal(size=(9, 4, 300, 300)).astype(np.float32)
cube = StokesCube(data, (134 + 4 * np.arange(9)) * u.MHz, 1 * u.arcmin, "K")
Analyzer(cube).rm_synthesis(np.linspace(-5, 5, 7), out=sys.argv[1] + "/a.npy")
before = high_water()
found = Analyzer(cube).rm_synthesis(np.linspace(-50, 50, 1201), out=sys.argv[1] + "/b.npy")
print(found.data.nbytes / 1e6, (high_water() - before) / 1e6)
"""


def test_output_in_a_file_does_not_fill_the_memory(tmp_path):
    """865 MB of F: pages are let go of every 256 MB, and chunks in work are 8 MB each, several times a core."""
    done = subprocess.run([sys.executable, "-c", MAPPED, str(tmp_path)], capture_output=True, text=True, timeout=300)
    assert done.returncode == 0, done.stderr
    size, grown = map(float, done.stdout.split())
    assert size > 860 and grown < 450


# Refused ----------------------------------------------------------------------------------------------------------

GOOD = np.ones((33, 2, 3), complex)
BAD = [
    ({"depths": []}, "depths have shape \\(0,\\): give one axis"),
    ({"depths": [[1.0, 2.0]]}, "depths have shape \\(1, 2\\)"),
    ({"depths": [1.0, np.nan]}, "depths must be finite numbers in rad/m2, got nan"),
    ({"depths": "wide"}, "depths must be finite numbers in rad/m2, got str"),
    ({"stokes": "X"}, "stokes = 'X' is not one of 'I', 'Q', 'U', 'V', 'P'"),
    ({"precision": "half"}, "precision = 'half' is not one of 'single', 'double'"),
    ({"weights": [1, 2]}, "weights must be 33 numbers"),
    ({"weights": -np.ones(33)}, "none below 0"),
    ({"weights": np.full(33, np.nan)}, "weights must be finite numbers, got nan"),
    ({"weights": np.zeros(33)}, "no channel with data and weight"),
    ({"noise": -1.0}, "noise must be one number or 33"),
    ({"noise": [1.0, 2.0]}, "noise must be one number or 33"),
    ({"noise": 1.0, "divide_by_i": True}, "says nothing about Q/I"),
    ({"lambda2_0": np.inf}, "lambda2_0 must be finite numbers in m2, got inf"),
    ({"lambda2_0": [1.0, 2.0]}, "lambda2_0 takes one value"),
    ({"spectral_index": np.nan}, "spectral_index = nan must be a finite number"),
    ({"spectral_index": -0.7, "divide_by_i": True}, "leave out spectral_index"),
    ({"stokes": "I", "divide_by_i": True}, "leave out spectral_index, and stokes = 'I'"),
]


@pytest.mark.parametrize("settings, message", BAD, ids=[str(i) for i in range(len(BAD))])
def test_synthesis_refuses_in_one_line(settings, message):
    with pytest.raises(InputError, match=message) as caught:
        analyzer(GOOD).rm_synthesis(**{"depths": WIDE, **settings})
    assert "\n" not in str(caught.value)


def test_synthesis_refuses_cubes_without_data_or_with_infinities():
    with pytest.raises(InputError, match="rm_synthesis needs a cube"):
        Analyzer().rm_synthesis(WIDE)
    with pytest.raises(InputError, match="Stokes P of this cube has no channel with data and weight"):
        analyzer(np.full((33, 2, 3), np.nan + 0j)).rm_synthesis(WIDE)
    half = GOOD.copy()
    half.imag[:] = np.nan  # Q alone is no polarization
    with pytest.raises(InputError, match="no channel with data"):
        analyzer(half).rm_synthesis(WIDE)
    wrong = GOOD.copy()
    wrong[9, 1, 2] = np.inf
    with pytest.raises(InputError, match=r"values beyond 1.8e\+305 in channel 9: make infinite pixels NaN"):
        analyzer(wrong).rm_synthesis(WIDE)
    with pytest.raises(InputError, match=r"values beyond 3.4e\+35 in channel 0"):
        analyzer(1e36 * GOOD).rm_synthesis(WIDE, precision="single")


@pytest.mark.parametrize(
    "settings, message",
    [
        ({}, "clean needs one of cutoff= \\(in K\\) and sigmas="),
        ({"cutoff": 1.0, "sigmas": 3}, "clean needs one of"),
        ({"cutoff": -1.0}, "must not be below 0"),
        ({"cutoff": np.nan}, "cutoff must be finite"),
        ({"cutoff": 1.0, "gain": 0}, "gain = 0.0 must be above 0 and at most 1"),
        ({"cutoff": 1.0, "gain": 1.5}, "gain = 1.5"),
        ({"cutoff": 1.0, "iterations": -1}, "iterations = -1"),
    ],
)
def test_clean_refuses_in_one_line(settings, message):
    with pytest.raises(InputError, match=message):
        analyzer(GOOD).rm_synthesis(WIDE).clean(**settings)


@pytest.mark.parametrize("depths", [[0.0, 1.0, 3.0], [5.0, 5.0], [3.0, 1.0, 2.0], np.geomspace(1, 50, 30)])
def test_clean_refuses_uneven_depths(depths):
    with pytest.raises(InputError, match="RM-CLEAN needs"):
        analyzer(GOOD).rm_synthesis(depths).clean(cutoff=0.1)


def test_an_axis_in_float32_is_even_enough():
    analyzer(GOOD).rm_synthesis(np.arange(-50, 50, 0.1, dtype=np.float32)).clean(cutoff=0.5).check()


def test_the_band_and_the_map_refuse_in_one_line():
    with pytest.raises(UnitError, match="frequencies needs a unit"):
        FaradayBand.of([150e6])
    for freq, weights in (([0, 1] * u.MHz, None), ([1, 2] * u.MHz, [1]), ([1, 2] * u.MHz, [0, 0]), ([1] * u.MHz, [-1])):
        with pytest.raises(InputError):
            FaradayBand.of(freq, weights)
    with pytest.raises(InputError, match=r"channel_width = .* must be above 0"):
        FaradayBand.of([150] * u.MHz, channel_width=-1 * u.MHz)
    for wrong in (1e11, 0.0, -1.0):
        with pytest.raises(InputError):
            k_par_of_depth(1, wrong)
    with pytest.raises(UnitError, match="k_par needs a unit convertible to 1/Mpc"):
        depth_of_k_par(1 * u.m, 150e6)
    with pytest.raises(InputError, match="depths must be finite"):
        k_par_of_depth(np.nan, 150e6)
