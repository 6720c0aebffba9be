"""The claims about instruments: a layout and a chain of terms that do not change, from the sky to the feeds."""

from __future__ import annotations

from functools import reduce

import numpy as np

from instrument import mat2
from instrument.conformance.bench import demand, demand_repeatable, demand_same
from instrument.jones.feed import FeedTerm
from instrument.jones.gain import GainTerm
from instrument.model import Instrument
from instrument.observe.sampling import Sampling


def its_layout_and_chain_are_the_same_every_time(instrument: Instrument) -> str:
    """`layout()` and `chain()` have no memory; there is a station."""
    layout, chain = instrument.layout(), instrument.chain()
    demand(len(layout) >= 1, "no station")
    demand(layout == instrument.layout(), "the second layout differs from the first")
    demand(chain == instrument.chain(), "the second chain differs from the first")
    return f"{len(layout)} stations, {len(chain.terms)} terms"


def its_chain_runs_from_sky_to_feed(instrument: Instrument, at: Sampling) -> str:
    """Its gain and feed, where given, are the left end, the rest stays as it is; the right end takes the sky, or feeds
    along north and east where there is no beam.
    """
    rest = instrument.with_fields(gain=None, feed=None).chain().jones(at)
    gain, feed = GainTerm(values=np.full((1, 1, 1, 2), 2.0)), FeedTerm(values=np.full((1, 1, 1, 2), 0.5))
    found = instrument.with_fields(gain=gain, feed=feed).chain().jones(at)
    due = mat2.mul(mat2.mul(gain.jones(at), feed.jones(at)), rest)
    demand_same(found, due, "a given gain and feed are left out: gain x feed x the rest of the chain")
    terms = instrument.chain().terms
    if not terms:
        return "no term"
    demand(terms[0].maps[1] == "feed", f"its left end, {type(terms[0]).__name__}, gives '{terms[0].maps[1]}'")
    demand(terms[-1].maps[0] != "horizon", f"its right end, {type(terms[-1]).__name__}, takes 'horizon'")
    return f"{terms[-1].maps[0]} to feed"


def its_chain_is_finite_and_not_zero_where_risen(instrument: Instrument, at: Sampling) -> str:
    """(T, F, A, S, 2, 2) for its own stations; finite everywhere, and something of the phase centre is received."""
    found = np.broadcast_to(instrument.chain().jones(at), (*at.shape, 2, 2))
    demand(np.all(np.isfinite(found)), "not finite")
    received = np.abs(found[0, :, 0, 0]).max()
    demand(received > 0, "zero at 25 deg from the zenith of the first station")
    return f"{received:.2g} at 25 deg from the zenith"


def the_factors_of_its_chain_multiply_to_its_jones(instrument: Instrument, at: Sampling) -> str:
    """The cheap form of the chain that fast engines use is its plain product."""
    chain = instrument.chain()
    f = chain.factors(at)
    parts = [np.broadcast_to(mat2.IDENTITY, (1, 1, 1, 1, 2, 2))]
    parts += [
        x for x in (f.outer, None if f.scalar is None else f.scalar[..., None, None] * mat2.IDENTITY) if x is not None
    ]
    parts += [] if f.shared is None else [f.shared[:, :, f.group]]
    return demand_same(reduce(mat2.mul, parts), chain.jones(at), "outer x scalar x shared")


def its_differential_beam_is_one_at_the_pointing(instrument: Instrument, at: Sampling) -> str:
    """`beam(...)` from SkyCoord, Time and Quantity: (T, F, A, 1, 2, 2), the identity where it points."""
    from astropy import units as u
    from astropy.time import Time

    where, times = at.centre.skycoord, Time(at.slots_s[:1] / 86400, format="mjd", scale="utc")
    found = instrument.beam(where, times, at.freq_hz * u.Hz, pointing=where, state="differential")
    demand(found.shape == (1, *at.shape[1:3], 1, 2, 2), f"shape {found.shape}")
    return demand_same(found, mat2.IDENTITY, "differential beam at the pointing")


def a_call_of_its_chain_has_no_side_effects(instrument: Instrument, at: Sampling) -> str:
    """The same call twice gives the same, and nothing that was given has changed."""
    return demand_repeatable(lambda: instrument.chain().jones(at), instrument, at, at.itrf, at.local)


CLAIMS = (
    its_chain_runs_from_sky_to_feed,
    its_chain_is_finite_and_not_zero_where_risen,
    the_factors_of_its_chain_multiply_to_its_jones,
    its_differential_beam_is_one_at_the_pointing,
    a_call_of_its_chain_has_no_side_effects,
)
