"""Reads FITS cubes of any program as one `StokesCube`: one file, or a file a Stokes parameter or a channel."""

from __future__ import annotations

import os
import re
import warnings
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, get_args

import numpy as np

from instrument.errors import FileError, InputError, InstrumentWarning
from instrument.files.fits_axes import Grid, Role, axes_of, frequencies_of, grid_of, number, stokes_of
from instrument.files.h5parm import one_line
from instrument.image.cube import Psf, StokesCube, Unit
from instrument.units import Float, to_si

NAMES = "IQUV"
BROKEN = (OSError, ValueError, TypeError, KeyError, IndexError)  # what astropy makes of broken files
# with spaces, dots and asterisks left out; of BUNIT in capitals only what cannot be read in two ways
FLUX = re.compile(r"([mµuμ]?)jy(?:/|per)?(?:(beam|bm)|(pixel|pix))(?:-1|\^-1)?|(?:beam|bm)-1([mµuμ]?)jy")
PREFIX = {"": 1.0, "m": 1e-3, "u": 1e-6, "µ": 1e-6, "μ": 1e-6}
KELVIN = {"K": 1.0, "mK": 1e-3, "uK": 1e-6, "µK": 1e-6, "μK": 1e-6}


@dataclass
class _Part:
    """What the header of one file says; the data are read later."""

    path: Path
    hdu: int
    axes: dict[Role, int]
    grid: Grid
    channels: int
    freq_hz: Float | None
    stokes: list[str]
    unit: Unit
    factor: float
    turns_u: bool
    beams: Float  # (3, F): BMAJ, BMIN, BPA in rad; NaN where not given
    wide: bool

    @property
    def name(self) -> str:
        return self.path.name


def read_cube(
    *paths: str | os.PathLike[str],
    stokes: str | Sequence[str] | None = None,
    unit: Unit | None = None,
    frequencies: Any = None,
    psf: Psf | None = None,
) -> StokesCube:
    """Cube (F, 4, Ny, Nx) of FITS images, float32 (float64 where a file is), NaN for Stokes parameters that none has.

    Axes RA, DEC, FREQ and STOKES are found by CTYPE, in any order; FREQ is linear in Hz, kHz, MHz or GHz, or a column
    FREQ of a table BEAMS. Files are put together by Stokes parameter, and along frequency in the order given. `stokes`
    ("Q,U"), `unit`, `frequencies` (with a unit) and `psf` stand for what the headers do not say, or say wrongly. Beams
    come from the table BEAMS (CASA's, ours) or BMAJ, BMIN, BPA. x is turned to run west, y north; U of POLCCONV =
    'COSMO' changes sign. Raises `FileError` or `InputError` in one line with file, axis or keyword, value and remedy.
    """
    if not paths:
        raise InputError('read_cube needs a file: read_cube("cube.fits"), or one for each Stokes parameter')
    names = [s.strip().upper() for s in (stokes.split(",") if isinstance(stokes, str) else stokes or ())]
    if wrong := [s for s in names if s not in list(NAMES)]:
        raise InputError(f"stokes = {stokes!r} has {wrong[0]!r}: needed some of I, Q, U, V, such as stokes='Q,U'")
    if unit is not None and unit not in get_args(Unit):
        raise InputError(f"unit = {unit!r} is not one of {', '.join(map(repr, get_args(Unit)))}")
    freq = None if frequencies is None else np.atleast_1d(to_si(frequencies, "Hz", "frequencies"))
    parts: list[_Part] = []
    for path in paths:
        parts.append(_look(Path(path), names if stokes is not None else None, unit, freq is not None))
        names = names[len(parts[-1].stokes) :]
    if names:
        raise InputError(f"stokes = {stokes!r} names {len(names)} more than the files have planes: {', '.join(names)}")
    _same(parts)
    places, freq = _places(parts, freq)
    return _filled(parts, places, freq, psf)


def _look(path: Path, names: list[str] | None, unit: Unit | None, named: bool) -> _Part:
    from astropy.io import fits
    from astropy.utils.exceptions import AstropyWarning

    try:
        # of keywords that it mends; of a short file, whose data are refused later
        with warnings.catch_warnings(action="ignore", category=AstropyWarning), fits.open(path) as hdus:
            for k, hdu in enumerate(hdus):
                if hdu.is_image and hdu.header.get("NAXIS", 0) >= 2:
                    return _described(path, k, hdus, names, unit, named)
    except (FileError, InputError):
        raise
    except FileNotFoundError:
        raise FileError(f"{path} does not exist") from None
    except (*BROKEN, fits.VerifyError) as error:
        raise FileError(f"{path.name or path} is not a readable FITS file: {one_line(error)}") from None
    raise FileError(f"{path.name}: there is no image of two axes or more in it")


