"""What of a cube is no data although it is a number: channels and voxels that hold one value, such as 0 or -999."""

from __future__ import annotations

from typing import Any

import numpy as np

from instrument.errors import unused
from instrument.units import Bool

GROUPS = ((0,), (1, 2), (3,))  # I; Q and U, which are made together; V
NONE = None
FILLED = 0.1  # of the voxels: with fewer that are not 0 a cube is a few sources on nothing, and 0 is a value


def without_constants(data: Any, source: str = "the cube", copy: bool = True) -> Any:
    """The data (F, 4, Ny, Nx) with NaN for what holds no data, said in one warning; the same array where all does.

    WSClean and CASA write 0 in channels that were flagged, mosaics 0 (or -999) around their rim. In a Stokes parameter
    that varies, no data are: a channel of one value; a voxel of the padding value (0, or what two corners hold in all
    channels) in a hole of 2 x 2 pixels or more, or in a quarter of the channels, in Q and U where both have it. Where
    not one voxel in ten is anything else, 0 is a value, but on lines of sight with data in half of the channels. A
    parameter that is constant in every channel stays as it is, and so do a single channel and a single pixel. In place
    without `copy`, of float arrays.
    """
    if len(data) < 2 or data[0, 0].size < 2 or data.dtype.kind not in "fiu":
        return data
    out, said = data, []
    for group in GROUPS:
        constant = {k: np.array([_constant(plane) for plane in data[:, k]]) for k in group}
        alive = [k for k in group if not constant[k].all()]
        if not alive:
            continue
        padding = {k: _padding(data[:, k], constant[k]) for k in alive}
        for k in alive:
            odd = np.array(
                [one and _first(p) not in (padding[k], NONE) for one, p in zip(constant[k], data[:, k], strict=True)]
            )
            if odd.any():  # one value that is not the padding: no image has it
                out = _blank(out, data, [k], np.broadcast_to(odd[:, None, None], data[:, k].shape), copy)
                said.append(_channels(odd, [k]))
        found = _voxels(data, alive, padding, constant)
        if found is not None:
            out = _blank(out, data, alive, found, copy)
            said += _told(found, alive)
    unused(source, said, "one value: no data; StokesCube(..., constants='data') keeps it")
    return out


def _first(plane: Any) -> Any:
    """The first pixel that is a number, `NONE` where none is."""
    if plane[0, 0] == plane[0, 0]:
        return plane[0, 0]
    good = plane[~np.isnan(plane)]
    return good[0] if good.size else NONE


def _constant(plane: Any) -> bool:
    """Whether all pixels with data have one value, or none has any."""
    # a few pixels tell most planes apart: 2 us instead of 0.1 ms
    some = plane.ravel()[:: max(1, plane.size // 16)] if plane.flags.c_contiguous else plane[::4, ::4].ravel()
    some = some[some == some]
    if some.size > 1 and (some != some[0]).any():
        return False
    if (value := _first(plane)) is NONE:
        return True
    return bool(((plane == value) | (plane != plane)).all())


def _padding(planes: Any, constant: Bool) -> Any:
    """The value of voxels without data: 0, or what two corners or more hold in every channel that varies."""
    corners = planes[:, [0, 0, -1, -1], [0, -1, 0, -1]][~constant]
    same = (corners == corners[:1]).all(axis=0)
    values, counts = np.unique(corners[0][same], return_counts=True) if same.any() else (np.zeros(0), np.zeros(0))
    return values[np.argmax(counts)] if counts.size and counts.max() > 1 else planes.dtype.type(0)


def _voxels(data: Any, alive: list[int], padding: dict[int, Any], constant: dict[int, Bool]) -> Bool | None:
    """Voxels without data (F, Ny, Nx), or None where there are none."""
    empty = None
    for f, plane in enumerate(data):
        first = plane[alive[0]]
        if padding[alive[0]] == 0 and np.count_nonzero(first) == first.size:
            continue  # most planes
        same = first == padding[alive[0]]
        for k in alive[1:]:
            same &= plane[k] == padding[k]
        if same.any():
            empty = np.zeros((len(data), *data.shape[2:]), bool) if empty is None else empty
            empty[f] = same
    if empty is None:
        return None
    varies = ~np.logical_and.reduce([constant[k] for k in alive])
    share = 1 - empty.mean(), 1 - empty[varies].mean()
    seen = (~empty).sum(axis=0)
    if share[0] > FILLED or (share[1] > 0.5 and varies.sum() > 1):
        # waves cross 0 along lines of one pixel: a hole is wider, or has data in other channels
        often = (seen > 0) & (4 * seen <= 3 * len(data))
        for f in np.flatnonzero(varies).tolist():
            empty[f] &= _wide(empty[f]) | often
    else:
        empty &= 2 * seen >= len(data)
    return empty if empty.any() else None


def _wide(where: Bool) -> Bool:
    """Pixels that lie in a block of 2 x 2 of them (Ny, Nx)."""
    block = where[1:, 1:] & where[1:, :-1] & where[:-1, 1:] & where[:-1, :-1]
    out = np.zeros_like(where)
    for rows in (slice(1, None), slice(None, -1)):
        for columns in (slice(1, None), slice(None, -1)):
            out[rows, columns] |= block
    return out


def _blank(out: Any, data: Any, planes: list[int], where: Bool, copy: bool) -> Any:
    if out is data and (copy or data.dtype.kind != "f"):
        out = np.array(data, np.result_type(data, np.float32))
    for k in planes:
        out[:, k][where] = np.nan
    return out


def _told(where: Bool, planes: list[int]) -> list[str]:
    """What is left out in words: channels that are empty throughout, and the share of the voxels elsewhere."""
    whole = where.all(axis=(1, 2))
    rest = float(where[~whole].mean()) if not whole.all() else 0.0
    said = [_channels(whole, planes)] if whole.any() else []
    names = ", ".join("IQUV"[k] for k in planes)
    return said + ([f"{100 * rest:.2g} % of the {'other ' if said else ''}voxels of {names}"] if rest else [])


def _channels(which: Any, planes: list[int]) -> str:
    index = np.flatnonzero(which).tolist()
    more = f" and {len(index) - 4} more" if len(index) > 4 else ""
    names = ", ".join("IQUV"[k] for k in planes)
    return f"channel{'s' if len(index) > 1 else ''} {', '.join(map(str, index[:4]))}{more} of {names}"
