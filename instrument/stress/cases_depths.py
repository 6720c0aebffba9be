"""Cases of Faraday depth beside the list: bands, RM-CLEAN, peaks and their errors, noise, spectra taken out."""

from __future__ import annotations

import warnings
from typing import Any

import numpy as np

from instrument.analyze.analyzer import Analyzer
from instrument.analyze.faraday.band import FaradayBand, depth_of_k_par, k_par_of_depth
from instrument.analyze.faraday.cube import FaradayCube
from instrument.image.cube import StokesCube
from instrument.observe.directions import LIGHT
from instrument.stress.case import Answer, both, case, claim, held
from instrument.units import Complex, Float

PAPER: Float = 134e6 + 0.2e6 * np.arange(161.0)
BAND: Float = 134e6 + 0.8e6 * np.arange(41.0)


def squares(freq_hz: Float) -> Float:
    """lambda^2 (F,), m2."""
    return np.asarray((LIGHT / freq_hz) ** 2)


def cube(p: Complex, freq_hz: Float = BAND, i: Any = 0.0, v: Any = 0.0) -> StokesCube:
    """Spectra of Q + iU (F, n) as a cube of one row of n pixels, in K."""
    from astropy import units as u

    data = np.zeros((len(freq_hz), 4, 1, p.shape[1]))
    data[:, 0, 0], data[:, 1, 0], data[:, 2, 0], data[:, 3, 0] = i, p.real, p.imag, v
    return StokesCube(data, freq_hz * u.Hz, 2 * u.arcmin, "K", constants="data")


def _made(p: Complex, depths: Any = None, freq_hz: Float = BAND, **how: Any) -> FaradayCube:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        return Analyzer(cube(p, freq_hz)).rm_synthesis(depths, **{"precision": "double", **how})


def _noise(shape: tuple[int, ...], seed: int = 0) -> Complex:
    return np.asarray(np.random.default_rng(seed).normal(size=(*shape, 2)).view(complex)[..., 0])


@case(
    "RM5", "faraday-depth", "the paper's band: resolution, largest depth and scale", "1.987, 2.179, 2.184; 116; 0.963"
)
def figures(_: None) -> Answer:
    """2 sqrt3 / width, 3.8 / width, the half height of |R| (solved here on 1e6 depths); the paper says 1."""
    from astropy import units as u

    band = FaradayBand.of(PAPER * u.Hz)
    x = squares(PAPER)
    low = (LIGHT / 133.9e6) ** 2 - (LIGHT / 134.1e6) ** 2
    phi = np.linspace(1.0, 1.2, 200001)
    size = np.abs(np.exp(-2j * np.outer(phi[::1000], x - x.mean())).mean(axis=1))
    at = np.searchsorted(-size, -0.5)
    near = phi[::1000][at - 1 : at + 1]
    fine = np.linspace(near[0], near[1], 1001)
    half = fine[np.argmin(np.abs(np.abs(np.exp(-2j * np.outer(fine, x - x.mean())).mean(axis=1)) - 0.5))]
    weight = np.where(np.arange(161) < 80, 2.0, 0.0)
    part = FaradayBand.of(PAPER * u.Hz, weight, 0.1 * u.MHz)
    axis = band.depths()
    k = k_par_of_depth(np.array([1.0, -2.0]), 150 * u.MHz)
    return both(
        held(band.fwhm, 2 * half, 2e-6),
        held(band.fwhm_nominal, 2 * np.sqrt(3) / np.ptp(x), 1e-13),
        held(band.fwhm_sinc, 3.8 / np.ptp(x), 1e-13),
        held(band.phi_max, np.sqrt(3) / low, 1e-12),
        held(band.max_scale, np.pi / x.min(), 1e-13),
        held([band.fwhm, band.phi_max, band.max_scale], [2.184, 116, 0.963], 2e-3),
        held(part.width, np.ptp(x[:80]), 1e-13),
        held(part.phi_max, np.sqrt(3) / (low / 2), 1e-5),
        held(np.diff(axis), band.fwhm / 8, 1e-9),
        held(axis + axis[::-1], 0 * axis, 1e-9, scale=1.0),
        claim(axis[-1] >= band.phi_max > axis[-1] - band.fwhm, f"depths to {axis[-1]}"),
        held(k, [0.0062, -0.0124], 5e-3),
        held(depth_of_k_par(k, 150 * u.MHz), [1.0, -2.0], 1e-13),
    )


