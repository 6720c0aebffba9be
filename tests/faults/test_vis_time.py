"""Time is time: intervals, tables and random keys go by times, not by counts (faults C1 to C6, B4)."""

from dataclasses import replace

import numpy as np
import pytest
from astropy import units as u
from astropy.coordinates import SkyCoord

from instrument import Chain, FeedTerm, GainTerm, InputError, Layout, Observation, PointSky, Sampling, Scene
from instrument.model import Composed
from instrument.observe.intervals import intervals

MJD_S = 4.8618e9  # what MJD seconds of today look like: a double there resolves 1 microsecond


def test_c2_intervals_are_cut_by_time_and_not_by_count():
    slots = MJD_S + np.array([0, 10, 20, 90, 100, 110.0])
    found = intervals(slots, 20.0, 10.0)
    assert found.group.tolist() == [0, 0, 1, 2, 3, 3]
    assert np.allclose(found.centres_s - MJD_S, [5, 25, 85, 105], rtol=0, atol=1e-5)
    assert [(s.start, s.stop) for s in found.slices] == [(0, 2), (2, 3), (3, 4), (4, 6)]
    nearest = np.abs(slots[:, None] - found.centres_s).argmin(axis=1)
    assert np.array_equal(nearest, found.group)


def test_c2_an_interval_that_is_no_multiple_says_what_it_became():
    slots = MJD_S + 10.0 * np.arange(12)
    assert intervals(slots, 25.0, 10.0).length_s == 20.0  # a tie goes to the shorter
    assert intervals(slots, 26.0, 10.0).length_s == 30.0
    assert intervals(slots, 3.0, 10.0).length_s == 10.0
    assert intervals(slots, None, 10.0).group.tolist() == list(range(12))


def test_c2_an_interval_longer_than_the_data_is_one_centred_on_them():
    found = intervals(MJD_S + 10.0 * np.arange(4), 86400.0, 10.0)
    assert len(found) == 1 and found.length_s == 40.0
    assert found.centres_s[0] == pytest.approx(MJD_S + 15.0, abs=1e-5)


def test_c2_blocks_of_a_run_are_cut_as_the_whole_is():
    slots = MJD_S + 10.0139 * np.arange(100)
    whole = intervals(slots, 70.0, 10.0139)
    for first in (0, 13, 41, 98):
        block = intervals(slots[first:], 70.0, 10.0139, start_s=slots[0])
        assert np.array_equal(block.group + whole.group[first], whole.group[first:])
        assert np.allclose(block.centres_s, whole.centres_s[whole.group[first] :], rtol=0, atol=1e-5)


@pytest.mark.parametrize("spacing", [1e-3, 0.5, 8.0, 10.0139, 60.0])
def test_c2_rounding_does_not_move_an_integration_to_another_interval(spacing):
    slots = MJD_S + spacing * np.arange(1000)
    for ulp in (-1, 0, 1):
        moved = slots + ulp * np.spacing(slots[0])
        assert np.array_equal(intervals(moved, 7 * spacing, spacing).group, np.arange(1000) // 7)


@pytest.mark.parametrize(
    "slots, interval, integration",
    [([0, 0.0], 1, 1), ([], 1, 1), ([0, np.nan], 1, 1), ([0, 1.0], -1, 1), ([0, 1.0], np.nan, 1), ([0, 1.0], 1, 0)],
)
def test_c2_slots_out_of_order_and_lengths_that_are_none_are_refused(slots, interval, integration):
    with pytest.raises(InputError):
        intervals(np.array(slots), interval, integration)


# C1: random keys -------------------------------------------------------------------------------------------------


def array(count=2):
    enu = np.array([[0, 0, 0], [100, 0, 3], [30, 200, 0], [-150, 90, 1]])[:count]
    return Layout.from_enu(list("abcd")[:count], enu * u.m, 6.9 * u.deg, 52.9 * u.deg, 0 * u.m)


def observed(interval=1 * u.ms, count=200, frequencies=(150e6,) * u.Hz, width=1e5 * u.Hz, **instrument):
    night = Observation(
        phase_centre=SkyCoord("08h13m36.0s +48d13m03s"), start="2015-06-10T22:00:00", duration=count * interval,
        interval=interval, frequencies=frequencies, channel_width=width,
    )  # fmt: skip
    sky = PointSky.at(SkyCoord("08h13m36.0s +48d13m03s"), [1.0])
    return Scene(instrument=Composed(stations=array(), **instrument), sky=sky, observation=night).plan(workers=1).run()


@pytest.mark.parametrize("interval", [1 * u.ms, 20 * u.us, 10 * u.s])
def test_c1_every_integration_draws_noise_of_its_own(interval):
    vis = observed(interval)
    noise = (vis.with_noise(1e3 * u.Jy, seed=1).data - vis.data).ravel()
    assert len(np.unique(noise.real.round(9))) == noise.size
    sigma = vis.noise_jy(1e3 * u.Jy)
    # the mean of 200 x 4 x 2 numbers is 1/sqrt(1600) sigma, their rms sigma to 1/sqrt(3200)
    assert abs(np.mean([noise.real, noise.imag])) < 4 * sigma / np.sqrt(2 * noise.size)
    assert np.std([noise.real, noise.imag]) == pytest.approx(sigma, rel=4 / np.sqrt(4 * noise.size))


def test_c1_close_channels_draw_noise_of_their_own():
    """0.3 Hz apart, as in a spectral line or a coherent dedispersion: the rounded frequency is one number."""
    vis = observed(frequencies=(150e6 + 0.3 * np.arange(40)) * u.Hz, width=0.3 * u.Hz, count=1)
    noise = (vis.with_noise(1e3 * u.Jy, seed=1).data - vis.data).ravel()
    assert len(np.unique(noise)) == noise.size


def test_c1_every_integration_draws_gains_and_feeds_of_its_own():
    for term in (GainTerm(rms=0.5, seed=3), FeedTerm(rms=0.5, seed=3)):
        found = term.table(observed().at)
        assert len(np.unique(found)) == found.size


def test_c1_a_draw_belongs_to_seed_time_and_channel_and_not_to_the_block():
    vis = observed(count=20, frequencies=[150, 151] * u.MHz, terms=Chain(GainTerm(rms=0.3, seed=1)))
    whole = vis.with_noise(100 * u.Jy, seed=1)
    part = replace(vis, data=vis.data[5:9, 1:], at=vis.at.block(slice(5, 9), slice(1, 2)))
    assert np.array_equal(part.with_noise(100 * u.Jy, seed=1).data, whole.data[5:9, 1:])
    again = Sampling.build(vis.layout, vis.times, vis.freq_hz, np.zeros(1), np.zeros(1), vis.phase_centre)
    assert np.array_equal(again.slots_s, vis.at.slots_s)  # so that times written and read draw the same
    assert np.array_equal(GainTerm(rms=0.3, seed=1).table(again), GainTerm(rms=0.3, seed=1).table(vis.at))


def test_c1_gains_of_an_interval_of_one_integration_are_those_of_the_integration():
    """Their centre has the bits of the time itself, or a drawn truth would be another draw."""
    slots = observed(10.0139 * u.s).at.slots_s
    assert np.array_equal(intervals(slots, None, 10.0139).centres_s, slots)
    assert np.array_equal(intervals(slots, 10.0139, 10.0139).centres_s, slots)
