"""Power spectra of images: the definition, fields of known spectrum, closed forms of k, what is refused, the figure."""

import numpy as np
import pytest
from astropy import units as u
from astropy.coordinates import SkyCoord
from astropy.cosmology import FlatLambdaCDM, LambdaCDM, Planck15, Planck18
from astropy.table import QTable

import instrument
from instrument import Analyzer, Imager, InputError, Observation, PointSky, Scene, StokesCube
from instrument.analyze.power.fourier import bin_edges, bin_means, cell_variance, taper_of
from instrument.analyze.power.spectra import ratio
from instrument.errors import InstrumentWarning, UnitError
from instrument.observe.directions import LIGHT
from instrument.report.spectra import spectra_2d

PIXEL = 2 * u.arcmin
RAD = PIXEL.to_value(u.rad)
SIZES = [(128, 128), (127, 127), (128, 127), (61, 150)]  # y, x: even, odd, mixed, far from square
EVERY = [0, 1e9] / u.Mpc  # one bin with every cell but k = 0
DISTANCE = Planck15.comoving_transverse_distance(1420.405751768 / 150 - 1).value


def analyzer(image=None, unit="K", pixel=PIXEL, frequencies=(150,), **planes):
    """Of a cube with one image as Stokes I, or with planes by name; what is not given is zero."""
    planes = {"I": image, **planes} if image is not None else planes
    shape = np.shape(next(iter(planes.values())))
    data = np.zeros((len(frequencies), 4, *shape))
    for name, plane in planes.items():
        data[-1, "IQUV".index(name)] = plane
    return Analyzer(StokesCube(data, frequencies * u.MHz, pixel, unit))


def cells(ny, nx):
    """Lengths of baselines of all cells of the Fourier plane, in wavelengths (Ny, Nx)."""
    return np.hypot(np.fft.fftfreq(ny, RAD)[:, None], np.fft.fftfreq(nx, RAD))


def true_power(uv, slope):
    """Spectrum of the fields below, K² Mpc²: 1 at 100 wavelengths."""
    return np.where(uv > 0, (np.maximum(uv, 1e-9) / 100) ** -slope, 0.0)


def gaussian_field(ny, nx, slope, rng):
    """A periodic real Gaussian field of that spectrum, in K: white noise, each cell times the root of its power."""
    root = np.sqrt(true_power(cells(ny, nx), slope) / (DISTANCE * RAD) ** 2)
    return np.fft.ifft2(np.fft.fft2(rng.normal(size=(ny, nx))) * root).real


def truth_in_bins(spectrum, ny, nx, slope, power=1):
    """The true spectrum (to a power) averaged over the cells of each bin: at the mean k it is another, by up to 7 %."""
    k = (cells(ny, nx) * 2 * np.pi / spectrum.distance_mpc).ravel()
    values = true_power(cells(ny, nx), slope).ravel() ** power
    pairs = zip(spectrum.edges[:-1], spectrum.edges[1:], strict=True)
    return np.array([values[inside].mean() if (inside := (k >= a) & (k < b)).any() else np.nan for a, b in pairs])


