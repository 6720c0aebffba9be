"""Zarr folders (extra `zarr`) behind the few calls that visibilities in HDF5 are written and read with, bit for bit."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from instrument.errors import FileError, InputError
from instrument.files_in import harmless
from instrument.h5 import FREE_BYTES, PACKED, one_line
from instrument.units import si_prefix

SUFFIX, MARK = ".zarr", "zarr.json"
MISSING = "files in .zarr need zarr: pip install 'instrument[zarr]'"


def is_zarr(path: Any) -> bool:
    """Whether a name is that of a Zarr folder."""
    return Path(os.fspath(path)).suffix.lower() == SUFFIX


def library() -> Any:
    """The module; raises `InputError` with the way to get it."""
    try:
        import zarr
    except ImportError:
        raise InputError(MISSING) from None
    return zarr


class Group:
    """A group whose arrays are made and filled as those of h5py."""

    def __init__(self, group: Any, path: str) -> None:
        self.group, self.path, self.attrs = group, path, group.attrs

    def __contains__(self, name: str) -> bool:
        return name in self.group

    def __getitem__(self, name: str) -> Array:
        return Array(self.group[name], self)

    def __setitem__(self, name: str, values: Any) -> None:
        self.create_dataset(name, data=values)

    def create_dataset(
        self, name: str, shape: Any = None, maxshape: Any = None, dtype: Any = None, chunks: Any = True,
        data: Any = None, compression: Any = None,
    ) -> None:  # fmt: skip
        """A new array; it may grow along any axis, whatever `maxshape`."""
        values = None if data is None else np.asarray(data)
        shape, dtype = (shape, dtype) if values is None else (values.shape, values.dtype)
        self.group.create_array(
            name, shape=shape, dtype=dtype, chunks="auto" if chunks is True else chunks,
            compressors="auto" if compression else None,
            config={"write_empty_chunks": True},  # or -0.0 comes back as 0.0
        )  # fmt: skip
        if values is not None:
            self[name][...] = values


class Array:
    """An array of a group; what is put into it is broadcast, as h5py does."""

    def __init__(self, array: Any, group: Group) -> None:
        self.array, self.group = array, group
        self.shape, self.dtype, self.size = tuple(array.shape), array.dtype, int(array.size)

    def resize(self, shape: tuple[int, ...]) -> None:
        """Make it longer."""
        self.array.resize(tuple(shape))
        self.shape = tuple(shape)

    def __getitem__(self, where: Any) -> Any:
        return np.asarray(self.array[where])

    def __setitem__(self, where: Any, values: Any) -> None:
        steps = where if isinstance(where, tuple) else () if where is Ellipsis else (where,)
        shape = [len(range(*s.indices(n))) for s, n in zip(steps, self.shape, strict=False)]
        self.array[where] = np.broadcast_to(values, (*shape, *self.shape[len(steps) :]))


class Created:
    """A new folder."""

    def __init__(self, path: str | os.PathLike[str]) -> None:
        self.file = Group(library().open_group(os.fspath(path), mode="w-", zarr_format=3), os.fspath(path))

    def check(self) -> None:
        """What the system says against writing has been raised already."""

    def close(self) -> None:
        """All is on the disk."""


@contextmanager
def opened(path: str | os.PathLike[str], what: str) -> Iterator[Group]:
    """The root of a folder; what is broken in it, while it is read, raises `FileError`."""
    zarr, name = library(), harmless(os.path.basename(os.fspath(path)))
    if not os.path.isdir(path):
        raise FileError(f"{harmless(path)} {'is no folder' if os.path.exists(path) else 'does not exist'}")
    try:
        yield Group(zarr.open_group(os.fspath(path), mode="r"), os.fspath(path))
    except FileError:
        raise
    except MemoryError:
        raise FileError(f"{name} does not fit into memory: read a part of it") from None
    # what zarr makes of broken content
    except (OSError, RuntimeError, LookupError, ValueError, TypeError, AttributeError, ArithmeticError) as error:
        raise FileError(f"{name} is not a readable {what}: {harmless(one_line(error), 200)}") from None


def members(group: Group) -> dict[str, Array]:
    """The arrays by name."""
    return {name: group[name] for name in group.group.array_keys()}


def dataset(group: Group, name: str, kinds: str) -> Array:
    """An array of some kinds of numbers, not yet read; raises `FileError` for anything else."""
    found = members(group).get(name)
    if found is None:
        raise FileError(f"{harmless(os.path.basename(group.path))}: there is no array '{name}'")
    if found.dtype.kind not in kinds:
        raise FileError(f"{harmless(os.path.basename(group.path))}: '{name}' holds {found.dtype}")
    return found


def demand_affordable(sets: list[Array]) -> None:
    """Raise `FileError` when arrays declare much more than their folder can hold: nothing is read then."""
    path = Path(sets[0].group.path)
    size = sum(file.lstat().st_size for file in path.rglob("*") if file.is_file())
    declared = sum(s.size * s.dtype.itemsize for s in sets)
    if declared > FREE_BYTES + PACKED * size:
        raise FileError(
            f"{harmless(path.name)}: declares {si_prefix(declared, 'B')} in {si_prefix(size, 'B')} of files; it is "
            "damaged, or made to fill the memory"
        )