@case(
    "RM6",
    "faraday-depth",
    "uneven weights, lambda^2_0 given, a spectral index",
    "the weighted sum as it stands, to 1e-12",
)
def weighted(_: None) -> Answer:
    """F = sum w P (nu/nu0)^-a exp(-2i phi (l2 - l2_0)) / sum w; nu0 is that of the mean lambda^2."""
    rng = np.random.default_rng(1)
    w, p, depths = rng.uniform(0, 2, 41), _noise((41, 5)), np.array([-33.0, -7.5, 0, 7.5, 12.25])
    x = squares(BAND)
    mean = (w * x).sum() / w.sum()
    found = _made(p, depths, weights=w)
    due = np.einsum("f,fn,pf->pn", w, p, np.exp(-2j * np.outer(depths, x - mean))) / w.sum()
    absolute = _made(p, depths, weights=w, lambda2_0=0.0)
    turned = np.einsum("f,fn,pf->pn", w, p, np.exp(-2j * np.outer(depths, x))) / w.sum()
    sloped = _made(p, depths, weights=w, spectral_index=-2.5)
    ratio = BAND / (LIGHT / np.sqrt(mean))
    flat = np.einsum("f,fn,pf->pn", w * ratio**2.5, p, np.exp(-2j * np.outer(depths, x - mean))) / w.sum()
    single = _made(p, np.linspace(-30, 30, 241), precision="single").data[:, 0]
    double = _made(p, np.linspace(-30, 30, 241)).data[:, 0]
    wide = _made(_noise((161, 3)), np.linspace(-20, 20, 401), PAPER, precision="single").data
    exact = _made(_noise((161, 3)), np.linspace(-20, 20, 401), PAPER).data
    return both(
        held(found.lambda2_0, mean, 1e-14),
        held(found.data[:, 0], due, 1e-12),
        held(absolute.data[:, 0], turned, 1e-11),
        held(sloped.data[:, 0], flat, 1e-12),
        held(single, double, 1e-6),
        held(wide, exact, 1e-6),
    )


@case(
    "RM7", "faraday-depth", "Stokes I as it is, and Q, U divided by it", "I R(phi), F(-phi) = conj F; Q/I, U/I to 1e-12"
)
def divided(_: None) -> Answer:
    """I of slope -2.5: by voxel and by the fit; F is multiplied with I at the mean lambda^2 again."""
    x, depths = squares(BAND), np.linspace(-20, 20, 81)
    law = 5 * (BAND / 150e6) ** -2.5
    p = 0.1 * np.exp(2j * 6 * x)[:, None] * law[:, None]
    given = cube(p, i=law[:, None])
    flat = 0.1 * np.exp(2j * np.outer(x - x.mean(), 6 - depths)).mean(axis=0) * np.exp(12j * x.mean())
    at = 5 * (LIGHT / np.sqrt(x.mean()) / 150e6) ** -2.5
    found = [
        Analyzer(given).rm_synthesis(depths, precision="double", divide_by_i=how) for how in ("voxel", "fit", True)
    ]
    real = Analyzer(cube(p, i=np.full((41, 1), 3.0))).rm_synthesis(depths, stokes="I", precision="double")
    due = 3 * np.exp(-2j * np.outer(depths, x - x.mean())).mean(axis=1)
    noisy = Analyzer(cube(_noise((41, 2)), i=np.random.default_rng(1).normal(size=(41, 2)))).rm_synthesis(
        depths, stokes="I", precision="double"
    )
    return both(
        *(held(f.data[:, 0, 0], flat * at, 1e-8) for f in found),
        held(found[0].data[:, 0, 0], flat * at, 1e-12),
        held(real.data[:, 0, 0], due, 1e-12),
        held(noisy.data[::-1], noisy.data.conj(), 1e-12),
    )


