"""Generated cubes: Faraday screens, what leaks of them, noise; each against its recipe within the sampling error."""

import numpy as np
import pytest
from astropy import units as u
from astropy.coordinates import SkyCoord

import instrument
from instrument import InputError, Psf, StokesCube, leaked, leaked_through, noise_cube, polarized_screens
from instrument.errors import InstrumentWarning
from instrument.sky.screens import FINE, TEN, Screens

LIGHT = 299792458.0
BAND = np.linspace(134, 166, 41) * u.MHz
SMALL = {"pixels": 120, "pixel": 2 * u.arcmin, "frequencies": BAND}  # the 4 deg of the recipe


def polarization(cube):
    return cube.data[:, 1].astype(float) + 1j * cube.data[:, 2]


def faraday(cube, depth):
    """|F(phi)| by the direct sum (Ny, Nx)."""
    l2 = (LIGHT / cube.freq_hz) ** 2
    kernel = np.exp(-2j * depth * (l2 - l2.mean())) / len(l2)
    return np.abs(np.tensordot(kernel, polarization(cube), 1))


def slope(cube, channel, low=40, high=300):
    """Slope of the angular power of Q + iU between two baselines, the beam divided out."""
    n = cube.data.shape[2]
    uv = np.hypot(*np.meshgrid(*[np.fft.fftfreq(n, cube.pixel_rad)] * 2))
    power = np.abs(np.fft.fft2(polarization(cube)[channel])) ** 2
    fwhm = cube.psf.major_rad[channel]
    power *= np.exp((np.pi * fwhm * uv) ** 2 / (2 * np.log(2)))
    edges = np.geomspace(low, high, 9)
    index = np.digitize(uv, edges)
    rings = [(uv[index == k].mean(), power[index == k].mean()) for k in range(1, 9)]
    return np.polyfit(*np.log(np.array(rings)).T, 1)[0]


@pytest.fixture(scope="module")
def screens():
    return polarized_screens(**SMALL)


# Screens ---------------------------------------------------------------------------------------------------------


def test_the_peak_is_5_k_at_1_2_and_the_emission_lies_where_it_is_observed(screens):
    depths = np.arange(-10, 10.01, 0.1)
    peaks = np.array([faraday(screens, d).max() for d in depths])
    # between steps of the search of 0.1 rad/m² another pixel may be higher by 0.2 %
    assert peaks.max() == pytest.approx(5, rel=2e-3)
    assert faraday(screens, 1.2).max() == pytest.approx(5, rel=1e-4)
    assert depths[peaks > 1.5].min() > -2.5
    assert depths[peaks > 1.5].max() < 6
    assert peaks[[0, -1]].max() < 0.6


