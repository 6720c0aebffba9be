"""Store: visibilities in HDF5 or Zarr, written and read block by block; all of their state comes back bit for bit."""

from __future__ import annotations

import json
import os
from collections.abc import Iterable
from functools import reduce
from operator import mul
from pathlib import Path
from typing import Any

import numpy as np

from instrument import h5, zarr_tree
from instrument.beam_state import BeamState
from instrument.errors import BeamStateError, FileError, InputError, warn
from instrument.files_in import harmless
from instrument.jones.base import ElementBeam, JonesTerm
from instrument.jones.chain import Chain
from instrument.jones.station import StationBeam
from instrument.memory import afford
from instrument.observe.directions import EarthFrame
from instrument.observe.layout import Layout
from instrument.observe.sampling import Sampling
from instrument.provenance import written_by
from instrument.units import Direction
from instrument.whole_file import whole_file, whole_folder

FORMAT, VERSION = "instrument visibilities", 3
KNOWN = (1, 2, 3)  # in 1 array factors and elements are those of EveryBeam and have no `phase`
WHAT = "file of visibilities"
CHUNK_BYTES = 1e6  # of data that HDF5 reads at once
# of times, by name: where it is found in visibilities, and its axes behind the times
PER_TIME = (
    "slots_s", "earth_matrices", "earth_velocity", "seen", "seen_east", "seen_centre", "given_uvw_m", "own_uvw_m",
)  # fmt: skip
SPREAD = {"weight": (0, 1), "flag": (0, 1), "interval_s": (0,), "width_hz": (1,)}  # axes along which one may do for all
LARGE = ("data", *PER_TIME[3:], "weight", "flag")  # read a part at a time
FIXED = ("antenna1", "antenna2", "ra_rad", "dec_rad", "centre", "layout", "beam_state")
KINDS = {"data": "c", "flag": "b", "antenna1": "iu", "antenna2": "iu", "layout": "u", "beam_state": "u"}


def write(path: str | os.PathLike[str], blocks: Iterable[Any], overwrite: bool = False) -> None:
    """Write visibilities (T, F, B, 2, 2) block by block, whole or not; raises `InputError` for blocks that clash.

    Blocks are of the same stations, baselines, phase centre and beam state, and fill times by channels once each.
    A name in .zarr becomes a folder of Zarr, any other a file of HDF5.
    """
    if zarr_tree.is_zarr(path):
        zarr_tree.library()
    whole = whole_folder(path, zarr_tree.MARK, overwrite) if zarr_tree.is_zarr(path) else whole_file(path, overwrite)
    with whole as partial:
        writer = None
        try:
            for block in blocks:
                writer = writer or StoreWriter(partial, block)
                writer.add(block)
            if writer is None:
                raise InputError("there are no visibilities to save: the set has no block")
            writer.finish()
        finally:
            if writer is not None:
                writer.created.close()


def _fixed(block: Any, texts: bool = True) -> dict[str, Any]:
    """What is the same for all blocks, as arrays; text as its bytes."""
    state, at = block.beam_state, block.at
    out = {name: getattr(block, name) for name in FIXED[:2]} | {name: getattr(at, name) for name in FIXED[2:4]}
    out["centre"] = np.array(at.centre)
    out["steered"] = np.array(at.steered or ())  # written where beams do not point at the centre
    if not texts:
        return out
    beams = None if state.beams is None else state.beams.to_dict()
    told = {"removed": state.removed, "towards": state.towards, "beams": beams, "other": state.other}
    told |= {"part": state.part} if state.part != "Full" else {}  # as it was before parts were known
    spelled = {"layout": block.layout.to_json(), "beam_state": json.dumps(told)}
    return out | {name: np.frombuffer(text.encode(), np.uint8) for name, text in spelled.items()}


def _per_time(block: Any) -> dict[str, Any]:
    earth = {"earth_matrices": block.at.earth.matrices, "earth_velocity": block.at.earth.velocity}
    found = {**earth, "given_uvw_m": block.given_uvw_m}
    return {name: found[name] if name in found else getattr(block.at, name) for name in PER_TIME}


