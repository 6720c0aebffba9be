"""Clock: integrations that follow each other regularly; how fast baselines turn there, and which are in a uv range."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from instrument.observe.directions import EARTH_RATE, LIGHT, EarthFrame
from instrument.observe.sampling import Sampling
from instrument.units import Bool, Float, Int
from instrument.visibilities import Visibilities

SLACK = 1.001  # precession of the pole, and aberration


class Clock:
    """Integrations that follow each other every `interval_s`, counted from the first, and the Earth at those seen."""

    def __init__(self, block: Visibilities) -> None:
        self.first = block.at.block(slice(0, 1), slice(0, 1))
        self.antennas = block.antenna1, block.antenna2
        self.interval_s = float(np.max(block.interval_s))
        self.numbers = np.zeros(0, int)
        self.earth = self.first.earth[:0]

    def count(self, block: Visibilities) -> Int | None:
        """The numbers of the integrations of a block, or `None` where it does not keep this time, or has its own UVW.

        To 10 ns, as `Sampling.regular`; looked at are the first, middle and last.
        """
        at, first = block.at, self.first
        apart = (
            block.given_uvw_m is not None
            or at.seen_centre is not None
            or at.own_uvw_m is not None
            or at.layout.names != first.layout.names
            or not np.array_equal(at.layout.positions_m, first.layout.positions_m)
            or not all(map(np.array_equal, self.antennas, (block.antenna1, block.antenna2)))
            or np.any(block.interval_s != self.interval_s)
        )
        if apart:
            return None
        since = at.slots_s - first.slots_s[0]
        found = np.rint(since / self.interval_s).astype(int)
        if np.abs(since - found * self.interval_s).max() > 1e-5:
            return None
        some = np.array([0, len(found) // 2, -1])
        made = first.every(self.interval_s, np.append(-1, found[some])).earth.matrices[1:]
        if np.abs(made - at.earth.matrices[some]).max() > 1e-8 * EARTH_RATE:
            return None
        self._know(found, at.earth)
        return found

    def _know(self, numbers: Int, earth: EarthFrame) -> None:
        both = np.append(self.numbers, numbers)
        self.numbers, place = np.unique(both, return_index=True)
        joined = EarthFrame(
            np.concatenate([self.earth.matrices, earth.matrices]), np.concatenate([self.earth.velocity, earth.velocity])
        )
        self.earth = joined[place]

    @property
    def baselines_m(self) -> Float:
        """Station 1 minus station 2, ITRF, m (B, 3)."""
        places, (one, other) = self.first.layout.positions_m, self.antennas
        return places[one] - places[other]

    def stations(self, numbers: Int) -> Float:
        """Stations u, v, w in m at integrations, before the first and after the last too, (N, A, 3)."""
        new = np.setdiff1d(numbers, self.numbers)
        if len(new):
            self._know(new, self.first.every(self.interval_s, np.append(new, -1)).earth[:-1])
        earth = self.earth[np.searchsorted(self.numbers, numbers)]
        return replace(self.first, earth=earth, slots_s=self.first.slots_s[0] + numbers * self.interval_s).uvw_m


def turns(first: Sampling, baselines_m: Float, freq_hz: float, half: float) -> Float:
    """How often what pixels within +-`half` (sin) add to baselines turns a second at most, whatever the time, (B,)."""
    across, sine = np.hypot(baselines_m[:, 0], baselines_m[:, 1]), float(first.centre_itrf[0, 2])
    corner = 2 * half**2
    down = corner / (1 + np.sqrt(max(0.0, 1 - corner)))
    # |du/dt| + |dv/dt| at its largest, and |dw/dt| at its own
    reach = half * np.sqrt(1 + sine**2) + down * np.sqrt(max(0.0, 1 - sine**2))
    return np.asarray(SLACK * EARTH_RATE * reach * across * (freq_hz / LIGHT))


def ever_within(first: Sampling, baselines_m: Float, freq_hz: float, uv_range: tuple[float, float] | None) -> Bool:
    """Which baselines may be in a uv range at some time of a day, (B,)."""
    if uv_range is None:
        return np.ones(len(baselines_m), bool)
    sine, length = float(first.centre_itrf[0, 2]), np.linalg.norm(baselines_m, axis=1)
    across, along = np.hypot(baselines_m[:, 0], baselines_m[:, 1]), np.abs(baselines_m[:, 2])
    deep = across * np.sqrt(max(0.0, 1 - sine**2)) + along * abs(sine)
    shortest = np.sqrt(np.maximum(length**2 - deep**2, 0.0))
    low, high = (limit * LIGHT / freq_hz for limit in uv_range)
    return np.asarray((SLACK * length >= low) & (shortest - (SLACK - 1) * length <= high))
