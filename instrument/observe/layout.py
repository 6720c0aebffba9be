"""Layout: where the stations are, which way their local axes point, and the baselines between them."""

from __future__ import annotations

from collections.abc import Sequence
from functools import cached_property
from typing import Annotated, Any, Self

import numpy as np
from pydantic import model_validator

from instrument.checked import checked
from instrument.component import Component
from instrument.errors import InputError, did_you_mean
from instrument.units import ArrayOf, Float, Int, one_si, plain, to_si

Positions = Annotated[Any, ArrayOf(float, (None, 3))]
Axes = Annotated[Any, ArrayOf(float, (None, 3, 3))]

# The surface of the Earth lies 6.353e6 (the poles) to 6.385e6 m (Chimborazo) from its centre; with some room
GROUND_M = 6.34e6, 6.40e6
UPRIGHT_RAD = np.deg2rad(10.0)


@checked
class Layout(Component):
    """Stations: names (A,), ITRF positions in m (A, 3), and local axes (A, 3, 3).

    Rows of `axes` are the unit vectors p (about east), q (about north), r (up, the normal of the antenna plane) of a
    station, in ITRF: `d_pqr = axes @ d_itrf`. The antenna plane, not the geodetic horizon, is what beams see.
    """

    names: tuple[str, ...]
    positions_m: Positions
    axes: Axes

    @model_validator(mode="after")
    def _consistent(self) -> Self:
        count = len(self.names)
        if self.positions_m.shape[0] != count or self.axes.shape[0] != count:
            raise InputError(
                f"{count} names, {self.positions_m.shape[0]} positions and {self.axes.shape[0]} axes of stations"
            )
        twice = sorted({n for n in self.names if self.names.count(n) > 1})
        if twice:
            raise InputError(f"station '{twice[0]}' is given twice")
        if not count:
            raise InputError("a layout needs at least one station")
        if not (np.all(np.isfinite(self.positions_m)) and np.all(np.isfinite(self.axes))):
            raise InputError("positions and axes of stations must be finite")
        skew = np.abs(self.axes @ np.swapaxes(self.axes, 1, 2) - np.eye(3)).max()
        if skew > 1e-6:
            raise InputError(f"axes of stations are not orthonormal (off by {skew:.1e})")
        self._standing()
        return self

    def _standing(self) -> None:
        """Raise `InputError` for stations in the middle of the Earth, and for axes that no antenna plane has."""
        _demand_distance(self.names, self.positions_m, (1e6, np.inf))
        left = np.flatnonzero(np.linalg.det(self.axes) < 0)
        if left.size:
            raise InputError(
                f"the axes of station '{self.names[left[0]]}' are left-handed: rows are p (about east), q (about "
                "north), r (up), in this order"
            )
        up = geodetic_axes(self.positions_m)[:, 2]
        tilt = np.arccos(np.clip(np.einsum("ac,ac->a", self.axes[:, 2], up), -1, 1))
        # the plane of an array is that of its middle, from which its ends lean away as the Earth is round
        steep = np.flatnonzero(tilt > UPRIGHT_RAD + self.longest_m / GROUND_M[0])
        if steep.size:
            a = steep[0]
            raise InputError(
                f"the third axis of station '{self.names[a]}' is {np.rad2deg(tilt[a]):.3g} deg from the vertical: rows "
                "are p (about east), q (about north), r (up), in this order"
            )

    @classmethod
    def geodetic(cls, names: Sequence[str], positions_m: Float) -> Layout:
        """Layout whose axes are local east, north and up of the WGS84 ellipsoid; positions ITRF, m, on the ground."""
        positions_m = plain(positions_m, float, "positions_m", finite=True)
        if positions_m.ndim != 2 or positions_m.shape[1] != 3:
            raise InputError(f"positions_m has shape {positions_m.shape}, needed (any, 3)")
        _demand_distance(tuple(names), positions_m, GROUND_M)
        return cls(names=tuple(names), positions_m=positions_m, axes=geodetic_axes(positions_m))

    @classmethod
    def from_enu(cls, names: Sequence[str], enu: Any, longitude: Any, latitude: Any, height: Any) -> Layout:
        """Layout of stations east, north and up (A, 3) of a WGS84 reference point, all with its axes; with units."""
        import erfa

        place = tuple(
            one_si(x, unit, name)
            for x, unit, name in (
                (longitude, "rad", "longitude"),
                (latitude, "rad", "latitude"),
                (height, "m", "height"),
            )
        )
        if abs(place[1]) > np.pi / 2:
            raise InputError(f"latitude = {np.rad2deg(place[1]):g} deg must lie between -90 and 90 deg")
        if not -12e3 < place[2] < 30e3:
            raise InputError(f"height = {place[2]:g} m is not on the Earth: that of the site above the WGS84 ellipsoid")
        reference = np.asarray(erfa.gd2gc(1, *place))
        axes = geodetic_axes(reference[None])
        enu_m = np.asarray(to_si(enu, "m", "enu"), float)
        if enu_m.ndim != 2 or enu_m.shape[1] != 3:
            raise InputError(f"enu has shape {enu_m.shape}, needed (any, 3)")
        return cls(
            names=tuple(names), positions_m=reference + enu_m @ axes[0], axes=np.repeat(axes, len(enu_m), axis=0)
        )

    def __len__(self) -> int:
        return len(self.names)

    def index(self, name: str) -> int:
        """Number of the station called `name`."""
        if name not in self.names:
            raise InputError(f"no station '{name}': {did_you_mean(name, self.names)}")
        return self.names.index(name)

    def select(self, names: Sequence[str]) -> Layout:
        """The stations `names`, in that order."""
        rows = [self.index(n) for n in names]
        return Layout(names=tuple(names), positions_m=self.positions_m[rows], axes=self.axes[rows])

    @cached_property
    def baselines(self) -> tuple[Int, Int]:
        """First and second station of every baseline, (B,) each; a < b, no autocorrelations."""
        a, b = np.triu_indices(len(self.names), 1)
        a.setflags(write=False)
        b.setflags(write=False)
        return a, b

    @cached_property
    def centre_m(self) -> Float:
        """Mean position, ITRF m (3,); the site for which aberration is computed."""
        mean: Float = self.positions_m.mean(axis=0)
        mean.setflags(write=False)
        return mean

    @cached_property
    def frames(self) -> tuple[Int, Int]:
        """First station of every distinct set of axes (G,), and the number of its set for each station (A,)."""
        _, first, which = np.unique(self.axes.reshape(-1, 9), axis=0, return_index=True, return_inverse=True)
        order = np.argsort(first)
        rank = np.empty_like(order)
        rank[order] = np.arange(len(order))
        return first[order], rank[which.reshape(-1)]

    @cached_property
    def longest_m(self) -> float:
        """Longest baseline, m."""
        a, b = self.baselines
        return float(np.linalg.norm(self.positions_m[a] - self.positions_m[b], axis=1).max(initial=0.0))

    @cached_property
    def one_per_frame(self) -> Layout:
        """The first station of every distinct set of axes, the array itself where all differ."""
        first, _ = self.frames
        if len(first) == len(self):
            return self
        rows = [self.positions_m[first], self.axes[first]]
        for row in rows:
            row.setflags(write=False)
        names = tuple(self.names[k] for k in first)
        # they have been looked at: a part of an array wider than 1000 km need not stand upright by itself
        return Layout.model_construct(names=names, positions_m=rows[0], axes=rows[1])


