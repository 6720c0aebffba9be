"""Times moved, and turned into TT, are those of astropy to the last bit; where leap seconds may be new it is asked."""

import numpy as np
import pytest
from astropy import units as u
from astropy.time import Time

from instrument.observe import clock
from instrument.observe.directions import transit_time
from instrument.units import Direction

NIGHTS = ("2012-06-30T18:00:00", "2012-12-07T01:02:03.456789", "1999-01-01", "2016-12-31T23:59:59.5", "2020-02-29")


def same(one, other):
    return np.array_equal(one.jd1, other.jd1) and np.array_equal(one.jd2, other.jd2)


@pytest.mark.parametrize("start", [*NIGHTS, "2040-03-01T12:00:00"])
def test_later_times_are_those_of_astropy_to_the_last_bit(start):
    """Over the leap seconds of 2012 and 2016, back in time too, and after the end of the tables."""
    begin = Time(start, scale="utc")
    steps = np.concatenate([np.arange(3000) * 10.1, np.random.default_rng(3).uniform(-1e5, 1e5, 300)]) * u.s
    with np.errstate(all="ignore"):
        found, due = clock.later(begin, steps), begin + steps
        assert same(found, due) and found.format == due.format and found.scale == "utc"
        assert same(clock.later(begin, -12.3 * u.hour), begin - 12.3 * u.hour)
        tt = clock.terrestrial(due)
    assert np.array_equal(tt[0], due.tt.jd1) and np.array_equal(tt[1], due.tt.jd2)


def test_astropy_is_asked_where_the_tables_end():
    assert [clock._must_ask(Time(day), 0.0) for day in ("2012-12-07", "2040-01-01")] == [False, True]
    assert clock._must_ask(Time("2012-12-07"), 1e4)


def test_a_transit_is_within_its_day():
    site = np.array([3826577.0, 461022.0, 5064892.0])
    for ra in np.linspace(0, 2 * np.pi, 13):
        found = transit_time(Direction(ra, 0.84), site, "2012-12-07")
        assert Time("2012-12-07") <= found < Time("2012-12-08")
