"""Cases of skies of pixels: other grids, HEALPix maps, generated images, sums of skies."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from instrument.jones.chain import Chain
from instrument.observe.directions import LIGHT, tangents
from instrument.observe.grid import ImageGrid
from instrument.predict.base import EVERY, Problem
from instrument.predict.choice import cheapest
from instrument.sky.galaxy import Galaxy
from instrument.sky.healpix import on_grid
from instrument.sky.image import ImageSky
from instrument.sky.points import PointSky
from instrument.sky.reproject import reprojected, solid_angles
from instrument.sky.sums import SumSky
from instrument.stress.bench import still
from instrument.stress.case import Answer, Unfit, both, case, claim, held
from instrument.units import Direction, Float, unit_vectors

TENSOR = np.array([[0.3, -1.1, 0.4], [-1.1, -0.5, 0.8], [0.4, 0.8, 1.2]])


def _field(vectors: Float, east: Float, north: Float) -> Float:
    """I, Q, U, V (4, S) smooth on the sphere: waves of 20 deg, and a tensor in a basis of tangents."""
    ee, nn, en = (np.einsum("si,ij,sj->s", a, TENSOR, b) for a, b in ((east, east), (north, north), (east, north)))
    wave = 2 + np.cos(vectors @ np.array([11.0, -9.0, 10.0]))
    return np.stack([wave, wave * (nn - ee) / 2, wave * en, np.sin(vectors @ np.array([5.0, 12.0, -7.0]))])


def _on(grid: ImageGrid) -> Float:
    ra, dec = grid.directions()
    return _field(unit_vectors(ra, dec), *tangents(ra, dec)).reshape(4, *grid.pixels)


@case("S11", "sky", "a polarized image next to a pole on another grid", "Q, U of ICRS north there, to 1e-8 of the peak")
def next_to_a_pole(_: None) -> Answer:
    """Centres half a degree from either pole, at other right ascensions, odd sides, smaller pixels."""
    answers = []
    for sign in (1, -1):
        first = ImageGrid.of((120, 131), np.deg2rad(0.1), Direction(1.0, sign * np.deg2rad(89.5)))
        second = ImageGrid.of((61, 50), np.deg2rad(0.07), Direction(3.0, sign * np.deg2rad(89.2)))
        found = reprojected(ImageSky(grid=first, stokes=(_on(first) * solid_angles(first))[None]), second)
        answers.append(held(found.stokes[0] / solid_angles(second), _on(second), 1e-8))
    return both(*answers)


@case("S12", "sky", "an image seen from a quarter of the sky away", "dark: nothing of it is there, nothing is NaN")
def from_the_side(_: None) -> Answer:
    """30 deg of pixels, about a direction 100 deg away, and the antipode; about one 20 deg away a third is left."""
    grid = ImageGrid.of((61, 61), np.deg2rad(0.5), Direction(1.0, 0.2))
    sky = ImageSky(grid=grid, stokes=_on(grid)[None])
    away = [Direction(1.0 + np.deg2rad(100), 0.2), Direction(1.0 + np.pi, -0.2)]
    dark = [reprojected(sky, grid.with_fields(centre=d.skycoord)).stokes for d in away]
    half = reprojected(sky, grid.with_fields(centre=Direction(1.0 + np.deg2rad(20), 0.2).skycoord)).stokes
    seen = float((half[0, 0] != 0).mean())
    return both(
        claim(all(np.array_equal(d, 0 * d) for d in dark), "light where there is none, or NaN"),
        claim(np.isfinite(half).all() and 0.3 < seen < 0.4, f"{seen:.2f} of the pixels are lit"),
    )


@case("S13", "sky", "a HEALPix map in galactic coordinates, COSMO", "Q, U of ICRS north in IAU, to 2e-3 at nside 128")
def galactic_map(_: None) -> Answer:
    """Ring and nested; axes by astropy's rotation of the frame, at a place where norths are 76 deg apart."""
    from astropy.coordinates import Galactic, SkyCoord

    try:
        from astropy_healpix import HEALPix
    except ImportError:
        raise Unfit("astropy-healpix is not installed") from None
    axes = np.asarray(SkyCoord([0, 90, 0], [0, 0, 90], unit="deg", frame=Galactic()).icrs.cartesian.xyz.value.T)
    grid = ImageGrid.of((21, 30), np.deg2rad(0.5), Direction(2.15, 0.84))
    answers = []
    for order in ("ring", "nested"):
        pixels = HEALPix(nside=128, order=order)
        lon, lat = (x.rad for x in pixels.healpix_to_lonlat(np.arange(pixels.npix)))
        east, north = (x @ axes for x in tangents(lon, lat))
        maps = _field(unit_vectors(lon, lat) @ axes, east, north)
        maps[2] *= -1
        found, said = on_grid(maps, grid, order == "nested", "galactic", "COSMO")
        answers += [held(found, _on(grid), 2e-3), claim(said < 4e-3, f"it says {said:.1e}")]
    return both(*answers)


