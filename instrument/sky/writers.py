"""A list of sources as a file, by the ending of its name; what the form cannot hold is refused, never dropped."""

from __future__ import annotations

import csv
import warnings
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from instrument.errors import FileError, InputError, warn
from instrument.files_in import harmless
from instrument.provenance import fits_cards, written_by
from instrument.sky.bbs import write_bbs
from instrument.sky.presets import beam_of, columns_of, held, preset_of, published
from instrument.sky.skyh5 import to_skyh5
from instrument.sky.sources import OPTIONAL, Sources
from instrument.sky.table_sky import moments
from instrument.whole_file import whole_file

ROUNDED = 1e-15  # of values in degrees and arcsec, which are radians in a sky
BLURRED = 1e-12  # of the square of a size that holds a beam: what `deconvolved` takes as no size


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
    polarized: bool = True
    beam: Any = None  # which sizes hold, (major, minor, angle)


def write_sky(path: Any, sky: Sources, overwrite: bool = False, preset: str | None = None) -> None:
    """Write a sky by the ending of its name: .skymodel, .bbs or .txt (BBS), .csv, .ecsv, .skyh5, .osm (OSKAR).

    CSV, ECSV and SkyH5 give every number back to the last bit, BBS and OSKAR angles and sizes to 1e-15 of them; OSKAR
    has no names and no patches. What is written is read before it stands under its name. Raises `InputError` for what
    the form cannot hold. `preset` ("LoTSS", ...) is a survey or source finder in whose columns and units a .csv, .ecsv
    or .fits is written, numbers to 1e-15; see `presets.published`. What is lost is said in a warning.
    """
    ending = Path(path).suffix.lower()
    if preset is not None:
        return _write_preset(path, ending, sky, overwrite, preset)
    if ending in (".skymodel", ".bbs", ".txt"):
        return write_bbs(path, sky, overwrite)
    if ending not in FORMS:
        known = ", ".join((".skymodel", ".bbs", ".txt", *FORMS))
        raise InputError(f"{harmless(path)}: the name of a sky ends in {known}, or .fits with a preset")
    form = FORMS[ending]
    _demand(sky, form)
    with whole_file(path, overwrite) as partial:
        form.write(partial, sky)
        _demand_same(sky, partial, form)


def _write_preset(path: Any, ending: str, sky: Sources, overwrite: bool, name: str) -> None:
    survey = preset_of(name)
    if ending not in (".csv", ".ecsv", ".fits"):
        raise InputError(f"{harmless(path)}: the name of a table of {survey.title} ends in .csv, .ecsv, .fits")
    has = held(survey)

    def write(partial: Path, there: Sources) -> None:
        freq = None if survey.freq_hz or there.reference_hz is None else float(there.reference_hz[0])
        PRESET_FORMS[ending](partial, columns_of(there, survey), len(there), freq)

    form = Form(
        survey.title, write, terms=int("spectral index" in has), follows=False, rotates=False,
        polarized="polarization" in has, beam=beam_of(survey, sky.dec_rad),
    )  # fmt: skip
    _demand(sky, form)
    there, lost = published(sky, survey)
    with whole_file(path, overwrite) as partial:
        write(partial, there)
        _demand_same(there, partial, form)
    if lost:
        warn(f"{harmless(path)}: {survey.title} has no columns for {' and '.join(lost)}: they are not written")


