"""Sky: what a scene looks at, as brightness matrices in some directions."""

from __future__ import annotations

from abc import abstractmethod
from typing import TYPE_CHECKING, ClassVar

from instrument.checked import checked
from instrument.component import Component
from instrument.observe.sampling import Sampling
from instrument.units import Complex, Direction, Float

if TYPE_CHECKING:
    from instrument.sky.points import PointSky


@checked
class Sky(Component):
    """Sources on the sky: directions (S,) and brightness matrices (T, F, S, 2, 2), length 1 where constant.

    A sky that is made about a phase centre (a grid, a mock field) gives the sources in `about`; every other sky is its
    own answer.
    """

    plugin_kind: ClassVar[str | None] = "skies"

    def about(self, centre: Direction) -> Sky:
        """The sky for a phase centre, with its directions fixed."""
        return self

    def sources(self) -> PointSky | None:
        """The sky as a list of sources; `None` when it is not one."""
        return None

    @abstractmethod
    def directions(self) -> tuple[Float, Float]:
        """ICRS right ascension and declination in rad, (S,) each."""

    @abstractmethod
    def brightness(self, at: Sampling) -> Complex:
        """Brightness matrices [[I+Q, U+iV], [U-iV, I-Q]] in Jy, (T, F, S, 2, 2), length 1 where constant."""

    @abstractmethod
    def envelope(self, at: Sampling, uvw_lambda: Float) -> Float | None:
        """What the shapes of sources take off visibilities, real (T, F, B, S); `None` when all are points.

        `uvw_lambda` (T, F, B, 3) in wavelengths.
        """
