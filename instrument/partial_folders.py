"""Folders of what is not whole yet: locked while their process lives, found and removed when it was killed."""

from __future__ import annotations

import contextlib
import fcntl
import os
import shutil
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from instrument.errors import FileError, warn

PARTIAL = ".instrument-partial"  # ends the names of folders that are being written
# files that a folder of data is told by, and what it is
OF_DATA = {  # a file that is in every one of them, and how it begins
    "table.dat": (b"\xbe\xbe\xbe\xbe", "a Measurement Set"),
    "zarr.json": (b"", "data in Zarr"),
    ".zgroup": (b"", "data in Zarr"),
}


@contextmanager
def own_folder(target: Path) -> Iterator[Path]:
    """A folder beside a path that only its owner may enter, with a random name, gone at the end."""
    folder, lock = locked_folder(target)
    try:
        yield folder
    finally:
        shutil.rmtree(folder, ignore_errors=True)
        if lock is not None:
            os.close(lock)


@contextmanager
def beside(target: Path) -> Iterator[Path]:
    """The same; what killed processes have left there is removed first and named.

    Raises `FileError` where none can be made.
    """
    for removed in clean(target.parent):
        warn(removed)
    with contextlib.ExitStack() as stack:
        try:
            folder = stack.enter_context(own_folder(target))
        except OSError as error:
            raise FileError(f"{target.parent}: {error.strerror or error}: nothing can be written there") from None
        yield folder


def inside_data(target: Path) -> str:
    """In which folder of data a path lies, and what that is; "" where it lies in none, or in a folder of ours in it.

    A link is where it stands, and not where it leads; what cannot be looked at is left to those who write there.
    """
    with contextlib.suppress(OSError, RuntimeError, ValueError):  # RuntimeError: a loop of links
        for parent in (target.parent.resolve() / target.name).parents:
            if parent.name.endswith(PARTIAL):
                return ""
            for mark, (begins, what) in OF_DATA.items():
                if (parent / mark).is_file() and _begins(parent / mark, begins):
                    return f"it lies in {parent.name}, {what}"
    return ""


def _begins(file: Path, with_bytes: bytes) -> bool:
    with file.open("rb") as there:
        return there.read(len(with_bytes)) == with_bytes


def locked_folder(target: Path) -> tuple[Path, int | None]:
    """A new folder beside a path and the descriptor that holds it; `None` on a file system without locks."""
    short = target.name.encode()[:100].decode(errors="ignore")
    fresh = Path(tempfile.mkdtemp(prefix=f".{short}.", dir=target.parent))
    # locked before it has the name of a partial folder: to the next process an unlocked one is that of a dead one
    lock = _locked(fresh)
    return fresh.rename(fresh.with_name(fresh.name + PARTIAL)), lock


def clean(folder: Path) -> list[str]:
    """Remove partial folders of runs that are dead; a line for each that was found and is not in use."""
    said = []
    for path in leftovers(folder):
        lock = _locked(path)
        shutil.rmtree(path, ignore_errors=True)
        if lock is not None:
            os.close(lock)
        state = "could not be removed" if path.exists() else "removed"
        said.append(f"{path}, left by a run that was killed, {state}")
    return said


def leftovers(folder: Path) -> list[Path]:
    """Partial folders in a folder that no running process holds."""
    try:
        names = sorted(os.listdir(folder))
    except OSError:
        return []
    found = []
    for path in (Path(folder) / name for name in names if name.startswith(".") and name.endswith(PARTIAL)):
        if path.is_symlink() or not path.is_dir():
            continue
        lock = _locked(path)
        if lock is not None:
            found.append(path)
            os.close(lock)
    return found


def _locked(folder: Path) -> int | None:
    """A descriptor that holds a folder until it is closed or its process dies; `None` where another holds it."""
    try:
        descriptor = os.open(folder, os.O_RDONLY | os.O_DIRECTORY | os.O_NOFOLLOW)
    except OSError:
        return None
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError:  # held, or a file system without locks: nothing is removed there
        os.close(descriptor)
        return None
    return descriptor