def _demand_distance(names: Sequence[str], positions_m: Float, limits: tuple[float, float]) -> None:
    """Raise `InputError` for a station that is not at these distances from the centre of the Earth, m."""
    far = np.linalg.norm(positions_m, axis=1)
    wrong = np.flatnonzero((far < limits[0]) | (far > limits[1]))
    if wrong.size:
        k = int(wrong[0])
        name = names[k] if k < len(names) else k
        raise InputError(
            f"station '{name}' is {far[k]:.7g} m from the centre of the Earth, whose surface is {GROUND_M[0]:g} to "
            f"{GROUND_M[1]:g} m from it: positions are ITRF in m; for offsets about a site use Layout.from_enu"
        )


def geodetic_axes(positions_m: Float) -> Float:
    """Rows east, north, up of the WGS84 ellipsoid at ITRF positions (A, 3), as (A, 3, 3)."""
    import erfa

    lon, lat, _ = erfa.gc2gd(1, np.ascontiguousarray(positions_m))
    zero = np.zeros_like(lon)
    east = np.stack([-np.sin(lon), np.cos(lon), zero], -1)
    up = np.stack([np.cos(lat) * np.cos(lon), np.cos(lat) * np.sin(lon), np.sin(lat)], -1)
    return np.stack([east, np.cross(up, east), up], axis=1)
