"""Towards: a chain evaluated in one direction, the term with which a beam is taken out of data at the phase centre.

`towards_in` finds it in whatever holds it.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any, ClassVar

import numpy as np

from instrument.checked import checked
from instrument.component import Component
from instrument.jones.base import Basis, JonesTerm
from instrument.jones.chain import Chain
from instrument.observe.sampling import Sampling
from instrument.units import Complex, SkyDirection


@checked
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


def towards_in(thing: Any) -> Iterator[Towards]:
    """Every beam at one direction that a term or chain holds: itself, its parts, or a field of a composite."""
    if isinstance(thing, Towards):
        yield thing
    elif isinstance(thing, Component):
        for name in type(thing).model_fields:
            yield from towards_in(getattr(thing, name))
    elif isinstance(thing, tuple | list):
        for item in thing:
            yield from towards_in(item)
    elif isinstance(thing, Mapping):
        yield from towards_in(tuple(thing.values()))
