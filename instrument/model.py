"""Instrument: a layout of stations and the chain of Jones terms of each; its beam and its Mueller matrices."""

from __future__ import annotations

import functools
import json
from abc import abstractmethod
from collections.abc import Callable, Mapping
from typing import Annotated, Any, ClassVar, Literal, Self

import numpy as np
from pydantic import BeforeValidator

from instrument import mat2
from instrument.checked import checked
from instrument.component import Component
from instrument.errors import InputError, warn
from instrument.jones.base import ElementBeam, JonesTerm
from instrument.jones.chain import Chain
from instrument.jones.feed import FeedTerm
from instrument.jones.gain import GainTerm
from instrument.jones.mueller import mueller
from instrument.observe.layout import Layout
from instrument.observe.sampling import Sampling
from instrument.units import Complex, Direction, Float, direction, icrs_of, instants, to_si

State = Literal["absolute", "differential"]


def _of_chain(value: Any) -> Any:
    """The terms of a chain, or of the text of one."""
    if isinstance(value, Mapping) and "terms" in value:
        value = Chain.from_json(json.dumps(value))
    return value.terms if isinstance(value, Chain) else value


def _directional(term: JonesTerm) -> bool:
    return any(part.directional for part in term.parts())


def _whole(chain: Callable[[Any], Chain]) -> Callable[[Any], Chain]:
    """The `chain` of a class of instruments with all that was given to the instrument; what is there stays there."""

    @functools.wraps(chain)
    def whole(self: Instrument) -> Chain:
        found = chain(self)
        place = 0
        for term in self.errors():
            there = _place(found, term, self)
            if there is None:
                found = found.with_term(term, place)
                there = place
            place = there + 1
        others = self._entering(errors=False)
        for k, term in enumerate(others):
            if _place(found, term, self) is None:
                alike = (_place(found, t, self) for t in others[:k] if t.maps == term.maps)
                begin = [1 + n for n in alike if n is not None]
                found = term.enter(found, max([len(found.gains().terms), *begin]))
        return found

    return whole


def _place(chain: Chain, term: JonesTerm, given: Instrument) -> int | None:
    """Where a term that was given stands in a chain: itself, alone or in a composite; an equal gain or feed will do."""
    equal = term is given.gain or term is given.feed
    for k, whole in enumerate(chain.terms):
        if any(part is term or (equal and part == term) for part in (whole, *whole.parts())):
            return k
    return None


