"""What visibilities must be: baselines of two stations, each once; weights, flags, lengths of time and channel."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from instrument.errors import InputError
from instrument.numbers import LARGEST
from instrument.units import Bool, Float, Int


def positive_along(given: Float | float, count: int, name: str) -> Float:
    """A number above 0, or one for each of `count` integrations or channels, as an array of length 1 or `count`."""
    values = np.array(np.atleast_1d(given), float)
    if values.ndim != 1 or len(values) not in (1, count):
        raise InputError(f"{name} has shape {values.shape}, needed one number or {(count,)}")
    wrong = ~(np.isfinite(values) & (values > 0))
    if wrong.any():
        raise InputError(f"{name} = {values[wrong][0]:g} must be a finite number above 0")
    values.setflags(write=False)
    return values


def check_baselines(first: Int, second: Int, names: Sequence[str]) -> None:
    """Raises `InputError` for numbers of no station, a station with itself, and a baseline that is there twice."""
    for name, stations in (("antenna1", first), ("antenna2", second)):
        if stations.dtype.kind not in "iu" or np.any((stations < 0) | (stations >= len(names))):
            raise InputError(f"{name} must hold numbers of stations, 0 to {len(names) - 1}")
    if first.shape != second.shape:
        raise InputError(f"antenna1 has {len(first)} baselines, antenna2 {len(second)}")
    if (alone := np.flatnonzero(first == second)).size:
        raise InputError(f"baseline {alone[0]} is of station '{names[first[alone[0]]]}' with itself: leave it out")
    pairs, count = np.unique(np.minimum(first, second) * len(names) + np.maximum(first, second), return_counts=True)
    if len(pairs) < len(first):
        a, b = divmod(int(pairs[count.argmax()]), len(names))
        raise InputError(f"baseline {names[a]}-{names[b]} is there twice: leave one out")


def check_weights(weight: Float, flag: Bool, want: tuple[int, ...]) -> None:
    """Raises `InputError` for shapes other than (T, F, B), length 1 where constant, and for wrong weights."""
    for name, array in (("weight", weight), ("flag", flag)):
        if array.ndim != 3 or any(n not in (1, m) for n, m in zip(array.shape, want, strict=True)):
            raise InputError(f"{name} has shape {array.shape}, needed {want} with length 1 where constant")
    if flag.dtype.kind != "b":
        raise InputError(f"flag holds {flag.dtype}, needed bool")
    if weight.dtype.kind not in "fiu" or not np.all(np.isfinite(weight)) or np.any(weight < 0):
        raise InputError("weight must be finite and not negative: flag what does not count")
    beyond = weight[(weight > 0) & ((weight < 1 / LARGEST) | (weight > LARGEST))]
    if beyond.size:
        raise InputError(f"weight = {beyond[0]:g} is beyond what squares can hold: scale all of them")
