"""HEALPix maps on a grid: bilinear in the map, polarization carried from the map's north to that of ICRS."""

from __future__ import annotations

from typing import Any, Literal

import numpy as np

from instrument.errors import InputError
from instrument.observe.directions import tangents
from instrument.observe.grid import ImageGrid
from instrument.sky.reproject import POLE, angle_of
from instrument.units import Direction, Float, Int, unit_vectors

Frame = Literal["galactic", "icrs"]
Convention = Literal["IAU", "COSMO"]


def healpix_of(count: int, nested: bool) -> Any:
    """What knows the pixels of maps of so many; raises `InputError` without astropy-healpix, or for another number."""
    try:
        from astropy_healpix import HEALPix
    except ImportError:
        raise InputError("HEALPix maps need astropy-healpix: pip install 'instrument[healpix]'") from None
    nside = round((count / 12) ** 0.5)
    if 12 * nside**2 != count or nside & (nside - 1):
        raise InputError(f"a map of {count} pixels is no HEALPix map: 12 nside² with nside a power of 2")
    return HEALPix(nside=nside, order="nested" if nested else "ring")


def axes_of(frame: Frame) -> Float:
    """Rows (3, 3): ICRS unit vectors of the x, y, z axes of a frame; z is its north pole."""
    if frame == "icrs":
        return np.eye(3)
    from astropy.coordinates import Galactic, SkyCoord

    axes = SkyCoord([0, 90, 0], [0, 0, 90], unit="deg", frame=Galactic()).icrs
    return np.asarray(axes.cartesian.xyz.value.T)


def on_grid(
    maps: Float, grid: ImageGrid, nested: bool = False, frame: Frame = "galactic", convention: Convention = "COSMO"
) -> tuple[Float, float]:
    """Stokes I, Q, U, V of a grid (4, Ny, Nx), in the unit of the maps (1 to 4, Npix), and what between pixels is open.

    Brightness is bilinear in the four pixels around; Q and U of these are turned to axes without a pole near by first,
    and to ICRS north at the end. U of `convention` "COSMO" has the other sign. The second number is the rms distance
    of the same from a map of half the resolution, a third of it, over the rms: the error of a second-order formula.
    """
    if grid.centre is None:
        raise InputError("a map is put on a grid with a centre: give ImageGrid(..., centre=...)")
    planes = np.zeros((4, maps.shape[1]))
    planes[: len(maps)] = maps
    if convention == "COSMO":
        planes[2] *= -1
    fine = _sampled(planes, grid, grid.centre, nested, frame)
    pixels = healpix_of(maps.shape[1], nested)
    if pixels.nside < 2:
        return fine, 1.0
    coarse = _sampled(_halved(planes, pixels), grid, grid.centre, True, frame)
    scale = np.sqrt(np.mean(fine**2)) or 1.0
    return fine, float(np.sqrt(np.mean((fine - coarse) ** 2)) / 3 / scale)


def _halved(planes: Float, pixels: Any) -> Float:
    """A map of half the resolution, nested: the mean of four pixels."""
    order = np.arange(planes.shape[1])
    nested = planes if pixels.order == "nested" else planes[:, pixels.nested_to_ring(order)]
    return np.asarray(nested.reshape(len(planes), -1, 4).mean(axis=2))


def _sampled(planes: Float, grid: ImageGrid, centre: Direction, nested: bool, frame: Frame) -> Float:
    from astropy import units as u

    pixels, axes = healpix_of(planes.shape[1], nested), axes_of(frame)
    ra, dec = grid.directions()
    own = unit_vectors(ra, dec) @ axes.T
    # a longitude below 0 has no weights next to the poles in astropy-healpix 2.0
    lon, lat = np.arctan2(own[:, 1], own[:, 0]) % (2 * np.pi), np.arctan2(own[:, 2], np.hypot(own[:, 0], own[:, 1]))
    near, weight = pixels.bilinear_interpolation_weights(lon * u.rad, lat * u.rad)  # (4, S) both
    used, back = np.unique(near, return_inverse=True)
    values = planes[:, used]
    bad = ~np.isfinite(values)
    if bad.any():
        raise InputError(f"pixel {int(used[np.argwhere(bad)[0][1]])} of the map has no data: the field leaves the map")
    # through axes that have no pole in the field: the north of its centre
    smooth = tangents(*(np.array([a]) for a in centre))[1][0]
    linear = (values[1] + 1j * values[2]) * np.exp(-2j * _of_pixels(pixels, used, axes, smooth))
    part = back.reshape(near.shape)
    q_u = (linear[part] * weight).sum(axis=0) * np.exp(2j * angle_of(smooth, ra, dec))
    out = (values[:, part] * weight).sum(axis=1)
    out[1], out[2] = q_u.real, q_u.imag
    return np.asarray(out.reshape(4, *grid.pixels))


def _of_pixels(pixels: Any, used: Int, axes: Float, smooth: Float) -> Float:
    """Angle (S,) from the map's north, through east, in which an axis (ICRS) is seen from some of its pixels."""
    lon, lat = pixels.healpix_to_lonlat(used)
    return angle_of(axes @ smooth, np.asarray(lon.rad), np.asarray(lat.rad))


def north_of(frame: Frame) -> Float:
    """The pole of a frame, ICRS unit vector."""
    return POLE if frame == "icrs" else axes_of(frame)[2]