@case(
    "RM8",
    "faraday-depth",
    "thin sources on the axis, RM-CLEAN",
    "components sum to their flux, 1e-3; residual below cutoff",
)
def cleaned(_: None) -> Answer:
    """One, and two 10 FWHM apart; flags of its own; cutoff above the peak: no iteration; restored: a Gaussian."""
    x, depths = squares(BAND), np.linspace(-40, 40, 321)
    base = x - x.mean()
    one, two = np.exp(2j * 5 * base), np.exp(2j * 5 * base) + 0.5j * np.exp(-2j * 17 * base)
    p = np.stack([one, two, one, 0 * one], axis=1)
    p[4:9, 2] = np.nan
    made = _made(p, depths)
    found = made.clean(cutoff=1e-3, gain=0.2)
    none = made.clean(cutoff=2.0)
    at, other = np.argmin(np.abs(depths - 5)), np.argmin(np.abs(depths + 17))
    near = slice(at - 1, at + 2)
    total = found.components[:, 0].sum(axis=0)
    beam = np.exp(-4 * np.log(2) * ((depths - 5) / found.fwhm[0, 0]) ** 2)
    there = np.isfinite(p[:, 2].real)
    own = 2 * np.linspace(0.5, 3, 20001)
    size = np.abs(np.exp(-1j * np.outer(own, (x - x[there].mean())[there])).mean(axis=1))
    width = own[np.argmin(np.abs(size - 0.5))]
    back = found.residual[:, 0, 0] + np.array(
        [
            (found.components[:, 0, 0] * np.exp(-2j * np.outer(depths[k] - depths, base)).mean(axis=1)).sum()
            for k in range(321)
        ]
    )
    return both(
        held(total[:2], [1, 1 + 0.5j], 2e-2),
        held(found.components[near, 0, 0].sum(), 1.0, 2e-2),
        held(found.components[other - 1 : other + 2, 0, 1].sum(), 0.5j, 2e-2),
        held(back, made.data[:, 0, 0], 1e-11),
        Answer(float(np.abs(found.residual[:, 0, :3]).max()), 1.01e-3),
        # it ends with the first that is below, not later: a component takes a fifth
        claim(bool((np.abs(found.residual[:, 0, :3]).max(axis=0) > 0.7e-3).all()), "cleaned on below the cutoff"),
        held(np.abs(found.restored[:, 0, 0]), beam, 2e-2),
        claim(not none.iterations.any() and np.array_equal(none.residual, made.data), "iterations below the cutoff"),
        claim(found.converged.all() and found.iterations[0, 3] == 0, f"{found.outcome.ravel().tolist()}"),
        held(found.fwhm[0, 2], width, 1e-3),
        held(found.components[near, 0, 2].sum(), 1.0, 2e-2),
        held(found.cutoff, 1e-3, 1e-12),
    )


@case(
    "RM9", "faraday-depth", "a source with noise, 2000 times", "depth, angle, P: pulls 1 +- 0.08; bias below 0.1 sigma"
)
def peaks(_: None) -> Answer:
    """P = 1 at 7.3 rad/m2, angle 0.4 rad emitted, noise of 0.5 a channel: signal to noise 13."""
    x, depths = squares(BAND), np.arange(-30, 30, 0.25)
    p = np.exp(2j * (0.4 + 7.3 * x))[:, None] + 0.5 * _noise((41, 2000), 3)
    w = np.random.default_rng(4).uniform(0.5, 2, 41)
    answers = []
    for weights in (None, w):
        made = _made(p, depths, weights=weights, noise=0.5)
        found = made.peaks()
        use = found.significant[0]
        sigma = 0.5 / np.sqrt(41) if weights is None else 0.5 * np.sqrt((w**2).sum()) / w.sum()
        off = found.depth[0] - 7.3
        turn = (found.angle[0] - 0.4 + np.pi / 2) % np.pi - np.pi / 2
        middle = (found.angle_0[0] - 0.4 - 7.3 * made.lambda2_0 + np.pi / 2) % np.pi - np.pi / 2
        share = np.ones(41) if weights is None else w
        spread = np.sqrt((share * (x - (share * x).sum() / share.sum()) ** 2).sum() / share.sum())
        answers += [
            claim(use.mean() > 0.99, f"{use.mean():.3f} significant"),
            held(found.noise, sigma, 1e-9),
            *(
                Answer(abs(float((d / e)[use].std()) - 1), 0.08)
                for d, e in (
                    (off, found.depth_error[0]),
                    (turn, found.angle_error[0]),
                    (middle, found.angle_0_error[0]),
                    (found.polarized[0] - 1, found.noise[0]),
                )
            ),
            *(
                Answer(abs(float((d / e)[use].mean())), 0.1)
                for d, e in (
                    (off, found.depth_error[0]),
                    (turn, found.angle_error[0]),
                    (found.polarized[0] - 1, found.noise[0]),
                )
            ),
            held(found.snr, found.peak / found.noise, 0.02),
        ]
        if weights is None:
            answers.append(held(np.median(found.depth_error[0]), sigma / (2 * spread), 0.02))
    return both(*answers)


