"""The table [observation] of a scene file: an observation, its channels as `frequency` or as a list."""

from __future__ import annotations

from typing import Annotated, Self

import numpy as np
from pydantic import model_validator

from instrument.component import Component
from instrument.errors import InputError
from instrument.numbers import Whole
from instrument.observe.observation import Observation
from instrument.units import (
    Float,
    HertzArray,
    Instant,
    PositiveHertz,
    Seconds,
    SkyDirection,
    si_prefix,
)

MOST_CHANNELS = 1_000_000
ALIKE = 1e-6  # of themselves: 161 channels of "0.19876 MHz" may be rounded


class Frequency(Component):
    """Channels: `centre` of the band, how many, and `channel_width` (also their spacing) or `bandwidth`, edge to edge.

    Where both are given they must agree. `width` is an older name of `channel_width`.
    """

    centre: PositiveHertz
    channel_width: PositiveHertz | None = None
    bandwidth: PositiveHertz | None = None
    width: PositiveHertz | None = None
    channels: Annotated[int, Whole(at_least=1, at_most=MOST_CHANNELS)] = 1

    @model_validator(mode="after")
    def _one_width(self) -> Self:
        given = self._given()
        if not given:
            raise InputError("frequency needs 'channel_width' or 'bandwidth'")
        (first, width), *others = given.items()
        for name, other in others:
            if abs(other - width) > ALIKE * width:
                count = f" of each of {self.channels} channels" if "bandwidth" in (first, name) else ""
                raise InputError(
                    f"frequency: {first} makes {si_prefix(width, 'Hz')}{count}, but {name} {si_prefix(other, 'Hz')}: "
                    "give one of them (bandwidth is that of all channels together)"
                )
        lowest = self.centre - width * (self.channels - 1) / 2
        if lowest <= 0 or lowest - width / 2 < -1e-9 * width:
            raise InputError(
                f"frequency: {self.channels} channels of {si_prefix(width, 'Hz')} about {si_prefix(self.centre, 'Hz')} "
                f"begin below 0: {first} or channels is too large"
            )
        if width < 1e-12 * self.centre:
            raise InputError(f"frequency: {first} = {width:g} Hz is too narrow to tell channels apart")
        return self

    def _given(self) -> dict[str, float]:
        """Width of a channel in Hz, by each key that tells it."""
        band = None if self.bandwidth is None else self.bandwidth / self.channels
        found = {"channel_width": self.channel_width, "bandwidth": band, "width": self.width}
        return {name: value for name, value in found.items() if value is not None}

    @property
    def width_hz(self) -> float:
        """Width of one channel, Hz."""
        return next(iter(self._given().values()))

    def values_hz(self) -> Float:
        """Channel centres, Hz (F,)."""
        return np.asarray(self.centre + self.width_hz * (np.arange(self.channels) - (self.channels - 1) / 2))


class ObservationTable(Component):
    """The table [observation]: an `Observation`, its channels as `frequency` or as a list `frequencies`."""

    phase_centre: SkyDirection
    start: Instant | None = None
    transit: str | None = None
    duration: Seconds
    interval: Seconds
    frequency: Frequency | None = None
    frequencies: HertzArray | None = None
    channel_width: PositiveHertz | None = None

    @model_validator(mode="after")
    def _one_band(self) -> Self:
        if (self.frequency is None) == (self.frequencies is None):
            raise InputError("needs 'frequency' or 'frequencies', and not both")
        if self.frequency is not None and self.channel_width is not None:
            width = self.frequency.width_hz
            if abs(self.channel_width - width) > ALIKE * width:
                raise InputError(
                    f"channel_width = {si_prefix(self.channel_width, 'Hz')}, but 'frequency' has channels of "
                    f"{si_prefix(width, 'Hz')}: give it there, once"
                )
        return self

    @property
    def width_hz(self) -> float | None:
        """Width of one channel, Hz, where it is given."""
        return self.channel_width if self.frequency is None else self.frequency.width_hz

    def observation(self) -> Observation:
        """The observation it describes."""
        from astropy import units as u

        values = self.frequency.values_hz() if self.frequency else self.frequencies
        return Observation(
            phase_centre=self.phase_centre,
            start=self.start,
            transit=self.transit,
            duration=self.duration * u.s,
            interval=self.interval * u.s,
            frequencies=np.asarray(values) * u.Hz,
            channel_width=None if self.width_hz is None else self.width_hz * u.Hz,
        )
