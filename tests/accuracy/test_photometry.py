"""Forced photometry: fluxes that were put in come out, by either way of solving; what cannot be measured says so."""

from dataclasses import replace

import numpy as np
import pytest
from astropy import units as u
from astropy.coordinates import SkyCoord

import instrument
from instrument import Analyzer, Observation, Outcome, PointSky, Scene, Towards
from instrument.analyze.sources.leakage import expected_percent
from instrument.analyze.sources.photometry import ForcedPhotometry

CENTRE = SkyCoord("08h13m36.0s +48d13m03s")
STATIONS = ["CS001HBA0", "CS003HBA1", "CS011HBA0", "CS101HBA0", "CS302HBA1", "RS106HBA", "RS205HBA", "RS508HBA"]


def night(interval=5 * u.min, frequencies=(150,)):
    return Observation(
        phase_centre=CENTRE, transit="2012-12-07", duration=8 * u.hour, interval=interval,
        frequencies=frequencies * u.MHz, channel_width=0.2 * u.MHz,
    )  # fmt: skip


def polarized(count=30, seed=1, shapes=False, patches=False):
    rng = np.random.default_rng(seed)
    where = CENTRE.spherical_offsets_by(rng.uniform(-4, 4, count) * u.deg, rng.uniform(-4, 4, count) * u.deg)
    flux = rng.normal(size=(count, 4))
    flux[0] = 1e3, 0, 0, 0  # a bright neighbour
    extra = {}
    if shapes:
        extra = {
            k: np.where(np.arange(count) < 4, v, 0.0)
            for k, v in (("major_rad", 2e-5), ("minor_rad", 1e-5), ("angle_rad", 1.0))
        }
    if patches:
        extra["patches"] = ("pair", "pair", *[""] * (count - 2))
    return PointSky.at(where, flux, **extra)


def bare(sky, **observation):
    array = instrument.load("telescopes", "lofar-hba", beam=None, stations=STATIONS)
    return Scene(instrument=array, sky=sky, observation=night(**observation)).plan().run()


@pytest.mark.parametrize("shapes", [False, True])
def test_fluxes_come_out_as_they_went_in(shapes):
    sky = polarized(shapes=shapes)
    found = ForcedPhotometry(accuracy=1e-12).measure(bare(sky), sky)
    assert found.outcome == (Outcome.CONVERGED,)
    # the 1000 Jy neighbour would drown the rest at 1e-2 of itself if its sidelobes were not solved for
    assert np.abs(found.stokes_jy[0] - sky.stokes_jy).max() < 1e-6


def test_conjugate_gradients_and_the_psf_matrix_agree():
    sky = polarized()
    vis = bare(sky)
    direct = ForcedPhotometry().measure(vis, sky)
    # weights that differ in nothing but their shape go the other way
    uneven = np.ones((1, 1, len(vis.antenna1)))
    uneven[..., 0] = 1 + 1e-9
    iterated = ForcedPhotometry(accuracy=1e-13).measure(vis.weighted(uneven), sky)
    assert iterated.iterations > 0
    assert direct.iterations == 0
    assert np.abs(direct.stokes_jy - iterated.stokes_jy).max() < 1e-6


def test_sources_of_a_patch_are_measured_as_one():
    sky = polarized(patches=True)
    sky = sky.with_fields(stokes_jy=np.vstack([[[3, 0, 0, 0], [1, 0, 0, 0]], sky.stokes_jy[2:]]))
    found = ForcedPhotometry().measure(bare(sky), sky)
    assert found.names[0] == "pair"
    assert len(found.names) == len(sky) - 1
    assert found.stokes_jy[0, 0] == pytest.approx([4, 0, 0, 0], abs=1e-8)


def test_flagged_and_nan_data_do_not_enter():
    sky = polarized()
    vis = bare(sky)
    data = np.array(vis.data)
    data[3, 0, 5] = np.nan
    data[7, 0, 2] = 1e9
    flag = np.zeros(data.shape[:3], bool)
    flag[7, 0, 2] = True
    found = ForcedPhotometry(accuracy=1e-12).measure(vis.with_data(data).flagged(flag), sky)
    assert np.abs(found.stokes_jy[0] - sky.stokes_jy).max() < 1e-6


def test_what_cannot_be_measured_says_so():
    sky = polarized(count=3)
    vis = bare(sky)
    nothing = ForcedPhotometry().measure(vis.flagged(np.ones((1, 1, 1), bool)), sky)
    assert nothing.outcome == (Outcome.REFUSED,)
    assert np.isnan(nothing.stokes_jy).all()
    twins = sky.select([0, 1, 1])
    assert ForcedPhotometry().measure(vis, twins).outcome == (Outcome.SINGULAR,)


