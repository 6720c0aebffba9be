"""Array: stations at places that are given, or those of the data, with one element beam or none."""

from __future__ import annotations

from typing import Annotated, Self

from pydantic import model_validator

from instrument.errors import InputError
from instrument.jones.base import ElementBeam
from instrument.jones.chain import Chain
from instrument.jones.parallactic import Parallactic
from instrument.model import Instrument
from instrument.observe.layout import Layout
from instrument.units import ArrayOf, Float

PLACES = ((-1601185.4, -5041977.5, 3554875.9), (-1601155.6, -5042007.5, 3554860.7))  # two antennas of the VLA


class Array(Instrument):
    """Stations `stations` at `positions_m`, ITRF, m (A, 3), their axes local east, north and up.

    In a scene with [data] both are those of the data. `element` is the beam of all of them, none where it is left out.
    """

    stations: tuple[str, ...] = ("A", "B")
    positions_m: Annotated[Float, ArrayOf(float, (None, 3))] = PLACES  # type: ignore[assignment]
    element: ElementBeam | None = None

    @model_validator(mode="after")
    def _one_place_each(self) -> Self:
        if len(self.stations) != len(self.positions_m):
            raise InputError(f"{len(self.stations)} stations, but positions_m has {len(self.positions_m)} rows")
        self.layout()
        return self

    def layout(self) -> Layout:
        """The stations."""
        return Layout.geodetic(self.stations, self.positions_m)

    def chain(self) -> Chain:
        """The element and the rotation between the sky's axes and its own, where there is one."""
        if self.element is None:
            return Chain(*self.receivers())
        return Chain(*self.receivers(), self.element.in_chain(), Parallactic())
