"""A run folder read back: its record, tables, cubes and figures, as anyone may have prepared them."""

from __future__ import annotations

import json
import os
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from instrument.errors import FileError, InputError
from instrument.files_in import harmless, read_regular

MOST_BYTES = 64 << 20  # of run.json, and of a table
MOST_FILES = 2000
DEEPEST = 3  # folders within a run folder


@dataclass(frozen=True)
class RunRead:
    """A run folder: what was called it, what run.json holds, and its files by their names within it."""

    label: str
    record: dict[str, Any]
    files: dict[str, Path]

    def part(self, name: str) -> dict[str, Any]:
        """A part of the record that is a table; empty where there is none."""
        found = self.record.get(name)
        return found if isinstance(found, dict) else {}

    def text(self, name: str) -> str:
        """An entry of the record as text for one line."""
        return harmless(self.record.get(name, ""), 120)

    def named(self, *endings: str) -> list[str]:
        """Names of the files with such an ending, in order."""
        return sorted(name for name in self.files if name.endswith(endings))

    def table(self, name: str) -> Any:
        """A table (ECSV) of the folder; raises `FileError` in one line for what is none."""
        from astropy.table import Table

        content = read_regular(self.files[name], MOST_BYTES, "table")
        try:
            return Table.read(content.decode("utf-8").splitlines(), format="ascii.ecsv")
        except Exception as error:  # its parsers raise of every kind
            said = (str(error) or type(error).__name__).splitlines()[0]
            raise FileError(f"{self.label}, {harmless(name)} is no table: {harmless(said, 120)}") from None


def read_run(path: str | os.PathLike[str]) -> RunRead:
    """The run in a folder; raises `InputError` in one line where there is none."""
    folder, label = Path(path), harmless(path)
    try:
        if not folder.is_dir():
            raise InputError(f"'{label}' is no folder: give the folder of a run, such as runs/NAME")
        if not (folder / "run.json").exists():
            raise InputError(f"'{label}' is no run folder: there is no run.json in it")
        files = _files(folder)
    except (OSError, ValueError) as error:  # a NUL in the name; a folder that may not be read
        if isinstance(error, InputError):
            raise
        raise InputError(f"'{label}' cannot be read: {getattr(error, 'strerror', None) or error}") from None
    content = read_regular(folder / "run.json", MOST_BYTES, "run.json")
    try:
        record = json.loads(content)
    except (ValueError, RecursionError) as error:
        raise FileError(f"{label}: run.json is no JSON ({harmless(str(error).splitlines()[0], 120)})") from None
    if not isinstance(record, dict) or not isinstance(record.get("versions"), dict):
        raise FileError(f"{label}: run.json is not that of a run: it names no versions")
    return RunRead(label, record, files)


def _files(folder: Path) -> dict[str, Path]:
    """Regular files in a folder and below, by name; links are left out: what they lead to is elsewhere."""
    found: dict[str, Path] = {}
    for top, folders, names in os.walk(folder):
        at = Path(top).relative_to(folder)
        if len(at.parts) >= DEEPEST:
            folders.clear()
        for name in sorted(names):
            one = Path(top) / name
            if one.is_file() and not one.is_symlink() and len(found) < MOST_FILES:
                found[(at / name).as_posix()] = one
    return found
