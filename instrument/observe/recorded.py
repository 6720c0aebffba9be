"""Recorded: the observation that a file holds: its own times, channels and UVW, to be predicted for."""

from __future__ import annotations

from dataclasses import replace
from typing import Annotated, Any

from instrument.errors import InputError
from instrument.observe.layout import Layout
from instrument.observe.observation import Observation
from instrument.observe.sampling import Sampling, times_of
from instrument.units import ArrayOf, Direction, Float


class Recorded(Observation):
    """An observation at times of its own, which may be irregular, with the UVW of its stations.

    `slots_s` (T,) are the middles of the integrations, UTC, MJD seconds; `own_uvw_m` (T, A, 3), m, are those of the
    stations `names` (A,), in the order of the file; `steered` is where beams point, if not to the phase centre.
    """

    slots_s: Annotated[Float, ArrayOf(float, (None,))]
    names: tuple[str, ...]
    own_uvw_m: Annotated[Float, ArrayOf(float, (None, None, 3))]
    steered: Direction | None = None

    @classmethod
    def of(cls, at: Sampling, interval_s: float, width_hz: float | None) -> Recorded:
        """The observation of a sampling, each integration as long as `interval_s`."""
        from astropy import units as u

        times = times_of(at.slots_s)
        return cls(
            phase_centre=at.centre, start=times[0] - interval_s / 2 * u.s, duration=len(times) * interval_s * u.s,
            interval=interval_s * u.s, frequencies=at.freq_hz * u.Hz,
            channel_width=None if width_hz is None else width_hz * u.Hz, slots_s=at.slots_s,
            names=at.layout.names, own_uvw_m=at.uvw_m, steered=at.steered,
        )  # fmt: skip

    def times(self, layout: Layout) -> Any:
        """Middles of the integrations, UTC `Time` (T,)."""
        return times_of(self.slots_s)

    def sampling(self, layout: Layout, ra_rad: Float, dec_rad: Float) -> Sampling:
        """The `Sampling` with the UVW of the file; raises `InputError` for stations that the file has not."""
        lacking = [name for name in layout.names if name not in self.names]
        if lacking:
            some = ", ".join(self.names[:5]) + ", ..." * (len(self.names) > 5)
            remedy = "give the telescope stations=observation.names"
            raise InputError(f"the data have no station {lacking[0]}: they have {some}; {remedy}")
        at = super().sampling(layout, ra_rad, dec_rad)
        rows = [self.names.index(name) for name in layout.names]
        return replace(at, slots_s=self.slots_s, own_uvw_m=self.own_uvw_m[:, rows], steered=self.steered)
