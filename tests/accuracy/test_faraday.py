"""Faraday synthesis: the plain sum, closed forms, the band's figures, RM-CLEAN, peaks, the map to k_par, the files."""

from dataclasses import replace

import numpy as np
import pytest
from astropy import units as u
from astropy.cosmology import Planck18
from astropy.io import fits

from instrument import Analyzer, InputError, StokesCube
from instrument.analyze.faraday.band import FaradayBand, depth_of_k_par, k_par_of_depth
from instrument.analyze.faraday.product import Product
from instrument.analyze.power.fourier import comoving, line_of_sight
from instrument.errors import InstrumentError, Outcome
from instrument.observe.directions import LIGHT
from instrument.units import Direction, UnitError

PAPER = 134e6 + 0.2e6 * np.arange(161)
SHORT = 134e6 + 1e6 * np.arange(33)  # as wide, fewer channels
WIDE = np.linspace(-50, 50, 401)
AXES = {
    "symmetric": WIDE,
    "asymmetric": np.arange(-10, 50.1, 0.25),
    "descending": WIDE[::-1],
    "unsorted": np.random.default_rng(1).permutation(WIDE)[:99],
    "wide": np.linspace(-300, 300, 401),
    "one": np.array([7.0]),
    "one sign": np.linspace(3, 20, 35),
}


def l2(freq):
    return (LIGHT / np.asarray(freq, float)) ** 2


def cube_of(freq=SHORT, unit="K", dtype=float, **planes):
    """A cube with the planes given by name (F, Ny, Nx); others are zero."""
    shape = next(iter(planes.values())).shape
    data = np.zeros((shape[0], 4, *shape[1:]), dtype)
    for name, plane in planes.items():
        data[:, "IQUV".index(name)] = plane
    return StokesCube(data, freq * u.Hz, 0.5 * u.arcmin, unit, constants="data")  # screens of one value are meant


def polarized(p, freq=SHORT, dtype=float, **planes):
    """A cube of the complex P = Q + iU (F, Ny, Nx)."""
    return cube_of(freq, dtype=dtype, Q=p.real, U=p.imag, **planes)


def thin(depth, freq=SHORT, amplitude=1.0, angle=0.0):
    """P of thin sources (F, Ny, Nx): the arguments broadcast over pixels (Ny, Nx)."""
    depth, amplitude, angle = np.broadcast_arrays(np.atleast_2d(depth), amplitude, angle)
    return amplitude * np.exp(2j * (angle + np.multiply.outer(l2(freq), depth)))


def noise(rng, *shape):
    return rng.normal(size=shape) + 1j * rng.normal(size=shape)


def plain(p, freq, depths, weights=None, lambda2_0=None):
    """The definition, one sum per depth and pixel in float64; voxels that are NaN are left out."""
    w = np.ones(len(freq)) if weights is None else np.asarray(weights, float)
    w = np.where(np.isnan(p).all(axis=(1, 2)), 0, w)
    x = l2(freq)
    x0 = (w * x).sum() / w.sum() if lambda2_0 is None else lambda2_0
    each = np.where(np.isnan(p), 0, w[:, None, None])
    total = each.sum(axis=0)
    clean = np.where(np.isnan(p), 0, p)
    with np.errstate(invalid="ignore"):
        return np.array(
            [(each * clean * np.exp(-2j * d * (x - x0))[:, None, None]).sum(axis=0) / total for d in depths]
        )


def worst(a, b):
    """Largest difference over the largest modulus."""
    return np.nanmax(np.abs(a - b)) / np.nanmax(np.abs(b))


# The definition ---------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("precision, most", [("single", 3e-7), ("double", 1e-12)])
@pytest.mark.parametrize("axis", AXES)
def test_synthesis_is_the_plain_sum_on_any_axis(axis, precision, most):
    """500 spectra of a source, noise and uneven weights: 3e-7 is 161 sums in float32, 1e-12 the phases in float64."""
    rng = np.random.default_rng(5)
    p = thin(rng.uniform(-10, 40, (20, 25)), PAPER, rng.uniform(0.5, 2, (20, 25))) + 0.3 * noise(rng, 161, 20, 25)
    p = p.astype(np.complex64)
    weights = rng.uniform(0.5, 1, 161)
    found = Analyzer(polarized(p, PAPER, np.float32)).rm_synthesis(AXES[axis], weights=weights, precision=precision)
    assert found.data.dtype == {"single": np.complex64, "double": np.complex128}[precision]
    assert worst(found.data, plain(p, PAPER, AXES[axis], weights)) < most


@pytest.mark.parametrize("depths, lambda2_0, factored", [(50, 4.04, True), (50, 0.0, False), (300, 4.04, False)])
def test_the_product_in_factors_is_the_product(depths, lambda2_0, factored):
    """Depths that do not fill the band: two factors, the same as the matrix within 1e-9 before they are rounded."""
    phi, weights = np.linspace(-depths, depths, 401), np.linspace(1e-6, 1, 161)
    product = Product(phi, l2(PAPER) - lambda2_0, weights, np.float32)
    assert product.factored is factored
    angle = 2 * np.outer(np.abs(phi), l2(PAPER) - lambda2_0)
    for made, wave in zip(product(np.eye(161, dtype=np.float32)), (np.cos(angle), np.sin(angle)), strict=True):
        # 1e-6: 47 terms in float32; every channel in proportion to its weight
        assert (np.abs(made[product.place] / weights - wave) < 1e-6).all()
    assert not Product(phi, l2(PAPER) - lambda2_0, weights, np.float64).factored


@pytest.mark.parametrize("stokes", "IQUV")
def test_real_parameters_are_the_plain_sum_of_their_values(stokes):
    rng = np.random.default_rng(6)
    planes = dict(zip("IQUV", rng.normal(size=(4, 33, 3, 5)), strict=True))
    for axis in AXES.values():
        found = Analyzer(cube_of(**planes)).rm_synthesis(axis, stokes=stokes)
        assert worst(found.data, plain(planes[stokes].astype(complex), SHORT, axis)) < 1e-12


