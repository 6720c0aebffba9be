"""Orientation: UT1 and the pole, day by day, from the tables that come with astropy; read once and kept.

astropy takes a second to read them from text, in every process, and a fifth to make a table of what was read. The
columns are kept beside the speed of the machine, under the version of the tables and with a digest; what is damaged or
of another version is read anew.
"""

from __future__ import annotations

import contextlib
import hashlib
import io
import sys
from functools import cache
from typing import Any

import numpy as np

from instrument.errors import InstrumentError
from instrument.machine import kept_in
from instrument.units import Bool, Float
from instrument.whole_file import whole_file

COLUMNS = {"MJD": "d", "UT1_UTC": "s", "PM_x": "arcsec", "PM_y": "arcsec"}
MJD = 2400000.5
ARCSEC = float(np.pi / 180 / 3600)


def orientation(jd1: Float, jd2: Float) -> tuple[Float, Float, Float, Bool]:
    """UT1 - UTC in s, the pole's x and y in rad, and what lies outside of the table, (T,) each, at UTC in two parts.

    Those of `astropy.utils.iers.earth_orientation_table` without any download, or of the table that the user has set.
    """
    if (own := _own()) is None:
        return _between(_kept(), jd1, jd2)
    from astropy.utils import iers

    with iers.conf.set_temp("auto_download", False), iers.conf.set_temp("auto_max_age", None):
        ut1_utc, status = own.ut1_utc(jd1, jd2, return_status=True)
        pole_x, pole_y, _ = own.pm_xy(jd1, jd2, return_status=True)
    outside = np.asarray(status) < 0
    return ut1_utc.to_value("s"), pole_x.to_value("rad"), pole_y.to_value("rad"), outside


def _own() -> Any:
    """The table that the user has set; nobody has where the module has never been loaded."""
    iers: Any = sys.modules.get("astropy.utils.iers")
    set_one = getattr(iers and iers.earth_orientation_table, "_value", None) is not None
    return iers.earth_orientation_table.get() if set_one else None


def _between(columns: Float, jd1: Float, jd2: Float) -> tuple[Float, Float, Float, Bool]:
    """Linear in time between days, as astropy has it; before the first and after the last the same as then."""
    days = columns[0]
    mjd = np.floor(jd1 - MJD + jd2)
    part = jd1 - (MJD + mjd) + jd2
    after = np.searchsorted(days, mjd, side="right")
    k = np.clip(after, 1, len(days) - 1)
    first, second = columns[1:, k - 1], columns[1:, k]
    step = second - first
    step[0] -= np.round(step[0])  # a leap second
    found = first + (mjd - days[k - 1] + part) / (days[k] - days[k - 1]) * step
    found = np.where(after == 0, columns[1:, :1], np.where(after == len(days), columns[1:, -1:], found))
    return found[0], ARCSEC * found[1], ARCSEC * found[2], (after == 0) | (after == len(days))


@cache
def _kept() -> Float:
    """The columns, (4, N)."""
    import astropy_iers_data

    path = kept_in().with_name(f"orientation-{astropy_iers_data.__version__}.npy")
    columns = _read(path)
    if columns is None:
        from astropy.utils import iers

        with iers.conf.set_temp("auto_download", False), iers.conf.set_temp("auto_max_age", None):
            whole = iers.earth_orientation_table.get()
        columns = np.array([whole[name].to_value(unit) for name, unit in COLUMNS.items()])
        # a place to keep it only saves time
        with contextlib.suppress(OSError, InstrumentError):
            path.parent.mkdir(parents=True, exist_ok=True)
            buffer = io.BytesIO()
            np.save(buffer, columns)
            with whole_file(path, overwrite=True) as partial:
                partial.write_bytes(hashlib.sha256(buffer.getvalue()).digest() + buffer.getvalue())
    return columns


def _read(path: Any) -> Any:
    with contextlib.suppress(OSError, ValueError):
        if path.is_file():  # a pipe would be waited for
            found = path.read_bytes()
            if hashlib.sha256(found[32:]).digest() == found[:32]:
                return np.load(io.BytesIO(found[32:]), allow_pickle=False)
    return None
