"""What leaks of Galactic polarization into Stokes I through the beam of LOFAR, and through a simple one."""

import numpy as np
from astropy import units as u
from astropy.coordinates import SkyCoord
from astropy.time import Time

import instrument

centre = SkyCoord("08h13m36.0s +48d13m03s")  # 3C 196
lofar = instrument.load("telescopes", "lofar-hba", stations=["CS001HBA0", "CS001HBA1"])
night = Time("2012-12-07T02:00:00") + np.linspace(-4, 4, 9) * u.hour  # about the transit

# 4 deg, the recipe of the docs at a quarter of the pixels and an eighth of the channels
screens = instrument.polarized_screens(120, 2 * u.arcmin, np.linspace(134, 166, 21) * u.MHz, seed=196, centre=centre)
through_lofar = instrument.leaked_through(screens, lofar, night)
through_simple = instrument.leaked(screens)


def rms_mk(cube, stokes):
    return 1e3 * np.sqrt(np.mean(cube.data[10, stokes] ** 2))


print(f"at {screens.freq_hz[10] / 1e6:.0f} MHz, over 4 deg, all in mK rms")
print(f"Q, U of the sky                        {rms_mk(screens, 1):7.1f}, {rms_mk(screens, 2):.1f}")
print(f"in I through two LOFAR stations, 8 h   {rms_mk(through_lofar, 0):7.1f}")
print(f"in I through the simple beam           {rms_mk(through_simple, 0):7.1f}")

print("\ndistance (deg)   of Q, U in I (%): LOFAR, simple")
y, x = np.mgrid[-60:60, -60:60] * 2 / 60
radius, polarized = np.hypot(x, y), np.hypot(*screens.data[10, 1:3])
for low, high in ((0, 0.5), (0.5, 1), (1, 1.5), (1.5, 2)):
    ring = (radius >= low) & (radius < high)
    share = [
        100 * np.sqrt((cube.data[10, 0][ring] ** 2).sum() / (polarized[ring] ** 2).sum())
        for cube in (through_lofar, through_simple)
    ]
    print(f"{low:4.1f} - {high:3.1f}        {share[0]:6.3f}  {share[1]:6.3f}")
