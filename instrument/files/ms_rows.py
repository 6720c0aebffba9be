"""Rows of a Measurement Set: which are of one window and field, in order of time; their values read and written."""

from __future__ import annotations

from typing import Any

import numpy as np

from instrument.errors import FileError
from instrument.files.by_rows import Rows, in_time, pairs_of
from instrument.files.ms_frame import Frame
from instrument.files.ms_tables import AT_ONCE, parts, told
from instrument.files.ms_units import in_unit, utc
from instrument.units import Complex, Int


def filled(table: Any, name: str, rows: Rows, path: str) -> bool:
    """Whether a column of weights is there and has values; raises `FileError` where only some rows have them."""
    if name not in table.columns():
        return False
    if "shape" in table.getcoldesc(name):
        return True  # of every row
    have, count = 0, len(rows.numbers)
    for r in range(0, count, AT_ONCE):
        with told(f"{table.name()}: column {name}"):
            shapes = table.row_shapes(name, (rows.numbers[r : r + AT_ONCE],))
            have += len(shapes) - shapes.null_count
    if 0 < have < count:
        raise FileError(f"{path}: {name} has values in {have} of {count} rows: fill it, or remove the column")
    return have > 0  # or declared, and empty


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
        one, two = frame.numbered(one), frame.numbered(two)
        numbers.append(r + here)
        times.append(in_unit(table, "TIME", time[here], "s", path))
        pairs.append(pairs_of(one[here], two[here], stations, path))
    whole = [np.concatenate(found) for found in (numbers, times, pairs)]
    if not len(whole[0]):
        raise FileError(f"{path} has no cross-correlations of this window and field")
    found = in_time(whole[0], whole[1], np.unique(whole[2]), stations, path)
    interval = in_unit(table, "INTERVAL", at_rows(table, "INTERVAL", found.numbers[found.begins[:-1]]), "s", path)
    return found._replace(slots_s=utc(table, found.slots_s, path), interval_s=interval, autos=autos)


def at_rows(table: Any, name: str, numbers: Int, channels: slice | None = None) -> Any:
    """Values of a column at some rows, of some channels: rows that follow each other in one go."""
    where: Any = np.asarray(numbers)
    if len(numbers) and numbers[-1] - numbers[0] + 1 == len(numbers) and np.all(np.diff(numbers) == 1):
        where = slice(int(numbers[0]), int(numbers[-1]) + 1)
    with told(f"{table.name()}: column {name}"):
        return np.asarray(table.getcol(name, (where,) if channels is None else (where, channels)))


def pairs_at(table: Any, frame: Frame, numbers: Int) -> tuple[Int, Int]:
    """The stations of some rows, as the layout numbers them."""
    one, two = (frame.numbered(at_rows(table, name, numbers)) for name in ("ANTENNA1", "ANTENNA2"))
    return one, two


def put_rows(table: Any, name: str, numbers: Int, values: Complex) -> None:
    """Write values of some rows in the precision of the column."""
    kind = np.complex128 if str(table.getcoldesc(name)["valueType"]).lower().startswith("d") else np.complex64
    with told(f"{table.name()}: column {name}"):
        table.putcol(name, np.ascontiguousarray(values, kind), (np.asarray(numbers),))
