"""Cubes that trip power spectra up: one channel, holes, gaps, order, 1e12, zeros, empty bins; right, or one line."""

import tracemalloc

import numpy as np
import pytest
from astropy import units as u

from instrument import Analyzer, InputError, StokesCube
from instrument.errors import InstrumentWarning, UnitError

PIXEL = 2 * u.arcmin


def cube(field, freq_hz=None, unit="K", stokes=0):
    data = np.zeros((len(field), 4, *field.shape[1:]), field.dtype)
    data[:, stokes] = field
    freq_hz = 150e6 + 0.4e6 * np.arange(len(field)) if freq_hz is None else freq_hz
    return StokesCube(data, freq_hz * u.Hz, PIXEL, unit)


def noise(shape=(16, 20, 21), seed=0):
    return np.random.default_rng(seed).normal(size=shape)


def voxel(made):
    """Volume of a voxel in Mpc³."""
    return (made.frame.distance_mpc * PIXEL.to_value(u.rad)) ** 2 * made.frame.depth_mpc_per_hz * 0.4e6


def refused(analyzer, text, **settings):
    for spectrum in (analyzer.cylindrical, analyzer.spherical):
        with pytest.raises(InputError, match=text) as error:
            spectrum(**settings)
        assert "\n" not in str(error.value)


def test_one_channel_has_no_k_par_but_a_spectrum_in_two_dimensions():
    one = Analyzer(cube(noise((1, 20, 21))))
    refused(one, "one channel has no k_par: use spectrum_2d")
    assert np.nansum(one.spectrum_2d().power) > 0


def test_two_channels_have_two_delays():
    found = Analyzer(cube(noise((2, 20, 21)))).cylindrical(taper=None, log=False)
    assert found.k_par.shape == (2,) and found.count.sum() == 2 * 20 * 21
    np.testing.assert_allclose(found.par_edges, found.k_par[1] * np.array([-0.5, 0.5, 1.5]), rtol=1e-12)


def test_without_a_cube_it_says_what_it_needs():
    with pytest.raises(InputError, match=r"power spectra need a cube: Analyzer\(cube\)"):
        Analyzer().cylindrical()


def test_a_channel_without_data_is_refused_by_name_or_filled_in():
    field = noise()
    field[5] = np.nan
    holed = Analyzer(cube(field))
    refused(holed, r"1 channels are all NaN \(5\): fill them in with infill=300 \* u.ns")
    found = holed.cylindrical(infill=300 * u.ns)
    assert np.isfinite(found.power[found.count > 0]).all() and found.frame.infilled == 1


@pytest.mark.parametrize("missing", [[7], [3, 4, 21], [30, 31, 32, 33]])
def test_smooth_foregrounds_are_filled_in_to_1e_6(missing):
    """A power law and a delay of 100 ns over 60 channels: filled in to 1e-6 of the amplitude."""
    freq = 150e6 + 0.2e6 * np.arange(60)
    wave = np.cos(2 * np.pi * 3 * np.arange(16) / 16) * np.ones((16, 1))
    spectrum = (freq / 150e6) ** -2.55 * (1 + 0.5 * np.cos(2 * np.pi * 100e-9 * freq))
    whole = cube(spectrum[:, None, None] * wave, freq)
    field = whole.data[:, 0].copy()
    field[missing] = np.nan
    for holed in (cube(field, freq), cube(np.delete(field, missing, axis=0), np.delete(freq, missing))):
        a = Analyzer(whole).cells(taper="blackman-harris")
        b = Analyzer(holed).cells(taper="blackman-harris", infill=300 * u.ns)
        assert b.frame.infilled == len(missing)
        # power at every delay within 2e-6 x of the largest amplitude: cross terms of the error with what is there
        top = a.power.max()
        assert np.abs(np.sqrt(a.power) - np.sqrt(b.power)).max() < 1e-6 * np.sqrt(top)


