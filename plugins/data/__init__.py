"""Coefficients, stations and arrays that the plugins carry; provenance in README.md beside them."""

from __future__ import annotations

from functools import cache
from importlib.resources import files
from typing import Any


@cache
def table(name: str) -> Any:
    """The data file `name` (ECSV or CSV with # comments) as an astropy table; do not change it."""
    from astropy.table import Table

    path = files(__package__) / name
    return Table.read(str(path), format="ascii.ecsv" if name.endswith(".ecsv") else "ascii.csv", comment="#")
