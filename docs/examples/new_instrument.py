"""A new instrument: tiles of 4 x 4 crossed dipoles on a ring. The same class as in docs/extending.md."""

from typing import Annotated

import numpy as np
from astropy import units as u
from instrument_plugins.elements.dipole import CrossedDipole
from pydantic import Field

import instrument
from instrument import (
    Analyzer,
    Chain,
    ElementBeam,
    GainTerm,
    Instrument,
    Layout,
    Level,
    Observation,
    Parallactic,
    Scene,
    StationBeam,
)
from instrument.units import Metres

SITE = {"longitude": 116.67 * u.deg, "latitude": -26.7 * u.deg, "height": 377 * u.m}


class Ring(Instrument):
    """Tiles of 4 x 4 dipoles, evenly spaced on a ring."""

    count: Annotated[int, Field(ge=2)] = 8
    radius: Metres = 200.0
    element: ElementBeam = CrossedDipole(height=0.3 * u.m)

    def layout(self):
        angle = 2 * np.pi * np.arange(self.count) / self.count
        enu = self.radius * np.stack([np.sin(angle), np.cos(angle), 0 * angle], axis=-1)
        return Layout.from_enu([f"tile{k}" for k in range(self.count)], enu * u.m, **SITE)

    def chain(self):
        steps = 1.1 * (np.arange(4) - 1.5)  # m
        p, q, up = (x.ravel() for x in np.meshgrid(steps, steps, 0.0))
        dipoles = np.stack([p, q, up], axis=-1) @ self.layout().axes[0]  # local axes to ITRF
        tile = StationBeam(element=self.element, levels=(Level(offsets_m=dipoles[None]),))  # all alike: (1, 16, 3)
        return Chain(*self.receivers(), tile, Parallactic())


if __name__ == "__main__":
    ring = Ring(radius="150 m", gain=GainTerm(rms=1e-3, seed=1))
    print(str(instrument.conformance.check(ring)).splitlines()[0], "\n")
    night = Observation(
        phase_centre="12h00m00.0s -30d00m00s",
        transit="2026-05-01",
        duration=2 * u.hour,
        interval=10 * u.min,
        frequencies=[150] * u.MHz,
    )
    sky = instrument.load("skies", "grid", shape=(3, 3), spacing=4 * u.deg, flux=1 * u.Jy)
    plan = Scene(name="ring", instrument=ring, sky=sky, observation=night).plan()
    print(plan, "\n")
    found = Analyzer(visibilities=plan.run(), sky=sky).leakage()
    print("distance  I of 1 Jy seen  I to linear  I to circular")
    for row in np.argsort(found.distance_rad, kind="stable"):
        print(
            f"{np.rad2deg(found.distance_rad[row]):.2f} deg  {found.stokes_jy[row, 0]:.4f} Jy"
            f"       {found.linear_percent[row]:6.2f} %     {found.circular_percent[row]:.3f} %"
        )
