"""Weights and flags of single correlations: what they mean for visibilities, Stokes parameters and what uses them."""

import warnings
from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from astropy import units as u
from astropy.coordinates import SkyCoord

import instrument
from instrument import (
    Chain,
    DirectionalCal,
    FeedTerm,
    GainTerm,
    Imager,
    InputError,
    Observation,
    PointSky,
    Scene,
    SelfCal,
    Visibilities,
)
from instrument.analyze.sources.photometry import ForcedPhotometry
from instrument.errors import Outcome
from instrument.visibility_sets import as_set

pytestmark = pytest.mark.filterwarnings("ignore:the PSF")  # few pixels, on purpose
CENTRE = SkyCoord("08h13m36.0s +48d13m03s")
STATIONS = ["CS001HBA0", "CS003HBA1", "CS011HBA0", "CS101HBA0", "CS302HBA1", "RS106HBA"]
SKY = PointSky.at(CENTRE.spherical_offsets_by([0, 1] * u.deg, [0, 0.5] * u.deg), [[3, 0.3, -0.2, 0.1], [2, 0, 0.4, 0]])


@cache
def scene():
    night = Observation(
        phase_centre=CENTRE, transit="2012-12-07", duration=6 * u.hour, interval=1 * u.hour,
        frequencies=[150, 151] * u.MHz, channel_width=0.2 * u.MHz,
    )  # fmt: skip
    return Scene(
        instrument=instrument.load("telescopes", "lofar-hba", beam=None, stations=STATIONS), sky=SKY, observation=night
    )


@cache
def seen():
    return scene().plan(workers=1).run()


def uneven(seed=0, share=0.2):
    """Weights and flags of every correlation, (T, F, B, 2, 2)."""
    rng = np.random.default_rng(seed)
    shape = seen().data.shape
    return rng.uniform(0.2, 2.0, shape), rng.uniform(size=shape) < share


def spoilt(vis, flag, value=np.nan):
    """The same, what is flagged of another value."""
    return vis.with_data(np.where(flag, value, vis.data))


def test_shapes_are_those_of_visibilities_or_of_correlations_and_nothing_else():
    vis = seen()
    weight = np.full(vis.data.shape[:3], 2.0)
    assert np.array_equal(vis.weighted(weight[..., None, None]).weight, weight)  # (T, F, B, 1, 1) is (T, F, B)
    rows = np.array([1.0, 2.0])[:, None]
    assert np.array_equal(vis.weighted(rows[None, None, None]).weight, np.tile(rows, 2)[None, None, None])
    for shape in ((6, 2, 15, 4), (6, 2, 15, 3, 2), (6, 2), (5, 2, 15, 2, 2)):
        with pytest.raises(
            InputError, match=r"weight has shape .* needed \(6, 2, 15\), or \(6, 2, 15, 2, 2\) for each"
        ):
            vis.weighted(np.ones(shape))
        with pytest.raises(InputError, match="flag has shape"):
            replace(vis, flag=np.ones(shape, bool))
    for wrong in (-1.0, np.nan):
        with pytest.raises(InputError, match="not negative"):
            vis.weighted(np.full((1, 1, 1, 2, 2), wrong))


def test_weights_of_a_visibility_and_of_stokes_parameters_are_inverse_variances():
    w = np.array([[1.0, 2.0], [4.0, 0.5]])[None, None, None]
    vis = seen().weighted(w)
    variance = 1 / w[0, 0, 0]  # of pp, pq, qp, qq
    i, u_ = 0.25 * (variance[0, 0] + variance[1, 1]), 0.25 * (variance[0, 1] + variance[1, 0])
    assert np.allclose(vis.stokes_weight[0, 0, 0], 1 / (2 * np.array([i, i, u_, u_])), rtol=1e-15)
    assert np.allclose(vis.whole_weight[0, 0, 0], 1 / variance.mean(), rtol=1e-15)
    flag = np.zeros((1, 1, 1, 2, 2), bool)
    flag[..., 1, 0] = True
    assert np.array_equal(vis.flagged(flag).stokes_weight[0, 0, 0] > 0, [True, True, False, False])
    assert not vis.flagged(flag).whole_weight.any()
    # one weight for all stays one, and is what it was to the last bit
    plain = seen().weighted(np.full((1, 1, 1), 0.3))
    assert plain.stokes_weight.shape[-1] == 1
    apart = plain.weighted(np.full((1, 1, 1, 2, 2), 0.3))
    assert np.array_equal(apart.whole_weight, plain.effective_weight)
    assert np.array_equal(apart.stokes_weight, np.repeat(plain.stokes_weight, 4, axis=-1))