def test_a_pixel_is_the_same_in_any_image_and_any_chunk(monkeypatch):
    """Rows longer and shorter than a chunk of pixels, and a chunk that ends within a row."""
    rng = np.random.default_rng(7)
    p = noise(rng, 33, 7, 411)
    p[5, 3, 100:300] = np.nan
    whole = Analyzer(polarized(p)).rm_synthesis(WIDE)
    monkeypatch.setattr("instrument.analyze.faraday.synthesis.CHUNK_BYTES", 0)  # 64 pixels at a time
    parts = Analyzer(polarized(p)).rm_synthesis(WIDE)
    assert worst(parts.data, whole.data) < 1e-14 and np.array_equal(parts.flags, whole.flags)
    turned = Analyzer(polarized(p.swapaxes(1, 2))).rm_synthesis(WIDE)
    assert worst(turned.data.swapaxes(1, 2), whole.data) < 1e-14
    assert worst(whole.data, plain(p, SHORT, WIDE)) < 1e-12


@pytest.mark.parametrize("flip", ["strides", "order of bytes", "integers"])
def test_any_layout_of_the_input_gives_the_same_and_is_left_as_it_was(flip):
    rng = np.random.default_rng(8)
    data = np.round(rng.normal(scale=100, size=(33, 4, 3, 5)))
    given = {
        "strides": np.asfortranarray(data)[:, :, ::-1],
        "order of bytes": data.astype(">f8"),
        "integers": data.astype(np.int16),
    }[flip]
    before = given.copy()
    expected = data[:, :, ::-1] if flip == "strides" else data
    found = Analyzer(StokesCube(given, SHORT * u.Hz, 1 * u.arcmin, "K")).rm_synthesis(WIDE)
    assert worst(found.data, plain(expected[:, 1] + 1j * expected[:, 2], SHORT, WIDE)) < 1e-12
    assert np.array_equal(given, before) and given.dtype == before.dtype


def test_the_output_in_a_file_is_the_same(tmp_path):
    p = noise(np.random.default_rng(9), 33, 40, 50)
    said = []
    found = Analyzer(polarized(p)).rm_synthesis(WIDE, out=tmp_path / "f.npy", progress=said.append)
    assert isinstance(found.data.base, np.memmap) or isinstance(found.data, np.memmap)
    assert np.array_equal(found.data, Analyzer(polarized(p)).rm_synthesis(WIDE).data)
    assert np.array_equal(np.load(tmp_path / "f.npy").reshape(found.data.shape), found.data)
    assert said == sorted(said) and said[-1] == 1
    assert np.array_equal(found.clean(cutoff=0.6).iterations.shape, (40, 50))  # read-only data will do


def test_a_file_is_not_there_when_synthesis_fails(tmp_path):
    p = noise(np.random.default_rng(9), 33, 4, 5)
    p[3, 1, 1] = np.inf
    with pytest.raises(InputError, match="infinite"):
        Analyzer(polarized(p)).rm_synthesis(WIDE, out=tmp_path / "f.npy")
    assert not list(tmp_path.iterdir())


# Closed forms -----------------------------------------------------------------------------------------------------


def test_a_thin_source_peaks_at_its_depth_with_its_flux_and_angle():
    """F(phi0) = p exp(2i (chi + phi0 lambda²_0)), and with lambda²_0 = 0 the angle is the one emitted."""
    p = thin(7.0, angle=0.4, amplitude=3.0)
    for lambda2_0 in (None, 0, 4.2 * u.m**2):
        found = Analyzer(polarized(p)).rm_synthesis(AXES["asymmetric"] * u.rad / u.m**2, lambda2_0=lambda2_0)
        at = np.argmax(np.abs(found.data[:, 0, 0]))
        assert found.depths[at] == 7
        assert np.isclose(found.data[at, 0, 0], 3 * np.exp(2j * (0.4 + 7 * found.lambda2_0)), atol=1e-12)
    assert found.lambda2_0 == 4.2


def test_the_rmsf_is_the_answer_to_a_constant():
    found = Analyzer(polarized(np.ones((33, 1, 1), complex))).rm_synthesis(AXES["asymmetric"])
    n = len(found.depths)
    assert len(found.rmsf) == 2 * n - 1 and found.rmsf_depths[n - 1] == 0 and found.rmsf[n - 1] == pytest.approx(1)
    assert np.allclose(np.diff(found.rmsf_depths), 0.25) and np.ptp(found.rmsf_depths) == 2 * np.ptp(found.depths)
    assert np.allclose(found.rmsf_at(found.depths), found.data[:, 0, 0], atol=1e-13)
    assert np.allclose(found.rmsf, np.interp(found.rmsf_depths, found.rmsf_depths, found.rmsf_at(found.rmsf_depths)))
    assert np.isclose(found.rmsf_at(1 * u.rad / u.m**2), np.exp(-2j * (l2(SHORT) - l2(SHORT).mean())).mean())


def test_it_is_linear_and_a_rotation_of_the_angles_turns_the_phase():
    rng = np.random.default_rng(10)
    a, b = noise(rng, 2, 33, 2, 3)

    def f(p):
        return Analyzer(polarized(p)).rm_synthesis(WIDE).data

    assert worst(f(a + b), f(a) + f(b)) < 1e-13
    assert worst(f(a * np.exp(2j * 0.3)), f(a) * np.exp(2j * 0.3)) < 1e-13


def test_real_stokes_parameters_are_hermitian_and_a_constant_gives_the_rmsf():
    rng = np.random.default_rng(11)
    found = Analyzer(cube_of(I=rng.normal(size=(33, 2, 2)))).rm_synthesis(WIDE, stokes="I")
    assert np.array_equal(found.data[::-1], found.data.conj())
    found = Analyzer(cube_of(V=np.full((33, 1, 1), 5.0))).rm_synthesis(WIDE, stokes="V")
    assert np.allclose(found.data[:, 0, 0], 5 * found.rmsf_at(WIDE), atol=1e-13)
    assert np.isclose(found.data[200, 0, 0], 5, atol=1e-13) and found.data[200, 0, 0].imag == 0


