"""The beam of LOFAR stations towards some directions, and what it leaks from Stokes I."""

import numpy as np
from astropy import units as u
from astropy.coordinates import SkyCoord

import instrument
from instrument import mat2, mueller

lofar = instrument.load("telescopes", "lofar-hba", stations=["CS001HBA0", "RS508HBA"])
centre = SkyCoord("08h13m36.0s +48d13m03s")
transit, frequency = "2012-12-07T02:44:00", 150 * u.MHz

raw = lofar.beam(centre, transit, frequency)  # (times, channels, stations, directions, 2, 2)
print(f"Jones matrices {raw.shape}; columns are north and east, rows the X and Y dipoles")
print(f"CS001HBA0 towards 3C196:\n{np.round(raw[0, 0, 0, 0], 3)}\n")

print("offset  power    I to linear  I to circular  condition number (means over position angle)")
for offset in (0.0, 1.0, 2.0, 3.0, 4.0):
    ring = centre.directional_offset_by(np.arange(0, 360, 15) * u.deg, offset * u.deg)
    jones = lofar.beam(ring, transit, frequency, pointing=centre, state="differential")
    matrix = lofar.mueller(ring, transit, frequency, pointing=centre)[0, 0]  # (S, 4, 4), of the one baseline
    linear, circular = mueller.leakage(matrix)
    power, k = matrix[:, 0, 0].real.mean(), mat2.condition(jones[0, 0, 0]).mean()
    print(
        f"{offset:.0f} deg   {power:.4f}   {100 * linear.mean():.4f} %     {100 * circular.mean():.5f} %      {k:.5f}"
    )
