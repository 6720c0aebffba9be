"""The contests of telescopes: their station beams against the sum over all parts, in extended precision."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from typing import Any

import numpy as np

from instrument.conformance.bench import icrs
from instrument.errors import RefusedError
from instrument.jones.base import ElementBeam
from instrument.model import Instrument
from instrument.observe.directions import earth_frame, offset
from instrument.observe.sampling import Sampling
from instrument.precision import peers
from instrument.precision.contest import Contest, Entry, Form, Trial
from instrument.precision.elements import distance, inverse, within
from instrument.precision.truth import chain_jones, geometry, has_truth, parallactic, product
from instrument.units import Complex, Direction

STATIONS, JUDGED = 12, 25  # stations and directions of which the truth is worked out
DIRECTIONS, TIMES = (50, 400), 60
START, STEP = "2012-12-07T01:00:00", 60.0  # s between times
HELD = tuple(STEP * n for n in (1, 2, 3, 5, 10, 20, 30, 60))  # s for which a beam is held
FIELD = 0.09  # rad: half a side of the field
VARIANTS = {"tiles": "ideal"}  # settings of a telescope that are approximations


def contests(telescopes: dict[str, Any], form: Form) -> list[Contest]:
    """One for each telescope: how long its beams may be held, and what its approximations cost."""
    return [_of(name, cls, form) for name, cls in telescopes.items()]


def small(cls: Any, **settings: Any) -> Instrument:
    """A telescope with the first and last of its stations, and those between, twelve at most."""
    whole = cls(**settings)
    if "stations" not in cls.model_fields:
        return whole
    known = whole.layout().names
    few = np.unique(np.linspace(0, len(known) - 1, STATIONS).astype(int))
    return cls(stations=[known[k] for k in few], **settings)


def where(telescope: Instrument, count: int) -> tuple[Any, Any, Any, Any]:
    """Directions (SkyCoord), times, a frequency and a pointing: a field 10 deg from the zenith at the middle time."""
    from astropy import units as u
    from astropy.coordinates import SkyCoord
    from astropy.time import Time

    layout = telescope.layout()
    times = Time(START, scale="utc") + STEP * np.arange(TIMES) * u.s
    middle = earth_frame(times[TIMES // 2 : TIMES // 2 + 1], layout.centre_m)
    p, _, r = layout.axes[0]
    (ra,), (dec,) = icrs(middle, (np.cos(0.17) * r + np.sin(0.17) * p)[None])
    centre = Direction(float(ra), float(dec))
    ra, dec = offset(centre, *np.random.default_rng(7).uniform(-FIELD, FIELD, (2, count)))
    elements = [part for part in telescope.chain().parts if isinstance(part, ElementBeam)]
    freq_hz = within(elements[0]) if elements else 150e6
    return SkyCoord(ra * u.rad, dec * u.rad), times, freq_hz * u.Hz, centre.skycoord


def _of(name: str, cls: Any, form: Form) -> Contest:
    telescope, few = cls(), small(cls)
    count = DIRECTIONS[0] if form.quick else DIRECTIONS[1]
    directions, times, freq, centre = where(telescope, count)
    whole = telescope.sampling(directions, times, freq, centre)
    # the Earth moves as at the centre of the whole array
    at = replace(whole, layout=few.layout()).towards(whole.ra_rad[:JUDGED], whole.dec_rad[:JUDGED])
    truth = _truth(few, at)
    stations = [telescope.layout().index(name) for name in few.layout().names]

    @cache
    def rotation() -> tuple[Any, Any]:
        """From north and east into the axes of the antennas, towards the directions and the pointing."""
        return tuple(parallactic(None, a, geometry(a)) for a in (at, at.at_centre()))

    def judge(found: Any, asked: float) -> Trial:
        if not isinstance(found, peers.Horizon):
            return distance(found[:, :, stations, :JUDGED], truth)
        jones = found.jones[:, :, stations, :JUDGED].astype(np.clongdouble)
        to, middle = (r[found.times] for r in rotation())
        beam = product(found.centre[:, :, stations].astype(np.clongdouble), middle)
        return distance(product(inverse(beam), product(jones, to)), truth.conj())

    def entry(label: str, one: Instrument) -> Entry:
        def answer(held: float) -> Complex:
            if truth is None:
                raise RefusedError("a term of it gives no truth(at, geometry) in extended precision")
            asked, which = shared(held)
            found = one.beam(directions, times[asked], freq, centre, state="differential")
            return found if len(asked) == TIMES else found[which]

        return Entry(label, answer)

    variants = {field: value for field, value in VARIANTS.items() if field in cls.model_fields}
    entries = [entry(name, telescope), *(entry(f"{name}, {k} {v}", cls(**{k: v})) for k, v in variants.items())]
    if form.peers and name in peers.LOFAR:
        entries += peers.station_beams(telescope, whole, shared)
    return Contest(
        name=f"beam of {name}, {TIMES * len(telescope.layout()) * count} station matrices",
        kind="telescopes",
        knob="held, s",
        values=HELD[::2] if form.quick else HELD,
        entries=tuple(entries),
        judge=judge,
        peers=peers.EVERYBEAM if name in peers.LOFAR else (),
        error=f"largest error of a differential matrix over the largest, {len(stations)} of the stations, {JUDGED} "
        f"directions within {2 * np.rad2deg(FIELD):.0f} deg, {TIMES} min",
        error_user="rms error of the intrinsic leakage, 1/sqrt(IXR)",
        truth="the sum over all parts of a station, times the element, in extended precision",
    )


def shared(held: float) -> tuple[Any, Any]:
    """Numbers of the times whose beams are asked for, held for so many seconds, and which each time takes."""
    steps = round(held / STEP)
    # the middle one of the times that share a beam
    return np.unique(np.minimum(np.arange(TIMES) // steps * steps + steps // 2, TIMES - 1), return_inverse=True)


def _truth(telescope: Instrument, at: Sampling) -> Any:
    """Differential matrices (T, F, A, S, 2, 2) in extended precision, or `None` where a term has no formula there."""
    chain, _ = telescope.chain().simplified(at)
    if not all(map(has_truth, chain.terms)):
        return None
    both = (at, at.at_centre())
    found, middle = (np.broadcast_to(chain_jones(chain.terms, a, geometry(a)), (*a.shape, 2, 2)) for a in both)
    return product(inverse(middle), found)
