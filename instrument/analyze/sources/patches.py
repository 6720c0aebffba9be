"""Groups of sources that are measured as one: which source is in which, and its share in it."""

from __future__ import annotations

from typing import Any

import numpy as np

from instrument.sky.points import PointSky
from instrument.units import Float, Int

CANCELS = 1e-6  # |sum I| over sum |I| of a patch below which its parts cancel


def groups(sky: PointSky) -> tuple[Int, Int, tuple[str, ...]]:
    """First source of each group (G,), group of each source (S,), names of the groups; a patch is a group."""
    patches = sky.patches or ("",) * len(sky)
    keys = [f"patch {patch}" if patch else f"source {i}" for i, patch in enumerate(patches)]
    order = {key: k for k, key in enumerate(dict.fromkeys(keys))}
    group = np.array([order[key] for key in keys], int)
    first = np.unique(group, return_index=True)[1]
    return first, group, tuple(patches[i] or sky.names[i] for i in first)


def gathered(values: Any, group: Int, count: int) -> Any:
    """Sum of rows (S, ...) over the sources of each group, (G, ...)."""
    if count == len(group):
        return values
    out = np.zeros((count, *values.shape[1:]), values.dtype)
    np.add.at(out, group, values)
    return out


def gathered_square(matrix: Float, group: Int, first: Int, mix: Float) -> Float:
    """Sum of mix_j M_ji mix_i over the sources i, j of groups, (G, G), of M (S, S), which is overwritten."""
    rest = np.setdiff1d(np.arange(len(group)), first)
    matrix *= mix[:, None]
    for i in rest:  # into the first of its group: no copies, 4571 sources are 167 MB
        matrix[first[group[i]]] += matrix[i]
    matrix *= mix
    for i in rest:
        matrix[:, first[group[i]]] += matrix[:, i]
    return np.asarray(matrix.T[np.ix_(first, first)])


def mixture(flux: Float, group: Int, count: int) -> Float:
    """Share of each source in its group, (S,): of the sum of I, of that of |I| where it cancels, or equal parts."""
    size = np.bincount(group, np.abs(flux), count)
    total = np.bincount(group, flux, count)
    signed = (np.abs(total) > CANCELS * size)[group]
    part = np.where((size > 0)[group], np.where(signed, flux, np.abs(flux)), 1.0)
    return part / np.bincount(group, part, count)[group]