def test_every_nth_integration_gives_the_same_constant_fluxes_in_every_channel():
    sky = polarized()
    vis = bare(sky, frequencies=(140, 150))
    found = ForcedPhotometry(every=7).measure(vis, sky)
    assert found.stokes_jy.shape == (2, 30, 4)
    assert np.abs(found.stokes_jy - sky.stokes_jy).max() < 1e-6


def test_leakage_of_a_source_alone_is_the_mean_mueller_matrix():
    sky = PointSky.at(CENTRE.spherical_offsets_by(2 * u.deg, 1.5 * u.deg), [1.0])
    lofar = instrument.load("telescopes", "lofar-hba", stations=STATIONS)
    plan = Scene(instrument=lofar, sky=sky, observation=night()).plan()
    vis = plan.run().corrected(Towards(chain=lofar.chain()))
    leak = Analyzer(visibilities=vis, sky=sky).leakage()
    want = expected_percent(lofar.chain(), plan.full.at, sky.stokes_jy)[0]
    assert leak.linear_percent[0] == pytest.approx(want[0], rel=1e-9)
    assert leak.circular_percent[0] == pytest.approx(want[1], rel=1e-6)
    assert 0.1 < want[0] < 2


def test_a_source_alone_at_the_centre_has_no_leakage_to_rounding():
    sky = PointSky.at(CENTRE.reshape(1), [100.0])
    lofar = instrument.load("telescopes", "lofar-hba", stations=STATIONS)
    vis = Scene(instrument=lofar, sky=sky, observation=night()).plan().run().corrected(Towards(chain=lofar.chain()))
    leak = Analyzer(visibilities=vis, sky=sky).leakage()
    assert leak.linear_percent[0] < 1e-12
    assert leak.circular_percent[0] < 1e-12


def test_a_source_in_a_null_of_the_beam_is_said_to_be_there():
    where = SkyCoord([CENTRE, CENTRE.spherical_offsets_by(0 * u.deg, 25 * u.deg)])
    sky = PointSky.at(where, [1.0, 1.0])
    lofar = instrument.load("telescopes", "lofar-hba", stations=STATIONS)
    vis = Scene(instrument=lofar, sky=sky, observation=night()).plan().run().corrected(Towards(chain=lofar.chain()))
    assert Analyzer(visibilities=vis, sky=sky).leakage().near_null.tolist() == [False, True]


def test_polarization_of_the_sky_is_not_counted_as_leakage():
    where = CENTRE.spherical_offsets_by([0, 2] * u.deg, [0, 1.5] * u.deg)
    plain, own = (PointSky.at(where, np.array([[1, q, -q, v]] * 2)) for q, v in ((0.0, 0.0), (0.1, 0.05)))
    lofar = instrument.load("telescopes", "lofar-hba", stations=STATIONS)
    found = []
    for sky in (plain, own):
        vis = Scene(instrument=lofar, sky=sky, observation=night()).plan().run().without_beam(lofar)
        found.append(Analyzer(visibilities=vis, sky=sky).leakage())
    assert found[1].linear_percent[0] < 0.01  # at the centre; 14 % is the source's own
    # away from it the beam turns and mixes what the source has, to first order in the leakage
    assert found[1].linear_percent[1] == pytest.approx(found[0].linear_percent[1], abs=1.5)


def test_error_of_fluxes_is_the_noise_when_there_is_noise():
    sky = polarized(count=10)
    vis = bare(sky, interval=2 * u.min)
    sigma = vis.noise_jy(2820 * u.Jy)
    errors, gaps = [], []
    for seed in range(12):
        found = ForcedPhotometry().measure(vis.with_noise(2820 * u.Jy, seed), sky)
        errors.append(found.error_jy[0])
        gaps.append(found.stokes_jy[0] - sky.stokes_jy)
    # Stokes parameters are means of two correlations, so each part has sigma / sqrt 2; a flux uses the real part only
    count = vis.data.shape[0] * vis.data.shape[2]
    assert np.mean(errors, axis=0) == pytest.approx(np.full((10, 4), sigma / np.sqrt(2 * count)), rel=0.02)
    assert np.std(gaps) == pytest.approx(sigma / np.sqrt(2 * count), rel=0.15)


def test_weights_of_integrations_enter_either_way_of_solving():
    """Fluxes that change with time, so that the answer depends on the weights; NaN where there is no weight."""
    sky = polarized(shapes=True)
    vis = bare(sky)
    times = len(vis.data)
    weight = np.random.default_rng(2).uniform(0.1, 5, (times, 1, 1))
    weight[3] = 0
    data = vis.data * np.linspace(1, 2, times)[:, None, None, None, None]
    data[3] = np.nan
    vis = vis.with_data(data)
    direct = ForcedPhotometry().measure(vis.weighted(weight), sky)
    uneven = weight * np.ones(len(vis.antenna1))
    uneven[..., 0] *= 1 + 1e-9
    iterated = ForcedPhotometry(accuracy=1e-12).measure(vis.weighted(uneven), sky)
    assert (direct.iterations, iterated.iterations > 0) == (0, True)
    assert np.abs(direct.stokes_jy - iterated.stokes_jy).max() < 1e-5
    assert np.abs(direct.stokes_jy - ForcedPhotometry().measure(vis, sky).stokes_jy)[0, 0, 0] > 1
    # only ratios of weights matter
    scaled = ForcedPhotometry().measure(vis.weighted(1e-12 * weight), sky)
    assert np.abs(direct.stokes_jy - scaled.stokes_jy).max() < 1e-8
    assert scaled.error_jy == pytest.approx(direct.error_jy, rel=1e-6)


