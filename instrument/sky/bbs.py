"""BBS sky models: `read_bbs` and its inverse `write_bbs`, for the text form of makesourcedb, DP3, WSClean and LSMTool.

Facts of the format (checked against the reader of DP3 and the makesourcedb page of the LOFAR wiki): one format line
names the fields, sets defaults (`Field='value'`) and fixed values (`Field=fixed'value'`); the field `dummy` is skipped.
Positions are J2000. Fluxes are in Jy at ReferenceFrequency, spectral terms belong to Stokes I alone, except that a
source with a RotationMeasure carries Q and U as a fraction of I(frequency). Axes are full widths at half maximum in
arcsec, and "MajorAxis" may be the shorter one: the orientation belongs to it.
"""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from instrument.errors import InputError, did_you_mean, unused, warn
from instrument.files_in import SHOWN, harmless
from instrument.observe.directions import LIGHT, tangents
from instrument.sky.bbs_text import Line, angle, broken, lines_of
from instrument.sky.sources import Sources
from instrument.units import Direction, Float
from instrument.whole_file import whole_file

S = TypeVar("S", bound=Sources)
ARCSEC = np.pi / 180 / 3600
MISORIENTED = np.deg2rad(0.1)  # orientations of fitted components are rarely better than a degree


def _shape(line: Line) -> tuple[float, float, float]:
    """Axes in rad and the orientation in rad as the file counts it; zeros for a point."""
    kind = line["Type"].lower()
    if kind not in ("", "point", "gaussian"):
        raise line.fail(f"Type = '{line['Type']}' cannot be kept; POINT and GAUSSIAN can, remove or replace the source")
    if kind == "point":
        for field in ("MajorAxis", "MinorAxis", "Orientation"):
            if line[field].startswith("["):  # a spectral index, say: the columns are shifted
                shown = harmless(line[field], SHOWN)
                raise line.fail(
                    f"Type is POINT but {field} = '{shown}'; put the columns in the order of the format line"
                )
            line.real(field, 0.0)
        return 0.0, 0.0, 0.0
    if not kind:
        if line.real("MajorAxis", 0.0) or line.real("MinorAxis", 0.0):
            raise line.fail("Type is empty but axes are given; write POINT or GAUSSIAN")
        return 0.0, 0.0, 0.0
    axes = line.real("MajorAxis"), line.real("MinorAxis")
    if min(axes) < 0:
        raise line.fail(f"an axis of {min(axes):g} arcsec is negative")
    orientation = line.real("Orientation", 0.0 if axes[0] == axes[1] else None)
    return axes[0] * ARCSEC, axes[1] * ARCSEC, float(np.deg2rad(orientation))


def _check_polarization(line: Line) -> None:
    rotation, fraction = line["RotationMeasure"], [line["PolarizedFraction"], line["PolarizationAngle"]]
    linear, wavelength = [line["Q"], line["U"]], line["ReferenceWavelength"]
    if not rotation:
        if any(fraction) or wavelength:
            raise line.fail(
                "PolarizedFraction, PolarizationAngle or ReferenceWavelength without RotationMeasure; give it, 0 too"
            )
    elif not (all(linear) and not any(fraction)) and not (all(fraction) and not any(linear)):
        raise line.fail("RotationMeasure needs either Q and U, or PolarizedFraction and PolarizationAngle, not both")
    elif any(fraction) and wavelength and line.real("ReferenceWavelength"):
        raise line.fail("PolarizationAngle is that of wavelength 0; remove ReferenceWavelength, or give Q and U")
    elif wavelength and line.real("ReferenceWavelength") < 0:
        raise line.fail(f"ReferenceWavelength = '{wavelength}' is negative")
    elif any(linear) and not wavelength and not line.real("ReferenceFrequency", 0.0):
        raise line.fail("RotationMeasure with Q and U needs ReferenceFrequency or ReferenceWavelength")


