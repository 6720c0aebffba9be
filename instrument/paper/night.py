"""The noise of one night in Q and U of a cube, and what leaks of it into I."""

from __future__ import annotations

import numpy as np

from instrument.image.beam_leakage import leaked_through
from instrument.image.cube import StokesCube
from instrument.image.mocks import noise_cube
from instrument.model import Instrument

NIGHT_K, NIGHT_HZ, NIGHT_ARCMIN = 0.06 * np.sqrt(75), 0.19e6, 4.3  # noise of one of 75 nights, Table 2
TRANSIT = "2012-12-07T02:44:00"
HOURS = (-3.2, -1.6, 0.0, 1.6, 3.2)


def with_night(cube: StokesCube, lofar: Instrument, seed: int) -> StokesCube:
    """The cube with the noise of a night in Q and U, and in I what leaks of it through the beams of a baseline."""
    from astropy import units as u
    from astropy.time import Time

    width = float(np.median(np.diff(cube.freq_hz)))
    assert cube.psf is not None
    # the same power per cell of (u, v): the square goes with the solid angle of the PSF
    beam = np.sqrt(cube.psf.solid_angle_sr * 4 * np.log(2) / np.pi)
    sigma = NIGHT_K * np.sqrt(NIGHT_HZ / width) * np.deg2rad(NIGHT_ARCMIN / 60) / beam
    one, two = lofar.layout().names[:2]
    pair = lofar.with_fields(stations=[one, two])
    data = np.array(cube.data)
    for k, hour in enumerate(HOURS):
        # a cell of (u, v) is seen at some time of the night, and leaks as the beam does then: noise of its own for each
        noise = noise_cube(cube, sigma / np.sqrt(len(HOURS)) * u.K, psf_shaped=True, seed=1000 * seed + k)
        noise.data[:, [0, 3]] = 0
        data += leaked_through(noise, pair, Time(TRANSIT) + hour * u.hour, (one, two)).data
        del noise
    return cube.with_data(data)