ITERATED = ForcedPhotometry(uv_range=(0, 1e7))


def test_conjugate_gradients_say_when_groups_cannot_be_told_apart():
    sky = polarized(count=4).with_fields(stokes_jy=np.eye(4)[[0, 0, 0, 0]])
    vis = bare(sky)
    assert ITERATED.measure(vis, sky).outcome == (Outcome.CONVERGED,)
    twice = sky.select([0, 1, 2, 1, 2])
    assert ITERATED.measure(vis, twice).outcome == (Outcome.SINGULAR,)
    # within a patch it is no matter, nor when patches have only a part in common; but two patches may be alike, or a
    # patch the sum of two sources
    for patches, outcome in (
        (("", "a", "b", "a", "b"), Outcome.CONVERGED),
        (("", "a", "a", "", ""), Outcome.SINGULAR),
        (("a", "a", "b", "", "b"), Outcome.CONVERGED),
        (("", "a", "a", "b", "b"), Outcome.SINGULAR),
    ):
        found = ITERATED.measure(vis, twice.with_fields(patches=patches))
        assert found.outcome == (outcome,), patches


def test_a_point_and_a_gaussian_at_one_place_are_two_sources():
    sky = polarized(count=3).select([0, 1, 1])
    sky = sky.with_fields(major_rad=[0, 0, 5e-5], minor_rad=[0, 0, 5e-5], angle_rad=[0, 0, 0])
    sky = sky.with_fields(stokes_jy=np.outer([3, 1, 2], np.ones(4)), names=("a", "b", "c"))
    found = ITERATED.measure(bare(sky), sky)
    assert found.outcome == (Outcome.CONVERGED,)
    assert np.abs(found.stokes_jy[0] - sky.stokes_jy).max() < 1e-6


def test_more_groups_than_data_cannot_be_measured():
    sky = polarized(count=30)
    vis = bare(sky)
    flag = np.ones(vis.data.shape[:3], bool)
    flag[5, :, :12] = False
    assert ITERATED.measure(vis.flagged(flag), sky).outcome == (Outcome.SINGULAR,)


def test_parts_of_a_patch_may_nearly_cancel():
    sky = polarized(count=4, patches=True)
    flux = np.outer([1000, -999.9, 5, 2], [1, 0, 0, 0])
    sky = sky.with_fields(stokes_jy=flux)
    vis = bare(sky)
    for photometry in (ForcedPhotometry(), ForcedPhotometry(uv_range=(0, 1e7), accuracy=1e-13)):
        found = photometry.measure(vis, sky)
        assert found.outcome == (Outcome.CONVERGED,)
        assert found.stokes_jy[0, :, 0] == pytest.approx([0.1, 5, 2], abs=1e-6)


def test_a_source_without_stokes_i_is_not_measured_and_not_near_a_null():
    sky = polarized(count=2).with_fields(stokes_jy=np.array([[1.0, 0, 0, 0], [0, 1, 0, 0]]))
    leak = Analyzer(visibilities=bare(sky), sky=sky).leakage()
    assert leak.near_null.tolist() == [False, False]
    assert leak.measured.tolist() == [True, False]


def test_expected_leakage_leaves_out_a_station_whose_beam_cannot_be_inverted():
    sky = PointSky.at(CENTRE.spherical_offsets_by(2 * u.deg, 1.5 * u.deg), [1.0])
    lofar = instrument.load("telescopes", "lofar-hba", stations=STATIONS[:5])
    at = Scene(instrument=lofar, sky=sky, observation=night(interval=60 * u.min)).plan().full.at
    whole, part = at.layout, at.layout.select(STATIONS[:4])

    class Dead:
        """The fifth station is dead, or is not there."""

        def jones(self, at):
            every = replace(at, layout=whole)
            out = np.array(np.broadcast_to(lofar.chain().jones(every), (*every.shape, 2, 2)))
            out[:, :, 4:] = 0
            return out[:, :, : len(at.layout)]

    dead = expected_percent(Dead(), at, sky.stokes_jy)
    assert np.isfinite(dead).all()
    assert dead == pytest.approx(expected_percent(Dead(), replace(at, layout=part), sky.stokes_jy), rel=1e-9)
    assert dead != pytest.approx(expected_percent(lofar.chain(), at, sky.stokes_jy), rel=1e-6)