def test_order_and_repetition_of_channels_do_not_matter():
    rng = np.random.default_rng(12)
    p, order = noise(rng, 33, 2, 2), rng.permutation(33)
    straight = Analyzer(polarized(p)).rm_synthesis(WIDE)
    mixed = Analyzer(polarized(p[order], SHORT[order])).rm_synthesis(WIDE)
    assert worst(mixed.data, straight.data) < 1e-13 and mixed.lambda2_0 == pytest.approx(straight.lambda2_0, rel=1e-14)
    assert mixed.band.phi_max == straight.band.phi_max
    twice = Analyzer(polarized(p[[0, 0, *range(1, 33)]], SHORT[[0, 0, *range(1, 33)]])).rm_synthesis(WIDE)
    weighted = Analyzer(polarized(p)).rm_synthesis(WIDE, weights=[2] + [1] * 32)
    assert worst(twice.data, weighted.data) < 1e-13


def test_one_channel_sees_all_depths_alike_and_two_a_cosine():
    p = np.array([2 + 1j])[:, None, None]
    one = Analyzer(polarized(p, SHORT[:1])).rm_synthesis(WIDE)
    assert np.allclose(one.data, 2 + 1j, atol=1e-14) and np.allclose(one.rmsf, 1) and one.fwhm == np.inf
    two = Analyzer(polarized(np.ones((2, 1, 1), complex), SHORT[[0, -1]])).rm_synthesis(WIDE)
    assert np.allclose(np.abs(two.data[:, 0, 0]), np.abs(np.cos(WIDE * np.ptp(l2(SHORT)))), atol=1e-13)
    assert two.fwhm == pytest.approx(2 * np.pi / 3 / np.ptp(l2(SHORT)), rel=1e-12)


def test_channels_as_wide_as_the_largest_depth_allows_keep_0_57_of_a_source():
    """Channels even in lambda², each the mean of 1001 samples; the sum over points sees the whole source."""
    centres, width = np.linspace(3.3, 5.0, 171), 0.01
    depth = np.sqrt(3) / width
    inside = (np.arange(1001) - 500) / 1001 * width
    averaged = np.exp(2j * depth * (centres[:, None] + inside)).mean(axis=1)[:, None, None]
    freq = LIGHT / np.sqrt(centres)
    found = Analyzer(polarized(averaged, freq)).rm_synthesis([depth])
    assert np.abs(found.data[0, 0, 0]) == pytest.approx(np.sin(np.sqrt(3)) / np.sqrt(3), abs=1e-5)
    assert np.abs(Analyzer(polarized(thin(depth, freq), freq)).rm_synthesis([depth]).data[0, 0, 0]) == pytest.approx(1)


def test_a_slab_wider_than_the_largest_scale_is_depolarized():
    """0.96 rad/m² of uniform slab keeps 15 % of its peak, 2 rad/m² 7 %: less than the resolution, and gone."""
    for width, left in ((0.96, 0.15), (2.0, 0.07)):
        inside = (np.arange(2000) + 0.5) / 2000 * width
        p = np.exp(2j * np.multiply.outer(l2(PAPER), inside)).mean(axis=1)[:, None, None]
        found = Analyzer(polarized(p, PAPER)).rm_synthesis(np.linspace(-10, 10, 401))
        assert np.abs(found.data).max() == pytest.approx(left, abs=0.01)


@pytest.mark.parametrize("alpha", [-2.55, 1.3])
def test_a_spectral_index_is_divided_out(alpha):
    found = Analyzer(polarized(thin(7.0))).rm_synthesis(WIDE)
    p = thin(7.0) * (SHORT / found.reference_hz)[:, None, None] ** alpha
    level = Analyzer(polarized(p)).rm_synthesis(WIDE, spectral_index=alpha, lambda2_0=0)
    assert np.abs(level.data).max() == pytest.approx(1, rel=1e-12)
    assert level.reference_hz == LIGHT / np.sqrt(found.lambda2_0)
    assert np.abs(Analyzer(polarized(p)).rm_synthesis(WIDE).data).max() != pytest.approx(1, abs=1e-3)


def test_division_by_stokes_i_gives_back_the_intensity_at_the_reference():
    """A fraction of 0.3 of power laws, with voxels flagged, too faint and negative in I: 0.3 I(nu0) to rounding."""
    rng = np.random.default_rng(13)
    alpha, level = rng.uniform(-3, 1, (2, 4)), rng.uniform(1, 9, (2, 4))
    reference = LIGHT / np.sqrt(l2(SHORT).mean())
    i = level * (SHORT / reference)[:, None, None] ** alpha
    p = 0.3 * i * thin(7.0)
    i[3, 0, 0], i[4, 0, 1], i[:, 1, 3], p[5, 0, 2] = -1, np.nan, 0, np.nan
    found = Analyzer(polarized(p, I=i)).rm_synthesis(AXES["asymmetric"], divide_by_i=True)
    peak = np.abs(found.data[np.flatnonzero(found.depths == 7)[0]])
    assert np.allclose(peak.ravel()[:-1], 0.3 * level.ravel()[:-1], rtol=1e-12) and np.isnan(peak[1, 3])
    assert found.flagged and found.has_voxel(slice(None))[3:6, :3].sum() == 6
    v = Analyzer(cube_of(I=i, V=0.1 * i)).rm_synthesis([0.0], stokes="V", divide_by_i=True)
    assert v.data[0, 1, 0] == pytest.approx(0.1 * level[1, 0])
    one = Analyzer(polarized(p[:1], SHORT[:1], I=i[:1])).rm_synthesis([7.0], divide_by_i=True)
    assert np.allclose(np.abs(one.data).ravel()[:-1], 0.3 * i[0].ravel()[:-1])


