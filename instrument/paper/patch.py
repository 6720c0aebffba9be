"""Where the experiments with beams look: a square patch about a centre, and hours from its transit."""

from __future__ import annotations

from typing import Any

import numpy as np

from instrument.observe.directions import earth_frame, offset
from instrument.observe.layout import Layout
from instrument.observe.observation import Observation
from instrument.units import Direction, Float

SIDEREAL = 1.002737909  # sidereal hours in an hour


def square(pixels: int, half_deg: float) -> tuple[Float, Float]:
    """Direction cosines l, m (pixels², ) of a square patch, rows from south to north."""
    k = np.sin(np.deg2rad(half_deg)) * np.linspace(-1, 1, pixels)
    l, m = np.meshgrid(k, k)
    return l.ravel(), m.ravel()


def rings(radii_deg: Float, angles_deg: Float) -> tuple[Float, Float]:
    """Direction cosines l, m of rings about the centre, one after the other; angles from north through east."""
    r, angle = np.sin(np.deg2rad(radii_deg))[:, None], np.deg2rad(angles_deg)
    return (r * np.sin(angle)).ravel(), (r * np.cos(angle)).ravel()


def around(centre: Direction, l: Float, m: Float) -> Any:
    """The SkyCoord of direction cosines about a centre."""
    from astropy.coordinates import SkyCoord

    return SkyCoord(*offset(centre, l, m), unit="rad")


def from_transit(observation: Observation, layout: Layout, hours: Any) -> Any:
    """Times at sidereal hours from the middle of an observation, which is the transit of its phase centre."""
    from astropy import units as u

    night = observation.times(layout)
    return night[0] + (night[-1] - night[0]) / 2 + np.asarray(hours) / SIDEREAL * u.hour


def zenith(layout: Layout, when: Any) -> Direction:
    """The ICRS direction that the first station faces, without aberration."""
    x, y, z = earth_frame(when, layout.positions_m[0]).matrices[0].T @ layout.axes[0, 2]
    return Direction(float(np.arctan2(y, x)), float(np.arcsin(z)))