# The definition ---------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("stokes", ["V", "P"])
@pytest.mark.parametrize("shape", [(5, 5), (4, 6), (6, 3), (1, 8), (7, 1)])
def test_power_is_the_plain_sum_over_pixels(shape, stokes):
    """P(k) = area / N² |sum_x f(x) exp(-2 pi i (u l + v m))|² of the cells of each bin, one by one."""
    rng = np.random.default_rng(3)
    q, w, v = rng.normal(size=(3, *shape))
    image = v if stokes == "V" else q + 1j * w
    m, l = (np.arange(n) - n // 2 for n in shape)
    sums, lengths = [], []
    for row in range(-((shape[0] - 1) // 2), shape[0] // 2 + 1):
        for column in range(-((shape[1] - 1) // 2), shape[1] // 2 + 1):
            wave = np.exp(-2j * np.pi * (row * m[:, None] / shape[0] + column * l / shape[1]))
            sums.append(abs((image * wave).sum()) ** 2 / image.size**2)
            lengths.append(np.hypot(row / shape[0], column / shape[1]) / RAD)
    sums, lengths = np.array(sums)[np.argsort(lengths)], np.sort(lengths)
    groups = np.cumsum(np.diff(lengths, prepend=-1) > 1e-6 * lengths[-1])[1:]  # of equal length, without k = 0
    middles = (lengths[1:-1] + lengths[2:])[np.diff(groups) > 0] / 2
    edges = np.concatenate([[0], middles, [2 * lengths[-1]]]) * 2 * np.pi / DISTANCE
    got = analyzer(Q=q, U=w, V=v).spectrum_2d(stokes, bins=edges / u.Mpc)
    count = np.bincount(groups)[groups[0] :]
    want = np.bincount(groups, sums[1:])[groups[0] :] / count * image.size * (DISTANCE * RAD) ** 2
    np.testing.assert_array_equal(got.count, count)
    np.testing.assert_allclose(got.power, want, rtol=1e-11)


@pytest.mark.parametrize("stokes", ["I", "P"])
@pytest.mark.parametrize("taper", [None, "hann", "blackman-harris"])
@pytest.mark.parametrize("shape", SIZES)
def test_parseval_to_1e_12(shape, taper, stokes):
    """The sum of P / area over all cells is the variance, of the image behind its taper."""
    rng = np.random.default_rng(1)
    q, w = rng.normal(size=(2, *shape))
    image = q if stokes == "I" else q + 1j * w
    window = np.multiply.outer(taper_of(shape[0], taper), taper_of(shape[1], taper))
    flat = image - image.mean()
    variance, times = cell_variance(flat, window)
    wanted = (abs(window * flat) ** 2).mean() / (window**2).mean()
    assert (variance * times).sum() == pytest.approx(wanted, rel=1e-12)
    spectrum = analyzer(I=q, Q=q, U=w).spectrum_2d(stokes, taper=taper, bins=EVERY)
    area = image.size * (spectrum.distance_mpc * RAD) ** 2
    at_zero = variance[0, 0] if taper else 0
    assert spectrum.power[0] * spectrum.count[0] / area + at_zero == pytest.approx(wanted, rel=1e-12)


@pytest.mark.parametrize("shape", [(8, 9, 10), (7, 6, 5)])
def test_parseval_holds_for_cubes_as_well(shape):
    field = np.random.default_rng(0).normal(size=shape)
    variance, times = cell_variance(field, np.ones(shape))
    assert (variance * times).sum() == pytest.approx((field**2).mean(), rel=1e-12)


@pytest.mark.parametrize("shape", SIZES)
def test_every_cell_but_zero_is_counted_once(shape):
    for log in (True, False):
        spectrum = analyzer(np.ones(shape)).spectrum_2d(log=log)
        assert spectrum.count.sum() == np.prod(shape) - 1


# Fields of known spectrum -----------------------------------------------------------------------------------------


@pytest.mark.parametrize("slope", [0, 2, 3.5])
@pytest.mark.parametrize("shape", SIZES)
def test_periodic_fields_are_recovered_within_the_sampling_error(shape, slope):
    """Mean of 40 fields within 4.5 sigma / sqrt(40) in 12 bins of 12 cases; their scatter is sigma within its error."""
    rng = np.random.default_rng(196)
    number = 40
    made = [analyzer(gaussian_field(*shape, slope, rng)).spectrum_2d(bins=12) for _ in range(number)]
    truth = truth_in_bins(made[0], *shape, slope)
    use = made[0].count > 0
    assert use.sum() >= 9
    found = np.array([s.power for s in made])[:, use] / truth[use]
    # within a bin power falls by slope: cells of more power weigh more, and the modes that count are fewer
    square = truth_in_bins(made[0], *shape, slope, power=2)[use]
    sigma = np.sqrt(square / truth[use] ** 2 / (made[0].count[use] / 2))
    assert np.all(abs(found.mean(axis=0) - 1) < 4.5 * sigma / np.sqrt(number))
    chi2 = ((found - 1) ** 2 / sigma**2).sum()
    assert abs(chi2 / found.size - 1) < 5 * np.sqrt(2 / found.size) + 0.1  # few modes: longer tails than a Gaussian
    if slope == 0:
        given = np.array([s.sigma / s.power for s in made])[0, use]
        np.testing.assert_allclose(given, sigma, rtol=1e-12)


@pytest.mark.long
def test_sigma_is_the_scatter_of_white_noise_for_real_complex_and_tapered_images():
    """400 images: the scatter has an error of 3.5 % in each bin, so 14 %."""
    rng = np.random.default_rng(2)
    for stokes in ("I", "P"):
        for taper in (None, "hann", "blackman-harris"):
            noise = rng.normal(size=(400, 2, 64, 65))
            made = [analyzer(I=a, Q=a, U=b).spectrum_2d(stokes, taper=taper, bins=5, log=False) for a, b in noise]
            power = np.array([s.power for s in made])
            sigma = np.array([s.sigma for s in made]).mean(axis=0)
            # in the first and last bin many neighbours, which a taper makes alike, are outside: sigma is an upper bound
            np.testing.assert_allclose(power.std(axis=0)[1:4] / sigma[1:4], 1, atol=0.14)
            assert np.all(power.std(axis=0) < 1.14 * sigma)


@pytest.mark.parametrize("taper", ["hann", "blackman-harris"])
@pytest.mark.parametrize("shape", [(256, 256), (255, 301)])
def test_a_taper_keeps_the_level_of_white_noise_within_1_percent(shape, taper):
    """P = sigma² times the area of a pixel; 60 images leave a sampling error of 0.3 % (1.2 % in the first bin)."""
    rng = np.random.default_rng(7)
    edges = [0.01, 0.1, 0.45, 0.9] / u.Mpc
    made = [analyzer(3 * rng.normal(size=shape)).spectrum_2d(taper=taper, bins=edges) for _ in range(60)]
    level = np.mean([s.power for s in made], axis=0) / (9 * (DISTANCE * RAD) ** 2)
    assert np.all(abs(level[1:] - 1) < 0.01)
    assert abs(level[0] - 1) < 0.05


def test_a_taper_recovers_a_steep_field_that_is_not_periodic():
    """Pieces of a larger field, P ~ k^-3.5: without a taper the rims make 5 times too much; with one, 6 % at most."""
    rng = np.random.default_rng(5)
    edges = np.geomspace(0.08, 0.8, 6) / u.Mpc
    fields = [gaussian_field(512, 512, 3.5, rng)[100:228, 200:328] for _ in range(16)]
    truth = truth_in_bins(analyzer(fields[0]).spectrum_2d(bins=edges), 128, 128, 3.5)
    found = {t: np.mean([analyzer(f).spectrum_2d(taper=t, bins=edges).power for f in fields], axis=0) / truth
             for t in (None, "hann", "blackman-harris")}  # fmt: skip
    assert np.all(found[None][2:] > 2)
    assert np.all(abs(found["hann"][1:] - 1) < 0.06)
    assert np.all(abs(found["blackman-harris"][1:] - 1) < 0.06)


def test_one_pixel_is_flat():
    image = np.zeros((40, 41))
    image[7, 9] = 1e12
    spectrum = analyzer(image).spectrum_2d()
    np.testing.assert_allclose(
        spectrum.power[spectrum.count > 0], 1e24 * (DISTANCE * RAD) ** 2 / image.size, rtol=1e-12
    )


# Where k is -------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("shape", SIZES)
@pytest.mark.parametrize("wave", [(0, 5), (4, 0), (3, -7), (12, 12)])
def test_a_plane_wave_lands_in_its_bin_with_all_its_power(shape, wave):
    ny, nx = shape
    y, x = np.indices(shape)
    image = 2 * np.cos(2 * np.pi * (wave[0] * y / ny + wave[1] * x / nx) + 0.3)
    spectrum = analyzer(image).spectrum_2d(bins=40)
    length = np.hypot(wave[0] / ny, wave[1] / nx) / RAD
    (bin_of,) = np.flatnonzero(np.nan_to_num(spectrum.power) > 1e-20 * np.nanmax(spectrum.power))
    k = 2 * np.pi * length / DISTANCE
    assert spectrum.edges[bin_of] <= k < spectrum.edges[bin_of + 1]
    # the variance of 2 cos is 2
    total = spectrum.power[bin_of] * spectrum.count[bin_of] / (image.size * (DISTANCE * RAD) ** 2)
    assert total == pytest.approx(2, rel=1e-12)


def test_a_rotation_of_polarization_across_the_image_keeps_its_power_in_one_cell():
    """Q + iU = exp(2 pi i k x): one cell, not a pair; Q alone has half of it."""
    x = np.arange(64) / 64
    q, w = (np.broadcast_to(part, (64, 64)) for part in (np.cos(2 * np.pi * 9 * x), np.sin(2 * np.pi * 9 * x)))
    p = analyzer(Q=q, U=w)
    assert p.spectrum_2d("P", bins=EVERY).power[0] == pytest.approx(2 * p.spectrum_2d("Q", bins=EVERY).power[0])


def test_k_of_a_known_baseline_at_a_known_redshift():
    """Einstein-de Sitter: D = 2 c/H0 (1 - 1/sqrt(1+z)); at z = 8, 4/3 c/H0."""
    flat = FlatLambdaCDM(H0=70, Om0=1, Tcmb0=0)
    distance = 4 / 3 * LIGHT / 70e3
    nx = 100
    image = np.cos(2 * np.pi * 10 * np.arange(nx) / nx) * np.ones((nx, 1))
    baseline = 10 / (nx * RAD)  # 171.9 wavelengths
    spectrum = analyzer(image).spectrum_2d(bins=200, log=False, redshift=8, cosmology=flat)
    top = np.nanargmax(spectrum.power)
    assert spectrum.distance_mpc == pytest.approx(distance, rel=1e-8)
    width = np.diff(spectrum.edges)[0]
    assert spectrum.k_perp[top] == pytest.approx(2 * np.pi * baseline / distance, abs=width)
    np.testing.assert_allclose(spectrum.k_perp, spectrum.uv * 2 * np.pi / distance, rtol=1e-8)


def test_numbers_of_the_paper_30_to_800_wavelengths_at_150_mhz():
    """notes: 0.0203 to 0.542 / Mpc (Planck15, 9276 Mpc at z = 8.47), no little h."""
    spectrum = analyzer(np.random.default_rng(0).normal(size=(240, 240))).spectrum_2d(uv_range=(30, 800))
    assert spectrum.redshift == pytest.approx(8.4694, abs=1e-4)
    assert spectrum.distance_mpc == pytest.approx(9276, abs=1)
    assert spectrum.edges[[0, -1]] == pytest.approx([0.0203, 0.542], rel=2e-3)
    assert spectrum.uv_range == (30, 800)


def test_curved_space_takes_the_transverse_distance():
    open_space = LambdaCDM(70, 0.3, 0.5)
    spectrum = analyzer(np.eye(16)).spectrum_2d(cosmology=open_space, redshift=9)
    assert spectrum.distance_mpc == open_space.comoving_transverse_distance(9).value
    assert abs(spectrum.distance_mpc / open_space.comoving_distance(9).value - 1) > 0.05


def test_the_cut_of_baselines_leaves_cells_out_and_ends_the_bins():
    image = np.random.default_rng(0).normal(size=(128, 128))
    spectrum = analyzer(image).spectrum_2d(uv_range=(50, 400), bins=6)
    uv = cells(128, 128)
    assert spectrum.count.sum() == ((uv >= 50) & (uv <= 400)).sum()
    np.testing.assert_allclose(spectrum.edges[[0, -1]] * DISTANCE / 2 / np.pi, [50, 400], rtol=1e-12)
    assert np.nanmin(spectrum.uv) >= 50 and np.nanmax(spectrum.uv) <= 400
    wider = analyzer(image).spectrum_2d(uv_range=(50, 400), bins=EVERY)  # edges of one's own do not undo the cut
    assert wider.count.tolist() == [spectrum.count.sum()]


@pytest.mark.filterwarnings("ignore:the PSF is")
def test_the_fringe_of_one_baseline_lies_at_its_length():
    """Two stations, one moment, imaged: 99 % of the power within 1.5 cells of |u|, the taper's reach."""
    sky = PointSky.at(SkyCoord("08h13m36.0s +48d13m03s"), [1.0])
    observation = Observation(
        phase_centre=SkyCoord("08h13m36.0s +48d13m03s"), transit="2012-12-07", duration=10 * u.s, interval=10 * u.s,
        frequencies=[150] * u.MHz,
    )  # fmt: skip
    array = instrument.load("telescopes", "lofar-hba", beam=None, stations=["CS001HBA0", "CS030HBA1"])
    vis = Scene(instrument=array, sky=sky, observation=observation).plan().run()
    baseline = np.hypot(*vis.uvw_m[0, 0, :2]) * 150e6 / LIGHT
    assert 100 < baseline < 700
    cube = Imager(pixels=256, pixel=PIXEL / 2).image(vis)
    cell = 1 / (128 * RAD)
    edges = (baseline + cell * np.arange(-12.5, 13, 1)) * 2 * np.pi / DISTANCE
    spectrum = Analyzer(cube).spectrum_2d(taper="hann", bins=edges[edges > 0] / u.Mpc)
    share = np.nan_to_num(spectrum.power * spectrum.count)
    near = abs(spectrum.uv - baseline) < 2 * cell
    assert share[near].sum() > 0.99 * share.sum()
    assert (share * np.nan_to_num(spectrum.uv)).sum() / share.sum() == pytest.approx(baseline, abs=0.25 * cell)


def test_each_channel_has_its_own_image_and_redshift():
    image = np.random.default_rng(0).normal(size=(32, 32))
    both = analyzer(image, frequencies=(150, 120))  # the image is in the last channel, the first is constant: no data
    with pytest.raises(InputError, match="I of channel 0 has no data"):
        both.spectrum_2d(channel=0)
    spectrum = both.spectrum_2d(channel=1)
    assert spectrum.redshift == pytest.approx(1420.405751768 / 120 - 1, rel=1e-12)
    one = analyzer(image, frequencies=(120,)).spectrum_2d()
    np.testing.assert_array_equal(spectrum.power, one.power)


def test_a_cell_on_an_edge_belongs_to_the_upper_bin_and_on_the_last_edge_to_the_last():
    count, (mean,) = bin_means(np.array([1.0, 2.0, 3.0, 4.0]), np.array([1.0, 2.0, 3.0]), np.ones(4), np.arange(4.0))
    np.testing.assert_array_equal(count, [1, 2])
    np.testing.assert_array_equal(mean, [0, 1.5])


def test_bins_are_equal_in_the_logarithm_or_in_k():
    np.testing.assert_allclose(bin_edges(1, 8, 3, True), [1, 2, 4, 8])
    np.testing.assert_allclose(bin_edges(1, 7, 3, False), [1, 3, 5, 7])
    np.testing.assert_allclose(bin_edges(1, 8, [1, 10] / u.Gpc, True), [1e-3, 1e-2])


def test_another_cosmology_moves_k_and_power_together():
    """Dimensionless power is the same: k ~ 1/D, P ~ D²."""
    a = analyzer(np.random.default_rng(0).normal(size=(32, 32)))
    one, other = a.spectrum_2d(), a.spectrum_2d(cosmology=Planck18)
    assert one.distance_mpc != other.distance_mpc
    np.testing.assert_allclose(one.delta2, other.delta2, rtol=1e-12)


# What must not matter ---------------------------------------------------------------------------------------------


def test_moving_a_periodic_image_does_not_change_its_spectrum():
    image = np.random.default_rng(0).normal(size=(48, 49))
    one, other = analyzer(image), analyzer(np.roll(image, (11, -20), (0, 1)))
    np.testing.assert_allclose(one.spectrum_2d().power, other.spectrum_2d().power, rtol=1e-10)


@pytest.mark.parametrize("taper", [None, "hann", "blackman-harris"])
def test_a_constant_has_no_power_taper_and_holes_or_not(taper):
    image = np.full((33, 48), 200.0)
    assert np.nanmax(analyzer(image).spectrum_2d(taper=taper).power) < 1e-25
    image[4:9, 7:20] = np.nan
    with pytest.warns(InstrumentWarning, match="NaN"):
        assert np.nanmax(analyzer(image).spectrum_2d(taper=taper).power) < 1e-25


def test_an_image_of_zeros_has_power_zero_not_nan():
    spectrum = analyzer(np.zeros((32, 32))).spectrum_2d("V")
    assert np.all(spectrum.power[spectrum.count > 0] == 0) and np.all(spectrum.sigma[spectrum.count > 0] == 0)


def test_the_cube_is_left_as_it_was_and_single_precision_is_enough_to_hold_it():
    data = np.random.default_rng(0).normal(size=(2, 4, 32, 32)).astype(np.float32)
    before = data.copy()
    cube = StokesCube(data, [150, 151] * u.MHz, PIXEL, "K")
    spectrum = Analyzer(cube).spectrum_2d("P", channel=1, taper="hann")
    np.testing.assert_array_equal(data, before)
    assert spectrum.power.dtype == np.float64 and spectrum.freq_hz == 151e6


@pytest.mark.parametrize("n", [16, 17])
def test_tapers_are_one_and_symmetric_at_the_centre_pixel(n):
    """Hann and Blackman-Harris (Harris 1978): their DFT ends after 1 and 3 cells, so a constant goes no further."""
    for name, last in (("hann", 1), ("blackman-harris", 3)):
        taper = taper_of(n, name)
        assert taper[n // 2] == pytest.approx(1, abs=1e-12) and taper.min() > -1e-12
        np.testing.assert_allclose(taper[n // 2 + 1 :], taper[n // 2 - 1 : 0 if n % 2 == 0 else None : -1], atol=1e-12)
        assert abs(np.fft.rfft(taper))[last + 1 :].max() < 1e-12 * n
    with pytest.raises(InputError, match="taper = 'hanning' is not known; did you mean 'hann'"):
        taper_of(n, "hanning")


# What is missing, and what is refused ----------------------------------------------------------------------------


def test_pixels_without_data_leave_the_level_of_white_noise():
    """A round field, 22 % NaN, within 1 % (sampling error 0.3 %); the share is said."""
    rng = np.random.default_rng(0)
    y, x = np.indices((128, 128)) - 64
    outside = np.hypot(y, x) > 64
    power = []
    for _ in range(40):
        image = rng.normal(size=(128, 128))
        image[outside] = np.nan
        with pytest.warns(InstrumentWarning, match=r"0\.22 of the pixels are NaN"):
            spectrum = analyzer(image).spectrum_2d(bins=[0.15, 0.4, 0.9] / u.Mpc)
        power.append(spectrum.power)
    assert spectrum.missing == pytest.approx(outside.mean())
    np.testing.assert_allclose(np.mean(power, axis=0) / (DISTANCE * RAD) ** 2, 1, atol=0.01)
    scatter = np.std(power, axis=0) / np.mean(power, axis=0)
    np.testing.assert_allclose(scatter, spectrum.sigma / spectrum.power, rtol=0.45)  # of 40: its error is 11 %


def test_empty_bins_are_nan_with_count_zero():
    spectrum = analyzer(np.random.default_rng(0).normal(size=(32, 32))).spectrum_2d(bins=60)
    empty = spectrum.count == 0
    assert 0 < empty.sum() < 30
    for values in (spectrum.k_perp, spectrum.uv, spectrum.power, spectrum.sigma, spectrum.delta2):
        np.testing.assert_array_equal(np.isnan(values), empty)
    beyond = analyzer(np.eye(32)).spectrum_2d(uv_range=(30, 1e5))
    assert beyond.count[-1] == 0 and np.isnan(beyond.power[-1])


REFUSED = {
    "stokes = 'L' is not one of 'I', 'Q'": {"stokes": "L"},
    "stokes = 'QU' is not one of 'I', 'Q'": {"stokes": "QU"},
    "channel = 1 is not one of 0 to 0": {"channel": 1},
    "channel = -1": {"channel": -1},
    "taper = 'hamming' is not one of .* did you mean 'hann'": {"taper": "hamming"},
    r"uv_range = \(800.0, 30.0\) must be two numbers": {"uv_range": (800, 30)},
    r"uv_range = \(30,\) must be 2 values": {"uv_range": (30,)},
    "uv_range = .* holds no cell of an image of 20 x 16": {"uv_range": (1e6, 2e6)},
    "bins = 0": {"bins": 0},
    "bins = .* grow": {"bins": [0.3, 0.2] / u.Mpc},
    "bins needs a unit convertible to 1/Mpc": {"bins": [0.1, 0.2]},
    "bins needs a unit convertible to 1/Mpc, got": {"bins": [0.1, 0.2] * u.Mpc},
    "redshift = -1.0 must be a finite number above 0": {"redshift": -1},
    "redshift = nan": {"redshift": float("nan")},
    "cosmology = 'Planck15' is not one of astropy": {"cosmology": "Planck15"},
}


@pytest.mark.parametrize("message", REFUSED)
def test_what_is_wrong_is_named_with_its_value(message):
    with pytest.raises(InputError, match=message):
        analyzer(np.ones((16, 20))).spectrum_2d(**REFUSED[message])


def test_numbers_without_a_unit_are_a_unit_error():
    with pytest.raises(UnitError, match="bins"):
        analyzer(np.ones((16, 16))).spectrum_2d(bins=np.array([0.1, 0.2]))


def test_images_without_an_answer_are_refused():
    image = np.ones((16, 16))
    with pytest.raises(InputError, match="needs a cube"):
        Analyzer().spectrum_2d()
    with pytest.raises(InputError, match="U of channel 0 has no data: all NaN"):
        analyzer(U=image * np.nan).spectrum_2d("U")
    for bad in (np.inf, -np.inf):
        with pytest.raises(InputError, match="V of channel 0 has 1 infinite pixels"):
            analyzer(V=np.where(np.eye(16) * np.arange(16) == 3, bad, image)).spectrum_2d("V")
    with pytest.raises(InputError, match="holds no cell of an image of 1 x 1"):
        analyzer(np.ones((1, 1))).spectrum_2d()
    with pytest.raises(InputError, match=r"redshift = -0\.2898 for 2000 MHz is not above 0: give redshift="):
        analyzer(image, frequencies=[2000]).spectrum_2d()


# Ratios, tables, figure -------------------------------------------------------------------------------------------


def test_the_ratio_of_spectra_is_that_of_the_images_whatever_the_psf():
    rng = np.random.default_rng(0)
    image = rng.normal(size=(64, 64))
    beam = np.exp(-((cells(64, 64) / 300) ** 2))
    seen = np.fft.ifft2(np.fft.fft2(image) * beam).real
    a = analyzer(I=seen, Q=0.1 * seen)
    found = ratio(a.spectrum_2d("Q", bins=20), a.spectrum_2d("I", bins=20))
    np.testing.assert_allclose(found[np.isfinite(found)], 0.01, rtol=1e-10)
    assert np.isnan(ratio(a.spectrum_2d("I"), a.spectrum_2d("V"))).all()  # nothing over zero
    with pytest.raises(InputError, match="differ in bins or unit"):
        ratio(a.spectrum_2d(bins=3), a.spectrum_2d(bins=4))
    with pytest.raises(InputError, match="differ in bins or unit"):
        ratio(a.spectrum_2d(), analyzer(I=seen, unit="Jy/beam").spectrum_2d())


@pytest.mark.parametrize("unit", ["K", "Jy/beam"])
def test_the_table_has_units_and_comes_back_from_its_file(tmp_path, unit):
    image = np.random.default_rng(0).normal(size=(32, 40))
    spectrum = analyzer(image, unit=unit).spectrum_2d(uv_range=(30, 800), taper="hann", bins=30)
    spectrum.write(tmp_path / "power.ecsv")
    assert [path.name for path in tmp_path.iterdir()] == ["power.ecsv"]
    back = QTable.read(tmp_path / "power.ecsv")
    np.testing.assert_array_equal(back["power"].to_value(u.Unit(unit) ** 2 * u.Mpc**2), spectrum.power)
    np.testing.assert_array_equal(back["k_perp"].to_value(1 / u.Mpc), spectrum.k_perp)
    assert back["delta2"].unit == u.Unit(unit) ** 2
    assert back["count"].tolist() == spectrum.count.tolist()
    assert back.meta["uv_range"] == [30, 800] and back.meta["taper"] == "hann" and back.meta["stokes"] == "I"
    assert back.meta["redshift"] == spectrum.redshift


def test_delta2_is_the_variance_per_logarithm_of_k():
    """Summed over bins in ln k it is the variance of a field whose power is far from the corners."""
    rng = np.random.default_rng(4)
    image = gaussian_field(256, 256, 4, rng)
    spectrum = analyzer(image).spectrum_2d(bins=30)
    use = (spectrum.count > 0) & (spectrum.uv < 0.5 / RAD)
    k, width = spectrum.k_perp[use], np.diff(spectrum.edges)[use]
    cells_area = (2 * np.pi / (256 * DISTANCE * RAD)) ** 2
    measure = spectrum.count[use] * cells_area / (2 * np.pi * k * width)  # cells in a ring over its area / cell
    total = (spectrum.delta2[use] * measure * width / k).sum()
    assert total == pytest.approx(image.var(), rel=1e-3)


def test_the_figure_shows_each_curve_with_units_and_both_axes():
    rng = np.random.default_rng(0)
    a = analyzer(I=rng.normal(size=(64, 64)), Q=rng.normal(size=(64, 64)))
    curves = {"I": a.spectrum_2d(bins=40), "Q + iU": a.spectrum_2d("P"), "V": a.spectrum_2d("V")}
    ax = spectra_2d(curves)
    assert ax.get_xscale() == ax.get_yscale() == "log"
    assert "Mpc$^{-1}$" in ax.get_xlabel() and ax.get_ylabel() == "power (K$^2$ Mpc$^2$)"
    (top,) = ax.child_axes
    ax.figure.draw_without_rendering()
    assert top.get_xlabel() == "baseline (wavelengths) at z = 8.47"
    assert top.get_xlim() == pytest.approx(np.array(ax.get_xlim()) * DISTANCE / 2 / np.pi)
    labels = [text.get_text() for text in ax.get_legend().get_texts()]
    assert labels == ["I", "Q + iU", "V: no power"]
    drawn = ax.containers[0].lines[0].get_ydata()
    np.testing.assert_array_equal(drawn, curves["I"].power)  # gaps stay gaps
    low, high = ax.get_ylim()
    assert low < np.nanmin(drawn) and np.nanmax(drawn + curves["I"].sigma) < high
    assert spectra_2d({"V": curves["V"]}).get_legend() is not None
    assert spectra_2d(curves, ax).figure is ax.figure


def test_the_figure_refuses_what_has_no_common_axes():
    one = analyzer(np.eye(16)).spectrum_2d()
    with pytest.raises(InputError, match="no spectrum"):
        spectra_2d({})
    for other in (analyzer(np.eye(16), unit="Jy/beam").spectrum_2d(), analyzer(np.eye(16)).spectrum_2d(redshift=9)):
        with pytest.raises(InputError, match="different units or redshifts"):
            spectra_2d({"a": one, "b": other})
