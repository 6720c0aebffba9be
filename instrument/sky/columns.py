"""What the columns of source catalogues mean: common names, units in names, and the tables that surveys publish."""

from __future__ import annotations

import re
from collections.abc import Iterable
from dataclasses import dataclass, field

# meaning: (unit it is kept in, "" for a plain number, None for text; names it goes by, small letters)
MEANINGS: dict[str, tuple[str | None, tuple[str, ...]]] = {
    "ra": ("rad", ("ra", "raj2000", "_raj2000", "ra_j2000", "right_ascension", "radeg")),
    "dec": ("rad", ("dec", "dej2000", "decj2000", "_dej2000", "dec_j2000", "declination", "dedeg", "decdeg")),
    "i": ("Jy", ("i", "stokes_i", "flux", "total_flux", "flux_i", "int_flux", "integrated_flux", "flux_int", "fint")),
    "q": ("Jy", ("q", "stokes_q", "total_q", "flux_q")),
    "u": ("Jy", ("u", "stokes_u", "total_u", "flux_u")),
    "v": ("Jy", ("v", "stokes_v", "total_v", "flux_v")),
    "spectral_index": (
        "",
        ("spectral_index", "spectralindex", "alpha", "spec_indx", "spec_index", "sp_index", "spidx", "spi", "spix"),
    ),
    "spectral_curvature": ("", ("spectral_curvature",)),
    "ref_freq": (
        "Hz",
        ("ref_freq", "reference_frequency", "reffreq", "freq", "frequency", "referencefrequency", "freq0", "freq_ref"),
    ),
    "rotation_measure": ("rad / m2", ("rotation_measure", "rm", "rm_rad_m2", "rotation_measure_rad_m2")),
    # sizes of the source itself
    "major": (
        "rad",
        ("major", "major_axis", "majoraxis", "dc_maj", "deconv_maj", "deconv_major", "maj_axis_deconv", "dcmaj"),
    ),
    "minor": (
        "rad",
        ("minor", "minor_axis", "minoraxis", "dc_min", "deconv_min", "deconv_minor", "min_axis_deconv", "dcmin"),
    ),
    "angle": ("rad", ("angle", "position_angle", "posang", "orientation")),
    "true_angle": ("rad", ("dc_pa", "deconv_pa", "pos_ang_deconv", "dcpa")),
    # sizes that may hold the beam of the survey
    "fit_major": ("rad", ("maj", "maj_axis")),
    "fit_minor": ("rad", ("min", "min_axis")),
    "fit_angle": ("rad", ("pa", "pos_ang")),
    "name": (None, ("name", "source_name", "src_name", "component_name", "gaus_id", "source_id", "id", "rank")),
    "patch": (None, ("patch",)),
    "remark": (None, ("comment", "comments", "remark", "note", "notes")),  # says nothing about the sky
}
PREFERRED = ("name",)  # of several such columns the first of the list above is taken, the others are not read
OF_SURVEYS: dict[str, str | None] = {  # meanings that only the tables of surveys have
    "fallback_i": "Jy", "psf_major": "rad", "psf_minor": "rad", "psf_angle": "rad", "limit_major": None,
    "limit_minor": None,
}  # fmt: skip
KEPT = {meaning: unit for meaning, (unit, _) in MEANINGS.items()} | OF_SURVEYS
KNOWN = {name: meaning for meaning, (_, names) in MEANINGS.items() for name in names}
SUFFIXES = {"deg": "deg", "degrees": "deg", "rad": "rad", "arcmin": "arcmin", "arcsec": "arcsec", "asec": "arcsec"}
SUFFIXES |= {"jy": "Jy", "mjy": "mJy", "ujy": "uJy", "hz": "Hz", "khz": "kHz", "mhz": "MHz", "ghz": "GHz"}
BRACKETS = re.compile(r"(?P<name>[^\[(]*?)\s*[\[(](?P<unit>[^\])]*)[\])]\s*")
WITHIN_NAME = {"radeg": "deg", "dedeg": "deg", "decdeg": "deg"}
# what only a fit to an image has: beside these, unmarked sizes hold the beam of that image
FITTED_BESIDE = ("peak_flux", "peak_i", "flux_peak", "fpeak", "speak", "e_maj", "isl_rms", "rms_noise", "local_rms")


@dataclass(frozen=True)
class Survey:
    """How a survey or a source finder calls its columns, where they differ from the common names or lack units."""

    title: str
    marks: tuple[frozenset[str], ...]  # column names (small letters), any of these sets
    columns: dict[str, str] = field(default_factory=dict)
    units: dict[str, str] = field(default_factory=dict)  # by kind of quantity, for files that give none
    freq_hz: float | None = None
    sizes_are_true: bool = False
    published: str = ""  # columns that a sky is written in; those that mean nothing here are empty, and mark the table


def _marks(*alternatives: str) -> tuple[frozenset[str], ...]:
    return tuple(frozenset(a.split()) for a in alternatives)


