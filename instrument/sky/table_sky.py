"""From the columns of a table to a sky: units, values that are no data, sizes that hold a beam, and what stays open."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Literal, TypeVar

import numpy as np

from instrument.files_in import SHOWN, harmless
from instrument.sky.bbs_text import broken, made
from instrument.sky.columns import FITTED_BESIDE, KEPT, MEANINGS, bare, default_unit
from instrument.sky.sources import Sources
from instrument.sky.tables import Column, Table, say, say_unread, unit_scale
from instrument.units import Float

S = TypeVar("S", bound=Sources)
# values that catalogues write where they have none; an angle or a rotation measure of -99 may be meant
PLACEHOLDERS = (-999.0, -9999.0, -99999.0)
HAVE_NO_EFFECT = (
    "q", "u", "v", "spectral_index", "spectral_curvature", "rotation_measure", "major", "minor", "angle",
)  # fmt: skip
ARCSEC = np.pi / 180 / 3600
Sizes = Literal["as given", "points"]
Incomplete = Literal["refuse", "leave out", "no effect"]


@dataclass(frozen=True)
class Choices:
    """What the reader of a table has to be told where the table leaves it open; see `forms.read_as`."""

    sizes: Sizes | None = None
    beam_rad: float | None = None
    freq_hz: float | None = None
    incomplete: Incomplete = "refuse"


def sky_of(make: type[S], table: Table, choices: Choices) -> S:
    """The sky of a table, a list of the class `make`; raises `FileError` with line or row, column and remedy."""
    _refuse_misspelt(table)
    if not len(table):
        raise broken(table.path, None, "no source in it")
    values = {m: _values(table, m, c) for m, c in table.columns.items() if KEPT[m] is not None}
    if "fallback_i" in values:  # a flux that is measured stands for one whose fit has failed
        fallback = values.pop("fallback_i")
        values["i"] = np.where(np.isfinite(values["i"]), values["i"], fallback) if "i" in values else fallback
        table.columns.setdefault("i", table.columns["fallback_i"])
    sizes = _sizes(table, values, choices)
    for meaning in [m for m in values if m.startswith(("fit_", "psf_")) or m in ("major", "minor", "true_angle")]:
        del values[meaning]
    values.pop("angle", None)
    values |= sizes
    rows = _complete(table, values, choices)
    _within_sky(table, values, rows)
    _frequency(table, values, choices)
    _need(table, values, "spectral_index", ("spectral_curvature",))
    unread = say_unread(table)
    chosen = {m: v[rows] for m, v in values.items()}
    names = table.columns["name"].texts if "name" in table.columns else None
    patches = table.columns["patch"].texts if "patch" in table.columns else None
    return _sky(make, table, chosen, rows, names, patches, unread)


def _values(table: Table, meaning: str, column: Column) -> Float:
    """A column in the unit its meaning is kept in, NaN where there is nothing; placeholders count as nothing."""
    found = np.array(column.numbers)
    for placeholder in _placeholders(meaning):
        there = np.flatnonzero(found == placeholder)
        if len(there):
            column.missing[int(there[0])] = f"{placeholder:g}, which stands for 'no data'"
            found[there] = np.nan
    if column.sexagesimal and column.sexagesimal < int(np.isfinite(found).sum()):
        name = harmless(column.name, SHOWN)
        raise broken(table.path, None, f"{name} is written as hh:mm:ss and as a plain number; write all alike")
    scale = np.deg2rad(1.0) if column.sexagesimal else _scale(table, meaning, column)
    return np.asarray(scale * found)


def _placeholders(meaning: str) -> tuple[float, ...]:
    if "angle" in meaning or meaning in ("ra", "rotation_measure"):
        return PLACEHOLDERS
    return (*PLACEHOLDERS, -99.0, *((999.0, 9999.0, 99.0) if meaning.startswith("spectral") else ()))


def _scale(table: Table, meaning: str, column: Column) -> float:
    """Factor from the unit of a column to the one its meaning is kept in."""
    kept, name = KEPT[meaning] or "", harmless(column.name, SHOWN)
    unit = column.unit or default_unit(table.survey, meaning)
    if unit is None:
        if kept in ("", "rad / m2"):
            return 1.0
        stem = bare(column.name)[0]
        example = {"rad": f"{stem}_deg or {stem}_arcsec", "Jy": f"{stem}_jy", "Hz": f"{stem}_hz"}[kept]
        raise broken(table.path, None, f"column '{name}' has no unit; name it like {example}")
    scale = unit_scale(unit, kept)
    if scale is None:
        why = f"'{harmless(unit, SHOWN)}', which is not convertible to {kept or 'no unit'}"
        raise broken(table.path, None, f"column '{name}' is in {why}")
    return scale


# Sizes -----------------------------------------------------------------------------------------------------------


def _sizes(table: Table, values: dict[str, Float], choices: Choices) -> dict[str, Float]:
    """`major`, `minor`, `angle` of the sources themselves, without the beam they were seen with; {} for points."""
    if choices.sizes == "points":
        _leave(table, "major", "minor", "angle", "true_angle", "fit_major", "fit_minor", "fit_angle")
        return {}
    if "major" in values or "minor" in values:
        _need(table, values, "minor", ("major",))
        _need(table, values, "major", ("minor",))
        angle = "true_angle" if "true_angle" in values else "angle" if "angle" in values else "fit_angle"
        if "fit_major" in values and angle == "fit_angle":
            angle = "none of the source itself"  # it belongs to the fitted size
        _leave(table, "fit_major", "fit_minor", *(a for a in ("angle", "true_angle", "fit_angle") if a != angle))
        return _ellipses(table, values, "major", "minor", angle)
    if "fit_major" not in values and "fit_minor" not in values:
        _need(table, values, "major", ("angle",))
        _leave(table, "angle", "true_angle", "fit_angle")
        return {}
    _need(table, {**values, "minor": values.get("fit_minor")}, "fit_minor", ("fit_major",))
    _need(table, values, "fit_major", ("fit_minor",))
    angle = next((a for a in ("fit_angle", "angle", "true_angle") if a in values), "fit_angle")
    found = _ellipses(table, values, "fit_major", "fit_minor", angle)
    return _without_beam(table, values, found, choices)


def _without_beam(
    table: Table, values: dict[str, Float], found: dict[str, Float], choices: Choices
) -> dict[str, Float]:
    """Fitted sizes with the beam taken out, where it is known; refused or warned of where it is not."""
    title = table.survey.title if table.survey else None
    if "limit_major" in table.columns:
        for axis in ("major", "minor"):
            limits = table.columns.get(f"limit_{axis}")
            if limits is not None and limits.texts is not None:
                found[axis] = np.where([t == "<" for t in limits.texts], 0.0, found[axis])
        unangled = (found["major"] == found["minor"]) & ~np.isfinite(found["angle"])
        # such sizes are deconvolved already, and what is only a limit is none
        return {**found, "angle": np.where(unangled, 0.0, found["angle"])}
    if choices.sizes == "as given":
        return found
    if title in ("NVSS", "VLSS"):
        raise broken(
            table.path, None, f"sizes of the {title} are upper limits where l_{table.columns['fit_major'].name} says "
            "'<', and that column is not there; fetch it too, or say sizes='points'"
        )  # fmt: skip
    if choices.beam_rad is not None:
        beam = (np.array(choices.beam_rad), np.array(choices.beam_rad), np.array(0.0))
    elif "psf_major" in values and "psf_minor" in values:
        beam = (values["psf_major"], values["psf_minor"], values.get("psf_angle", np.array(0.0)))
    elif title == "TGSS ADR1":
        beam = tgss_beam(values["dec"])
    else:
        names = [harmless(table.columns[m].name, SHOWN) for m in ("fit_major", "fit_minor")]
        beside = {bare(n)[0] for n in [*table.others, *(c.name for c in table.columns.values())]}
        fitted = title is not None or any(n.startswith(FITTED_BESIDE) for n in beside)
        if fitted:
            raise broken(
                table.path, None, f"{names[0]}, {names[1]} are sizes fitted to an image, which hold its beam, and "
                "there are no deconvolved ones (DC_Maj); say sizes='points', sizes='as given', or beam='6 arcsec'"
            )  # fmt: skip
        say(
            table, f"{names[0]}, {names[1]} are taken as sizes of the sources themselves; if they hold the beam of an "
            "image, say beam='6 arcsec' (its size) or sizes='points'; sizes='as given' keeps this quiet"
        )  # fmt: skip
        return found
    return deconvolved(found, *beam)


def _ellipses(table: Table, values: dict[str, Float], major: str, minor: str, angle: str) -> dict[str, Float]:
    a, b = values[major], values[minor]
    if angle not in values:
        if np.any(np.abs(a - b) > 0):
            _need(table, {"major": a}, "angle", ("major",))
        return {"major": a, "minor": b, "angle": np.zeros(len(a))}
    # a circle or a point needs no angle: what is missing there is not missed
    return {"major": a, "minor": b, "angle": np.where((a == b) & ~np.isfinite(values[angle]), 0.0, values[angle])}


def tgss_beam(dec_rad: Float) -> tuple[Float, Float, Float]:
    """Intema et al. 2017: 25 arcsec, longer to the north where the array looks down."""
    north = np.cos(np.minimum(dec_rad - np.deg2rad(19), 0.0))
    return 25 * ARCSEC / north, np.array(25 * ARCSEC), np.array(0.0)


def deconvolved(found: dict[str, Float], major: Float, minor: Float, angle: Float, sign: int = -1) -> dict[str, Float]:
    """Gaussians with the beam taken out (second moments subtracted), or put in; an axis below the beam becomes 0."""
    axx, ayy, axy = (
        x + sign * y
        for x, y in zip(
            moments(found["major"], found["minor"], found["angle"]), moments(major, minor, angle), strict=True
        )
    )
    mean, half = 0.5 * (axx + ayy), np.hypot(0.5 * (axx - ayy), axy)
    # rounding of the squares: 1e-12 of the beam's own is no size
    floor = 1e-12 * np.asarray(major) ** 2
    a, b = mean + half, mean - half
    return {
        "major": np.where(np.isnan(a), np.nan, np.sqrt(np.where(a > floor, a, 0.0))),
        "minor": np.where(np.isnan(b), np.nan, np.sqrt(np.where(b > floor, b, 0.0))),
        "angle": np.where(half > floor, 0.5 * np.arctan2(2 * axy, axx - ayy), 0.0),
    }


def moments(major: Float, minor: Float, angle: Float) -> tuple[Float, Float, Float]:
    """North-north, east-east and north-east elements of a Gaussian's squared widths."""
    c, s = np.cos(angle), np.sin(angle)
    return major**2 * c**2 + minor**2 * s**2, major**2 * s**2 + minor**2 * c**2, (major**2 - minor**2) * s * c


