"""RM-Tools and this package on the same spectra: where it is right we agree, where it is not we are right."""

import warnings

import numpy as np
import pytest
from astropy import units as u

from instrument import Analyzer, StokesCube
from instrument.observe.directions import LIGHT

pytestmark = pytest.mark.peer
rm_tools = pytest.importorskip("RMutils.util_RM")

FREQ = 134e6 + 0.2e6 * np.arange(161)
L2 = (LIGHT / FREQ) ** 2
WIDE = np.linspace(-50, 50, 401)


def quiet(*text, **more):
    """RM-Tools prints by default."""


def spectra(shape=(6, 7), seed=1, freq=FREQ, noise=0.1):
    """P of three thin sources and noise in every pixel (F, Ny, Nx)."""
    rng = np.random.default_rng(seed)
    depth, angle, amplitude = rng.uniform(-20, 20, (3, *shape)), *rng.uniform(0.2, 1, (2, 3, *shape))
    p = (amplitude * np.exp(2j * (angle + np.multiply.outer((LIGHT / freq) ** 2, depth)))).sum(axis=1)
    return p + noise * (rng.normal(size=p.shape) + 1j * rng.normal(size=p.shape))


def ours(p, depths=WIDE, freq=FREQ, **settings):
    data = np.zeros((len(p), 4, *p.shape[1:]))
    data[:, 1], data[:, 2] = p.real, p.imag
    return Analyzer(StokesCube(data, freq * u.Hz, 0.5 * u.arcmin, "K")).rm_synthesis(depths, **settings)


def theirs(p, depths=WIDE, freq=FREQ, weights=None, eps=1e-12):
    weights = np.ones(len(freq)) if weights is None else weights
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        return rm_tools.do_rmsynth_planes(
            p.real, p.imag, (LIGHT / freq) ** 2, depths, weights, nBits=64, eps=eps, log=quiet
        )


def worst(a, b):
    return np.nanmax(np.abs(a - b)) / np.nanmax(np.abs(b))


@pytest.mark.parametrize("weighted", [False, True])
def test_synthesis_agrees_on_symmetric_axes(weighted):
    """With its transforms at 1e-12 both agree to 1e-10; at its default of 1e-6 to 1e-5."""
    p, weights = spectra(), np.random.default_rng(2).uniform(0.3, 1, 161) if weighted else None
    found = ours(p, weights=weights)
    exact, default = theirs(p, weights=weights), theirs(p, weights=weights, eps=1e-6)
    assert worst(found.data, exact.FDFcube) < 1e-10 and worst(found.data, default.FDFcube) < 1e-5
    assert found.lambda2_0 == pytest.approx(exact.lam0Sq_m2, rel=1e-14)
    single = ours(p, weights=weights, precision="single")
    assert worst(single.data, default.FDFcube) < 1e-5


def test_flagged_voxels_and_channels_agree():
    p = spectra()
    p[np.random.default_rng(3).random(p.shape) < 0.3] = np.nan
    p[[5, 60]] = np.nan
    found, peer = ours(p), theirs(p)
    assert worst(found.data, peer.FDFcube) < 1e-10
    assert found.lambda2_0 == pytest.approx(peer.lam0Sq_m2, rel=1e-14)


def test_the_rmsf_and_its_width_agree():
    found = ours(spectra())
    peer = rm_tools.get_rmsf_planes(L2, found.rmsf_depths, nBits=64, eps=1e-12, log=quiet)
    assert np.abs(found.rmsf - np.squeeze(peer.RMSFcube)).max() < 1e-10
    assert found.band.fwhm_sinc == pytest.approx(float(np.squeeze(peer.fwhmRMSFArr)), rel=1e-3)


def test_clean_agrees():
    """Same loop, same gain and cutoff: the same iterations, components and residuals; the Gaussian of its own FWHM."""
    p = spectra((4, 5))
    found = ours(p)
    step = np.arange(-401, 402) * 0.25
    fwhm = np.full((4, 5), found.fwhm)
    rmsf = np.broadcast_to(found.rmsf_at(step)[:, None, None], (803, 4, 5))
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        peer = rm_tools.do_rmclean_hogbom(
            found.data, WIDE, rmsf, step, fwhm, 0.1, 1000, 0.1, nBits=64, window=0.1, log=quiet
        )
    cleaned = found.clean(cutoff=0.1)
    assert np.array_equal(cleaned.iterations, peer.iterCountArr) and cleaned.iterations.min() > 10
    assert worst(cleaned.components, peer.ccArr) < 1e-10 and worst(cleaned.residual, peer.residFDF) < 1e-10
    assert worst(cleaned.restored, peer.cleanFDF) < 1e-10


# Where it is wrong --------------------------------------------------------------------------------------------------


def test_an_axis_that_is_not_symmetric_is_right():
    """A source at +7 on an axis -10..50: RM-Tools 1.5 has it at the mirrored place, 47."""
    p = np.exp(2j * 7 * L2)[:, None, None] * np.ones((1, 2))
    depths = np.arange(-10, 50.1, 0.25)
    assert depths[np.argmax(np.abs(theirs(p, depths).FDFcube[:, 0]))] == 47
    assert (np.argmax(np.abs(ours(p, depths).data), axis=0) == np.flatnonzero(depths == 7)).all()


def test_a_spectrum_of_zeros_is_zero():
    p = spectra((1, 2))
    p[:, 0, 0] = 0
    assert np.isnan(theirs(p).FDFcube[:, 0]).all()
    assert not ours(p).data[:, 0, 0].any()


def test_axes_of_length_one_are_kept():
    p = spectra((1, 5))
    assert theirs(p).FDFcube.shape == (401, 5) and ours(p).data.shape == (401, 1, 5)


def test_a_weak_component_beside_a_bright_one():
    """1e6 : 1: its transforms are good to 1e-6 of the bright one by default, a product to 1e-9 of the weak one."""
    p = (1e6 * np.exp(-2j * 30 * L2) + np.exp(2j * 20 * L2))[:, None, None] * np.ones((1, 2))
    exact = np.exp(-2j * np.outer(WIDE, L2 - L2.mean())) @ p[:, 0, 0] / 161
    assert (
        np.abs(ours(p).data[:, 0, 0] - exact).max()
        < 1e-9
        < 0.01
        < np.abs(theirs(p, eps=1e-6).FDFcube[:, 0] - exact).max()
    )


def test_clean_stops_at_the_cutoff_with_the_defaults():
    """Its own default `window=0` cleans every spectrum to the limit of iterations."""
    found = ours(spectra((1, 2)))
    step = np.arange(-401, 402) * 0.25
    rmsf = np.broadcast_to(found.rmsf_at(step)[:, None, None], (803, 1, 2))
    peer = rm_tools.do_rmclean_hogbom(
        found.data, WIDE, rmsf, step, np.full((1, 2), 2.18), 0.1, 1000, 0.1, nBits=64, log=quiet
    )
    assert (np.atleast_1d(peer.iterCountArr) == 1000).all()
    assert found.clean(cutoff=0.1).iterations.max() < 300


def test_no_data_and_one_channel():
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        one = rm_tools.get_rmsf_planes(L2[:1], np.arange(-5.0, 6), nBits=64, log=quiet)
    assert not np.isfinite(np.squeeze(one.fwhmRMSFArr)) or np.squeeze(one.fwhmRMSFArr) == 0
    assert ours(spectra()[:1], freq=FREQ[:1]).fwhm == np.inf
