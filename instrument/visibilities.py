"""Visibilities: data of all baselines with their coordinates, weights, flags and beam; and sets of blocks of them."""

from __future__ import annotations

import os
from abc import ABC, abstractmethod
from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any

import numpy as np

from instrument import correlations, store
from instrument.averaging import averaged
from instrument.beam_state import BeamState as BeamState
from instrument.checked import checked
from instrument.errors import BeamStateError, FileError, InputError
from instrument.jones import mueller
from instrument.jones.base import JonesTerm
from instrument.jones.chain import Chain
from instrument.jones.gain import exact_key, slot_normals
from instrument.jones.towards import Towards, towards_in
from instrument.model import Instrument
from instrument.msv4 import tree_of
from instrument.observe.closure import stations_of
from instrument.observe.layout import Layout
from instrument.observe.sampling import Sampling, times_of
from instrument.recentred import recentred
from instrument.station_jones import inverted, station_jones, through
from instrument.units import SEED, Bool, Complex, Count, Direction, Float, Int, direction, one_si, plain
from instrument.visibility_checks import as_kind, check_baselines, check_weights, positive_along, same_coordinates

KINDS = {"data": complex, "weight": float, "antenna1": int, "antenna2": int, "given_uvw_m": float}


@checked
class VisibilitySet(ABC):
    """Visibilities as blocks that can be gone through as often as needed: a plan, a file, a list, one `Visibilities`.

    Blocks hold all baselines and some times and channels, each of them once.
    """

    @abstractmethod
    def blocks(self) -> Iterator[Visibilities]:
        """The blocks, in order of time; every call begins anew."""

    def coverage(self) -> Iterator[Visibilities]:
        """Coordinates and weights of the blocks with data of zero; what is flagged or not finite weighs nothing."""
        for block in self.blocks():
            zeros = np.broadcast_to(np.zeros((), complex), block.data.shape)
            yield replace(block, data=zeros, weight=block.effective_weight)

    def save(self, path: str | os.PathLike[str], overwrite: bool = False) -> None:
        """Write the blocks one by one, whole or not at all, to HDF5, or to Zarr where `path` ends in .zarr."""
        store.write(path, self.blocks(), overwrite)


def _ones() -> Float:
    return np.ones((1, 1, 1))


def _no_flags() -> Bool:
    return np.zeros((1, 1, 1), bool)