@case(
    "E4",
    "faraday-depth",
    "two sub-bands of 5 channels; peaks at the edge (E2, E3)",
    "ambiguous, listed, or no peak: never significant",
)
def ambiguous(_: None) -> Answer:
    """Aliases above 0.9; a source beyond the axis; steps wider than a quarter of the RMSF are refused."""
    from instrument.errors import InputError

    freq = np.concatenate([140e6 + 0.05e6 * np.arange(5), 160e6 + 0.05e6 * np.arange(5)])
    x = squares(freq)
    two = _made(np.exp(2j * 3 * x)[:, None] + 0.2 * _noise((10, 1)), np.arange(-20, 20, 0.1), freq, noise=0.2)
    found = two.peaks()
    beyond = _made(
        np.exp(2j * 31 * squares(BAND))[:, None] + 0.01 * _noise((41, 1)), np.arange(-30, 30.1, 0.25), noise=0.01
    )
    edge = beyond.peaks()
    try:
        _made(np.exp(2j * 3 * squares(BAND))[:, None], np.arange(-30, 30, 2.0)).peaks()
        wide = False
    except InputError:
        wide = True
    best = max((h for _d, h in found.aliases), default=0.0)
    quiet = not found.significant.any() and found.ambiguous.all() and np.isnan(found.depth).all()
    return claim(quiet and best > 0.9 and edge.edge.all() and not edge.significant.any() and wide, f"{best}, {wide}")


@case(
    "RM10", "faraday-depth", "noise measured from differences of channels", "that of every channel to 5 %, of F to 3 %"
)
def measured(_: None) -> Answer:
    """Rms 1 to 3 over the band beside sources of 30; few channels; flags make a pixel noisier."""
    sigma = np.linspace(1, 3, 41)
    x = squares(BAND)
    p = 30 * np.exp(2j * np.outer(x, np.linspace(-9, 9, 3000))) + sigma[:, None] * _noise((41, 3000))
    made = _made(p, np.arange(-20, 20, 0.5))
    due = np.sqrt((sigma**2).sum()) / 41
    few = _made(_noise((7, 4000)), np.arange(-5, 5, 0.5), BAND[:7])
    holed = p[:, :200].copy()
    holed[::2, 0] = np.nan
    flagged = _made(holed, np.arange(-20, 20, 0.5), noise=sigma)
    left = np.sqrt((sigma[1::2] ** 2).sum()) / 20
    inside = made.channel_noise[2:-2] / sigma[2:-2]
    return both(
        Answer(abs(made.measured_noise / due - 1), 0.03),
        Answer(float(np.abs(inside - 1).max()), 0.1),
        Answer(abs(few.measured_noise * np.sqrt(7) - 1), 0.05),
        held(flagged.noise_map()[0, 1], due, 1e-9),
        held(flagged.noise_map()[0, 0], left, 1e-9),
        held(made.noise_map(), made.measured_noise, 1e-12),
    )
