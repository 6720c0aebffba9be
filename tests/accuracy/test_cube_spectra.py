"""Power spectra of cubes: the definition, fields of known spectrum, tapers, k, cross-spectra, errors, the PSF."""

import itertools

import numpy as np
import pytest
from astropy import units as u
from astropy.cosmology import Planck15

from instrument import Analyzer, InputError, StokesCube
from instrument.analyze.power.cylinders import ratio
from instrument.analyze.power.fourier import HYDROGEN, taper_of
from instrument.image.psf import Psf
from instrument.observe.directions import LIGHT

PIXEL = 2 * u.arcmin
RAD = PIXEL.to_value(u.rad)
STEP = 0.4e6
SIZES = [(32, 48, 48), (33, 47, 49), (32, 47, 48), (31, 40, 61)]  # channels, y, x


def band(n, step=STEP, middle=150e6):
    return middle + step * (np.arange(n) - (n - 1) / 2)


def cube(field=None, step=STEP, pixel=PIXEL, unit="K", psf=None, **planes):
    """With one field (F, Ny, Nx) as Stokes I, or fields by name; what is not given is zero."""
    planes = {"I": field, **planes} if field is not None else planes
    shape = np.shape(next(iter(planes.values())))
    data = np.zeros((shape[0], 4, *shape[1:]))
    for name, plane in planes.items():
        data[:, "IQUV".index(name)] = plane
    return StokesCube(data, band(shape[0], step) * u.Hz, pixel, unit, psf=psf)


def scales(step=STEP, freq_hz=150e6):
    """Mpc per rad and per Hz at the middle of the band, from astropy alone."""
    z = HYDROGEN / freq_hz - 1
    along = LIGHT * (1 + z) ** 2 / (Planck15.H(z).to_value("m / (s Mpc)") * HYDROGEN)
    return Planck15.comoving_transverse_distance(z).value, along


def grid_k(shape, step=STEP, pixel=RAD):
    """|k| components (F, Ny, Nx) of every cell, 1/Mpc."""
    across, along = scales()
    par = 2 * np.pi * np.fft.fftfreq(shape[0], step * along)
    y, x = (2 * np.pi * np.fft.fftfreq(n, pixel * across) for n in shape[1:])
    return np.broadcast_to(np.hypot(y[:, None], x), shape), np.broadcast_to(np.abs(par)[:, None, None], shape)


def cell_mpc3(step=STEP, pixel=RAD):
    across, along = scales()
    return (across * pixel) ** 2 * along * step


def gaussian_field(shape, slope, rng, step=STEP, pixel=RAD):
    """Periodic and real, P = (k / 0.1)^-slope K² Mpc³: white noise, each cell times the root of its power."""
    power = law(np.hypot(*grid_k(shape, step, pixel)), slope)
    return np.fft.ifftn(np.fft.fftn(rng.normal(size=shape)) * np.sqrt(power / cell_mpc3(step, pixel))).real


def law(k, slope):
    return np.where(k > 0, (np.maximum(k, 1e-9) / 0.1) ** -slope, 0.0)