ARCSEC_MJY = {"rad": "deg", "Jy": "mJy", "size": "arcsec"}
SURVEYS = (
    Survey(
        "TGSS ADR1",
        _marks("total_flux rms_noise mosaic_name", "tgssadr stotal"),
        {"stotal": "i", "tgssadr": "name"},
        ARCSEC_MJY,
        147.5e6,
        published="Source_name RA DEC Total_flux Maj Min PA RMS_noise Mosaic_name",
    ),
    Survey(
        "LoTSS",
        _marks("total_flux isl_rms mosaic_id", "speaktot maj min"),
        {"speaktot": "i", "source": "name"},
        ARCSEC_MJY,
        144e6,
        published="Source_Name RA DEC Total_flux DC_Maj DC_Min DC_PA Isl_rms Mosaic_ID",
    ),
    Survey(
        "GLEAM",
        _marks("int_flux_wide psf_a_wide", "fintwide psfawide"),
        {
            "int_flux_fit_200": "i", "int_flux_wide": "fallback_i", "a_wide": "fit_major", "b_wide": "fit_minor",
            "pa_wide": "fit_angle", "psf_a_wide": "psf_major", "psf_b_wide": "psf_minor", "psf_pa_wide": "psf_angle",
            "fintfit200": "i", "fintwide": "fallback_i", "awide": "fit_major", "bwide": "fit_minor",
            "pawide": "fit_angle", "psfawide": "psf_major", "psfbwide": "psf_minor", "psfpawide": "psf_angle",
            "gleam": "name",
        },
        {"rad": "deg", "Jy": "Jy", "size": "arcsec"},
        200e6,
        published="Name RAJ2000 DEJ2000 int_flux_wide a_wide b_wide pa_wide psf_a_wide psf_b_wide psf_pa_wide alpha "
        "int_flux_fit_200",
    ),
    Survey(
        "NVSS",
        _marks("s1.4 majaxis"),
        {"s1.4": "i", "majaxis": "fit_major", "minaxis": "fit_minor", "l_majaxis": "limit_major",
         "l_minaxis": "limit_minor", "nvss": "name"},
        ARCSEC_MJY,
        1.4e9,
        published="NVSS RAJ2000 DEJ2000 S1.4 l_MajAxis MajAxis l_MinAxis MinAxis PA",
    ),
    Survey(
        "FIRST",
        _marks("fint fitted_major", "fint fmaj"),
        {"first": "name", "maj": "major", "min": "minor", "pa": "angle"},
        ARCSEC_MJY,
        1.4e9,
        sizes_are_true=True,
        published="FIRST RAJ2000 DEJ2000 Fint Maj Min PA fMaj",
    ),
    Survey(
        "VLSS",
        _marks("si majax"),
        {"si": "i", "majax": "fit_major", "minax": "fit_minor", "l_majax": "limit_major", "l_minax": "limit_minor",
         "vlss": "name", "vlssr": "name"},
        {"rad": "deg", "Jy": "Jy", "size": "arcsec"},
        73.8e6,
        published="VLSS RAJ2000 DEJ2000 Si l_MajAx MajAx l_MinAx MinAx PA",
    ),
    Survey(
        "PyBDSF",
        _marks("total_flux isl_rms"),
        {},
        {"rad": "deg", "Jy": "Jy", "size": "deg"},
        published="Source_id RA DEC Total_flux DC_Maj DC_Min DC_PA Isl_rms Total_Q Total_U Total_V Spec_Indx",
    ),
    Survey(
        "Aegean",
        _marks("int_flux a b psf_a psf_b"),
        {"a": "fit_major", "b": "fit_minor", "psf_a": "psf_major", "psf_b": "psf_minor", "psf_pa": "psf_angle",
         "uuid": "name"},
        {"rad": "deg", "Jy": "Jy", "size": "arcsec"},
        published="ra dec int_flux a b pa uuid psf_a psf_b psf_pa",
    ),
)  # fmt: skip


def survey_of(names: Iterable[str]) -> Survey | None:
    """The survey or source finder whose columns these are; `None` where it is none that is known."""
    there = {bare(name)[0] for name in names}
    return next((s for s in SURVEYS if any(marks <= there for marks in s.marks)), None)


def bare(column: str) -> tuple[str, str | None]:
    """A column name in small letters without the unit that stands in brackets behind it, and that unit."""
    match = BRACKETS.fullmatch(column)
    name, unit = (match["name"], match["unit"].strip() or None) if match else (column, None)
    return re.sub(r"\s+", "_", name.strip().lower()), unit


def meaning_of(column: str, survey: Survey | None = None) -> tuple[str | None, str | None]:
    """Meaning of a column name and the unit that the name gives; `None` for what is not known."""
    name, unit = bare(column)
    if survey and name in survey.columns:
        return survey.columns[name], unit
    if name in KNOWN:
        return KNOWN[name], unit or WITHIN_NAME.get(name)
    base, _, suffix = name.rpartition("_")
    if base in KNOWN and suffix in SUFFIXES and unit in (None, SUFFIXES[suffix]):
        return KNOWN[base], SUFFIXES[suffix]
    return None, unit


def default_unit(survey: Survey | None, meaning: str) -> str | None:
    """The unit in which a survey publishes a quantity whose column does not say it."""
    kept = KEPT[meaning]
    size = any(word in meaning for word in ("major", "minor"))
    return None if survey is None or not kept else survey.units.get("size" if size else kept)
