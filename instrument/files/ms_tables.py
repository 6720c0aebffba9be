"""Tables of a Measurement Set through arcae: opened, read and written in rows, every failure one line of ours."""

from __future__ import annotations

import os
import re
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from instrument.errors import FileError, InputError
from instrument.files.ms_lock import unlocked
from instrument.files_in import harmless

AT_ONCE = 100_000  # rows of what tells where the rows are
MISSING = "Measurement Sets need arcae (Linux, macOS): pip install 'instrument[ms]'"


@contextmanager
def opened(path: str | os.PathLike[str], sub: str = "", writable: bool = False) -> Iterator[Any]:
    """A table of the set, closed at the end; `FileError` for what is none, is locked, or cannot be read here."""
    Table = _library()
    name = str(path)
    if not Path(name).exists():
        raise FileError(f"{name}: there is no such Measurement Set")
    if not (Path(name) / "table.dat").is_file():
        raise FileError(f"{name}: no Measurement Set: it is to be a folder with a file table.dat")
    with unlocked(f"{name}/{sub}" if sub else name, writable):
        with told(f"{name}::{sub}" if sub else name):
            table = Table.from_filename(f"{name}::{sub}" if sub else name, readonly=not writable)
        try:
            yield table
        finally:
            table.close()


@contextmanager
def created(path: str, columns: dict[str, Any], tile: list[int] | None = None) -> Iterator[Any]:
    """A new table with columns as casacore describes them: a set with those a set must have, if `tile` is given.

    `tile` is the shape of the tiles of its cubes (correlations, channels, rows).
    """
    Table = _library()
    groups = {
        f"*{k}": {"NAME": c["dataManagerGroup"], "TYPE": c["dataManagerType"], "SPEC": {"DEFAULTTILESHAPE": tile},
                  "COLUMNS": [name]}
        for k, (name, c) in enumerate(columns.items(), 1) if tile
    }  # fmt: skip
    with told(path):
        if tile:
            table = Table.ms_from_descriptor(path, "MAIN", columns, groups)
        else:
            table = Table.from_descriptor(path, table_desc=columns)
    try:
        yield table
    finally:
        table.close()


def _library() -> Any:
    try:
        from arcae.lib.arrow_tables import Table
    except ImportError:
        raise InputError(MISSING) from None
    return Table


@contextmanager
def told(what: str) -> Iterator[None]:
    """Failures of the library as `FileError`s about `what`; a storage manager that is not there by its name."""
    try:
        yield
    except InputError:
        raise
    except (ValueError, RuntimeError, KeyError, TypeError, OSError, NotImplementedError) as error:
        text = " ".join(str(error).split()).replace("Unhandled casacore exception: ", "")
        lacking = re.search(r"Shared library (\S+) not found in CASACORE_LDPATH|Data Manager class (\S+)", text)
        if lacking:
            text = (
                f"its storage manager {lacking[1] or lacking[2]} is not installed here: put the folder of its library "
                "(DyscoStMan: libdyscostman) into CASACORE_LDPATH, or copy the set without it (DP3, with no "
                "msout.storagemanager)"
            )
        if "bucket" in text.lower():  # casacore's word for what it reads of a file at once
            text = f"it is cut short or damaged, copy the set again ({text})"
        raise FileError(f"{harmless(what)}: {harmless(text, 300)}") from None


def column(table: Any, name: str, rows: slice | None = None) -> Any:
    """Values of a column, (rows, ...), as an array of its own."""
    with told(f"{table.name()}: column {name}"):
        if rows is None:
            return np.array(table.getcol(name))
        return np.array(table.getcol(name, (slice(rows.start, min(rows.stop, table.nrow())),)))


def parts(table: Any, *names: str) -> Iterator[tuple[int, list[Any]]]:
    """The number of the first row of a part of the table, and its values of columns of numbers."""
    for r in range(0, table.nrow(), AT_ONCE):
        yield r, [column(table, name, slice(r, r + AT_ONCE)) for name in names]


def kinds_of(table: Any, name: str) -> Any:
    """The values that a column of numbers has, each once."""
    return np.unique(np.concatenate([np.unique(values) for _, (values,) in parts(table, name)]))


def demand(table: Any, names: tuple[str, ...], what: str) -> None:
    """`FileError` for columns that a table lacks."""
    lacking = [name for name in names if name not in table.columns()]
    if lacking:
        raise FileError(f"{what} has no column {', '.join(lacking)}: it is no whole Measurement Set")
