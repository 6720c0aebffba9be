"""Memory: what this machine and process may still use, and the refusal of more before it is allocated."""

from __future__ import annotations

import contextlib
import ctypes
import gc
import os
import sys
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from instrument.errors import RefusedError
from instrument.units import si_prefix

SHARE = 0.75  # of the memory that is there, which one run may take


def machine_memory() -> float:
    """Bytes of memory of this machine, or of the group of processes it is limited to; 8 GB where it cannot be asked."""
    try:
        found = float(os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES"))
    except (AttributeError, ValueError, OSError):
        found = 8e9
    for name in ("/sys/fs/cgroup/memory.max", "/sys/fs/cgroup/memory/memory.limit_in_bytes"):
        try:
            found = min(found, float(Path(name).read_text()))
        except (OSError, ValueError):  # no such file, or the word "max"
            continue
    return found


def resident() -> float:
    """Bytes of memory that this process has now; 200 MB, that of an interpreter with its libraries, if unknown."""
    try:
        return float(Path("/proc/self/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE")
    except (OSError, ValueError, IndexError):
        return 200e6


def high_water() -> float:
    """The most bytes that this process has had at once; `resident()` where the system does not tell.

    On Linux what getrusage tells begins with what the process that started this one had: a notebook's gigabytes.
    """
    with contextlib.suppress(OSError, ValueError, StopIteration):
        lines = Path("/proc/self/status").read_text().splitlines()
        return 1024 * float(next(line.split()[1] for line in lines if line.startswith("VmHWM:")))
    try:
        import resource

        found = float(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss)
    except ImportError:
        return resident()
    return found * (1 if sys.platform == "darwin" else 1024)


def give_back() -> None:
    """Memory that is free in this process given back to the system, where its C library can.

    What only circles still hold is freed first: exceptions that a library keeps hold the frames they passed.
    """
    gc.collect()
    with contextlib.suppress(OSError, AttributeError):
        ctypes.CDLL(None).malloc_trim(0)


@contextlib.contextmanager
def quick_give_back() -> Iterator[None]:
    """Within it `give_back` looks only at what is made within: a million objects of libraries take 0.2 s each time."""
    gc.collect()
    gc.freeze()
    try:
        yield
    finally:
        gc.unfreeze()


def usable() -> float:
    """Bytes that a run may take: three quarters of the machine, or of the addresses left under `ulimit -v`."""
    return SHARE * min(machine_memory(), _addresses_left())


def _addresses_left() -> float:
    try:
        import resource

        limit, _ = resource.getrlimit(resource.RLIMIT_AS)
        if limit == resource.RLIM_INFINITY:
            return np.inf
        taken = float(Path("/proc/self/statm").read_text().split()[0]) * os.sysconf("SC_PAGE_SIZE")
    except (ImportError, OSError):
        return np.inf
    return max(0.0, limit - taken)


def afford(size: float, what: str, remedy: str) -> None:
    """Raise `RefusedError` when `size` bytes are more than may be taken: what needs them, and the way out.

    Called with the size that was asked for, before anything of it is allocated.
    """
    most = usable()
    if not size <= most:
        need = si_prefix(float(size), "B")
        raise RefusedError(f"{what} would take {need} of memory, and {si_prefix(most, 'B')} may be taken: {remedy}")
