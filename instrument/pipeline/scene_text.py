"""The text of scene files: TOML in UTF-8 to tables and back, and settings of the command line put into them."""

from __future__ import annotations

import copy
import os
import re
import tomllib
import unicodedata
from collections.abc import Sequence
from datetime import date, datetime, time
from importlib.resources import files
from pathlib import Path
from typing import Any

from instrument.errors import FileError, InputError, did_you_mean

MOST_BYTES = 10e6  # of a scene file
DEEPEST = 12  # tables in tables
BARE = re.compile(r"[A-Za-z0-9_-]+")
NOT_UTF8 = {  # how other files begin
    b"\xff\xfe": "is UTF-16 or UTF-32 text",
    b"\xfe\xff": "is UTF-16 text",
    b"\x00\x00\xfe\xff": "is UTF-32 text",
    b"\x89PNG": "is a PNG image",
    b"SIMPLE  =": "is a FITS file",
    b"\x89HDF": "is an HDF5 file",
    b"PK\x03\x04": "is a ZIP archive",
    b"\x1f\x8b": "is packed by gzip",
}


def shipped() -> dict[str, str]:
    """Names of the shipped scenes and their titles."""
    found = {}
    for entry in sorted(files("instrument.scenes").iterdir(), key=lambda e: e.name):
        if entry.name.endswith(".toml"):
            found[entry.name.removesuffix(".toml")] = tomllib.loads(entry.read_text("utf-8")).get("title", "")
    return found


def read_tables(scene: str | os.PathLike[str]) -> dict[str, Any]:
    """Tables of a scene file, or of the shipped scene of that name."""
    from instrument.files_in import is_measurement_set, read_regular

    path = Path(scene)
    taken = str(scene) in shipped() and os.path.isdir(path)  # a run of it may have left a folder of its name
    if path.suffix == ".toml" or (_is_there(path) and not taken) or is_measurement_set(path):
        return _tables(_decoded(read_regular(path, int(MOST_BYTES), "scene file"), str(path)), str(path))
    if str(scene) not in shipped():
        raise InputError(f"no scene is called '{scene}': {did_you_mean(str(scene), shipped())}; or give a .toml file")
    return _tables((files("instrument.scenes") / f"{scene}.toml").read_text("utf-8"), str(scene))


def _is_there(path: Path) -> bool:
    try:
        return os.path.lexists(path)
    except (OSError, ValueError):  # too long for a name, or with a NUL
        return False


def _decoded(raw: bytes, label: str) -> str:
    """The text of a file in UTF-8, which is what TOML is written in; a mark of the byte order at its start is taken."""
    raw = raw.removeprefix(b"\xef\xbb\xbf")
    for start, what in NOT_UTF8.items():
        if raw.startswith(start):
            raise FileError(f"'{label}' {what}: a scene file is TOML in UTF-8; save it as that")
    try:
        return raw.decode("utf-8")
    except UnicodeDecodeError as error:
        line = raw.count(b"\n", 0, error.start) + 1
        raise FileError(
            f"'{label}', line {line}: byte {raw[error.start]:#04x} is not UTF-8 (Latin-1?): save the file as UTF-8"
        ) from None


def _tables(text: str, label: str) -> dict[str, Any]:
    try:
        found: dict[str, Any] = _plain(tomllib.loads(text), label)
        return found
    except tomllib.TOMLDecodeError as error:
        raise FileError(f"'{label}': {error}{_key_at(text, str(error))}") from None
    except RecursionError:
        raise FileError(f"'{label}': values are nested deeper than {DEEPEST} levels") from None
    except InputError:
        raise
    except ValueError as error:  # an integer of more digits than Python reads; a day that no month has
        raise FileError(f"'{label}': {error}") from None


def _key_at(text: str, message: str) -> str:
    """The key on the line of an error; no other content, for the file may be anything."""
    place = re.search(r"at line (\d+)", message)
    lines = text.splitlines()
    if place is None or int(place[1]) > len(lines):
        return ""
    key = re.match(r"\s*([\w.-]{1,40})\s*=|\s*(\[+[\w.-]{1,40}\]+)", lines[int(place[1]) - 1])
    return f": {(key[1] or key[2])}" if key else ""


def _plain(value: Any, name: str, depth: int = 0) -> Any:
    """Tables with times written without quotes as text; refuses what no later stage could take, by its key."""
    if depth > DEEPEST:
        raise FileError(f"{name[:60]}: values are nested deeper than {DEEPEST} levels")
    if isinstance(value, dict):
        for key in value:
            _check_text(key, f"a key of {name}")
        inner = (lambda key: str(key)) if depth == 0 else (lambda key: f"{name}.{key}")
        return {key: _plain(item, inner(key), depth + 1) for key, item in value.items()}
    if isinstance(value, list):
        return [_plain(item, name, depth + 1) for item in value]
    if isinstance(value, str):
        _check_text(value, name)
    if isinstance(value, int) and not -(2**63) <= value < 2**63:
        raise InputError(f"{name} is an integer of more than 64 bits, which no setting takes")
    return value.isoformat() if isinstance(value, date | datetime | time) else value


def _check_text(text: str, name: str) -> None:
    odd = next((c for c in text if c not in "\n\t" and unicodedata.category(c) in ("Cc", "Cs")), "")
    if odd:
        raise InputError(f"{name} holds the control character {odd.encode('unicode_escape').decode()}: leave it out")


def override(tables: dict[str, Any], settings: Sequence[str]) -> dict[str, Any]:
    """Tables with settings such as "sky.brightest=500" put in; values are TOML, or else text."""
    out = copy.deepcopy(tables)
    for setting in settings:
        key, equals, text = setting.partition("=")
        steps = [s.strip() for s in key.split(".")]
        shown = setting if len(setting) <= 80 else f"{setting[:77]}..."
        if not equals or not all(steps):
            raise InputError(f"--set {shown}: write it like --set sky.brightest=500")
        if len(steps) > DEEPEST:
            raise InputError(f"--set {shown}: nested deeper than {DEEPEST} levels")
        table = out
        for step in steps[:-1]:
            table = table.setdefault(step, {})
            if not isinstance(table, dict):
                raise InputError(f"--set {shown}: '{step}' is not a table")
        table[steps[-1]] = _value(text, key.strip(), shown)
    return out


def _value(text: str, name: str, shown: str) -> Any:
    try:
        found = tomllib.loads(f"value = {text}")
    except tomllib.TOMLDecodeError:
        found = {"value": text.strip()}
    except (RecursionError, ValueError):  # nested too deep; more digits than Python reads
        raise InputError(f"--set {shown}: not a value that a setting takes") from None
    if set(found) != {"value"}:
        raise InputError(f"--set {shown}: one value, please; give --set once for each setting")
    return _plain(found["value"], name, 1)


def to_toml(tables: dict[str, Any]) -> str:
    """Tables as TOML text; the inverse of reading them, for what a scene file holds."""
    import tomli_w

    return tomli_w.dumps(tables)
