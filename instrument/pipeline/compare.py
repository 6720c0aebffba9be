"""The verb `compare`: what changed between two runs: scene, versions, checks, numbers, tables, cubes, costs."""

from __future__ import annotations

import os
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from instrument import h5
from instrument.errors import InputError
from instrument.files_in import harmless
from instrument.numbers import brief
from instrument.pipeline.folder import RunFolder
from instrument.pipeline.record import json_text
from instrument.pipeline.run_read import RunRead, read_run
from instrument.units import Float

TOLD = (  # parts of the record that are compared apart, or not at all
    *("name", "title", "finished", "versions", "machine", "scene", "plan", "unused", "checks", "stage_errors"),
    *("command", "files", "kind", "seed", "scene_hash"),
)
COSTS = ("seconds", "parts", "stages", "memory")
SHORT = 6  # values of a list that are compared one by one; longer lists stand in files
MOST_LINES = 12  # of one kind on the terminal; the page has all


class Change(NamedTuple):
    """One thing that differs: its key, and its values in the first and in the second run; `None` where it is not."""

    key: str
    first: Any
    second: Any


class Column(NamedTuple):
    """How a column of a table, or an image, differs: rms of the difference and the largest, as shares of its rms."""

    file: str
    column: str
    rows: int
    rms: float
    largest: float
    where: str


@dataclass
class Comparison:
    """What changed between two runs."""

    first: RunRead
    second: RunRead
    scene: list[Change] = field(default_factory=list)
    versions: list[Change] = field(default_factory=list)
    checks: list[Change] = field(default_factory=list)
    errors: list[Change] = field(default_factory=list)
    numbers: list[Change] = field(default_factory=list)
    costs: list[Change] = field(default_factory=list)
    columns: list[Column] = field(default_factory=list)
    alike: list[str] = field(default_factory=list)  # files that are the same
    apart: list[str] = field(default_factory=list)  # those that cannot be compared, and why

    def lines(self) -> list[str]:
        """The text for the terminal."""
        out = [f"{word:<13} {_headline(run)}" for word, run in (("first", self.first), ("second", self.second))]
        for title, changes in self.parts():
            if not changes:
                out.append(f"{title:<13} the same")
            for change in changes[:MOST_LINES]:
                out.append(f"{title:<13} {change.key:<34} {told(change.first)}  ->  {told(change.second)}")
            if len(changes) > MOST_LINES:
                out.append(f"{title:<13} and {len(changes) - MOST_LINES} more")
        for one in worst(self.columns):
            of = f"{one.column}, largest at {one.where}" if one.where else one.column
            out.append(f"{'files':<13} {one.file:<34} rms {percent(one.rms)}, largest {percent(one.largest)} ({of})")
        if self.alike:
            out.append(f"{'files':<13} the same to the last bit: {', '.join(self.alike)}")
        return [*out, *(f"{'files':<13} {text}" for text in self.apart)]

    def parts(self) -> list[tuple[str, list[Change]]]:
        """What changed, by what it is."""
        names = ("scene", "versions", "checks", "errors", "numbers", "costs")
        return [(name, getattr(self, name)) for name in names]

    def record(self) -> dict[str, Any]:
        """What compare.json holds."""
        changed = {name: [c._asdict() for c in changes] for name, changes in self.parts()}
        return {
            "runs": [run.label for run in (self.first, self.second)],
            **changed,
            "columns": [c._asdict() for c in self.columns],
            "the_same": self.alike,
            "not_compared": self.apart,
        }


def compare(first: str | os.PathLike[str], second: str | os.PathLike[str]) -> Comparison:
    """What changed between two run folders; raises `InputError` in one line for what is none."""
    a, b = read_run(first), read_run(second)
    found = Comparison(a, b)
    found.scene = _changes(_scene(a), _scene(b))
    found.versions = _changes(a.part("versions"), b.part("versions"))
    found.checks = _changes(*({name: _verdict(check) for name, check in run.part("checks").items()} for run in (a, b)))
    found.errors = _changes(a.part("stage_errors"), b.part("stage_errors"))
    found.numbers = _changes(_flat(_numbers(a)), _flat(_numbers(b)))
    found.costs = _changes(*(_flat({name: run.part(name) for name in COSTS}) for run in (a, b)))
    _files(found)
    return found


def compare_runs(
    first: str, second: str, out: str | None = None, show: Callable[[str], None] = print, force: bool = False
) -> Comparison:
    """Compare two run folders; with `out` a folder with compare.html, compare.json and figures is written."""
    folder = (
        None if out is None else RunFolder("compare", out, force, [Path(run) / "run.json" for run in (first, second)])
    )
    found = compare(first, second)
    if folder is not None:
        from instrument.report.compare_page import page_of_comparison
        from instrument.report.page import write_page
        from instrument.report.style import drawer

        with folder:
            write_page(page_of_comparison(found, drawer(folder.partial)), folder.partial / "compare.html")
            (folder.partial / "compare.json").write_text(json_text(found.record()), encoding="utf-8")
            path = folder.finish()
    show("\n".join(found.lines()))
    if folder is not None:
        show(f"{'written':<13} {path}/compare.html, compare.json, figures")
    return found


