"""Directions as casacore, and so EveryBeam and DP3, have them: their own precession, from their own places on Earth."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np

from instrument.observe.sampling import Sampling
from instrument.units import Float

# EveryBeam takes coordinates from J2000 to ITRF at this position, whose x lacks its leading 3
EVERYBEAM_SITE_M = (826577.022720000, 461022.995082000, 5064892.814)


def casacore_itrf(slots_s: Any, ra_rad: Any, dec_rad: Any, site: Any = EVERYBEAM_SITE_M) -> Float:
    """ITRF unit vectors (T, S, 3) of J2000 directions (S,) at MJD seconds (T,), aberration included.

    `site` is an ITRF position or the name of one of casacore's observatories.
    """
    from casacore.measures import measures
    from casacore.quanta import quantity

    frame = measures()
    named = isinstance(site, str)
    place = frame.observatory(site) if named else frame.position("ITRF", *(quantity(x, "m") for x in site))
    frame.do_frame(frame.measure(place, "ITRF"))
    out = np.empty((len(slots_s), len(ra_rad), 3))
    for t, slot in enumerate(slots_s):
        frame.do_frame(frame.epoch("UTC", quantity(float(slot), "s")))
        for s, angles in enumerate(zip(ra_rad, dec_rad, strict=True)):
            seen = frame.measure(frame.direction("J2000", *(quantity(float(x), "rad") for x in angles)), "ITRF")
            lon, lat = seen["m0"]["value"], seen["m1"]["value"]
            out[t, s] = np.cos(lat) * np.cos(lon), np.cos(lat) * np.sin(lon), np.sin(lat)
    return out


def with_everybeam_north(at: Sampling, seen: Float) -> Sampling:
    """A sampling that sees ITRF directions (T, S, 3), north towards EveryBeam's pole.

    That is the J2000 pole as casacore carries it to ITRF, with the aberration of the pole.
    """
    east = np.cross(casacore_itrf(at.slots_s, [0.0], [np.pi / 2]), seen)
    return replace(at, seen=seen, seen_east=east / np.linalg.norm(east, axis=-1, keepdims=True))


def as_dp3(at: Sampling) -> Sampling:
    """Sources from casacore's observatory "LOFAR", 49 m from the centre of the Earth; the beam former as EveryBeam."""
    seen = casacore_itrf(at.slots_s, at.ra_rad, at.dec_rad, site="LOFAR")
    centre = casacore_itrf(at.slots_s, [at.centre.ra_rad], [at.centre.dec_rad])[:, 0]
    return replace(with_everybeam_north(at, seen), seen_centre=centre)