# The definition ---------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("stokes", ["V", "P"])
@pytest.mark.parametrize("shape", [(4, 5, 6), (5, 4, 3), (2, 3, 3), (6, 1, 4), (3, 6, 1)])
def test_power_is_the_plain_sum_over_voxels(shape, stokes):
    """V / N² |sum_x f(x) exp(-2 pi i k.x)|² of each cell, one by one, averaged over cells of equal k_perp and k_par."""
    rng = np.random.default_rng(3)
    q, w, v = rng.normal(size=(3, *shape))
    field = v if stokes == "V" else q + 1j * w
    places = np.indices(shape)
    perp, par = (np.round(k, 12) for k in grid_k(shape))
    sums = {}
    for cell in itertools.product(*(range(n) for n in shape)):
        wave = np.exp(-2j * np.pi * sum(c * x / n for c, x, n in zip(cell, places, shape, strict=True)))
        here = abs(((field - field.mean()) * wave).sum()) ** 2 * cell_mpc3() / field.size
        sums.setdefault((perp[cell], par[cell]), []).append(here)
    lengths, depths = np.unique(perp), np.unique(par)
    edges = [np.concatenate([[0], (k[1:] + k[:-1]) / 2, [2 * k[-1] + 1]]) for k in (lengths, depths)]
    found = Analyzer(cube(Q=q, U=w, V=v)).cylindrical(
        stokes, taper=None, bins=edges[0] / u.Mpc, bins_par=edges[1] / u.Mpc
    )
    for (a, b), values in sums.items():
        i, j = np.searchsorted(lengths, a), np.searchsorted(depths, b)
        assert found.count[i, j] == len(values)
        assert found.power[i, j] == pytest.approx(np.mean(values), rel=1e-10, abs=1e-12)
    assert found.count.sum() == field.size
    assert found.left_out["outside all bins"] == 0


@pytest.mark.parametrize("stokes", ["I", "P"])
@pytest.mark.parametrize("taper", [None, "hann", "blackman-harris"])
@pytest.mark.parametrize("shape", SIZES)
def test_parseval_to_1e_12(shape, taper, stokes):
    """The sum of P over all cells / V is the variance of the field behind its taper."""
    rng = np.random.default_rng(1)
    q, w = rng.normal(size=(2, *shape))
    field = (q if stokes == "I" else q + 1j * w) - (q if stokes == "I" else q + 1j * w).mean()
    window = np.multiply.outer(taper_of(shape[0], taper), np.multiply.outer(*(taper_of(n, taper) for n in shape[1:])))
    wanted = (abs(window * field) ** 2).mean() / (window**2).mean()
    cells = Analyzer(cube(I=q, Q=q, U=w)).cells(stokes, taper=taper, taper_space=taper)
    total = (cells.power * cells.times * cells.folds[:, None]).sum() / (cell_mpc3() * field.size)
    assert total == pytest.approx(wanted, rel=1e-12)
    assert cells.times.sum() * cells.folds.sum() == field.size
    if taper is None:
        everything = cells.spherical(bins=[0, 1e9] / u.Mpc)
        assert everything.count[0] == field.size - 1
        assert everything.power[0] * everything.count[0] / (cell_mpc3() * field.size) == pytest.approx(
            wanted, rel=1e-12
        )


@pytest.mark.parametrize("log", [True, False])
@pytest.mark.parametrize("shape", SIZES)
def test_every_cell_is_in_one_bin_or_listed_as_left_out(shape, log):
    analyzer = Analyzer(cube(np.random.default_rng(0).normal(size=shape)))
    for bins_par in (None, 7):
        found = analyzer.cylindrical(log=log, bins_par=bins_par)
        assert found.count.sum() + sum(found.left_out.values()) == np.prod(shape)
        assert (found.left_out["k_perp = 0"] > 0) == log and (found.left_out["k_par = 0"] > 0) == log
        assert found.left_out["outside all bins"] == 0
    ball = analyzer.spherical(log=log)
    assert ball.count.sum() == np.prod(shape) - 1 and ball.left_out["k = 0, or outside all bins"] == 1


# Fields of known spectrum -----------------------------------------------------------------------------------------


