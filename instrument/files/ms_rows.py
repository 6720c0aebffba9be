"""Rows of a Measurement Set: which are of one window and field, in order of time; their values read and written."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np

from instrument.errors import FileError
from instrument.files.by_rows import Rows, in_time, pairs_of
from instrument.files.ms_frame import Frame
from instrument.files.ms_tables import column, told
from instrument.units import Complex, Int

AT_ONCE = 100_000  # rows of what tells where the rows are


def parts(table: Any, *names: str) -> Iterator[tuple[int, list[Any]]]:
    """The number of the first row of a part of the table, and its values of columns of numbers."""
    for r in range(0, table.nrow(), AT_ONCE):
        yield r, [column(table, name, slice(r, r + AT_ONCE)) for name in names]


def kinds_of(table: Any, name: str) -> Int:
    """The values that a column of numbers has, each once."""
    return np.unique(np.concatenate([np.unique(values) for _, (values,) in parts(table, name)]))


def filled(table: Any, name: str, rows: Rows) -> bool:
    """Whether a column of weights is there and has values."""
    if name not in table.columns():
        return False
    try:
        return column(table, name, slice(int(rows.numbers[0]), int(rows.numbers[0]) + 1)).size > 0
    except FileError:
        return False  # declared, and empty


def rows_of(table: Any, frame: Frame, path: str) -> Rows:
    """The rows of the window and field of a frame."""
    stations, autos = len(frame.layout), 0
    numbers, times, pairs = [], [], []
    for r, (described, fields, time, one, two) in parts(
        table, "DATA_DESC_ID", "FIELD_ID", "TIME", "ANTENNA1", "ANTENNA2"
    ):
        mine, cross = (described == frame.described) & (fields == frame.field), one != two
        autos += int((mine & ~cross).sum())
        here = np.flatnonzero(mine & cross)
        numbers.append(r + here)
        times.append(time[here])
        pairs.append(pairs_of(one[here], two[here], stations, path))
    whole = [np.concatenate(found) for found in (numbers, times, pairs)]
    if not len(whole[0]):
        raise FileError(f"{path} has no cross-correlations of this window and field")
    found = in_time(whole[0], whole[1], np.unique(whole[2]), stations, path)
    interval = at_rows(table, "INTERVAL", found.numbers[found.begins[:-1]])
    return found._replace(interval_s=interval, autos=autos)


def at_rows(table: Any, name: str, numbers: Int, channels: slice | None = None) -> Any:
    """Values of a column at some rows, of some channels: rows that follow each other in one go."""
    where: Any = np.asarray(numbers)
    if len(numbers) and numbers[-1] - numbers[0] + 1 == len(numbers) and np.all(np.diff(numbers) == 1):
        where = slice(int(numbers[0]), int(numbers[-1]) + 1)
    with told(f"column {name}"):
        return np.asarray(table.getcol(name, (where,) if channels is None else (where, channels)))


def put_rows(table: Any, name: str, numbers: Int, values: Complex) -> None:
    """Write values of some rows in the precision of the column."""
    kind = np.complex128 if str(table.getcoldesc(name)["valueType"]).lower().startswith("d") else np.complex64
    with told(f"column {name}"):
        table.putcol(name, np.ascontiguousarray(values, kind), (np.asarray(numbers),))