def _leave(table: Table, *meanings: str) -> None:
    """Counts columns among those that were not read."""
    for meaning in meanings:
        if meaning in table.columns:
            table.others.append(table.columns.pop(meaning).name)


# Rows ------------------------------------------------------------------------------------------------------------


def _complete(table: Table, values: dict[str, Float], choices: Choices) -> Any:
    """Rows of the sources that have every value; with a choice the others are left out, or lack the effect."""
    whole = np.ones(len(table), bool)
    for meaning, found in values.items():
        bad = ~np.isfinite(found)
        if not bad.any():
            continue
        column = table.columns.get(meaning) or table.columns.get(f"fit_{meaning}") or table.columns[f"true_{meaning}"]
        name = harmless(column.name, SHOWN)
        if choices.incomplete == "no effect" and meaning in HAVE_NO_EFFECT:
            values[meaning] = np.where(bad, 0.0, found)
            say(table, f"{bad.sum()} of {len(bad)} sources have no {name} and are taken without its effect (0)")
        elif choices.incomplete == "leave out":
            whole &= ~bad
            say(table, f"{bad.sum()} of {len(bad)} sources have no {name} and are left out")
        else:
            k = int(np.argmax(bad))
            what, more = column.missing.get(k, "no number"), f" ({bad.sum()} sources in all)" if bad.sum() > 1 else ""
            remedy = "give the value (0 for none) or remove the source"
            ways = "; or say incomplete='leave out'" + (", 'no effect'" if meaning in HAVE_NO_EFFECT else "")
            raise broken(table.path, int(table.where[k]), f"{name} is {what}{more}; {remedy}{ways}", table.kind)
    if not whole.any():
        raise broken(table.path, None, "no source has every value; give the values, or say incomplete='no effect'")
    return np.flatnonzero(whole)


