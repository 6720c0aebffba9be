"""Found by attacking the finished doors: masks, units of images, dtypes, weights, sizes that squares cannot hold."""

from dataclasses import replace

import numpy as np
import pytest
from astropy import units as u
from astropy.coordinates import SkyCoord
from astropy.utils.masked import Masked

import instrument as ins

CENTRE = SkyCoord("08h13m36.0s +48d13m03s")
FREQ = np.arange(150, 158, 0.5) * u.MHz


def cube(data=None, freq=FREQ, pixel=4 * u.arcmin, **more):
    data = np.random.default_rng(0).normal(size=(len(freq), 4, 16, 16)) if data is None else data
    return ins.StokesCube(data, freq, pixel, "K", **more)


@pytest.fixture(scope="module")
def vis():
    enu = np.array([[0, 0, 0], [100, 0, 0], [0, 200, 1.0], [-150, 70, 2.0]])
    layout = ins.Layout.from_enu(list("abcd"), enu * u.m, 0.12 * u.rad, 0.92 * u.rad, 50 * u.m)
    observation = ins.Observation(
        phase_centre=CENTRE,
        start="2012-12-07T23:00:00",
        duration=40 * u.s,
        interval=10 * u.s,
        frequencies=[150, 150.2] * u.MHz,
    )
    instrument = ins.Composed(stations=layout, terms=ins.Chain())
    return ins.Scene(instrument=instrument, sky=ins.PointSky.at(CENTRE, [3.0]), observation=observation).plan().run()


def refused(call, *words):
    with pytest.raises(ins.InputError) as found:
        call()
    assert "\n" not in str(found.value)
    assert all(word in str(found.value) for word in words), str(found.value)


# What lies under a mask ----------------------------------------------------------------------------------------------


def test_masked_voxels_of_a_cube_are_no_data():
    masked = np.ma.masked_array(cube().data.copy(), mask=False)
    masked[3, 1:3, 5, 6], masked.mask[3, 1:3, 5, 6] = 1e30, True
    found = cube(masked)
    assert np.isnan(found.data[3, 1:3, 5, 6]).all() and np.isnan(found.data).sum() == 2
    assert type(found.data) is np.ndarray


def test_masked_numbers_are_refused_where_nan_has_no_meaning(vis):
    mask = np.zeros(vis.data.shape, bool)
    mask[0, 0, 0] = True
    two, hide = SkyCoord([1, 2] * u.deg, [3, 4] * u.deg), [False, True]
    refused(lambda: replace(vis, data=np.ma.masked_array(vis.data, mask)), "data", "masked", "4")
    refused(lambda: vis.with_data(np.ma.masked_array(vis.data, mask)), "data", "masked")
    refused(lambda: vis.weighted(np.ma.masked_array(np.ones((1, 2, 1)), [[[0], [1]]])), "weight", "masked")
    refused(lambda: vis.flagged(np.ma.masked_array(np.zeros((1, 2, 1), bool), [[[0], [1]]])), "flag", "masked")
    refused(lambda: ins.PointSky.at(two, np.ma.masked_array([1, 9999.0], hide)), "stokes_jy", "masked")
    refused(lambda: ins.PointSky.at(two, Masked([1, 9999.0] * u.Jy, hide)), "stokes_jy", "masked")
    weights = np.ma.masked_array(np.ones(16), np.arange(16) < 3)
    refused(lambda: ins.Analyzer(cube()).rm_synthesis([0.0, 5.0], weights=weights), "weights", "masked")
    enu = np.ma.masked_array([[0, 0, 0.0], [9, 0, 0]], [[0, 0, 0], [1, 1, 1]])
    positions = np.ma.masked_array(vis.layout.positions_m, True)
    refused(lambda: ins.Layout.geodetic(vis.layout.names, positions), "positions_m", "masked")
    refused(
        lambda: ins.Layout.from_enu(["a", "b"], Masked(enu.data * u.m, enu.mask), 0 * u.rad, 0 * u.rad, 0 * u.m), "enu"
    )


