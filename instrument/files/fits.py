"""Reads FITS cubes of any program as one `StokesCube`: one file, or a file a Stokes parameter or a channel."""

from __future__ import annotations

import os
import re
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any, get_args

import numpy as np

from instrument.checked import checked
from instrument.errors import FileError, InputError, unused, warn
from instrument.files.fits_axes import Role
from instrument.files.fits_header import Given, Part, affordable, look
from instrument.files.fits_open import opened
from instrument.files_in import harmless
from instrument.image.blanks import without_constants
from instrument.image.cube import StokesCube, Unit
from instrument.image.psf import Psf
from instrument.units import Float, to_si

NAMES = "IQUV"
MFS = re.compile(r"(.*)-MFS(-.*)")  # WSClean: the mean of all channels, beside NAME-0000, NAME-0001, ...


@checked
def read_cube(
    *paths: str | os.PathLike[str],
    stokes: str | Sequence[str] | None = None,
    unit: Unit | None = None,
    frequencies: Any = None,
    psf: Psf | None = None,
) -> StokesCube:
    """Cube (F, 4, Ny, Nx) of FITS images, float32 (float64 where a file is), NaN for Stokes parameters that none has.

    Axes RA, DEC, FREQ and STOKES are found by CTYPE, in any order; FREQ is linear in Hz, kHz, MHz or GHz, a table
    (FREQ-TAB), or a column FREQ of a table BEAMS. Files are put together by Stokes parameter, and along frequency in
    the order given; the mean of all channels (-MFS-) that WSClean puts beside them is left out. `stokes` ("Q,U"),
    `unit`, `frequencies` (with a unit) and `psf` stand for what the headers do not say. Beams come from the table BEAMS
    (CASA's, ours), BMAJ1 and so on, BMAJ, or AIPS's history. x is turned to run west, y north; U of POLCCONV = 'COSMO'
    changes sign. What was not used is named in warnings. Raises `FileError` or `InputError` in one line with file, axis
    or keyword, value and remedy.
    """
    if not paths:
        raise InputError('read_cube needs a file: read_cube("cube.fits"), or one for each Stokes parameter')
    names = [s.strip().upper() for s in (stokes.split(",") if isinstance(stokes, str) else stokes or ())]
    if wrong := [s for s in names if s not in list(NAMES)]:
        raise InputError(f"stokes = {stokes!r} has {wrong[0]!r}: needed some of I, Q, U, V, such as stokes='Q,U'")
    if unit is not None and unit not in get_args(Unit):
        raise InputError(f"unit = {unit!r} is not one of {', '.join(map(repr, get_args(Unit)))}")
    freq = None if frequencies is None else np.atleast_1d(to_si(frequencies, "Hz", "frequencies"))
    parts: list[Part] = []
    for path in _channels_alone(paths):
        left = names if stokes is not None else None
        parts.append(look(Path(path), Given(left, unit, freq is not None, psf is not None)))
        names = names[len(parts[-1].stokes) :]
    if names:
        raise InputError(f"stokes = {stokes!r} names {len(names)} more than the files have planes: {', '.join(names)}")
    _named_as_they_say(parts)
    _same(parts)
    places, freq = _places(parts, freq)
    return _filled(parts, places, freq, psf)


def _channels_alone(paths: Sequence[Any]) -> list[Any]:
    """The files without the means over all channels that WSClean writes beside the channels."""
    names = [Path(path).name for path in paths]
    kept = []
    for path, name in zip(paths, names, strict=True):
        mean = MFS.fullmatch(name)
        if mean and any(re.fullmatch(re.escape(mean[1]) + r"-\d+" + re.escape(mean[2]), other) for other in names):
            unused(harmless(name), ["all of it"], "the mean of all channels, no channel of its own")
        else:
            kept.append(path)
    return kept


def _named_as_they_say(parts: list[Part]) -> None:
    """Raises `InputError` where a header says Q, U or V and the caller another; I stands in many that nobody filled."""
    for part in parts:
        if not part.header_stokes or part.header_stokes == part.stokes:
            continue
        header, given = ",".join(part.header_stokes), ",".join(part.stokes)
        if set(part.header_stokes) & set("QUV"):
            remedy = "leave stokes= out, give the files in its order, or correct CRVAL of STOKES"
            raise InputError(f"{part.name}: its axis STOKES says {header}, but stokes= says {given}: {remedy}")
        part.notes.unused.append((f"STOKES = {header} of its header", f"stokes = '{given}' is given"))


def _same(parts: list[Part]) -> None:
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


Places = dict[str, list[tuple[Part, int, int]]]  # of a Stokes parameter: part, its plane there, its first channel


def _places(parts: list[Part], given: Float | None) -> tuple[Places, Float]:
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
def _data(part: Part) -> Iterator[Any]:
    """The data of a file as (F, planes, Ny, Nx), x to the west, y to the north; a view of the file where possible."""
    with opened(part.path, "has data that cannot be read") as hdus:
        array = hdus[part.hdu].data
        roles: tuple[Role, ...] = ("freq", "stokes", "y", "x")
        order = [array.ndim - part.axes[r] for r in roles if r in part.axes]
        rest = [k for k in range(array.ndim) if k not in order]
        array = np.transpose(array, rest + order)[(0,) * len(rest)]
        array = np.expand_dims(array, [k for k, r in enumerate(roles) if r not in part.axes])
        yield array[..., :: -1 if part.grid.flip_y else 1, :: -1 if part.grid.flip_x else 1]


def _filled(parts: list[Part], places: Places, freq: Float, psf: Psf | None) -> StokesCube:
    from astropy import units as u

    first = parts[0]
    dtype = np.float64 if any(p.wide for p in parts) else np.float32
    shape = (len(freq), 4, *first.grid.shape)
    affordable(first.name, len(freq), *first.grid.shape, dtype == np.float64)
    out = np.empty(shape, dtype)
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
                if part.beams is not None:
                    beams[k, :, here] = part.beams
    of = [beams[NAMES.index(name)] for name in places]
    if any(not np.allclose(b[:2], of[0][:2], rtol=1e-3, atol=0, equal_nan=True) for b in of[1:]):
        first.notes.warned.append(f"beams differ between Stokes parameters: those of {next(iter(places))} are taken")
    _say(parts)
    major, minor, angle = of[0]
    if psf is None and np.isfinite(major).any():
        psf = Psf.gaussian(major * u.rad, minor * u.rad, angle * u.rad)
    grid = first.grid
    out = without_constants(out, first.name + (f" and {len(parts) - 1} more" if len(parts) > 1 else ""), copy=False)
    return StokesCube(out, freq * u.Hz, grid.pixel_rad * u.rad, first.unit, grid.centre, psf, "data")


def _say(parts: list[Part]) -> None:
    """Warn of what the files have in common once: a hundred channels need no hundred warnings."""
    for text in dict.fromkeys(text for part in parts for text in part.notes.warned):
        warn(text)
    found: dict[tuple[str, str], list[str]] = {}
    for part in parts:
        for note in part.notes.unused:
            found.setdefault(note, []).append(part.name)
    for (what, why), files in found.items():
        unused(files[0] + (f" and {len(files) - 1} more" if len(files) > 1 else ""), [what], why)