@checked
class Instrument(Component):
    """A radio interferometer: a subclass has its own fields and gives `layout()` and `chain()`.

    `gain`, `feed` and `terms` (more Jones terms, receiver to sky) can be given to every instrument: what a subclass
    leaves out of its chain of them is put in here, so that none can be forgotten. Errors of the receivers (`gain`,
    `feed`, and those of `terms` that take and give "feed" and are the same for every direction) are the left end of the
    chain. Each other term stands right of all that is the same for every direction, at the leftmost place where its
    bases fit; of two with the same bases the first stands left. A chain whose last term takes "sky" is complete; where
    none does (no beam), the feeds are taken to lie along north and east.
    """

    plugin_kind: ClassVar[str | None] = "telescopes"
    telescope_name: ClassVar[str] = ""  # as Measurement Sets have it
    terms_enter: ClassVar[bool] = True  # False where `terms` are the chain itself
    gain: GainTerm | None = None
    feed: FeedTerm | None = None
    terms: Annotated[tuple[JonesTerm, ...], BeforeValidator(_of_chain)] = ()

    def __init_subclass__(cls, **settings: Any) -> None:
        super().__init_subclass__(**settings)
        if "chain" in vars(cls):
            cls.chain = _whole(vars(cls)["chain"])  # type: ignore[method-assign,assignment]

    @abstractmethod
    def layout(self) -> Layout:
        """Stations of the array."""

    @abstractmethod
    def chain(self) -> Chain:
        """Jones terms, receiver to sky; whoever calls it finds gain, feed and terms in it."""

    def receivers(self) -> tuple[JonesTerm, ...]:
        """Errors of the receivers, the left end of the chain; the identity for a gain or feed that is not given."""
        return *self._entering(errors=True), self.gain or GainTerm(), self.feed or FeedTerm()

    def errors(self) -> tuple[JonesTerm, ...]:
        """Those errors of the receivers that were given: what calibration is there to find."""
        return *self._entering(errors=True), *(t for t in (self.gain, self.feed) if t is not None)

    def perfect(self) -> Self:
        """The same instrument without errors of its receivers: what a calibration compares with."""
        left = self._entering(errors=False) if self.terms_enter else self.terms
        return self.with_fields(gain=None, feed=None, terms=left)

    def _entering(self, errors: bool) -> tuple[JonesTerm, ...]:
        terms = self.terms if self.terms_enter else ()
        return tuple(t for t in terms if (t.maps == ("feed", "feed") and not _directional(t)) == errors)

    def beam(
        self, directions: Any, times: Any, frequencies: Any, pointing: Any = None, state: State = "absolute"
    ) -> Complex:
        """Jones matrices of every station, complex (T, F, A, S, 2, 2).

        `directions` (SkyCoord, S), `times` (Time or UTC strings, T), `frequencies` (Quantity, F), `pointing` (one
        SkyCoord; the direction itself where there is only one). `state` "absolute" is the raw beam, "differential" is
        inv(J(pointing)) @ J(direction) per station, time and channel. Columns are north and east at each source.
        Raises `InputError` for impossible input and where the beam at the pointing is singular.
        """
        if state not in ("absolute", "differential"):
            raise InputError(f"state = '{state}' is not a state of a beam: 'absolute' or 'differential'")
        at = self.sampling(directions, times, frequencies, pointing)
        whole = self.chain()
        warn_outside_band(whole, at.freq_hz)
        chain, _ = whole.simplified(at)
        found = chain.jones(at)
        if state == "differential":
            centre = mat2.inverse(chain.jones(at.at_centre()))
            if not np.all(np.isfinite(centre)):
                raise InputError(
                    "the beam at the pointing is singular (below the horizon?): it has no differential beam"
                )
            found = mat2.mul(centre, found)
        return np.broadcast_to(found, (*at.shape, 2, 2)).copy()

    def mueller(
        self,
        directions: Any,
        times: Any,
        frequencies: Any,
        pointing: Any = None,
        baseline: tuple[str, str] | None = None,
        state: State = "differential",
    ) -> Complex:
        """Mueller matrices of one baseline, complex (T, F, S, 4, 4).

        The first by default; that of a station with itself where there is one alone.
        """
        layout = self.layout()
        if isinstance(baseline, str):
            raise InputError(f"baseline = '{baseline}' is one station: give two, ('{baseline}', ...)")
        pair = (layout.names * 2)[:2] if baseline is None else tuple(baseline)
        if len(pair) != 2 or not all(isinstance(n, str) for n in pair):
            raise InputError(f"baseline = {pair} must be the names of two stations")
        a, b = (layout.index(n) for n in pair)
        found = self.beam(directions, times, frequencies, pointing, state)
        return mueller(found[:, :, a], found[:, :, b])

    def sampling(self, directions: Any, times: Any, frequencies: Any, pointing: Any = None) -> Sampling:
        """The `Sampling` of this array at directions (SkyCoord), times (Time) and frequencies (Quantity)."""
        from astropy.coordinates import SkyCoord

        if isinstance(directions, str):
            directions = direction(directions, "directions").skycoord
        if not isinstance(directions, SkyCoord):
            raise InputError(f"directions must be a SkyCoord, got {type(directions).__name__}")
        when = instants(times)
        icrs = icrs_of(directions)
        ra, dec = np.atleast_1d(icrs.ra.rad).ravel(), np.atleast_1d(icrs.dec.rad).ravel()
        if not (np.all(np.isfinite(ra)) and np.all(np.isfinite(dec))):
            raise InputError("directions are not finite")
        if pointing is None:
            if len(ra) > 1:
                raise InputError(f"{len(ra)} directions need a pointing: give pointing=SkyCoord(...)")
            pointing = Direction(float(ra[0]), float(dec[0]))
        centre = direction(pointing, "pointing")
        freq = np.atleast_1d(np.asarray(to_si(frequencies, "Hz", "frequencies", above=0), float))
        return Sampling.build(self.layout(), when, freq, ra, dec, centre)


@checked
class Composed(Instrument):
    """An instrument put together by hand from a layout and Jones terms, receiver to sky."""

    terms_enter: ClassVar[bool] = False
    stations: Layout

    def layout(self) -> Layout:
        """The layout as given."""
        return self.stations

    def chain(self) -> Chain:
        """Gains and feed errors if given, then the terms as given."""
        return Chain(*self.errors(), *self.terms)


def warn_outside_band(chain: Chain, freq_hz: Float) -> None:
    """Warn, once for each element beam, when it is asked outside the band it was made for."""
    for term in chain.parts:
        if not isinstance(term, ElementBeam):
            continue
        low, high = term.band_hz()
        outside = freq_hz[(freq_hz < low) | (freq_hz > high)]
        if outside.size:
            warn(
                f"{term.called} was made for {low / 1e6:g} to {high / 1e6:g} MHz: it extrapolates at "
                f"{outside.min() / 1e6:g} MHz" + (f" to {outside.max() / 1e6:g} MHz" if outside.size > 1 else "")
            )