def test_flags_of_both_shapes_add_up_and_blocks_are_cut():
    vis, (weight, flag) = seen(), uneven()
    whole = np.zeros((6, 1, 1), bool)
    whole[2] = True
    both = vis.flagged(whole).flagged(flag)
    assert np.array_equal(both.flag, flag | whole[..., None, None])
    assert np.array_equal(vis.flagged(flag).flagged(whole).flag, both.flag)
    part = both.weighted(weight).block(slice(1, 4), slice(1, 2))
    assert np.array_equal(part.flag, both.flag[1:4, 1:2])
    assert np.array_equal(part.weight, weight[1:4, 1:2])
    assert np.array_equal((vis.flagged(flag) - vis.flagged(whole)).flag, both.flag)
    assert np.array_equal((vis.flagged(whole) + vis.flagged(flag)).flag, both.flag)
    assert "flagged" in repr(both)


def test_one_number_that_is_not_finite_spoils_its_correlation_alone_where_correlations_count():
    vis = seen()
    data = np.array(vis.data)
    data[1, 0, 3, 0, 1] = np.nan
    assert vis.with_data(data).effective_weight[1, 0, 3] == 0
    apart = vis.with_data(data).weighted(np.ones((1, 1, 1, 2, 2))).effective_weight
    assert np.array_equal(apart[1, 0, 3], [[1, 0], [1, 1]])
    assert apart.sum() == apart.size - 1


@pytest.mark.parametrize("weighting", ["natural", "briggs"])
def test_an_image_of_a_stokes_parameter_is_that_with_its_own_weights(weighting):
    weight, flag = uneven()
    vis = spoilt(seen(), flag).weighted(weight).flagged(flag)
    imager = Imager(pixels=32, pixel=0.5 * u.arcmin, weighting=weighting, accuracy=1e-10)
    cube = imager.image([vis.block(slice(0, 2), slice(None)), vis.block(slice(2, 6), slice(None))])
    for k in range(4):
        one = imager.image(seen().weighted(vis.stokes_weight[..., k]))
        assert np.abs(cube.data[:, k] - one.data[:, k]).max() < 1e-9  # the accuracy asked for, of 5 Jy
        if k == 0:
            assert np.abs(cube.psf.data - one.psf.data).max() < 1e-9
    with warnings.catch_warnings(record=True) as said:
        warnings.simplefilter("always")
        imager.image(vis)
        imager.image(seen().weighted(np.array([[1.0, 0.5], [0.5, 1.0]])[None, None, None]))  # other weights, one PSF
    assert len([w for w in said if "the PSF of U and V differs by" in str(w.message)]) == 1
    wrong = imager.image(seen().weighted(vis.whole_weight)).data
    assert np.abs(cube.data - wrong).max() > 1e-2


def test_blocks_with_and_without_weights_of_correlations_are_imaged_together():
    vis, (weight, _) = seen(), uneven()
    first, last = vis.block(slice(0, 3), slice(None)), vis.block(slice(3, 6), slice(None))
    for weighting in ("natural", "briggs"):
        imager = Imager(pixels=32, pixel=0.5 * u.arcmin, weighting=weighting, accuracy=1e-10)
        mixed = imager.image([first, last.weighted(weight[3:])]).data
        due = imager.image(vis.weighted(np.concatenate([np.ones_like(weight[:3]), weight[3:]]))).data
        assert np.abs(mixed - due).max() < 1e-9


def test_a_stokes_parameter_that_is_nowhere_known_has_no_image_and_no_flux():
    flag = np.zeros((1, 1, 1, 2, 2), bool)
    flag[..., 0, 1] = True
    vis = spoilt(seen(), np.broadcast_to(flag, seen().data.shape)).flagged(flag)
    cube = Imager(pixels=32, pixel=0.5 * u.arcmin).image(vis)
    plain = Imager(pixels=32, pixel=0.5 * u.arcmin).image(seen())
    assert np.isnan(cube.data[:, 2:]).all()
    assert np.abs(cube.data[:, :2] - plain.data[:, :2]).max() < 1e-5
    found = ForcedPhotometry().measure(vis, SKY)
    assert np.isnan(found.stokes_jy[..., 2:]).all()
    assert np.abs(found.stokes_jy[..., :2] - SKY.stokes_jy[:, :2]).max() < 1e-9
    assert found.outcome == (Outcome.REFUSED,) * 2