# Flags and weights ------------------------------------------------------------------------------------------------


def test_a_channel_without_data_or_weight_is_as_if_it_were_not_there():
    rng = np.random.default_rng(14)
    p = noise(rng, 33, 3, 3)
    keep = np.setdiff1d(np.arange(33), [0, 7, 32])
    without = Analyzer(polarized(p[keep], SHORT[keep])).rm_synthesis(WIDE, noise=np.full(30, 0.1))
    gone = p.copy()
    gone[[0, 32]] = np.nan
    weights = np.where(np.arange(33) == 7, 0.0, 1.0)
    gone[7] = np.inf  # a channel of weight 0 is not looked at
    flagged = Analyzer(polarized(gone)).rm_synthesis(WIDE, weights=weights, noise=0.1)
    assert worst(flagged.data, without.data) < 1e-13
    assert flagged.lambda2_0 == pytest.approx(without.lambda2_0, rel=1e-15) and flagged.fwhm == pytest.approx(
        without.fwhm
    )
    assert np.allclose(flagged.rmsf, without.rmsf, atol=1e-14) and flagged.noise == pytest.approx(without.noise)
    assert not flagged.flagged and flagged.weights.sum() == 30
    assert np.array_equal(flagged.has_voxel(slice(0, 2)), np.isin(np.arange(33), keep)[:, None].repeat(2, 1))


def test_a_thin_source_keeps_its_flux_under_any_flags_of_voxels():
    rng = np.random.default_rng(15)
    p = np.broadcast_to(thin(7.0), (33, 6, 7)).copy()
    p[rng.random(p.shape) < 0.6] = np.nan
    p[:, 2, 2] = np.nan
    p[:, 2, 3], p[4, 2, 3] = np.nan, 1j  # one voxel left
    found = Analyzer(polarized(p)).rm_synthesis(AXES["asymmetric"])
    at = np.flatnonzero(found.depths == 7)[0]
    there = np.ones((6, 7), bool)
    there[2, 2] = False
    assert np.allclose(np.abs(found.data[at][there]), 1, atol=1e-13) and np.isnan(found.data[:, 2, 2]).all()
    assert worst(found.data, plain(p, SHORT, found.depths)) < 1e-12
    assert found.flagged and np.array_equal(found.has_voxel(slice(None)).reshape(p.shape), ~np.isnan(p))


def test_a_voxel_is_flagged_when_either_of_q_and_u_is():
    p = noise(np.random.default_rng(16), 33, 1, 3)
    cube = polarized(p)
    cube.data[4, 1, 0, 0] = cube.data[4, 2, 0, 1] = np.nan
    both = p.copy()
    both[4, 0, :2] = np.nan
    assert worst(Analyzer(cube).rm_synthesis(WIDE).data, plain(both, SHORT, WIDE)) < 1e-12


def test_noise_is_that_of_the_weighted_mean():
    """Analytic sigma_F against 20000 spectra: 1 % is two sigma of their scatter; flags raise it in their pixels."""
    rng = np.random.default_rng(17)
    sigma = rng.uniform(0.5, 2, 33)
    p = sigma[:, None, None] * noise(rng, 33, 100, 200)
    for weights in (None, 1 / sigma**2):
        found = Analyzer(polarized(p)).rm_synthesis([3.0, 40.0], weights=weights, noise=sigma * u.K)
        assert found.data.real.std() == pytest.approx(found.noise, rel=0.01)
        assert found.measured_noise == pytest.approx(found.noise, rel=0.02)
    p[:25, :50] = np.nan
    found = Analyzer(polarized(p)).rm_synthesis([3.0, 40.0], noise=sigma)
    chart = found.noise_map()
    assert np.ptp(chart[50:]) < 1e-12 and chart[99, 0] == pytest.approx(found.noise)
    assert chart[0, 0] == pytest.approx(found.data[:, :50].imag.std(), rel=0.1) and chart[0, 0] > 1.5 * chart[99, 0]


def test_the_largest_weights_make_the_best_map():
    sigma = np.linspace(0.5, 2, 33)
    noises = [
        Analyzer(polarized(np.ones((33, 1, 1), complex))).rm_synthesis([0], weights=w, noise=sigma).noise
        for w in (None, 1 / sigma**2)
    ]
    assert noises[1] == pytest.approx((1 / sigma**2).sum() ** -0.5) and noises[1] < noises[0]


# The band ---------------------------------------------------------------------------------------------------------


def test_the_figures_of_the_paper_s_band():
    band = FaradayBand.of(PAPER * u.Hz)
    assert band.width == pytest.approx(1.7438, abs=5e-5)
    assert band.fwhm_nominal == pytest.approx(1.987, abs=5e-4)
    assert band.fwhm_sinc == pytest.approx(2.179, abs=5e-4)
    assert band.fwhm == pytest.approx(2.184, abs=5e-4)
    assert band.max_scale == pytest.approx(0.963, abs=5e-4)
    assert band.phi_max == pytest.approx(116, abs=0.5)
    assert FaradayBand.of(PAPER[::-1] * u.Hz).phi_max == band.phi_max
    assert FaradayBand.of(PAPER[80:] * u.Hz).phi_max == pytest.approx(162.6, abs=0.5)  # from 150 MHz on
    assert "FWHM 2.184" in str(band)


def test_the_first_null_and_sidelobe_of_the_paper_s_band():
    found = Analyzer(polarized(np.ones((161, 1, 1), complex), PAPER)).rm_synthesis(np.linspace(0, 4, 4001))
    size = np.abs(found.data[:, 0, 0])
    rising = np.flatnonzero(np.diff(size) > 0)[0]
    assert found.depths[rising] == pytest.approx(1.80, abs=0.01)
    assert size[rising:].max() == pytest.approx(0.23, abs=0.01)