def _within_sky(table: Table, values: dict[str, Float], rows: Any) -> None:
    for meaning, limit in (("ra", 360.0), ("dec", 90.0)):
        degrees = np.rad2deg(values[meaning])
        beyond = np.flatnonzero(np.abs(degrees[rows]) > limit * (1 + 1e-12))
        if len(beyond):
            k = int(rows[beyond[0]])
            column = table.columns[meaning]
            shown = float(np.asarray(column.numbers)[k])
            name = harmless(column.name, SHOWN)
            raise broken(table.path, int(table.where[k]), f"{name} = {shown:.12g} is beyond the sky", table.kind)


def _frequency(table: Table, values: dict[str, Float], choices: Choices) -> None:
    """The frequency of the fluxes: of its column, the file's header, the survey, or as told; in that order."""
    if "ref_freq" in values:
        return
    known = choices.freq_hz or table.freq_hz or (table.survey.freq_hz if table.survey else None)
    if known is not None:
        values["ref_freq"] = np.full(len(table), known)
        return
    for meaning in ("spectral_index", "spectral_curvature", "rotation_measure"):
        if meaning in values:
            known_names = ", ".join(MEANINGS["ref_freq"][1][:4])
            raise broken(
                table.path, None, f"column {meaning} needs a column ref_freq ({known_names}), or frequency='150 MHz' "
                "of the fluxes"
            )  # fmt: skip