@pytest.mark.parametrize("slope", [0, 2, 3.5])
@pytest.mark.parametrize("shape", SIZES)
def test_periodic_fields_are_recovered_within_the_sampling_error(shape, slope):
    """20 fields, 8 bins of k and 6 x 5 of (k_perp, k_par): means within 4.5 sigma / sqrt(20) of the true average."""
    rng = np.random.default_rng(196)
    number = 20
    balls, cylinders = [], []
    for _ in range(number):
        made = Analyzer(cube(gaussian_field(shape, slope, rng))).cells(taper=None)
        balls.append(made.spherical(bins=8))
        cylinders.append(made.cylindrical(bins=6, bins_par=5))
    for spectra in (balls, cylinders):
        truth = spectra[0].average(lambda k: law(k, slope))
        square = spectra[0].average(lambda k: law(k, slope) ** 2)
        use = spectra[0].count > 0
        found = np.array([s.power for s in spectra])[:, use] / truth[use]
        # cells of more power weigh more: the modes that count are fewer than the cells
        sigma = np.sqrt(square / truth**2 / (spectra[0].count / 2))[use]
        assert np.all(abs(found.mean(axis=0) - 1) < 4.5 * sigma / np.sqrt(number))
        chi2 = ((found - 1) ** 2 / sigma**2).mean()
        assert abs(chi2 - 1) < 5 * np.sqrt(2 / found.size) + 0.1
        if slope == 0:
            np.testing.assert_allclose((spectra[0].sigma / spectra[0].power)[use], sigma, rtol=1e-12)


def test_the_average_over_cells_is_not_the_spectrum_at_the_mean_k():
    """6 % at a slope of 3.5 and bins of ratio 1.37; by the definition it is the mean over all cells of the bin."""
    shape, edges = (32, 48, 48), 0.1 * 1.37 ** np.arange(6)
    found = Analyzer(cube(np.random.default_rng(0).normal(size=shape))).spherical(taper=None, bins=edges / u.Mpc)
    k = np.hypot(*grid_k(shape)).ravel()
    got = found.average(lambda k: law(k, 3.5))
    for low, high, mean in zip(edges[:-1], edges[1:], got, strict=True):
        assert mean == pytest.approx(law(k[(k >= low) & (k < high)], 3.5).mean(), rel=1e-9)
    off = got / law(found.k, 3.5) - 1
    assert np.all((off > 0.04) & (off < 0.08)), off


def test_both_tapers_recover_a_steep_field_that_is_not_periodic_within_2_percent():
    """Pieces of a larger field, P ~ k^-3.5, k > 0.2 / Mpc; no taper makes it 10 % too high, one along frequency 3 %."""
    rng = np.random.default_rng(5)
    shape = (64, 96, 96)
    edges = np.geomspace(0.2, 0.75, 5) / u.Mpc
    found = {"none": [], "frequency": [], "both": []}
    for _ in range(3):
        large = gaussian_field((128, 192, 192), 3.5, rng)
        for y, x in ((0, 0), (96, 96), (0, 96), (96, 0)):
            piece = Analyzer(cube(large[: shape[0], y : y + shape[1], x : x + shape[2]]))
            for name, tapers in (
                ("none", (None, None)),
                ("frequency", ("blackman-harris", None)),
                ("both", ("blackman-harris", "hann")),
            ):
                found[name].append(piece.spherical(taper=tapers[0], taper_space=tapers[1], bins=edges))
    truth = found["none"][0].average(lambda k: law(k, 3.5))
    mean = {name: np.mean([s.power for s in spectra], axis=0) / truth for name, spectra in found.items()}
    assert np.all(abs(mean["both"] - 1) < 0.02), mean
    assert np.all(mean["none"] > 1.05), mean
    assert np.all(mean["frequency"] > mean["both"]), mean


def test_a_taper_keeps_the_level_of_white_noise():
    rng = np.random.default_rng(7)
    edges = [0.1, 0.3, 0.9] / u.Mpc
    for tapers in ({"taper": "hann"}, {"taper": "blackman-harris", "taper_space": "hann"}):
        made = [Analyzer(cube(3 * rng.normal(size=(33, 64, 64)))).spherical(bins=edges, **tapers) for _ in range(20)]
        level = np.mean([s.power for s in made], axis=0) / (9 * cell_mpc3())
        assert np.all(abs(level - 1) < 0.015), level


