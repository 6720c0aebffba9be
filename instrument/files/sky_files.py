"""Images and HEALPix maps in FITS files as skies of a scene, brought to the phase centre."""

from __future__ import annotations

from abc import abstractmethod
from pathlib import Path
from typing import Annotated, Any, ClassVar, Literal, Self

import numpy as np
from pydantic import BeforeValidator, PrivateAttr, model_validator

from instrument.errors import FileError, InputError, unused, warn
from instrument.files.fits import NAMES, read_cube
from instrument.files.fits_open import opened
from instrument.files_in import harmless
from instrument.image.cube import StokesCube, Unit
from instrument.memory import afford
from instrument.numbers import Count, Finite
from instrument.observe.grid import ImageGrid
from instrument.sky.base import Sky
from instrument.sky.healpix import Convention, Frame, healpix_of, on_grid
from instrument.sky.image import ImageSky
from instrument.sky.made import Side, jy_per_k
from instrument.sky.reproject import reprojected, solid_angles
from instrument.units import Direction, Float, PositiveHertz, PositiveHertzArray, PositiveRadians

SAME = 1e-3  # of a pixel: a centre that near is the phase centre
Files = Annotated[tuple[str, ...], BeforeValidator(lambda v: (v,) if isinstance(v, str) else v)]


class _FileSky(Sky):
    """A sky of pixels that is read of a file and placed about a phase centre; the latest is remembered."""

    _placed: dict[Direction, ImageSky] = PrivateAttr(default_factory=dict)

    def about(self, centre: Direction) -> ImageSky:
        """The images, about the phase centre."""
        if centre not in self._placed:
            placed = self.read(centre)
            self._placed.clear()
            self._placed[centre] = placed
        return self._placed[centre]

    @abstractmethod
    def read(self, centre: Direction) -> ImageSky:
        """The images of the file for a phase centre."""


class ImageFile(_FileSky):
    """Images of FITS files, one or several (by Stokes parameter or channel) as `read_cube` takes them.

    In Jy/pixel, in K (each pixel `pixel`² of it), or in Jy/beam with the beam, whose pixels are blurred already. They
    are brought to a grid about the phase centre, `pixels` of `pixel`, those of the file unless given; with `reproject`
    false they stay where they are, pixel by pixel. An observation asks for channels that are there; one image with a
    `temperature_index` serves all, its kelvin going as nu^index. Pixels without data are refused, or 0 with
    `blanks = "zero"`; a Stokes parameter that no file has is 0.
    """

    file: Files
    stokes: str | None = None
    unit: Unit | None = None
    frequencies: PositiveHertzArray | None = None
    temperature_index: Finite | None = None
    blanks: Literal["refuse", "zero"] = "refuse"
    reproject: bool = True
    pixels: Side | None = None
    pixel: PositiveRadians | None = None

    @model_validator(mode="after")
    def _possible(self) -> Self:
        given = [name for name in ("pixels", "pixel") if getattr(self, name) is not None]
        if given and not self.reproject:
            raise InputError(f"{given[0]} is that of another grid, and reproject = false keeps that of the file")
        return self

    def read(self, centre: Direction) -> ImageSky:
        """The images of the file for a phase centre."""
        from astropy import units as u

        freq = None if self.frequencies is None else self.frequencies * u.Hz
        cube = read_cube(*self.file, stokes=self.stokes, unit=self.unit, frequencies=freq)
        name = harmless(Path(self.file[0]).name)
        # float64 beside what was read, and once more while it is checked
        afford(24.0 * cube.data.size, f"{name}: a sky of {len(cube.data)} channels", "cut out channels or a part")
        sky = _filled(cube, self.blanks == "zero", name).sky()
        if self.temperature_index is not None:
            # Jy of a kelvin go as nu²
            sky = sky.with_fields(spectral_index=self.temperature_index + 2)
        own = sky.grid
        side = own.pixels if self.pixels is None else (self.pixels, self.pixels)
        grid = ImageGrid.of(side, own.pixel if self.pixel is None else self.pixel, centre)
        apart = 0.0 if own.centre is None else float(np.linalg.norm(own.centre.vector - centre.vector))
        same = grid.pixels == own.pixels and abs(grid.pixel / own.pixel - 1) < SAME / max(own.pixels)
        if not self.reproject or (same and apart < SAME * own.pixel):
            return sky.about(centre)
        return reprojected(sky.about(centre), grid)


