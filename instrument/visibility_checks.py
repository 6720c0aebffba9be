"""What visibilities must be: baselines of two stations, each once; weights, flags, lengths; the same coordinates."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from instrument.errors import InputError
from instrument.numbers import LARGEST
from instrument.units import Bool, Float, Int


def same_coordinates(one: Any, other: Any) -> bool:
    """Whether two sets of visibilities are of the same times, channels, stations, baselines and phase centre."""
    return (
        one.data.shape == other.data.shape
        and one.phase_centre == other.phase_centre
        and one.layout.names == other.layout.names
        and np.array_equal(one.layout.positions_m, other.layout.positions_m)
        and np.array_equal(one.antenna1, other.antenna1)
        and np.array_equal(one.antenna2, other.antenna2)
        and np.array_equal(one.at.slots_s, other.at.slots_s)
        and np.array_equal(one.freq_hz, other.freq_hz)
        and (_own(one) == _own(other) == (None, None) or np.array_equal(one.uvw_m, other.uvw_m))
    )


def _own(vis: Any) -> tuple[Any, Any]:
    """UVW of baselines and of stations that are not worked out."""
    return (None if vis.given_uvw_m is None else "given", None if vis.at.own_uvw_m is None else "own")


def as_kind(given: Any, kind: type) -> Any:
    """Numbers of any precision and byte order in double precision and the order of this machine; else as given."""
    if given is None or given.dtype == kind or given.dtype.kind not in "fiuc":
        return given
    return given if kind is int and given.dtype.kind == "f" else given.astype(kind)  # 1.5 is no number of a station


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
    """Raises `InputError` for shapes that are no part of (T, F, B) or (T, F, B, 2, 2), and for wrong weights."""
    for name, array in (("weight", weight), ("flag", flag)):
        if array.ndim not in (3, 5) or any(n not in (1, m) for n, m in zip(array.shape, want, strict=False)):
            raise InputError(
                f"{name} has shape {array.shape}, needed {want[:3]}, or {want} for each correlation, with length 1 "
                "where constant"
            )
    if flag.dtype.kind != "b":
        raise InputError(f"flag holds {flag.dtype}, needed bool")
    if weight.dtype.kind not in "fiu" or not np.all(np.isfinite(weight)) or np.any(weight < 0):
        raise InputError("weight must be finite and not negative: flag what does not count")
    beyond = weight[(weight > 0) & ((weight < 1 / LARGEST) | (weight > LARGEST))]
    if beyond.size:
        raise InputError(f"weight = {beyond[0]:g} is beyond what squares can hold: scale all of them")
