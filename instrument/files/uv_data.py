"""pyuvdata: opened when it is needed, quiet, without downloads; what it refuses is one line of ours."""

from __future__ import annotations

import os
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from instrument.errors import FileError, InputError
from instrument.files_in import harmless
from instrument.observe.layout import Layout

NAME_LENGTH = 8  # of antennas in the FITS files of pyuvdata
MISSING = "UVFITS and UVH5 need pyuvdata: pip install 'instrument[uv]'"
KINDS = {".uvfits": "uvfits", ".uvh5": "uvh5"}
# its numbers of correlations, those of AIPS, and casacore's
CORRELATIONS = {1: 1, 2: 2, 3: 3, 4: 4, -1: 5, -3: 6, -4: 7, -2: 8, -5: 9, -7: 10, -8: 11, -6: 12}


def library() -> Any:
    """The module; raises `InputError` with the way to get it."""
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            import pyuvdata
    except ImportError:
        raise InputError(MISSING) from None
    return pyuvdata


@contextmanager
def told(path: str | os.PathLike[str]) -> Iterator[None]:
    """Its failures as `FileError`s about a file; its warnings are kept back, and nothing is downloaded."""
    from astropy.utils import iers

    try:
        with warnings.catch_warnings(), iers.conf.set_temp("auto_download", False):
            warnings.simplefilter("ignore")
            yield
    except (InputError, MemoryError):
        raise
    except Exception as error:  # of fifty kinds, KeyError to UnicodeError, as files are broken
        text = " ".join((str(error) or type(error).__name__).split())
        raise FileError(f"{harmless(path)}: {harmless(text, 300)}") from None


def telescope_of(layout: Layout, name: str = "unknown") -> Any:
    """The stations as its `Telescope`: numbered from 1, the place of the array that of the first."""
    from astropy import units as u
    from astropy.coordinates import EarthLocation

    site = layout.positions_m[0]
    return library().Telescope.new(
        name=name, instrument=name, location=EarthLocation.from_geocentric(*(site * u.m)),
        antenna_positions=layout.positions_m - site, antenna_names=list(layout.names),
        antenna_numbers=np.arange(len(layout)) + 1, feed_array=["x", "y"], feed_angle=[0.0, np.pi / 2],
        mount_type="other", update_from_known=False,
    )  # fmt: skip


def name_antennas(path: Path, table: str, column: str, names: tuple[str, ...]) -> None:
    """Put whole names of antennas into a FITS file, where they were cut to 8 characters."""
    from astropy.io import fits

    width = max(map(len, names))
    if width <= NAME_LENGTH:
        return
    longer = path.with_name(f"named-{path.name}")
    with fits.open(path, memmap=True) as hdus:
        old = hdus[table]
        whole = fits.Column(name=column, format=f"{width}A", array=np.array(names))
        new = fits.BinTableHDU.from_columns([whole if c.name == column else c for c in old.columns])
        new.header.extend(old.header, unique=True, strip=True)
        hdus[hdus.index_of(table)] = new
        hdus.writeto(longer)
    longer.replace(path)


def say_utc(path: Path) -> None:
    """Say in UVFITS that times are UTC by the keyword that CASA reads: without it they are TAI there, 35 s off."""
    from astropy.io import fits

    fits.setval(path, "TIMSYS", value="UTC", extname="AIPS AN")
