"""StokesCube: images of the four Stokes parameters in every channel, with coordinates, unit and PSF."""

from __future__ import annotations

import os
from dataclasses import dataclass
from typing import Any, Literal, get_args

import numpy as np

from instrument.checked import checked
from instrument.errors import InputError
from instrument.image.blanks import without_constants
from instrument.image.channels import channel_index, in_band
from instrument.image.common_beam import at_common_beam
from instrument.image.cube_file import write_cube
from instrument.image.psf import Psf
from instrument.observe.grid import ImageGrid
from instrument.shown import short_repr
from instrument.sky.image import ImageSky
from instrument.sky.made import jy_per_k
from instrument.units import Direction, Float, one_si, to_si

Unit = Literal["Jy/beam", "Jy/pixel", "K"]
SolidAngle = Literal["fit", "sum"]


@checked
@dataclass(frozen=True, eq=False, init=False)
class StokesCube:
    """Stokes I, Q, U, V images, real (F, 4, Ny, Nx); x runs to the west, y to the north; NaN is no data.

    `StokesCube(data=array, frequencies=freqs, pixel=0.5 * u.arcmin, unit="K")` makes one from anywhere. The centre is
    pixel (Ny // 2, Nx // 2). Channels stay in the order given; `sorted()` puts them in order of frequency. A channel
    or a rim of one value (0, -999) is no data: it becomes NaN and is said, unless `constants` is "data".
    Masked voxels become NaN; a `Quantity` is turned into `unit`.
    """

    __repr__ = short_repr
    data: Float
    freq_hz: Float
    pixel_rad: float
    unit: Unit
    centre: Direction | None
    psf: Psf | None

    def __init__(
        self,
        data: Any,
        frequencies: Any,
        pixel: Any,
        unit: Unit = "Jy/beam",
        centre: Direction | None = None,
        psf: Psf | None = None,
        constants: Literal["no data", "data"] = "no data",
    ) -> None:
        put = object.__setattr__
        if unit not in get_args(Unit):
            raise InputError(f"unit = {unit!r} is not one of {', '.join(map(repr, get_args(Unit)))}: say which it is")
        cube = _images(data, unit)
        if cube.ndim != 4 or cube.shape[1] != 4 or not cube.size:
            raise InputError(f"data has shape {cube.shape}, needed (channels, 4 Stokes, y, x)")
        freq = np.atleast_1d(np.asarray(to_si(frequencies, "Hz", "frequencies"), float))
        if len(freq) != len(cube):
            raise InputError(f"{len(cube)} channels but {len(freq)} frequencies")
        if (wrong := ~(np.isfinite(freq) & (freq > 0))).any():
            raise InputError(f"frequencies of {listing(wrong)} are {show(freq[wrong])} Hz: needed finite and above 0")
        step = one_si(pixel, "rad", "pixel")
        if not step > 0:
            raise InputError(f"pixel = {pixel} is not above 0")
        if (span := max(cube.shape[2:]) * step) > np.pi and max(cube.shape[2:]) > 1:
            raise InputError(f"pixel = {pixel}: the images span {np.rad2deg(span):.4g} deg, more than half the sky")
        if constants not in ("no data", "data"):
            raise InputError(f"constants = {constants!r} is not 'no data' or 'data'")
        put(self, "data", without_constants(cube) if constants == "no data" else cube)
        put(self, "freq_hz", freq)
        put(self, "pixel_rad", step)
        put(self, "unit", unit)
        put(self, "centre", centre)
        put(self, "psf", psf and psf.of(len(cube)))

    @property
    def grid(self) -> ImageGrid:
        """The pixels on the sky."""
        return ImageGrid.of(self.data.shape, self.pixel_rad, self.centre)

    @property
    def wcs(self) -> Any:
        """World coordinates of the axes (x, y, Stokes, frequency), SIN projection about the centre.

        The frequency axis is even, with the mean step; uneven or unsorted channels are in `freq_hz`. A centre that is
        not known is at 0, 0.
        """
        from astropy.wcs import WCS

        out = WCS(naxis=4)
        # 1 Hz where there is no spacing: an axis of step 0 has no coordinates
        spacing = (float(np.diff(self.freq_hz).mean()) if len(self.freq_hz) > 1 else 0.0) or 1.0
        axes = (*self.grid.fits_axes, ("STOKES", 1.0, 1.0, 1.0), ("FREQ", float(self.freq_hz[0]), spacing, 1.0))
        out.wcs.ctype, out.wcs.crval, out.wcs.cdelt, out.wcs.crpix = zip(*axes, strict=True)
        out.wcs.cunit, out.wcs.radesys = ["deg", "deg", "", "Hz"], "ICRS"
        return out

    def sky(self) -> ImageSky:
        """The cube as a sky for scenes: every pixel a point of its Jy; from Jy/pixel, or K by its solid angle.

        From Jy/beam where the beam is known: the sky is then the image as it is blurred, which the plan says.
        """
        from astropy import units as u

        if self.unit == "Jy/beam":
            if self.psf is None:
                raise InputError(
                    "a cube in Jy/beam is no sky: its pixels are blurred, and by what beam is not known; give one in "
                    "Jy/pixel or K, or its psf=Psf.gaussian(major, minor, angle)"
                )
            widths = np.rad2deg([np.nanmin(self.psf.minor_rad), np.nanmax(self.psf.major_rad)]) * 60
            text = f"its pixels are blurred already, by a beam of {widths[0]:.3g}' to {widths[1]:.3g}'"
            return self.to_kelvin().sky().with_fields(remarks=(("image", text),))
        jansky = np.asarray(self.data, float)
        if self.unit == "K":
            jansky = jansky * jy_per_k(self.freq_hz, self.pixel_rad**2)[:, None, None, None]
        return ImageSky(grid=self.grid, stokes=jansky, frequencies=self.freq_hz * u.Hz)

    def solid_angle_sr(self, of: SolidAngle = "fit") -> Float:
        """Solid angle of the PSF of each channel, sr (F,): of the Gaussian fitted to it, or of the sum of its image.

        The sum is that of all sidelobes in the image. It tells what a cube does to diffuse emission only where the
        array sees that: the sum of a PSF of natural weights without the zero spacing tends to 0 in a large image.
        """
        if of not in get_args(SolidAngle):
            raise InputError(f"of = {of!r} is not one of {', '.join(map(repr, get_args(SolidAngle)))}")
        psf = self.psf
        if psf is None or (of == "sum" and psf.data is None):
            raise InputError(
                f"the solid angle {of!r} needs {'the image of the PSF' if psf else 'a PSF'}, which this cube has "
                "not: images of an Imager have both, a FITS file widths alone"
            )
        if of == "fit" or psf.data is None:
            return psf.solid_angle_sr
        return np.asarray(psf.data.sum(axis=(1, 2)) * self.pixel_rad**2)

    def to_kelvin(self, solid_angle: SolidAngle = "fit") -> StokesCube:
        """The same in K, Rayleigh-Jeans: c² / (2 k nu² Omega), the solid angle of each channel's PSF, or of a pixel.

        `solid_angle` is that of the Gaussian "fit", or of the "sum" of the image of the PSF; see `solid_angle_sr`.
        Raises `InputError` without a PSF and where a channel that has data has none: a width of 0 or NaN, a sum of 0.
        """
        if self.unit == "K":
            return self
        if self.unit == "Jy/beam" and self.psf is None:
            raise InputError(
                "a cube in Jy/beam needs its PSF to become K: give psf=Psf.gaussian(major, minor, angle), its widths"
            )
        omega = self.solid_angle_sr(solid_angle) if self.unit == "Jy/beam" else self.pixel_rad**2
        omega = np.broadcast_to(omega, len(self.data))
        usable = np.isfinite(omega) & (omega > 0)
        wrong = np.array([not ok and not np.isnan(x).all() for ok, x in zip(usable, self.data, strict=True)])
        if wrong.any():
            raise InputError(
                f"the solid angle of the PSF in {listing(wrong)} is {show(omega[wrong])} sr: it has no K; "
                "leave these channels out, or give psf=Psf.gaussian(major, minor, angle)"
            )
        factor = 1 / jy_per_k(self.freq_hz, np.where(usable, omega, np.nan))
        exact = np.result_type(self.data, np.float32)  # a float32 cube stays one
        return self._with(data=self.data * factor[:, None, None, None].astype(exact), unit="K")

    def channels(self, keep: Any) -> StokesCube:
        """Some of the channels: indices in the order wanted, a slice, or (F,) booleans."""
        index = channel_index(keep, len(self.data))
        if not len(index):
            raise InputError("no channel is chosen: a cube has at least one")
        psf = self.psf and Psf(
            None if self.psf.data is None else self.psf.data[index],
            *(x[index] for x in (self.psf.major_rad, self.psf.minor_rad, self.psf.angle_rad, self.psf.residual)),
        )
        return self._with(data=self.data[index], freq_hz=self.freq_hz[index], psf=psf)

    def select(self, channels: Any = None, band: Any = None) -> StokesCube:
        """Some of the channels, as `channels` takes them, and of these what lies in `band`, both ends included.

        `band` is two frequencies with their unit, or text: "134 MHz,166 MHz".
        """
        chosen = self if channels is None else self.channels(channels)
        return chosen if band is None else chosen.channels(in_band(chosen.freq_hz, band))

    def flagged(self, channels: Any) -> StokesCube:
        """The same without data (NaN) in some channels: indices, a slice, or (F,) booleans."""
        index = channel_index(channels, len(self.data))
        data = np.array(self.data, np.result_type(self.data, np.float32))
        data[index] = np.nan
        return self._with(data=data)

    def sorted(self) -> StokesCube:
        """The channels in order of frequency, low to high; the cube itself where they are."""
        ascending = bool((np.diff(self.freq_hz) >= 0).all())
        return self if ascending else self.channels(np.argsort(self.freq_hz, kind="stable"))

    def with_data(self, data: Any) -> StokesCube:
        """The same axes, unit, centre and PSF with other data (F, 4, Ny, Nx)."""
        if np.shape(data) != self.data.shape:
            raise InputError(f"data has shape {np.shape(data)}, needed that of the cube, {self.data.shape}")
        return self._with(data=data)

    def with_psf(self, psf: Psf | None) -> StokesCube:
        """The same images with another PSF, known better than by those who made them."""
        return self._with(psf=psf)

    def at_common_beam(self, size: Any = None) -> StokesCube:
        """The same at one resolution in every channel: blurred to one Gaussian beam, Jy/beam of a point kept.

        `size` is a width, three (major, minor, angle), text ("4 arcmin, 3 arcmin, 30 deg") or a `Psf` of one beam; the
        largest beam of the cube unless given, or a circle around all where none holds the others. Pixels without data
        stay so and weigh nothing. Raises `InputError` for channels with data and no beam, or with a larger one.
        """
        if self.psf is None:
            raise InputError("a common beam needs the beams of the cube: give psf=Psf.gaussian(major, minor, angle)")
        data, psf = at_common_beam(self.data, self.psf, self.pixel_rad, self.unit == "Jy/beam", size)
        return self.with_data(data).with_psf(psf)

    def _with(self, **changes: Any) -> StokesCube:
        from astropy import units as u

        given = {"data": self.data, "unit": self.unit, "centre": self.centre, "psf": self.psf, **changes}
        freq = given.pop("freq_hz", self.freq_hz)
        # what is one value here was looked at when the cube was made
        return StokesCube(frequencies=freq * u.Hz, pixel=self.pixel_rad * u.rad, constants="data", **given)

    def write(self, path: str | os.PathLike[str], overwrite: bool = False) -> None:
        """Write a FITS cube in float32 (Stokes and frequency axes, IAU polarization, restoring beam), whole or not.

        Beams of many channels are in a table BEAMS; frequencies that are not even make an axis FREQ-TAB with its table
        (FITS paper III), which programs that know it not refuse rather than misread. `read_cube` reads both back.
        """
        write_cube(self, path, overwrite)