def _need(table: Table, values: Any, wanted: str, by: tuple[str, ...]) -> None:
    for meaning in by:
        if meaning in values and wanted not in values:
            raise broken(
                table.path, None, f"column {meaning} needs a column {wanted} ({', '.join(MEANINGS[wanted][1])})"
            )


def _refuse_misspelt(table: Table) -> None:
    """A name that is nearly one of a meaning that is not there yet is refused; others are named as not read."""
    import difflib

    from instrument.sky.columns import KNOWN

    for column in table.others:
        name = bare(column)[0]
        if name.startswith(("e_", "err")) or name.endswith(("err", "error")) or table.survey:
            continue
        near = difflib.get_close_matches(name, [k for k in KNOWN if len(k) > 4], n=1, cutoff=0.9)
        if near and KNOWN[near[0]] not in table.columns:
            shown = harmless(column, SHOWN)
            raise broken(table.path, None, f"column '{shown}' is not known; did you mean '{near[0]}'? Rename it")


def _sky(
    make: type[S],
    table: Table,
    data: dict[str, Float],
    rows: Any,
    names: Any,
    patches: Any,
    unread: tuple[str, ...],
) -> S:
    none = np.zeros(len(rows))
    terms = [data[t] for t in ("spectral_index", "spectral_curvature") if t in data]
    if len(rows) > 2 and terms and np.median(terms[0]) > 0.3:
        say(table, f"most spectral indices are positive (median {np.median(terms[0]):.2g}); fluxes go as (f/f0)^index")
    return made(
        make,
        table.path,
        names=tuple(names[k] for k in rows) if names else tuple(f"s{k}" for k in rows),
        patches=tuple(patches[k] for k in rows) if patches and any(patches) else (),
        ra_rad=data["ra"],
        dec_rad=data["dec"],
        stokes_jy=np.stack([data["i"], *(data.get(s, none) for s in "quv")], axis=1),
        reference_hz=data.get("ref_freq"),
        spectral_terms=np.stack(terms, axis=1) if terms else None,
        rotation_measure=data.get("rotation_measure"),
        major_rad=data.get("major"),
        minor_rad=data.get("minor"),
        angle_rad=data.get("angle"),
        not_read=(f"{harmless(table.path.name)}: {', '.join(unread)}",) if unread else (),
    )