def _source(line: Line) -> dict[str, Any]:
    """One source as plain numbers, by the names of the fields of `Sources` and a few more."""
    ra, dec = angle(line, "Ra"), angle(line, "Dec")
    if ra is None or dec is None:
        raise line.fail(f"{'Ra' if ra is None else 'Dec'} of '{line['Name']}' is missing")
    if line["RefType"].upper() not in ("", "J2000"):
        raise line.fail(f"RefType = '{line['RefType']}' is not J2000; convert the positions first")
    _check_polarization(line)
    frequency, terms = line.real("ReferenceFrequency", 0.0), line.terms()
    if frequency < 0 or (frequency == 0 and terms):
        raise line.fail("SpectralIndex needs a positive ReferenceFrequency")
    wavelength = line.real("ReferenceWavelength", 0.0)
    fractional, rotates = bool(line["PolarizedFraction"]), bool(line["RotationMeasure"])
    intensity, logarithmic = line.real("I"), line.flag("LogarithmicSI", True)
    if rotates and any(terms) and line.real("V", 0.0):
        raise line.fail("V with RotationMeasure and SpectralIndex cannot be kept: Q and U follow I, V would not")
    if rotates and any(terms) and intensity == 0:
        raise line.fail("I = 0 with RotationMeasure and SpectralIndex: Q and U are a fraction of I, which is then 0")
    chi0 = line.real("PolarizationAngle", 0.0)
    linear = line.real("PolarizedFraction", 0.0) * intensity * np.exp(2j * chi0) if fractional else (
        line.real("Q", 0.0) + 1j * line.real("U", 0.0)
    )  # fmt: skip
    return {
        "name": line["Name"], "patch": line["Patch"], "ra": ra, "dec": dec, "i": intensity, "v": line.real("V", 0.0),
        "linear": linear, "at_zero": fractional, "wavelength": wavelength, "rm": line.real("RotationMeasure", 0.0),
        "rotates": rotates, "frequency": frequency or (LIGHT / wavelength if wavelength else 0.0), "terms": terms,
        "log": logarithmic, "shape": _shape(line), "absolute": line.flag("OrientationIsAbsolute", False),
    }  # fmt: skip


def read_bbs(make: type[S], path: Path, text: Sequence[str], centre: Direction | None = None) -> S:
    """Sources of BBS text, a list of the class `make`; raises `FileError` with line and field.

    Orientations count from the m axis of the phase centre unless OrientationIsAbsolute: from `centre` they are turned
    into angles from each source's own north (minus the angle of that north in the l, m plane of the centre). DP3 draws
    such an ellipse flat in that plane instead, without w: 1 % apart in the visibilities of a 90 arcsec source 4.5 deg
    away; absolute ones agree with it to the rounding of its complex64. Without
    `centre` they are taken as they stand, as if each source were at the phase centre, and an `InstrumentWarning` says
    so where, about the middle of the file, that would turn an ellipse by more than 0.1 deg. Directions of patches
    are not kept: a patch is a name.
    """
    patches: set[str] = set()
    names: dict[tuple[str, str], int] = {}
    rows, flat, without_name = [], [], []
    for line in lines_of(path, text):
        name, patch = line["Name"], line["Patch"]
        if not name:  # a patch, also where its line carries a Type
            if not patch:
                raise line.fail("no Name; a source needs one, and a patch is a line with Patch but no Name")
            if line.real("I", 0.0):
                without_name.append(f"line {line.number}")
            if patch in patches:
                raise line.fail(f"patch '{patch}' is defined twice; remove one")
            patches.add(patch)
            angle(line, "Ra"), angle(line, "Dec")
            continue
        if patch and patch not in patches:
            hint = did_you_mean(patch, patches)
            raise line.fail(f"patch '{patch}' is not defined before the source that uses it: {hint}")
        if (patch, name) in names:
            earlier = names[patch, name]
            raise line.fail(f"source '{name}' was there before, on line {earlier}; rename or remove one")
        names[patch, name] = line.number
        rows.append(_source(line))
        if line["Type"].lower() == "point" and (line.real("MajorAxis", 0.0) or line.real("MinorAxis", 0.0)):
            flat.append(f"line {line.number}")
    if not rows:
        raise broken(path, None, "no source in it")
    unused(harmless(path.name), flat, "axes of a POINT")
    unused(harmless(path.name), without_name, "a patch has no flux, and a source needs a Name")
    _unique(path, rows)
    return _sky(make, path, rows, centre)


