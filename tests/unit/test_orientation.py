"""UT1 and the pole are those of astropy's table, from a file that is kept, and anew where that is damaged."""

import numpy as np
import pytest
from astropy import units as u
from astropy.time import Time
from astropy.utils import iers

from instrument.observe import orientation
from instrument.observe.directions import earth_frame

SITE = np.array([3826577.0, 461022.0, 5064892.0])
TIMES = Time("2012-06-30T18:00:00") + np.linspace(0, 400, 300) * u.day  # over a leap second


@pytest.fixture
def place(tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    orientation._kept.cache_clear()
    # astropy's own tables would ask the network
    with iers.conf.set_temp("auto_download", False), iers.conf.set_temp("auto_max_age", None):
        yield tmp_path / "instrument"
    orientation._kept.cache_clear()


def test_kept_values_are_those_of_the_table(place):
    whole = iers.earth_orientation_table.get()
    far = Time(["1960-01-01", "2100-01-01"])
    for _ in range(2):  # read from text, and from what was kept
        orientation._kept.cache_clear()
        for times in (TIMES.utc, far):
            jd = times.jd1, times.jd2
            ut1_utc, x, y, outside = orientation.orientation(*jd)
            due, status = whole.ut1_utc(*jd, return_status=True)
            assert np.array_equal(ut1_utc, due.to_value("s"))
            pole = whole.pm_xy(*jd, return_status=True)[:2]
            assert all(np.array_equal(a, b.to_value("rad")) for a, b in zip((x, y), pole, strict=True))
            assert np.array_equal(outside, status < 0) and outside.all() == (times is far)
        assert len(list(place.glob("orientation-*.npy"))) == 1


def test_a_damaged_file_is_read_anew(place):
    good = earth_frame(TIMES, SITE).matrices
    (file,) = place.glob("orientation-*.npy")
    spoilt = bytearray(file.read_bytes())
    spoilt[5000] ^= 1
    for content in (bytes(spoilt), b"", b"x" * 100):
        file.write_bytes(content)
        orientation._kept.cache_clear()
        assert np.array_equal(earth_frame(TIMES, SITE).matrices, good)
        assert file.read_bytes() != content


def test_a_table_that_the_user_has_set_is_taken(place):
    own, jd = iers.IERS_B.read(iers.IERS_B_FILE), (TIMES.utc.jd1, TIMES.utc.jd2)
    own["UT1_UTC"] += 0.1 * u.s
    usual = orientation.orientation(*jd)
    with iers.earth_orientation_table.set(own):
        found = orientation.orientation(*jd)
    due, status = own.ut1_utc(*jd, return_status=True)
    assert np.array_equal(found[0], due.to_value("s")) and np.array_equal(found[3], status < 0)
    assert np.allclose(found[0] - usual[0], 0.1) and np.array_equal(orientation.orientation(*jd), usual)
