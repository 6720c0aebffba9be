"""Machine: how fast this one is beside that on which costs were measured; found in half a second, once, and kept."""

from __future__ import annotations

import contextlib
import json
import os
import platform
import time
from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

from instrument.errors import InstrumentError
from instrument.whole_file import whole_file

TRIES = 15  # the best counts: other work on the machine makes all but a few slow
SIZE = 250_000
# processor seconds of each task on the machine of all costs: one core of an AMD EPYC of 2024, two of them at work
REFERENCE = {"functions": 0.0060, "memory": 0.0011, "python": 0.0130}


@cache
def speed() -> float:
    """How many times as fast as the machine on which the costs of stages were measured, one core beside one core."""
    path, key = kept_in(), _key()
    with contextlib.suppress(OSError, ValueError, KeyError, TypeError):
        if not path.is_file():  # a pipe would be waited for
            raise OSError
        with path.open("rb") as file:
            found = json.loads(file.read(10_000))
        if found["of"] == key and 1e-3 < float(found["speed"]) < 1e3:
            return float(found["speed"])
    return measured_and_kept()


def measured_and_kept() -> float:
    """The speed, measured now and kept for later; `instrument doctor` does it on a machine that has changed."""
    path, key = kept_in(), _key()
    value = measured()
    # a place to keep it only saves time
    with contextlib.suppress(OSError, InstrumentError):
        path.parent.mkdir(parents=True, exist_ok=True)
        with whole_file(path, overwrite=True) as partial:
            partial.write_text(json.dumps({"of": key, "speed": value}), encoding="utf-8")
    return value


def kept_in() -> Path:
    """The file that keeps it: in XDG_CACHE_HOME or ~/.cache."""
    home = os.environ.get("XDG_CACHE_HOME") or os.path.join(os.path.expanduser("~"), ".cache")
    return Path(home) / "instrument" / "machine.json"


def measured() -> float:
    """The speed, measured now: the geometric mean of how many times as fast each task is done."""
    took = {name: min(_seconds(task) for _ in range(TRIES)) for name, task in _tasks().items()}
    return float(np.exp(np.mean([np.log(REFERENCE[name] / max(spent, 1e-9)) for name, spent in took.items()])))


def _tasks() -> dict[str, Callable[[], Any]]:
    phase = np.linspace(0, 50, SIZE) * 1j
    many = np.ones(4 * SIZE)
    return {
        "functions": lambda: np.exp(phase),
        "memory": lambda: many * 1.5 + many,
        "python": lambda: sum(k * 2 for k in range(SIZE)),
    }


def _seconds(task: Callable[[], Any]) -> float:
    # of this thread: what else the machine does counts little
    begin = time.thread_time()
    task()
    return time.thread_time() - begin


def _key() -> list[Any]:
    return [platform.node(), platform.machine(), os.cpu_count(), platform.python_version(), np.__version__]
