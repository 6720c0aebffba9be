"""A list of sources as a file, by the ending of its name; what the form cannot hold is refused, never dropped."""

from __future__ import annotations

import csv
import warnings
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from instrument.errors import FileError, InputError
from instrument.files_in import harmless
from instrument.provenance import written_by
from instrument.sky.bbs import write_bbs
from instrument.sky.skyh5 import to_skyh5
from instrument.sky.sources import OPTIONAL, Sources
from instrument.whole_file import whole_file

ROUNDED = 1e-15  # of values in degrees and arcsec, which are radians in a sky


@dataclass(frozen=True)
class Form:
    """What a form of files holds: spectral terms at most, whether Q, U and V follow I, rotations, shapes, names."""

    title: str
    write: Callable[[Path, Sources], None]
    terms: int
    follows: bool
    rotates: bool = True
    shaped: bool = True
    named: bool = True


def write_sky(path: Any, sky: Sources, overwrite: bool = False) -> None:
    """Write a sky by the ending of its name: .skymodel, .bbs or .txt (BBS), .csv, .ecsv, .skyh5, .osm (OSKAR).

    CSV, ECSV and SkyH5 give every number back to the last bit, BBS and OSKAR angles and sizes to 1e-15 of them; OSKAR
    has no names and no patches. What is written is read before it stands under its name. Raises `InputError` for what
    the form cannot hold.
    """
    ending = Path(path).suffix.lower()
    if ending in (".skymodel", ".bbs", ".txt"):
        return write_bbs(path, sky, overwrite)
    if ending not in FORMS:
        known = ", ".join((".skymodel", ".bbs", ".txt", *FORMS))
        raise InputError(f"{harmless(path)}: the name of a sky ends in {known}")
    form = FORMS[ending]
    _demand(sky, form)
    with whole_file(path, overwrite) as partial:
        form.write(partial, sky)
        _demand_same(sky, partial, form)


def _demand(sky: Sources, form: Form) -> None:
    """Raises `InputError` that names the first source that the form cannot hold."""
    none, flux = np.zeros(len(sky), bool), np.asarray(sky.stokes_jy)
    terms = np.zeros((len(sky), 1)) if sky.spectral_terms is None else sky.spectral_terms
    curved = np.any(terms != 0, axis=1)
    follows = none if sky.polarization_follows_i is None else sky.polarization_follows_i
    rotates = none if sky.rotation_measure is None else sky.rotation_measure != 0
    q_u_v = "Q, U and V that do not follow the spectrum of I" if form.follows else "Q, U and V that follow that of I"
    kinds = {
        f"more than {form.terms} spectral term{'s' * (form.terms > 1)}": np.any(terms[:, form.terms :] != 0, axis=1),
        "linear spectral terms": none if sky.logarithmic is None else curved & ~sky.logarithmic,
        q_u_v: curved & flux[:, 1:].any(axis=1) & (follows != form.follows),
        "a rotation measure": rotates & (not form.rotates),
        "a shape": sky.gaussian & (not form.shaped),
    }
    for what, lacking in kinds.items():
        if lacking.any():
            name = harmless(sky.names[int(np.argmax(lacking))], 60)
            raise InputError(f"source '{name}' has {what}, which {form.title} cannot hold; write it as BBS (.skymodel)")


def _demand_same(sky: Sources, file: Path, form: Form) -> None:
    """Raises `InputError` where a file does not give the sky back."""
    from instrument.sky.forms import read_as

    try:
        with warnings.catch_warnings(action="ignore"):
            back = read_as(type(sky), file)
    except FileError as error:
        raise InputError(f"the sky cannot be written as {form.title}: {error}") from None
    if len(back) != len(sky):
        raise InputError(
            f"{form.title} gives {len(back)} of {len(sky)} sources back: a name or a value is no data to it"
        )
    wrong = _differs(sky, back, "ra_rad") | _differs(sky, back, "dec_rad") | _differs(sky, back, "stokes_jy")
    for field in OPTIONAL:
        if field not in ("logarithmic", "polarization_follows_i"):  # `_demand` knows what these may be
            wrong |= _differs(sky, back, field)
    if form.named:
        wrong |= np.array(sky.names) != np.array(back.names)
        blank = ("",) * len(sky)
        wrong |= np.array(sky.patches or blank) != np.array(back.patches or blank)
    if wrong.any():
        name = harmless(sky.names[int(np.argmax(wrong))], 60)
        raise InputError(f"{form.title} does not give source '{name}' back as it is; write it as BBS (.skymodel)")


