"""Sky models of other programs: OSKAR's is read; of the others it is said what they are and how to bring them here."""

from __future__ import annotations

import re
from pathlib import Path
from typing import TypeVar

import numpy as np

from instrument.errors import unused
from instrument.files_in import harmless
from instrument.sky.bbs_text import broken
from instrument.sky.sources import Sources

S = TypeVar("S", bound=Sources)
TABLE = "write its sources as BBS text or as a table of named columns"
# name of the format, what a comment or the first line of data begins with, and the way out
TEXTS: tuple[tuple[str, str, str], ...] = (
    ("an AO sky model (skymodel fileformat, of mwa-reduce)", r"skymodel fileformat", TABLE),
    ("a source list of RTS or WODEN", r"source\s+\S+\s+(?:p\s|[\d.])", TABLE),
    (
        "a SAGECal sky model",
        r"##\s*lsm file|#+\s*name\s*\|?\s*(?:h\s+m\s+s|ra\s*\()|"
        r"\S+(?:\s+[+-]?\d+){2}\s+[\d.]+(?:\s+[+-]?\d+){2}\s+[\d.]+(?:\s+[-+.\de]+){7}",
        "SAGECal's convert_skymodel.py --lsmtobbs writes BBS text (its spectral terms are of natural logarithms: "
        "multiply the second by ln 10, the third by its square)",
    ),
    ("a Tigger sky model", r"#\s*format\s*:|<.*\btigger\b", "tigger-convert writes its columns as text: " + TABLE),
    ("a ds9 region file", r"# region file format", "it holds no fluxes; " + TABLE),
    ("a hyperdrive source list", r"-?\s*(?:ra|flux_type|comp_type)\s*:", TABLE),
    ("JSON or YAML", r"[\[{]\s*(?:[\"{]|$)|---(?:\s|$)", TABLE),
    ("a web page", r"<(?:!doctype html|html)", "fetch the table itself"),
)
BELOW_A_FIRST_LINE = ("a Tigger sky model", "a hyperdrive source list")
BINARY: tuple[tuple[str, bytes, str], ...] = (
    ("an HDF5 file (pyradiosky's .skyh5?)", b"\x89HDF", "pyradiosky's write_text_catalog writes a table that is read"),
    ("a zip archive", b"PK\x03\x04", "unpack it"),
    ("a bzip2 archive", b"BZh", "unpack it"),
    ("an xz archive", b"\xfd7zXZ", "unpack it"),
    ("a Parquet file", b"PAR1", "write it as FITS, VOTable or CSV"),
)
OSKAR = ("ra", "dec", "i", "q", "u", "v", "ref_freq", "spectral_index", "rotation_measure", "major", "minor", "angle")


def refuse_foreign(path: Path, raw: bytes) -> None:
    """Raises `FileError` that names the format and the way out, where contents are of a known program's format."""
    for title, start, remedy in BINARY:
        if raw.startswith(start):
            raise broken(path, None, f"is {title}, which is not read here; {remedy}")
    # of each line the first 200 characters: enough to tell, and no pattern can take long over them
    lines = [t.strip()[:200] for t in raw[:4096].decode("utf-8", errors="replace").split("\n")]
    written = [t for t in lines if t]
    first = next((k for k, t in enumerate(written) if not t.startswith("#")), len(written))
    for title, pattern, remedy in TEXTS:
        # the lines below the first hold data in a table too
        looked_at = written[: first + (4 if title in BELOW_A_FIRST_LINE else 1)]
        if any(re.match(pattern, t, re.IGNORECASE) for t in looked_at):
            raise broken(path, None, f"is {title}, which is not read here; {remedy}")


def read_oskar(make: type[S], path: Path, raw: bytes) -> S:
    """Sources of an OSKAR sky model, as `make`: up to 12 numbers a line in its order and units, missing ones are 0.

    Q, U and V carry the spectrum of I and turn with the rotation measure; without a reference frequency (0) nothing
    changes with frequency, as OSKAR takes it.
    """
    rows, lines = [], []
    for number, line in enumerate(raw.decode("utf-8-sig", errors="replace").split("\n"), 1):
        text = line.partition("#")[0].replace(",", " ").split()
        if not text:
            continue
        try:
            found = [float(t) for t in text]
        except ValueError:
            raise broken(path, number, "an OSKAR sky model holds numbers alone, 3 to 12 a line") from None
        if not 3 <= len(found) <= 12 or not np.all(np.isfinite(found)):
            raise broken(path, number, f"{len(found)} values; OSKAR has 3 to 12 a line, all of them finite")
        if not (abs(found[0]) <= 360 and abs(found[1]) <= 90):
            raise broken(path, number, f"right ascension {found[0]:g}, declination {found[1]:g} are beyond the sky")
        rows.append(found + [0.0] * (12 - len(found)))
        lines.append(number)
    if not rows:
        raise broken(path, None, "no source in it")
    data = dict(zip(OSKAR, np.array(rows).T, strict=True))
    still = data["ref_freq"] <= 0
    if np.any(still & ((data["spectral_index"] != 0) | (data["rotation_measure"] != 0))):
        where = [f"line {lines[k]}" for k in np.flatnonzero(still & (data["spectral_index"] != 0))[:20]]
        unused(
            harmless(path.name), where or ["rotation measures"], "spectra and rotation without a reference frequency"
        )
    freq = np.where(still, 150e6, data["ref_freq"])
    index, turn = (np.where(still, 0.0, data[m]) for m in ("spectral_index", "rotation_measure"))
    arcsec = np.pi / 180 / 3600
    shaped = bool((data["major"] > 0).any() or (data["minor"] > 0).any())
    return make(
        names=tuple(f"s{k}" for k in range(len(rows))),
        ra_rad=np.deg2rad(data["ra"]),
        dec_rad=np.deg2rad(data["dec"]),
        stokes_jy=np.stack([data[s] for s in "iquv"], axis=1),
        reference_hz=None if still.all() else freq,
        spectral_terms=index[:, None] if index.any() else None,
        rotation_measure=turn if turn.any() else None,
        polarization_follows_i=np.ones(len(rows), bool) if index.any() else None,
        major_rad=data["major"] * arcsec if shaped else None,
        minor_rad=data["minor"] * arcsec if shaped else None,
        angle_rad=np.deg2rad(data["angle"]) if shaped else None,
    )