def _headline(run: RunRead) -> str:
    made = harmless(run.part("versions").get("instrument", "?"), 40)
    hashed = f", scene {run.text('scene_hash')}" if "scene_hash" in run.record else ""
    when = run.text("finished").replace("T", " ").replace("+00:00", " UTC")
    return f"{run.label}: {run.text('name')}, {when}, instrument {made}{hashed}"


def _scene(run: RunRead) -> dict[str, Any]:
    """The settings of a run by key: of its scene, or of the command that analyzed a cube."""
    return _flat(run.part("scene")) | {key: run.record[key] for key in ("command", "files") if key in run.record}


def _numbers(run: RunRead) -> dict[str, Any]:
    plan = {key: value for key, value in run.part("plan").items() if key in ("engine", "error_bound", "flops")}
    return {"plan": plan} | {key: v for key, v in run.record.items() if key not in (*TOLD, *COSTS)}


def _verdict(check: Any) -> str:
    if not isinstance(check, dict):
        return "unknown"
    word = {True: "held", False: "fell short", None: "not checked"}.get(check.get("passed", True), "unknown")
    if "error" in check and "bound" in check:
        return f"{word} (error {_digits(check['error'])}, bound {_digits(check['bound'])})"
    outcome = check.get("outcome")
    said = "; ".join(dict.fromkeys(str(one) for one in outcome)) if isinstance(outcome, list) else ""
    return f"{word} ({harmless(said, 100)})" if said else word


def _digits(value: Any) -> str:
    return f"{value:.1e}" if isinstance(value, float) else told(value)


def _flat(value: Any, name: str = "", depth: int = 0) -> dict[str, Any]:
    """Entries of tables in tables by dotted keys; short lists of numbers one by one."""
    if depth < 12 and isinstance(value, dict):
        inside = value.items()
    elif depth < 12 and isinstance(value, list) and len(value) <= SHORT and any(isinstance(v, dict) for v in value):
        inside = enumerate(value)  # type: ignore[assignment]
    else:
        return {name: value}
    out: dict[str, Any] = {}
    for key, item in inside:
        out |= _flat(item, f"{name}.{harmless(key, 60)}" if name else harmless(key, 60), depth + 1)
    return out


def _changes(a: Mapping[str, Any], b: Mapping[str, Any]) -> list[Change]:
    """Keys whose values differ, in the order of the first."""
    keys = [*a, *(key for key in b if key not in a)]
    return [Change(key, a.get(key), b.get(key)) for key in keys if a.get(key) != b.get(key) or (key in a) != (key in b)]


def _files(found: Comparison) -> None:
    """Compare tables and cubes of the same name."""
    a, b = found.first, found.second
    for name in sorted({name for run in (a, b) for name in run.named(".ecsv", ".fits", ".h5")}):
        lacking = [run.label for run in (a, b) if name not in run.files]
        if lacking:
            found.apart.append(f"{harmless(name)}: not in {lacking[0]}")
            continue
        try:
            columns = _table(name, a, b) if name.endswith(".ecsv") else _images(name, a, b)
        except InputError as error:
            found.apart.append(f"{harmless(name)}: {error}")
            continue
        changed = [column for column in columns if column.largest != 0]
        found.columns += changed
        if columns and not changed:
            found.alike.append(name)


def _table(name: str, a: RunRead, b: RunRead) -> list[Column]:
    one, two = a.table(name), b.table(name)
    names = [column for column in one.colnames if column in two.colnames]
    if not names or not len(one) or not len(two):
        raise InputError("no row or column is in both")
    key = names[0]
    rows, others = _paired(one[key], two[key])
    if not len(rows):
        raise InputError(f"no {key} is in both")
    labels = [told(value) for value in np.asarray(one[key])[rows].tolist()]
    out = []
    for column in names:
        x, y = (np.ma.filled(np.ma.asarray(t[column]), np.nan if t[column].dtype.kind == "f" else None)
                for t in (one, two))  # fmt: skip
        x, y = x[rows], y[others]
        if x.dtype.kind in "fiu" and y.dtype.kind in "fiu" and x.ndim == 1 and x.shape == y.shape:
            out.append(_column(name, column, x.astype(float), y.astype(float), labels))
        elif x.shape == y.shape and not np.array_equal(x, y):
            which = np.flatnonzero((x != y).reshape(len(x), -1).any(axis=1))
            out.append(Column(name, column, len(x), np.nan, np.nan, labels[int(which[0])] if which.size else ""))
    return out


def _paired(x: Any, y: Any) -> tuple[Any, Any]:
    """Rows of two tables that belong together: by their names where the first column has names, else by their place."""
    x, y = np.asarray(x), np.asarray(y)
    if x.dtype.kind in "US" and y.dtype.kind in "US" and len(set(x)) == len(x) and len(set(y)) == len(y):
        place = {value: k for k, value in enumerate(y)}
        pairs = [(k, place[value]) for k, value in enumerate(x) if value in place]
        return np.array([p[0] for p in pairs], int), np.array([p[1] for p in pairs], int)
    if len(x) != len(y):
        raise InputError(f"{len(x)} rows, and {len(y)}")
    return np.arange(len(x)), np.arange(len(x))