def test_a_mask_that_hides_nothing_is_no_obstacle(vis):
    assert replace(vis, data=np.ma.masked_array(vis.data)).data.sum() == vis.data.sum()
    assert type(replace(vis, data=np.ma.masked_array(vis.data)).data) is np.ndarray


# What images are made of ---------------------------------------------------------------------------------------------


def test_images_with_a_unit_are_in_the_unit_of_the_cube():
    """1000 mK were 1000 K: numpy drops the unit."""
    same = cube(cube().data * 1000 * u.mK)
    assert np.allclose(same.data, cube().data, rtol=1e-15, atol=0) and type(same.data) is np.ndarray
    jansky = ins.StokesCube(cube().data * 1000 * u.mJy / u.beam, FREQ, 4 * u.arcmin, "Jy/beam")
    assert np.allclose(jansky.data, cube().data, rtol=1e-15, atol=0)
    refused(lambda: cube(cube().data * u.Jy), "data", "K", "Jy")


@pytest.mark.parametrize("kind", [complex, object, str, bool])
def test_images_are_real_numbers(kind):
    refused(lambda: cube(cube().data.astype(kind)), "data", "real numbers")


def test_a_cube_has_pixels_and_lies_on_the_sky():
    refused(lambda: cube(cube().data[:, :, :0]), "data", "(16, 4, 0, 16)")
    refused(lambda: cube(pixel=[4, 4] * u.arcmin), "pixel", "one value")
    refused(lambda: cube(pixel=60 * u.deg), "pixel", "960 deg")
    refused(lambda: cube(freq=np.linspace(2, 2.1, 16) * u.m), "frequencies", "Hz")


@pytest.mark.filterwarnings("ignore:overflow")
@pytest.mark.parametrize("scale", [1e-200, 1e200])
def test_power_of_what_squares_cannot_hold_is_refused(scale):
    """Power of 1e-200 K was 0 and its window 100 % open; that of 1e200 K was infinite."""
    faint = ins.Analyzer(cube(cube().data * scale))
    for call in (faint.spectrum_2d, faint.cylindrical, faint.spherical):
        refused(call, "squares", "scale the cube")
    refused(lambda: faint.eor_window(ins.Signal21cm.table(), bins=3, bins_par=3), "squares")


# Visibilities --------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("kind", ["c8", ">c16", ">c8", "f8", "list"])
def test_visibilities_of_any_numbers_give_the_same_images_and_gains(vis, kind):
    """Single precision ended in a traceback of the gridder, small station numbers in one of the solver."""
    data = vis.data.tolist() if kind == "list" else vis.data.real if kind == "f8" else vis.data.astype(kind)
    found = replace(
        vis,
        data=data,
        weight=np.ones((1, 1, 1), ">f4"),
        antenna1=vis.antenna1.astype(">i2"),
        antenna2=vis.antenna2.astype("u1"),
    )
    imager = ins.Imager(pixels=32, pixel=2 * u.arcmin)
    # 3 Jy at the centre: exact in all precisions; threads of the gridder sum in any order, 5e-11 was seen
    assert np.allclose(imager.image(found).data, imager.image(vis).data, rtol=0, atol=1e-9)
    gains = ins.SelfCal().solve(found, found)
    assert np.all(gains.outcome == ins.Outcome.CONVERGED)


def test_baselines_are_of_two_stations_each_once(vis):
    refused(lambda: replace(vis, antenna2=vis.antenna2[:-1]), "antenna2", "6")
    refused(lambda: replace(vis, antenna2=vis.antenna1), "itself", "a")
    twice = np.where(np.arange(6) == 5, 0, np.arange(6))
    refused(lambda: replace(vis, antenna1=vis.antenna1[twice], antenna2=vis.antenna2[twice]), "a-b", "twice")
    swapped = replace(vis, antenna1=vis.antenna2, antenna2=vis.antenna1)
    assert np.array_equal(swapped.uvw_m, -vis.uvw_m)


