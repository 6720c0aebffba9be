"""Coefficients, stations and arrays that the plugins carry; provenance in README.md beside them."""

from __future__ import annotations

import csv
from collections.abc import Mapping
from functools import cache
from importlib.resources import files
from typing import Any

import numpy as np

TYPES = {"string": str, "int64": int, "float64": float}


class Rows:
    """Columns of one length by their names, and `meta`, what the head of the file says of them; do not change them."""

    def __init__(self, columns: Mapping[str, Any], meta: dict[str, Any]) -> None:
        self.columns, self.meta = columns, meta

    def __len__(self) -> int:
        return len(next(iter(self.columns.values())))

    def __getitem__(self, which: Any) -> Any:
        """A column by its name, or some of the rows."""
        if isinstance(which, str):
            return self.columns[which]
        return Rows({name: column[which] for name, column in self.columns.items()}, self.meta)


@cache
def table(name: str) -> Rows:
    """The data file `name`, ECSV or CSV with # comments: what `astropy.table` reads in a fifth of a second."""
    lines = (files(__package__) / name).read_text(encoding="utf-8").splitlines()
    rest = [line for line in lines if line and not line.startswith("#")]
    rows = csv.reader(rest, delimiter=" " if name.endswith(".ecsv") else ",")
    names, *cells = rows
    columns = [np.array(column) for column in zip(*cells, strict=True)]
    if not name.endswith(".ecsv"):
        return Rows(dict(zip(names, map(_guessed, columns), strict=True)), {})
    import yaml

    head = yaml.safe_load("\n".join(line[2:] for line in lines if line.startswith("# "))[len("%ECSV 1.0") :])
    types = {column["name"]: TYPES[column["datatype"]] for column in head["datatype"]}
    return Rows({n: column.astype(types[n]) for n, column in zip(names, columns, strict=True)}, head.get("meta", {}))


def _guessed(column: Any) -> Any:
    """A column of text as whole numbers, or as numbers, where all of it is."""
    for kind in (int, float):
        try:
            return column.astype(kind)
        except ValueError:
            continue
    return column
