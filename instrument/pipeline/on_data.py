"""The verbs `predict`, `calibrate`, `image` and `subtract`: scenes made to work on the visibilities of a file."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from instrument.errors import InputError, unused

OWN = ("name", "title", "seed", "tolerance", "engine", "instrument", "sky")
STAGES = {"predict": (), "calibrate": ("calibrate",), "image": ("correct", "image", "analyze"), "subtract": ()}
WRITES = {
    "predict": ("model", "MODEL_DATA"),
    "calibrate": ("data", "CORRECTED_DATA"),
    "subtract": ("difference", "SUBTRACTED_DATA"),
}
NEEDS = {"calibrate": 'kind = "selfcal"', "image": "pixels and pixel"}  # of the tables that verbs are about, the least
HELP = {
    "predict": "Predict the sky of a scene into a column of a Measurement Set, with its times, channels and UVW.",
    "calibrate": "Calibrate the data of a Measurement Set against the sky of a scene, and write them corrected.",
    "image": "Image and analyze the data of a Measurement Set as a scene says.",
    "subtract": "Take the sky of a scene off the data of a Measurement Set.",
}


def can(verb: str, tables: dict[str, Any]) -> bool:
    """Whether a scene has the table that a verb is about."""
    return verb not in STAGES[verb] or verb in tables


def tables_on(verb: str, tables: dict[str, Any], data: dict[str, Any], into: str | None, force: bool) -> dict[str, Any]:
    """The tables of a scene as a verb has them: on visibilities `data`; `into` is their column, or a new file.

    Raises `InputError` where the scene lacks the table that the verb is about, and where neither is to be had.
    """
    from instrument.files.formats import ENDINGS, has_columns, known_file, names_file

    if not can(verb, tables):
        raise InputError(
            f"{verb} takes its settings from a table [{verb}], which the scene has not: write one, with {NEEDS[verb]}"
        )
    kept = {name: value for name, value in tables.items() if name in (*OWN, *STAGES[verb])}
    if not Path(data["set"]).is_dir():
        known_file(data["set"])
    if "observation" in tables:
        unused("scene", ["[observation]"], f"times, channels and stations are those of {data['set']}")
    kept["name"] = f"{tables.get('name', 'scene')}-{verb}"  # or one verb's --force would take the folder of another
    out = kept | {"data": {name: value for name, value in data.items() if value is not None}}
    if verb not in WRITES:
        return out
    what, usual = WRITES[verb]
    if not has_columns(data["set"]) and (into is None or not names_file(into)):
        raise InputError(f"{data['set']} has no columns to write: give --into a new file, {ENDINGS}")
    named = {"set": into} if into is not None and names_file(into) else {"column": usual if into is None else into}
    return out | {"into": {"what": what, **named, "overwrite": force}}
