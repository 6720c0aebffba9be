"""Visibilities: data of all baselines with their coordinates, weights, flags, and which beam has been taken out."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any, Literal

import numpy as np

from instrument import mat2
from instrument.checked import checked
from instrument.errors import BeamStateError, InputError, warn
from instrument.jones import mueller
from instrument.jones.base import JonesTerm
from instrument.jones.chain import Chain
from instrument.jones.gain import exact_key, slot_normals
from instrument.jones.towards import Towards, towards_in
from instrument.model import Instrument
from instrument.numbers import LARGEST
from instrument.observe.layout import Layout
from instrument.observe.sampling import Sampling
from instrument.units import POSITIVE, SEED, Bool, Complex, Direction, Float, Int, one_si, plain

CANCELS = 1e6  # of a Jones matrix: its inverse twice in double precision leaves 1e-4


@checked
@dataclass(frozen=True)
class BeamState:
    """What has been taken out of visibilities: "nothing" or "centre" (the beam), and towards where.

    `beams` is the part of the chain in the data that differs between directions; `None` where nobody knows it (data
    from elsewhere). `other` says that it was another beam that has been taken out.
    """

    removed: Literal["nothing", "centre"] = "nothing"
    towards: Direction | None = None
    beams: Chain | None = field(default=None, compare=False)
    other: bool = False

    def __str__(self) -> str:
        if self.removed == "centre":
            which = "another beam" if self.other else "differential beam"
            return f"{which}, removed towards {self.towards}"
        return "no beam" if self.beams is not None and not self.beams.terms else "absolute beam"

    def without(self, beam: Towards, centre: Direction) -> BeamState:
        """The state after a beam is taken out; raises `BeamStateError` where it cannot be in the data (any more)."""
        if self.removed != "nothing":
            raise BeamStateError(f"a beam has been taken out already ({self}): start from uncorrected visibilities")
        taken = beam.chain.beams()
        if self.beams is not None and taken.terms and not self.beams.terms:
            raise BeamStateError("there is no beam in these visibilities (beam=None): there is none to take out")
        other = self.beams is not None and taken != self.beams
        if other:
            warn("the beam that is taken out is not the beam that is in the data: their ratio is left at the centre")
        return BeamState("centre", beam.direction or centre, self.beams, other)

    def with_beam(self, beam: Towards) -> BeamState:
        """The state after the beam at one direction is put on; raises `BeamStateError` where one is there."""
        if self.removed == "centre":
            return BeamState(beams=self.beams)
        if self.beams is not None and self.beams.terms and beam.chain.beams().terms:
            raise BeamStateError("a beam is in the data already: it would be there twice")
        return BeamState(beams=beam.chain.beams())


def _ones() -> Float:
    return np.ones((1, 1, 1))


def _no_flags() -> Bool:
    return np.zeros((1, 1, 1), bool)


@checked
@dataclass(frozen=True, eq=False)
class Visibilities:
    """Visibilities in Jy, complex (T, F, B, 2, 2): rows are receptors p, q of the first station, columns of the second.

    `at` holds times, channels, stations and the phase centre; `weight` (finite, not negative) and `flag` (bool) are
    (T, F, B), length 1 where constant. Nothing is changed in place: every method returns a new object.
    """

    data: Complex
    at: Sampling
    antenna1: Int
    antenna2: Int
    interval_s: float
    width_hz: float | None = None
    weight: Float = field(default_factory=_ones)
    flag: Bool = field(default_factory=_no_flags)
    beam_state: BeamState = BeamState()

    def __post_init__(self) -> None:
        self._as_the_kernels_take_them()
        times, channels, _, _ = self.at.shape
        want = (times, channels, len(self.antenna1), 2, 2)
        if self.data.shape != want:
            raise InputError(f"data has shape {self.data.shape}, the coordinates need {want}")
        POSITIVE.check(self.interval_s, "interval_s")
        if self.width_hz is not None:
            POSITIVE.check(self.width_hz, "width_hz")
        for name in ("antenna1", "antenna2"):
            stations = getattr(self, name)
            if stations.dtype.kind not in "iu" or np.any((stations < 0) | (stations >= len(self.layout))):
                raise InputError(f"{name} must hold numbers of stations, 0 to {len(self.layout) - 1}")
        self._check_baselines()
        for name in ("weight", "flag"):
            shape = getattr(self, name).shape
            if len(shape) != 3 or any(n not in (1, m) for n, m in zip(shape, want, strict=False)):
                raise InputError(f"{name} has shape {shape}, needed {want[:3]} with length 1 where constant")
        if self.flag.dtype.kind != "b":
            raise InputError(f"flag holds {self.flag.dtype}, needed bool")
        if self.weight.dtype.kind not in "fiu" or not np.all(np.isfinite(self.weight)) or np.any(self.weight < 0):
            raise InputError("weight must be finite and not negative: flag what does not count")
        beyond = self.weight[(self.weight > 0) & ((self.weight < 1 / LARGEST) | (self.weight > LARGEST))]
        if beyond.size:
            raise InputError(f"weight = {beyond[0]:g} is beyond what squares can hold: scale all of them")

    def _as_the_kernels_take_them(self) -> None:
        """Numbers of any precision and byte order in double precision and the machine's own order."""
        for name, kind in (("data", complex), ("weight", float), ("antenna1", int), ("antenna2", int)):
            given = getattr(self, name)
            if given.dtype.kind in "fiuc" and given.dtype != kind and not (kind is int and given.dtype.kind == "f"):
                object.__setattr__(self, name, given.astype(kind))

    def _check_baselines(self) -> None:
        first, second, names = self.antenna1, self.antenna2, self.layout.names
        if first.shape != second.shape:
            raise InputError(f"antenna1 has {len(first)} baselines, antenna2 {len(second)}")
        if (alone := np.flatnonzero(first == second)).size:
            raise InputError(f"baseline {alone[0]} is of station '{names[first[alone[0]]]}' with itself: leave it out")
        pairs, count = np.unique(np.minimum(first, second) * len(names) + np.maximum(first, second), return_counts=True)
        if len(pairs) < len(first):
            a, b = divmod(int(pairs[count.argmax()]), len(names))
            raise InputError(f"baseline {names[a]}-{names[b]} is there twice: leave one out")

    def __repr__(self) -> str:
        times, channels, baselines = self.data.shape[:3]
        return (
            f"Visibilities({times} times, {channels} channels, {baselines} baselines, {len(self.layout)} stations, "
            f"{100 * float(np.mean(self.flag)):.3g} % flagged, {self.beam_state})"
        )

    @property
    def layout(self) -> Layout:
        """The stations."""
        return self.at.layout

    @property
    def phase_centre(self) -> Direction:
        """Where the fringes are stopped."""
        return self.at.centre

    @property
    def freq_hz(self) -> Float:
        """Channel centres, Hz (F,)."""
        return self.at.freq_hz

    @property
    def times(self) -> Any:
        """Centres of the integrations, UTC `Time` (T,)."""
        from astropy.time import Time

        return Time(self.at.slots_s // 86400, (self.at.slots_s % 86400) / 86400, format="mjd", scale="utc")

    @cached_property
    def uvw_m(self) -> Float:
        """Baselines u, v, w in m (T, B, 3): station 1 minus station 2."""
        stations = self.at.uvw_m
        return stations[:, self.antenna1] - stations[:, self.antenna2]

    @property
    def effective_weight(self) -> Float:
        """Weights with flagged and non-finite data at zero, (T, F, B)."""
        good = (
            ~self.flag & np.isfinite(self.data.real).all(axis=(-2, -1)) & np.isfinite(self.data.imag).all(axis=(-2, -1))
        )
        return np.where(good, self.weight, 0.0)

    def with_data(self, data: Complex) -> Visibilities:
        """The same coordinates with other data, (T, F, B, 2, 2)."""
        return replace(self, data=data)

    def flagged(self, flag: Bool) -> Visibilities:
        """The same with more flags, (T, F, B), length 1 where constant."""
        return replace(self, flag=self.flag | flag)

    def weighted(self, weight: Float) -> Visibilities:
        """The same with other weights (T, F, B), length 1 where constant; negative and non-finite ones raise."""
        return replace(self, weight=plain(weight, float, "weight"))

    def stokes(self) -> Complex:
        """Stokes visibilities I, Q, U, V in Jy, complex (T, F, B, 4): I = (pp+qq)/2 and so on."""
        return mueller.stokes(self.data)

    def noise_jy(self, sefd: Any) -> float:
        """Rms of the noise in the real or imaginary part of one correlation: SEFD / sqrt(2 dnu dt), in Jy."""
        value = one_si(sefd, "Jy", "sefd", at_least=0)
        if self.width_hz is None:
            raise InputError(
                "noise needs the width of a channel, which one channel and channels apart do not tell: give "
                "channel_width to the Observation"
            )
        return value / float(np.sqrt(2 * self.width_hz * self.interval_s))

    def with_noise(self, sefd: Any, seed: int) -> Visibilities:
        """The same with thermal noise of stations of one system equivalent flux density added.

        The noise of an integration and channel depends on seed, time and frequency only, not on the blocks of a run.
        """
        seed, sigma = SEED.check(seed, "seed"), self.noise_jy(sefd)
        noisy = np.array(self.data)
        count = len(self.antenna1)
        for i, freq in enumerate(self.freq_hz):
            # slot_normals has unit power over both parts, so each part has 1/2
            noisy[:, i] += np.sqrt(2) * sigma * slot_normals((seed, exact_key(freq)), self.at.slots_s, (count, 2, 2))
        return replace(self, data=noisy)

    def corrected(self, term: JonesTerm | Chain) -> Visibilities:
        """J_a^-1 V J_b^-H for a direction-independent term; zero and flagged where J or its square has no inverse.

        So also where the inverse cancels to a part in 1e6 or less: data would be wrong by 1e-4 of themselves and more.
        """
        jones = self._station_jones(term)
        inverse = mat2.inverse(jones)
        largest = np.abs(inverse).max(axis=(-2, -1))  # the data are multiplied with two of them
        # |J^-1| |J| (Skeel): rounding of the data grows with its square; 1 where receptors differ in scale alone
        lost = mat2.mul(np.abs(inverse), np.abs(jones)).max(axis=(-2, -1)).real
        good = np.asarray((largest > 1 / LARGEST) & (largest < LARGEST) & (lost < CANCELS))
        inverse = np.where(good[..., None, None], inverse, 0.0)
        data = mat2.sandwich(inverse[:, :, self._pick(inverse, 1)], self.data, inverse[:, :, self._pick(inverse, 2)])
        flag = self.flag | ~(good[:, :, self._pick(inverse, 1)] & good[:, :, self._pick(inverse, 2)])
        state = self.beam_state
        for beam in towards_in(term):
            state = state.without(beam, self.phase_centre)
        return replace(self, data=data, flag=flag, beam_state=state)

    def without_beam(self, instrument: Instrument) -> Visibilities:
        """The same with the beam of an instrument towards the phase centre taken out, not its gains and feeds.

        Raises `BeamStateError` where another beam, or none, is in the data.
        """
        if instrument.layout().names != self.layout.names:
            raise InputError("these visibilities are of other stations than the instrument, or in another order")
        beams, there = instrument.chain().beams(), self.beam_state.beams
        if there is not None and there.terms and self.beam_state.removed == "nothing" and there != beams:
            raise BeamStateError(
                "the beam of this instrument is not the beam in the data; to take it out on purpose: "
                "corrected(Towards(chain=...))"
            )
        return self.corrected(Towards(chain=beams))

    def corrupted(self, term: JonesTerm | Chain) -> Visibilities:
        """J_a V J_b^H for a direction-independent term; inverse of `corrected`."""
        jones = self._station_jones(term)
        data = mat2.sandwich(jones[:, :, self._pick(jones, 1)], self.data, jones[:, :, self._pick(jones, 2)])
        state = self.beam_state
        for beam in towards_in(term):
            state = state.with_beam(beam)
        return replace(self, data=data, beam_state=state)

    def check_same(self, other: Visibilities) -> None:
        """Raise where the other set has other coordinates, or a beam state of its own (`BeamStateError`)."""
        if self.beam_state != other.beam_state:
            raise BeamStateError(f"cannot mix visibilities of {self.beam_state} and of {other.beam_state}")
        same = (
            self.data.shape == other.data.shape
            and self.phase_centre == other.phase_centre
            and self.layout.names == other.layout.names
            and np.array_equal(self.layout.positions_m, other.layout.positions_m)
            and np.array_equal(self.antenna1, other.antenna1)
            and np.array_equal(self.antenna2, other.antenna2)
            and np.array_equal(self.at.slots_s, other.at.slots_s)
            and np.array_equal(self.freq_hz, other.freq_hz)
        )
        if not same:
            raise InputError("visibilities of other times, channels, stations or phase centres cannot be subtracted")

    def __sub__(self, other: Visibilities) -> Visibilities:
        """Difference of two sets on the same coordinates; raises `BeamStateError` when their beam states differ."""
        self.check_same(other)
        return replace(self, data=self.data - other.data, flag=self.flag | other.flag)

    def _station_jones(self, term: JonesTerm | Chain) -> Complex:
        found = term.jones(self.at)[:, :, :, :1]
        spread = [t for t in (term.parts if isinstance(term, Chain) else term.parts()) if t.directional]
        if spread:
            raise InputError(
                f"{type(spread[0]).__name__} differs between directions: visibilities can be corrected towards one "
                "direction only; use Towards(chain=...)"
            )
        return found[:, :, :, 0]

    def _pick(self, jones: Complex, which: int) -> Any:
        if jones.shape[2] == 1:
            return slice(None)
        return self.antenna1 if which == 1 else self.antenna2