@checked
@dataclass(frozen=True, eq=False)
class Visibilities(VisibilitySet):
    """Visibilities in Jy, complex (T, F, B, 2, 2): rows are receptors p, q of the first station, columns of the second.

    `at` holds times, channels, stations and the phase centre; `weight` (finite, not negative) and `flag` (bool) are
    (T, F, B), or (T, F, B, 2, 2) for each correlation, length 1 where constant. `interval_s` (T,) and `width_hz` (F,)
    are one number where all are alike.
    `given_uvw_m` (T, B, 3), m, station 1 minus station 2, are the UVW of a file; without it they are worked out.
    Nothing is changed in place: every method returns a new object.
    """

    data: Complex
    at: Sampling
    antenna1: Int
    antenna2: Int
    interval_s: Float | float  # kept as (T | 1,)
    width_hz: Float | float | None = None  # kept as (F | 1,)
    weight: Float = field(default_factory=_ones)
    flag: Bool = field(default_factory=_no_flags)
    beam_state: BeamState = field(default_factory=BeamState)
    given_uvw_m: Float | None = None

    def __post_init__(self) -> None:
        for name, kind in KINDS.items():
            object.__setattr__(self, name, as_kind(getattr(self, name), kind))
        for name in ("weight", "flag"):
            object.__setattr__(self, name, correlations.plain_axes(getattr(self, name)))
        times, channels, _, _ = self.at.shape
        want = (times, channels, len(self.antenna1), 2, 2)
        if self.data.shape != want:
            raise InputError(f"data has shape {self.data.shape}, the coordinates need {want}")
        for name, count in (("interval_s", times), ("width_hz", channels)):
            if getattr(self, name) is not None:
                object.__setattr__(self, name, positive_along(getattr(self, name), count, name))
        check_baselines(self.antenna1, self.antenna2, self.layout.names)
        check_weights(self.weight, self.flag, want)
        if (uvw := self.given_uvw_m) is not None and (uvw.shape != (times, want[2], 3) or not np.isfinite(uvw).all()):
            raise InputError(f"given_uvw_m has shape {uvw.shape}, needed {(times, want[2], 3)}, all finite")
        places = (times, len(self.layout), 3)
        if (own := self.at.own_uvw_m) is not None and (own.shape != places or not np.isfinite(own).all()):
            raise InputError(f"own_uvw_m has shape {own.shape}, needed {places}, all finite")

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
        return times_of(self.at.slots_s)

    @property
    def integration_s(self) -> float:
        """Length of an integration in s, of the longest where they differ: the grid of times that solvers use."""
        return float(np.max(self.interval_s))

    @cached_property
    def uvw_m(self) -> Float:
        """Baselines u, v, w in m (T, B, 3): station 1 minus station 2; those given, or those of the coordinates."""
        if self.given_uvw_m is not None:
            return self.given_uvw_m
        stations = self.at.uvw_m
        return stations[:, self.antenna1] - stations[:, self.antenna2]

    @cached_property
    def station_uvw_m(self) -> Float:
        """Stations u, v, w in m (T, A, 3), whose differences are `uvw_m`; raises `InputError` where there are none."""
        if self.given_uvw_m is None:
            return self.at.uvw_m
        return stations_of(self.given_uvw_m, self.antenna1, self.antenna2, len(self.layout))

    @classmethod
    def open(
        cls, path: str | os.PathLike[str], times: slice = slice(None), channels: slice = slice(None)
    ) -> Visibilities:
        """Visibilities that `save` has written, or some times and channels of them, as they were to the last bit.

        `VisibilityFile(path)` gives them block by block. Raises `FileError` for other files, in one line.
        """
        return cls.of(store.Store(path), times, channels)

    @classmethod
    def of(cls, file: store.Store, times: slice, channels: slice) -> Visibilities:
        """Some times and channels of an opened file."""
        found = file.arguments(times, channels)
        try:
            return cls(**found)
        except InputError as error:
            raise FileError(f"{file.name}: {error}") from None

    def blocks(self) -> Iterator[Visibilities]:
        """One block: these."""
        yield self

    def block(self, times: slice, channels: slice) -> Visibilities:
        """The same for some times and channels."""

        def cut(array: Any) -> Any:
            steps = zip(array.shape, (times, channels), strict=False)
            return array[tuple(slice(None) if n == 1 else step for n, step in steps)]

        uvw, width, interval = self.given_uvw_m, self.width_hz, self.interval_s
        return replace(
            self,
            data=self.data[times, channels],
            at=self.at.block(times, channels),
            interval_s=interval[times] if np.size(interval) > 1 else interval,  # type: ignore[index]
            width_hz=width[channels] if width is not None and np.size(width) > 1 else width,  # type: ignore[index]
            weight=cut(self.weight),
            flag=cut(self.flag),
            given_uvw_m=None if uvw is None else uvw[times],
        )

    @property
    def effective_weight(self) -> Float:
        """Weights with flagged and non-finite data at zero, (T, F, B), or (T, F, B, 2, 2) where correlations differ.

        With weights and flags of whole visibilities one correlation that is not finite spoils all four.
        """
        weight, flag = correlations.alike(self.weight, self.flag)
        finite: Bool = np.isfinite(self.data)
        good = finite if weight.ndim == correlations.APART else np.asarray(finite.all(axis=(-2, -1)))
        return np.where(good & ~flag, weight, 0.0)

    @property
    def whole_weight(self) -> Float:
        """One effective weight for each visibility, (T, F, B): the harmonic mean of the four, 0 where one is 0."""
        return correlations.whole(self.effective_weight)

    @property
    def stokes_weight(self) -> Float:
        """Effective weights of I, Q, U, V, (T, F, B, 4), or (T, F, B, 1) where one holds for all correlations.

        The harmonic mean of the two correlations that it is made of, 0 where one is 0: a flagged pp takes I and Q.
        """
        return correlations.of_stokes(self.effective_weight)

    def with_data(self, data: Complex) -> Visibilities:
        """The same coordinates with other data, (T, F, B, 2, 2)."""
        return replace(self, data=data)

    def flagged(self, flag: Bool) -> Visibilities:
        """The same with more flags, (T, F, B) or (T, F, B, 2, 2), length 1 where constant."""
        return replace(self, flag=correlations.either(self.flag, flag))

    def weighted(self, weight: Float) -> Visibilities:
        """The same with other weights, (T, F, B) or (T, F, B, 2, 2), length 1 where constant; none below 0."""
        return replace(self, weight=plain(weight, float, "weight"))

    def to_xarray(self) -> Any:
        """An xarray DataTree in the schema of MSv4 (extra `xarray`); `write_msv4` writes it, `Msv4File` reads it."""
        return tree_of(self)

    def stokes(self) -> Complex:
        """Stokes visibilities I, Q, U, V in Jy, complex (T, F, B, 4): I = (pp+qq)/2 and so on."""
        return mueller.stokes(self.data)

    def noise_jy(self, sefd: Any) -> Any:
        """Rms of the noise in the real or imaginary part of one correlation: SEFD / sqrt(2 dnu dt), in Jy.

        One number, or (T | 1, F | 1) where integrations or channels differ.
        """
        value = one_si(sefd, "Jy", "sefd", at_least=0)
        if self.width_hz is None:
            raise InputError(
                "noise needs the width of a channel, which one channel and channels apart do not tell: give "
                "channel_width to the Observation"
            )
        sigma = value / np.sqrt(2 * np.asarray(self.width_hz) * np.asarray(self.interval_s)[:, None])
        return float(sigma[0, 0]) if sigma.size == 1 else sigma

    def with_noise(self, sefd: Any, seed: int) -> Visibilities:
        """The same with thermal noise of stations of one system equivalent flux density added.

        The noise of an integration and channel depends on seed, time and frequency only, not on the blocks of a run.
        """
        seed, sigma = SEED.check(seed, "seed"), np.broadcast_to(self.noise_jy(sefd), self.data.shape[:2])
        noisy = np.array(self.data)
        count = len(self.antenna1)
        for i, freq in enumerate(self.freq_hz):
            # slot_normals has unit power over both parts, so each part has 1/2
            drawn = slot_normals((seed, exact_key(freq)), self.at.slots_s, (count, 2, 2))
            noisy[:, i] += np.sqrt(2) * sigma[:, i, None, None, None] * drawn
        return replace(self, data=noisy)

    def averaged(self, time: Any = None, channels: Count = 1) -> Visibilities:
        """Weighted means over `time` (a whole number of integrations) and so many channels; weights add up.

        At the mean time and frequency; what has no weight is flagged, and gaps are not filled. A source at phases that
        turn by x cycles over an average loses 1 - sin(pi x) / (pi x) of its amplitude.
        """
        seconds = None if time is None else one_si(time, "s", "time", above=0)
        return replace(self, **averaged(self, seconds, channels))

    def shifted_to(self, centre: Any) -> Visibilities:
        """The same about another phase centre (SkyCoord, text): phases, u, v and w turn; beams point where they did."""
        return replace(self, **recentred(self, direction(centre, "centre")))

    def corrected(self, term: JonesTerm | Chain) -> Visibilities:
        """J_a^-1 V J_b^-H for a direction-independent term; zero and flagged where J or its square has no inverse.

        So also where the inverse cancels to a part in 1e6 or less: data would be wrong by 1e-4 of themselves and more.
        """
        inverse, good = inverted(station_jones(term, self.at))
        state = self.beam_state
        for beam in towards_in(term):
            state = state.without(beam, self.phase_centre)
        return replace(self, **through(self, inverse, good), beam_state=state)

    def without_beam(self, instrument: Instrument) -> Visibilities:
        """The same with the beam of an instrument towards the phase centre taken out, not its gains and feeds.

        Raises `BeamStateError` where another beam, or none, is in the data.
        """
        if instrument.layout().names != self.layout.names:
            raise InputError("these visibilities are of other stations than the instrument, or in another order")
        beams, there = instrument.chain().beams(), self.beam_state.beams
        if (
            there is not None
            and there.terms
            and self.beam_state.removed == "nothing"
            and there.known() != beams.known()
        ):
            raise BeamStateError(
                "the beam of this instrument is not the beam in the data: another element, pointing or phase; to "
                "take it out on purpose: corrected(Towards(chain=...))"
            )
        return self.corrected(Towards(chain=beams))

    def corrupted(self, term: JonesTerm | Chain) -> Visibilities:
        """J_a V J_b^H for a direction-independent term; inverse of `corrected`."""
        state = self.beam_state
        for beam in towards_in(term):
            state = state.with_beam(beam)
        return replace(self, **through(self, station_jones(term, self.at)), beam_state=state)

    def check_same(self, other: Visibilities) -> None:
        """Raise where the other set has other coordinates, or a beam state of its own (`BeamStateError`)."""
        if self.beam_state != other.beam_state:
            raise BeamStateError(f"cannot mix visibilities of {self.beam_state} and of {other.beam_state}")
        if not same_coordinates(self, other):
            raise InputError(
                "visibilities of other times, channels, stations or phase centres cannot be added or subtracted"
            )

    def __sub__(self, other: Visibilities) -> Visibilities:
        """Difference of two sets on the same coordinates; raises `BeamStateError` when their beam states differ."""
        self.check_same(other)
        return replace(self, data=self.data - other.data, flag=correlations.either(self.flag, other.flag))

    def __add__(self, other: Visibilities) -> Visibilities:
        """Sum of two sets on the same coordinates, with the weights of the first; `BeamStateError` as for `-`."""
        self.check_same(other)
        return replace(self, data=self.data + other.data, flag=correlations.either(self.flag, other.flag))