def test_fluxes_are_those_of_each_stokes_parameter_with_its_own_weights():
    weight, flag = uneven()
    vis = seen().with_noise(300 * u.Jy, seed=1)
    apart = spoilt(vis, flag).weighted(weight).flagged(flag)
    blocks = [vis.block(slice(0, 1), slice(None)), apart.block(slice(1, 6), slice(None))]  # the first: all alike
    found = ForcedPhotometry().measure(blocks, SKY)
    every = np.concatenate([np.ones((1, *weight.shape[1:3], 4)), apart.stokes_weight[1:]])
    for k in range(4):
        one = ForcedPhotometry().measure(vis.weighted(every[..., k]), SKY)
        assert np.abs(found.stokes_jy[..., k] - one.stokes_jy[..., k]).max() < 1e-9
        assert np.abs(found.error_jy[..., k] - one.error_jy[..., k]).max() < 1e-9
    assert np.abs(found.stokes_jy - ForcedPhotometry().measure(vis, SKY).stokes_jy).max() > 1e-3


@pytest.mark.parametrize("seed", range(4))
def test_an_axis_of_length_1_means_that_all_along_it_are_alike(seed):
    rng, vis = np.random.default_rng(seed), seen()
    shapes = [tuple(n if rng.uniform() < 0.5 else 1 for n in vis.data.shape) for _ in range(2)]
    weight, flag = rng.uniform(0.2, 2, (*shapes[0][:3], 2, 2)), rng.uniform(size=shapes[1][: 5 if seed else 3]) < 0.2
    some = spoilt(vis, rng.uniform(size=vis.data.shape) < 0.02)
    short, whole = some.weighted(weight).flagged(flag), np.ones(vis.data.shape)
    long = some.weighted(weight * whole).flagged((flag if seed else flag[..., None, None]) & (whole > 0))
    term = Chain(GainTerm(rms=0.2, seed=1), FeedTerm(rms=0.2, seed=2))
    for change in (lambda v: v, lambda v: v.corrected(term), lambda v: v.averaged(time=2 * u.hour, channels=2)):
        one, other = change(short), change(long)
        assert np.abs(one.stokes_weight - other.stokes_weight).max() < 1e-13
        known = other.effective_weight > 0
        assert known.any()
        assert np.abs(np.where(known, one.data, 0) - np.where(known, other.data, 0)).max() < 1e-13


def test_corrections_keep_what_is_not_known_out_of_what_is():
    """A diagonal matrix leaves a flagged correlation where it is; a full one flags all that it reaches."""
    vis = seen()
    flag = np.zeros(vis.data.shape, bool)
    flag[..., 3, 0, 1] = True
    bad = spoilt(vis, flag).flagged(flag)
    gains, full = GainTerm(rms=0.2, seed=1), Chain(GainTerm(rms=0.2, seed=1), FeedTerm(rms=0.2, seed=2))
    for change in (lambda v, term: v.corrected(term), lambda v, term: v.corrupted(term)):
        found, due = change(bad, gains), change(vis, gains)
        assert np.array_equal(found.flag, flag)
        assert np.abs(np.where(flag, 0, found.data - due.data)).max() < 1e-13
        found, due = change(bad, full), change(vis, full)
        assert np.array_equal(found.flag.any(axis=(0, 1, 3, 4)), np.arange(15) == 3)
        assert found.flag[:, :, 3].all()
        assert np.isfinite(found.data).all()
        assert np.abs(np.where(found.flag, 0, found.data - due.data)).max() < 1e-13


def test_weights_of_corrected_correlations_are_inverse_to_their_noise():
    """The response to 1 Jy in each correlation alone gives the variance of each corrected one, sum_k |R_k|^2 / w_k."""
    vis, w = seen(), np.array([[1.0, 0.1], [2.0, 0.5]])
    term = Chain(GainTerm(rms=0.3, seed=1), FeedTerm(rms=0.5, seed=2))
    unit = np.eye(4).reshape(4, 2, 2)
    power = [np.abs(vis.with_data(np.tile(e, (6, 2, 15, 1, 1)) + 0j).corrected(term).data) ** 2 for e in unit]
    variance = sum(p / w_k for p, w_k in zip(power, w.ravel(), strict=True))
    # the whole scale is left as it was (docs/conventions.md): what equal weights of 1 would get is divided out
    found = vis.weighted(w[None, None, None]).corrected(term).weight
    assert np.abs(found * variance / sum(power) - 1).max() < 1e-13
    assert np.ptp(found) > 0.3
    same = vis.weighted(np.full((1, 1, 1, 2, 2), 0.7)).corrected(term).weight
    assert np.abs(same - 0.7).max() < 1e-15


