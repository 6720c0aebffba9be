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
    for _ in range(2):  # read from text, and from what was kept
        orientation._kept.cache_clear()
        found = orientation.orientation_table()
        jd = TIMES.utc.jd1, TIMES.utc.jd2
        assert np.array_equal(found.ut1_utc(*jd), whole.ut1_utc(*jd))
        assert all(np.array_equal(a, b) for a, b in zip(found.pm_xy(*jd), whole.pm_xy(*jd), strict=True))
        assert len(list(place.glob("orientation-*.npy"))) == 1
    far = Time(["1960-01-01", "2100-01-01"])
    assert np.array_equal(
        found.ut1_utc(far.jd1, far.jd2, return_status=True)[1], whole.ut1_utc(far.jd1, far.jd2, return_status=True)[1]
    )


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
    own = iers.IERS_B.open(iers.IERS_B_FILE)
    with iers.earth_orientation_table.set(own):
        assert orientation.orientation_table() is own
