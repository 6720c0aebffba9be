"""SignalSky: the 21-cm signal of a table as a sky of a scene."""

from __future__ import annotations

from functools import lru_cache
from typing import Annotated, Any, Self

import numpy as np
from pydantic import model_validator

from instrument.analyze.power.signal import DEFAULT, Signal21cm
from instrument.errors import InputError
from instrument.memory import afford
from instrument.numbers import Positive, Seed, Whole
from instrument.sky.image import NEAR
from instrument.sky.made import ImageMaker
from instrument.units import Float, PositiveHertz


class SignalSky(ImageMaker):
    """A Gaussian field of the spectrum of a 21-cm `model` about the phase centre, Stokes I alone.

    It is drawn for `channels` even channels of `band`, the first and the last, all at once, for the signal of one
    channel is akin to that of the next; an observation may ask for any of these and for no other. `redshift` is that of
    the middle of the band unless given. See `Signal21cm.cube`.
    """

    model: str = DEFAULT
    band: tuple[PositiveHertz, PositiveHertz] = (134e6, 166e6)
    channels: Annotated[int, Whole(at_least=2, at_most=10_000)] = 161
    redshift: Positive | None = None
    seed: Seed = 21

    @model_validator(mode="after")
    def _possible(self) -> Self:
        if not self.band[0] < self.band[1]:
            raise InputError(f"band = {self.band[0]:g} to {self.band[1]:g} Hz: give the first channel and the last")
        Signal21cm.table(self.model)
        afford(4 * self.held_bytes, f"a signal of {self.channels} x {self.pixels} x {self.pixels}", "lower its pixels")
        return self

    @property
    def freq_hz(self) -> Float:
        """The channels that it has, Hz (F,)."""
        return np.linspace(*self.band, self.channels)

    @property
    def there(self) -> tuple[bool, bool, bool, bool]:
        """I."""
        return (True, False, False, False)

    @property
    def held_bytes(self) -> float:
        """The field of all channels."""
        return 4.0 * self.channels * self.pixels**2

    def kelvin(self, freq_hz: float) -> Any:
        """Stokes I, Q, U, V of one channel in K, float32 (4, N, N)."""
        apart = np.abs(self.freq_hz - freq_hz)
        k = int(np.argmin(apart))
        if apart[k] > NEAR * freq_hz:
            first, last = (f / 1e6 for f in self.band)
            raise InputError(
                f"the 21-cm sky has no channel at {freq_hz / 1e6:.10g} MHz ({self.channels} from {first:.10g} to "
                f"{last:.10g} MHz): observe some of these, or give band and channels of the observation"
            )
        out = np.zeros((4, self.pixels, self.pixels), np.float32)
        out[0] = _field(self)[k]
        return out


@lru_cache(maxsize=1)
def _field(sky: SignalSky) -> Any:
    """The field of all channels in K, float32 (F, N, N); the latest is remembered."""
    from astropy import units as u

    signal = Signal21cm.table(sky.model)
    about = sky.pixels, sky.pixel * u.rad, sky.freq_hz * u.Hz, sky.seed
    return signal.cube(*about, redshift=sky.redshift).data[:, 0]
