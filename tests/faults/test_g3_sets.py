"""G3 and the house: given UVW, lengths by time and channel, sets of blocks."""

from dataclasses import replace

import numpy as np
import pytest
from astropy import units as u
from astropy.coordinates import SkyCoord

import instrument as ins
from instrument.errors import InputError
from instrument.visibility_sets import as_set

CENTRE = "08h13m36.0s +48d13m03s"
SKY = ins.PointSky.at(SkyCoord([123.4, 124.2], [48.2, 48.9], unit="deg"), [[3.0, 0, 0.5, 0], [1.0, 0.2, 0, 0]])


@pytest.fixture(scope="module")
def plan():
    """Five stations, four times, three channels; blocks of one cell would be too easy to confuse, so of the plan."""
    rng = np.random.default_rng(3)
    enu = np.c_[rng.uniform(-300, 300, (5, 2)), np.zeros(5)] * u.m
    layout = ins.Layout.from_enu([f"s{k}" for k in range(5)], enu, 6.9 * u.deg, 52.9 * u.deg, 10 * u.m)
    observation = ins.Observation(
        phase_centre=CENTRE, transit="2012-12-07", duration=40 * u.s, interval=10 * u.s,
        frequencies=[150, 150.2, 150.4] * u.MHz,
    )  # fmt: skip
    return ins.Scene(instrument=ins.Composed(stations=layout), sky=SKY, observation=observation).plan()


@pytest.fixture(scope="module")
def vis(plan):
    return plan.run()


@pytest.fixture(scope="module")
def turned(vis):
    """The data of coordinates turned by 1e-3 rad about w, and their UVW: as of a file in another frame."""
    angle = 1e-3
    turn = np.array([[np.cos(angle), np.sin(angle), 0], [-np.sin(angle), np.cos(angle), 0], [0, 0, 1]])
    uvw = vis.uvw_m @ turn.T
    where = vis.at.towards(SKY.ra_rad, SKY.dec_rad).lmn
    cycles = np.einsum("tbc,sc->tbs", uvw, where)[:, None] * (vis.freq_hz / 299792458.0)[None, :, None, None]
    bright = SKY.brightness(vis.at.towards(SKY.ra_rad, SKY.dec_rad))
    data = np.einsum("tfbs,tfsij->tfbij", np.exp(-2j * np.pi * cycles), np.broadcast_to(bright, (4, 3, 2, 2, 2)))
    return replace(vis, data=data, given_uvw_m=uvw)


def test_given_uvw_are_those_that_images_are_made_with(vis, turned):
    imager = ins.Imager(pixels=64, pixel=2 * u.arcmin, accuracy=1e-9)
    x, y, pixel = 20, 45, np.deg2rad(2 / 60)
    l, m = -(x - 32) * pixel, (y - 32) * pixel
    where = np.array([l, m, np.sqrt(1 - l**2 - m**2) - 1])
    stokes_i = turned.stokes()[:, 0, :, 0]
    due = (stokes_i * np.exp(2j * np.pi * (turned.given_uvw_m @ where) * vis.freq_hz[0] / 299792458.0)).real.mean()
    assert imager.image(turned).data[0, 0, y, x] == pytest.approx(due, abs=1e-7)
    assert abs(imager.image(replace(turned, given_uvw_m=None)).data[0, 0, y, x] - due) > 1e-4


def test_given_uvw_are_those_of_photometry(turned):
    found = ins.Analyzer(visibilities=turned, sky=SKY).leakage()
    assert found is not None
    from instrument.analyze.sources.photometry import ForcedPhotometry

    flux = ForcedPhotometry().measure(turned, SKY).stokes_jy
    wrong = ForcedPhotometry().measure(replace(turned, given_uvw_m=None), SKY).stokes_jy
    assert np.abs(flux - SKY.stokes_jy).max() < 1e-8
    assert np.abs(wrong - SKY.stokes_jy).max() > 1e-6


def test_given_uvw_that_do_not_close_are_refused_where_stations_are_needed(turned):
    from instrument.analyze.sources.photometry import ForcedPhotometry

    uvw = turned.given_uvw_m + 1e-3 * np.random.default_rng(0).standard_normal(turned.given_uvw_m.shape)
    with pytest.raises(InputError, match="do not close around triangles"):
        ForcedPhotometry().measure(replace(turned, given_uvw_m=uvw), SKY)


