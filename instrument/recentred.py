"""Visibilities about another phase centre: phases and u, v, w turned, while beams point where they did."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np

from instrument.observe.directions import LIGHT, tangents
from instrument.units import Direction, Float

SAME_M = 1e-8  # UVW as near as this to those of the coordinates are those; rounding of stations 1000 km apart


def recentred(vis: Any, centre: Direction) -> dict[str, Any]:
    """What of visibilities (T, F, B, 2, 2) changes with the phase centre: V exp(2 pi i (u l + v m + w (n-1))).

    l, m, n are those of the new centre about the old one. u, v, w are those of the old centre in the axes of the new
    one, so that K of every source is exact; the axes of a new observation differ by their aberration (1e-4 of the
    shift, see `EarthFrame.uvw_axes`), so they are given ones (`given_uvw_m`), until the way back.
    """
    old = vis.phase_centre
    if centre == old:
        return {}
    baseline = vis.uvw_m @ _axes(old)
    # not u l + v m + w (n-1): direction cosines round to 1e-16 each way, and 1e5 wavelengths come back off by 1e-10
    cycles = (baseline @ (centre.vector - old.vector))[:, None] * (vis.freq_hz / LIGHT)[:, None]
    turn = np.exp(2j * np.pi * (cycles - np.rint(cycles)))
    uvw = baseline @ _axes(centre).T
    pointing = vis.at.pointing
    at = replace(vis.at, centre=centre, steered=None if pointing == centre else pointing)
    if at.own_uvw_m is not None:
        at = replace(at, own_uvw_m=at.own_uvw_m @ _axes(old) @ _axes(centre).T)
    stations = at.uvw_m
    own = stations[:, vis.antenna1] - stations[:, vis.antenna2]
    given = None if np.abs(uvw - own).max(initial=0.0) < SAME_M else uvw
    return {"data": vis.data * turn[..., None, None], "at": at, "given_uvw_m": given}


def _axes(centre: Direction) -> Float:
    """ICRS unit vectors of u, v, w (3, 3), rows, without aberration."""
    east, north = tangents(np.array([centre.ra_rad]), np.array([centre.dec_rad]))
    return np.concatenate([east, north, centre.vector[None]])