def _filled(cube: StokesCube, zero: bool, file: str) -> StokesCube:
    """A cube without NaN: a Stokes parameter without any data is 0, other pixels without data too if they may."""
    blank = np.isnan(cube.data)
    if not blank.any():
        return cube
    data = np.array(cube.data)
    empty = blank.all(axis=(0, 2, 3))
    data[:, empty] = 0
    blank[:, empty] = False
    if blank.any() and not zero:
        f, s, y, x = np.argwhere(blank)[0].tolist()
        where = f"pixel ({y}, {x}) of {NAMES[s]} in channel {f}"
        raise InputError(
            f"{file}: {int(blank.sum())} pixels have no data, first {where}: give blanks = 'zero' to take them as dark"
        )
    data[blank] = 0
    return cube.with_data(data)


class HealpixFile(_FileSky):
    """A HEALPix map of a FITS file: I, or I, Q and U, in K, mK, uK, Jy/sr or MJy/sr, of one frequency.

    It is put on `pixels` x `pixels` of `pixel` about the phase centre, bilinear in the map. NSIDE, ORDERING, COORDSYS,
    POLCCONV (COSMO where it does not say), TUNIT1 and FREQ of its header are known; fields stand for what the header
    does not say. Its kelvin go as nu^`temperature_index` from `frequency`; without an index that frequency alone may
    be observed.
    """

    needs: ClassVar[dict[str, str]] = {"astropy_healpix": "astropy-healpix"}
    file: str
    hdu: Count = 1
    pixels: Side = 480
    pixel: PositiveRadians = float(np.deg2rad(0.5 / 60))
    frequency: PositiveHertz | None = None
    temperature_index: Finite | None = None
    unit: str | None = None
    coordinates: Frame | None = None
    convention: Convention | None = None

    def read(self, centre: Direction) -> ImageSky:
        """The map on its grid for a phase centre."""
        from astropy import units as u

        name = harmless(Path(self.file).name)
        maps, header = _maps(Path(self.file), self.hdu)
        freq = self.frequency if self.frequency is not None else _frequency(name, header)
        grid = ImageGrid.of((self.pixels, self.pixels), self.pixel, centre)
        grid.on_the_sky()
        nested = _one_of(name, header, "ORDERING", {"RING": False, "NESTED": True, "NEST": True}, None)
        frame = self.coordinates or _one_of(name, header, "COORDSYS", FRAMES, "coordinates")
        convention = self.convention or _one_of(name, header, "POLCCONV", CONVENTIONS, "convention", "COSMO")
        if len(maps) > 1 and self.convention is None and "POLCCONV" not in header:
            warn(f"{name}: no POLCCONV in its header: U is taken as COSMO; convention = 'IAU' takes it as the IAU's")
        planes, open_ = on_grid(maps, grid, nested, frame, convention)
        scale = _per_sr(name, self.unit or str(header.get("TUNIT1", "")).strip(), freq)
        text = f"{name}, nside {healpix_of(maps.shape[1], nested).nside}, {frame}, {convention}: between its pixels "
        return ImageSky(
            grid=grid,
            stokes=(planes * scale * solid_angles(grid))[None],
            frequencies=[freq] * u.Hz,
            spectral_index=None if self.temperature_index is None else self.temperature_index + 2,
            remarks=(("HEALPix", text + f"it is good to {open_:.1e} (rms, of its own)"),),
        )


FRAMES: dict[str, Any] = {"G": "galactic", "GALACTIC": "galactic", "C": "icrs", "CELESTIAL": "icrs", "ICRS": "icrs"}
FRAMES |= {"EQUATORIAL": "icrs"}
CONVENTIONS = {"IAU": "IAU", "COSMO": "COSMO"}


