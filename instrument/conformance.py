"""Conformance: the contract of each kind of component as claims, checked on anyone's plugin in one call.

`check(obj)` returns a `Report`, one line per claim. A claim is a function whose name is the sentence it checks: it
returns a remark (what was measured) and raises when it does not hold. The claims of Jones terms are in
`conformance_terms`, those of engines in `conformance_engines`, those of foreground removers in
`conformance_foregrounds`, those of stages in `conformance_stages`; what they are tried on is in `conformance_bench`.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import reduce
from typing import Any, NamedTuple

import numpy as np

from instrument import conformance_engines, conformance_foregrounds, conformance_stages, conformance_terms, mat2
from instrument.component import Component
from instrument.conformance_bench import (
    Broken,
    bench,
    cuts,
    demand,
    demand_repeatable,
    demand_same,
    fresh,
    problems,
)
from instrument.errors import InputError, InstrumentError, InstrumentWarning
from instrument.foreground.base import ForegroundRemover
from instrument.jones.base import JonesTerm
from instrument.jones.feed import FeedTerm
from instrument.jones.gain import GainTerm
from instrument.model import Instrument
from instrument.observe.sampling import Sampling
from instrument.pipeline.stage import Stage
from instrument.predict.base import Predictor
from instrument.sky.base import Sky


class Line(NamedTuple):
    """One claim: the sentence, whether it holds, and what was measured or went wrong."""

    claim: str
    passed: bool
    detail: str


@dataclass(frozen=True)
class Report:
    """What `check` found of an object, one line per claim."""

    subject: str
    lines: tuple[Line, ...]

    @property
    def passed(self) -> bool:
        """Whether every claim holds."""
        return not self.failed

    @property
    def failed(self) -> tuple[Line, ...]:
        """The claims that do not hold."""
        return tuple(line for line in self.lines if not line.passed)

    def __str__(self) -> str:
        width = max(len(line.claim) for line in self.lines)
        rows = [f"{'ok' if n.passed else 'FAILED':<7} {n.claim:<{width}}  {n.detail}".rstrip() for n in self.lines]
        return "\n".join([f"{self.subject}: {len(self.lines)} claims, {len(self.failed)} failed", *rows])

    def raise_if_failed(self) -> None:
        """Raise `InstrumentError` that names the claims that do not hold."""
        if not self.passed:
            broken = "; ".join(f"{line.claim}: {line.detail}" for line in self.failed)
            raise InstrumentError(f"{self.subject} breaks its contract: {broken}")


def check(obj: object, at: Sampling | None = None) -> Report:
    """Check a Jones term, an instrument, a sky, an engine, a remover or a stage against the contract of its kind.

    `at` is where a term is evaluated and where a sky is placed, for those that fit one array only (tables per station);
    a small array of LOFAR-like stations otherwise. Raises `InputError` where there is no contract for such an object.
    """
    for kind, contract in CONTRACTS.items():
        if isinstance(obj, kind):
            with warnings.catch_warnings():
                warnings.simplefilter("ignore", InstrumentWarning)
                return Report(type(obj).__name__, tuple(contract(obj, at)))
    known = ", ".join(kind.__name__ for kind in CONTRACTS)
    shown = f"the class {obj.__name__}" if isinstance(obj, type) else f"a {type(obj).__name__}"
    raise InputError(f"there is no contract for {shown}: give an object of one of {known}")


def _line(claim: Callable[..., str], *given: Any, before: str = "", after: str = "") -> Line:
    sentence = before + claim.__name__.replace("_", " ") + after
    try:
        return Line(sentence, True, claim(*map(fresh, given)))
    except Broken as error:
        return Line(sentence, False, str(error))
    except Exception as error:  # a stranger's plugin may fail in any way
        return Line(sentence, False, f"{type(error).__name__}: {error}")


def a_round_trip_through_json_gives_an_equal_object(obj: Component, kind: type[Component]) -> str:
    """JSON, read by the abstract class, gives the same class and equal fields."""
    back = kind.from_json(obj.to_json())
    demand(type(back) is type(obj), f"it comes back as {type(back).__name__}")
    demand(back == obj, "it comes back unequal")
    return ""


def its_layout_and_chain_are_the_same_every_time(instrument: Instrument) -> str:
    """`layout()` and `chain()` have no memory; there are at least two stations."""
    layout, chain = instrument.layout(), instrument.chain()
    demand(len(layout) >= 2, f"{len(layout)} station")
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


def _instrument(instrument: Instrument, at: Sampling | None) -> Iterator[Line]:
    first = _line(its_layout_and_chain_are_the_same_every_time, instrument)
    yield first
    yield _line(a_round_trip_through_json_gives_an_equal_object, instrument, Instrument)
    if not first.passed:
        return
    chain = instrument.chain()
    where = bench(chain.parts, instrument.layout())
    for claim in (
        its_chain_runs_from_sky_to_feed,
        its_chain_is_finite_and_not_zero_where_risen,
        the_factors_of_its_chain_multiply_to_its_jones,
        its_differential_beam_is_one_at_the_pointing,
        a_call_of_its_chain_has_no_side_effects,
    ):
        yield _line(claim, instrument, where)
    for term in chain.terms:
        for line in _term(term, where):
            yield line._replace(claim=f"{type(term).__name__}: {line.claim}")


def _term(term: JonesTerm, at: Sampling | None) -> Iterator[Line]:
    where = at or bench(term.parts())
    for claim in conformance_terms.CLAIMS:
        yield _line(claim, term, where)
    yield _line(a_round_trip_through_json_gives_an_equal_object, term, JonesTerm)


def about_a_phase_centre_its_directions_are_fixed(sky: Sky, at: Sampling) -> str:
    """`about` changes nothing on the sky, gives the same twice, and what it gives needs no placing any more."""
    before = sky.to_json()
    placed = sky.about(at.centre)
    demand(sky.to_json() == before, "about changes the sky")
    demand(sky.about(at.centre) == placed, "a second about gives another sky")
    demand(placed.about(at.centre) == placed, "what about gives is not placed")
    ra, dec = placed.directions()
    demand(ra.ndim == 1 and ra.shape == dec.shape and ra.size, f"directions of shapes {ra.shape} and {dec.shape}")
    demand(np.all(np.isfinite(ra)) and np.all(np.abs(dec) <= np.pi / 2 + 1e-12), "directions off the sphere")
    return f"{len(ra)} directions"


def its_brightness_is_times_channels_directions_2_2(sky: Sky, at: Sampling) -> str:
    """Complex (T, F, S, 2, 2), every axis full or of length 1, finite."""
    found = sky.brightness(at)
    due = (at.shape[0], at.shape[1], at.shape[3])
    fits = found.ndim == 5 and all(n in (1, m) for n, m in zip(found.shape, due, strict=False))
    demand(fits and found.shape[-2:] == (2, 2), f"{found.shape} for a sampling of {at.shape}")
    demand(np.all(np.isfinite(found)), "not finite")
    return str(found.shape)


def its_brightness_is_hermitian(sky: Sky, at: Sampling) -> str:
    """[[I+Q, U+iV], [U-iV, I-Q]] with real I, Q, U, V."""
    found = sky.brightness(at)
    return demand_same(found, mat2.herm(found), "brightness and its conjugate transpose")


def a_block_of_its_brightness_equals_the_slice_of_the_whole(sky: Sky, at: Sampling) -> str:
    """Asking for one time or channel gives what it has among the others, and an axis of length 1 is constant."""
    for _, name, where, due in cuts(sky.brightness(at), at, (0, 1)):
        demand_same(sky.brightness(where), due, f"{name} alone")
    return ""


def its_envelope_takes_nothing_off_a_baseline_of_zero(sky: Sky, at: Sampling) -> str:
    """`None`, or real (T, F, B, S) within 0 and 1, and 1 where u = v = w = 0."""
    uvw = np.random.default_rng(0).uniform(-3e3, 3e3, (*at.shape[:2], 4, 3))
    uvw[:, :, 0] = 0.0
    found = sky.envelope(at, uvw)
    if found is None:
        return "points only"
    due = (*uvw.shape[:3], at.shape[3])
    demand(found.ndim == 4 and all(n in (1, m) for n, m in zip(found.shape, due, strict=True)), f"{found.shape}")
    demand(np.isrealobj(found) and np.all((found >= 0) & (found <= 1)), "not a number between 0 and 1")
    return demand_same(found[:, :, 0], np.ones(1), "envelope at u = v = w = 0")


def its_list_of_sources_is_the_sky(sky: Sky, at: Sampling) -> str:
    """`sources()`: `None`, or a list with the same directions, brightness and envelope."""
    listed = sky.sources()
    if listed is None:
        return "not a list"
    demand_same(np.stack(listed.directions()), np.stack(sky.directions()), "directions of the list")
    return demand_same(listed.brightness(at), sky.brightness(at), "brightness of the list")


def a_call_of_its_brightness_has_no_side_effects(sky: Sky, at: Sampling) -> str:
    """The same call twice gives the same, and nothing that was given has changed."""
    return demand_repeatable(lambda: sky.brightness(at), sky, at)


def _sky(sky: Sky, at: Sampling | None) -> Iterator[Line]:
    where = at or bench()
    first = _line(about_a_phase_centre_its_directions_are_fixed, sky, where)
    yield first
    yield _line(a_round_trip_through_json_gives_an_equal_object, sky, Sky)
    if not first.passed:
        return
    placed = sky.about(where.centre)
    for claim in (
        its_brightness_is_times_channels_directions_2_2,
        its_brightness_is_hermitian,
        a_block_of_its_brightness_equals_the_slice_of_the_whole,
        its_envelope_takes_nothing_off_a_baseline_of_zero,
        its_list_of_sources_is_the_sky,
        a_call_of_its_brightness_has_no_side_effects,
    ):
        yield _line(claim, placed, where.towards(*placed.directions()))


def _engine(engine: Predictor, at: Sampling | None) -> Iterator[Line]:
    some = problems()
    first = _line(conformance_engines.it_serves_some_problem_and_refuses_others_in_a_sentence, engine, some)
    yield first
    yield _line(a_round_trip_through_json_gives_an_equal_object, engine, Predictor)
    if not first.passed:
        return
    served = {name: problem for name, problem in some.items() if engine.refuses(problem) is None}
    for name, problem in served.items():
        yield _line(conformance_engines.it_agrees_with_direct, engine, problem, after=f": {name}")
    for claim in conformance_engines.CLAIMS:
        yield _line(claim, engine, list(served.values())[-1])


def _remover(remover: ForegroundRemover, at: Sampling | None) -> Iterator[Line]:
    yield _line(a_round_trip_through_json_gives_an_equal_object, remover, ForegroundRemover)
    for claim in conformance_foregrounds.CLAIMS:
        yield _line(claim, remover)


def _stage(stage: Stage, at: Sampling | None) -> Iterator[Line]:
    yield _line(a_round_trip_through_json_gives_an_equal_object, stage, Stage)
    for claim in conformance_stages.CLAIMS:
        yield _line(claim, stage)


CONTRACTS: dict[type[Component], Callable[[Any, Sampling | None], Iterator[Line]]] = {
    JonesTerm: _term,
    Instrument: _instrument,
    Sky: _sky,
    Predictor: _engine,
    ForegroundRemover: _remover,
    Stage: _stage,
}