@pytest.mark.parametrize("weight", [1e-320, 1e-200, 1e200, 1e308])
def test_weights_whose_squares_leave_the_numbers_are_refused(vis, weight):
    """Briggs with weights of 1e-200 said that there was no visibility; natural ones of 1e308 gave NaN."""
    refused(lambda: vis.weighted(np.full((1, 1, 1), weight)), "weight", f"{weight:g}", "scale")


@pytest.mark.parametrize("weight", [1e-99, 1e99])
@pytest.mark.parametrize("weighting", ["natural", "uniform", "briggs"])
def test_weights_within_may_be_scaled(vis, weight, weighting):
    imager = ins.Imager(pixels=32, pixel=2 * u.arcmin, weighting=weighting)
    wanted = imager.image(vis)
    found = imager.image(vis.weighted(np.full((1, 1, 1), weight)))
    assert np.allclose(found.data, wanted.data, rtol=0, atol=1e-9)  # of 3 Jy; 5e-11 was seen, the gridder's threads


@pytest.mark.parametrize("size", [1e200, 1e-200])
def test_gains_that_take_data_out_of_the_numbers_are_flagged(vis, size):
    """Data over the square of 1e200 were 0, with all their weight."""
    found = vis.corrected(ins.GainTerm(values=np.full((1, 1, 4, 2), size, complex)))
    assert not found.effective_weight.any() and not found.data.any()


# Settings ------------------------------------------------------------------------------------------------------------


def test_settings_without_meaning_are_refused():
    """A thousand million bins ended in a MemoryError; no wavelength has a square below 0."""
    analyzer = ins.Analyzer(cube())
    for call in (analyzer.spectrum_2d, analyzer.cylindrical, analyzer.spherical):
        refused(lambda call=call: call(bins=10**9), "bins", "1e+06")
    refused(lambda: analyzer.rm_synthesis([0.0], lambda2_0=-1.0), "lambda2_0 = -1", "0")


def test_a_table_given_as_a_list_or_text_is_refused_in_our_words(capsys):
    from instrument.cli import main

    for wrong, *words in (
        ("observation.frequency='150 MHz'", "frequency = '150 MHz' must be a table", "centre"),
        ("image.uv_range='3,80'", "uv_range = '3,80' must be a list"),
    ):
        assert main(["plan", "mock-grid", "--set", wrong]) == 2
        said = capsys.readouterr().err
        assert all(word in said for word in words), said


# Inverses and zeros that are no answer -------------------------------------------------------------------------------


@pytest.mark.parametrize("d", [1.0, 1e-3, 1e-5, 1e-7, 1e-12])
def test_data_corrected_with_a_matrix_that_is_almost_singular_are_right_or_flagged(vis, d):
    """[[1, 1], [1, 1 + d]] put on and taken off left 3 of 3 Jy at 1e-8, unflagged: each inverse loses 1 / d."""

    def same(matrix):
        values = np.broadcast_to(np.asarray(matrix, complex), (1, 1, len(vis.layout), 2, 2))
        return ins.JonesTable(values=values, slots_s=vis.at.slots_s[:1], freq_hz=vis.freq_hz[:1])

    bad = same([[1, 1], [1, 1 + d]])
    back = vis.corrupted(bad).corrected(bad)
    flag = np.broadcast_to(back.flag, vis.data.shape[:3])
    assert flag.all() if d < 1e-6 else not flag.any()
    assert np.abs(back.data - vis.data)[~flag].max(initial=0.0) < 1e-4 * np.abs(vis.data).max()
    scales = same(np.diag([1e6, 1e-6]))  # nothing cancels here
    assert not np.any(vis.corrupted(scales).corrected(scales).flag)


def test_a_window_over_a_stokes_i_of_zeros_is_refused():
    data = np.random.default_rng(1).normal(size=(len(FREQ), 4, 16, 16))
    data[:, 0] = 0
    refused(
        lambda: ins.Analyzer(cube(data, constants="data")).eor_window(ins.Signal21cm.table()), "Stokes I", "no data"
    )
