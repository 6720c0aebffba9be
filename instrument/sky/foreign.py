"""Files of other programs that are not read: what they are, and how to bring them here."""

from __future__ import annotations

import re
from pathlib import Path

from instrument.sky.bbs_text import broken

TABLE = "write its sources as BBS text or as a table of named columns"
# name of the format, what a comment or the first line of data begins with, and the way out
TEXTS: tuple[tuple[str, str, str], ...] = (
    ("a source list of RTS or WODEN", r"source\s+\S+\s+(?:p\s|[\d.])", TABLE),
    (
        "a Tigger sky model as a web page",
        r"<.*\btigger\b",
        "tigger-convert writes it as text with a '#format:' line, which is read",
    ),
    (
        "a cluster file of SAGECal",
        r"-?\d+\s+\d+\s+[A-Za-z]\S*(?:\s+[A-Za-z]\S*)*\s*$",
        "it says which sources go together; the sky file beside it has the sources",
    ),
    ("a ds9 region file", r"# region file format", "it holds no fluxes; " + TABLE),
    ("a hyperdrive source list", r"-?\s*(?:ra|flux_type|comp_type)\s*:", TABLE),
    ("JSON or YAML", r"[\[{]\s*(?:[\"{]|$)|---(?:\s|$)", TABLE),
    ("a web page", r"<(?:!doctype html|html)", "fetch the table itself"),
)
BELOW_A_FIRST_LINE = ("a Tigger sky model as a web page", "a hyperdrive source list")
BINARY: tuple[tuple[str, bytes, str], ...] = (
    ("a zip archive", b"PK\x03\x04", "unpack it"),
    ("a bzip2 archive", b"BZh", "unpack it"),
    ("an xz archive", b"\xfd7zXZ", "unpack it"),
    ("a Parquet file", b"PAR1", "write it as FITS, VOTable or CSV"),
)


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
