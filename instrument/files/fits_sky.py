"""The grid on the sky of a FITS image: pixel, centre, frame, and whether pixels lie where they should."""

from __future__ import annotations

import warnings
from dataclasses import dataclass
from typing import Any

import numpy as np

from instrument.errors import FileError
from instrument.files.fits_axes import PARALLEL, Notes, Role, number, scale_of, turned_round
from instrument.files.h5parm import one_line
from instrument.observe.directions import lmn
from instrument.units import Direction

OFF = 0.05  # of half the diagonal: farther from a SIN projection an image is refused


@dataclass(frozen=True)
class Grid:
    """The grid on the sky of an image: (Ny, Nx), pixel, centre, and whether x or y must be turned round."""

    shape: tuple[int, int]
    pixel_rad: float
    centre: Direction | None
    flip_x: bool
    flip_y: bool


def grid_of(file: str, header: Any, axes: dict[Role, int], notes: Notes) -> Grid:
    """Pixel, size and centre of the images; notes where pixels are not where a SIN projection has them.

    The centre is what lies at pixel (Ny // 2, Nx // 2), whatever the reference pixel and the projection are.
    """
    from astropy.wcs import WCS

    plain = _celestial(file, header, axes, notes)
    nx, ny = (int(header[f"NAXIS{axes[role]}"]) for role in ("x", "y"))
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # of old keywords that astropy mends
            wcs = WCS(plain)
            wcs.wcs.set()
            dx, dy = (float(s) for s in np.deg2rad(np.diag(wcs.pixel_scale_matrix)))
            flip_x, flip_y = dx > 0, dy < 0
            _checked(file, header, axes, (nx, ny), (dx, dy))
            # centre, corners, middles of the edges
            x = np.array([nx // 2, 0, 0, 0, nx // 2, nx // 2, nx - 1, nx - 1, nx - 1])
            y = np.array([ny // 2, 0, ny // 2, ny - 1, 0, ny - 1, 0, ny // 2, ny - 1])
            sky = wcs.pixel_to_world(nx - 1 - x if flip_x else x, ny - 1 - y if flip_y else y).icrs
    except FileError:
        raise
    except Exception as error:  # wcslib has many of its own
        raise FileError(f"{file}: the coordinates on the sky cannot be read: {one_line(error)}") from None
    ra, dec = np.asarray(sky.ra.rad), np.asarray(sky.dec.rad)
    if not np.isfinite([ra[0], dec[0]]).all():
        raise FileError(f"{file}: the centre pixel is not on the sky: CRPIX, CRVAL or CDELT are wrong")
    centre = Direction(float(ra[0]), float(dec[0]))
    vectors = np.stack([np.cos(dec) * np.cos(ra), np.cos(dec) * np.sin(ra), np.sin(dec)], axis=-1)
    found = lmn(vectors, centre)[:, :2] / abs(dy)
    off = float(np.nanmax(np.hypot(found[:, 0] + (x - nx // 2), found[:, 1] - (y - ny // 2))))
    what = f"pixels lie up to {off:.2g} pixels from where a SIN projection about the centre has them"
    if off > OFF * np.hypot(nx, ny) / 2 and off > 0.5:
        raise FileError(f"{file}: {what}: regrid to one with the reference pixel in the middle, north up")
    if off > 0.5:
        notes.warned.append(f"{file}: {what}")
    return Grid((ny, nx), abs(dy), None if header.get("NOCENTRE") is True else centre, flip_x, flip_y)


def _celestial(file: str, header: Any, axes: dict[Role, int], notes: Notes) -> Any:
    """A header of the two axes on the sky alone, with what older programs wrote in the words of today."""
    from astropy.io.fits import Header

    plain = Header()
    sign = -1.0 if turned_round(file, header, axes) else 1.0
    for new, axis in ((1, axes["x"]), (2, axes["y"])):
        ctype = str(header[f"CTYPE{axis}"]).strip().upper()
        if len(ctype) < 8:
            if new == 1:
                notes.warned.append(f"{file}: CTYPE{axis} = '{ctype}' names no projection: taken as SIN")
            ctype = f"{ctype:-<5}SIN"
        if len(ctype) > 8:  # such as RA---TAN-SIP
            notes.unused.append((f"CTYPE{axis} = '{ctype}'", f"the distortion {ctype[8:].strip('-')} is not undone"))
        plain[f"CTYPE{new}"], plain[f"CDELT{new}"] = ctype[:8], sign * scale_of(file, header, axis, None)
        unit = str(header.get(f"CUNIT{axis}", "")).strip().lower()
        plain[f"CUNIT{new}"] = "deg" if unit in ("", "degree", "degrees") else unit
        for key in ("CRVAL", "CRPIX"):
            plain[f"{key}{new}"] = number(file, header, f"{key}{axis}")
        plain.update({f"PV{new}_{m}": header[f"PV{axis}_{m}"] for m in range(5) if f"PV{axis}_{m}" in header})
    plain.update({k: header[k] for k in ("RADESYS", "RADECSYS", "EQUINOX", "LONPOLE", "LATPOLE") if k in header})
    # AIPS, MIRIAD: before 1984 means FK4, as for EQUINOX; some write 0 where they do not know
    if "EQUINOX" not in header and number(file, header, "EPOCH", 0.0):
        plain["EQUINOX"] = number(file, header, "EPOCH")
    return plain


def _checked(file: str, header: Any, axes: dict[Role, int], size: tuple[int, int], step: tuple[float, float]) -> None:
    """Raises `FileError` for pixels that are not square, and for an image that spans more than the sky."""
    if abs(abs(step[0]) - abs(step[1])) > PARALLEL * abs(step[1]):
        sizes = " x ".join(f"{60 * abs(np.rad2deg(d)):.6g}'" for d in step)
        raise FileError(f"{file}: pixels are {sizes} (axes {axes['x']} and {axes['y']}): regrid to square ones")
    span = max(size) * abs(step[1])
    if span > np.pi:
        axis = axes["x" if size[0] >= size[1] else "y"]
        pixel = f"{max(size)} pixels of {np.rad2deg(abs(step[1])):.6g} deg span {np.rad2deg(span):.6g} deg"
        unit = header.get(f"CUNIT{axis}")
        said = f"CUNIT{axis} is missing: is CDELT{axis} in arcsec?" if not unit else f"CUNIT{axis} = '{unit}' is wrong"
        raise FileError(f"{file}: {pixel}, more than half the sky; {said} Write CUNIT and CDELT as they are")
