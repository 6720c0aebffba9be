"""Observation: towards where, when, and at which frequencies."""

from __future__ import annotations

from typing import Any, Self

import numpy as np
from pydantic import model_validator

from instrument.checked import checked
from instrument.component import Component
from instrument.errors import InputError, RefusedError
from instrument.memory import afford
from instrument.observe.clock import later
from instrument.observe.directions import transit_time
from instrument.observe.layout import Layout
from instrument.observe.sampling import Sampling
from instrument.units import Float, Hertz, HertzArray, Instant, Seconds, SkyDirection

MOST_TIMES = 3_000_000  # integrations that are planned at once, at 20 us and 1 kB each
SHORTEST_S = 1e-5  # MJD seconds of today resolve 1e-6 in double precision


@checked
class Observation(Component):
    """A phase centre tracked for `duration` in integrations of `interval`, at channel centres `frequencies`.

    Give `start` (UTC, the beginning of the first integration) or `transit` (a UTC day, "2012-12-07": the observation is
    centred on the culmination of the phase centre within that day). `channel_width` is that of one channel; where it is
    not given, it is the spacing of the channels where they are adjacent. `duration` is a whole number of intervals.
    """

    phase_centre: SkyDirection
    start: Instant | None = None
    transit: str | None = None
    duration: Seconds
    interval: Seconds
    frequencies: HertzArray
    channel_width: Hertz | None = None

    @model_validator(mode="after")
    def _possible(self) -> Self:
        if (self.start is None) == (self.transit is None):
            raise InputError("an observation needs 'start' or 'transit', and not both")
        if self.interval <= 0:
            raise InputError(f"interval = {self.interval:g} s must be positive")
        if self.duration < self.interval:
            raise InputError(f"duration = {self.duration:g} s is shorter than one interval of {self.interval:g} s")
        count = self.duration / self.interval
        if abs(count - round(count)) > 1e-3:
            few, more = (n * self.interval for n in (np.floor(count), np.ceil(count)))
            raise InputError(
                f"duration = {self.duration:g} s is {count:.6g} intervals of {self.interval:g} s: give {few:.10g} s or "
                f"{more:.10g} s"
            )
        if self.frequencies.size == 0 or np.any(self.frequencies <= 0):
            raise InputError("frequencies must be positive, and at least one")
        if np.unique(self.frequencies).size != self.frequencies.size:
            raise InputError("frequencies holds the same channel twice")
        if self.channel_width is not None and self.channel_width <= 0:
            raise InputError(f"channel_width = {self.channel_width:g} Hz must be positive")
        return self

    @property
    def count(self) -> int:
        """Number of integrations."""
        return max(1, round(self.duration / self.interval))

    @property
    def width_hz(self) -> float | None:
        """Width of a channel: given, or the smallest spacing of channels; `None` where neither is known.

        A spacing above 5 % of the lowest frequency is none of adjacent channels: 120 and 180 MHz are not 60 MHz wide.
        """
        if self.channel_width is not None:
            return self.channel_width
        if self.frequencies.size < 2:
            return None
        known = np.sort(self.frequencies)
        step = float(np.diff(known).min())
        return step if step <= 0.05 * known[0] else None

    @property
    def freq_hz(self) -> Float:
        """Channel centres in Hz (F,)."""
        return np.asarray(self.frequencies)

    def times(self, layout: Layout) -> Any:
        """Centres of the integrations, UTC `Time` (T,); the layout says where "transit" is."""
        asked = self.duration / self.interval
        if asked > MOST_TIMES:
            raise RefusedError(
                f"duration = {self.duration:g} s by interval = {self.interval:g} s is {asked:.3g} integrations, and "
                f"{MOST_TIMES} are planned at once: lengthen the interval, or split the observation"
            )
        if self.interval < SHORTEST_S:
            raise InputError(
                f"interval = {self.interval:g} s is shorter than {SHORTEST_S:g} s: times are kept to 1 microsecond"
            )
        afford(1e3 * self.count, f"an observation of {self.count} integrations", "lengthen the interval")
        from astropy import units as u

        if self.transit is not None:
            middle = transit_time(self.phase_centre, layout.centre_m, self.transit)
            begin = later(middle, -self.count * self.interval / 2 * u.s)
        else:
            begin = self.start
        return later(begin, (np.arange(self.count) + 0.5) * self.interval * u.s)

    def sampling(self, layout: Layout, ra_rad: Float, dec_rad: Float) -> Sampling:
        """The `Sampling` of its times and channels for directions (S,), ICRS rad."""
        return Sampling.build(layout, self.times(layout), self.freq_hz, ra_rad, dec_rad, self.phase_centre)
