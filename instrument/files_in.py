"""Files from outside: regular ones only, opened once, never more of them in memory than a limit that is said."""

from __future__ import annotations

import gzip
import io
import os
import stat
import zlib
from pathlib import Path
from typing import Any, BinaryIO

from instrument.errors import FileError
from instrument.units import si_prefix

GZIP = b"\x1f\x8b"
SHOWN = 24  # characters of a file's contents that an error quotes: enough to find the place, too few to give a secret


def harmless(text: Any, at_most: int | None = None) -> str:
    r"""Text of unknown origin for a message: control and format characters escaped (\x1b), cut to a length."""
    text = str(text)
    cut = text if at_most is None or len(text) <= at_most else text[: at_most - 3] + "..."
    return "".join(c if c.isprintable() else c.encode("unicode_escape").decode() for c in cut)


def is_measurement_set(path: Any) -> bool:
    """Whether a name is that of a Measurement Set, there or not: a folder with a table in it, or a name in .ms."""
    try:
        text = os.fspath(path)
        folder = os.path.isdir(text)
        named = str(text).rstrip("/").lower().endswith((".ms", ".measurementset"))
        return (folder and os.path.isfile(os.path.join(text, "table.dat"))) or (named and not os.path.isfile(text))
    except (OSError, ValueError, TypeError):  # a NUL in the name: who opens it says so
        return False


def open_regular(path: Any, limit_bytes: int | None = None, what: str = "file") -> BinaryIO:
    """A regular file opened for reading in binary; the caller closes it.

    Opened first and looked at afterwards, so that nothing can take its place in between, and without waiting, so that
    a pipe behind the name does not block. Raises `FileError` for what is no regular file (folder, pipe, device, socket)
    and for one of more than `limit_bytes`; a sparse file counts with the size that it declares.
    """
    shown = harmless(path)
    if is_measurement_set(path):
        raise FileError(
            f"'{shown}' is a Measurement Set: instrument.MeasurementSet reads it in Python; images of it, as FITS, "
            "go into 'instrument analyze', an observation like it into a scene file for 'instrument run'"
        )
    try:
        # O_NONBLOCK and O_NOCTTY are not everywhere; O_BINARY is on Windows alone
        flags = os.O_RDONLY | sum(getattr(os, name, 0) for name in ("O_NONBLOCK", "O_NOCTTY", "O_CLOEXEC", "O_BINARY"))
        number = os.open(os.fspath(path), flags)
    except FileNotFoundError:
        raise FileError(f"no {what} '{shown}'") from None
    except (OSError, ValueError, TypeError) as error:  # ValueError: a NUL in the name
        why = getattr(error, "strerror", None) or error
        raise FileError(f"{what} '{shown}' cannot be opened: {harmless(why)}") from None
    try:
        found = os.fstat(number)
        if stat.S_ISDIR(found.st_mode):
            raise FileError(f"'{shown}' is a folder; name the file in it")
        if not stat.S_ISREG(found.st_mode):
            raise FileError(f"'{shown}' is a pipe or a device, no regular file; write its contents into a file first")
        if limit_bytes is not None and found.st_size > limit_bytes:
            raise FileError(_too_large(shown, found.st_size, limit_bytes, what))
        return os.fdopen(number, "rb")
    except BaseException:  # whatever went wrong, the descriptor is not left open
        os.close(number)
        raise


def read_regular(path: Any, limit_bytes: int, what: str = "file", unzip: bool = False) -> bytes:
    """The bytes of a regular file, at most `limit_bytes` of them also where the file does not say its size (/proc).

    With `unzip` gzip is undone, and the limit holds for what comes out: a bomb is refused after `limit_bytes`.
    """
    with open_regular(path, limit_bytes, what) as file:
        try:
            raw = file.read(limit_bytes + 1)
        except OSError as error:
            raise FileError(f"{what} '{harmless(path)}' cannot be read: {error.strerror or error}") from None
    if len(raw) > limit_bytes:
        raise FileError(_too_large(harmless(path), None, limit_bytes, what))
    return _unzipped(raw, path, limit_bytes, what) if unzip and raw.startswith(GZIP) else raw


def _unzipped(raw: bytes, path: Any, limit: int, what: str) -> bytes:
    """What gzip has packed, unless it is more than the limit."""
    try:
        out = gzip.GzipFile(fileobj=io.BytesIO(raw)).read(limit + 1)
    except (OSError, EOFError, zlib.error) as error:
        raise FileError(f"{harmless(Path(path).name)}: damaged gzip ({error}); fetch it again, or unpack it") from None
    if len(out) > limit:
        raise FileError(_too_large(harmless(path), None, limit, f"{what}, unpacked,"))
    return out


def _too_large(shown: str, size: int | None, limit: int, what: str) -> str:
    there = "is larger" if size is None else f"has {si_prefix(size, 'B')}, which is more"
    return f"{what} '{shown}' {there} than the {si_prefix(limit, 'B')} that are read; cut out what is needed"