def _images(data: Any, unit: str) -> Any:
    """Real numbers of any shape in the unit of the cube: a `Quantity` is turned into it, masked values become NaN."""
    given = getattr(data, "unit", None)
    if given is not None:
        from astropy import units as u

        try:
            data = data.to_value(u.Unit(unit))
        except u.UnitConversionError:
            raise InputError(f"data in '{given}' cannot be turned into the unit of the cube, '{unit}'") from None
    images, mask = np.asarray(data), getattr(data, "mask", False)
    if images.dtype.kind not in "fiu":
        raise InputError(f"data holds {images.dtype}, needed real numbers")
    if np.any(mask):
        images = np.array(images, np.result_type(images, np.float32))
        images[mask] = np.nan
    return images


def listing(wrong: Any) -> str:
    """Channels that are wrong (F,) in words: "channels 0, 3, 4 and 12 more"."""
    which = np.flatnonzero(wrong).tolist()
    more = f" and {len(which) - 4} more" if len(which) > 4 else ""
    return f"channel{'s' if len(which) > 1 else ''} {', '.join(map(str, which[:4]))}{more}"


def show(values: Any) -> str:
    """Up to four of some values."""
    return ", ".join(f"{v:.6g}" for v in np.asarray(values)[:4]) + (", ..." if len(values) > 4 else "")