def _described(path: Path, k: int, hdus: Any, names: list[str] | None, unit: Unit | None, named: bool) -> _Part:
    file, header = path.name, hdus[k].header
    axes = axes_of(file, header, named)
    if "freq" not in axes and not named:
        raise FileError(f"{file}: no axis is FREQ: give frequencies=")
    channels = int(header[f"NAXIS{axes['freq']}"]) if "freq" in axes else 1
    planes = int(header[f"NAXIS{axes['stokes']}"]) if "stokes" in axes else 1
    if names is None:
        found = stokes_of(file, header, axes.get("stokes"))
        if found is None:
            raise FileError(f"{file}: no axis is STOKES: say what it is, such as stokes='I'")
    elif len(names) < planes:
        raise InputError(f"stokes names too few: {file} has {planes}, of which {len(names)} are left to name")
    else:
        found = names[:planes]
    table = next((h for h in hdus if h.name == "BEAMS" and not h.is_image), None)
    freq: Float | None = None
    if not named:
        if table is not None and "FREQ" in table.columns.names:
            freq = np.array(table.data["FREQ"], float)
        else:
            freq = frequencies_of(file, header, axes["freq"])
        if len(freq) != channels:
            raise FileError(f"{file}: the table BEAMS has {len(freq)} rows, the axis FREQ {channels} channels")
    convention = str(header.get("POLCCONV", "IAU")).strip().upper()
    if convention not in ("IAU", "COSMO"):
        raise FileError(f"{file}: POLCCONV = '{convention}' is neither IAU nor COSMO")
    of_unit = (unit, 1.0) if unit else _unit(file, header)
    beams = _beams(file, header, table, channels)
    wide, turns = header["BITPIX"] == -64, convention == "COSMO"
    return _Part(path, k, axes, grid_of(file, header, axes), channels, freq, found, *of_unit, turns, beams, wide)


def _unit(file: str, header: Any) -> tuple[Unit, float]:
    """Unit and factor of BUNIT: 'mJy/beam' is Jy/beam, 1e-3."""
    text = str(header.get("BUNIT", "")).strip()
    remedy = "give unit='Jy/beam', 'Jy/pixel' or 'K'"
    if not text:
        raise FileError(f"{file}: BUNIT is missing: {remedy}")
    plain = re.sub(r"[\s.*()]", "", text)
    if plain in KELVIN or plain.lower() == "kelvin":
        return "K", KELVIN.get(plain, 1.0)
    # MK, MJY/BEAM: mega or milli?
    if (flux := FLUX.fullmatch(plain.lower())) and not plain.startswith("M"):
        return "Jy/pixel" if flux[3] else "Jy/beam", PREFIX[flux[1] or flux[4] or ""]
    raise FileError(f"{file}: BUNIT = '{text}' is not K, Jy/beam or Jy/pixel, or milli or micro of them: {remedy}")


def _beams(file: str, header: Any, table: Any, channels: int) -> Float:
    """BMAJ, BMIN, BPA of every channel in rad (3, F), NaN where not given."""
    keys = ("BMAJ", "BMIN", "BPA")
    if table is not None and {"BMAJ", "BMIN"} <= set(table.columns.names):
        rows = table.data
        if {"CHAN", "POL"} <= set(table.columns.names):  # CASA: one row a channel and Stokes parameter
            rows = rows[rows["POL"] == rows["POL"].min()]
            rows = rows[np.argsort(rows["CHAN"], kind="stable")]
        if len(rows) != channels:
            raise FileError(f"{file}: the table BEAMS has {len(rows)} beams, the axis FREQ {channels} channels")
        columns = table.columns
        return np.stack(
            [
                to_si(np.asarray(rows[k], float) * _angle(file, columns[k].unit), "rad", k, nan=True)
                if k in columns.names
                else np.zeros(channels)
                for k in keys
            ]
        )
    if "BMAJ" not in header:
        return np.full((3, channels), np.nan)
    major = number(file, header, "BMAJ")
    widths = major, number(file, header, "BMIN", major), number(file, header, "BPA", 0.0)
    return np.repeat(np.deg2rad(widths)[:, None], channels, axis=1)


def _angle(file: str, text: str | None) -> Any:
    from astropy import units as u

    unit = u.Unit(text or "deg", parse_strict="silent")
    if not unit.is_equivalent(u.rad):
        raise FileError(f"{file}: the table BEAMS has the unit '{text}': needed deg, arcsec or rad")
    return unit


def _same(parts: list[_Part]) -> None:
    """Raises `FileError` where two files differ in grid or unit."""
    first = parts[0]
    for part in parts[1:]:
        a, b = first.grid, part.grid
        both = f"{part.name} and {first.name}"
        if a.shape != b.shape:
            sizes = " and ".join(f"{g.shape[1]} x {g.shape[0]}" for g in (b, a))
            raise FileError(f"{both} have {sizes} pixels: needed the same grid")
        if abs(a.pixel_rad - b.pixel_rad) > 1e-6 * a.pixel_rad:
            sizes = " and ".join(f"{60 * np.rad2deg(g.pixel_rad):.8g}'" for g in (b, a))
            raise FileError(f"{both} have pixels of {sizes}: needed the same grid")
        apart = 0.0 if not (a.centre and b.centre) else float(np.linalg.norm(a.centre.vector - b.centre.vector))
        if (a.centre is None) != (b.centre is None) or apart > 0.01 * a.pixel_rad:
            raise FileError(f"{both} have centres {b.centre} and {a.centre}: needed the same grid")
        if first.unit != part.unit:
            raise FileError(f"{both} are in {part.unit} and {first.unit}: needed one unit, or unit= for all")


