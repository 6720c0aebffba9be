"""Time is time: intervals, tables and random keys go by times, not by counts (faults C1 to C6, B4)."""

import numpy as np
import pytest

from instrument import InputError
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
