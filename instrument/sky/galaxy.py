"""Galaxy: polarized emission in Faraday screens as a sky, any channel of it when it is asked for."""

from __future__ import annotations

from functools import lru_cache
from typing import Annotated, Any, Self

import numpy as np
from pydantic import model_validator

from instrument.errors import InputError
from instrument.memory import afford
from instrument.numbers import Seed, Whole
from instrument.observe.directions import LIGHT
from instrument.sky.made import ImageMaker
from instrument.sky.screens import TEN, Screens, emission, turned_to_peak
from instrument.units import Kelvin, PositiveHertz, PositiveRadians

ARCMIN = np.pi / 180 / 60


class Galaxy(ImageMaker):
    """Polarized emission of the Galaxy about the phase centre: I and V are 0, as an interferometer sees it.

    `screens` (a table of its own in a scene file) are what emits; see `polarized_screens`. Their peak in Faraday depth
    is that of `channels` even channels of `band`, first and last, whatever is observed, so that one channel is the same
    alone and among others. `noise` is that of Q and of U in every pixel and channel, independent; `discs` of radius
    `disc`, at random places, hold nothing but it: what is left where bright sources are masked. All by the `seed`.
    """

    screens: Screens = TEN
    band: tuple[PositiveHertz, PositiveHertz] = (134e6, 166e6)
    channels: Annotated[int, Whole(at_least=1, at_most=10_000)] = 161
    noise: Kelvin = 0.0
    discs: Annotated[int, Whole(at_least=0, at_most=100_000)] = 0
    disc: PositiveRadians = 5 * ARCMIN
    seed: Seed = 196

    @model_validator(mode="after")
    def _possible(self) -> Self:
        if not self.band[0] <= self.band[1]:
            raise InputError(f"band = {self.band[0]:g} to {self.band[1]:g} Hz: give the first channel and the last")
        afford(self.held_bytes, f"a Galaxy of {self.pixels} x {self.pixels} pixels", "lower its pixels")
        self.screens.check(self.pixels, self.pixel)
        return self

    @property
    def there(self) -> tuple[bool, bool, bool, bool]:
        """Q and U."""
        return (False, True, True, False)

    @property
    def held_bytes(self) -> float:
        """Fields of the screens, and 34 channels while the peak is looked for."""
        return self.screens.bytes_of(self.pixels) + 34 * 8.0 * self.pixels**2

    def kelvin(self, freq_hz: float) -> Any:
        """Stokes I, Q, U, V of one frequency in K, float32 (4, N, N)."""
        about = self.screens, self.pixels, self.pixel, self.seed
        factor, shift = turned_to_peak(*about, self.band, self.channels)
        p = emission(*about).at(freq_hz).reshape(self.pixels, self.pixels)
        p *= np.complex64(factor * np.exp(2j * shift * (LIGHT / freq_hz) ** 2))
        out = np.zeros((4, *p.shape), np.float32)
        out[1], out[2] = p.real, p.imag
        if self.discs:
            out[:, self.masked()] = 0
        if self.noise:
            # of its own for every frequency: a channel has the same noise alone and among others
            rng = np.random.default_rng([self.seed, 1, round(freq_hz)])
            out[1:3] += np.float32(self.noise) * rng.standard_normal((2, *p.shape), dtype=np.float32)
        return out

    def masked(self) -> Any:
        """The pixels within the discs, bool (N, N)."""
        return _masked(self.pixels, self.disc / self.pixel, self.discs, self.seed)


@lru_cache(maxsize=2)
def _masked(pixels: int, radius: float, discs: int, seed: int) -> Any:
    """Pixels within a radius, in pixels, of random places, bool (N, N)."""
    y, x = np.ogrid[:pixels, :pixels]
    out = np.zeros((pixels, pixels), bool)
    for at in np.random.default_rng([seed, 2]).uniform(0, pixels, (discs, 2)):
        out |= np.hypot(y - at[0], x - at[1]) <= radius
    return out