def test_extreme_weights_are_carried_and_zero_ones_reach_what_they_are_mixed_into():
    vis = seen()
    full = Chain(GainTerm(rms=0.2, seed=1), FeedTerm(rms=0.2, seed=2))
    w = np.array([[1e-99, 1e99], [1.0, 0.0]])[None, None, None]
    diagonal = vis.weighted(w).corrected(GainTerm(rms=0.2, seed=1)).weight
    assert np.abs(diagonal / np.where(w > 0, w, 1) - (w > 0)).max() < 1e-14
    assert not vis.weighted(w).corrected(full).weight.any()
    assert np.isfinite(vis.weighted(np.where(w > 0, w, 1.0)).corrected(full).weight).all()


@pytest.mark.parametrize("solver", [SelfCal(), DirectionalCal(tolerance=1e-9)], ids=["selfcal", "directional"])
def test_a_solve_takes_visibilities_of_which_all_correlations_are_known(solver):
    few = slice(0, 2), slice(0, 1)
    vis, weight, flag = seen().block(*few), *(x[few] for x in uneven(share=0.05))
    assert flag.any() and not flag.any(axis=(-2, -1)).all()
    data = vis.corrupted(Chain(GainTerm(rms=0.1, seed=1), FeedTerm(rms=0.1, seed=2)))
    found = solver.solve(spoilt(data, flag).weighted(weight).flagged(flag), vis)
    assert found.converged.all()
    some = 100 * flag.any(axis=(-2, -1)).mean()
    assert f"{some:.2g} % of the visibilities are left out: not all of their correlations are known" in str(found)
    assert "left out" not in str(solver.solve(data.flagged(flag.any(axis=(-2, -1))), vis))
    corrected = spoilt(data, flag).weighted(weight).flagged(flag).corrected(found.term)
    assert np.abs(np.where(corrected.flag, 0, corrected.data - vis.data)).max() < 1e-8


def test_they_are_saved_and_read_back_to_the_last_bit_block_by_block(tmp_path):
    weight, flag = uneven()
    vis = spoilt(seen(), flag).weighted(weight).flagged(flag)
    few = vis.weighted(weight[:1, :1, :1])  # constant but for the correlations
    for k, one in enumerate((vis, few)):
        path = tmp_path / f"{k}.h5"
        one.save(path)
        back = Visibilities.open(path)
        assert back.weight.tobytes() == one.weight.tobytes() and back.weight.shape == one.weight.shape
        assert np.array_equal(back.flag, one.flag)
        blocks = tmp_path / f"{k} blocks.h5"
        as_set([one.block(slice(t, t + 2), slice(f, f + 1)) for t in (0, 2, 4) for f in (0, 1)]).save(blocks)
        back = Visibilities.open(blocks, times=slice(1, 5))
        assert np.array_equal(
            np.broadcast_to(back.weight, back.data.shape), np.broadcast_to(one.weight, vis.data.shape)[1:5]
        )
        assert np.array_equal(back.flag, one.flag[1:5])
    with pytest.raises(InputError, match="some blocks have flag for each correlation and others have not"):
        as_set([vis.block(slice(0, 3), slice(None)), seen().block(slice(3, 6), slice(None)).weighted(weight[3:])]).save(
            tmp_path / "mixed.h5"
        )
    assert not (tmp_path / "mixed.h5").exists()


def test_the_check_of_a_plan_passes_over_flagged_correlations_and_no_others():
    plan = scene().plan(workers=1)
    _, flag = uneven()
    vis = spoilt(seen(), flag, 1e6)
    assert plan.verify(vis.flagged(flag)).passed
    assert not plan.verify(vis).passed


def test_noise_is_the_same_whatever_the_weights():
    weight, flag = uneven()
    noisy = seen().weighted(weight).flagged(flag).with_noise(100 * u.Jy, seed=2)
    assert np.array_equal(noisy.data, seen().with_noise(100 * u.Jy, seed=2).data)
    assert np.array_equal(noisy.weight, weight)
    assert np.array_equal(noisy.stokes()[..., 0], (noisy.data[..., 0, 0] + noisy.data[..., 1, 1]) / 2)
