"""LOFAR's low band: how wide the beam is and what it leaks, from 30 to 75 MHz."""

import numpy as np
from astropy import units as u
from astropy.coordinates import SkyCoord

import instrument
from instrument import mueller

lofar = instrument.load("telescopes", "lofar-lba", stations=["CS001LBA", "CS302LBA"], antennas="outer")
centre, time = SkyCoord("08h13m36.0s +48d13m03s"), "2012-12-07T02:44:00"
frequencies = [30, 45, 60, 75] * u.MHz
radii = np.linspace(0, 8, 161)

profiles = []  # power against distance, for eight position angles
for angle in np.arange(0, 360, 45) * u.deg:
    line = centre.directional_offset_by(angle, radii * u.deg)
    matrix = lofar.mueller(line, time, frequencies, pointing=centre)[0]  # (F, S, 4, 4)
    profiles.append((matrix[..., 0, 0].real, 100 * mueller.leakage(matrix)[0]))
power, linear = (np.mean(x, axis=0) for x in zip(*profiles, strict=True))

print("CS001LBA-CS302LBA, outer antennas, differential beam, means over position angle")
for f, frequency in enumerate(frequencies):
    half = np.interp(-0.5, -power[f, : np.argmax(power[f] < 0.3)], radii[: np.argmax(power[f] < 0.3)])
    leak = np.interp(half, radii, linear[f])
    print(f"{frequency:.0f}: half power at {half:.2f} deg from the centre, {leak:.2f} % of I is linear there")
