"""Shown: representations of at most a few lines: names, shapes, ranges and units in the place of arrays."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import fields, is_dataclass
from typing import Any

import numpy as np

from instrument.numbers import brief

MOST = 380  # characters of a whole representation
RANGED = 1_000_000  # values up to which a range is worked out: 1 ms
UNITS = {"rad": "rad", "hz": "Hz", "m": "m", "s": "s", "jy": "Jy", "lambda": "wavelengths", "mpc": "Mpc"}


def short_repr(self: Any) -> str:
    """The fields of a dataclass, each by its name, with the unit that its name ends in; for `__repr__` of a class."""
    names = [field.name for field in fields(self) if field.repr]
    return represented(type(self).__name__, ((name, getattr(self, name), unit_of(name)) for name in names))


def represented(name: str, parts: Iterable[tuple[str, Any, str]]) -> str:
    """`Name(a=1 m, b=(59,) 0.4 to 100 Jy, ...)` of names, values and units; an empty name stands for a bare value."""
    out, room = [], MOST - len(name)
    for key, value, unit in parts:
        text = f"{key}={shown(value, unit)}" if key else shown(value, unit)
        room -= len(text) + 2
        if room < 0:
            out.append("...")
            break
        out.append(text)
    return f"{name}({', '.join(out)})"


def unit_of(name: str) -> str:
    """The unit that a name ends in: "freq_hz" is in Hz."""
    head, _, tail = name.rpartition("_")
    return UNITS.get(tail, "") if head else ""


def shown(value: Any, unit: str = "") -> str:
    """One value in at most about 70 characters."""
    end = f" {unit}" if unit else ""
    if isinstance(value, np.ndarray):
        return f"{_array(value)}{end}"
    if isinstance(value, bool | str | bytes) or value is None:
        return brief(value)
    if unit == "rad" and isinstance(value, float):
        return _angle(value)
    if isinstance(value, int | float | complex | np.number):
        return f"{value:.6g}{end}"
    if isinstance(value, dict):
        return f"{{{len(value)} keys}}" if len(value) > 2 else brief(value)
    if isinstance(value, tuple) and type(value).__str__ is not tuple.__str__:  # a Direction
        return str(value)
    if type(value).__module__.startswith("astropy.time"):
        return " ".join(str(value.utc.isot).split())[:60]
    if isinstance(value, tuple | list):
        some = ", ".join(shown(item, unit) for item in value[:3])
        return f"({some}, ... {len(value)} in all)" if len(value) > 3 else f"({some})"
    if is_dataclass(value) or hasattr(type(value), "model_fields"):
        text = repr(value)
        return text if len(text) <= 60 else f"{type(value).__name__}(...)"
    return brief(value)


def _angle(rad: float) -> str:
    """In the unit in which it is at least 1."""
    for unit, size in (("deg", 1.0), ("arcmin", 60.0), ("arcsec", 3600.0)):
        if abs(np.rad2deg(rad)) * size >= 0.999 or unit == "arcsec":
            break
    return f"{np.rad2deg(rad) * size:.6g} {unit}"


def _array(value: Any) -> str:
    if value.dtype.kind not in "biufc" or not value.size:
        return f"{value.shape} {value.dtype}"
    if value.size <= 3 and value.ndim == 1:
        return "[" + ", ".join(f"{v:.6g}" for v in value) + "]"
    if value.size > RANGED:
        return f"{value.shape} {value.dtype}"
    if value.dtype.kind == "b":
        return f"{value.shape} {100 * float(value.mean()):.3g} % true"
    size, of = (np.abs(value), " in size") if value.dtype.kind == "c" else (value, "")
    good = size[np.isfinite(size)]
    return f"{value.shape} {good.min():.4g} to {good.max():.4g}{of}" if good.size else f"{value.shape} without a number"