@pytest.mark.parametrize("seed", range(5))
def test_half_height_is_where_the_rmsf_is_half(seed):
    rng = np.random.default_rng(seed)
    keep = rng.random(161) < 0.3
    band = FaradayBand.of(PAPER[keep] * u.Hz, rng.uniform(0, 1, keep.sum()))
    phi = np.linspace(0, band.fwhm / 2, 200)
    size = np.abs(np.exp(-2j * np.outer(phi, band.lambda2)) @ band.weights) / band.weights.sum()
    assert size[-1] == pytest.approx(0.5, abs=1e-12) and (size[:-1] > 0.5).all()


def test_a_band_whose_rmsf_stays_high_has_no_width():
    assert FaradayBand.of([134, 166] * u.MHz, [9, 1]).fwhm == np.inf
    one = FaradayBand.of([150] * u.MHz)
    assert one.fwhm == one.fwhm_nominal == one.fwhm_sinc == np.inf and np.isnan(one.phi_max)
    assert FaradayBand.of([150] * u.MHz, channel_width=0.2 * u.MHz).phi_max == pytest.approx(162.6, abs=0.1)


def test_a_gap_in_the_band_is_not_a_wide_channel():
    assert FaradayBand.of(np.delete(PAPER, np.s_[40:90]) * u.Hz).phi_max == FaradayBand.of(PAPER * u.Hz).phi_max


def test_depth_is_a_delay_and_a_k_par():
    """17.0 ns and 0.0062 /Mpc for 1 rad/m² at 150 MHz, and the phase of exp(2i phi lambda²) itself, differentiated."""
    z, _ = comoving(150e6, None, None)
    assert k_par_of_depth(1, 150e6) * line_of_sight(z, None) / (2 * np.pi) == pytest.approx(17.0e-9, rel=3e-3)
    assert k_par_of_depth([1, 5] * u.rad / u.m**2, 150 * u.MHz) == pytest.approx([0.0062, 0.031], rel=3e-3)
    assert k_par_of_depth(-3.0, 150e6) == -k_par_of_depth(3.0, 150e6)
    slope = -(l2(150e6 + 1) - l2(150e6 - 1)) / 2 * 2 / (2 * np.pi)  # turns per Hz of 1 rad/m²
    assert k_par_of_depth(1, 150e6) * line_of_sight(z, None) / (2 * np.pi) == pytest.approx(slope, rel=1e-7)
    back = depth_of_k_par(k_par_of_depth(WIDE, 150e6, Planck18), 150e6, Planck18)
    assert np.allclose(back, WIDE, rtol=1e-14) and k_par_of_depth(1, 150e6, Planck18) != k_par_of_depth(1, 150e6)
    assert depth_of_k_par(0.1 / u.Mpc, 150e6) == pytest.approx(16.15, abs=0.05)


# RM-CLEAN ---------------------------------------------------------------------------------------------------------


def reference_clean(f, rmsf, cutoff, gain, limit):
    """Högbom's loop on one spectrum, as the definition has it."""
    n, left, parts, count = len(f), f.copy(), np.zeros(len(f), complex), 0
    while count < limit and np.abs(left).max() > cutoff:
        k = int(np.argmax(np.abs(left)))
        c = gain * left[k]
        parts[k] += c
        left = left - c * rmsf[n - 1 - k : 2 * n - 1 - k]
        count += 1
    return parts, left, count


@pytest.mark.parametrize("axis", ["symmetric", "asymmetric", "descending", "one sign"])
def test_clean_is_the_plain_loop_with_the_rmsf_of_each_pixel(axis):
    rng = np.random.default_rng(18)
    depths = AXES[axis]
    p = (
        thin(rng.uniform(4, 15, (5, 9)), PAPER)
        + thin(rng.uniform(4, 15, (5, 9)), PAPER, 0.4)
        + 0.1 * noise(rng, 161, 5, 9)
    )
    p[20:60, 2:] = np.nan  # two patterns of flags, and a pixel with its own
    p[rng.random(161) < 0.5, 4, 4] = np.nan
    p[:, 0, 0] = np.nan
    found = Analyzer(polarized(p, PAPER)).rm_synthesis(depths)
    cleaned = found.clean(cutoff=0.05, gain=0.2)
    x = found.lambda2 - found.lambda2_0
    span = np.concatenate([depths[0] - depths[::-1], depths[1:] - depths[0]])
    for row, column in ((0, 1), (2, 3), (4, 4), (4, 8)):
        there = ~np.isnan(p[:, row, column])
        rmsf = np.exp(-2j * np.outer(span, x[there])).mean(axis=1)
        parts, left, count = reference_clean(found.data[:, row, column], rmsf, 0.05, 0.2, 1000)
        assert cleaned.iterations[row, column] == count > 10
        assert np.allclose(cleaned.components[:, row, column], parts, atol=1e-10)
        assert np.allclose(cleaned.residual[:, row, column], left, atol=1e-10)
        width = 2 * np.min(
            np.abs(fine := np.linspace(0, 3, 30001))[np.abs(np.exp(-2j * np.outer(fine, x[there])).mean(1)) < 0.5]
        )
        assert cleaned.fwhm[row, column] == pytest.approx(width, abs=3e-4)
        beam = np.exp(-4 * np.log(2) * (np.subtract.outer(depths, depths) / cleaned.fwhm[row, column]) ** 2)
        assert np.allclose(cleaned.restored[:, row, column], left + beam @ parts, atol=1e-10)
    assert np.isnan(cleaned.restored[:, 0, 0]).all() and cleaned.outcome[0, 0] is Outcome.NON_FINITE
    assert cleaned.iterations[0, 0] == 0 and cleaned.converged.sum() == 44
    cleaned.check()


