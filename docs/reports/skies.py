"""Skies of pixels measured: the Galaxy against its recipe, images and HEALPix maps on other grids.

python docs/reports/skies.py          (the Galaxy at full size: 161 channels of 480 x 480, 30 s for a seed)
python docs/reports/skies.py --quick  (a quarter of the pixels)

What it prints is skies.md.
"""

import sys

import numpy as np
from astropy import units as u

from instrument.observe.directions import LIGHT, tangents
from instrument.observe.grid import ImageGrid
from instrument.sky.galaxy import Galaxy
from instrument.sky.healpix import axes_of, on_grid
from instrument.sky.image import ImageSky
from instrument.sky.reproject import reprojected, solid_angles
from instrument.units import Direction, unit_vectors

DEPTHS = (-5, -3, -1.5, 0, 1, 2, 5, 8)
FREQ = np.linspace(134e6, 166e6, 161)
AT = Direction(2.15, 0.84)


def slope(image, pixel_rad, fwhm_rad):
    """Slope of the angular power of Q + iU between 40 and 300 wavelengths, the beam divided out."""
    uv = np.hypot(*np.meshgrid(*[np.fft.fftfreq(len(image), pixel_rad)] * 2))
    power = np.abs(np.fft.fft2(image)) ** 2 * np.exp((np.pi * fwhm_rad * uv) ** 2 / (2 * np.log(2)))
    ring = np.digitize(uv, np.geomspace(40, 300, 9))
    points = [(uv[ring == k].mean(), power[ring == k].mean()) for k in range(1, 9)]
    return np.polyfit(*np.log(points).T, 1)[0]


def galaxy(seed, pixels, pixel):
    """A row of the table: with noise and masks, as in the recipe."""
    noisy = Galaxy(pixels=pixels, pixel=pixel, seed=seed, noise=0.52 * u.K, discs=30)
    kelvin = np.stack([noisy.kelvin(f)[1:3] for f in FREQ])
    p = (kelvin[:, 0] + 1j * kelvin[:, 1]).reshape(161, -1)
    l2 = (LIGHT / FREQ) ** 2
    fine = np.concatenate([DEPTHS, np.arange(0.8, 1.6, 0.02)])
    found = np.abs(np.exp(-2j * np.multiply.outer(fine, l2 - l2.mean())).astype(np.complex64) @ p) / 161
    peaks = found.max(axis=1)
    rms = np.sqrt(np.mean(np.abs(p) ** 2, axis=1))
    plain = Galaxy(pixels=pixels, pixel=pixel, seed=seed)
    slopes = [
        slope(np.ascontiguousarray(plain.kelvin(f)[1] + 1j * plain.kelvin(f)[2]), plain.pixel, plain.screens.fwhm)
        for f in (134e6, 150e6, 166e6)
    ]
    best = 8 + int(np.argmax(peaks[8:]))
    row = [f"{seed}", f"{peaks[best]:.2f} at {fine[best]:+.2f}", *(f"{x:.1f}" for x in peaks[:8])]
    return [*row, f"{rms.min():.2f} to {rms.max():.2f}", ", ".join(f"{s:.2f}" for s in slopes)]


def field(vectors, east, north, waves):
    """I, Q, U, V (4, S): waves of so many rad^-1 on the sphere, a tensor in the basis given."""
    rng = np.random.default_rng(7)
    k, tensor = rng.normal(size=(6, 3)), rng.normal(size=(3, 3))
    k *= waves / np.linalg.norm(k, axis=1)[:, None]
    wave = 2 + np.cos(vectors @ k.T + np.arange(6)) @ rng.normal(size=6)
    ee, nn, en = (
        np.einsum("si,ij,sj->s", a, tensor + tensor.T, b) for a, b in ((east, east), (north, north), (east, north))
    )
    return np.stack([wave, wave * (nn - ee) / 2, wave * en, wave - 2])


def on(grid, waves):
    """The field on a grid (4, Ny, Nx)."""
    ra, dec = grid.directions()
    return field(unit_vectors(ra, dec), *tangents(ra, dec), waves).reshape(4, *grid.pixels)


def moved(per_wave):
    """Largest error over the peak, and what is said, of an image with so many pixels a wave."""
    pixel = 0.005 / per_wave
    grid = ImageGrid.of((160, 160), pixel, AT)
    other = ImageGrid.of((80, 80), 0.9 * pixel, Direction(AT.ra_rad + 15.3 * pixel, AT.dec_rad - 10.7 * pixel))
    waves = 2 * np.pi / 0.005
    found = reprojected(ImageSky(grid=grid, stokes=(on(grid, waves) * solid_angles(grid))[None]), other)
    due = on(other, waves)
    error = np.abs(found.stokes[0] / solid_angles(other) - due).max() / np.abs(due).max()
    said = dict(found.remarks)["reprojection"].split("within ")[1].split(" of")[0]
    return [f"{per_wave:g}", f"{error:.1e}", said]


def mapped(nside):
    """Rms error over the rms, and what is said, of a galactic map in COSMO for waves of 12 deg."""
    from astropy_healpix import HEALPix

    pixels, axes = HEALPix(nside=nside, order="ring"), axes_of("galactic")
    lon, lat = (x.rad for x in pixels.healpix_to_lonlat(np.arange(pixels.npix)))
    maps = field(unit_vectors(lon, lat) @ axes, *(x @ axes for x in tangents(lon, lat)), 30.0)
    maps[2] *= -1
    grid = ImageGrid.of((60, 60), np.deg2rad(0.2), AT)
    found, said = on_grid(maps, grid, False, "galactic", "COSMO")
    due = on(grid, 30.0)
    return [f"{nside}", f"{np.sqrt(np.mean((found - due) ** 2) / np.mean(due**2)):.1e}", f"{said:.1e}"]


def table(head, rows):
    """A table of a page."""
    print("\n| " + " | ".join(head) + " |\n" + "|---" * len(head) + "|")
    for row in rows:
        print("| " + " | ".join(row) + " |", flush=True)


def main():
    """All tables."""
    quick = "--quick" in sys.argv
    size = (240, 1 * u.arcmin) if quick else (480, 0.5 * u.arcmin)
    print(f"# Skies of pixels\n\n`python docs/reports/skies.py{' --quick' if quick else ''}`")
    print(
        f"\nThe Galaxy: {size[0]} x {size[0]} pixels of {size[1]}, 161 channels, noise of 0.52 K, 30 discs masked; K."
    )
    head = ["seed", "peak, rad/m2", *(f"at {d}" for d in DEPTHS), "rms of P in a channel", "slope at 134, 150, 166 MHz"]
    table(head, [galaxy(seed, *size) for seed in (196, 1, 2, 3)])
    print("\nAn image of waves of 17 arcmin on another grid; errors over the peak.")
    table(["pixels a wave", "largest error", "said"], [moved(n) for n in (3, 4, 6, 8, 12, 16)])
    print("\nA HEALPix map in galactic coordinates and COSMO on a grid of ICRS, waves of 12 deg; errors over the rms.")
    table(["nside", "rms error", "said"], [mapped(n) for n in (32, 64, 128, 256, 512)])


if __name__ == "__main__":
    main()
