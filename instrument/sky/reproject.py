"""Images on another grid: splines of the brightness, flux kept, Q and U carried from one local north to another."""

from __future__ import annotations

from typing import Any

import numpy as np

from instrument.errors import InputError
from instrument.observe.directions import lmn, tangents
from instrument.observe.grid import ImageGrid
from instrument.sky.image import ImageSky
from instrument.units import Complex, Float, unit_vectors

BEST, OTHER = 5, 3  # orders of splines: the one that is taken, and the one whose distance from it tells the error
POLE = np.array([0.0, 0.0, 1.0])  # of ICRS
STEEP = 1e-2  # of the largest brightness: splines further apart than that do not know what lies between pixels


def angle_of(axis: Float, ra_rad: Float, dec_rad: Float) -> Float:
    """Position angle (S,), ICRS north through east, in which an axis (unit vector, ICRS) is seen from directions (S,).

    Q + iU relative to the north of a system with that pole is exp(-2i angle) times Q + iU relative to ICRS north.
    """
    east, north = tangents(ra_rad, dec_rad)
    return np.arctan2(east @ axis, north @ axis)


def solid_angles(grid: ImageGrid) -> Float:
    """Solid angle of every pixel, sr (Ny, Nx): dl dm / n."""
    l, m = np.meshgrid(grid.east, grid.north)
    return np.asarray(grid.pixel**2 / np.sqrt(1 - l**2 - m**2))


def reprojected(sky: ImageSky, grid: ImageGrid) -> ImageSky:
    """A sky of pixels on another grid, (F, 4, Ny, Nx) in Jy per pixel; what lies beyond its images is 0.

    Brightness per steradian between pixels is that of quintic splines; how far cubic ones are from it, and the flux
    that is lost or gained, are among its `remarks`. Q and U go through axes of the first grid, which have no pole.
    Raises `InputError` for a grid without a centre.
    """
    if sky.grid.centre is None or grid.centre is None:
        raise InputError("reprojection needs the centres of both grids: give ImageGrid(..., centre=...)")
    grid.on_the_sky()
    ra, dec = grid.directions()
    where = lmn(unit_vectors(ra, dec), sky.grid.centre)
    (ny, nx), step = sky.grid.pixels, sky.grid.pixel
    y, x = ny // 2 + where[:, 1] / step, nx // 2 - where[:, 0] / step
    inside = (np.abs(y - (ny - 1) / 2) <= ny / 2) & (np.abs(x - (nx - 1) / 2) <= nx / 2)
    seen = ((where[:, 2] > -1) & inside).reshape(grid.pixels)  # neither behind nor beyond the rim
    axis = tangents(*(np.array([a]) for a in sky.grid.centre))[1][0]
    before, after = angle_of(axis, *sky.grid.directions()), angle_of(axis, ra, dec)
    areas, new = solid_angles(sky.grid), solid_angles(grid)
    out = np.zeros((len(sky.stokes), 4, *grid.pixels))
    worst = 0.0
    for planes, made in zip(sky.stokes, out, strict=True):
        smooth = turned(planes / areas, -before)
        found = [np.stack([_spline(p, (y, x), order) for p in smooth]) for order in (BEST, OTHER)]
        best, other = (np.where(seen, turned(f.reshape(4, *grid.pixels), after), 0) for f in found)
        made[:] = best * new
        worst = max(worst, float(np.abs(best - other).max() / (np.abs(best).max() or 1.0)))
    return sky.with_fields(grid=grid, stokes=out, remarks=(*sky.remarks, ("reprojection", _said(sky, out, worst))))


def turned(planes: Float, angle_rad: Float) -> Float:
    """Stokes images (4, Ny, Nx) whose Q + iU is times exp(2i angle), angles (Ny Nx,)."""
    out = np.array(planes)
    linear: Complex = (planes[1] + 1j * planes[2]) * np.exp(2j * angle_rad.reshape(planes.shape[1:]))
    out[1], out[2] = linear.real, linear.imag
    return out


def _spline(image: Float, places: tuple[Float, Float], order: int) -> Any:
    from scipy.ndimage import map_coordinates

    if not image.any():
        return np.zeros(len(places[0]))
    return map_coordinates(image, places, order=order, mode="mirror")  # a rim is no edge: zeros beyond it would ring


def _said(sky: ImageSky, out: Float, worst: float) -> str:
    """Size of the old grid, the distance of splines, and what became of the flux."""
    text = f"splines of {sky.grid} about {sky.grid.centre}: within {worst:.1e} of the largest brightness"
    if worst > STEEP:
        text += ", for its pixels do not resolve it: take reproject = false"
    old, new = float(np.abs(sky.stokes[:, 0]).sum()), float(np.abs(out[:, 0]).sum())
    if old:
        text += f"; {100 * (new / old - 1):+.2g} % of the flux in |I|"
    return text
