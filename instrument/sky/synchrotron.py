"""Synchrotron: total intensity of the Galaxy, a random field with a power law along frequency in every pixel."""

from __future__ import annotations

from functools import lru_cache
from typing import Any, Self

import numpy as np
from pydantic import model_validator

from instrument.errors import InputError
from instrument.memory import afford
from instrument.numbers import Finite, NotNegative, Seed, UvRange
from instrument.sky.made import ImageMaker
from instrument.sky.screens import random_field, unit_rms, uv_of
from instrument.units import Kelvin, PositiveHertz


class Synchrotron(ImageMaker):
    """Stokes I of fluctuations about the mean of the sky, which no interferometer sees; unpolarized.

    T = T_0(x) (nu / `frequency`)^b(x): T_0 a Gaussian field of angular power l^-`slope` within `uv_range` (wavelengths)
    and of that `rms`, b of mean `index` and rms `scatter`, of the same angular power. 14 K and 2.2 were measured at
    150 MHz in the Fan region, which is bright (Bernardi et al. 2009, A&A 500, 965). By the `seed`.
    """

    rms: Kelvin = 14.0
    frequency: PositiveHertz = 150e6
    slope: Finite = 2.2
    uv_range: UvRange = (10.0, 800.0)
    index: Finite = -2.55
    scatter: NotNegative = 0.1
    seed: Seed = 150

    @model_validator(mode="after")
    def _possible(self) -> Self:
        afford(8 * self.held_bytes, f"an image of {self.pixels} x {self.pixels} pixels", "lower its pixels")
        uv = uv_of(self.pixels, self.pixel)
        if not ((uv > 0) & (uv >= self.uv_range[0]) & (uv <= self.uv_range[1])).any():
            text = f"{self.pixels} pixels have no cell within uv_range = {self.uv_range}"
            raise InputError(f"{text}: take more or larger ones")
        return self

    @property
    def there(self) -> tuple[bool, bool, bool, bool]:
        """I."""
        return (True, False, False, False)

    @property
    def held_bytes(self) -> float:
        """Brightness and index."""
        return 8.0 * self.pixels**2

    def kelvin(self, freq_hz: float) -> Any:
        """Stokes I, Q, U, V of one frequency in K, float32 (4, N, N)."""
        brightness, index = _fields(self)
        out = np.zeros((4, self.pixels, self.pixels), np.float32)
        out[0] = self.rms * brightness * np.exp((self.index + self.scatter * index) * np.log(freq_hz / self.frequency))
        return out


@lru_cache(maxsize=2)
def _fields(sky: Synchrotron) -> tuple[Any, Any]:
    """Brightness and index, float32 (N, N) of mean 0 and rms 1."""
    rng, uv = np.random.default_rng(sky.seed), uv_of(sky.pixels, sky.pixel)
    brightness, index = (unit_rms(random_field(rng, uv, sky.slope, sky.uv_range).real) for _ in range(2))
    return brightness, index
