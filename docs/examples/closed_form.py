"""An instrument without beam, gains and feeds against the formula of a point source."""

import numpy as np
from astropy import units as u
from astropy.coordinates import SkyCoord

import instrument
from instrument import Observation, PointSky, Scene

stations = ["CS001HBA0", "CS032HBA1", "RS509HBA"]
bare = instrument.load("telescopes", "lofar-hba", stations=stations, beam=None)
centre, source = SkyCoord("08h13m36.0s +48d13m03s"), SkyCoord("08h23m36.0s +49d13m03s")
night = Observation(
    phase_centre=centre, transit="2012-12-07", duration=4 * u.hour, interval=30 * u.min, frequencies=[150] * u.MHz
)
i, q, stokes_u, v = 2.0, 0.3, -0.2, 0.1
vis = Scene(instrument=bare, sky=PointSky.at(source, [[i, q, stokes_u, v]]), observation=night).plan().run()

# V = B exp(-2 pi i (u l + v m + w (n - 1)))
a, d, a0, d0 = source.ra.rad, source.dec.rad, centre.ra.rad, centre.dec.rad
l = np.cos(d) * np.sin(a - a0)
m = np.sin(d) * np.cos(d0) - np.cos(d) * np.sin(d0) * np.cos(a - a0)
n1 = -(l**2 + m**2) / (1 + np.sqrt(1 - l**2 - m**2))
turns = vis.uvw_m @ [l, m, n1] * 150e6 / 299792458.0  # (times, baselines)
brightness = np.array([[i + q, stokes_u + 1j * v], [stokes_u - 1j * v, i - q]])
paper = np.exp(-2j * np.pi * turns)[:, None, :, None, None] * brightness

longest = np.linalg.norm(vis.uvw_m, axis=-1).max()
print(f"{vis.data.shape[0]} times, {vis.data.shape[2]} baselines up to {longest / 1e3:.1f} km, phases up to", end=" ")
print(f"{np.abs(turns).max():.0f} turns; largest difference {np.abs(vis.data - paper).max():.1e} Jy of {i} Jy")