def test_an_infill_that_is_no_delay_is_refused():
    field = noise()
    field[5] = np.nan
    with pytest.raises(UnitError, match="infill needs a unit convertible to s"):
        Analyzer(cube(field)).cylindrical(infill=300)
    with pytest.raises(InputError, match=r"infill = 0 s must be above 0"):
        Analyzer(cube(field)).cylindrical(infill=0 * u.ns)


def test_a_gap_in_frequency_is_refused_by_name():
    freq = np.delete(150e6 + 0.4e6 * np.arange(16), [6, 7])
    refused(Analyzer(cube(noise((14, 20, 21)), freq)), "2 channels are missing, the first between 152 and 153.2 MHz")


def test_uneven_and_duplicated_channels_are_refused():
    even = 150e6 + 0.4e6 * np.arange(16)
    refused(Analyzer(cube(noise(), even * (1 + 1e-3 * np.arange(16)))), "channels are not evenly spaced")
    twice = even.copy()
    twice[4] = twice[3]
    refused(Analyzer(cube(noise(), twice)), "two channels at 151.2 MHz")


def test_rounding_of_frequencies_is_no_unevenness():
    """Headers hold float32 or 1 kHz at times: 1e-3 of a channel is forgiven."""
    rng = np.random.default_rng(0)
    freq = 150e6 + 0.4e6 * np.arange(16)
    exact = Analyzer(cube(noise(), freq)).cylindrical()
    rounded = Analyzer(cube(noise(), freq + rng.uniform(-400, 400, 16))).cylindrical()
    np.testing.assert_allclose(rounded.power, exact.power, rtol=5e-3)


@pytest.mark.parametrize("order", ["descending", "shuffled"])
def test_the_order_of_channels_does_not_matter(order):
    field, freq = noise(), 150e6 + 0.4e6 * np.arange(16)
    turn = np.arange(16)[::-1] if order == "descending" else np.random.default_rng(1).permutation(16)
    one, two = Analyzer(cube(field, freq)).cylindrical(), Analyzer(cube(field[turn], freq[turn])).cylindrical()
    np.testing.assert_array_equal(one.power, two.power)


def test_lines_of_sight_with_nan_count_as_zero_and_white_noise_keeps_its_level():
    field = noise((32, 48, 48))
    field[3, :12] = np.nan  # in one channel only: the line of sight is out
    field[:, 20, 20] = np.nan
    with pytest.warns(InstrumentWarning, match="0.25 of the lines of sight hold NaN"):
        found = Analyzer(cube(field)).spherical(taper=None, bins=[0.3, 9] / u.Mpc)
    assert found.power[0] / voxel(found) == pytest.approx(1, abs=0.03)
    assert found.frame.missing == pytest.approx(0.25, abs=1e-3)


def test_a_rim_of_nan_leaves_the_power_as_it_is():
    """Twice the field with nothing in it: zeros would halve the power along every axis."""
    field = noise((8, 24, 24))
    wide = np.full((8, 48, 48), np.nan)
    wide[:, 12:36, 12:36] = field
    edges = [0.2, 0.4, 0.6] / u.Mpc
    plain = Analyzer(cube(field)).spherical(taper=None, bins=edges)
    with pytest.warns(InstrumentWarning):
        padded = Analyzer(cube(wide)).spherical(taper=None, bins=edges)
    np.testing.assert_allclose(padded.power / plain.power, 1, atol=0.08)


