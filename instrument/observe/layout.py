"""Layout: where the stations are, which way their local axes point, and the baselines between them."""

from __future__ import annotations

from collections.abc import Sequence
from functools import cached_property
from typing import Annotated, Any, Self

import numpy as np
from pydantic import model_validator

from instrument.component import Component
from instrument.errors import InputError, did_you_mean
from instrument.units import ArrayOf, Float, Int, plain, to_si

Positions = Annotated[Any, ArrayOf(float, (None, 3))]
Axes = Annotated[Any, ArrayOf(float, (None, 3, 3))]


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
        if count < 2:
            raise InputError(
                f"an interferometer needs at least two stations, got {count}: {', '.join(self.names) or 'none'}"
            )
        if not (np.all(np.isfinite(self.positions_m)) and np.all(np.isfinite(self.axes))):
            raise InputError("positions and axes of stations must be finite")
        skew = np.abs(self.axes @ np.swapaxes(self.axes, 1, 2) - np.eye(3)).max()
        if skew > 1e-6:
            raise InputError(f"axes of stations are not orthonormal (off by {skew:.1e})")
        return self

    @classmethod
    def geodetic(cls, names: Sequence[str], positions_m: Float) -> Layout:
        """Layout whose axes are local east, north and up of the WGS84 ellipsoid."""
        positions_m = plain(positions_m, float, "positions_m")
        return cls(names=tuple(names), positions_m=positions_m, axes=geodetic_axes(positions_m))

    @classmethod
    def from_enu(cls, names: Sequence[str], enu: Any, longitude: Any, latitude: Any, height: Any) -> Layout:
        """Layout of stations east, north and up (A, 3) of a WGS84 reference point, all with its axes; with units."""
        import erfa

        place = (to_si(longitude, "rad", "longitude"), to_si(latitude, "rad", "latitude"), to_si(height, "m", "height"))
        reference = np.asarray(erfa.gd2gc(1, *place))
        axes = geodetic_axes(reference[None])
        enu_m = np.asarray(to_si(enu, "m", "enu"), float)
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
        return float(np.linalg.norm(self.positions_m[a] - self.positions_m[b], axis=1).max())


def geodetic_axes(positions_m: Float) -> Float:
    """Rows east, north, up of the WGS84 ellipsoid at ITRF positions (A, 3), as (A, 3, 3)."""
    import erfa

    lon, lat, _ = erfa.gc2gd(1, np.ascontiguousarray(positions_m))
    zero = np.zeros_like(lon)
    east = np.stack([-np.sin(lon), np.cos(lon), zero], -1)
    up = np.stack([np.cos(lat) * np.cos(lon), np.cos(lat) * np.sin(lon), np.sin(lat)], -1)
    return np.stack([east, np.cross(up, east), up], axis=1)