def _unique(path: Path, rows: list[dict[str, Any]]) -> None:
    """Names that stand in several patches become "patch:name" after the first: only so can they be written back."""
    taken = {r["name"] for r in rows}
    seen: set[str] = set()
    made: list[str] = []
    for row in rows:
        if row["name"] in seen:
            row["name"] = f"{row['patch']}:{row['name']}"
            while row["name"] in taken:
                row["name"] += "+"
            made.append(row["name"])
            taken.add(row["name"])
        seen.add(row["name"])
    if made:
        names, what = ("name stands", "is") if len(made) == 1 else ("names stand", "are")
        warn(
            f"{harmless(path.name)}: {len(made)} {names} in several patches and {what} made unique by the patch, as "
            f"'{harmless(made[0], 60)}'"
        )


def _sky(make: type[S], path: Path, rows: list[dict[str, Any]], centre: Direction | None) -> S:
    def column(key: str) -> Any:
        return np.array([r[key] for r in rows])

    frequency = column("frequency")
    known = frequency[frequency > 0]
    # a source without ReferenceFrequency is constant in frequency, so that any reference does for it
    frequency = np.where(frequency > 0, frequency, known[0] if len(known) else 150e6)
    width = max(len(r["terms"]) for r in rows)
    shape, rotates, rm = column("shape"), column("rotates"), column("rm")
    sky = make(
        names=tuple(r["name"] for r in rows),
        patches=tuple(r["patch"] for r in rows) if any(r["patch"] for r in rows) else (),
        ra_rad=column("ra"),
        dec_rad=column("dec"),
        stokes_jy=np.stack([column("i"), 0 * rm, 0 * rm, column("v")], axis=1),
        reference_hz=frequency if len(known) or rotates.any() else None,
        spectral_terms=np.array([r["terms"] + [0.0] * (width - len(r["terms"])) for r in rows]) if width else None,
        logarithmic=None if column("log").all() else column("log"),
        rotation_measure=rm if rotates.any() else None,
        polarization_follows_i=rotates if rotates.any() and width else None,
    )
    # Q, U as they stand at the reference frequency: turned back from where the file gives them, and scaled with I
    given = np.where(column("wavelength") > 0, column("wavelength"), LIGHT / frequency)
    squared = np.where(column("at_zero"), 0.0, given**2)
    linear = column("linear") * np.exp(2j * rm * ((LIGHT / frequency) ** 2 - squared))
    for k in np.flatnonzero(rotates & (column("wavelength") > 0) & (sky.stokes_jy[:, 0] != 0)):
        linear[k] *= sky.stokes_jy[k, 0] / sky.select([int(k)]).stokes(np.array([LIGHT / given[k]]))[0, 0, 0]
    fields: dict[str, Any] = {"stokes_jy": np.stack([column("i"), linear.real, linear.imag, column("v")], axis=1)}
    if (shape[:, :2] > 0).any():
        turned = ~column("absolute") & (shape[:, 0] != shape[:, 1])
        absolute = shape[:, 2] + np.where(turned, _convergence(path, sky, centre, turned), 0.0)
        fields.update(major_rad=shape[:, 0], minor_rad=shape[:, 1], angle_rad=absolute)
    return sky.with_fields(**fields)


def _convergence(path: Path, sky: Sources, centre: Direction | None, turned: Any) -> Float | float:
    """What turns an orientation in the l, m plane of the centre into one from the source's own north, rad (S,)."""
    at = centre or sky.middle
    (east,), (north,) = tangents(np.array([at.ra_rad]), np.array([at.dec_rad]))
    own_north = tangents(sky.ra_rad, sky.dec_rad)[1]
    turn = -np.arctan2(own_north @ east, own_north @ north)
    if centre is not None:
        return np.asarray(turn)
    worst = np.abs(turn[turned]).max(initial=0.0)
    if worst > MISORIENTED:
        warn(
            f"{harmless(path.name)}: {turned.sum()} orientations count from the phase centre of the model, which is "
            f"not given, and are taken as angles at the sources; about the middle of the file that turns them by up to "
            f"{np.rad2deg(worst):.2g} deg; give it as read(path, centre=...)"
        )
    return 0.0


