"""Files of rows, one baseline at one time each: where rows stand, their coordinates, the block that they make."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Iterable, Iterator
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np

from instrument.beam_state import BeamState
from instrument.errors import FileError, InputError, warn
from instrument.files.ms_frame import Frame
from instrument.files.ms_units import LATEST_S
from instrument.observe.closure import CLOSURE_M, rounding_m, stations_seen
from instrument.observe.directions import earth_frame
from instrument.observe.recorded import Recorded
from instrument.observe.sampling import Sampling, times_of
from instrument.units import Bool, Float, Int
from instrument.visibilities import Visibilities, VisibilitySet
from instrument.visibility_sets import BLOCK_BYTES

SAME_S = 1e-3  # times as near as this are one
CELLS = 32768  # visibilities turned into matrices at once
FAR = 0.01  # 0.6 deg: precession from J2000 to 2050 is 0.7


class Rows(NamedTuple):
    """Where the rows of one window and field are: their numbers, in order of time, and the times of these."""

    numbers: Int  # (N,)
    begins: Int  # (T + 1,) of `numbers`
    slots_s: Float  # (T,)
    interval_s: Float  # (T,)
    antenna1: Int  # (B,) of all baselines, antenna1 < antenna2
    antenna2: Int
    autos: int  # rows left out

    def of(self, times: slice) -> Int:
        """The rows of some times."""
        return self.numbers[self.begins[times.start] : self.begins[times.stop]]

    def steps(self, most_bytes: float, channels: int) -> list[slice]:
        """Times that follow each other, of so many bytes of data together."""
        step = int(max(1, most_bytes // (64 * len(self.antenna1) * channels)))
        return [slice(t, min(t + step, len(self.slots_s))) for t in range(0, len(self.slots_s), step)]


class Where(NamedTuple):
    """Coordinates of the rows of some times: the `Sampling`, UVW of baselines (T, B, 3) where stations have none.

    `place` is where each row stands among times and baselines; `turned` whether its antenna 1 is the later one.
    """

    at: Sampling
    given_uvw_m: Float | None
    place: Int
    turned: Bool


class RowFile(VisibilitySet):
    """A file of rows as blocks of at most 64 MB of data: a reader sets fields and has `_coordinates`, `_block`."""

    path: str
    frame: Frame
    rows: Rows
    beam_state: BeamState

    def __repr__(self) -> str:
        times, channels, baselines = self.shape
        return (
            f"{type(self).__name__}({self.path}{self._which}: {self.frame.telescope}, {times} times, "
            f"{channels} channels, {baselines} baselines, {len(self.frame.layout)} stations, {self.beam_state})"
        )

    _which = ""  # of what there is in the file, for the text
    column = ""  # where it has several
    jansky = 1.0  # of one in the file
    closes = True  # whether its UVW are those of stations, once it is `observed`

    @property
    def named(self) -> str:
        """The file, and the column where it has several."""
        return f"{self.column} of {self.path}" if self.column else self.path

    @property
    def shape(self) -> tuple[int, int, int]:
        """Times, channels, baselines."""
        return len(self.rows.slots_s), len(self.frame.freq_hz), len(self.rows.antenna1)

    @property
    def freq_hz(self) -> Float:
        """Channel centres, Hz (F,), ascending."""
        return self.frame.freq_hz

    def observation(self) -> Recorded:
        """The observation that the file holds, for a `Scene` that is predicted with its times, channels and UVW.

        Raises `InputError` where the UVW are not those of stations, or integrations have no length; it has the longest.
        """
        found = self.observed()
        self.demand_closing()
        return found

    def observed(self) -> Recorded:
        """The same for what is not predicted: where UVW do not close, stations have those of the IERS Earth."""
        parts = (self._coordinates(times) for times in self._steps())
        found, self.closes = recorded(self.path, self.frame, self.rows, parts)
        return found

    def demand_closing(self) -> None:
        """Raise `InputError` where what was `observed` has UVW that are not those of stations."""
        if not self.closes:
            raise InputError(
                f"{self.path}: its UVW do not close around triangles of stations: it can be imaged as it stands; for a "
                "model write UVW of stations first (CASA's fixvis)"
            )

    def part(self, block: Visibilities, which: Int | None = None) -> Visibilities:
        """The visibilities of the times and channels of another block, all baselines of the file or some, by number.

        Raises `InputError` for times and channels that the file has not.
        """
        return self._block(*self._where(block), which)

    def sampling(self, block: Visibilities) -> Sampling:
        """The coordinates of the times and channels of another block, with the UVW of the file."""
        times, channels = self._where(block)
        return self._coordinates(times).at.block(slice(None), channels)

    def _where(self, block: Visibilities) -> tuple[slice, slice]:
        """Where the times and channels of a block are."""
        found = []
        asked = (block.at.slots_s, self.rows.slots_s, SAME_S, "times"), (block.freq_hz, self.freq_hz, 1.0, "channels")
        for values, known, same, what in asked:
            first = int(np.abs(known - values[0]).argmin())
            step = slice(first, first + len(values))
            if len(known[step]) < len(values) or np.abs(known[step] - values).max() > same:
                raise InputError(f"the visibilities are of other {what} than {self.path}")
            found.append(step)
        return found[0], found[1]

    def blocks(self) -> Iterator[Visibilities]:
        """Blocks in order of time, all channels each."""
        for times in self._steps():
            yield self._block(times, slice(None))

    def _steps(self) -> list[slice]:
        return self.rows.steps(BLOCK_BYTES, len(self.freq_hz))

    def _say_autos(self) -> None:
        if self.rows.autos:
            warn(f"{self.path}: {self.rows.autos} rows are autocorrelations: left out")

    @abstractmethod
    def _coordinates(self, times: slice) -> Where:
        """Coordinates of some times."""

    def _block(self, times: slice, channels: slice, which: Int | None = None) -> Visibilities:
        """The block of some times, channels and baselines."""
        where = self._coordinates(times)
        cells = self._cells(self.rows.of(times), channels)
        if self.jansky != 1:
            data = np.asarray(cells.data, complex) * self.jansky
            cells = Cells(data, cells.flag, np.asarray(cells.weight, float) / self.jansky**2)
        return block_of(self, times, channels, where, cells, which)

    @abstractmethod
    def _cells(self, numbers: Int, channels: slice) -> Cells:
        """What the file has of some rows and channels."""


def pairs_of(one: Int, two: Int, stations: int, path: str) -> Int:
    """The baselines that rows are of, each once, as lower station times `stations` plus the higher."""
    if one.size and (min(one.min(), two.min()) < 0 or max(one.max(), two.max()) >= stations):
        raise FileError(f"{path}: rows are of station {max(one.max(), two.max())}, of {stations} that are described")
    return np.unique(np.minimum(one, two).astype(np.int64) * stations + np.maximum(one, two))


def in_time(numbers: Int, time: Float, pairs: Int, stations: int, path: str) -> Rows:
    """Rows of cross-correlations, of these `pairs_of`, in order of time; `interval_s` still those of nothing."""
    if not np.all((time >= 0) & (time < LATEST_S)):
        bad = time[~((time >= 0) & (time < LATEST_S))][0]
        raise FileError(f"{path}: TIME is {bad:g} s: it is to be a date, seconds of MJD (5e9 in 2017)")
    if np.any(np.diff(time) < 0):
        order = np.argsort(time, kind="stable")
        numbers, time = numbers[order], time[order]
    begins = np.append(np.flatnonzero(np.diff(time, prepend=-np.inf) > SAME_S), len(time))
    slots, each = time[begins[:-1]], float(np.median(np.diff(begins)))
    if each < len(pairs) / 2:
        warn(
            f"{path}: half of its {len(slots)} times have at most {each:g} of {len(pairs)} baselines: where TIME "
            "differs by more than 1 ms between baselines, times are apart that are one"
        )
    return Rows(numbers, begins, slots, np.zeros(len(slots)), pairs // stations, pairs % stations, 0)


def places(path: str, rows: Rows, stations: int, times: slice, one: Int, two: Int) -> Int:
    """Where each row of some times stands among the baselines; raises `FileError` for a baseline that is twice."""
    low, high = np.minimum(one, two), np.maximum(one, two)
    names = rows.antenna1 * stations + rows.antenna2
    found = np.searchsorted(names, low * stations + high)
    slot = np.repeat(np.arange(times.stop - times.start), np.diff(rows.begins[times.start : times.stop + 1]))
    place = slot * len(names) + found
    if len(np.unique(place)) < len(place):
        twice = int(slot[np.flatnonzero(np.diff(np.sort(place)) == 0)[0]]) if len(place) else 0
        raise FileError(f"{path}: a baseline has two rows at time {times.start + twice} of this window and field")
    return np.asarray(place)


def coordinates(path: str, frame: Frame, rows: Rows, times: slice, one: Int, two: Int, uvw: Float | None) -> Where:
    """Coordinates of rows whose UVW (N, 3) are antenna 2 minus antenna 1; without them those of the IERS Earth."""
    place, turned = places(path, rows, len(frame.layout), times, one, two), one > two
    slots, centre = rows.slots_s[times], frame.centre
    at = Sampling(
        frame.layout, earth_frame(times_of(slots), frame.layout.centre_m), slots, frame.freq_hz,
        np.array([centre.ra_rad]), np.array([centre.dec_rad]), centre,
        steered=None if frame.pointing == centre else frame.pointing,
    )  # fmt: skip
    if uvw is None:
        return Where(at, None, place, turned)
    if not np.isfinite(uvw).all():
        raise FileError(f"{path}: UVW is not finite, {times.stop - times.start} times from {times.start}")
    ours = at.uvw_m[:, rows.antenna1] - at.uvw_m[:, rows.antenna2]
    own, seen = ours.copy(), np.zeros(ours.shape[:2], bool)
    own.reshape(-1, 3)[place] = np.where(turned[:, None], uvw, -uvw)  # station 1 minus station 2
    seen.ravel()[place] = True
    if not times.start:
        _compare(path, own, ours)
    stations, apart = stations_seen(own, seen, rows.antenna1, rows.antenna2, at.uvw_m)
    if apart > CLOSURE_M:
        if apart > rounding_m(uvw):
            return Where(at, own, place, turned)
        if not times.start:
            warn(
                f"{path}: UVW are rounded to single precision: they close around triangles of stations to {apart:.2g} m"
            )
    return Where(replace(at, own_uvw_m=stations), None, place, turned)


def _compare(path: str, own: Float, ours: Float) -> None:
    """Warn where the UVW of the file are not those of its stations, times and phase centre."""
    size = float(np.sqrt((ours**2).sum())) or 1.0
    apart, turned = (float(np.sqrt(((own - sign * ours) ** 2).sum())) / size for sign in (1, -1))
    if turned < FAR:
        warn(
            f"{path}: UVW are antenna 1 minus 2, the definition has 2 minus 1: fringes are those of the UVW as they "
            "stand; array factors of stations then have the other sign (phase = 'everybeam')"
        )
    elif apart > FAR:
        warn(
            f"{path}: UVW are {100 * apart:.2g} % off those of its stations, times and phase centre: another "
            "centre, equinox or date? They are used as they stand"
        )


class Cells(NamedTuple):
    """What a file has of some rows: data, flags and weights (N, F, n) of its channels and correlations, ascending."""

    data: Any
    flag: Any
    weight: Any


def block_of(
    file: RowFile, times: slice, channels: slice, where: Where, cells: Cells, which: Int | None = None
) -> Visibilities:
    """The block of some times and channels, of its rows as the file has them; of the baselines `which`, or of all.

    A weight that is not a number above 0 is 0; one weight and flag of each visibility where correlations are alike.
    """
    rows, frame, every = file.rows, file.frame.of(channels), len(file.rows.antenna1)
    chosen = np.arange(every) if which is None else which
    among = np.full(every, -1)
    among[chosen] = np.arange(len(chosen))
    use = np.flatnonzero(among[where.place % every] >= 0)
    step = max(1, CELLS // max(len(frame.freq_hz), 1))
    shape = (times.stop - times.start, len(frame.freq_hz), len(chosen))
    data = np.zeros((*shape, 2, 2), complex)
    flag, weight = (
        np.full(shape if frame.alike(values, step) else data.shape, lacking)
        for values, lacking in ((cells.flag, True), (cells.weight, 0.0))
    )
    for first in range(0, len(use), step):
        some = use[first : first + step]
        to = where.place[some] // every, slice(None), among[where.place[some] % every]
        turned = where.turned[some]
        clean = np.asarray(cells.weight[some], float)
        clean = np.where(np.isfinite(clean) & (clean > 0), clean, 0.0)
        found = frame.linear(cells.data[some])
        found[turned] = np.conj(np.swapaxes(found[turned], -1, -2))
        data[to] = found
        for filled, values, lacking in ((flag, cells.flag[some].astype(bool), True), (weight, clean, 0.0)):
            spread = frame.spread(values, lacking)
            if filled.ndim == len(shape):
                filled[to] = spread[..., 0, 0]
            else:
                filled[to] = np.where(turned[:, None, None, None], np.swapaxes(spread, -1, -2), spread)
    uvw = where.given_uvw_m
    return Visibilities(
        data=data, at=where.at.block(slice(None), channels), antenna1=rows.antenna1[chosen],
        antenna2=rows.antenna2[chosen], interval_s=rows.interval_s[times], width_hz=frame.width_hz, weight=weight,
        flag=flag, beam_state=file.beam_state, given_uvw_m=None if uvw is None else uvw[:, chosen],
    )  # fmt: skip


def recorded(path: str, frame: Frame, rows: Rows, parts: Iterable[Where]) -> tuple[Recorded, bool]:
    """The observation of a file, of the coordinates of all its times, and whether its UVW are those of stations.

    Raises `InputError` where integrations have no length.
    """
    longest = float(rows.interval_s.max())
    if not (np.all(rows.interval_s >= 0) and 0 < longest < np.inf):
        raise InputError(f"{path}: INTERVAL is {rows.interval_s.min():g} to {longest:g} s: integrations need a length")
    if np.ptp(rows.interval_s) > SAME_S:
        warn(
            f"{path}: integrations of {rows.interval_s.min():g} to {longest:g} s: what is predicted is smeared as the "
            "longest are"
        )
    first, found, width, closes = None, [], frame.width_hz, True
    for part in parts:
        closes = closes and part.given_uvw_m is None
        first = first or part.at
        found.append(part.at.uvw_m)
    assert first is not None
    at = replace(first, slots_s=rows.slots_s, own_uvw_m=np.concatenate(found))
    return Recorded.of(at, longest, float(width[0]) if np.ptp(width) == 0 else None), closes
