"""The HISTORY of a Measurement Set: one row of what was written; only that subtable is touched, whole or not at all."""

from __future__ import annotations

import shutil
from pathlib import Path

import numpy as np

from instrument.files.ms_tables import opened, told
from instrument.files.ms_units import in_unit
from instrument.observe.sampling import mjd_seconds
from instrument.provenance import command, written_by


def add_history(path: str, what: str, folder: Path) -> str:
    """One row more in the HISTORY of a set, that `what` was written, by which software, scene and command.

    Where that fails the subtable is as it was, from a copy in `folder`; why it failed, "" where it did not. A set
    without HISTORY gets none.
    """
    place, kept = Path(path) / "HISTORY", folder / "history"
    if place.is_symlink() or not (place / "table.dat").is_file():  # a link leads to the HISTORY of another set
        return ""
    try:
        shutil.copytree(place, kept)
        try:
            _add(str(place), what)
        except BaseException:  # also a signal
            shutil.copytree(kept, place, dirs_exist_ok=True)
            raise
    except Exception as error:  # whatever it is, what was to be written is
        return " ".join(str(error).split())
    return ""


def _add(place: str, what: str) -> None:
    from astropy.time import Time

    known = written_by()
    scene = f", scene {known['object']}" if "object" in known else ""
    with opened(place, writable=True) as table, told(place):
        now = float(mjd_seconds(Time.now())[0]) / float(in_unit(table, "TIME", 1.0, "s", place))
        texts = {
            "MESSAGE": f"{what} written by {known['software']}{scene}", "APPLICATION": "instrument",
            "PRIORITY": "NORMAL", "ORIGIN": "instrument",
        }  # fmt: skip
        values = {name: np.array([text], object) for name, text in texts.items()}
        values |= {"TIME": np.array([now]), "OBJECT_ID": np.zeros(1, np.int32), "OBSERVATION_ID": np.zeros(1, np.int32)}
        values["CLI_COMMAND"] = np.array([[command() or "-"]], object)
        values["APP_PARAMS"] = np.array([[f"{name} = {value}" for name, value in known.items()]], object)
        row = table.nrow()
        table.addrows(1)
        for name in table.columns():
            if name in values:
                table.putcol(name, values[name], (slice(row, row + 1),))
