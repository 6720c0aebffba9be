"""Orientation: UT1 and the pole, day by day, from the tables that come with astropy; read once and kept.

astropy takes a second to read them from text, in every process. The columns are kept beside the speed of the machine,
under the version of the tables and with a digest; what is damaged or of another version is read anew.
"""

from __future__ import annotations

import contextlib
import hashlib
import io
from functools import cache
from typing import Any

import numpy as np

from instrument.errors import InstrumentError
from instrument.machine import kept_in
from instrument.whole_file import whole_file

COLUMNS = {"MJD": "d", "UT1_UTC": "s", "PM_x": "arcsec", "PM_y": "arcsec"}


def orientation_table() -> Any:
    """The table (astropy `IERS`) that `earth_orientation_table` would give without any download."""
    from astropy.utils import iers

    if getattr(iers.earth_orientation_table, "_value", None) is not None:
        return iers.earth_orientation_table.get()  # the user's own
    return _kept()


@cache
def _kept() -> Any:
    import astropy_iers_data
    from astropy import units as u
    from astropy.utils import iers

    path = kept_in().with_name(f"orientation-{astropy_iers_data.__version__}.npy")
    columns = _read(path)
    if columns is None:
        whole = iers.earth_orientation_table.get()
        columns = np.array([whole[name].to_value(unit) for name, unit in COLUMNS.items()])
        # a place to keep it only saves time
        with contextlib.suppress(OSError, InstrumentError):
            path.parent.mkdir(parents=True, exist_ok=True)
            buffer = io.BytesIO()
            np.save(buffer, columns)
            with whole_file(path, overwrite=True) as partial:
                partial.write_bytes(hashlib.sha256(buffer.getvalue()).digest() + buffer.getvalue())
    quantities = [column * u.Unit(unit) for column, unit in zip(columns, COLUMNS.values(), strict=True)]
    return iers.IERS(quantities, names=list(COLUMNS))


def _read(path: Any) -> Any:
    with contextlib.suppress(OSError, ValueError):
        if path.is_file():  # a pipe would be waited for
            found = path.read_bytes()
            if hashlib.sha256(found[32:]).digest() == found[:32]:
                return np.load(io.BytesIO(found[32:]), allow_pickle=False)
    return None