class StoreWriter:
    """A new file that is filled block by block; `finish` closes it."""

    def __init__(self, path: str | os.PathLike[str], first: Any) -> None:
        self.created = (zarr_tree if zarr_tree.is_zarr(path) else h5).Created(path)
        self.file, self.fixed = (file := self.created.file), _fixed(first)
        self.known = first.layout, first.beam_state
        self.slots: dict[float, int] = {}
        self.channels: dict[float, int] = {}
        self.cells: set[tuple[int, int]] = set()
        self.spread = {name: _Spread(file, name) for name in SPREAD}
        baselines = len(first.antenna1)
        times = int(max(1, min(CHUNK_BYTES // (64 * baselines), len(first.at.slots_s))))
        self._grow("data", (0, 0, baselines, 2, 2), complex, (times, 1, baselines, 2, 2), 2)
        self._grow("freq_hz", (0,), float, (256,), 1)
        for name, array in _per_time(first).items():
            if array is not None:
                self._grow(name, (0, *array.shape[1:]), float, (min(256, times), *array.shape[1:]), 1)

    def _grow(self, name: str, shape: tuple[int, ...], dtype: Any, chunks: tuple[int, ...], axes: int) -> None:
        limits = (*[None] * axes, *shape[axes:])
        self.file.create_dataset(name, shape=shape, maxshape=limits, dtype=dtype, chunks=chunks)

    def add(self, block: Any) -> None:
        """Write a block."""
        # a chain takes 20 ms to be spelled out: not again where it is the same object
        seen = block.layout is self.known[0] and block.beam_state is self.known[1]
        for name, value in _fixed(block, texts=not seen).items():
            if not np.array_equal(value, self.fixed[name]):
                error = BeamStateError if name == "beam_state" else InputError
                raise error(f"the blocks differ in {name}: save each kind in a file of its own")
        t, f = _rows(self.slots, block.at.slots_s, "times"), _rows(self.channels, block.freq_hz, "channels")
        cells = {(i, j) for i in range(t.start, t.stop) for j in range(f.start, f.stop)}
        if cells & self.cells:
            i, j = min(cells & self.cells)
            raise InputError(f"time {i} and channel {j} are in two blocks: save each once")
        self.cells |= cells
        self._put("data", (t, f), block.data)
        self._put("freq_hz", (f,), block.freq_hz)
        for name, array in _per_time(block).items():
            if (array is not None) != (name in self.file):
                raise InputError(f"some blocks have {name} and others have not")
            if array is not None:
                self._put(name, (t,), array)
        shape = (len(self.slots), len(self.channels), len(block.antenna1))
        for name, axes in SPREAD.items():
            here = tuple((t, f)[axis] for axis in axes)
            array = getattr(block, name)
            # weights and flags may be of correlations: two more axes
            size = (*shape, *array.shape[3:]) if len(axes) == 2 else tuple(shape[axis] for axis in axes)
            self.spread[name].put(array, here, size)
        self.created.check()

    def _put(self, name: str, where: tuple[slice, ...], array: Any) -> None:
        found = self.file[name]
        grown = tuple(max(n, s.stop) for n, s in zip(found.shape, where, strict=False))
        if grown != found.shape[: len(where)]:
            found.resize((*grown, *found.shape[len(where) :]))
        found[where] = array

    def finish(self) -> None:
        """Write what is known at the end."""
        if len(self.cells) < len(self.slots) * len(self.channels):
            grid = ((i, j) for i in range(len(self.slots)) for j in range(len(self.channels)))
            i, j = next(cell for cell in grid if cell not in self.cells)
            raise InputError(f"no block holds channel {j} at time {i}: blocks must fill times by channels")
        for one in self.spread.values():
            one.finish()
        for name, value in self.fixed.items():
            if value.size:
                self.file[name] = value
        self.file.attrs.update({"format": FORMAT, "version": VERSION, **written_by()})
        self.created.close()


def _rows(known: dict[float, int], values: Any, what: str) -> slice:
    """Where times or channels of a block stand in the file, one after the other; new ones at its end."""
    rows = [known.setdefault(float(value), len(known)) for value in values]
    if rows != list(range(rows[0], rows[0] + len(rows))):
        raise InputError(f"the {what} of one block lie between those of others: give blocks in order")
    return slice(rows[0], rows[0] + len(rows))


class _Spread:
    """An array that has length 1 where it is constant: as it is in one block, whole where blocks differ."""

    def __init__(self, file: Any, name: str) -> None:
        self.file, self.name = file, name
        self.kept: Any = None
        self.where: tuple[slice, ...] = ()
        self.begun = False

    def put(self, array: Any, where: tuple[slice, ...], size: tuple[int, ...]) -> None:
        """Take that of a block, which lies at `where` in an array of `size`."""
        if self.begun and (array is None) != (self.kept is None):
            raise InputError(f"some blocks have {self.name} and others have not")
        if array is None or not self.begun:
            self.kept, self.where, self.begun = array, where, True
            return
        if array.ndim != self.kept.ndim:
            raise InputError(
                f"some blocks have {self.name} for each correlation and others have not: give all the same"
            )
        if self.name not in self.file:
            constant = all(n == 1 for n in self.kept.shape[: len(where)])
            if constant and np.array_equal(array, self.kept):
                return
            if len(where) == 1 and where == self.where and np.array_equal(array, self.kept):
                return  # other channels of the same times, or other times of the same channels
            self.file.create_dataset(
                self.name, shape=size, maxshape=(None,) * len(size), dtype=self.kept.dtype, chunks=True, compression=1
            )
            self.file[self.name][... if constant else self.where] = self.kept
        found = self.file[self.name]
        if found.shape != size:
            found.resize(size)
        found[where] = array

    def finish(self) -> None:
        """Write what stayed constant."""
        if self.kept is not None and self.name not in self.file:
            self.file.create_dataset(self.name, data=self.kept, **({"compression": 1} if self.kept.size > 1 else {}))


class Store:
    """A file that `write` has made: its coordinates, read once; its data, a part at a time.

    Raises `FileError` in one line for what is no such file, or where its arrays do not fit one another.
    """

    def __init__(self, path: str | os.PathLike[str]) -> None:
        self.path = os.fspath(path)
        self.name = harmless(Path(self.path).name)
        self.disk: Any = zarr_tree if zarr_tree.is_zarr(path) else h5
        with self.disk.opened(path, WHAT) as file:
            sets = self._sets(file)
            self.shape = sets["data"].shape[:3]
            small = {n: np.asarray(d[()]) for n, d in sets.items() if n not in LARGE}
            self.written = {str(k): h5.text(v) for k, v in file.attrs.items()}
        texts = {name: small[name].astype(np.uint8).tobytes().decode("utf-8", "replace") for name in FIXED[-2:]}
        self.slots_s, self.freq_hz = small["slots_s"], small["freq_hz"]
        places = [small[name] for name in ("centre", "earth_matrices", "earth_velocity", "steered") if name in small]
        if not all(np.isfinite(x).all() for x in (self.slots_s, self.freq_hz, *places)) or (self.freq_hz <= 0).any():
            raise FileError(f"{self.name}: times, frequencies or coordinates are not finite, or not above 0")
        try:
            self.layout = Layout.from_json(texts["layout"])
            self.beam_state = _state(json.loads(texts["beam_state"]), self.name, int(self.written["version"]))
        except (InputError, ValueError, LookupError, TypeError) as error:
            raise FileError(f"{self.name}: layout or beam state: {harmless(h5.one_line(error), 200)}") from None
        self.small = small

    def _sets(self, file: Any) -> dict[str, Any]:
        """All arrays, not yet read, with the shapes that they must have."""
        if h5.text(file.attrs.get("format", "")) != FORMAT:
            other = "another HDF5 file" if self.disk is h5 else "another Zarr folder"
            like = "an h5parm, which read_h5parm reads" if "sol000" in file else other
            raise FileError(f"{self.name} is no {WHAT} (Visibilities.save): it is {like}")
        if (version := int(file.attrs.get("version", 0))) not in KNOWN:
            raise FileError(f"{self.name}: version {version} of the format is not one of {KNOWN}: take a newer program")
        there = self.disk.members(file)
        needed = ("data", "freq_hz", *PER_TIME[:3], *FIXED, "weight", "flag", "interval_s")
        known = [n for n in ("data", "freq_hz", *PER_TIME, *FIXED, "steered", *SPREAD) if n in needed or n in there]
        sets = {name: self.disk.dataset(file, name, KINDS.get(name, "f")) for name in known}
        t, f, b = (*sets["data"].shape, 0, 0, 0)[:3]
        s = sets["ra_rad"].size
        due = {
            "data": (t, f, b, 2, 2), "freq_hz": (f,), "slots_s": (t,), "earth_matrices": (t, 3, 3),
            "earth_velocity": (t, 3), "seen": (t, s, 3), "seen_east": (t, s, 3), "seen_centre": (t, 3),
            "given_uvw_m": (t, b, 3), "antenna1": (b,), "antenna2": (b,), "ra_rad": (s,), "dec_rad": (s,),
            "centre": (2,), "steered": (2,),
        }  # fmt: skip
        for name, shape in due.items():
            if name in sets and (sets[name].shape != shape or 0 in shape):
                raise FileError(f"{self.name}: '{name}' has shape {sets[name].shape}, needed {shape}, none of them 0")
        whole = (t, f, b, 2, 2)
        for name, axes in SPREAD.items():
            if name not in sets:
                continue
            given = sets[name].shape
            shape = tuple(whole[axis] for axis in axes) if len(axes) == 1 else whole[: 5 if len(given) == 5 else 3]
            if len(given) != len(shape) or any(n not in (1, m) for n, m in zip(given, shape, strict=True)):
                raise FileError(f"{self.name}: '{name}' has shape {given}, needed {shape} with length 1 where constant")
        self.disk.demand_affordable(list(sets.values()))
        return sets

    def arguments(self, times: slice, channels: slice) -> dict[str, Any]:
        """What `Visibilities` is made of, for some times and channels."""
        t, f = (
            _forward(s, n, w) for s, n, w in zip((times, channels), self.shape, ("times", "channels"), strict=False)
        )
        size = 100.0 * reduce(mul, (len(range(*s.indices(n))) for s, n in zip((t, f), self.shape, strict=False)), 1)
        afford(
            size * self.shape[2], f"{self.name}: what is asked for", "choose times= or channels=, or take its blocks"
        )
        with self.disk.opened(self.path, WHAT) as file:
            sets = self._sets(file)
            out = {"data": sets["data"][t, f]}
            for name, axes in SPREAD.items():
                if name in sets:
                    lead = [(t, f)[axis] for axis in axes]
                    steps = zip(sets[name].shape, lead, strict=False)
                    out[name] = sets[name][tuple(slice(None) if n == 1 else step for n, step in steps)]
            late = {name: sets[name][t] for name in PER_TIME[3:] if name in sets}
        out["given_uvw_m"] = late.pop("given_uvw_m", None)
        if "steered" in self.small:
            late["steered"] = Direction(*self.small["steered"].tolist())
        small, earth = self.small, EarthFrame(self.small["earth_matrices"][t], self.small["earth_velocity"][t])
        out["at"] = Sampling(
            self.layout, earth, self.slots_s[t], self.freq_hz[f], small["ra_rad"], small["dec_rad"],
            Direction(*small["centre"].tolist()), **late,
        )  # fmt: skip
        return {**out, **{name: small[name] for name in FIXED[:2]}, "beam_state": self.beam_state}


def _forward(step: slice, count: int, what: str) -> slice:
    """A slice as HDF5 takes it; raises `InputError` for none and for backward ones."""
    if (step.step is not None and step.step < 1) or not len(range(*step.indices(count))):
        raise InputError(f"{what} = {step} takes nothing of {count}: give a forward slice with something in it")
    return step


def _state(told: dict[str, Any], name: str, version: int) -> BeamState:
    """The beam state of a file; a chain of terms that are not known here is not known, which is said."""
    towards, beams = told["towards"] and Direction(*map(float, told["towards"])), None
    if told["beams"] is not None:
        try:
            beams = Chain.from_json(json.dumps(told["beams"] if version > 1 else _of_everybeam(told["beams"])))
            beams = beams if version > 1 else Chain(*(_element_of_everybeam(term) for term in beams.terms))
        except InputError as error:
            warn(f"{name}: which beam is in the data is not known here: {harmless(h5.one_line(error), 200)}")
    return BeamState(told["removed"], towards, beams, bool(told["other"]), told.get("part", "Full"))


def _of_everybeam(told: Any) -> Any:
    """The text of a chain with the `phase` that array factors and stations had when there was no other."""
    if isinstance(told, list):
        return [_of_everybeam(item) for item in told]
    if not isinstance(told, dict):
        return told
    found = {name: _of_everybeam(item) for name, item in told.items()}
    return {"phase": "everybeam", **found} if "levels" in found else found


def _element_of_everybeam(term: JonesTerm) -> JonesTerm:
    """An element by itself was multiplied as it is: now that is a station of no level."""
    alone = isinstance(term, ElementBeam) and not term.real
    return StationBeam(element=term, levels=(), phase="everybeam") if alone else term
