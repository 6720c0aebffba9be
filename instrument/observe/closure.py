"""Closure: coordinates of stations from those of their baselines, where these close around triangles."""

from __future__ import annotations

import numpy as np

from instrument.errors import InputError
from instrument.observe.directions import LIGHT
from instrument.units import Bool, Float, Int

CLOSURE_M = 1e-6  # 3e-6 rad of phase at 150 MHz


def stations_of(uvw_m: Float, antenna1: Int, antenna2: Int, count: int) -> Float:
    """Stations (T, A, 3), m, whose differences, first minus second, are the baselines `uvw_m` (T, B, 3).

    Raises `InputError` where no stations have these: baselines averaged over times of their own do not close.
    """
    graph, right = np.zeros((count, count)), np.zeros((count, len(uvw_m), 3))
    for one, sign in ((antenna1, 1.0), (antenna2, -1.0)):
        np.add.at(graph, (one, one), 1.0)
        np.add.at(right, one, sign * uvw_m.transpose(1, 0, 2))
    graph[antenna1, antenna2] = graph[antenna2, antenna1] = -1.0
    found = np.linalg.lstsq(graph, right.reshape(count, -1), rcond=None)[0].reshape(right.shape).transpose(1, 0, 2)
    apart = float(np.abs(found[:, antenna1] - found[:, antenna2] - uvw_m).max(initial=0.0))
    if apart > CLOSURE_M:
        raise InputError(
            f"the given UVW do not close around triangles of stations (by {apart:.2g} m): what works station by "
            "station needs baselines of the same times"
        )
    return np.asarray(found)


def stations_seen(uvw_m: Float, seen: Bool, antenna1: Int, antenna2: Int, ours_m: Float) -> tuple[Float, float]:
    """Stations (T, A, 3), m, of baselines (T, B, 3) of which some were not seen (T, B); by how much these do not close.

    What no baseline tells, where a group of stations stands as a whole, is nearest to `ours_m` (T, A, 3).
    """
    count, one, two = ours_m.shape[1], antenna1, antenna2
    found, most = ours_m.copy(), 0.0
    kinds, of = np.unique(seen, axis=0, return_inverse=True)
    for k, there in enumerate(kinds):
        times = np.flatnonzero(of.ravel() == k)
        a, b = one[there], two[there]
        matrix = np.zeros((len(a), count))
        matrix[np.arange(len(a)), a], matrix[np.arange(len(a)), b] = 1.0, -1.0
        rest = uvw_m[times][:, there] - (ours_m[times][:, a] - ours_m[times][:, b])
        right = matrix.T @ rest.transpose(1, 0, 2).reshape(len(a), -1)
        moved = np.linalg.pinv(matrix.T @ matrix, hermitian=True) @ right
        found[times] += moved.reshape(count, len(times), 3).transpose(1, 0, 2)
        apart = np.abs(found[times][:, a] - found[times][:, b] - uvw_m[times][:, there])
        most = max(most, float(apart.max(initial=0.0)))
    return found, most


def rounding_m(uvw_m: Float) -> float:
    """By how much baselines (..., 3) in m may fail to close: more where all of them, or their delays, are singles."""
    for values in (uvw_m, uvw_m / LIGHT):  # metres, or seconds as in UVFITS
        if np.all(np.abs(values.astype(np.float32) - values) <= 4 * np.finfo(float).eps * np.abs(values)):
            return max(CLOSURE_M, 4 * float(np.finfo(np.float32).eps) * float(np.abs(uvw_m).max(initial=0.0)))
    return CLOSURE_M
