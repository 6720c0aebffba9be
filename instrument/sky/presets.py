"""A sky in the columns, units and frequency of a survey or source finder: pure arrays, files are `writers`' matter."""

from __future__ import annotations

from typing import Any, TypeVar

import numpy as np

from instrument.errors import InputError, did_you_mean
from instrument.files_in import harmless
from instrument.sky.columns import KEPT, SURVEYS, Survey, default_unit, meaning_of
from instrument.sky.sources import Sources
from instrument.sky.table_sky import deconvolved, tgss_beam
from instrument.sky.tables import unit_scale
from instrument.units import Float

S = TypeVar("S", bound=Sources)
PRESETS = {survey.title.split()[0]: survey for survey in SURVEYS}


def preset_of(name: Any) -> Survey:
    """The survey or source finder of a name, capital letters or not; raises `InputError` for others."""
    folded = {key.lower(): survey for key, survey in PRESETS.items()}
    if str(name).lower() not in folded:
        raise InputError(f"preset = '{harmless(name, 60)}' is none: {did_you_mean(harmless(name, 60), PRESETS)}")
    return folded[str(name).lower()]


def beam_of(survey: Survey, dec_rad: Float) -> tuple[Float, Float, Float] | None:
    """Axes and angle of the beam that the sizes of a table hold, 0 where it stands in columns; `None` without any."""
    meanings = _meanings(survey).values()
    if "fit_major" not in meanings or "limit_major" in meanings:
        return None
    none = np.zeros(len(dec_rad))
    return tgss_beam(dec_rad) if survey.title == "TGSS ADR1" else (none, none, none)


def _meanings(survey: Survey) -> dict[str, str | None]:
    return {name: meaning_of(name, survey)[0] for name in survey.published.split()}


def held(survey: Survey) -> set[str]:
    """Which of "polarization" and "spectral index" a table has columns for."""
    meanings = _meanings(survey).values()
    return {text for text, m in (("polarization", "q"), ("spectral index", "spectral_index")) if m in meanings}


def published(sky: S, survey: Survey) -> tuple[S, list[str]]:
    """The same sources as a table has them, and what is lost of them.

    Right ascensions are from 0 to 2 pi, the longer axis is first, angles are from 0 to pi; fluxes are at the frequency
    of the survey (of the first source, where it has none) by their spectra.
    """
    if (beam := beam_of(survey, sky.dec_rad)) is not None and np.any(low := beam[0] < 0):
        name = harmless(sky.names[int(np.argmax(low))], 60)
        raise InputError(f"source '{name}' lies below -71 deg, where {survey.title} has no beam; write another preset")
    lost = ["patches"] if any(sky.patches) else []
    names, none = sky.names, np.zeros(len(sky))
    if "Source_id" in _meanings(survey) and not all(n.isdecimal() and n.isascii() for n in names):
        names, lost = tuple(str(k) for k in range(len(sky))), [*lost, "names (its sources have numbers)"]
    a, b, angle = (none if x is None else np.asarray(x) for x in (sky.major_rad, sky.minor_rad, sky.angle_rad))
    longer = b > a
    angle = np.where(a == b, 0.0, np.where(longer, angle + np.pi / 2, angle)) % np.pi
    there: dict[str, Any] = {"names": names, "patches": (), "ra_rad": sky.ra_rad % (2 * np.pi)}
    there |= {"major_rad": np.maximum(a, b), "minor_rad": np.minimum(a, b), "angle_rad": angle}
    given = sky.reference_hz
    freq = survey.freq_hz or (None if given is None else float(given[0]))
    if freq is not None:
        if given is not None and sky.spectral_terms is not None:
            moved = (given != freq)[:, None]
            there["stokes_jy"] = np.where(moved, sky.stokes(np.array([freq]))[0], sky.stokes_jy)
        there["reference_hz"] = np.full(len(sky), freq)
    return sky.with_fields(**there), lost


def columns_of(sky: Sources, survey: Survey) -> dict[str, tuple[Any, str | None]]:
    """Values and unit of each column for what `published` has made; `None` for values that a sky does not have."""
    sizes: dict[str, Any] = {"major": sky.major_rad, "minor": sky.minor_rad, "angle": sky.angle_rad}
    beam = beam_of(survey, sky.dec_rad)
    fitted = sizes if beam is None else deconvolved(sizes, *beam, sign=1)
    values: dict[str, Any] = {"name": sky.names, "ra": sky.ra_rad, "dec": sky.dec_rad}
    values |= {stokes: sky.stokes_jy[:, k] for k, stokes in enumerate("iquv")} | {"fallback_i": sky.stokes_jy[:, 0]}
    values |= sizes | {"true_angle": sky.angle_rad} | {f"fit_{name}": value for name, value in fitted.items()}
    values |= {f"psf_{name}": np.zeros(len(sky)) for name in sizes}  # nothing has blurred a sky
    if sky.spectral_terms is not None:
        values["spectral_index"] = sky.spectral_terms[:, 0]
    out: dict[str, tuple[Any, str | None]] = {}
    for name, meaning in _meanings(survey).items():
        if meaning in ("q", "u", "v") and not sky.stokes_jy[:, 1:].any():
            continue
        if meaning == "spectral_index" and sky.spectral_terms is None:
            continue
        if meaning is None or meaning not in values:
            out[name] = (None, None)
            continue
        unit = default_unit(survey, meaning)
        found = values[meaning]
        out[name] = (found if KEPT[meaning] is None else _scaled(found, KEPT[meaning], unit), unit)
    return out


def _scaled(found: Any, kept: str | None, unit: str | None) -> Float:
    if kept == "rad" and unit == "deg":
        return np.asarray(np.rad2deg(found))
    scale = unit_scale(unit, kept) if unit and kept else None
    return np.asarray(found if scale is None else found / scale)