def _one_of(file: str, header: Any, key: str, known: dict[str, Any], field: str | None, default: str = "") -> Any:
    """What a keyword of the header says, among what is known."""
    text = str(header.get(key, default)).strip().upper()
    if text not in known:
        remedy = (
            f"give {field} = {' or '.join(map(repr, dict.fromkeys(known.values())))}" if field else "convert the map"
        )
        raise FileError(f"{file}: {key} = '{harmless(text, 24)}' is not one of {', '.join(known)}: {remedy}")
    return known[text]


def _frequency(file: str, header: Any) -> float:
    """Hz of FREQ, with the unit of FREQUNIT, in Hz without one."""
    from astropy import units as u

    try:
        found = u.Quantity(float(header["FREQ"]), str(header.get("FREQUNIT", "Hz")).strip()).to_value(u.Hz)
    except (KeyError, ValueError, TypeError, u.UnitConversionError):
        raise FileError(f"{file}: FREQ of its header tells no frequency: give frequency = '408 MHz'") from None
    if not (np.isfinite(found) and found > 0):
        raise FileError(f"{file}: FREQ = {found:g} Hz is not above 0: give frequency = '408 MHz'")
    return float(found)


def _per_sr(file: str, unit: str, freq_hz: float) -> float:
    """Jy/sr of one unit of a map."""
    from astropy import units as u

    try:
        found = u.Unit(unit)
        if found.is_equivalent(u.K):
            return float(found.to(u.K)) * float(jy_per_k(freq_hz, 1.0))
        return float(found.to(u.Jy / u.sr))
    except (ValueError, TypeError, u.UnitConversionError):
        raise FileError(
            f"{file}: the unit '{harmless(unit, 24)}' is not K, Jy/sr or the like: give unit = 'K'"
        ) from None


def _maps(path: Path, number: int) -> tuple[Float, Any]:
    """Stokes maps (1 to 3, Npix), float64, NaN where a file of some pixels has none, and the header."""
    name = harmless(path.name or path)
    with opened(path) as hdus:
        if number >= len(hdus) or hdus[number].is_image or not hasattr(hdus[number], "columns"):
            raise FileError(f"{name}: unit {number} is no table of a HEALPix map: give hdu = ...")
        table, header = hdus[number], hdus[number].header.copy()
        nside = header.get("NSIDE")
        if not isinstance(nside, int) or not 1 <= nside <= 2**15 or nside & (nside - 1):
            raise FileError(f"{name}: NSIDE = {harmless(nside, 24)} is not a power of 2 up to 32768")
        count = 12 * nside**2
        afford(3 * 8.0 * count, f"{name}: a map of nside {nside}", "give one of less resolution")
        names = list(table.columns.names)
        explicit = str(header.get("INDXSCHM", "IMPLICIT")).strip().upper() == "EXPLICIT"
        columns = names[1:] if explicit else names
        used = columns[: 3 if len(columns) >= 3 else 1]
        if not used:
            raise FileError(f"{name}: the table has no column of a map")
        values = [np.asarray(table.data[c], float).ravel() for c in used]
        place = np.asarray(table.data[names[0]]).astype(int).ravel() if explicit else np.arange(count)
    if columns[len(used) :]:
        unused(name, columns[len(used) :], "the first columns are taken as I, or I, Q and U")
    maps = np.full((len(used), count), np.nan)
    if explicit and len(place) and not (place.min() >= 0 and place.max() < count):
        raise FileError(f"{name}: pixel {int(place.max())} of the column {names[0]} is not one of {count}")
    if any(len(v) != len(place) for v in values):
        raise FileError(f"{name}: column {used[0]} has {len(values[0])} pixels, due {len(place)}")
    for row, value in zip(maps, values, strict=True):
        # healpy's mark of a pixel without data
        row[place] = np.where(np.abs(value) > 1e30, np.nan, value)
    return maps, header
