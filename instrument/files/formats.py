"""Formats of visibilities, by what a path is: what reads it, what writes it; Measurement Sets where nothing else is."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from typing import Any

from instrument.errors import FileError, InputError
from instrument.files.by_rows import RowFile
from instrument.files.measurement_set import MARK, MeasurementSet
from instrument.model import Instrument
from instrument.visibilities import Visibilities, VisibilitySet

VERSION_4 = (".zgroup", "zarr.json")  # one of them is in every folder of Zarr
UV, ZARR, SETS = (".uvfits", ".uvh5"), ".zarr", (".ms", ".measurementset")


ENDINGS = "in .uvh5, .uvfits, .zarr or .MS"


def has_columns(path: str) -> bool:
    """Whether visibilities are written into a column of what is there: it is a Measurement Set, or nothing at all."""
    where = Path(path)
    return (where / MARK).is_file() or not where.exists()


def known_file(path: str) -> None:
    """Raise `FileError` for a file whose first bytes are those of no format of visibilities, or that is not there."""
    where = Path(path)
    if not where.is_file():
        raise FileError(f"{path}: there is no such Measurement Set, UVFITS or UVH5 file, or set of version 4")
    with where.open("rb") as file:
        first = file.read(9)
    if not first.startswith((b"SIMPLE  =", b"\x89HDF")):
        raise FileError(f"{path} holds no visibilities: a Measurement Set, UVFITS, UVH5 or version 4 in Zarr is taken")


def names_file(word: str) -> bool:
    """Whether a word is the name of a file to write, and not that of a column."""
    return "/" in word or Path(word).suffix.lower() in (*UV, ZARR, *SETS)


def source(path: str, **choice: Any) -> RowFile:
    """What is at a path as visibilities; of `choice` (column, window, field, part, centre) what is given.

    Raises `InputError` for a choice that the format does not have, `FileError` for what is no file of visibilities.
    """
    given = {name: value for name, value in choice.items() if value is not None}
    where = Path(path)
    if where.is_dir() and any((where / name).is_file() for name in VERSION_4):
        _known(path, given, ("column", "part"), "a set of version 4")
        from instrument.files.msv4_file import Msv4File

        return Msv4File(path, given.get("part"), given.get("column", "base"))
    if where.is_file():
        known_file(path)
        _known(path, given, ("window", "field", "centre"), "a UVFITS or UVH5 file")
        from instrument.files.uv_file import UVFile

        return UVFile(path, **given)
    _known(path, given, ("column", "window", "field"), "a Measurement Set")
    return MeasurementSet(path, **given)


def _known(path: str, given: dict[str, Any], known: tuple[str, ...], what: str) -> None:
    if unknown := [name for name in given if name not in known]:
        have = ", ".join(known)
        raise InputError(f"{path} is {what}, which has no {unknown[0]} to choose: leave it out (it has {have})")


def write(
    path: str, blocks: VisibilitySet | Iterable[Visibilities], overwrite: bool, instrument: Instrument | None
) -> None:
    """Write blocks to a new file in the format that its name ends in."""
    suffix = Path(path).suffix.lower()
    if suffix in UV:
        from instrument.files.uv_write import write_uv

        write_uv(path, blocks, overwrite, telescope=instrument.telescope_name if instrument else "unknown")
    elif suffix == ZARR:
        from instrument.files.msv4_file import write_msv4

        write_msv4(path, blocks, overwrite, telescope=instrument.telescope_name if instrument else "unknown")
    else:
        MeasurementSet.create(path, blocks, overwrite, instrument)


def demand_free(path: str, overwrite: bool) -> None:
    """Raise `InputError` for what is there already, a place within other data, and a library that is not there."""
    from instrument.whole_file import free_file, free_folder

    suffix = Path(path).suffix.lower()
    if suffix in UV:
        from instrument.files.uv_data import library

        library()
        free_file(Path(path), overwrite)
    elif suffix == ZARR:
        from instrument import zarr_tree
        from instrument.files.msv4_file import MARK as OURS
        from instrument.msv4 import library as xarray

        zarr_tree.library()
        xarray()
        free_folder(Path(path), OURS, overwrite)
    else:
        free_folder(Path(path), MARK, overwrite)
