"""Files that are whole or not there: written beside their name and moved to it at the end."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from instrument.errors import FileError, InputError
from instrument.partial_folders import inside_data, own_folder
from instrument.provenance import written_by


@contextmanager
def whole_file(path: str | os.PathLike[str], overwrite: bool = False) -> Iterator[Path]:
    """Gives a path to write to; it becomes `path` when what is inside succeeds, and is removed when it does not.

    Raises `InputError` for what exists, before anything is done and at the end, unless `overwrite` is given: the one
    rule of every writer. A folder is never overwritten, and nothing is written into one of data.

    The path lies in a new folder of a random name that only its owner may enter: nobody can have put a link to
    another file in its place. A link at `path` itself is replaced, not followed. What the system says against writing
    (full disk, no permission, no such folder) is a `FileError`.
    """
    target = Path(path)
    free_file(target, overwrite)
    try:
        with own_folder(target) as private:
            yield private / target.name
            free_file(target, overwrite)  # it may have come meanwhile
            (private / target.name).replace(target)
    except OSError as error:
        why = error.strerror or str(error).partition("\n")[0] or type(error).__name__
        raise FileError(f"{path} cannot be written: {why}") from None


@contextmanager
def whole_folder(path: str | os.PathLike[str], mark: str, overwrite: bool = False) -> Iterator[Path]:
    """The same for what is a folder of its own: with `overwrite` one that has the file `mark` in it is replaced.

    The old one is there until the new one is whole.
    """
    target = Path(path)
    free_folder(target, mark, overwrite)
    try:
        with own_folder(target) as private:
            yield private / target.name
            free_folder(target, mark, overwrite)
            if target.is_dir():
                old = target.rename(private / "old")
                try:
                    (private / target.name).rename(target)
                except OSError:
                    old.rename(target)
                    raise
            else:
                (private / target.name).rename(target)
    except OSError as error:
        why = error.strerror or str(error).partition("\n")[0] or type(error).__name__
        raise FileError(f"{path} cannot be written: {why}") from None


def free_folder(target: Path, mark: str, overwrite: bool) -> None:
    """Raise `InputError` where `whole_folder` would."""
    _demand_place(target)
    if not os.path.lexists(target):
        return
    if target.is_symlink() or not (target / mark).is_file():
        raise InputError(f"{target} exists and is something else: choose another name")
    if not overwrite:
        raise InputError(f"{target} exists: give overwrite=True, or another name")


def free_file(target: Path, overwrite: bool) -> None:
    """Raise `InputError` where `whole_file` would."""
    _demand_place(target)
    if os.path.lexists(target) and (not overwrite or (target.is_dir() and not target.is_symlink())):
        remedy = "choose another name" if target.is_dir() else "give overwrite=True, or another name"
        raise InputError(f"{target} exists: {remedy}")


def _demand_place(target: Path) -> None:
    """Raise `InputError` for no name, and for a place within a folder of data, of which it would become a part."""
    if "\0" in str(target):
        raise InputError(f"{str(target)!r}: a name of a file holds no null byte")
    if within := inside_data(target):
        raise InputError(f"{target}: {within}: choose another place")


def write_ecsv(table: Any, path: str | os.PathLike[str], overwrite: bool = False) -> None:
    """Write an astropy table as ECSV with its provenance, whole or not at all; see `whole_file`."""
    table = table.copy(copy_data=False)
    table.meta["provenance"] = written_by()
    with whole_file(path, overwrite) as partial:
        table.write(str(partial), format="ascii.ecsv", overwrite=True)