@pytest.mark.long
def test_sigma_is_the_scatter_of_white_noise():
    """200 cubes: the scatter has an error of 5 % in each bin, so 20 %."""
    rng = np.random.default_rng(2)
    for stokes, tapers in itertools.product(
        "IP", ({"taper": None}, {"taper": "blackman-harris", "taper_space": "hann"})
    ):
        noise = rng.normal(size=(200, 2, 16, 24, 25))
        made = [Analyzer(cube(I=a, Q=a, U=b)).spherical(stokes, bins=4, log=False, **tapers) for a, b in noise]
        power, sigma = np.array([s.power for s in made]), np.mean([s.sigma for s in made], axis=0)
        np.testing.assert_allclose(power.std(axis=0)[1:3] / sigma[1:3], 1, atol=0.2)


@pytest.mark.parametrize(
    ("taper", "levels"),
    [
        (None, (9e-4, 1e-4, 1e-5, 3e-6)),
        ("hann", (1e-5, 1.5e-8, 7e-11, 1e-13)),  # a symmetric one, zero at both ends, 4e-15
        ("blackman-harris", (1.5e-4, 2e-11, 3e-13, 4e-14)),
    ],
)
def test_smooth_spectra_stay_at_low_k_par_as_their_taper_has_it(taper, levels):
    """nu^-2.55, 161 channels: power at k_par 0.03, 0.1, 0.3, 0.9 over its mean, within a factor 3 of other tools."""
    freq = np.linspace(134e6, 166e6, 161)
    wave = np.cos(2 * np.pi * 3 * np.arange(16) / 16)
    data = np.zeros((161, 4, 1, 16))
    data[:, 0] = (freq / 150e6)[:, None, None] ** -2.55 * wave
    found = Analyzer(StokesCube(data, freq * u.Hz, PIXEL, "K")).cylindrical(taper=taper, log=False, bins=1)
    near = abs(found.k_par[:, None] - [0.034, 0.1, 0.3, 0.9]).argmin(axis=0)
    power = found.power[0, near] / found.power[0, 0]
    # the tapers here are periodic, a symmetric one differs by up to 5 times
    assert np.all(power < 5 * np.array(levels))
    assert np.all(power[:2] > np.array(levels[:2]) / 5)


# Where k is -------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("shape", SIZES)
@pytest.mark.parametrize("wave", [(3, 0, 5), (0, 4, 0), (7, 3, -7), (12, 0, 1)])
def test_a_plane_wave_lands_in_its_bin_with_all_its_power(shape, wave):
    places = np.indices(shape)
    field = 2 * np.cos(2 * np.pi * sum(c * x / n for c, x, n in zip(wave, places, shape, strict=True)) + 0.3)
    across, along = scales()
    k_par = 2 * np.pi * wave[0] / (shape[0] * STEP * along)
    k_perp = 2 * np.pi * np.hypot(wave[1] / shape[1], wave[2] / shape[2]) / (RAD * across)
    found = Analyzer(cube(field)).cylindrical(taper=None, bins=30, log=False)
    (i,), (j,) = np.nonzero(np.nan_to_num(found.power) > 1e-20 * np.nanmax(found.power))
    assert found.perp_edges[i] <= k_perp * (1 + 1e-12) and k_perp <= found.perp_edges[i + 1]
    assert found.k_par[j] == pytest.approx(k_par, rel=1e-9, abs=1e-12)
    assert found.power[i, j] * found.count[i, j] / (cell_mpc3() * field.size) == pytest.approx(2, rel=1e-11)
    ball = Analyzer(cube(field)).spherical(taper=None, bins=30)
    (i,) = np.flatnonzero(np.nan_to_num(ball.power) > 1e-20 * np.nanmax(ball.power))
    assert ball.edges[i] * (1 - 1e-12) <= np.hypot(k_perp, k_par) <= ball.edges[i + 1] * (1 + 1e-12)