def _demand(sky: Sources, form: Form) -> None:
    """Raises `InputError` that names the first source that the form cannot hold."""
    none, flux = np.zeros(len(sky), bool), np.asarray(sky.stokes_jy)
    terms = np.zeros((len(sky), 1)) if sky.spectral_terms is None else sky.spectral_terms
    curved = np.any(terms != 0, axis=1)
    follows = none if sky.polarization_follows_i is None else sky.polarization_follows_i
    rotates = none if sky.rotation_measure is None else sky.rotation_measure != 0
    q_u_v = "Q, U and V that do not follow the spectrum of I" if form.follows else "Q, U and V that follow that of I"
    too_many = f"more than {form.terms} spectral term{'s' * (form.terms > 1)}" if form.terms else "a spectrum"
    kinds = {
        "polarization": flux[:, 1:].any(axis=1) & (not form.polarized),
        too_many: np.any(terms[:, form.terms :] != 0, axis=1),
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
        if form.beam is not None and field in ("major_rad", "minor_rad", "angle_rad"):
            continue
        if field not in ("logarithmic", "polarization_follows_i"):  # `_demand` knows what these may be
            wrong |= _differs(sky, back, field)
    if form.beam is not None:
        wrong |= _other_shape(sky, back, form.beam[0])
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


def _other_shape(sky: Sources, back: Sources, beam_rad: Any) -> Any:
    """Which sources have another shape once a beam has been put in and taken out, told by the squares of sizes."""
    both: Any = ([s.major_rad, s.minor_rad, s.angle_rad] for s in (sky, back))
    first, second = (np.array(moments(*given)) for given in both)
    return np.any(np.abs(first - second) > BLURRED * (np.asarray(sky.major_rad) ** 2 + beam_rad**2), axis=0)


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
    _csv(path, _columns(sky))


def _csv(path: Path, columns: dict[str, Any], *comments: str) -> None:
    with open(path, "w", encoding="utf-8", newline="") as file:
        file.writelines(f"# {text}\n" for text in (f"{written_by()['software']}, {written_by()['written']}", *comments))
        out = csv.writer(file, lineterminator="\n")
        out.writerow(columns)
        out.writerows(
            zip(*(v if isinstance(v, tuple) else np.asarray(v).tolist() for v in columns.values()), strict=True)
        )


def _write_ecsv(path: Path, sky: Sources) -> None:
    units = {"rad": "rad", "jy": "Jy", "hz": "Hz"}
    columns = {}
    for name, values in _columns(sky).items():
        stem, _, suffix = name.rpartition("_")
        columns[stem if suffix in units else name] = (values, units.get(suffix))
    if "rotation_measure" in columns:
        columns["rotation_measure"] = (sky.rotation_measure, "rad / m2")
    _table(columns, len(sky), {"provenance": written_by()}).write(str(path), format="ascii.ecsv", overwrite=True)


def _table(columns: dict[str, tuple[Any, str | None]], count: int, meta: dict[str, Any]) -> Any:
    from astropy.table import MaskedColumn, Table

    table = Table(meta=meta)
    for name, (values, unit) in columns.items():
        empty = MaskedColumn(np.zeros(count), mask=np.ones(count, bool)) if values is None else None
        table[name] = list(values) if isinstance(values, tuple) else values if empty is None else empty
        table[name].unit = unit
    return table


def _preset_csv(path: Path, columns: dict[str, tuple[Any, str | None]], count: int, freq_hz: float | None) -> None:
    plain = {name: ("",) * count if values is None else values for name, (values, _) in columns.items()}
    _csv(path, plain, *([] if freq_hz is None else [f"Reference frequency: {freq_hz!r} Hz"]))


def _preset_ecsv(path: Path, columns: dict[str, tuple[Any, str | None]], count: int, freq_hz: float | None) -> None:
    meta = {"provenance": written_by()} | ({} if freq_hz is None else {"Reference frequency": f"{freq_hz!r} Hz"})
    _table(columns, count, meta).write(str(path), format="ascii.ecsv", overwrite=True)


def _preset_fits(path: Path, columns: dict[str, tuple[Any, str | None]], count: int, freq_hz: float | None) -> None:
    from astropy.io import fits

    for name in (name for values, _ in columns.values() if isinstance(values, tuple) for name in values):
        if not name.isascii():
            raise InputError(f"source '{name}': FITS holds names of ASCII alone; rename it, or write .ecsv")
    hdu = fits.table_to_hdu(_table(columns, count, {}))
    hdu.header.extend(fits_cards())
    if freq_hz is not None:
        hdu.header["FREQ0"] = freq_hz, "Hz, of the fluxes"
    hdu.writeto(path)


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
PRESET_FORMS = {".csv": _preset_csv, ".ecsv": _preset_ecsv, ".fits": _preset_fits}
