"""SumSky: several skies at once, each a member with a name."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Annotated, Any, ClassVar, Literal

import numpy as np
from pydantic import Field, model_validator

from instrument.checked import checked
from instrument.errors import InputError
from instrument.numbers import brief
from instrument.observe.sampling import Sampling
from instrument.sky.base import PlacedSky, Sky
from instrument.units import Complex, Direction, Float


@checked
class SumSky(PlacedSky):
    """Several skies at once: `SumSky(skies={"stars": ..., "galaxy": ...})`; in a scene file tables [sky.NAME].

    Every member is what it is alone, with a seed of its own, and a plan gives each to the engine that is cheapest for
    it. `about` a phase centre places those that need it.
    """

    kind: ClassVar[Literal["points", "image", "sum", "other"]] = "sum"
    skies: Annotated[dict[str, Sky], Field(min_length=1)]

    @model_validator(mode="before")
    @classmethod
    def _tables(cls, given: Any) -> Any:
        if not isinstance(given, Mapping) or "skies" in given:
            return given
        for name, table in given.items():
            if not isinstance(table, Mapping | Sky):
                raise InputError(f"{name} = {brief(table)}: a sum of skies takes tables, [sky.{name}] with a 'kind'")
        return {"skies": dict(given)}

    def about(self, centre: Direction) -> SumSky:
        """The sum of its members about a phase centre."""
        placed = {name: sky.about(centre) for name, sky in self.skies.items()}
        if all(placed[name] is sky for name, sky in self.skies.items()):
            return self
        return self.with_fields(skies=placed)

    def members(self) -> dict[str, PlacedSky]:
        """The skies that it is a sum of, by name; raises `InputError` before they are placed."""
        for name, sky in self.skies.items():
            if not isinstance(sky, PlacedSky):
                raise InputError(f"'{name}' of the sum has no sources yet: call about(phase_centre) first")
        return dict(self.skies)  # type: ignore[arg-type]

    def directions(self) -> tuple[Float, Float]:
        """ICRS right ascension and declination of all members, one after the other, rad (S,) each."""
        return _joined([sky.directions() for sky in self.members().values()])

    def outline(self) -> tuple[Float, Float]:
        """The outlines of all members, one after the other, rad (N,) each."""
        return _joined([sky.outline() for sky in self.members().values()])

    @property
    def reach_rad(self) -> float:
        """How far a direction may be from the nearest of the outline."""
        return max(sky.reach_rad for sky in self.members().values())

    def brightness(self, at: Sampling) -> Complex:
        """Brightness matrices of all members (T, F, S, 2, 2)."""
        return side_by_side([sky.brightness(at.towards(*sky.directions())) for sky in self.members().values()])

    def envelope(self, at: Sampling, uvw_lambda: Float) -> Float | None:
        """What shapes take off visibilities (T, F, B, S), 1 for members without shapes; `None` where none has any."""
        members = list(self.members().values())
        found = [sky.envelope(at.towards(*sky.directions()), uvw_lambda) for sky in members]
        if all(one is None for one in found):
            return None
        shape = np.broadcast_shapes(*(one.shape[:3] for one in found if one is not None))
        ones = [np.ones((*shape, len(sky.directions()[0]))) for sky in members]
        return np.concatenate([one * (1 if f is None else f) for one, f in zip(ones, found, strict=True)], axis=3)

    def total_jy(self, freq_hz: Float) -> Float:
        """Sum of |I| + P of all members, Jy (F,)."""
        return np.asarray(sum(sky.total_jy(freq_hz) for sky in self.members().values()))

    def nonzero(self, freq_hz: Float) -> tuple[bool, bool, bool, bool]:
        """Which of I, Q, U, V differ from zero in any member."""
        found = np.any([sky.nonzero(freq_hz) for sky in self.members().values()], axis=0)
        return tuple(found.tolist())

    @property
    def count(self) -> int:
        """How many directions are summed."""
        return sum(sky.count for sky in self.members().values())

    @property
    def size(self) -> str:
        """How large it is, in words."""
        return " + ".join(f"{name} ({sky.size})" for name, sky in self.members().items())

    def held_bytes(self, channels: int) -> float:
        """That of the member which takes most."""
        return max(sky.held_bytes(channels) for sky in self.members().values())

    def doubts(self, freq_hz: Float) -> dict[str, str]:
        """What members say of themselves, with their names."""
        return {
            f"{name}: {thing}": text
            for name, sky in self.members().items()
            for thing, text in sky.doubts(freq_hz).items()
        }

    def parts(self, most: int, freq_hz: Float) -> Iterator[PlacedSky]:
        """Members, one after the other, in pieces of at most so many directions."""
        for sky in self.members().values():
            yield from sky.parts(most, freq_hz)


def side_by_side(parts: list[Any]) -> Any:
    """Arrays (T, F, S, ...) of members as one along S, each along T and F where any of them is not constant."""
    shape = np.broadcast_shapes(*(part.shape[:2] for part in parts))
    return np.concatenate([np.broadcast_to(part, (*shape, *part.shape[2:])) for part in parts], axis=2)


def _joined(pairs: list[tuple[Float, Float]]) -> tuple[Float, Float]:
    ra, dec = (np.concatenate(both) for both in zip(*pairs, strict=True))
    return ra, dec
