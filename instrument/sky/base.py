"""Sky: what a scene looks at, as brightness matrices in some directions; PlacedSky: one whose directions are fixed."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Iterator
from typing import ClassVar, Literal

import numpy as np

from instrument.checked import checked
from instrument.component import Component
from instrument.errors import InputError
from instrument.observe.sampling import Sampling
from instrument.units import Complex, Direction, Float


class Sky(Component):
    """What is looked at; `about` a phase centre it is a `PlacedSky`, which is its own answer.

    A sky that is made about a phase centre (a grid, a mock field) has no directions before.
    """

    plugin_kind: ClassVar[str | None] = "skies"

    @abstractmethod
    def about(self, centre: Direction) -> PlacedSky:
        """The sky for a phase centre, with its directions fixed."""

    def directions(self) -> tuple[Float, Float]:
        """ICRS right ascension and declination in rad, (S,) each; raises `InputError` before it is placed."""
        raise self._unplaced()

    def brightness(self, at: Sampling) -> Complex:
        """Brightness matrices (T, F, S, 2, 2); raises `InputError` before it is placed."""
        raise self._unplaced()

    def envelope(self, at: Sampling, uvw_lambda: Float) -> Float | None:
        """What shapes take off visibilities, (T, F, B, S); raises `InputError` before it is placed."""
        raise self._unplaced()

    def _unplaced(self) -> InputError:
        return InputError(f"{type(self).__name__} has no sources yet: call about(phase_centre) first")


@checked
class PlacedSky(Sky):
    """Directions on the sky (S,) and their brightness matrices (T, F, S, 2, 2), length 1 where constant.

    `kind` says which engines it is for: "points" is a list of sources (`PointSky`), "image" has a grid (`PixelSky`),
    "sum" has members (`SumSky`), "other" is known by its directions and brightness alone, which `direct` takes.
    """

    kind: ClassVar[Literal["points", "image", "sum", "other"]] = "other"

    def about(self, centre: Direction) -> PlacedSky:
        """Itself."""
        return self

    @abstractmethod
    def directions(self) -> tuple[Float, Float]:
        """ICRS right ascension and declination in rad, (S,) each."""

    @abstractmethod
    def brightness(self, at: Sampling) -> Complex:
        """Brightness matrices [[I+Q, U+iV], [U-iV, I-Q]] in Jy, (T, F, S, 2, 2), length 1 where constant.

        `at` is towards its `directions`.
        """

    @abstractmethod
    def envelope(self, at: Sampling, uvw_lambda: Float) -> Float | None:
        """What the shapes of sources take off visibilities, real (T, F, B, S); `None` when all are points.

        `uvw_lambda` (T, F, B, 3) in wavelengths.
        """

    @abstractmethod
    def total_jy(self, freq_hz: Float) -> Float:
        """Sum of |I| + P of all directions, at the brightest time, Jy (F,): errors are relative to its largest."""

    def nonzero(self, freq_hz: Float) -> tuple[bool, bool, bool, bool]:
        """Which of I, Q, U, V differ from zero in any direction and channel; the cautious answer is all."""
        return (True, True, True, True)

    def doubts(self, freq_hz: Float) -> dict[str, str]:
        """What a plan should say of it at some frequencies, under "not modelled": a thing, and what is so about it."""
        return {}

    def held_bytes(self, channels: int) -> float:
        """What is allocated for its brightness while so many channels are summed, beside what it holds anyway."""
        return 0.0

    def members(self) -> dict[str, PlacedSky]:
        """The skies that it is a sum of, by name; itself, without a name, where it is none."""
        return {"": self}

    @property
    def count(self) -> int:
        """How many directions are summed."""
        return len(self.directions()[0])

    @property
    def size(self) -> str:
        """How large it is, in words."""
        return f"{self.count} direction{'' if self.count == 1 else 's'}"

    def outline(self) -> tuple[Float, Float]:
        """The directions that a plan looks at, (N,) each: all, or cells of `reach_rad` that cover an image."""
        return self.directions()

    @property
    def reach_rad(self) -> float:
        """How far a direction may be from the nearest of the outline."""
        return 0.0

    def parts(self, most: int, freq_hz: Float) -> Iterator[PlacedSky]:
        """Itself in pieces of at most so many directions, in these channels; as one piece where it cannot be cut."""
        yield self


def polarized(stokes_jy: Float) -> Float:
    """P = sqrt(Q^2 + U^2 + V^2) of Stokes I, Q, U, V (..., 4); `hypot`, for the squares of 1e155 Jy are no floats."""
    return np.asarray(np.hypot(np.hypot(stokes_jy[..., 1], stokes_jy[..., 2]), stokes_jy[..., 3]))


def power(stokes_jy: Float) -> Float:
    """|I| + P of Stokes I, Q, U, V (..., 4), the largest singular value of the brightness."""
    return np.asarray(np.abs(stokes_jy[..., 0]) + polarized(stokes_jy))
