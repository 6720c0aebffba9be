"""HDF5 files that anyone may have prepared: regular files, hard links only, declared sizes looked at before reading."""

from __future__ import annotations

import io
import os
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np

from instrument.errors import FileError
from instrument.files_in import harmless, is_measurement_set, open_regular
from instrument.units import si_prefix

# What a file may declare in memory: h5parms are packed 50-fold where all is 1 or flagged; small files may do more
FREE_BYTES, PACKED = 64_000_000, 50
LONGEST_NAME = 1000


class _Source(io.BufferedReader):
    """An open file that h5py names by its name."""

    label = ""

    def __repr__(self) -> str:
        return self.label


class Created:
    """A new HDF5 file; what the system says against writing is kept, and raised as `OSError` by `check` and `close`.

    Where it reaches HDF5 itself, as on a full disk, hundreds of lines are printed and the process crashes as it ends.
    """

    def __init__(self, path: str | os.PathLike[str]) -> None:
        import h5py

        self.refused: OSError | None = None
        self.raw = open(path, "w+b", buffering=0)  # noqa: SIM115 - closed by `close`
        self.file: Any = h5py.File(self, "w")

    def write(self, data: Any) -> int:
        """Write all of some bytes, or keep why not."""
        left = memoryview(data).cast("B")
        size = len(left)
        try:
            while len(left) and self.refused is None:
                left = left[self.raw.write(left) :]
        except OSError as error:
            self.refused = error
        return size

    def truncate(self, size: int | None = None) -> int:
        """Cut or extend the file, or keep why not."""
        try:
            return self.raw.truncate(size)
        except OSError as error:
            self.refused = self.refused or error
            return size or 0

    def read(self, size: int = -1) -> bytes | None:
        """Read back what was written: h5py takes nothing for a file without it."""
        return self.raw.read(size)

    def readinto(self, buffer: Any) -> int | None:
        """Read back what was written."""
        return self.raw.readinto(buffer)

    def seek(self, *where: int) -> int:
        """Go to a place."""
        return self.raw.seek(*where)

    def tell(self) -> int:
        """Where it is."""
        return self.raw.tell()

    def flush(self) -> None:
        """Nothing waits here."""

    def check(self) -> None:
        """Raise what the system has said against writing, if anything, once the file is closed."""
        if self.refused is not None:
            self.close()

    def close(self) -> None:
        """Close the file; raises what was said against writing it."""
        self.file.close()
        self.raw.close()
        if self.refused is not None:
            raise self.refused


@contextmanager
def created(path: str | os.PathLike[str]) -> Iterator[Any]:
    """A new HDF5 file, closed at the end; raises `OSError` where it could not be written whole."""
    made = Created(path)
    try:
        yield made.file
        made.check()
    finally:
        made.close()


@contextmanager
def opened(path: Any, what: str) -> Iterator[Any]:
    """The root of an HDF5 file; what is broken in it, while it is read, raises `FileError`."""
    import h5py

    try:
        if not os.path.exists(path) and not is_measurement_set(path):
            raise FileError(f"{harmless(path)} does not exist")
        name = harmless(os.path.basename(os.fspath(path)))
        try:
            file = open_regular(path, what=what)
        except FileError as error:
            raise FileError(f"{name} is not a readable {what}: {error}") from None
        with _Source(file.detach()) as raw:  # type: ignore[attr-defined]
            raw.label = name
            with h5py.File(raw, "r") as store:
                yield store
    except FileError:
        raise
    except MemoryError:
        raise FileError(f"{name} does not fit into memory: read fewer of its tables") from None
    # what h5py makes of broken content
    except (OSError, RuntimeError, LookupError, ValueError, TypeError, AttributeError, ArithmeticError) as error:
        raise FileError(f"{name} is not a readable {what}: {harmless(one_line(error), 200)}") from None


def members(group: Any) -> dict[str, Any]:
    """Groups and datasets of a group by name; a link raises, for what a file names is not opened."""
    return {name: _member(group, name) for name in group}


def _member(group: Any, name: str) -> Any:
    import h5py

    link = group.get(name, getlink=True)
    if not isinstance(link, h5py.HardLink):
        other = f"in the file '{harmless(link.filename, 80)}'" if isinstance(link, h5py.ExternalLink) else "elsewhere"
        raise FileError(
            f"{file_of(group)}: '{harmless(name, 80)}' only points to something {other}, which is not opened; "
            "copy it in (h5copy, h5repack)"
        )
    return group[name]


def dataset(group: Any, name: str, kinds: str = "fiuSUO") -> Any:
    """A dataset of numbers or text that is all in this file, not yet read; raises `FileError` for anything else."""
    import h5py

    found = _member(group, name) if name in group else None
    where = f"{file_of(group)}, {harmless(group.name)}"
    if found is None:
        raise FileError(f"{where}: there is no '{name}'")
    if not isinstance(found, h5py.Dataset):
        raise FileError(f"{where}: '{name}' is a group, needed an array")
    if found.is_virtual or found.external:
        raise FileError(f"{where}: '{name}' lies in other files, which are not opened; copy it in (h5repack)")
    if found.shape is None or found.dtype.kind not in kinds:
        raise FileError(f"{where}: '{name}' holds {found.dtype}, needed an array of numbers or names")
    return found


def numbers(found: Any, index: Any = ()) -> Any:
    """Numbers of a dataset as float64; text raises `ValueError`, which `opened` words."""
    if found.dtype.kind not in "fiu":
        raise ValueError(f"{found.name} holds {found.dtype}, needed numbers")
    return np.asarray(found[index], float)


def names(found: Any) -> list[str]:
    """A list of names, one at a time where they are of any length: each of them might be the same long one."""
    if found.ndim != 1 or found.dtype.kind not in "SO":
        raise FileError(f"{file_of(found)}, {found.name}: holds {found.dtype}, needed a list of names")
    if found.dtype.kind == "S":
        return [text(value) for value in found[()]]
    out: list[str] = []
    for k in range(found.shape[0]):
        out.append(text(found[k]))
        if len(out[-1]) > LONGEST_NAME:
            raise FileError(f"{file_of(found)}, {found.name}: a name of {len(out[-1])} characters")
    return out


def demand_affordable(sets: list[Any]) -> None:
    """Raise `FileError` when datasets declare much more than their file can hold: nothing is read then."""
    if not sets:
        return
    size = sets[0].file.id.get_filesize()
    declared = sum(int(s.size) * int(s.dtype.itemsize) for s in sets)
    if declared > FREE_BYTES + PACKED * size:
        raise FileError(
            f"{file_of(sets[0])}, {sets[0].parent.name}: declares {si_prefix(declared, 'B')} in a file of "
            f"{si_prefix(size, 'B')}; it is damaged, or made to fill the memory"
        )


def file_of(thing: Any) -> str:
    """The name of the file that holds a group or a dataset."""
    return str(thing.file.filename)


def text(value: Any) -> str:
    """Text of an attribute or a name, which HDF5 has in several forms."""
    value = np.asarray(value).ravel()[0] if np.size(value) else ""
    return value.decode(errors="replace") if isinstance(value, bytes) else str(value)


def one_line(error: Exception) -> str:
    """First line of what an error says."""
    return (str(error) or type(error).__name__).splitlines()[0]
