"""Time is time: intervals, tables and random keys go by times, not by counts (faults C1 to C6, B4)."""

from dataclasses import replace

import numpy as np
import pytest
from astropy import units as u
from astropy.coordinates import SkyCoord

from instrument import (
    Chain,
    FeedTerm,
    GainTerm,
    InputError,
    JonesTable,
    Layout,
    Observation,
    PointSky,
    Sampling,
    Scene,
)
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


# C3: between two solutions -----------------------------------------------------------------------------------------


def between(first, second, share, interpolation="linear", axis="time"):
    """The matrix that a table of two entries has at a share of the way, (2, 2)."""
    vis = observed(10 * u.s, 2)
    known = vis.at.slots_s if axis == "time" else [149e6, 151e6]
    values = np.stack(np.broadcast_arrays(first, second)).astype(complex)
    shape, slots, freq = ((2, 1), known, [150e6]) if axis == "time" else ((1, 2), vis.at.slots_s[:1], known)
    table = JonesTable(values=values.reshape(*shape, 1, 2, 2), slots_s=slots, freq_hz=freq, interpolation=interpolation)
    asked = known[0] + share * (known[1] - known[0])
    at = replace(vis.at.block(slice(0, 1), slice(0, 1)), **{"slots_s" if axis == "time" else "freq_hz": [asked]})
    return table.jones(at)[0, 0, 0, 0]


def turn(degrees):
    c, s = np.cos(np.deg2rad(degrees)), np.sin(np.deg2rad(degrees))
    return np.array([[c, s], [-s, c]])


def phases(p, q):
    return np.diag(np.exp(1j * np.deg2rad([p, q])))


def test_c3_a_phase_that_runs_90_degrees_between_two_solutions_corrects_to_1_half_way():
    vis = observed(5 * u.s, 3)
    values = np.tile(np.eye(2, dtype=complex), (2, 1, 2, 1, 1))
    values[1, 0, 0] *= 1j  # of one station: 0, then 90 deg
    table = JonesTable(values=values, slots_s=vis.at.slots_s[[0, 2]], freq_hz=vis.freq_hz, interpolation="linear")
    data = vis.with_data(vis.data * np.exp(1j * np.deg2rad([0, 45, 90]))[:, None, None, None, None])
    corrected = data.corrected(table).stokes()[:, 0, 0, 0]
    assert np.abs(corrected - 1).max() < 1e-12  # abs 1.000 and 0 deg; a straight line of complex numbers gives 1.41


@pytest.mark.parametrize("axis", ["time", "frequency"])
@pytest.mark.parametrize(
    "first, second, half",
    [
        (phases(0, 0), phases(90, -90), phases(45, -45)),
        (phases(-170, 10), phases(170, 30), phases(180, 20)),  # the short way round
        (1.0 * np.eye(2), 3.0 * np.eye(2), 2.0 * np.eye(2)),
        (2 * phases(0, 0), 4 * phases(60, 0), 3 * phases(30, 0)),
        (np.diag([0, 1.0]), np.diag([2j, 1.0]), np.diag([1j, 1.0])),  # zero has no phase: that of the other end
        (turn(0), turn(90), turn(45)),  # a rotation, as Faraday's or a parallactic angle's
        (turn(170), turn(-170), turn(180)),
        (2 * turn(10), 4 * turn(50) * 1j, 3 * turn(30) * np.exp(0.25j * np.pi)),
        (1e-9 * turn(0), 1e-9 * turn(90), 1e-9 * turn(45)),
        (1e200 * turn(0), 1e200 * turn(90), 1e200 * turn(45)),
    ],
)
def test_c3_linear_is_of_amplitude_and_phase(first, second, half, axis):
    found = between(first, second, 0.5, axis=axis)
    assert np.abs(found - half).max() < 1e-6 * np.abs(half).max()  # times resolve 1 us of 10 s
    assert np.array_equal(between(first, second, 0.0, axis=axis), first)
    assert np.array_equal(between(first, second, 1.0, axis=axis), second)


