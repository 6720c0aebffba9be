"""Sums, averages and other phase centres of visibilities, against closed forms and predictions."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from astropy import units as u
from astropy.coordinates import SkyCoord

import instrument
from instrument import (
    Composed,
    GainTerm,
    Imager,
    InputError,
    Layout,
    Observation,
    PointSky,
    Scene,
    Towards,
    Visibilities,
)
from instrument.analyze.sources.photometry import ForcedPhotometry
from instrument.errors import BeamStateError
from instrument.observe.directions import LIGHT
from instrument.visibility_sets import as_set

pytestmark = pytest.mark.filterwarnings("ignore:the PSF")  # few pixels, on purpose
CENTRE = SkyCoord("08h13m36.0s +48d13m03s")
STATIONS = ["CS001HBA0", "CS003HBA1", "CS302HBA1", "RS106HBA", "RS508HBA"]
AWAY = CENTRE.spherical_offsets_by(1 * u.deg, 0.5 * u.deg)
SKY = PointSky.at(CENTRE.spherical_offsets_by([0, 1] * u.deg, [0, 0.5] * u.deg), [[3, 0.1, 0.2, 0.3], [2, 0, 0.4, 0]])


def scene(times=12, interval=10 * u.s, frequencies=(150.0, 150.2, 150.4), centre=CENTRE, sky=SKY, **settings):
    night = Observation(
        phase_centre=centre, start="2012-12-07T01:00:00", duration=times * interval, interval=interval,
        frequencies=frequencies * u.MHz, channel_width=0.2 * u.MHz,
    )  # fmt: skip
    array = instrument.load("telescopes", "lofar-hba", stations=STATIONS, **({"beam": None} | settings))
    return Scene(instrument=array, sky=sky, observation=night)


@cache
def seen():
    return scene().plan(workers=1).run()


def test_a_sum_undoes_a_difference_and_takes_only_what_is_alike():
    vis, model = seen(), seen().with_data(1j * seen().data)
    assert np.array_equal((vis + model).data, vis.data + model.data)
    assert np.abs((vis - model + model).data - vis.data).max() < 1e-14
    with pytest.raises(InputError, match="cannot be added or subtracted"):
        vis + vis.block(slice(0, 3), slice(None))
    held = scene(times=1, beam="full")
    beam = held.plan(workers=1).run()
    with pytest.raises(BeamStateError, match="cannot mix"):
        beam + beam.without_beam(held.instrument)


# Averages ---------------------------------------------------------------------------------------------------------


def test_means_weights_and_coordinates_of_uneven_groups():
    rng = np.random.default_rng(1)
    vis = seen()
    weight, flag = rng.uniform(0.5, 2, vis.data.shape[:3]), rng.uniform(size=vis.data.shape[:3]) < 0.2
    flag[:5, :2, 4] = True  # a whole group
    data = np.where(flag[..., None, None], np.nan, vis.data)
    found = vis.with_data(data).weighted(weight).flagged(flag).averaged(time=50 * u.s, channels=2)
    w = np.where(flag, 0, weight)
    for i, t in enumerate((slice(0, 5), slice(5, 10), slice(10, 12))):
        for j, f in enumerate((slice(0, 2), slice(2, 3))):
            total = w[t, f].sum(axis=(0, 1))
            assert np.abs(found.weight[i, j] - total).max() < 1e-13
            assert np.array_equal(found.flag[i, j], total == 0)
            due = (w[t, f][..., None, None] * vis.data[t, f]).sum(axis=(0, 1)) / np.where(total, total, 1)[
                :, None, None
            ]
            assert np.abs(found.data[i, j] - due).max() < 1e-13
    assert found.flag[0, 0, 4] and found.flag.sum() == 1
    assert np.array_equal(found.interval_s, [50, 50, 20])
    assert np.allclose(found.width_hz, [0.4e6, 0.2e6], rtol=1e-15)
    assert np.allclose(found.freq_hz, [150.1e6, 150.4e6], rtol=1e-15)
    assert np.abs(found.at.slots_s - vis.at.slots_s[0] - [20, 70, 105]).max() < 2e-6
    again = found.averaged(time=100 * u.s)
    assert again.weight.sum() == pytest.approx(w.sum(), rel=1e-12)


def test_coordinates_of_an_average_are_those_of_an_observation_at_its_mean_times():
    vis = seen()
    found = vis.averaged(time=60 * u.s, channels=3)
    due = scene(times=2, interval=60 * u.s, frequencies=(150.2,)).plan(workers=1).run()
    assert np.abs(found.at.slots_s - due.at.slots_s).max() < 2e-6
    assert np.abs(found.uvw_m - due.uvw_m).max() < 1e-6
    assert np.abs(found.at.earth.matrices - due.at.earth.matrices).max() < 1e-10
    assert found.weight.shape == (1, 1, 1) and found.weight[0, 0, 0] == 18
    assert not found.flag.any()
    # UVW of a file follow
    given = replace(vis, given_uvw_m=vis.uvw_m).averaged(time=60 * u.s, channels=3)
    assert np.abs(given.uvw_m - due.uvw_m).max() < 1e-6
    assert given.beam_state is vis.beam_state
    # and so do directions of another program
    at = replace(vis.at, seen=vis.at.itrf, seen_east=vis.at.east_itrf, seen_centre=vis.at.centre_itrf)
    other = replace(vis, at=at).averaged(time=60 * u.s, channels=3).at
    for name in ("itrf", "east_itrf", "centre_itrf"):
        assert np.abs(getattr(other, name) - getattr(found.at, name)).max() < 1e-10
    assert other.seen is not None and other.seen_centre is not None


def test_an_average_of_one_is_what_it_was_and_gaps_are_not_filled():
    vis = seen()
    same = vis.averaged(time=10 * u.s)
    assert same.data.tobytes() == vis.data.tobytes()
    assert np.array_equal(same.at.slots_s, vis.at.slots_s) and np.array_equal(same.uvw_m, vis.uvw_m)
    rows = np.array([0, 1, 2, 7, 8, 11])
    late = replace(
        vis.block(slice(0, 6), slice(None)), data=vis.data[rows], at=replace(
            vis.at, slots_s=vis.at.slots_s[rows], earth=vis.at.earth[rows]
        )
    )  # fmt: skip
    found = late.averaged(time=30 * u.s)
    assert np.array_equal(found.interval_s, [30, 20, 10])
    assert np.abs(found.at.slots_s - vis.at.slots_s[0] - [10, 75, 110]).max() < 2e-6


def test_weights_of_correlations_stay_apart_in_an_average():
    rng = np.random.default_rng(2)
    vis = seen()
    weight, flag = rng.uniform(0.5, 2, vis.data.shape), rng.uniform(size=vis.data.shape) < 0.3
    found = vis.with_data(np.where(flag, np.nan, vis.data)).weighted(weight).flagged(flag).averaged(time=60 * u.s)
    w = np.where(flag, 0, weight).reshape(2, 6, *weight.shape[1:])
    assert np.abs(found.weight - w.sum(axis=1)).max() < 1e-13
    due = (w * vis.data.reshape(w.shape)).sum(axis=1) / w.sum(axis=1)
    assert np.abs(found.data - due).max() < 1e-13


def test_weights_of_any_size_give_the_same_means():
    weight = np.random.default_rng(3).uniform(0.5, 2, seen().data.shape[:3])
    due = seen().weighted(weight).averaged(time=60 * u.s).data
    for size in (1e-95, 1e95):
        assert np.abs(seen().weighted(size * weight).averaged(time=60 * u.s).data - due).max() < 1e-14


@pytest.mark.parametrize(
    ("asked", "said"),
    [
        ({"time": 25 * u.s}, "time = 25 s is 2.5 integrations of 10 s: give 20 s or 30 s"),
        ({"time": 4 * u.s}, "time = 4 s is 0.4 integrations of 10 s: give 10 s"),
        ({"time": 0 * u.s}, "time"),
        ({"time": 60}, "unit"),
        ({"channels": 4}, "channels = 4 of one average, but the data have 3"),
        ({"channels": 0}, "channels"),
    ],
)
def test_averages_that_cannot_be_are_refused_in_one_line(asked, said):
    with pytest.raises(InputError, match=said) as caught:
        seen().averaged(**asked)
    assert "\n" not in str(caught.value)


def sinc_of_many(turns, count):
    """Mean of exp(2 pi i k turns / count) over k about its middle: sin(pi turns) / (count sin(pi turns / count))."""
    return np.sin(np.pi * turns) / (count * np.sin(np.pi * turns / count))


def test_averaging_channels_loses_the_sinc_of_the_delay():
    """A point of delay tau over n channels: sin(pi n x) / (n sin(pi x)), x = tau df; sinc(tau n df) for narrow ones."""
    at = CENTRE.spherical_offsets_by(1.5 * u.deg, 0 * u.deg)
    freq = 150 + 0.01 * np.arange(41)
    vis = scene(times=1, frequencies=freq, sky=PointSky.at(at, [1.0])).plan(workers=1).run()
    found = vis.averaged(channels=41)
    where = vis.at.towards(np.array([at.ra.rad]), np.array([at.dec.rad])).lmn[0]
    turns = (vis.uvw_m[0] @ where) / LIGHT * 41 * 0.01e6
    middle = vis.data[0, 20, :, 0, 0]
    lost = (found.data[0, 0, :, 0, 0] / middle).real
    assert np.abs(lost - sinc_of_many(turns, 41)).max() < 1e-9
    assert np.abs(lost - np.sinc(turns)).max() < 1e-3 and np.abs(lost).min() < 0.5


def test_averaging_in_time_loses_the_sinc_of_the_turning_fringe():
    at = CENTRE.spherical_offsets_by(1.5 * u.deg, 0 * u.deg)
    vis = scene(times=31, interval=2 * u.s, frequencies=(150.0,), sky=PointSky.at(at, [1.0])).plan(workers=1).run()
    found = vis.averaged(time=62 * u.s)
    where = vis.at.towards(np.array([at.ra.rad]), np.array([at.dec.rad])).lmn[0]
    cycles = (vis.uvw_m @ where) * (150e6 / LIGHT)
    turns = (cycles[-1] - cycles[0]) * 31 / 30
    lost = np.abs(found.data[0, 0, :, 0, 0])
    # what the fringe does beyond the first order, (omega t)^2 / 2 of the largest phase, is 1e-3 of it here
    assert np.abs(lost - np.abs(sinc_of_many(turns, 31))).max() < 2e-3
    assert np.abs(lost - np.abs(np.sinc(turns))).max() < 4e-3 and lost.min() < 0.8


# Other phase centres ----------------------------------------------------------------------------------------------


def test_a_source_at_the_new_centre_is_what_a_scene_with_that_centre_predicts():
    sky = PointSky.at(AWAY, [[2, 0.1, 0.2, 0.3]])
    turned = scene(sky=sky).plan(workers=1).run().shifted_to(AWAY)
    due = scene(sky=sky, centre=AWAY).plan(workers=1).run()
    longest = np.linalg.norm(due.uvw_m, axis=-1).max() * 150.4e6 / LIGHT
    # direction cosines round to half an ulp of 1, on either side
    assert np.abs(turned.data - due.data).max() < 2.2e-16 * 2 * np.pi * longest * 3
    assert turned.phase_centre == due.phase_centre
    # UVW of the two scenes differ by the differential aberration, at most 1e-4 of the shift (docs/conventions.md)
    assert np.abs(turned.uvw_m - due.uvw_m).max() < 1e-4 * np.deg2rad(1.2) * np.abs(due.uvw_m).max()


def test_there_and_back_is_nothing():
    vis = seen()
    back = vis.shifted_to(AWAY).shifted_to(CENTRE)
    assert np.abs(back.data - vis.data).max() < 1e-12 * np.abs(vis.data).max()
    assert back.given_uvw_m is None and back.at.steered is None
    assert np.abs((back - vis).data).max() < 1e-11  # and they are of the same coordinates
    given = replace(vis, given_uvw_m=1.001 * vis.uvw_m)
    again = given.shifted_to(AWAY).shifted_to("08h13m36.0s +48d13m03s")
    assert np.abs(again.data - given.data).max() < 1e-12 * np.abs(vis.data).max()
    assert np.abs(again.uvw_m - given.uvw_m).max() < 1e-9
    assert vis.shifted_to(CENTRE).data is vis.data


def test_fluxes_are_the_same_about_any_centre_and_images_move():
    vis, turned = seen(), seen().shifted_to(AWAY)
    before, after = (ForcedPhotometry().measure(v, SKY).stokes_jy for v in (vis, turned))
    assert np.abs(after - before).max() < 1e-10
    alone = scene(sky=PointSky.at(AWAY, [2.0])).plan(workers=1).run().shifted_to(AWAY)
    cube = Imager(pixels=32, pixel=0.4 * u.arcmin, uv_range=(0, 2000)).image(alone)
    assert cube.data[0, 0, 16, 16] == pytest.approx(2, abs=1e-5)
    assert cube.centre == turned.phase_centre


def test_beams_point_where_they_did():
    """The beam of the old pointing, in the direction of either centre, is found about both."""
    made = scene(times=2, frequencies=(150.0,), beam="full")
    vis = made.plan(workers=1).run()
    turned, beams = vis.shifted_to(AWAY), made.instrument.chain().beams()
    assert turned.beam_state is vis.beam_state
    for where in (CENTRE, AWAY):
        due = vis.corrected(Towards(chain=beams, direction=where)).shifted_to(AWAY)
        found = turned.corrected(Towards(chain=beams, direction=where))
        assert np.abs(found.data - due.data).max() < 1e-10 * np.abs(due.data).max()
        assert found.beam_state == due.beam_state
    assert turned.without_beam(made.instrument).beam_state.towards == turned.phase_centre
    with pytest.raises(BeamStateError, match="cannot mix"):
        turned - vis.without_beam(made.instrument).shifted_to(AWAY)


def test_a_dish_points_where_it_did(tmp_path):
    enu = np.array([[0, 0, 0], [300, 0, 0], [0, 400, 1.0]])
    layout = Layout.from_enu(["a", "b", "c"], enu * u.m, 0.12 * u.rad, 0.92 * u.rad, 50 * u.m)
    dish = instrument.load("elements", "gaussian", fwhm=3 * u.deg)
    array = Composed(stations=layout, terms=instrument.Chain(dish, instrument.Parallactic()))
    vis = Scene(instrument=array, sky=SKY, observation=scene(times=1).observation).plan(workers=1).run()
    term = Towards(chain=array.chain().beams(), direction=AWAY)
    turned = vis.shifted_to(AWAY)
    found, due = turned.corrected(term).data, vis.corrected(term).shifted_to(AWAY).data
    assert np.abs(found - due).max() < 1e-12
    turned.save(tmp_path / "turned.h5")
    back = Visibilities.open(tmp_path / "turned.h5")
    assert back.at.steered == turned.at.steered == vis.phase_centre
    assert np.array_equal(back.corrected(term).data, found)
    one = turned.block(slice(0, 1), slice(0, 1))
    other = replace(turned, at=replace(turned.at, steered=None)).block(slice(0, 1), slice(1, 3))
    for pair in ((one, other), (other, one)):
        with pytest.raises(InputError, match="differ in steered"):
            as_set(pair).save(tmp_path / "no.h5")


def test_gains_commute_with_another_phase_centre():
    term = GainTerm(rms=0.1, seed=1)
    one, other = seen().corrupted(term).shifted_to(AWAY), seen().shifted_to(AWAY).corrupted(term)
    assert np.abs(one.data - other.data).max() < 1e-13
