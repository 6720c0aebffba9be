"""Locks of tables of a Measurement Set, as casacore keeps them: waited for a while, then said who holds them."""

from __future__ import annotations

import os
import struct
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager

from instrument.errors import FileError

WAIT_S = 5.0
# struct flock of the C library: what it is, from where, where, how many bytes, whose
FLOCK, KIND, OWNER = ("qqihh", 3, 2) if sys.platform == "darwin" else ("hhqqi4x", 0, 4)
HERE = threading.Lock()
OPEN: dict[str, int] = {}  # tables that this process has open: to close any file of theirs would drop its locks


@contextmanager
def unlocked(folder: str, writable: bool) -> Iterator[None]:
    """While a table is in use; raises `FileError` where another process keeps it locked for longer than `WAIT_S`.

    Without it casacore waits for ever, and no signal ends it.
    """
    name = os.path.realpath(folder)
    with HERE:
        first = name not in OPEN
        OPEN[name] = OPEN.get(name, 0) + 1
    try:
        if first:
            _wait(folder, os.path.join(name, "table.lock"), writable)
        yield
    finally:
        with HERE:
            OPEN[name] -= 1
            if not OPEN[name]:
                del OPEN[name]


def _wait(folder: str, lock: str, writable: bool) -> None:
    until = time.monotonic() + WAIT_S
    while (owner := holder(lock, writable)) is not None:
        if time.monotonic() > until:
            who = f" (number {owner})" if owner > 0 else ""
            raise FileError(f"{folder} is locked by another process{who}: wait until it has done, or close it there")
        time.sleep(0.1)


def holder(lock: str, writable: bool) -> int | None:
    """The number of a process that keeps us from reading or writing, 0 or less where it is not known; or `None`."""
    import fcntl  # Windows has none, nor casacore

    try:
        file = os.open(lock, os.O_RDONLY)
    except OSError:  # no file yet, or none that may be read: the library tells
        return None
    try:
        kind = fcntl.F_WRLCK if writable else fcntl.F_RDLCK
        order = [kind, os.SEEK_SET, 0, 1, 0] if KIND == 0 else [0, 1, 0, kind, os.SEEK_SET]  # casacore's: byte 0
        found = struct.unpack(FLOCK, fcntl.fcntl(file, fcntl.F_GETLK, struct.pack(FLOCK, *order)))
    except OSError:  # a disk without locks
        return None
    finally:
        os.close(file)
    return None if found[KIND] == fcntl.F_UNLCK else int(found[OWNER])
