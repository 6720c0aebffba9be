"""Sets of visibilities made of what is at hand: a list of blocks, an iterator that can be gone through once."""

from __future__ import annotations

import os
from collections.abc import Iterable, Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np

from instrument.checked import checked
from instrument.errors import InputError
from instrument.store import Store
from instrument.units import Float
from instrument.visibilities import Visibilities, VisibilitySet

BLOCK_BYTES = 64e6  # of a file that are read at once


def as_set(given: VisibilitySet | Iterable[Visibilities], twice: str = "") -> VisibilitySet:
    """What was given as a `VisibilitySet`: a set as it is, blocks in anything that can be gone through.

    An iterator (`plan.blocks()`) can be gone through once. It is refused at once where `twice` names work that needs
    several passes, and at the second pass else.
    """
    if isinstance(given, VisibilitySet):
        return given
    blocks = _Blocks(given)
    if twice and blocks.once:
        raise InputError(f"{twice} go over the visibilities twice: {REMEDY}")
    return blocks


def as_one(given: VisibilitySet | Iterable[Visibilities], beside: Path) -> Visibilities:
    """All blocks as one, brought together in a file at `beside`, a name that is free and stays."""
    if isinstance(given, Visibilities):
        return given
    as_set(given).save(beside)
    return Visibilities.open(beside)


def outline_and_blocks(
    given: VisibilitySet | Iterable[Visibilities], beside: Path
) -> tuple[Visibilities, Iterable[Visibilities]]:
    """Coordinates of all there is, with data that take no memory, and the blocks, for a file that is filled by blocks.

    Blocks are brought together in a file at `beside`, a name that is free and stays; what is one block is held anyway.
    """
    if isinstance(given, Visibilities):
        first, shape, freq, width = given, given.data.shape, given.freq_hz, given.width_hz
    else:
        if not isinstance(given, VisibilityFile):
            as_set(given).save(beside)
            given = VisibilityFile(beside)
        store = given.store
        first, shape = Visibilities.of(store, slice(None), slice(0, 1)), (*store.shape, 2, 2)
        freq, width = store.freq_hz, store.small.get("width_hz")
    outline = replace(
        first, data=np.broadcast_to(np.zeros((), complex), shape), at=replace(first.at, freq_hz=freq), width_hz=width,
        weight=np.ones((1, 1, 1)), flag=np.zeros((1, 1, 1), bool),
    )  # fmt: skip
    return outline, given.blocks()


def places_in(outline: Visibilities, block: Visibilities) -> tuple[slice, slice]:
    """Where the times and channels of a block are among those of the whole."""
    found = []
    for all_of, some in ((outline.at.slots_s, block.at.slots_s), (outline.freq_hz, block.freq_hz)):
        first = int(np.abs(all_of - some[0]).argmin())
        found.append(slice(first, first + len(some)))
    return found[0], found[1]


def in_pieces(blocks: Iterable[Visibilities], most_bytes: float = 8e6) -> Iterator[Visibilities]:
    """Blocks cut into so few integrations that copies of their data are small."""
    for block in blocks:
        times, channels, baselines = block.data.shape[:3]
        step = int(max(1, most_bytes // (64 * channels * baselines)))
        for t in range(0, times, step):
            yield block if step >= times else block.block(slice(t, t + step), slice(None))


REMEDY = "these blocks can be gone through once: give the plan itself, a list of blocks, or a file of them"


@checked
class VisibilityFile(VisibilitySet):
    """A file that `save` has written, as blocks: nothing but coordinates is held.

    `Visibilities.open` reads some times and channels, or all of them, at once.
    """

    def __init__(self, path: str | os.PathLike[str]) -> None:
        self.store = Store(path)

    def __repr__(self) -> str:
        times, channels, baselines = self.store.shape
        return (
            f"VisibilityFile({self.store.name}: {times} times, {channels} channels, {baselines} baselines, "
            f"{len(self.store.layout)} stations, {self.store.beam_state})"
        )

    @property
    def freq_hz(self) -> Float:
        """Channel centres, Hz (F,)."""
        return self.store.freq_hz

    def blocks(self) -> Iterator[Visibilities]:
        """Blocks of at most 64 MB of data, in order of time; all channels, where one integration of them is smaller."""
        times, channels, baselines = self.store.shape
        some = int(max(1, min(channels, BLOCK_BYTES // (64 * baselines))))
        slots = int(max(1, BLOCK_BYTES // (64 * baselines * channels)))
        for t in range(0, times, slots):
            for f in range(0, channels, some):
                yield Visibilities.of(self.store, slice(t, t + slots), slice(f, f + some))


class _Blocks(VisibilitySet):
    """Blocks of anything iterable."""

    def __init__(self, given: Iterable[Visibilities]) -> None:
        self.given = given
        self.once = iter(given) is given
        self.gone = False

    def blocks(self) -> Iterator[Visibilities]:
        """The blocks; raises `InputError` for a second pass over an iterator, and for what is no block."""
        if self.gone:
            raise InputError(f"a second pass over visibilities: {REMEDY}")
        self.gone = self.once
        for block in self.given:
            if not isinstance(block, Visibilities):
                raise InputError(f"a {type(block).__name__} stands among the blocks: give Visibilities")
            yield block