def test_clean_in_single_precision_agrees_with_double():
    rng = np.random.default_rng(19)
    p = thin(rng.uniform(-9, 9, (6, 16)), PAPER) + 0.1 * noise(rng, 161, 6, 16)
    one, two = (
        Analyzer(polarized(p, PAPER)).rm_synthesis(WIDE, precision=x).clean(cutoff=0.1) for x in ("single", "double")
    )
    assert one.restored.dtype == np.complex64 and two.restored.dtype == np.complex128
    # a peak of two equal values may be taken in the other order: then components differ, the restored spectrum hardly
    same = one.iterations == two.iterations
    assert same.mean() > 0.9 and worst(one.residual[:, same], two.residual[:, same]) < 0.02
    assert worst(one.restored, two.restored) < 0.02


def test_clean_recovers_a_source_on_the_grid():
    found = Analyzer(polarized(thin(7.0, angle=0.3, amplitude=2.0))).rm_synthesis(WIDE)
    cleaned = found.clean(cutoff=1e-6)
    cleaned.check()
    parts = cleaned.components[:, 0, 0]
    at = np.flatnonzero(np.abs(parts))
    assert WIDE[at] == pytest.approx([7.0])
    expected = 2 * np.exp(2j * (0.3 + 7 * found.lambda2_0))
    assert parts.sum() == pytest.approx(expected, abs=1e-6)
    assert np.abs(cleaned.residual).max() <= 1e-6
    assert cleaned.cube.data[at[0], 0, 0] == pytest.approx(expected, abs=2e-6)
    half = np.abs(cleaned.restored[:, 0, 0]) >= 1
    assert half.sum() == np.sum(np.abs(WIDE - 7) <= found.fwhm / 2)


@pytest.mark.parametrize("factor", [1e-25, 1.0, 1e25])
def test_clean_does_not_depend_on_the_unit(factor):
    """In complex64 |F|² of 1e-25 is 0: spectra are scaled by powers of two before."""
    p = thin([[7.0, -12.3]], PAPER) + 0.1 * noise(np.random.default_rng(20), 161, 1, 2)
    first = Analyzer(polarized(p, PAPER, np.float32)).rm_synthesis(WIDE)
    other = replace(first, data=first.data * np.float32(factor))
    one, two = first.clean(cutoff=0.05), other.clean(cutoff=0.05 * factor)
    assert np.allclose(two.residual / np.float32(factor), one.residual, atol=0.01) and one.iterations.min() > 10
    assert np.abs(two.iterations - one.iterations).max() <= 3


def test_a_cutoff_above_the_peak_leaves_everything_as_it_was():
    p = thin([[7.0, 9.0, 1.0]])
    p[:, 0, 2] = 0
    found = Analyzer(polarized(p)).rm_synthesis(WIDE)
    cleaned = found.clean(cutoff=1.1 * u.K)
    assert not cleaned.iterations.any() and not cleaned.components.any() and cleaned.converged.all()
    assert np.array_equal(cleaned.residual, found.data) and np.array_equal(cleaned.restored, found.data)
    zero = found.clean(cutoff=0, iterations=5)
    assert zero.iterations.tolist() == [[5, 5, 0]] and zero.outcome[0, 2] is Outcome.CONVERGED
    assert zero.outcome[0, 0] is Outcome.ITERATION_LIMIT
    with pytest.raises(InstrumentError, match="2 of 3 spectra did not converge: stopped at the iteration limit"):
        zero.check()


def test_clean_takes_multiples_of_the_noise():
    rng = np.random.default_rng(21)
    p = np.broadcast_to(thin(7.0, PAPER), (161, 4, 50)) + noise(rng, 161, 4, 50)
    p[::2, :2] = np.nan
    found = Analyzer(polarized(p, PAPER)).rm_synthesis(WIDE, noise=1.0)
    cleaned = found.clean(sigmas=4)
    assert cleaned.cutoff[3, 0] == pytest.approx(4 / np.sqrt(161)) and cleaned.cutoff[0, 0] == pytest.approx(
        4 / np.sqrt(80)
    )
    assert (np.abs(cleaned.residual).max(axis=0) <= cleaned.cutoff).all() and cleaned.iterations.max() > 5


def test_a_real_stokes_parameter_is_cleaned_in_pairs():
    """I = cos(2 phi0 lambda²) is half a source at +phi0 and half at -phi0."""
    i = np.cos(2 * 12.5 * (l2(PAPER) - 4))[:, None, None]
    found = Analyzer(cube_of(PAPER, I=i)).rm_synthesis(WIDE, stokes="I")
    parts = found.clean(cutoff=1e-4).components[:, 0, 0]
    for side in (12.5, -12.5):
        assert np.abs(parts[np.abs(WIDE - side) < 0.01].sum()) == pytest.approx(0.5, abs=1e-3)


# Peaks ------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("lambda2_0", [None, 0])
@pytest.mark.parametrize("axis", ["asymmetric", "descending", "unsorted", "uneven"])
def test_peaks_between_the_depths_are_found(axis, lambda2_0):
    """Noiseless thin sources anywhere: good to 0.01 of the 2.18 rad/m² of the RMSF."""
    rng = np.random.default_rng(22)
    axes = AXES | {
        "uneven": -2 + 0.25 * (np.arange(97) + rng.uniform(-0.3, 0.3, 97)),
        "unsorted": rng.permutation(WIDE),
    }
    depth, angle, amplitude = rng.uniform(1, 19, (3, 30)), rng.uniform(0, np.pi, (3, 30)), rng.uniform(1, 9, (3, 30))
    p = thin(depth, PAPER, amplitude, angle)
    found = Analyzer(polarized(p, PAPER)).rm_synthesis(axes[axis], lambda2_0=lambda2_0, noise=1e-3)
    peaks = found.peaks()
    assert peaks.significant.all() and not peaks.edge.any()
    assert np.allclose(peaks.depth, depth, atol=0.01) and np.allclose(peaks.peak, amplitude, rtol=1e-3)
    for got, true in ((peaks.angle, angle), (peaks.angle_0, angle + depth * found.lambda2_0)):
        assert ((got >= 0) & (got < np.pi)).all()
        # 4 m² times the error of the depth, and 0.002 of the angle itself
        assert np.abs(np.angle(np.exp(2j * (got - true)))).max() < 2 * (4.1 * 0.01 + 0.002)
    if lambda2_0 is None:
        right = np.exp(2j * (peaks.angle_0 - angle - depth * found.lambda2_0))
        assert np.abs(np.angle(right)).max() < 0.02  # at the mean the error of the depth does not come in