def test_data_with_uvw_of_their_own_are_not_held_against_a_plan(plan, vis, turned):
    with pytest.raises(InputError, match=r"have UVW of their own, up to .* m from those that a plan works out"):
        plan.verify(turned)
    assert plan.verify(replace(vis, given_uvw_m=vis.uvw_m)).passed


def test_given_uvw_stay_through_everything_and_are_compared(vis, turned):
    gains = ins.GainTerm(rms=0.1, seed=1)
    for one in (
        turned.with_noise(10 * u.Jy, seed=1),
        turned.corrupted(gains).corrected(gains),
        turned.weighted([[[2.0]]]),
    ):
        assert np.array_equal(one.uvw_m, turned.given_uvw_m)
    assert np.array_equal(turned.block(slice(1, 3), slice(0, 1)).uvw_m, turned.given_uvw_m[1:3])
    with pytest.raises(InputError, match="other"):
        turned - vis
    for shape in ((4, 10), (4, 9, 3)):
        with pytest.raises(InputError, match="given_uvw_m has shape"):
            replace(vis, given_uvw_m=np.zeros(shape))


def test_lengths_of_integrations_and_channels_count_one_by_one(vis):
    long, wide = [10.0, 10.0, 10.0, 40.0], [1e5, 1e5, 4e5]
    uneven = replace(vis, interval_s=long, width_hz=wide)
    sigma = uneven.noise_jy(100 * u.Jy)
    assert sigma.shape == (4, 3)
    assert sigma[3, 2] == pytest.approx(sigma[0, 0] / 4)
    many = replace(uneven, data=np.zeros_like(vis.data))
    drawn = np.stack([many.with_noise(100 * u.Jy, seed=k).data for k in range(60)])
    rms = np.sqrt((np.abs(drawn) ** 2).mean(axis=(0, 3, 4, 5)) / 2)
    assert np.abs(rms / sigma - 1).max() < 0.06  # 2400 draws of two parts: 1.4 %, four of them
    part = uneven.block(slice(2, 4), slice(1, 3))
    assert part.interval_s.tolist() == [10, 40] and part.width_hz.tolist() == [1e5, 4e5]
    assert vis.block(slice(2, 4), slice(1, 3)).interval_s.tolist() == [10]


@pytest.mark.parametrize(
    ("wrong", "text"),
    [
        ({"interval_s": [10.0, 10.0]}, r"interval_s has shape \(2,\), needed one number or \(4,\)"),
        ({"width_hz": [1e5, -1e5, 1e5]}, "width_hz = -100000 must be a finite number above 0"),
        ({"width_hz": [[1e5]]}, "width_hz has shape"),
    ],
)
def test_wrong_lengths_are_one_line(vis, wrong, text):
    with pytest.raises(InputError, match=text):
        replace(vis, **wrong)


def test_a_plan_and_visibilities_are_sets(plan, vis):
    imager = ins.Imager(pixels=32, pixel=4 * u.arcmin, weighting="uniform")
    want = imager.image(vis).data
    for given in (plan, [vis], as_set([*plan.blocks()]), [vis.block(slice(k, k + 1), slice(None)) for k in range(4)]):
        assert np.abs(imager.image(given).data - want).max() < 1e-5
    assert isinstance(plan, ins.VisibilitySet) and isinstance(vis, ins.VisibilitySet)
    assert all(np.array_equal(a.data, b.data) for a, b in zip(plan.blocks(), plan.blocks(), strict=True))
    assert plan.verify(plan).passed


def test_one_pass_over_an_iterator_is_taken_and_a_second_refused_before_the_first(plan):
    grid = {"pixels": 32, "pixel": 4 * u.arcmin}
    assert ins.Imager(**grid).image(plan.blocks()).data.shape == (3, 4, 32, 32)
    blocks = plan.blocks()
    with pytest.raises(InputError, match="briggs weights go over the visibilities twice: these blocks can be gone"):
        ins.Imager(**grid, weighting="briggs").image(blocks)
    assert len([*blocks]) == len([*plan.blocks()])  # none was taken
    once = as_set(plan.blocks())
    assert [*once.blocks()]
    with pytest.raises(InputError, match="second pass"):
        [*once.blocks()]
    with pytest.raises(InputError, match="a float stands among the blocks"):
        ins.Imager(**grid).image([1.0])


def test_what_is_not_finite_has_no_weight_in_a_coverage(vis):
    data = np.array(vis.data)
    data[1, 2, 3, 0, 0] = np.nan
    (one,) = vis.with_data(data).coverage()
    assert one.effective_weight[1, 2, 3] == 0 and one.effective_weight.sum() == data.size / 4 - 1
