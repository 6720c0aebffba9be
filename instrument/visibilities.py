"""Visibilities: data of all baselines with their coordinates, weights, flags and beam; and sets of blocks of them."""

from __future__ import annotations

import os
from abc import ABC, abstractmethod
from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any

import numpy as np

from instrument import mat2, store
from instrument.beam_state import BeamState as BeamState
from instrument.checked import checked
from instrument.errors import BeamStateError, FileError, InputError
from instrument.jones import mueller
from instrument.jones.base import JonesTerm
from instrument.jones.chain import Chain
from instrument.jones.gain import exact_key, slot_normals
from instrument.jones.towards import Towards, towards_in
from instrument.model import Instrument
from instrument.numbers import LARGEST
from instrument.observe.closure import stations_of
from instrument.observe.layout import Layout
from instrument.observe.sampling import Sampling
from instrument.units import SEED, Bool, Complex, Direction, Float, Int, one_si, plain
from instrument.visibility_checks import check_baselines, check_weights, positive_along

CANCELS = 1e6  # of a Jones matrix: its inverse twice in double precision leaves 1e-4


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
        """Write the blocks one by one to an HDF5 file, whole or not at all, which `Visibilities.open` reads."""
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
    (T, F, B), length 1 where constant. `interval_s` (T,) and `width_hz` (F,) are one number where all are alike.
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
        self._as_the_kernels_take_them()
        times, channels, _, _ = self.at.shape
        want = (times, channels, len(self.antenna1), 2, 2)
        if self.data.shape != want:
            raise InputError(f"data has shape {self.data.shape}, the coordinates need {want}")
        for name, count in (("interval_s", times), ("width_hz", channels)):
            if getattr(self, name) is not None:
                object.__setattr__(self, name, positive_along(getattr(self, name), count, name))
        check_baselines(self.antenna1, self.antenna2, self.layout.names)
        check_weights(self.weight, self.flag, want[:3])
        if (uvw := self.given_uvw_m) is not None and (uvw.shape != (times, want[2], 3) or not np.isfinite(uvw).all()):
            raise InputError(f"given_uvw_m has shape {uvw.shape}, needed {(times, want[2], 3)}, all finite")

    def _as_the_kernels_take_them(self) -> None:
        """Numbers of any precision and byte order in double precision and the machine's own order."""
        kinds = (("data", complex), ("weight", float), ("antenna1", int), ("antenna2", int), ("given_uvw_m", float))
        for name, kind in kinds:
            given = getattr(self, name)
            if given is None or given.dtype == kind or given.dtype.kind not in "fiuc":
                continue
            if kind is not int or given.dtype.kind != "f":  # 1.5 is no number of a station
                object.__setattr__(self, name, given.astype(kind))

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
            and (self.given_uvw_m is other.given_uvw_m or np.array_equal(self.uvw_m, other.uvw_m))
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
                f"{spread[0].called} differs between directions: visibilities can be corrected towards one "
                "direction only; use Towards(chain=...)"
            )
        return found[:, :, :, 0]

    def _pick(self, jones: Complex, which: int) -> Any:
        if jones.shape[2] == 1:
            return slice(None)
        return self.antenna1 if which == 1 else self.antenna2