def test_errors_of_peaks_are_those_of_the_scatter():
    """6000 spectra of snr 20: the errors within 5 % (2 sigma is 2 %), the depth unbiased."""
    rng = np.random.default_rng(23)
    p = np.broadcast_to(thin(7.1, PAPER, angle=0.5), (161, 60, 100)) + np.sqrt(161) / 20 * noise(rng, 161, 60, 100)
    found = Analyzer(polarized(p, PAPER)).rm_synthesis(np.linspace(0, 14, 57), noise=np.sqrt(161) / 20)
    peaks = found.peaks()
    assert peaks.significant.all() and found.noise == pytest.approx(1 / 20)
    assert peaks.depth.std() == pytest.approx(peaks.depth_error.mean(), rel=0.05)
    assert peaks.depth_error.mean() == pytest.approx(found.band.fwhm_nominal / 40, rel=0.02)
    assert peaks.depth.mean() == pytest.approx(7.1, abs=0.005)
    for name in ("angle", "angle_0"):
        turned = np.exp(2j * getattr(peaks, name))
        scatter = np.angle(turned / turned.mean()).std() / 2
        assert scatter == pytest.approx(getattr(peaks, f"{name}_error").mean(), rel=0.05)


def test_the_ricean_bias_is_taken_off():
    """Sources of 8 times the noise: the largest |F| is 2 % too bright on average, the corrected one within 0.3 %."""
    rng = np.random.default_rng(24)
    p = np.broadcast_to(thin(7.0, PAPER), (161, 100, 200)) + np.sqrt(161) / 8 * noise(rng, 161, 100, 200)
    peaks = Analyzer(polarized(p, PAPER)).rm_synthesis(np.linspace(4, 10, 25), noise=np.sqrt(161) / 8).peaks(snr=3)
    assert peaks.peak.mean() > 1.01
    assert peaks.polarized.mean() == pytest.approx(1, abs=4e-3)
    assert np.allclose(peaks.polarized**2, peaks.peak**2 - 2.3 / 64)


def test_peaks_that_mean_nothing_are_nan_and_flagged():
    p = thin([[7.0, 7.0, 60.0, 7.0, 7.0]], PAPER)
    p[:, 0, 1] *= 0.05
    p[:, 0, 3] = np.nan
    p[:, 0, 4] = 0
    peaks = Analyzer(polarized(p, PAPER)).rm_synthesis(WIDE, noise=np.sqrt(161) / 100).peaks()
    assert peaks.significant.tolist() == [[True, False, False, False, False]]
    assert peaks.edge.tolist()[0][:3] == [False, False, True]  # a source outside is seen at its flank
    for name in ("depth", "depth_error", "peak", "polarized", "angle", "angle_0", "angle_error", "angle_0_error"):
        assert np.isfinite(getattr(peaks, name)[0]).tolist() == [True, False, False, False, False]
    assert peaks.snr[0, :2] == pytest.approx([100, 5]) and peaks.snr[0, 4] == 0 and np.isnan(peaks.snr[0, 3])


def test_peaks_of_a_cleaned_cube():
    p = thin(7.0, PAPER) + thin(9.5, PAPER, 0.5, 1.0)
    cleaned = Analyzer(polarized(p, PAPER)).rm_synthesis(WIDE, noise=0.01).clean(cutoff=0.01)
    assert cleaned.cube.peaks().depth[0, 0] == pytest.approx(7, abs=0.15)
    assert cleaned.cube.lambda2_0 == cleaned.dirty.lambda2_0


def test_peaks_are_of_polarization():
    found = Analyzer(cube_of(I=np.ones((33, 1, 1)))).rm_synthesis(WIDE, stokes="I")
    with pytest.raises(InputError, match="peaks are those of Q \\+ iU, this is Stokes I"):
        found.peaks()


# Files ------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("dtype", [np.float32, float])
def test_fits_has_the_planes_axes_and_tables(tmp_path, dtype):
    p = noise(np.random.default_rng(25), 33, 3, 5)
    cube = polarized(p, dtype=dtype)
    cube = StokesCube(cube.data, SHORT * u.Hz, 0.5 * u.arcmin, "K", centre=Direction(2.0, 0.8))
    found = Analyzer(cube).rm_synthesis(AXES["asymmetric"], noise=0.1)
    found.write(tmp_path / "f.fits")
    with fits.open(tmp_path / "f.fits") as hdus:
        head, data = hdus[0].header, hdus[0].data
        assert data.shape == (2, len(found.depths), 3, 5) and data.dtype.itemsize == np.dtype(dtype).itemsize
        assert np.array_equal(data[0] + 1j * data[1], found.data)
        assert [head[f"CTYPE{i}"] for i in range(1, 5)] == ["RA---SIN", "DEC--SIN", "FDEP", "STOKES"]
        assert (head["CUNIT3"], head["CRVAL3"], head["CDELT3"]) == ("rad/m2", -10, 0.25) and head["CRVAL4"] == 2
        assert head["BUNIT"] == "K" and head["LAMSQ0"] == found.lambda2_0 and head["NOISE"] == found.noise
        assert head["FWHM"] == found.fwhm
        sky = cube.wcs.to_header()
        assert all(
            head[k] == pytest.approx(sky[k]) for k in ("CRVAL1", "CRVAL2", "CDELT1", "CDELT2", "CRPIX1", "CRPIX2")
        )
        assert (
            np.array_equal(hdus["RMSF"].data["RMSF"], found.rmsf)
            and len(hdus["RMSF"].data) == 2 * len(found.depths) - 1
        )
        assert np.array_equal(hdus["CHANNELS"].data["FREQ"], SHORT) and hdus["CHANNELS"].data["WEIGHT"].sum() == 33
        assert np.array_equal(hdus["DEPTHS"].data["FDEP"], found.depths)
        hdus.verify("exception")
    assert [x.name for x in tmp_path.iterdir()] == ["f.fits"]


