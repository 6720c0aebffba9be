"""Where a run stands on the curve of error against time of its scene, as the contest of engines has measured it."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from functools import cache
from importlib.resources import files
from typing import Any

import numpy as np

from instrument.pipeline.scene_text import read_tables, shipped
from instrument.pipeline.work import PREDICT
from instrument.report.page import Figures, Section

PLAN = "plan"
ALIKE = ("instrument", "sky")  # tables that must be those of the shipped scene: cost and error hang on them


def on_curve(record: Mapping[str, Any], draw: Callable[..., Any]) -> list[Section]:
    """The section with the run's own point on the curve of its scene; none where there is no curve, or no check."""
    from instrument.report.precision import point_figure

    check = record.get("checks", {}).get("prediction") or {}
    rows = curves().get(record["name"])
    error, seen = check.get("error"), check.get("seen")
    if rows is None or not seen or not check.get("passed") or not error or not np.isfinite(error) or not _alike(record):
        return []
    count = math.prod(seen[axis][1] for axis in ("times", "channels", "baselines"))
    steps = record["stages"]
    seconds = sum(steps[name]["seconds"]["measured"] for name in (PLAN, PREDICT) if name in steps) / count
    if not seconds > 0:
        return []
    meta = curves()["meta"]
    text = (
        "Error of the prediction against seconds a visibility, its plan included: this run (star; its error as the "
        f"check found it, its bound above), and the engines on six integrations, as `{meta['command']}` measured them "
        f"on {meta['made'][:10]} ({meta['machine']}); beside a mark what was asked."
    )
    figure = point_figure(rows, record["plan"]["engine"], seconds, (error, check["bound"]))
    return [Section("Error against run time", [Figures([draw("precision", figure, text)])])]


def _alike(record: Mapping[str, Any]) -> bool:
    """Whether what is predicted is that of the shipped scene of this name."""
    if record["name"] not in shipped():
        return False
    known = read_tables(record["name"])
    return all(known.get(name) == record["scene"].get(name) for name in ALIKE)


@cache
def curves() -> dict[str, Any]:
    """Rows (engine, asked, seconds a visibility, error) of scenes that were measured, by name; "meta" says how."""
    from astropy.table import Table

    path = files("instrument.data") / "precision_engines.ecsv"
    table = Table.read(path, format="ascii.ecsv")
    found: dict[str, Any] = {"meta": table.meta}
    for scene, *row in table.iterrows("scene", "engine", "asked", "seconds_each", "error"):
        found.setdefault(str(scene), []).append(tuple(row))
    return found