def test_there_is_no_i_or_v_and_the_polarization_of_a_channel_is_about_2_k(screens):
    assert screens.data.dtype == np.float32
    assert not screens.data[:, [0, 3]].any()
    rms = np.sqrt((np.abs(polarization(screens)) ** 2).mean(axis=(1, 2)))
    assert 1.5 < rms[len(rms) // 2] < 2.5
    assert screens.unit == "K"
    assert np.rad2deg(screens.psf.major_rad) * 60 == pytest.approx([4.3] * 41)


def test_the_spectrum_has_the_slope_of_its_screens_and_ripples_make_it_flatter():
    """Eight rings of 24 to 2000 cells and four seeds: +-0.1; -1.65 +- 0.15 is observed, at 150 MHz."""
    one = {**SMALL, "pixels": 240, "pixel": 1 * u.arcmin, "frequencies": [134, 150, 166] * u.MHz}
    smooth = TEN.model_copy(update={"ripple": 0.0})
    plain = [slope(polarized_screens(**one, seed=s, screens=smooth), 1) for s in range(4)]
    rippled = np.array([[slope(polarized_screens(**one, seed=s), k) for k in range(3)] for s in range(4)])
    assert np.mean(plain) == pytest.approx(-2.2, abs=0.1)
    assert rippled.mean(axis=0) == pytest.approx([-1.4, -1.7, -1.8], abs=0.2)


def test_a_screen_alone_has_one_depth_one_spectrum_and_no_cell_outside_its_baselines():
    only = Screens(depths=(3.0,), brightest=3.0, ripple=0.0, spectral_index=-2.0, uv_range=(50, 400), peak_k=2.0)
    cube = polarized_screens(**SMALL, screens=only)
    p = polarization(cube)
    l2 = (LIGHT / cube.freq_hz) ** 2
    freq = cube.freq_hz / 150e6
    expected = p[:1] * (freq / freq[0])[:, None, None] ** -2 * np.exp(6j * (l2 - l2[0]))[:, None, None]
    assert np.abs(p - expected).max() < 3e-6 * np.abs(p).max()
    uv = np.hypot(*np.meshgrid(*[np.fft.fftfreq(120, cube.pixel_rad)] * 2))
    cells = np.abs(np.fft.fft2(p[0]))
    assert cells[(uv < 50) | (uv > 400)].max() < 1e-5 * cells.max()
    assert cells[(uv >= 50) & (uv <= 400)].min() > 0
    assert faraday(cube, 3.0).max() == pytest.approx(2, rel=1e-5)


def test_a_chromatic_beam_is_as_wide_as_the_wavelength():
    """Of one screen the ratio of two channels in the uv plane is that of their beams."""
    only = Screens(depths=(0.0,), ripple=0.0, spectral_index=0.0, fwhm="20 arcmin", chromatic=True)
    cube = polarized_screens(**{**SMALL, "frequencies": [100, 150] * u.MHz}, screens=only)
    assert np.rad2deg(cube.psf.major_rad) * 60 == pytest.approx([30, 20])
    cells = np.abs(np.fft.fft2(polarization(cube)))
    uv = np.hypot(*np.meshgrid(*[np.fft.fftfreq(120, cube.pixel_rad)] * 2))
    use = (uv > 30) & (uv < 150)
    fwhm = np.deg2rad(np.array([30, 20]) / 60)
    expected = np.exp(-(np.pi**2) * (fwhm[0] ** 2 - fwhm[1] ** 2) * uv[use] ** 2 / (4 * np.log(2)))
    assert (cells[0] / cells[1])[use] == pytest.approx(expected, rel=1e-3)


def test_a_seed_gives_the_same_cube_and_another_one_another():
    small = {"pixels": 64, "frequencies": [150, 151] * u.MHz}
    first = polarized_screens(**small, seed=1).data
    assert np.array_equal(first, polarized_screens(**small, seed=1).data)
    assert not np.array_equal(first, polarized_screens(**small, seed=2).data)


@pytest.mark.parametrize("pixels", [64, 65])
def test_small_images_and_single_channels_work(pixels):
    cube = polarized_screens(pixels, frequencies=[150] * u.MHz, centre=SkyCoord("08h13m36s +48d13m03s"))
    assert np.abs(polarization(cube)).max() == pytest.approx(5, rel=1e-5)
    assert np.rad2deg(cube.centre.dec_rad) == pytest.approx(48.2175, abs=1e-4)


@pytest.mark.parametrize(
    ("given", "said"),
    [
        ({"pixels": 2}, "pixels = 2"),
        ({"pixel": 0 * u.arcmin}, "pixel = 0.0 arcmin"),
        ({"frequencies": [0] * u.MHz}, "all must be above 0"),
        ({"frequencies": 150}, "frequencies needs a unit"),
        ({"pixels": 16, "screens": Screens(uv_range=(30, 300))}, "have no cell within uv_range"),
        ({"screens": Screens(uv_range=(300, 30))}, "a uv_range that grows"),
        ({"screens": Screens(depths=())}, "screens need depths"),
    ],
)
def test_impossible_screens_are_refused(given, said):
    with pytest.raises(InputError, match=said) as error:
        polarized_screens(**{"pixels": 64, "frequencies": [150] * u.MHz, **given})
    assert "\n" not in str(error.value)
    with pytest.raises(InputError, match="width"):
        Screens(width=0.0)


# Leakage ---------------------------------------------------------------------------------------------------------


def flat(q, unpolarized=0.0, mhz=(150.0, 75.0), pixels=(8, 8)):
    data = np.zeros((len(mhz), 4, *pixels))
    data[:, 0] = unpolarized
    data[:, 1], data[:, 2] = q
    return StokesCube(data, mhz * u.MHz, 1 * u.deg, "K")


def test_leakage_is_a_quadrupole_that_grows_with_distance_and_frequency_squared():
    """At 2 deg north Q leaks by +0.3 %, east by -0.3 %; U by + in the north-east; a quarter at half the frequency."""
    of = {"fraction": 0.003, "radius": 2 * u.deg}
    q, both = leaked(flat((1, 0)), **of).data, leaked(flat((0, 1), 7.0), **of).data
    north, east, north_east = (6, 4), (4, 2), (6, 2)  # x runs to the west
    assert [q[0, 0][at] for at in (north, east, north_east)] == pytest.approx([0.003, -0.003, 0])
    assert [both[0, 0][at] - 7 for at in (north, east, north_east)] == pytest.approx([0, 0, 0.006], abs=1e-9)
    assert q[0, 0, 4, 4] == 0
    assert q[1, 0][north] == pytest.approx(0.003 / 4)
    assert np.array_equal(q[:, 1:], flat((1, 0)).data[:, 1:])


def test_leakage_of_files_without_i_is_leakage_and_a_channel_without_data_stays_empty():
    cube = flat((1, 0))
    cube.data[:, [0, 3]] = np.nan
    cube.data[1] = np.nan
    found = leaked(cube, radius=2 * u.deg).data
    assert found[0, 0, 6, 4] == pytest.approx(0.003)
    assert np.isnan(found[1]).all()
    assert np.isnan(cube.data[0, 0]).all()  # the input is as it was


@pytest.mark.long
def test_the_fine_screens_leak_7_mk_with_the_eigenvalues_they_are_known_by():
    """The simulation that foreground removers are tried on: 27 screens, 161 channels, 480 pixels, seed 196."""
    found = leaked(polarized_screens(screens=FINE)).data[:, 0].reshape(161, -1)
    assert 1e3 * found.std() == pytest.approx(7.1, abs=0.05)
    values = np.linalg.eigvalsh(np.cov(found, bias=True) + np.outer(*[found.mean(axis=1)] * 2))[::-1]
    expected = [1, 0.69, 0.21, 0.047, 0.0044, 0.0021, 1.1e-3, 2.7e-4]
    assert values[:8] / values[0] == pytest.approx(expected, rel=0.05)  # two digits


@pytest.mark.parametrize("given", [{"fraction": np.nan}, {"radius": 0 * u.deg}, {"frequency": -1 * u.Hz}])
def test_impossible_leakage_is_refused(given):
    with pytest.raises(
        InputError, match=r"must be a finite number|must be above 0|the first must be finite, the others above 0"
    ):
        leaked(flat((1, 0)), **given)


def test_leakage_through_a_beam_is_that_of_its_mueller_matrix_at_every_pixel():
    centre = SkyCoord("08h13m36.0s +48d13m03s")
    lofar = instrument.load("telescopes", "lofar-hba", stations=["CS001HBA0", "CS001HBA1"])
    times = ["2012-12-07T00:00:00", "2012-12-07T03:00:00"]
    given = {"pixels": 16, "pixel": 15 * u.arcmin, "frequencies": [160, 134, 150] * u.MHz, "centre": centre}
    cube = polarized_screens(**given, screens=Screens(uv_range=(0, 800)))
    cube.data[:, 0], cube.data[:, 3] = 2.0, 0.5
    found = leaked_through(cube, lofar, times)
    y, x = np.mgrid[:16, :16]
    sky = cube.wcs.celestial.pixel_to_world(x.ravel(), y.ravel())
    beam = lofar.mueller(sky, times, cube.freq_hz * u.Hz, centre).real.mean(axis=0)[..., 0, 1:].reshape(3, 16, 16, 3)
    expected = 2 + np.einsum("fyxk,fkyx->fyx", beam, cube.data[:, 1:].astype(float))
    leak = np.abs(expected - 2).max()
    assert leak > 5e-3
    assert np.abs(found.data[:, 0] - expected).max() < 1e-3 * leak  # 9 nodes over 4 deg
    assert np.array_equal(found.data[:, 1:], cube.data[:, 1:])
    with pytest.warns(InstrumentWarning, match="between 2 x 2 nodes is wrong by .* more nodes"):
        leaked_through(cube, lofar, times, nodes=2)
    with pytest.raises(InputError, match="the centre of the cube"):
        leaked_through(polarized_screens(16, 15 * u.arcmin, BAND[:1], screens=Screens(uv_range=(0, 800))), lofar, times)
    with pytest.raises(InputError, match="nodes = 1"):
        leaked_through(cube, lofar, times, nodes=1)


# Noise -----------------------------------------------------------------------------------------------------------


def like(psf=None, unit="K", pixels=128):
    return StokesCube(np.zeros((2, 4, pixels, pixels)), [140, 150] * u.MHz, 0.5 * u.arcmin, unit, psf=psf)


def test_white_noise_has_its_rms_in_each_channel_and_nothing_in_common():
    noise = noise_cube(like(), [60, 120] * u.mK, seed=3)
    assert noise.data.dtype == np.float32
    # 5 sigma of an rms of 16384 values
    assert noise.data.std(axis=(2, 3)) == pytest.approx(np.repeat([[0.06], [0.12]], 4, axis=1), rel=5 / 128 / 2**0.5)
    both = np.corrcoef(noise.data.reshape(8, -1)) - np.eye(8)
    assert np.abs(both).max() < 5 / 128
    lag = np.corrcoef(noise.data[0, 0, :, 1:].ravel(), noise.data[0, 0, :, :-1].ravel())[0, 1]
    assert abs(lag) < 5 / 128
    assert not np.array_equal(noise.data, noise_cube(like(), [60, 120] * u.mK, seed=4).data)
    assert np.array_equal(noise.data, noise_cube(like(), [60, 120] * u.mK, seed=3).data)


def test_noise_with_the_shape_of_the_psf_has_the_covariance_of_the_psf():
    """Covariance at a separation is sigma² PSF: along the major axis of an ellipse turned north through east."""
    fwhm = Psf.gaussian([4, 6] * u.arcmin, [2, 3] * u.arcmin, 45 * u.deg)
    noise = noise_cube(like(fwhm, pixels=512), 1 * u.K, psf_shaped=True).data
    cells = np.abs(np.fft.fft2(noise)) ** 2
    covariance = np.fft.ifft2(cells).real.mean(axis=1) / 512**2
    assert noise.std() == pytest.approx(1, abs=0.02)
    for channel, (major, minor) in enumerate([(4, 2), (6, 3)]):
        for n in (1, 2, 3):
            apart = n * 0.5 * np.sqrt(2)
            # x to the west, y to the north: (-n, n) is north-east, along the major axis
            along, across = covariance[channel, n, -n], covariance[channel, n, n]
            expected = [np.exp(-4 * np.log(2) * (apart / w) ** 2) for w in (major, minor)]
            # 4 x 512² pixels, 27 to 61 pixels a beam: 5 sigma is 0.03
            assert [along, across] == pytest.approx(expected, abs=0.03)


def test_an_image_of_the_psf_and_its_gaussian_give_the_same_noise():
    n = np.arange(128) - 64
    image = np.exp(-4 * np.log(2) * (n[:, None] ** 2 + n**2) * 0.25 / 9)
    known = Psf.gaussian([3, 3] * u.arcmin)
    seen = Psf(np.stack([image] * 2), known.major_rad, known.minor_rad, known.angle_rad, known.residual)
    a, b = (noise_cube(like(psf), 1 * u.K, psf_shaped=True).data for psf in (seen, known))
    assert np.abs(a - b).max() < 1e-4


def test_impossible_noise_is_refused():
    with pytest.raises(InputError, match="needs a cube with a PSF"):
        noise_cube(like(), 1 * u.K, psf_shaped=True)
    with pytest.raises(InputError, match="sigma needs a unit convertible to K"):
        noise_cube(like(), 60)
    with pytest.raises(InputError, match="sigma needs a unit convertible to Jy/beam"):
        noise_cube(like(unit="Jy/beam"), 1 * u.K)
    with pytest.raises(InputError, match="sigma = nan K is not finite"):
        noise_cube(like(), np.nan * u.K)
    with pytest.raises(InputError, match="is not one value or 2"):
        noise_cube(like(), [1, 2, 3] * u.K)
    with pytest.raises(InputError, match="the PSF of channel 1 is not known"):
        noise_cube(like(Psf.gaussian([3, np.nan] * u.arcmin)), 1 * u.K, psf_shaped=True)
    assert noise_cube(like(unit="Jy/beam"), 1 * u.mJy / u.beam).data.std() == pytest.approx(1e-3, rel=0.02)