def test_beyond_nyquist_a_tone_comes_back_from_it():
    """1.2 of Nyquist lies at 0.8; on the paper's axis, up to 1/dnu, at both."""
    n = 40
    field = np.cos(2 * np.pi * 0.6 * np.arange(n))[:, None, None] * np.cos(2 * np.pi * np.arange(16) * 3 / 16)
    field = field * np.ones((1, 16, 1))
    analyzer = Analyzer(cube(field))
    found = analyzer.cylindrical(taper=None)
    nyquist = np.pi / (scales()[1] * STEP)
    assert found.k_par[-1] == pytest.approx(nyquist, rel=1e-9)
    assert found.k_par[np.nanargmax(np.nansum(found.power, axis=0))] == pytest.approx(0.8 * nyquist, rel=1e-9)
    printed = analyzer.cylindrical(taper=None, paper_axis=True)
    seen = printed.k_par[np.nansum(printed.power, axis=0) > 0.1 * np.nanmax(printed.power)]
    np.testing.assert_allclose(seen, [0.8 * nyquist, 1.2 * nyquist], rtol=1e-9)
    assert printed.k_par[-1] == pytest.approx(2 * nyquist * (1 - 1 / n), rel=1e-9)


def test_numbers_of_the_paper():
    """30 to 800 wavelengths, 161 channels of 0.2 MHz at 150 MHz: k_perp 0.0203 to 0.542, k_par to 0.913 / Mpc."""
    freq = np.linspace(134e6, 166e6, 161)
    data = np.random.default_rng(0).normal(size=(161, 4, 60, 60))
    made = Analyzer(StokesCube(data, freq * u.Hz, 1.9 * u.arcmin, "K")).cells(uv_range=(30, 800))
    found = made.cylindrical()
    assert found.redshift == pytest.approx(8.4694, abs=1e-4)
    assert found.perp_edges[[0, -1]] == pytest.approx([0.0203, 0.542], rel=2e-3)
    nyquist = np.pi / (found.frame.depth_mpc_per_hz * 0.2e6)
    assert nyquist == pytest.approx(0.913, abs=5e-4)
    assert found.k_par[[0, -1]] == pytest.approx([2 * nyquist / 161, 160 * nyquist / 161], rel=1e-9)
    assert made.cylindrical(paper_axis=True).k_par[-1] == pytest.approx(1.826 * 160 / 161, rel=1e-3)
    assert found.frame.horizon_slope == pytest.approx(3.59, abs=0.005)
    assert found.wedge(2 * u.deg)[3] / found.k_perp[3] == pytest.approx(0.125, abs=5e-4)
    assert found.wedge(10 * u.deg)[3] / found.k_perp[3] == pytest.approx(0.62, abs=5e-3)


def test_k_means_are_those_of_the_cells_of_a_bin():
    shape = (9, 20, 21)
    found = Analyzer(cube(np.random.default_rng(0).normal(size=shape))).cylindrical(bins=4, bins_par=3)
    perp, par = (k.ravel() for k in grid_k(shape))
    for i, j in np.ndindex(4, 3):
        inside = (perp >= found.perp_edges[i] * (1 - 1e-12)) & (par >= found.par_edges[j] * (1 - 1e-12))
        inside &= (
            perp < found.perp_edges[i + 1] * (1 - 1e-12) if i < 3 else perp <= found.perp_edges[i + 1] * (1 + 1e-12)
        )
        inside &= par < found.par_edges[j + 1] * (1 - 1e-12) if j < 2 else par <= found.par_edges[j + 1] * (1 + 1e-12)
        assert found.count[i, j] == inside.sum()
        assert found.k_perp[i] == pytest.approx(perp[inside].mean(), rel=1e-9)
        assert found.k_par[j] == pytest.approx(par[inside].mean(), rel=1e-9)


