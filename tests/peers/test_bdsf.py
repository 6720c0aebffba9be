"""Source finding against bdsf, the successor of PyBDSM, on one image."""

import numpy as np
import pytest
from astropy import units as u

from instrument import PointSky, Psf, SourceFinder, StokesCube
from instrument.image.minor import Folding, restored
from instrument.units import direction

pytestmark = pytest.mark.peer
PIXELS, PIXEL, SIGMA = 512, float(np.deg2rad(10 / 3600)), 1e-3
BEAM = (*np.deg2rad(np.array([60, 45]) / 3600), 0.5)


def test_as_complete_at_10_sigma_as_bdsf_with_fluxes_at_least_as_near(tmp_path, monkeypatch):
    bdsf = pytest.importorskip("bdsf")
    rng, folding = np.random.default_rng(2), Folding((PIXELS, PIXELS))
    y, x = (a.ravel() + rng.uniform(-8, 8, 64) for a in np.meshgrid(*[np.arange(36, 500, 62)] * 2, indexing="ij"))
    flux = SIGMA * 10 * rng.uniform(1, 5, 64)
    white = restored(rng.standard_normal((PIXELS, PIXELS)), BEAM, PIXEL, folding)
    data = np.zeros((1, 4, PIXELS, PIXELS))
    data[0, 0] = SIGMA * white / white.std()
    north, east = (np.arange(PIXELS)[:, None] * PIXEL, -np.arange(PIXELS) * PIXEL)
    c, s = np.cos(BEAM[2]), np.sin(BEAM[2])
    for f, row, column in zip(flux, y, x, strict=True):
        n, e = north - row * PIXEL, east + column * PIXEL
        along, across = n * c + e * s, e * c - n * s
        data[0, 0] += f * np.exp(-4 * np.log(2) * ((along / BEAM[0]) ** 2 + (across / BEAM[1]) ** 2))
    psf = Psf.gaussian(*(a * u.rad for a in BEAM))
    centre = direction("08h13m36.0s +48d13m03s")
    cube = StokesCube(data, [150] * u.MHz, PIXEL * u.rad, "Jy/beam", centre, psf, constants="data")
    ra, dec = cube.grid.at(y, x)
    stokes = flux[:, None] * [1, 0, 0, 0]
    truth = PointSky(names=tuple(f"t{k}" for k in range(64)), ra_rad=ra, dec_rad=dec, stokes_jy=stokes)
    ours = SourceFinder().find(cube).against(truth, 30 * u.arcsec)
    monkeypatch.chdir(tmp_path)
    cube.write("image.fits")
    image = bdsf.process_image("image.fits", quiet=True, frequency=150e6, ncores=1)
    theirs = np.array([[g.centre_sky[0], g.centre_sky[1], g.total_flux] for g in image.gaussians])
    apart = np.hypot(
        (theirs[:, 0] - np.rad2deg(ra)[:, None] + 180) % 360 - 180, theirs[:, 1] - np.rad2deg(dec)[:, None]
    )
    nearest = apart.argmin(axis=1)
    found = apart.min(axis=1) < 30 / 3600
    assert ours.completeness >= found.mean() and ours.false <= 0.02
    worse = np.median(np.abs(theirs[nearest, 2] / flux - 1)[found])
    assert np.median(np.abs(ours.flux_ratio - 1)) <= worse
