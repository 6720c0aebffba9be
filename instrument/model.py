"""Instrument: a layout of stations and the chain of Jones terms of each; its beam and its Mueller matrices."""

from __future__ import annotations

from abc import abstractmethod
from typing import Any, ClassVar, Literal

import numpy as np

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


@checked
class Instrument(Component):
    """A radio interferometer: a subclass has its own fields and gives `layout()` and `chain()`.

    `gain` and `feed` are the direction-independent errors of its receivers. A chain whose last term takes "sky" is
    complete; where none does (no beam), the feeds are taken to lie along north and east.
    """

    plugin_kind: ClassVar[str | None] = "telescopes"
    gain: GainTerm | None = None
    feed: FeedTerm | None = None

    @abstractmethod
    def layout(self) -> Layout:
        """Stations of the array."""

    @abstractmethod
    def chain(self) -> Chain:
        """Jones terms, receiver to sky."""

    def receivers(self) -> tuple[JonesTerm, ...]:
        """Gains and feed errors, for the left end of a chain; the identity where none are given."""
        return self.gain or GainTerm(), self.feed or FeedTerm()

    def checked_chain(self) -> Chain:
        """`chain()`; raises `InputError` where it leaves out the gains or feeds of this instrument."""
        chain = self.chain()
        for name, term in (("gain", self.gain), ("feed", self.feed)):
            if term is not None and not any(part == term for part in chain.parts):
                raise InputError(
                    f"{type(self).__name__}.chain() leaves out the '{name}' that was given: let it begin with "
                    "*self.receivers()"
                )
        return chain

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
        whole = self.checked_chain()
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
        """Mueller matrices of one baseline (the first by default), complex (T, F, S, 4, 4)."""
        layout = self.layout()
        if isinstance(baseline, str):
            raise InputError(f"baseline = '{baseline}' is one station: give two, ('{baseline}', ...)")
        pair = layout.names[:2] if baseline is None else tuple(baseline)
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

    stations: Layout
    terms: Chain = Chain()

    def layout(self) -> Layout:
        """The layout as given."""
        return self.stations

    def chain(self) -> Chain:
        """Gains and feed errors if given, then the terms as given."""
        return Chain(*(t for t in (self.gain, self.feed) if t is not None), *self.terms.terms)


def warn_outside_band(chain: Chain, freq_hz: Float) -> None:
    """Warn, once for each element beam, when it is asked outside the band it was made for."""
    for term in chain.parts:
        if not isinstance(term, ElementBeam):
            continue
        low, high = term.band_hz()
        outside = freq_hz[(freq_hz < low) | (freq_hz > high)]
        if outside.size:
            warn(
                f"{type(term).__name__} was made for {low / 1e6:g} to {high / 1e6:g} MHz: it extrapolates at "
                f"{outside.min() / 1e6:g} MHz" + (f" to {outside.max() / 1e6:g} MHz" if outside.size > 1 else "")
            )