def test_the_two_conventions_of_delta2():
    """The paper's is half the variance per ln k_perp and ln k_par; the standard one is k³ P / 2 pi²."""
    rng = np.random.default_rng(0)
    found = Analyzer(cube(rng.normal(size=(64, 64, 64)))).cylindrical(taper=None, bins=12, bins_par=10)
    each = np.multiply.outer(np.diff(np.log(found.perp_edges)), np.diff(np.log(found.par_edges)))
    variance = found.power * found.count / (cell_mpc3() * 64**3)
    inner = (slice(7, 10), slice(6, 9))  # full rings of many cells
    assert (2 * found.delta2 * each)[inner].sum() == pytest.approx(variance[inner].sum(), rel=0.06)
    k = np.hypot(found.k_perp[:, None], found.k_par)
    np.testing.assert_allclose(found.delta2_standard, k**3 * found.power / (2 * np.pi**2), rtol=1e-12)


def test_the_sign_of_a_faraday_depth_does_not_matter_to_p():
    """Q + iU = exp(+2 pi i m f / F) and its conjugate: both signs of k_par are in one bin, each with half its power."""
    tone = np.exp(2j * np.pi * 5 * np.arange(32) / 32)[:, None, None] * np.cos(2 * np.pi * 2 * np.arange(12) / 12)
    both = [Analyzer(cube(Q=w.real, U=w.imag)).cylindrical("P", taper=None) for w in (tone, tone.conj())]
    np.testing.assert_allclose(both[0].power, both[1].power, rtol=1e-10, atol=1e-10 * np.nanmax(both[0].power))
    assert np.nanargmax(np.nansum(both[0].power, axis=0)) == 4  # bins begin at 1


# What is given to it ----------------------------------------------------------------------------------------------


def test_cross_spectra_have_no_bias_of_noise():
    """One field, noise of ten times its power in both halves: the cross-spectrum is the field's, within its sigma."""
    rng = np.random.default_rng(4)
    shape, number = (24, 32, 32), 20
    crosses, autos, sigmas, without = [], [], [], []
    for _ in range(number):
        signal = rng.normal(size=shape)
        one, two = (signal + np.sqrt(10) * rng.normal(size=shape) for _ in range(2))
        made = Analyzer(cube(one)).spherical(taper=None, bins=4, cross=cube(two))
        crosses.append(made.power)
        sigmas.append(made.sigma)
        autos.append(Analyzer(cube(one)).spherical(taper=None, bins=4).power)
        noise = Analyzer(cube(np.sqrt(10) * rng.normal(size=shape))).spherical(taper=None, bins=4)
        without.append(Analyzer(cube(one)).spherical(taper=None, bins=4).less(noise).power)
    sigma = np.mean(sigmas, axis=0)
    level = cell_mpc3()
    assert np.all(abs(np.mean(crosses, axis=0) - level) < 4 * sigma / np.sqrt(number))
    np.testing.assert_allclose(np.std(crosses, axis=0) / sigma, 1, atol=0.5)
    np.testing.assert_allclose(np.mean(autos, axis=0)[1:] / level, 11, rtol=0.1)
    np.testing.assert_allclose(np.mean(without, axis=0)[2:] / level, 1, atol=0.4)


def test_a_cube_across_itself_is_its_spectrum():
    field = np.random.default_rng(0).normal(size=(8, 12, 13))
    one, two = cube(field), cube(field.copy())
    a, b = Analyzer(one).cylindrical(), Analyzer(one).cylindrical(cross=two)
    np.testing.assert_allclose(a.power, b.power, rtol=1e-12)
    np.testing.assert_allclose(a.sigma, b.sigma, rtol=1e-12)
    np.testing.assert_allclose(ratio(b, a)[a.count > 0], 1, rtol=1e-12)


