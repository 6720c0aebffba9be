"""SkyH5, the HDF5 files of pyradiosky: lists of point sources, read and written without it.

Q, U and V are those of the IAU: pyradiosky's coherencies in the sky show it (tests/peers). V changes its sign between
such a file and a sky, whose V is minus that of the IAU. All four carry the spectral index.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from instrument.errors import FileError, unused
from instrument.files_in import SHOWN, harmless
from instrument.h5 import created, dataset, demand_affordable, members, names, numbers, opened, text
from instrument.provenance import written_by
from instrument.sky.bbs_text import broken, made
from instrument.sky.sources import Sources
from instrument.sky.tables import ROWS_AT_MOST, plain_unit, unit_scale
from instrument.units import Float

S = TypeVar("S", bound=Sources)
HDF5 = b"\x89HDF\r\n\x1a\n"
FRAMES = {"icrs": ("ra", "dec"), "fk5": ("ra", "dec"), "galactic": ("l", "b")}
IAU = np.array([1.0, 1.0, 1.0, -1.0])  # times I, Q, U, V: from one to the other
SAME = 1e-9  # of a frequency: the channel that is asked for
UNREAD = ("beam_amp", "stokes_error")


def read_skyh5(make: type[S], path: Path, frequency: float | None = None) -> S:
    """Point sources of a SkyH5 file, as `make`; of fluxes in several channels those at `frequency` in Hz.

    Raises `FileError`, for maps too: pyradiosky's `write_healpix` or healpy writes FITS, which the sky `healpix` reads.
    """
    with opened(path, "SkyH5 file") as store:
        top = members(store)
        if not {"Header", "Data"} <= set(top):
            raise broken(path, None, "is HDF5 but no SkyH5 file: it has no Header and Data; the sky of a file of "
                                     "another program is read from its text form")  # fmt: skip
        header, data = top["Header"], top["Data"]
        parts = members(header)
        kind = _word(parts, "component_type", "point")
        if kind != "point":
            raise broken(path, None, f"component_type is '{harmless(kind, SHOWN)}': maps are read as HEALPix FITS, by "
                                     "the sky 'healpix'")  # fmt: skip
        flux = dataset(data, "stokes", "fiu")
        if flux.ndim != 3 or flux.shape[0] != 4 or not flux.shape[2]:
            raise broken(path, None, f"stokes is of shape {flux.shape}, needed (4, channels, sources)")
        count = flux.shape[2]
        if count > ROWS_AT_MOST:
            raise broken(path, None, f"{count:,} sources; at most {ROWS_AT_MOST:,} are read: cut out what is needed")
        demand_affordable([flux])
        channel, freq, terms = _spectra(path, header, parts, flux.shape[1:], frequency)
        stokes = IAU * numbers(flux, (slice(None), channel)).T * _scale(path, flux, "Jy")
        ra, dec = _places(path, parts, header, bool(stokes[:, 1:3].any()))
        group = parts.get("extended_model_group")
        listed = {
            "names": names(dataset(header, "name", "SO")) if "name" in parts else [f"s{k}" for k in range(count)],
            "patches": [] if group is None else names(dataset(header, "extended_model_group", "SO")),
        }
        extra = parts.get("extra_columns")
        unread = [*(n for n in UNREAD if n in members(data)), *(members(extra) if extra is not None else ())]
    shown = [harmless(n, SHOWN) for n in unread]
    unused(harmless(path.name), shown)
    columns = {"ra": ra, "dec": dec, "reference_frequency": freq, "spectral_index": terms, **listed}
    for column, values in columns.items():
        if values is not None and len(values) != count and not (column == "patches" and not values):
            raise broken(path, None, f"{column} has {len(values)} entries for {count} sources")
    follows = terms is not None and bool(stokes[:, 1:].any())
    return made(
        make,
        path,
        names=tuple(listed["names"]),
        patches=tuple(listed["patches"]) if any(listed["patches"]) else (),
        ra_rad=ra,
        dec_rad=dec,
        stokes_jy=stokes,
        reference_hz=freq,
        spectral_terms=None if terms is None else terms[:, None],
        polarization_follows_i=np.ones(count, bool) if follows else None,
        not_read=(f"{harmless(path.name)}: {', '.join(shown)}",) if shown else (),
    )


def _word(parts: dict[str, Any], name: str, default: str = "") -> str:
    return text(parts[name][()]).strip() if name in parts else default


def _scale(path: Path, found: Any, kept: str) -> float:
    """Factor from the unit of a dataset to another."""
    unit = text(found.attrs.get("unit", "")).strip()
    scale = unit_scale(unit, kept) if plain_unit(unit) else None
    if scale is None:
        name, shown = harmless(found.name), harmless(unit, SHOWN)
        raise broken(path, None, f"{name} is in '{shown}', which is not convertible to {kept}")
    return scale


def _spectra(
    path: Path, header: Any, parts: dict[str, Any], shape: tuple[int, int], frequency: float | None
) -> tuple[int, Float | None, Float | None]:
    """The channel whose fluxes are taken, Hz of each source or `None`, spectral indices or `None`."""

    def hertz(name: str) -> Float:
        found = dataset(header, name, "fiu")
        return np.asarray(np.atleast_1d(numbers(found)) * _scale(path, found, "Hz"))

    channels, count = shape
    kind, terms = _word(parts, "spectral_type", "flat"), None
    if kind in ("flat", "spectral_index"):
        freq = hertz("reference_frequency") if "reference_frequency" in parts else None
        if kind == "spectral_index":
            if freq is None:
                raise broken(path, None, "spectral_type is 'spectral_index' without reference_frequency")
            terms = numbers(dataset(header, "spectral_index", "fiu"))
            terms = terms if terms.any() else None
        if channels != 1:
            raise broken(path, None, f"{channels} channels of fluxes where spectral_type is '{kind}'")
        return 0, freq, terms
    if kind not in ("full", "subband"):
        raise broken(path, None, f"spectral_type '{harmless(kind, SHOWN)}' is none of pyradiosky's")
    there = hertz("freq_array")
    if len(there) != channels:
        raise broken(path, None, f"freq_array has {len(there)} channels, stokes {channels}")
    shown = ", ".join(f"{f / 1e6:g}" for f in there[:8]) + (" ..." if len(there) > 8 else "")
    if frequency is None and channels > 1:
        raise broken(path, None, f"has fluxes at {shown} MHz; say which with frequency='{there[0] / 1e6:g} MHz'")
    channel = 0 if frequency is None else int(np.argmin(np.abs(there - frequency)))
    if frequency is not None and abs(there[channel] / frequency - 1) > SAME:
        raise broken(path, None, f"has no fluxes at {frequency / 1e6:g} MHz, but at {shown} MHz")
    return channel, np.full(count, there[channel]), None


def _places(path: Path, parts: dict[str, Any], header: Any, polarized: bool) -> tuple[Float, Float]:
    """ICRS right ascension and declination in rad."""
    group = parts.get("skycoord")
    inside = parts if group is None else members(group)
    frame = _word(inside, "frame").lower()
    if frame not in FRAMES or (frame == "fk5" and _word(inside, "equinox", "J2000").strip("J").rstrip("0.") != "2"):
        known = ", ".join(FRAMES)
        raise broken(path, None, f"positions are of '{harmless(frame, SHOWN)}'; known are {known} (J2000)")
    both = []
    for name in FRAMES[frame] if group is not None else ("lon", "lat"):
        found = dataset(header if group is None else group, name, "fiu")
        both.append(np.atleast_1d(numbers(found)) * _scale(path, found, "rad"))
    if frame == "icrs":
        return both[0], both[1]
    if frame == "galactic" and polarized:
        raise FileError(
            f"{harmless(path.name)}: Q and U of sources in galactic coordinates count from galactic north; "
            "SkyModel.transform_to('icrs') of pyradiosky turns them"
        )
    from astropy import units as u
    from astropy.coordinates import SkyCoord

    icrs = SkyCoord(both[0] * u.rad, both[1] * u.rad, frame=frame).icrs
    return np.asarray(icrs.ra.rad), np.asarray(icrs.dec.rad)


def to_skyh5(path: Path, sky: Sources) -> None:
    """Write a new SkyH5 file of a sky that `writers.write_sky` lets pass; positions in rad, to the last bit."""
    count = len(sky)
    index = None if sky.spectral_terms is None else sky.spectral_terms[:, 0]
    with created(path) as store:
        header, data = store.create_group("Header"), store.create_group("Data")
        header["Ncomponents"], header["Nfreqs"] = count, 1
        by = written_by()
        for name, value in {
            "component_type": "point",
            "spectral_type": "flat" if sky.reference_hz is None else "spectral_index",
            "history": f"{by['software']}, {by['written']}",
        }.items():
            header[name] = np.bytes_(value)
        for name, texts in {"name": sky.names, "extended_model_group": sky.patches}.items():
            if texts:
                header[name] = np.char.encode(np.array(texts), "utf-8")
        if sky.reference_hz is not None:
            header["reference_frequency"] = sky.reference_hz
            header["reference_frequency"].attrs["unit"] = "Hz"
            header["spectral_index"] = np.zeros(count) if index is None else index
        group = header.create_group("skycoord")
        group["frame"], group["representation_type"] = np.bytes_("icrs"), np.bytes_("spherical")
        for name, values, kind in (("ra", sky.ra_rad, "longitude"), ("dec", sky.dec_rad, "latitude")):
            group[name] = values
            group[name].attrs["unit"], group[name].attrs["object_type"] = "rad", kind
        data["stokes"] = (IAU * sky.stokes_jy).T[:, None]
        data["stokes"].attrs["unit"] = "Jy"
