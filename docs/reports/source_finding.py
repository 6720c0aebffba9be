"""800 sources in 2048 x 2048 pixels: what is found, beside others.

Run: python docs/reports/source_finding.py --bdsf --photutils
"""

from __future__ import annotations

import os
import sys
import tempfile
import time
import warnings
from dataclasses import replace
from pathlib import Path

import numpy as np
from astropy import units as u

from instrument import PointSky, Psf, StokesCube
from instrument.analyze.sources.finder import SourceFinder
from instrument.image.minor import Folding, restored
from instrument.units import direction

PIXELS, COUNT, PIXEL, SIGMA = 2048, 800, float(np.deg2rad(10 / 3600)), 1e-3
BEAM = (*np.deg2rad(np.array([60, 45]) / 3600), 0.5)

HEADS = (
    "finder", "found", "of 10 sigma and more", "of all, from 4 sigma", "false", "flux bias, median", "mean",
    "flux error, median", "place error, arcsec", "place bias", "s",
)  # fmt: skip


def field(seed=196):
    """An image (1, 4, N, N) of points with noise of the resolution of the beam, and the truth."""
    rng = np.random.default_rng(seed)
    flux = SIGMA * 4 * (1 - rng.uniform(size=COUNT)) ** (-1 / 1.2)  # from 4 sigma, slope -2.2
    flux = np.minimum(flux, 5.0)
    y, x = rng.uniform(20, PIXELS - 20, (2, COUNT))
    folding = Folding((PIXELS, PIXELS))
    white = restored(rng.standard_normal((PIXELS, PIXELS)), BEAM, PIXEL, folding)
    image = SIGMA * white / white.std()
    a, b, c = shape()
    for f, row, column in zip(flux, y, x, strict=True):
        dy, dx = (np.arange(int(at) - 24, int(at) + 25) for at in (row, column))
        keep = [(d >= 0) & (d < PIXELS) for d in (dy, dx)]
        dy, dx = dy[keep[0]], dx[keep[1]]
        s, t = dy[:, None] - row, dx - column
        image[dy[0] : dy[-1] + 1, dx[0] : dx[-1] + 1] += f * np.exp(-0.5 * (a * s**2 + 2 * b * s * t + c * t**2))
    centre = direction("08h13m36.0s +48d13m03s")
    data = np.zeros((1, 4, PIXELS, PIXELS))
    data[0, 0] = image
    psf = Psf.gaussian(*(angle * u.rad for angle in BEAM))
    cube = StokesCube(data, [150] * u.MHz, PIXEL * u.rad, "Jy/beam", centre, psf, constants="data")
    ra, dec = cube.grid.at(y, x)
    stokes = np.zeros((COUNT, 4))
    stokes[:, 0] = flux
    names = tuple(f"t{k}" for k in range(COUNT))
    return cube, PointSky(names=names, ra_rad=ra, dec_rad=dec, stokes_jy=stokes)


def shape():
    """The beam as a, b, c of a Gaussian in pixels; x to the west."""
    major, minor, angle = BEAM
    c, s = np.cos(angle), np.sin(angle)
    scale = 8 * np.log(2) * PIXEL**2
    along, across = scale / major**2, scale / minor**2
    return along * c**2 + across * s**2, -(along - across) * s * c, along * s**2 + across * c**2


def judged(found, truth, seconds, name):
    """One row of the table."""
    near = 30 * u.arcsec
    at10 = found.against(truth, near, 10 * SIGMA * u.Jy)
    whole = found.against(truth, near)
    east, north = np.rad2deg(at10.offset_rad).T * 3600
    row = [
        name, len(found), f"{100 * at10.completeness:.2f} %", f"{100 * whole.completeness:.1f} %",
        f"{100 * whole.false:.2f} %", f"{100 * at10.bias:+.2f} %", f"{100 * (np.mean(at10.flux_ratio) - 1):+.2f} %",
        f"{np.median(np.abs(at10.flux_ratio - 1)) * 100:.2f} %", f"{np.median(np.hypot(east, north)):.2f}",
        f"{np.median(east):+.3f}, {np.median(north):+.3f}", f"{seconds:.2f}",
    ]  # fmt: skip
    print("| " + " | ".join(map(str, row)) + " |")


def by_bdsf(path):
    """Places and total fluxes of bdsf's Gaussians, and the seconds it took."""
    import bdsf

    begin = time.perf_counter()
    options = {"thresh_pix": 5.0, "thresh_isl": 3.0, "quiet": True, "frequency": 150e6, "ncores": 1}
    image = bdsf.process_image(
        str(path), beam=(BEAM[0] * 57.2957795, BEAM[1] * 57.2957795, BEAM[2] * 57.2957795), **options
    )
    seconds = time.perf_counter() - begin
    return np.array([[g.centre_sky[0], g.centre_sky[1], g.total_flux] for g in image.gaussians]), seconds


def by_photutils(cube):
    """Places and fluxes of photutils' finder and its fits of the beam, and the seconds it took."""
    from photutils.detection import DAOStarFinder
    from photutils.psf import GaussianPSF, PSFPhotometry, SourceGrouper

    begin = time.perf_counter()
    image = cube.data[0, 0]
    major, minor = (float(width / PIXEL) for width in BEAM[:2])
    finder = DAOStarFinder(threshold=5 * SIGMA, fwhm=minor, ratio=minor / major, theta=np.rad2deg(BEAM[2]) + 90)
    model = GaussianPSF(x_fwhm=minor, y_fwhm=major, theta=BEAM[2] * u.rad)
    fit = PSFPhotometry(model, (7, 7), finder=finder, grouper=SourceGrouper(major), aperture_radius=major / 2)
    found = fit(image, error=np.full(image.shape, SIGMA))
    area = np.pi / (4 * np.log(2)) * major * minor
    ra, dec = cube.grid.at(np.asarray(found["y_fit"]), np.asarray(found["x_fit"]))
    rows = np.rad2deg(np.stack([ra, dec], axis=1))
    return np.column_stack([rows, np.asarray(found["flux_fit"]) / area]), time.perf_counter() - begin


def as_ours(found, rows):
    """A catalogue like ours of places in deg and fluxes (n, 3)."""
    stokes, none = np.zeros((1, len(rows), 4)), np.zeros(len(rows))
    stokes[0, :, 0] = rows[:, 2]
    return replace(
        found, ra_rad=np.deg2rad(rows[:, 0]), dec_rad=np.deg2rad(rows[:, 1]), stokes_jy=stokes,
        place_error_rad=np.zeros((len(rows), 2)), error_jy=0 * stokes, peak_jy=none, major_rad=none, minor_rad=none,
        angle_rad=none, rms=none, island=none.astype(int), fitted=none == 0,
    )  # fmt: skip


def main():
    cube, truth = field()
    print("| " + " | ".join(HEADS) + " |\n|" + "---|" * len(HEADS))
    SourceFinder().find(cube)
    for _ in range(2):
        begin = time.perf_counter()
        found = SourceFinder().find(cube)
        judged(found, truth, time.perf_counter() - begin, "ours")
        if "--photutils" in sys.argv:
            rows, seconds = by_photutils(cube)
            judged(as_ours(found, rows), truth, seconds, "photutils")
        if "--bdsf" in sys.argv:
            with tempfile.TemporaryDirectory() as folder:
                cube.write(Path(folder) / "image.fits")
                os.chdir(folder)  # where it writes
                rows, seconds = by_bdsf(Path(folder) / "image.fits")
            judged(as_ours(found, rows), truth, seconds, "bdsf")


if __name__ == "__main__":
    warnings.simplefilter("ignore")
    main()