def _differs(sky: Sources, back: Sources, field: str) -> Any:
    """Which sources have another value in a field; one that is not there is 0, a point has no angle."""
    a, b = (getattr(s, field) for s in (sky, back))
    if a is None and b is None:
        return np.zeros(len(sky), bool)
    wide = [np.zeros((len(sky), 1)) if x is None else np.asarray(x, float).reshape(len(sky), -1) for x in (a, b)]
    width = max(x.shape[1] for x in wide)
    first, second = (np.pad(x, ((0, 0), (0, width - x.shape[1]))) for x in wide)
    there = np.ones(len(sky), bool)
    if field == "reference_hz":  # of a source that is constant in frequency it has no effect
        none = np.zeros(len(sky), bool)
        there = none if sky.spectral_terms is None else np.any(sky.spectral_terms != 0, axis=1)
        there = there | (none if sky.rotation_measure is None else sky.rotation_measure != 0)
    if field == "angle_rad":
        there = sky.gaussian
    return there & np.any(np.abs(first - second) > ROUNDED * np.abs(first), axis=1)


def _columns(sky: Sources) -> dict[str, Any]:
    """Name and values of each column of a table, in SI units that stand in the names."""
    out: dict[str, Any] = {"name": sky.names}
    if sky.patches:
        out["patch"] = sky.patches
    out |= {"ra_rad": sky.ra_rad, "dec_rad": sky.dec_rad}
    out |= {f"{s}_jy": sky.stokes_jy[:, k] for k, s in enumerate("iquv")}
    if sky.reference_hz is not None:
        out["ref_freq_hz"] = sky.reference_hz
    if sky.spectral_terms is not None:
        both = ("spectral_index", "spectral_curvature")
        out |= {n: sky.spectral_terms[:, k] for k, n in enumerate(both[: sky.spectral_terms.shape[1]])}
    if sky.rotation_measure is not None:
        out["rotation_measure"] = sky.rotation_measure
    if sky.gaussian.any():
        angle = np.zeros(len(sky)) if sky.angle_rad is None else sky.angle_rad
        out |= {"major_rad": sky.major_rad, "minor_rad": sky.minor_rad, "angle_rad": angle}
    return out


def _write_csv(path: Path, sky: Sources) -> None:
    columns = _columns(sky)
    with open(path, "w", encoding="utf-8", newline="") as file:
        file.write(f"# {written_by()['software']}, {written_by()['written']}\n")
        out = csv.writer(file, lineterminator="\n")
        out.writerow(columns)
        out.writerows(
            zip(*(v if isinstance(v, tuple) else np.asarray(v).tolist() for v in columns.values()), strict=True)
        )


def _write_ecsv(path: Path, sky: Sources) -> None:
    from astropy.table import Table

    units = {"rad": "rad", "jy": "Jy", "hz": "Hz"}
    table = Table()
    for name, values in _columns(sky).items():
        stem, _, suffix = name.rpartition("_")
        table[stem if suffix in units else name] = list(values) if isinstance(values, tuple) else values
        if suffix in units:
            table[stem].unit = units[suffix]
    if "rotation_measure" in table.colnames:
        table["rotation_measure"].unit = "rad / m2"
    table.meta["provenance"] = written_by()
    table.write(str(path), format="ascii.ecsv", overwrite=True)


def _write_oskar(path: Path, sky: Sources) -> None:
    zero = np.zeros(len(sky))
    given = [sky.rotation_measure, sky.major_rad, sky.minor_rad, sky.angle_rad]
    turn, major, minor, angle = (zero if x is None else x for x in given)
    columns = [
        np.rad2deg(sky.ra_rad % (2 * np.pi)), np.rad2deg(sky.dec_rad), *sky.stokes_jy.T,
        zero if sky.reference_hz is None else sky.reference_hz,
        zero if sky.spectral_terms is None else sky.spectral_terms[:, 0],
        turn, np.rad2deg(major) * 3600, np.rad2deg(minor) * 3600, np.rad2deg(angle),
    ]  # fmt: skip
    rows = np.array(columns).T.tolist()
    with open(path, "w", encoding="utf-8") as file:
        file.write(f"# {written_by()['software']}, {written_by()['written']}\n")
        file.write("# RA, Dec (deg), I, Q, U, V (Jy), f0 (Hz), index, RM (rad/m2), major, minor (arcsec), PA (deg)\n")
        file.writelines(", ".join(map(repr, row)) + "\n" for row in rows)


FORMS = {
    ".csv": Form("CSV", _write_csv, terms=2, follows=False),
    ".ecsv": Form("ECSV", _write_ecsv, terms=2, follows=False),
    ".skyh5": Form("SkyH5", to_skyh5, terms=1, follows=True, rotates=False, shaped=False),
    ".osm": Form("an OSKAR sky model", _write_oskar, terms=1, follows=True, named=False),
}
