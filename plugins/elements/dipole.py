"""CrossedDipole: two short dipoles at right angles over an infinite ground plane."""

from __future__ import annotations

from typing import Annotated, ClassVar

import numpy as np
from pydantic import Field

from instrument.jones.base import ElementBeam, Knob
from instrument.mat2 import UNIT, pack
from instrument.observe.directions import LIGHT
from instrument.observe.sampling import Sampling
from instrument.units import Complex, Float, Metres, Radians


class CrossedDipole(ElementBeam):
    """Ideal crossed dipoles `height` above a perfect ground plane, (T, F, A, S, 2, 2).

    J = sin(2 pi h/lambda cos theta) [[cos theta cos a, -sin a], [cos theta sin a, cos a]], a = azimuth - azimuth of X;
    the second row is that of the Y dipole, 90 deg further from p (east) to q (north). 1 at the zenith for h = lambda/4.
    Closed form of image theory (for example Balanis, Antenna Theory, chapter 4). Zero below the plane.
    """

    real: ClassVar[bool] = True
    knob: ClassVar[Knob | None] = (
        "height",
        "m",
        (0.2, 0.3, 0.4, 0.5, 0.6, 0.8, 1.0, 1.3, 1.7, 2.2),
    )
    height: Annotated[Metres, Field(gt=0)]
    x_azimuth: Radians = 0.0

    def peak(self, at: Sampling) -> float:
        """1."""
        return 1.0

    def rounding(self, at: Sampling) -> Float:
        """That of the height in turns, of the angle from the zenith, and of the products."""
        turns = 2 * np.pi * self.height * float(at.freq_hz.max()) / LIGHT
        return np.array([UNIT * (22 * turns + 64)])

    def jump(self, at: Sampling) -> float:
        """0: it stands still."""
        return 0.0

    def jones(self, at: Sampling) -> Complex:
        """J of the element, (T, F, A, S, 2, 2)."""
        theta = at.zenith_angle
        cos_az, sin_az = at.azimuth_cos_sin
        c, s = np.cos(self.x_azimuth), np.sin(self.x_azimuth)
        cos_a, sin_a = cos_az * c + sin_az * s, sin_az * c - cos_az * s
        cos_theta = np.where(theta < np.pi / 2, np.cos(theta), 0.0)
        height = 2 * np.pi * self.height * at.freq_hz / LIGHT
        plane = np.sin(height[:, None, None] * cos_theta[:, None])
        field = pack(cos_theta * cos_a, -sin_a, cos_theta * sin_a, cos_a)
        return plane[..., None, None] * field[:, None]
