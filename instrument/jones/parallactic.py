"""Parallactic: from north and east at each source to e_theta and e_phi of each station."""

from __future__ import annotations

from typing import ClassVar

import numpy as np

from instrument import mat2
from instrument.checked import checked
from instrument.jones.base import Basis, JonesTerm, PerStation
from instrument.observe.sampling import Sampling
from instrument.units import Complex


@checked
class Parallactic(JonesTerm):
    """Sky to horizon basis, [[theta.north, theta.east], [phi.north, phi.east]], (T, 1, A, S, 2, 2).

    It holds the parallactic angle and the change of handedness between (north, east) and (theta, phi): its determinant
    is -1. At the zenith of a station e_theta is p.
    """

    maps: ClassVar[tuple[Basis, Basis]] = ("sky", "horizon")
    per_station: ClassVar[PerStation] = "frame"

    def peak(self, at: Sampling) -> float:
        """1: it is a rotation and a change of handedness."""
        return 1.0

    def jones(self, at: Sampling) -> Complex:
        """The rotation, (T, 1, A, S, 2, 2)."""
        d, east = at.itrf, at.east_itrf
        north = np.cross(d, east)
        p, q = at.layout.axes[:, 0], at.layout.axes[:, 1]
        cos, sin = at.azimuth_cos_sin
        # e_phi lies in the antenna plane, so it needs the azimuth only: exact at the zenith too
        along_p = np.stack([north @ p.T, east @ p.T], axis=-1)
        along_q = np.stack([north @ q.T, east @ q.T], axis=-1)
        phi = -sin[..., None] * np.swapaxes(along_p, 1, 2) + cos[..., None] * np.swapaxes(along_q, 1, 2)
        phi_north, phi_east = phi[..., 0], phi[..., 1]
        # e_theta = e_phi x d; north x d = east and east x d = -north
        return mat2.pack(-phi_east, phi_north, phi_north, phi_east)[:, None]
