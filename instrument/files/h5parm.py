"""Reads the soltabs of an h5parm, the HDF5 layout of the solutions of DP3 and LoSoTo, and says what is wrong with one.

A solset (a group, "sol000") holds tables `antenna` and `source`, and soltabs (groups, "amplitude000" and "phase000")
with `val`, `weight` (0: flagged) and an array for each axis; the attribute AXES of `val` gives their order. DP3 6.6.0
writes time,freq,ant,pol (gaincal) or time,freq,ant,dir,pol (ddecal); pol is XX,XY,YX,YY (full Jones), XX,YY (diagonal),
or left out (scalar). Any order is read.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from instrument.errors import FileError
from instrument.units import Float

POLS: dict[str, tuple[str, ...]] = {
    "full": ("XX", "XY", "YX", "YY"),
    "diagonal": ("XX", "YY"),
    "scalar": (),
    "phase": ("XX", "YY"),
}
AXES = ("time", "freq", "ant", "dir", "pol")
KINDS = ("amplitude", "phase")


@dataclass
class Soltab:
    """A table read: values (t, f, A, P), NaN where the weight is 0, and its axes."""

    name: str
    kind: str
    values: Float
    along: dict[str, Any]


def read_soltabs(
    path: Any, solset: str | None, soltabs: Sequence[str] | None, direction: str | None
) -> tuple[str, list[Soltab]]:
    """File and solset in words, and the tables: an amplitude, a phase, or both; raises `FileError`."""
    import h5py

    file = Path(path)
    try:
        with h5py.File(file, "r") as store:
            chosen = _solset(file, store, solset)
            tables = [_soltab(file, chosen[name], direction) for name in _soltabs(file, chosen, soltabs)]
            return f"{file.name}, {chosen.name}", tables
    except FileError:
        raise
    except FileNotFoundError:
        raise FileError(f"{path} does not exist") from None
    except (OSError, RuntimeError, KeyError, ValueError, TypeError) as error:  # what h5py makes of broken content
        raise FileError(f"{file.name} is not a readable h5parm: {one_line(error)}") from None


def _solset(file: Path, store: Any, name: str | None) -> Any:
    import h5py

    known = [key for key in store if isinstance(store[key], h5py.Group)]
    if name is None and len(known) == 1:
        return store[known[0]]
    if name in known:
        return store[name]
    if not known:
        raise FileError(f"{file.name}: there is no solset in it (a group such as 'sol000')")
    what = "more than one solset; choose with solset=" if name is None else f"no solset '{name}'"
    raise FileError(f"{file.name}: {what} ({', '.join(known)})")


def _soltabs(file: Path, solset: Any, names: Sequence[str] | None) -> list[str]:
    """Names of one amplitude table, or one phase table, or one of each."""
    import h5py

    known = {key: _kind(item) for key, item in solset.items() if isinstance(item, h5py.Group)}
    listing = ", ".join(known) or "none"
    for name in names or ():
        if name not in known:
            raise FileError(f"{file.name}, {solset.name}: no soltab '{name}' (there are: {listing})")
    chosen = list(known if names is None else names)
    kinds = [known[name] for name in chosen]
    if not kinds or len(set(kinds)) < len(kinds) or not set(kinds) <= set(KINDS):
        raise FileError(
            f"{file.name}, {solset.name}: needs one soltab of amplitudes, one of phases, or both, but has {listing}; "
            "choose with soltabs=(...)"
        )
    return chosen


def _kind(soltab: Any) -> str:
    """What a table holds: its TITLE, or else its name without the number."""
    return _text(soltab.attrs.get("TITLE", "")) or soltab.name.rpartition("/")[2].rstrip("0123456789")


def _soltab(file: Path, group: Any, direction: str | None) -> Soltab:
    def fail(message: str) -> FileError:
        return FileError(f"{file.name}, {group.name}: {message}")

    for name in ("val", "weight"):
        if name not in group:
            raise fail(f"there is no '{name}'")
        if "AXES" not in group[name].attrs:
            raise fail(f"'{name}' has no attribute AXES")
    val, weight = group["val"], group["weight"]
    axes = _text(val.attrs["AXES"]).split(",")
    if len(set(axes)) < len(axes) or not set(AXES[:3]) <= set(axes) <= set(AXES):
        raise fail(f"axes {','.join(axes)} of 'val'; time, freq and ant must be there, dir and pol may")
    lacking = [axis for axis in axes if axis not in group]
    if lacking:
        raise fail(f"there is no array '{lacking[0]}', an axis of 'val'")
    along = {axis: group[axis][()] for axis in axes}
    along |= {axis: [_text(x) for x in along[axis]] for axis in AXES[2:] if axis in along}
    wanted = tuple(len(along[axis]) for axis in axes)
    if val.shape != wanted:
        raise fail(f"'val' has shape {val.shape}, its axes {','.join(axes)} need {wanted}")
    if weight.shape != wanted or _text(weight.attrs["AXES"]).split(",") != axes:
        raise fail(f"'weight' has shape {weight.shape} along {_text(weight.attrs['AXES'])}, unlike 'val'")
    twice = sorted({name for name in along["ant"] if along["ant"].count(name) > 1})
    if twice:
        raise fail(f"station '{twice[0]}' is there twice")

    values = np.where(np.asarray(weight[()], float) > 0, np.asarray(val[()], float), np.nan)
    values = np.where(np.isfinite(values), values, np.nan)
    for axis in AXES[3:]:
        if axis not in axes:
            values = values[..., None]
    order = [*axes, *(axis for axis in AXES[3:] if axis not in axes)]
    values = values.transpose([order.index(axis) for axis in AXES])

    directions = along.get("dir", [])
    found = [k for k, name in enumerate(directions) if direction in (None, name, name.strip("[]"))]
    if (direction is not None or "dir" in along) and len(found) != 1:
        asked = "choose one with direction=" if direction is None else f"'{direction}' is not one of them"
        raise fail(f"solutions of {len(directions)} directions ({', '.join(directions)}); {asked}")
    values = values[:, :, :, found[0] if found else 0]

    pols = along.get("pol", [])
    for known in POLS.values():
        if sorted(pols) == sorted(known) and bool(known) == ("pol" in along):
            return Soltab(group.name, _kind(group), values[..., [pols.index(p) for p in known] or [0]], along)
    raise fail(f"axis 'pol' holds {', '.join(pols) or 'nothing'}, which is neither XX, XY, YX, YY nor XX, YY")


def _text(value: Any) -> str:
    value = np.asarray(value).ravel()[0] if np.size(value) else ""
    return value.decode() if isinstance(value, bytes) else str(value)


def one_line(error: Exception) -> str:
    """First line of what an error says."""
    return (str(error) or type(error).__name__).splitlines()[0]
