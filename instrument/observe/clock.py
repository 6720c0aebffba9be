"""Times in UTC and TT as astropy has them, to the last bit, without the tables of leap seconds that it loads first.

astropy asks whether the leap seconds of erfa are out of date before it turns any scale into another, a sixth of a
second in every process. Before the day on which erfa's expire there is nothing to ask.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from instrument.units import Float


def later(time: Any, by: Any) -> Any:
    """The UTC `Time` that comes so much later (a `Quantity` of time), one or many: `time + by`."""
    from astropy.time import Time, TimeDelta
    from astropy.time.utils import day_frac

    delta = TimeDelta(by)
    if _must_ask(time, float(np.max(delta.jd1, initial=0.0)) + 1):
        return time + delta
    import erfa

    tai = day_frac(*erfa.utctai(time.jd1, time.jd2))
    moved = day_frac(tai[0] + delta.jd1, tai[1] + delta.jd2)
    out = Time(*day_frac(*erfa.taiutc(*moved)), format="jd", scale="utc")
    out.format = time.format
    return out


def terrestrial(times: Any) -> tuple[Float, Float]:
    """TT in two parts (T,) of UTC times: those of `times.tt`."""
    if _must_ask(times, 0.0):
        return np.atleast_1d(times.tt.jd1), np.atleast_1d(times.tt.jd2)
    import erfa
    from astropy.time.utils import day_frac

    tt = day_frac(*erfa.taitt(*day_frac(*erfa.utctai(times.jd1, times.jd2))))
    return np.atleast_1d(tt[0]), np.atleast_1d(tt[1])


def _must_ask(time: Any, days: float) -> bool:
    """Whether times, or so many days after them, come to where erfa's table of leap seconds ends."""
    import erfa

    ends = erfa.leap_seconds.expires.toordinal() + 1721424.5
    return not float(np.max(time.jd1, initial=0.0)) + days < ends
