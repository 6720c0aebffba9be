"""ImageGrid: the pixels of an image on the sky, in the SIN projection about its centre."""

from __future__ import annotations

from functools import cached_property
from typing import Annotated, Any

import numpy as np
from pydantic import BeforeValidator

from instrument.checked import checked
from instrument.component import Component
from instrument.errors import InputError
from instrument.numbers import Count
from instrument.observe.directions import offset
from instrument.units import Direction, Float, PositiveRadians, SkyDirection


def _both(value: object) -> object:
    return (value, value) if isinstance(value, int) else value


@checked
class ImageGrid(Component):
    """`pixels` (Ny, Nx), or one number for both, of `pixel` each; x runs to the west, y to the north.

    The centre is pixel (Ny // 2, Nx // 2). Lists of all pixels run along x first, as an image (Ny, Nx) does.
    """

    pixels: Annotated[tuple[Count, Count], BeforeValidator(_both)]
    pixel: PositiveRadians
    centre: SkyDirection | None = None

    @classmethod
    def of(cls, shape: tuple[int, ...], pixel_rad: float, centre: Direction | None = None) -> ImageGrid:
        """The grid of images (..., Ny, Nx) with pixels of so many rad."""
        from astropy import units as u

        return cls(pixels=(shape[-2], shape[-1]), pixel=pixel_rad * u.rad, centre=centre)

    def __len__(self) -> int:
        return self.pixels[0] * self.pixels[1]

    def __str__(self) -> str:
        return f"{self.pixels[0]} x {self.pixels[1]} pixels"

    @property
    def east(self) -> Float:
        """Direction cosine l, towards the east, of each column (Nx,)."""
        return self.along(1, np.arange(self.pixels[1]))

    @property
    def north(self) -> Float:
        """Direction cosine m, towards the north, of each row (Ny,)."""
        return self.along(0, np.arange(self.pixels[0]))

    def along(self, axis: int, index: Any) -> Float:
        """Direction cosines at places along y (axis 0, m) or x (axis 1, l), in pixels, between them too."""
        steps = np.asarray(index) - self.pixels[axis] // 2
        return np.asarray((-steps if axis else steps) * self.pixel)

    @cached_property
    def lmn(self) -> Float:
        """Direction cosines l, m and n - 1 about the centre of the image, of all pixels (Ny Nx, 3)."""
        self.on_the_sky()
        l, m = (x.ravel() for x in np.meshgrid(self.east, self.north))
        r2 = l**2 + m**2
        return np.stack([l, m, -r2 / (1 + np.sqrt(1 - r2))], axis=-1)  # n - 1 without losing digits

    def directions(self, rows: Any = slice(None)) -> tuple[Float, Float]:
        """ICRS right ascension and declination in rad of all pixels, or of some `rows` of their list, (S,) each."""
        y, x = np.divmod(np.arange(len(self))[rows] if isinstance(rows, slice) else rows, self.pixels[1])
        return self.at(y, x)

    def at(self, y: Any, x: Any) -> tuple[Float, Float]:
        """The same at places in pixels (S,); raises `InputError` where the image has no centre or leaves the sky."""
        if self.centre is None:
            raise InputError(f"an image of {self} without a centre has no directions: give centre=...")
        self.on_the_sky()
        return offset(self.centre, self.along(1, x), self.along(0, y))

    def on_the_sky(self) -> None:
        """Raise `InputError` where a corner lies beyond the sphere."""
        sides = np.array(self.pixels) * self.pixel
        if np.sum((sides / 2) ** 2) > 1:
            side = " x ".join(f"{s:.3g}" for s in dict.fromkeys(np.rad2deg(sides)))
            count = " x ".join(str(n) for n in dict.fromkeys(self.pixels))
            raise InputError(f"{count} pixels of {np.rad2deg(self.pixel):.3g} deg are {side} deg: beyond the sky")

    @property
    def fits_axes(self) -> tuple[tuple[str, float, float, float], ...]:
        """CTYPE, CRVAL, CDELT (deg) and CRPIX of x and y; a centre that is not known is at 0, 0."""
        step, centre = float(np.rad2deg(self.pixel)), self.centre or Direction(0.0, 0.0)
        ny, nx = self.pixels
        return (
            ("RA---SIN", float(np.rad2deg(centre.ra_rad)), -step, float(nx // 2 + 1)),
            ("DEC--SIN", float(np.rad2deg(centre.dec_rad)), step, float(ny // 2 + 1)),
        )

    @property
    def wcs(self) -> Any:
        """World coordinates (x, y), SIN projection about the centre, ICRS."""
        from astropy.wcs import WCS

        out = WCS(naxis=2)
        out.wcs.ctype, out.wcs.crval, out.wcs.cdelt, out.wcs.crpix = zip(*self.fits_axes, strict=True)
        out.wcs.cunit, out.wcs.radesys = ["deg", "deg"], "ICRS"
        return out
