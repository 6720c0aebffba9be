"""Towards: a chain evaluated in one direction, the term with which a beam is taken out of data at the phase centre."""

from __future__ import annotations

from typing import ClassVar

import numpy as np

from instrument.jones.base import Basis, JonesTerm
from instrument.jones.chain import Chain
from instrument.observe.sampling import Sampling
from instrument.units import Complex, SkyDirection


class Towards(JonesTerm):
    """Jones matrices of `chain` towards one direction (the phase centre by default), (T, F, A, 1, 2, 2)."""

    maps: ClassVar[tuple[Basis, Basis]] = ("sky", "feed")
    directional: ClassVar[bool] = False
    chain: Chain
    direction: SkyDirection | None = None

    def jones(self, at: Sampling) -> Complex:
        """J(direction) of every station, (T, F, A, 1, 2, 2)."""
        d = self.direction or at.centre
        return self.chain.jones(at.towards(np.array([d.ra_rad]), np.array([d.dec_rad])))