def _column(file: str, name: str, x: Float, y: Float, labels: list[str]) -> Column:
    """Differences as shares of the rms of the first, or of the second where that is zero; NaN in one alone is all."""
    both = np.isfinite(x) & np.isfinite(y)
    lost = np.isfinite(x) != np.isfinite(y)
    apart = np.where(both, y - x, 0.0)
    scale = next((s for s in (float(np.sqrt((v[both] ** 2).mean())) for v in (x, y) if both.any()) if s > 0), 1.0)
    size = np.where(lost, np.inf, np.abs(apart) / scale)
    k = int(np.argmax(size)) if size.size else 0
    rms = float(np.sqrt((apart[both] ** 2).mean())) / scale if both.any() else 0.0
    return Column(file, name, len(x), rms, float(size.max(initial=0.0)), labels[k] if size.size else "")


def _images(name: str, a: RunRead, b: RunRead) -> list[Column]:
    """Of files that are no tables: the same bytes of data, or how the images of a FITS file differ, plane by plane."""
    if name.endswith(".h5"):
        one, two = _solutions(a.files[name]), _solutions(b.files[name])
        if [(key, x.shape) for key, x in one.items()] != [(key, x.shape) for key, x in two.items()]:
            raise InputError("solutions of other kinds, stations, times or channels")
        pairs = {key: (x.ravel(), two[key].ravel()) for key, x in one.items()}
        turned = {key: (x, x + np.angle(np.exp(1j * (y - x)))) for key, (x, y) in pairs.items() if "/phase" in key}
        return [_column(name, key, x, y, [""] * x.size) for key, (x, y) in (pairs | turned).items()]
    from instrument.files.fits_open import opened

    with opened(a.files[name]) as one, opened(b.files[name]) as two:
        if [hdu.name for hdu in one] != [hdu.name for hdu in two]:
            raise InputError("the files have other images or tables than one another")
        found = []
        for x, y in zip(one, two, strict=True):
            if x.is_image and x.data is not None and y.data is not None:
                label = x.name.lower() if x.name not in ("", "PRIMARY") else "images"
                found.append(_planes(name, label, x.data, y.data))
        if not found:
            raise InputError("there is no image in it")
        return found


def _planes(name: str, label: str, x: Any, y: Any) -> Column:
    """How two images (..., Ny, Nx) differ, plane by plane: two of them in memory at once."""
    if x.shape != y.shape:
        raise InputError(f"{label} of {x.shape}, and {y.shape}")
    sums, largest, where = np.zeros(3), 0.0, ""
    for index in np.ndindex(*x.shape[:-2]):
        u, v = np.asarray(x[index], float), np.asarray(y[index], float)
        both = np.isfinite(u) & np.isfinite(v)
        apart = np.where(both, v - u, 0.0)
        sums += (apart**2).sum(), (u[both] ** 2).sum(), both.sum()
        top = np.inf if (np.isfinite(u) != np.isfinite(v)).any() else float(np.abs(apart).max(initial=0.0))
        if top > largest:
            largest, where = top, f"plane {'.'.join(map(str, index))}" if index else ""
    scale = float(np.sqrt(sums[1] / max(sums[2], 1))) or 1.0
    return Column(name, label, x.size, float(np.sqrt(sums[0] / max(sums[2], 1))) / scale, largest / scale, where)


def _solutions(path: Path) -> dict[str, Float]:
    """Values of the soltabs of an h5parm, by name."""
    with h5.opened(path, "h5parm") as store:
        tabs = {f"{s}/{t}": tab for s, solset in h5.members(store).items() for t, tab in _groups(solset).items()}
        sets = {name: h5.dataset(tab, "val") for name, tab in tabs.items() if "val" in tab}
        h5.demand_affordable(list(sets.values()))
        return {name: h5.numbers(found) for name, found in sets.items()}


def _groups(solset: Any) -> dict[str, Any]:
    return {name: item for name, item in h5.members(solset).items() if hasattr(item, "keys")}


def worst(columns: list[Column]) -> list[Column]:
    """Of each file the column that differs most."""
    out: dict[str, Column] = {}
    for one in columns:
        kept = out.setdefault(one.file, one)
        if not np.isnan(one.rms) and (np.isnan(kept.rms) or one.rms > kept.rms):
            out[one.file] = one
    return list(out.values())


def percent(share: float) -> str:
    """A share as a person says it."""
    if np.isnan(share):
        return "other words"
    return "no number in one of them" if np.isinf(share) else f"{100 * share:.2g} %"


def told(value: Any) -> str:
    """A value of a record in a few words."""
    if value is None:
        return "–"
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, float):
        return f"{value:.6g}"
    if isinstance(value, list) and len(value) > SHORT:
        return f"{len(value)} values"
    return harmless(value, 60) if isinstance(value, str) else brief(value)