Places = dict[str, list[tuple[_Part, int, int]]]  # of a Stokes parameter: part, its plane there, its first channel


def _places(parts: list[_Part], given: Float | None) -> tuple[Places, Float]:
    """Where each plane of each file goes, and the frequencies (F,), the same for every Stokes parameter."""
    places: Places = {}
    count: dict[str, int] = {}
    for part in parts:
        for plane, name in enumerate(part.stokes):
            places.setdefault(name, []).append((part, plane, count.get(name, 0)))
            count[name] = count.get(name, 0) + part.channels
    freqs = {}
    for name, list_of in places.items():
        if given is not None:
            if len(given) != count[name]:
                raise InputError(f"{len(given)} frequencies, but the files have {count[name]} channels of {name}")
            freqs[name] = given
            continue
        each = [p.freq_hz for p, _, _ in list_of if p.freq_hz is not None]
        for i, one in enumerate(each):
            for j in range(i):
                if (again := np.isin(one, each[j])).any():
                    both = f"{list_of[i][0].name} and {list_of[j][0].name}"
                    raise FileError(f"{both} both have {name} at {one[again][0] / 1e6:.9g} MHz")
        freqs[name] = np.concatenate(each)
    first, *others = freqs
    for name in others:
        a, b = freqs[first], freqs[name]
        if len(a) != len(b):
            raise FileError(f"there are {len(a)} channels of {first}, but {len(b)} of {name}: needed the same")
        if (differs := ~np.isclose(a, b, rtol=1e-9, atol=0)).any():
            k = int(np.flatnonzero(differs)[0])
            at = f"channel {k} is {a[k] / 1e6:.9g} MHz in {first}, {b[k] / 1e6:.9g} MHz in {name}"
            raise FileError(f"{at}: give the files of each Stokes parameter in the same order")
    return places, freqs[first]


@contextmanager
def _data(part: _Part) -> Iterator[Any]:
    """The data of a file as (F, planes, Ny, Nx), x to the west, y to the north; a view of the file where possible."""
    from astropy.io import fits
    from astropy.utils.exceptions import AstropyWarning

    try:
        with warnings.catch_warnings(action="ignore", category=AstropyWarning), fits.open(part.path) as hdus:
            array = hdus[part.hdu].data
            roles: tuple[Role, ...] = ("freq", "stokes", "y", "x")
            order = [array.ndim - part.axes[r] for r in roles if r in part.axes]
            rest = [k for k in range(array.ndim) if k not in order]
            array = np.transpose(array, rest + order)[(0,) * len(rest)]
            array = np.expand_dims(array, [k for k, r in enumerate(roles) if r not in part.axes])
            yield array[..., :: -1 if part.grid.flip_y else 1, :: -1 if part.grid.flip_x else 1]
    except BROKEN as error:
        raise FileError(f"{part.name}: its data cannot be read: {one_line(error)}") from None


def _filled(parts: list[_Part], places: Places, freq: Float, psf: Psf | None) -> StokesCube:
    from astropy import units as u

    first = parts[0]
    dtype = np.float64 if any(p.wide for p in parts) else np.float32
    out = np.empty((len(freq), 4, *first.grid.shape), dtype)
    beams = np.full((4, 3, len(freq)), np.nan)
    for name in NAMES:
        if name not in places:
            out[:, NAMES.index(name)] = np.nan
    for part in parts:
        with _data(part) as planes:
            for plane, name in enumerate(part.stokes):
                start = next(at for p, k, at in places[name] if p is part and k == plane)
                here, k = slice(start, start + part.channels), NAMES.index(name)
                np.copyto(out[here, k], planes[:, plane], casting="same_kind")
                if (factor := -part.factor if part.turns_u and name == "U" else part.factor) != 1:
                    out[here, k] *= factor
                beams[k, :, here] = part.beams
    of = [beams[NAMES.index(name)] for name in places]
    if psf is None and any(not np.allclose(b[:2], of[0][:2], rtol=1e-3, atol=0, equal_nan=True) for b in of[1:]):
        said = f"beams differ between Stokes parameters: those of {next(iter(places))} are taken"
        warnings.warn(said, InstrumentWarning, stacklevel=3)
    major, minor, angle = of[0]
    if psf is None and np.isfinite(major).any():
        psf = Psf.gaussian(major * u.rad, minor * u.rad, angle * u.rad)
    grid = first.grid
    return StokesCube(out, freq * u.Hz, grid.pixel_rad * u.rad, first.unit, grid.centre, psf)