def test_no_data_at_all_and_infinities_are_one_line():
    refused(Analyzer(cube(np.full((8, 9, 9), np.nan))), "I has no data: all NaN")
    field = noise()
    field[2, 3, 4] = np.inf
    refused(Analyzer(cube(field)), "I of channel 2 has 1 infinite pixels: make them NaN")
    scattered = noise((4, 2, 2))
    for k in range(4):
        scattered[k, k // 2, k % 2] = np.nan
    refused(Analyzer(cube(scattered)), "I has no data: every pixel is NaN in some channel")


def test_zero_is_zero_and_a_constant_has_no_power():
    for value in (0.0, 7.0):
        for taper in (None, "blackman-harris"):
            found = Analyzer(cube(np.full((16, 20, 21), value))).cylindrical(taper=taper, taper_space=taper)
            assert np.all(found.power[found.count > 0] < 1e-25)
            assert value or np.all(found.power[found.count > 0] == 0)


def test_one_voxel_of_1e12_is_flat_to_1e_12():
    field = np.zeros((16, 20, 21))
    field[7, 3, 9] = 1e12
    found = Analyzer(cube(field)).spherical(taper=None)
    want = 1e24 * voxel(found) / field.size
    np.testing.assert_allclose(found.power[found.count > 0], want, rtol=1e-12)


def test_a_signal_of_1_mk_is_seen_behind_a_smooth_source_of_1e5_k():
    """1e15 in power: four terms of a taper leave 100 times the signal, seven nothing; float32 data their rounding."""
    freq = np.linspace(134e6, 166e6, 161)
    signal = 1e-3 * noise((161, 24, 24))
    source = np.zeros((161, 24, 24))
    source[:, 11, 5] = 1e5 * (freq / 150e6) ** -2.55
    settings = {"bins": 2, "bins_par": [0.35, 0.6, 0.9] / u.Mpc}

    def excess(dtype, taper):
        both, alone = (
            Analyzer(cube(x.astype(dtype), freq)).cylindrical(taper=taper, **settings)
            for x in (source + signal, signal)
        )
        return both.power / alone.power - 1

    assert np.all(excess(np.float64, "blackman-harris") > 10)
    assert np.all(abs(excess(np.float64, "blackman-harris-7")) < 1e-3)
    rounding = 1e5 * 2**-24 / np.sqrt(3) / 24  # K, of one pixel, over the image
    assert np.all(abs(excess(np.float32, "blackman-harris-7")) < 10 * (rounding / 1e-3) ** 2 + 0.03)


def test_a_faint_bin_is_not_buried_behind_a_bright_one():
    """Power over 24 orders of magnitude in one spectrum: k_par of a tone of 1, and of one of 1e-12."""
    n = 64
    x = np.cos(2 * np.pi * 2 * np.arange(16) / 16) * np.ones((16, 1))
    k = np.arange(n)[:, None, None]
    field = (np.cos(2 * np.pi * 3 * k / n) + 1e-7 * np.cos(2 * np.pi * 20 * k / n)) * x
    found = Analyzer(cube(field)).cylindrical(taper=None, bins=2)
    row = np.nanmax(found.power, axis=0)
    assert row[19] / row[2] == pytest.approx(1e-14, rel=1e-6)


def test_empty_bins_are_nan_with_a_count_of_zero():
    found = Analyzer(cube(noise((161, 12, 12)))).cylindrical(bins=12, bins_par=30)
    empty = found.count == 0
    assert (~(found.count > 0).any(axis=0)).sum() == 7  # of 30 log bins of 80 delays
    for values in (found.power, found.sigma, found.delta2):
        assert np.isnan(values[empty]).all() and np.isfinite(values[~empty]).all()
    ball = Analyzer(cube(noise((4, 6, 6)))).spherical(bins=20)
    assert (ball.count == 0).any() and np.array_equal(np.isnan(ball.power), ball.count == 0)


def test_an_edge_on_a_cell_puts_it_in_the_upper_bin_and_the_last_edge_is_closed():
    made = Analyzer(cube(noise())).cells(taper=None)
    edges = made.k_par[[2, 4, 8]]
    found = made.cylindrical(bins=[0, 99] / u.Mpc, bins_par=edges / u.Mpc)
    plane = 20 * 21
    assert found.count.tolist() == [[2 * 2 * plane, 4 * 2 * plane + plane]]  # 2, 3; 4 to 7 and Nyquist, once
    assert found.count.sum() + sum(found.left_out.values()) == 16 * plane


@pytest.mark.parametrize("wave", [(0.11, 0.13, -0.21), (0.23, -0.31, 0.07), (0.05, 0.29, 0.33)])
def test_odd_and_even_sizes_have_the_same_power_of_one_field_at_the_same_k(wave):
    """One wave (in cycles a voxel) on grids of four sizes: its variance, 1/2, to 1 %, at its k to 0.1 of a cell."""
    found = []
    for shape in ((40, 48, 50), (41, 49, 51), (40, 49, 50), (41, 48, 51)):
        z, y, x = np.meshgrid(*(np.arange(n) - n // 2 for n in shape), indexing="ij")
        field = np.cos(2 * np.pi * (wave[0] * z + wave[1] * y + wave[2] * x) + 0.7)
        made = Analyzer(cube(field)).cells(taper="hann", taper_space="hann")
        power = made.power * made.times * made.folds[:, None]
        per_mpc = 2 * np.pi / made.frame.distance_mpc / PIXEL.to_value(u.rad)
        perp, par = np.hypot(wave[1], wave[2]) * per_mpc, wave[0] * made.k_par[1] * shape[0]
        cell = per_mpc / 48
        assert (power * made.k_perp).sum() / power.sum() == pytest.approx(perp, abs=0.1 * cell)
        assert (power * made.k_par[:, None]).sum() / power.sum() == pytest.approx(par, abs=0.1 * made.k_par[1])
        found.append(power.sum() / (voxel(made) * field.size))
    np.testing.assert_allclose(found, 0.5, rtol=0.01)


def test_images_far_from_square_have_cells_of_their_own_on_each_axis():
    """A wave of 10 cells along 100 pixels and one of 2 along 20 have one k."""
    waves = [
        np.cos(2 * np.pi * 10 * np.arange(100) / 100) * np.ones((20, 1)),
        (np.cos(2 * np.pi * 2 * np.arange(20) / 20) * np.ones((100, 1))).T,
    ]
    tops = []
    for wave in waves:
        found = Analyzer(cube(np.ones((4, 1, 1)) * wave)).cylindrical(taper=None, bins=60, log=False)
        tops.append(found.k_perp[np.nanargmax(np.nansum(found.power, axis=1))])
    assert tops[0] == pytest.approx(tops[1], rel=1e-12)


def test_nothing_given_is_changed():
    given = cube(noise())
    before = given.data.copy()
    for taper in (None, "hann"):
        Analyzer(given).spherical(taper=taper, taper_space=taper)
    np.testing.assert_array_equal(given.data, before)


def test_a_cut_that_holds_no_cell_and_other_wrong_settings_are_one_line():
    analyzer = Analyzer(cube(noise()))
    refused(analyzer, "holds no cell", uv_range=(1, 2))
    refused(analyzer, "must be two numbers of wavelengths", uv_range=(800, 30))
    refused(analyzer, "taper = 'hamming' is not one of", taper="hamming")
    refused(analyzer, "stokes = 'X' is not one of", stokes="X")
    refused(analyzer, "redshift = -1.0 must be", redshift=-1)
    refused(analyzer, "bins = 0", bins=0)
    refused(analyzer, "cross needs a cube of the same shape", cross=cube(noise((16, 20, 20))))
    with pytest.raises(InputError, match=r"wedge = 100.0 deg"):
        analyzer.spherical(wedge=100 * u.deg)


def test_spectra_of_other_bins_are_not_subtracted():
    analyzer = Analyzer(cube(noise()))
    with pytest.raises(InputError, match="spectra differ in bins or unit"):
        analyzer.spherical(bins=4).less(analyzer.spherical(bins=5))


def test_memory_is_that_of_the_cells_kept_and_not_of_the_cube():
    """20 MB of images, of which 3 % of the cells are asked for: 8 channels in work, and the cells."""
    field = np.zeros((64, 200, 200))
    given = cube(field.astype(np.float32))
    Analyzer(given).spherical(uv_range=(10, 100))
    tracemalloc.start()
    Analyzer(given).spherical(uv_range=(10, 100))
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 8 * 200 * 200 * 8 * 4, peak  # an image block in float64, its transform, and a copy
    assert peak < given.data[:, 0].nbytes * 1.1
