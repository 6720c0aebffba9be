"""Airy and Gaussian: parabolic dishes on alt-azimuth mounts that track the phase centre."""

from __future__ import annotations

from typing import Annotated, ClassVar

import numpy as np
from pydantic import Field

from instrument import mat2
from instrument.jones.base import ElementBeam, Knob, Structure
from instrument.observe.directions import LIGHT, separation
from instrument.observe.sampling import Sampling
from instrument.units import Complex, Float, Hertz, Metres, Radians


def _dish(pattern: Float, at: Sampling) -> Complex:
    """A voltage pattern (F, S) as Jones matrices (T, F, A, S, 2, 2), zero below the horizon."""
    up = at.zenith_angle < np.pi / 2
    return (pattern[None, :, None] * up[:, None])[..., None, None] * mat2.IDENTITY


class Airy(ElementBeam):
    """Uniformly lit circular dish, voltage 2 J1(x)/x with x = pi D/lambda sin(offset), (T, F, A, S, 2, 2).

    Feeds along elevation (e_theta) and azimuth (e_phi), no leakage of its own. Zero below the horizon.
    """

    structure: ClassVar[Structure] = "scalar"
    real: ClassVar[bool] = True
    knob: ClassVar[Knob | None] = ("diameter", "m", (3.0, 6.0, 12.0, 25.0, 35.0))
    diameter: Annotated[Metres, Field(gt=0)]

    def peak(self, at: Sampling) -> float:
        """1."""
        return 1.0

    def rounding(self, at: Sampling) -> Float:
        """That of x, whose angle is good to 10 roundings of 1: 2 J1(x)/x changes by 0.4 per unit at most."""
        return np.array([mat2.UNIT * (6 * np.pi * self.diameter * float(at.freq_hz.max()) / LIGHT + 32)])

    def jump(self, at: Sampling) -> float:
        """1: its feeds turn with the azimuth."""
        return 1.0

    def jones(self, at: Sampling) -> Complex:
        """J of the dish, (T, F, A, S, 2, 2)."""
        from scipy.special import j1

        angle = separation(at.vectors, at.pointing)
        x = np.pi * self.diameter * at.freq_hz[:, None] / LIGHT * np.sin(np.minimum(angle, np.pi / 2))
        with np.errstate(divide="ignore", invalid="ignore"):
            return _dish(np.where(np.abs(x) > 1e-8, 2 * j1(x) / x, 1.0), at)


class Gaussian(ElementBeam):
    """Gaussian dish: power exp(-4 ln2 (offset/fwhm)^2), `fwhm` that of the power at `frequency`, (T, F, A, S, 2, 2).

    The width goes as 1/frequency when `frequency` is given, else it is the same in every channel.
    """

    structure: ClassVar[Structure] = "scalar"
    real: ClassVar[bool] = True
    knob: ClassVar[Knob | None] = ("fwhm", "deg", (1.0, 3.0, 10.0, 30.0, 60.0))
    fwhm: Annotated[Radians, Field(gt=0)]
    frequency: Hertz | None = None

    def peak(self, at: Sampling) -> float:
        """1."""
        return 1.0

    def rounding(self, at: Sampling) -> Float:
        """That of an angle good to 10 roundings of 1: the pattern changes by 1.01 per width at most."""
        width = self.fwhm * (self.frequency / float(at.freq_hz.max()) if self.frequency else 1.0)
        return np.array([mat2.UNIT * (12 / width + 32)])

    def jump(self, at: Sampling) -> float:
        """1: its feeds turn with the azimuth."""
        return 1.0

    def jones(self, at: Sampling) -> Complex:
        """J of the dish, (T, F, A, S, 2, 2)."""
        angle = separation(at.vectors, at.pointing)
        width = self.fwhm * (self.frequency / at.freq_hz if self.frequency else np.ones(len(at.freq_hz)))
        return _dish(np.exp(-2 * np.log(2) * (angle / width[:, None]) ** 2), at)
