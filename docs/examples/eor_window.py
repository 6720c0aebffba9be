"""From Q and U of Faraday screens to what their leakage leaves of the window on the 21-cm signal.

About ten seconds: python docs/examples/eor_window.py
"""

import numpy as np
from astropy import units as u

import instrument
from instrument import Analyzer, Signal21cm, leaked, noise_cube, polarized_screens

sky = polarized_screens(pixels=128, pixel=2 * u.arcmin)  # Q and U in K, 161 channels from 134 to 166 MHz, I = 0
noise = noise_cube(sky, 1 * u.K, seed=1).data
noise[:, [0, 3]] = 0  # of Q and U; it leaks like them
cube = leaked(sky.with_data(sky.data + noise), fraction=0.02)
print(f"{1e3 * cube.data[:, 0].std():.1f} mK rms have leaked into Stokes I, of {cube.data[:, 1].std():.2f} K in Q")

depths = np.arange(-10, 10.01, 0.25)
for stokes in ("P", "I"):
    found = Analyzer(cube).rm_synthesis(depths, stokes=stokes)
    power = (np.abs(found.data) ** 2).mean(axis=(1, 2))
    print(f"Stokes {stokes}: brightest at a Faraday depth of {depths[np.argmax(power)]:+.2f} rad/m2")

signal = Signal21cm.table()
look = {"uv_range": (30, 500), "bins": 8, "bins_par": 8, "wedge": 2 * u.deg}
print(Analyzer(cube).eor_window(signal, **look))

split = instrument.load("foregrounds", "pca", components=4).split(cube)
print(split)
window = Analyzer(split.residual).eor_window(signal, **look)
print(f"after that {window.area()[1]:.0%} of the bins' area are open")