def test_c3_full_matrices_turn_by_their_unitary_part_and_stretch_by_their_hermitian_part():
    rng = np.random.default_rng(1)
    for _ in range(8):
        first, second = np.eye(2) + 0.4 * (rng.normal(size=(2, 2, 2)) + 1j * rng.normal(size=(2, 2, 2)))
        for share in (0.2, 0.5, 0.9):
            found = between(first, second, share)
            (u0, h0), (u1, h1), (u2, h2) = (polar(x) for x in (first, second, found))
            assert np.abs(h2 - ((1 - share) * h0 + share * h1)).max() < 1e-6
            angle0, angle2 = (np.linalg.eigvals(np.linalg.inv(u0) @ x) for x in (u1, u2))
            assert np.abs(np.sort(np.angle(angle0)) * share - np.sort(np.angle(angle2))).max() < 1e-6


def polar(jones):
    left, values, right = np.linalg.svd(jones)
    return left @ right, right.conj().T @ np.diag(values) @ right


# C4: where a table ends --------------------------------------------------------------------------------------------

DAY = 86400.0


def ask(table, slots=None, freq=None):
    at = observed(10 * u.s, 2).at
    at = replace(at, slots_s=at.slots_s if slots is None else np.atleast_1d(slots))
    return table.jones(replace(at, freq_hz=at.freq_hz if freq is None else np.atleast_1d(freq)))


def tables(slots, freqs):
    shape = (len(slots), len(freqs))
    return (
        JonesTable(values=np.broadcast_to(np.eye(2), (*shape, 2, 2, 2)), slots_s=slots, freq_hz=freqs),
        GainTerm(values=np.full((*shape, 2, 2), 2.0), slots_s=slots, freq_hz=freqs),
    )


@pytest.mark.parametrize("which", [0, 1])
def test_c4_a_table_is_not_asked_a_year_later_or_at_another_band(which):
    two = tables(MJD_S + np.array([0, 10.0]), [60e6])[which]
    with pytest.raises(InputError, match="time"):
        ask(two, MJD_S + 390 * DAY, 60e6)
    with pytest.raises(InputError, match="frequency"):
        ask(two, MJD_S, 150e6)
    one = tables([MJD_S], [60e6])[which]
    assert ask(one, MJD_S + 0.4 * DAY, 61e6).shape[:2] == (1, 1)
    with pytest.raises(InputError, match="time"):
        ask(one, MJD_S + 390 * DAY, 60e6)
    with pytest.raises(InputError, match="frequency"):
        ask(one, MJD_S, 150e6)


@pytest.mark.parametrize("which", [0, 1])
def test_c4_a_gap_does_not_make_the_ends_of_a_table_longer(which):
    table = tables(MJD_S + np.array([0, 10, 1000, 1010.0]), [60e6])[which]
    ask(table, MJD_S + 1014.9, 60e6)
    for slot in (-980, -11, 1021, 1990):
        with pytest.raises(InputError, match="time"):
            ask(table, MJD_S + slot, 60e6)
    channels = tables([MJD_S], np.array([60, 60.2, 70, 70.2]) * 1e6)[which]
    ask(channels, MJD_S, 70.29e6)
    for freq in (50e6, 59.7e6, 70.5e6, 79e6):
        with pytest.raises(InputError, match="frequency"):
            ask(channels, MJD_S, freq)


def test_c4_an_entry_at_no_time_and_no_frequency_is_constant():
    for table in tables([0.0], [0.0]):
        for slot, freq in ((MJD_S, 60e6), (MJD_S + 1000 * DAY, 240e6)):
            assert ask(table, slot, freq).shape[:2] == (1, 1)


@pytest.mark.parametrize("slots", [[MJD_S, np.nan], [MJD_S, np.inf], [MJD_S, MJD_S]])
def test_b7_times_of_a_table_are_finite_and_different(slots):
    with pytest.raises(InputError, match="slots_s"):
        GainTerm(values=np.ones((2, 1, 2, 2)), slots_s=slots)
    with pytest.raises(InputError, match="freq_hz"):
        FeedTerm(values=np.zeros((1, 2, 2, 2)), freq_hz=[150e6, np.nan])
