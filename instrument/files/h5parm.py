"""Reads the soltabs of an h5parm, the HDF5 layout of the solutions of DP3 and LoSoTo, and says what is wrong with one.

A solset (a group, "sol000") holds tables `antenna` and `source`, and soltabs (groups, "amplitude000" and "phase000")
with `val`, `weight` (0: flagged) and an array for each axis; the attribute AXES of `val` gives their order. DP3 6.6.0
writes time,freq,ant,pol (gaincal) or time,freq,ant,dir,pol (ddecal); pol is XX,XY,YX,YY (full Jones), XX,YY (diagonal),
or left out (scalar). Any order is read. Along time or freq, where it is left out (a bandpass of prefactor or LINC is
ant,freq,pol), solutions are constant, as DP3 takes them.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from instrument import h5
from instrument.errors import FileError
from instrument.files_in import harmless
from instrument.h5 import one_line as one_line
from instrument.units import Float

POLS: dict[str, tuple[str, ...]] = {
    "full": ("XX", "XY", "YX", "YY"),
    "diagonal": ("XX", "YY"),
    "scalar": (),
    "phase": ("XX", "YY"),
}
AXES = ("time", "freq", "ant", "dir", "pol")
KINDS = ("amplitude", "phase")
ALIKE = {f"{prefix}{kind}": kind for prefix in ("scalar", "commonscalar") for kind in KINDS}
# tables from which gains follow: what they are a phase of, for the remedy of a refusal
DERIVED = {
    "clock": "a phase of 2 pi freq clock",
    "tec": "a phase of -8.4479745e9 tec / freq",
    "tec3rd": "a phase that falls as freq^-3",
    "rotation": "a rotation of the feeds",
    "rotationmeasure": "a rotation by RM (c / freq)^2",
}


@dataclass
class Soltab:
    """A table read: values (t, f, A, P), NaN where the weight is 0, and the axes that it has."""

    name: str
    kind: str
    values: Float
    along: dict[str, Any]


def read_soltabs(
    path: Any, solset: str | None, soltabs: Sequence[str] | None, direction: str | None
) -> tuple[str, list[Soltab]]:
    """File and solset in words, and the tables: an amplitude, a phase, or both; raises `FileError`."""
    with h5.opened(path, "h5parm") as store:
        chosen = _solset(store, solset)
        tables = [_soltab(group, direction) for group in _soltabs(chosen, soltabs)]
        return f"{h5.file_of(chosen)}, {chosen.name}", tables


def _groups(group: Any) -> dict[str, Any]:
    import h5py

    return {name: item for name, item in h5.members(group).items() if isinstance(item, h5py.Group)}


def _listing(names: Sequence[str]) -> str:
    return harmless(", ".join(names), 200) or "none"


def _solset(store: Any, name: str | None) -> Any:
    known = _groups(store)
    if name is None and len(known) == 1:
        return next(iter(known.values()))
    if name in known:
        return known[name]
    if not known:
        raise FileError(f"{h5.file_of(store)}: there is no solset in it (a group such as 'sol000')")
    what = "more than one solset; choose with solset=" if name is None else f"no solset '{name}'"
    raise FileError(f"{h5.file_of(store)}: {what} ({_listing(list(known))})")


def _soltabs(solset: Any, names: Sequence[str] | None) -> list[Any]:
    """One amplitude table, or one phase table, or one of each."""
    groups = _groups(solset)
    kinds = {name: _kind(group) for name, group in groups.items()}
    plain = [name if kind in KINDS or name.startswith(kind) else f"{name} ({kind})" for name, kind in kinds.items()]
    where = f"{h5.file_of(solset)}, {solset.name}"
    for name in names or ():
        if name not in groups:
            raise FileError(f"{where}: no soltab '{name}' (there are: {_listing(plain)})")
    chosen = list(groups if names is None else names)
    found = [kinds[name] for name in chosen]
    if not found or len(set(found)) < len(found) or not set(found) <= set(KINDS):
        derived = [f"; {kind} is {DERIVED[kind]}: make a phase soltab of it" for kind in found if kind in DERIVED]
        raise FileError(
            f"{where}: needs one soltab of amplitudes, one of phases, or both, but has {_listing(plain)}; "
            f"choose with soltabs=(...){derived[0] if derived else ''}"
        )
    return [groups[name] for name in chosen]


def _kind(soltab: Any) -> str:
    """What a table holds: its TITLE, or else its name without the number."""
    kind = h5.text(soltab.attrs.get("TITLE", "")) or soltab.name.rpartition("/")[2].rstrip("0123456789")
    return ALIKE.get(kind, kind)


def _soltab(group: Any, direction: str | None) -> Soltab:
    def fail(message: str) -> FileError:
        return FileError(f"{h5.file_of(group)}, {group.name}: {message}")

    val, weight = (h5.dataset(group, name) for name in ("val", "weight"))
    for name, found in (("val", val), ("weight", weight)):
        if "AXES" not in found.attrs:
            raise fail(f"'{name}' has no attribute AXES")
    axes = h5.text(val.attrs["AXES"]).split(",")
    if len(set(axes)) < len(axes) or "ant" not in axes or not set(axes) <= set(AXES):
        raise fail(
            f"axes {harmless(','.join(axes), 80)} of 'val'; time, freq and ant must be there by these names, dir and "
            "pol may; without time or freq the solutions are constant along it"
        )
    lacking = [axis for axis in axes if axis not in group]
    if lacking:
        raise fail(f"there is no array '{lacking[0]}', an axis of 'val'")
    # shapes are compared before anything is read: an axis may declare 1e9 entries in a file of 20 kB
    sets = {axis: h5.dataset(group, axis) for axis in axes}
    wanted = tuple(int(sets[axis].size) for axis in axes)
    if val.shape != wanted:
        raise fail(f"'val' has shape {val.shape}, its axes {','.join(axes)} need {wanted}")
    if weight.shape != wanted or h5.text(weight.attrs["AXES"]).split(",") != axes:
        other = harmless(h5.text(weight.attrs["AXES"]), 80)
        raise fail(f"'weight' has shape {weight.shape} along {other}, unlike 'val'")
    h5.demand_affordable([val, weight, *sets.values()])
    along: dict[str, Any] = {axis: h5.numbers(sets[axis]) for axis in AXES[:2] if axis in axes}
    along |= {axis: h5.names(sets[axis]) for axis in AXES[2:] if axis in axes}
    twice = sorted({name for name in along["ant"] if along["ant"].count(name) > 1})
    if twice:
        raise fail(f"station '{harmless(twice[0], 80)}' is there twice")
    along["pol"], order = _pols(along.get("pol"), fail)

    index: list[Any] = [slice(None)] * len(axes)
    chosen = _chosen(along, direction, fail)
    if "dir" in axes:
        index[axes.index("dir")] = chosen
    values, weights = (h5.numbers(found, tuple(index)) for found in (val, weight))
    axes = [axis for axis in axes if axis != "dir"]
    values, weights = (_ordered(array, axes)[..., order] for array in (values, weights))
    if np.any(weights < 0):
        raise fail("a weight is negative")
    values = np.where((weights > 0) & np.isfinite(values), values, np.nan)
    kind = _kind(group)
    if kind == "amplitude" and np.any(values < 0):
        raise fail(f"an amplitude is {np.nanmin(values):.6g}: negative ones belong into a phase of 180 deg")
    return Soltab(group.name, kind, values, along)


def _chosen(along: dict[str, Any], direction: str | None, fail: Any) -> int:
    directions = along.get("dir", [])
    found = [k for k, name in enumerate(directions) if direction in (None, name, name.strip("[]"))]
    if (direction is not None or "dir" in along) and len(found) != 1:
        asked = "choose one with direction=" if direction is None else f"'{direction}' is not one of them"
        raise fail(f"solutions of {len(directions)} directions ({harmless(', '.join(directions), 200)}); {asked}")
    return found[0] if found else 0


def _pols(pols: list[str] | None, fail: Any) -> tuple[list[str], list[int]]:
    """The polarizations in our order, and where each of them is in the file; one where there is no such axis."""
    for known in POLS.values():
        if sorted(pols or []) == sorted(known) and bool(known) == (pols is not None):
            return list(known), [(pols or []).index(p) for p in known] or [0]
    there = harmless(", ".join(pols or []), 80) or "nothing"
    raise fail(f"axis 'pol' holds {there}, which is neither XX, XY, YX, YY nor XX, YY")


def _ordered(array: Float, axes: list[str]) -> Float:
    """Values with axes time, freq, ant, pol, of length 1 where the file has none."""
    order = [axis for axis in AXES if axis != "dir"]
    full = [*axes, *(axis for axis in order if axis not in axes)]
    array = array.reshape(*array.shape, *[1] * (len(full) - len(axes)))
    return np.asarray(array.transpose([full.index(axis) for axis in order]))