def test_the_psf_is_divided_out():
    """White noise seen with a Gaussian beam that grows with the wavelength: P back to 1e-6 where it is seen."""
    rng = np.random.default_rng(0)
    shape, freq = (16, 64, 64), band(16)
    across = np.hypot(*(np.meshgrid(*(np.fft.fftfreq(64, RAD),) * 2)))
    fwhm = 6 / 60 * np.pi / 180 * 150e6 / freq
    seen = np.exp(-((np.pi * fwhm[:, None, None] * across) ** 2) / (4 * np.log(2)))
    field = rng.normal(size=shape)
    image = np.fft.ifft2(np.fft.fft2(field) * seen).real
    solid = np.pi / (4 * np.log(2)) * fwhm**2
    psf = np.fft.fftshift(np.fft.ifft2(seen).real, axes=(1, 2)) * (solid / RAD**2)[:, None, None]
    beams = Psf(psf, fwhm, fwhm, np.zeros(16), np.zeros(16))
    got = Analyzer(cube(image, psf=beams)).spherical(taper=None, psf_corrected=True, bins=6, uv_range=(10, 250))
    want = Analyzer(cube(field)).spherical(taper=None, bins=6, uv_range=(10, 250))
    np.testing.assert_allclose(got.power[want.count > 0], want.power[want.count > 0], rtol=1e-6)
    assert got.frame.psf_corrected and not want.frame.psf_corrected
    everything = Analyzer(cube(image, psf=beams)).cells(taper=None, psf_corrected=True)
    assert everything.left_out["cells where the PSF is weak"] > 0
    with pytest.raises(InputError, match="needs the images of the PSF"):
        Analyzer(cube(field)).spherical(psf_corrected=True)


def test_the_wedge_is_left_out_of_a_spherical_spectrum():
    shape = (24, 32, 32)
    made = Analyzer(cube(np.random.default_rng(0).normal(size=shape))).cells(taper=None)
    perp, par = grid_k(shape)
    line = made.frame.horizon_slope * np.sin(np.deg2rad(20)) * perp
    keep = (par >= line * (1 - 1e-12)) & (par >= 0.05) & (np.hypot(perp, par) > 0)
    found = made.spherical(bins=[0, 99] / u.Mpc, wedge=20 * u.deg, k_par_min=0.05 / u.Mpc)
    assert found.count.sum() == keep.sum()
    assert found.left_out["in the wedge, or below k_par_min"] == np.prod(shape) - keep.sum()
    assert found.count.sum() < made.spherical(bins=[0, 99] / u.Mpc, wedge=1 * u.deg).count.sum()


def test_the_cut_of_baselines_keeps_their_cells_and_ends_the_bins():
    shape = (8, 48, 47)
    analyzer = Analyzer(cube(np.random.default_rng(0).normal(size=shape)))
    made = analyzer.cells(uv_range=(50, 400))
    uv = np.hypot(*np.meshgrid(np.fft.fftfreq(47, RAD), np.fft.fftfreq(48, RAD)))
    assert made.times.sum() == ((uv >= 50) & (uv <= 400)).sum()
    whole = analyzer.cells()
    keep = (whole.k_perp >= 50 * 2 * np.pi / made.frame.distance_mpc) & (
        whole.k_perp <= 400 * 2 * np.pi / made.frame.distance_mpc
    )
    np.testing.assert_allclose(made.power, whole.power[:, keep], rtol=1e-10, atol=1e-18)
    found = made.cylindrical(bins=6)
    np.testing.assert_allclose(found.perp_edges[[0, -1]] * found.frame.distance_mpc / 2 / np.pi, [50, 400], rtol=1e-12)


def test_tables_have_units_and_come_back(tmp_path):
    from astropy.table import QTable

    analyzer = Analyzer(cube(np.random.default_rng(0).normal(size=(8, 12, 12))))
    for made, rows in ((analyzer.cylindrical(bins=3), 12), (analyzer.spherical(bins=5), 5)):
        made.write(tmp_path / f"spectrum_{rows}.ecsv")
        back = QTable.read(tmp_path / f"spectrum_{rows}.ecsv", format="ascii.ecsv")
        assert len(back) == rows and back["power"].unit == u.K**2 * u.Mpc**3
        np.testing.assert_allclose(back["power"].value, made.power.ravel(), rtol=1e-12)
        assert back.meta["taper"] == "blackman-harris" and back.meta["horizon_slope"] == pytest.approx(3.59, abs=0.01)