@case(
    "S14",
    "sky",
    "a channel of the Galaxy alone and among others",
    "the same to the last bit; 5 K at 1.2 rad/m2 to 2e-3",
)
def galaxy(_: None) -> Answer:
    """48 x 48 pixels of 5'; the peak by the plain sum over 161 channels."""
    sky = Galaxy(pixels=48, pixel="5 arcmin", seed=7)
    placed, freq = sky.about(Direction(2.15, 0.84)), np.linspace(134e6, 166e6, 161)
    alone = placed.planes(freq[80:81])
    kelvin = np.array([sky.kelvin(f) for f in freq])
    lambda2 = (LIGHT / freq) ** 2
    p = (kelvin[:, 1] + 1j * kelvin[:, 2]).reshape(161, -1)
    depths = np.arange(-4, 8, 0.05)
    found = np.abs(np.exp(-2j * np.multiply.outer(depths, lambda2 - lambda2.mean())) @ p).max(axis=1) / 161
    area = np.deg2rad(5 / 60) ** 2
    due = kelvin[80].astype(float) * 2 * 1.380649e-23 * freq[80] ** 2 / LIGHT**2 * area * 1e26
    return both(
        claim(np.array_equal(placed.planes(freq[78:83])[2], alone[0]), "another channel changes it"),
        held(found.max(), 5.0, 2e-3),
        claim(abs(depths[np.argmax(found)] - 1.2) < 0.03, f"the peak is at {depths[np.argmax(found)]:.2f}"),
        held(alone[0], due, 1e-12),
        claim(not kelvin[:, [0, 3]].any(), "it has I or V"),
    )


@case(
    "S15",
    "sky",
    "+1e8 Jy, -1e8 Jy and an image of 1 Jy in one sum",
    "1 Jy to 1e-7: members may cancel, and differ in kind",
)
def cancelling(_: None) -> Answer:
    """At one place 1e-3 rad from the centre, on 1000 wavelengths; each member has an engine of its own."""
    at = still([[0, 0, 0], [600.0, -800.0, 0]])
    place = {"ra_rad": np.array([1e-3]), "dec_rad": np.array([0.0])}
    loud = [PointSky(names=("s",), stokes_jy=np.array([[f, 0.0, 0.0, 0.0]]), **place) for f in (1e8, -1e8)]
    stokes = np.zeros((1, 4, 3, 3))
    stokes[0, :2, 1, 1] = 1.0, 0.25
    quiet = ImageSky(grid=ImageGrid.of((3, 3), 1e-4, Direction(1e-3, 0.0)), stokes=stokes)
    sky = SumSky(skies={"plus": loud[0], "minus": loud[1], "quiet": quiet})
    problem = Problem(at, Chain(), sky, np.array([0]), np.array([1]), 1.0).of(sky)
    found = cheapest(problem, None, 0.0).ready.sums(EVERY, EVERY)[0, 0, 0]
    phase = np.exp(2j * np.pi * 600.0 * np.sin(1e-3))  # u = 0 - 600
    due = phase * np.array([[1.25, 0], [0, 0.75]])
    whole = cheapest(replace(problem), "direct", 0.0).ready.sums(EVERY, EVERY)[0, 0, 0]
    return both(held(found, due, 1e-7, condition=2e8), held(whole, due, 1e-7))