WRITTEN = (
    "Name", "Type", "Patch", "Ra", "Dec", "I", "Q", "U", "V", "ReferenceFrequency", "SpectralIndex", "LogarithmicSI",
    "RotationMeasure", "MajorAxis", "MinorAxis", "Orientation", "OrientationIsAbsolute",
)  # fmt: skip
UNWRITABLE = re.compile(r"[,'\"\[\]\n\r]|^\s|\s$|^#|^$|^format\s*=", re.IGNORECASE)


def write_bbs(path: Any, sky: Sources, overwrite: bool = False) -> None:
    """Write a sky as BBS text that `read_bbs` (and DP3) read back; raises `InputError` for what the format cannot hold.

    Values are written with all their digits, positions in degrees, orientations as absolute ones. A patch stands at
    the mean direction of its sources, weighted with |I|.
    """
    _check_names(sky)
    rows = [_written(sky, k) for k in range(len(sky))]
    used = [k for k in range(len(WRITTEN)) if any(row[k] for row in rows)]
    out = [f"FORMAT = {', '.join(WRITTEN[k] for k in used)}", ""]
    for patch in dict.fromkeys(p for p in sky.patches if p):
        middle = sky.select([k for k, p in enumerate(sky.patches) if p == patch]).middle
        out.append(f", , {patch}, {_degrees(middle.ra_rad)}, {_degrees(middle.dec_rad)}")
    out += [", ".join(row[k] for k in used) for row in rows]
    with whole_file(path, overwrite) as partial:
        partial.write_text("\n".join(out) + "\n", encoding="utf-8")


def _check_names(sky: Sources) -> None:
    for kind, names in (("source", sky.names), ("patch", [p for p in sky.patches if p])):
        for name in names:
            if UNWRITABLE.search(name):
                raise InputError(
                    f"{kind} name '{name}' cannot be written as BBS text; use one without commas, quotes, brackets, "
                    "outer blanks or a leading #"
                )
    twice = [n for n, seen in Counter(sky.names).items() if seen > 1]
    if twice:
        raise InputError(f"source name '{twice[0]}' stands twice; BBS text needs every name once")


def _degrees(angle_rad: Any) -> str:
    return f"{float(np.rad2deg(angle_rad))!r}deg"


def _written(sky: Sources, k: int) -> list[str]:
    """The fields of one source, in the order of the format line."""

    def of(values: Any, default: Any = 0.0) -> Any:
        return default if values is None else values[k].tolist()

    i, q, u, v = sky.stokes_jy[k].tolist()
    terms, rm, follows = of(sky.spectral_terms, []), of(sky.rotation_measure), of(sky.polarization_follows_i, False)
    curved, linear = any(terms), bool(q or u)
    if curved and (((follows or rm) and v) or (linear and rm and not follows) or (linear and follows and not i)):
        raise InputError(
            f"source '{sky.names[k]}': BBS text has Q and U follow the spectrum of I exactly where there is a rotation "
            "measure, V never, and none of them with I = 0; remove the spectral terms, the rotation measure or V"
        )
    if rm and not i:
        raise InputError(f"source '{sky.names[k]}': BBS text takes Q and U that rotate as a fraction of I, which is 0")
    shaped = bool(sky.gaussian[k])
    right_ascension = sky.ra_rad[k] if abs(sky.ra_rad[k]) < 2 * np.pi else sky.ra_rad[k] % (2 * np.pi)
    return [
        sky.names[k],
        "GAUSSIAN" if shaped else "POINT",
        sky.patches[k] if sky.patches else "",
        _degrees(right_ascension),
        _degrees(sky.dec_rad[k]),
        *(repr(x) for x in (i, q, u, v)),
        repr(of(sky.reference_hz)) if sky.reference_hz is not None else "",
        f"[{', '.join(map(repr, terms))}]" if terms else "",
        "" if sky.logarithmic is None else str(of(sky.logarithmic)).lower(),
        repr(rm) if rm or (curved and linear and follows) else "",
        *(repr(of(x) / ARCSEC) if shaped else "" for x in (sky.major_rad, sky.minor_rad)),
        repr(float(np.rad2deg(of(sky.angle_rad)))) if shaped else "",
        "true" if shaped else "",
    ]
