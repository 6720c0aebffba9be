"""What `doctor` looks at: optional parts with the command that brings them, a beam against known values."""

from __future__ import annotations

import re
from collections.abc import Iterator
from importlib import metadata
from importlib.resources import files
from typing import Any

import numpy as np

from instrument.pipeline.record import package_version

ADDS = {  # of each extra of pyproject.toml
    "ms": "Measurement Sets, in and out",
    "uv": "UVFITS and UVH5, beams as UVBeam FITS",
    "zarr": "visibilities saved as Zarr",
    "xarray": "visibilities as xarray, MSv4",
    "healpix": "HEALPix maps as skies",
    "ica": "the foreground remover 'ica'",
    "radler": "deconvolution by Radler beside our own",
    "dask": "blocks on a Dask cluster",
    "peers": "comparisons with EveryBeam, DP3, RM-Tools and others (tests/peers, precision --peers)",
    "test": "the tests",
}
# EveryBeam's own frames are 0.7 arcsec from ours: tests/peers/test_everybeam.py
BEAM_AGREES = 5e-5
TABLE = "everybeam_lofar.ecsv"
CORRELATIONS = ("xx", "xy", "yx", "yy")
ARCAE_BESIDE_CASACORE = (0, 5, 2)


def extras() -> Iterator[str]:
    """A line for each optional part: what is there with its version, or what it would add and the command."""
    from packaging.requirements import Requirement

    wanted = [Requirement(text) for text in metadata.requires("instrument") or ()]
    for name, adds in ADDS.items():
        named = [r for r in wanted if r.marker and re.search(f"extra == ['\"]{name}['\"]", str(r.marker))]
        mine = [r for r in named if r.marker and r.marker.evaluate({"extra": name})]
        versions = {r.name: package_version(r.name) for r in mine}
        there = ", ".join(f"{n} {v}" for n, v in versions.items() if v != "not installed")
        lacking = ", ".join(n for n, v in versions.items() if v == "not installed")
        if lacking:
            command = f"pip install 'instrument[{name}]' adds {adds}"
            yield f"{name:<13} {there or 'not installed'}; lacks {lacking}: {command}"
        elif there:
            yield f"{name:<13} {there}: {adds}"
        elif named:
            yield f"{name:<13} not for this platform ({', '.join(r.name for r in named)}): {adds}"
        else:
            yield f"{name:<13} not known to what is installed: pip install -U instrument; it is for {adds}"


def coexistence() -> Iterator[str]:
    """Lines on the programs around casacore, of which some crash each other in one process."""
    have = {n: package_version(n) for n in ("python-casacore", "casatools", "arcae")}
    there = {n: v for n, v in have.items() if v != "not installed"}
    if {"python-casacore", "casatools"} <= set(there):
        yield "python-casacore and casatools crash each other in one process: import one of them, or use two processes"
    if "arcae" in there:
        numbers = tuple(int(n) for n in there["arcae"].split(".")[:3] if n.isdigit())
        beside = [n for n in there if n != "arcae"]
        if numbers < ARCAE_BESIDE_CASACORE and beside:
            yield f"arcae {there['arcae']} crashes beside {beside[0]}: pip install -U 'arcae>=0.5.2'"
        else:
            yield f"arcae {there['arcae']} reads Measurement Sets here, and lives beside python-casacore and casatools"


def known_beams() -> dict[str, float]:
    """Largest difference from EveryBeam's matrices, over the largest of them, by telescope; those that are installed.

    From coordinates and times to Jones matrices, so the tables of the Earth are in it.
    """
    from astropy import units as u
    from astropy.coordinates import SkyCoord
    from astropy.table import Table

    from instrument.registry import available, load

    table = Table.read(str(files("instrument.data") / TABLE), format="ascii.ecsv")
    out = {}
    for name in sorted(set(table["telescope"]) & set(available("telescopes"))):
        rows = table[table["telescope"] == name]
        stations, times, freq = (list(dict.fromkeys(rows[c])) for c in ("station", "time", "freq_hz"))
        places = list(dict.fromkeys(zip(rows["ra_deg"], rows["dec_deg"], strict=True)))
        telescope: Any = load("telescopes", name, stations=stations, phase="everybeam")
        pointing = SkyCoord(table.meta["pointing"])
        ours = telescope.beam(SkyCoord(places, unit="deg"), times, freq * u.Hz, pointing)
        theirs = np.stack([rows[c + "_re"] + 1j * rows[c + "_im"] for c in CORRELATIONS], axis=-1)
        # rows run over times, stations, frequencies, directions
        shape = (len(times), len(stations), len(freq), len(places), 2, 2)
        known = np.swapaxes(np.asarray(theirs, complex).reshape(shape), 1, 2)
        out[name] = float(np.abs(ours - known).max() / np.abs(known).max())
    return out