def test_uneven_depths_are_numbered_not_pretended(tmp_path):
    depths = np.array([0.0, 1.0, 5.0])
    found = Analyzer(cube_of(V=np.ones((33, 2, 2)))).rm_synthesis(depths, stokes="V")
    found.write(tmp_path / "v.fits")
    with fits.open(tmp_path / "v.fits") as hdus:
        head = hdus[0].header
        assert (head["CTYPE3"], head["CTYPE4"], head["STOKESIN"]) == ("DEPTHNUM", "COMPLEX", "V")
        assert np.array_equal(hdus["DEPTHS"].data["FDEP"], depths)


def test_maps_of_peaks_as_fits(tmp_path):
    found = Analyzer(polarized(thin([[7.0, 8.0]], PAPER), PAPER)).rm_synthesis(WIDE, noise=0.1)
    peaks = found.peaks()
    peaks.write(tmp_path / "peaks.fits", found)
    with fits.open(tmp_path / "peaks.fits") as hdus:
        assert np.allclose(hdus["DEPTH"].data, peaks.depth, rtol=1e-6) and hdus["DEPTH"].header["BUNIT"] == "rad/m2"
        assert hdus["POLARIZED"].header["BUNIT"] == "K" and hdus["ANGLE"].header["CTYPE1"] == "RA---SIN"


def test_units_at_the_door():
    cube = polarized(thin(7.0))
    with pytest.raises(UnitError, match="depths needs a unit convertible to rad/m2"):
        Analyzer(cube).rm_synthesis([1, 2] * u.m)
    with pytest.raises(UnitError, match="noise needs a unit convertible to K"):
        Analyzer(cube).rm_synthesis(WIDE, noise=1 * u.Jy)
    assert np.array_equal(Analyzer(cube).rm_synthesis([1, 2] * u.rad / u.cm**2).depths, [1e4, 2e4])


# Figures ----------------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def drawn():
    """Two degrees of sky with one bright pixel 0.5 deg east and 0.25 deg north, at depth 7; one pixel without data."""
    p = np.zeros((33, 8, 8), complex) + thin(7.0) * 1e-3
    p[:, 5, 2] = thin(7.0)[:, 0, 0]
    p[:, 0, 0] = np.nan
    cube = StokesCube(polarized(p, I=0.1 * p.real).data, SHORT * u.Hz, 0.25 * u.deg, "K")
    return {s: Analyzer(cube).rm_synthesis(WIDE, stokes=s) for s in "PI"}


def test_slices_show_the_depths_and_circles_by_their_diameter(drawn, tmp_path):
    from instrument.report.faraday import faraday_slices
    from instrument.report.style import save

    figure = faraday_slices(drawn["P"], [7.1, -20] * u.rad / u.m**2)
    bright, dark = figure.axes[:2]
    assert [ax.get_title() for ax in (bright, dark)] == ["$\\phi$ = 7", "$\\phi$ = -20"]
    assert [c.radius for c in bright.patches] == [1.0] and "circles 2 deg across" in figure.get_suptitle()
    image = bright.images[0]
    left, right, bottom, top = image.get_extent()
    row, column = np.unravel_index(np.nanargmax(image.get_array()), (8, 8))
    assert left + (column + 0.5) * (right - left) / 8 == pytest.approx(0.5)
    assert bottom + (row + 0.5) * (top - bottom) / 8 == pytest.approx(0.25)
    assert image.get_clim() == dark.images[0].get_clim()
    assert save(figure, tmp_path / "a.png").stat().st_size > 1000
    with pytest.raises(InputError, match="no Faraday depth"):
        faraday_slices(drawn["P"], [])


def test_lines_of_sight_are_those_of_the_pixel(drawn):
    from instrument.report.faraday import lines_of_sight

    ax = lines_of_sight(drawn, (0.5, 0.25))
    p, i = ax.get_lines()
    assert np.allclose(p.get_ydata(), np.abs(drawn["P"].data[:, 5, 2])) and np.allclose(p.get_xdata(), WIDE)
    assert i.get_ydata().max() == pytest.approx(0.05, rel=0.1)  # half of 0.1 Q at either sign
    assert "0.5 deg east, 0.25 deg north" in ax.get_title()
    with pytest.raises(InputError, match=r"offset \(3, 0\) deg is outside of the 2 x 2 deg of 'P'"):
        lines_of_sight(drawn, (3, 0))
    with pytest.raises(InputError, match="no Faraday cube"):
        lines_of_sight({})
    with pytest.raises(InputError, match="different units"):
        lines_of_sight({"a": drawn["P"], "b": replace(drawn["P"], unit="Jy/beam")})
    lines_of_sight(drawn, (1.0, -1.0), log=False)  # without data


def test_the_rmsf_is_drawn_with_its_width(drawn):
    from instrument.report.faraday import rmsf

    ax = rmsf(drawn["P"])
    assert f"FWHM {drawn['P'].fwhm:.3g}" in [t.get_text() for t in ax.texts]
    modulus = next(line for line in ax.get_lines() if line.get_label() == "|R|")
    assert np.interp(drawn["P"].fwhm / 2, *modulus.get_data()) == pytest.approx(0.5, abs=1e-3)
    one = Analyzer(polarized(np.ones((1, 1, 1), complex), SHORT[:1])).rm_synthesis(WIDE)
    assert not rmsf(one).texts
