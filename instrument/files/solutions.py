"""Solutions in and out as h5parm, the layout of DP3 and LoSoTo (see h5parm.py).

Gains multiply there as ours do, V_ab = J_a M J_b^H with rows and columns X, Y = p, q: nothing is conjugated or
transposed here. Times are MJD seconds, UTC, as ours.
"""

from __future__ import annotations

import os
from collections.abc import Iterable, Mapping, Sequence
from typing import Any, Literal

import numpy as np

from instrument import mat2
from instrument.calibrate.base import Solution
from instrument.calibrate.directional_solution import DirectionalSolution
from instrument.checked import checked
from instrument.errors import FileError, InputError, did_you_mean
from instrument.files.h5parm import AXES, KINDS, POLS, read_soltabs
from instrument.h5 import created
from instrument.jones.lookup import nearest
from instrument.jones.table import JonesTable
from instrument.observe.layout import Layout
from instrument.observe.sampling import Sampling
from instrument.provenance import written_by
from instrument.units import Bool, Complex, Float, direction
from instrument.whole_file import whole_file

Pattern = Literal["full", "diagonal", "scalar", "phase"]


@checked
def write_h5parm(
    path: str | os.PathLike[str],
    solution: Solution | DirectionalSolution | JonesTable,
    pattern: Pattern = "full",
    at: Sampling | None = None,
    directions: Mapping[str, Any] | None = None,
    overwrite: bool = False,
) -> None:
    """Write a solution as h5parm; `at` (such as `vis.at`) lends names and positions of stations and the phase centre.

    `pattern` "phase" is a phase per receptor, without amplitudes; what a pattern would lose (above 1e-6) raises
    `InputError`. Matrices that are not finite or have no inverse get weight 0, for DP3 passes a gain of zero on
    unflagged; they read back as NaN. Positions and directions that are not known are NaN. A `DirectionalSolution`
    gets an axis `dir`, and `directions` (SkyCoord by cluster) says where its clusters are; clusters of different
    intervals are put on one grid of times. A table constant in time or frequency is written without that axis.
    Standard errors of a solution that has them are a dataset `error` beside `val`, in its unit.
    """
    if pattern not in POLS:
        raise InputError(f"no pattern '{pattern}': {did_you_mean(str(pattern), POLS)}")
    clusters = solution.clusters if isinstance(solution, DirectionalSolution) else {"": solution}
    values, error, slots_s, freq_hz, names = _stacked(clusters, at)
    usable: Any = np.isfinite(values).all(axis=(-2, -1)) & np.isfinite(mat2.inverse(values)).all(axis=(-2, -1))
    gains = np.stack([_in_pattern(one, pattern) for one in np.moveaxis(values, 3, 0)], axis=3)

    along = {"time": slots_s, "freq": freq_hz, "ant": _bytes(names), "pol": _bytes(POLS[pattern])}
    along["dir"] = _bytes([f"[{name.strip('[]')}]" for name in clusters])
    there = {
        "time": not np.array_equal(slots_s, [0.0]), "freq": not np.array_equal(freq_hz, [0.0]), "ant": True,
        "dir": isinstance(solution, DirectionalSolution), "pol": bool(POLS[pattern]),
    }  # fmt: skip
    axes = [axis for axis in AXES if there[axis]]
    weight = np.broadcast_to(usable[..., None], gains.shape).astype(np.float32)
    parts = {"amplitude": np.abs(gains), "phase": np.where(np.isfinite(gains), np.angle(gains), np.nan)}
    errors = _errors(error, gains)
    said = written_by()
    known = ", ".join(f"{name} {value}" for name, value in said.items() if name not in ("written", "software"))
    history = f"{said['written']}: CREATE by {said['software']}{known and f' ({known})'}"
    if not isinstance(solution, JonesTable):
        history += f"\n{solution}"
    sources = _sources(clusters if there["dir"] else {"POINTING": None}, at, directions)

    with whole_file(path, overwrite) as partial, created(partial) as store:
        solset = store.create_group("sol000")
        solset.attrs["h5parm_version"] = np.bytes_("1.0")
        solset["antenna"], solset["source"] = _antenna(names, at), sources
        for kind in KINDS[1:] if pattern == "phase" else KINDS:
            soltab = solset.create_group(f"{kind}000")
            soltab.attrs["TITLE"], soltab.attrs["h5parm_version"] = np.bytes_(kind), np.bytes_("1.0")
            for axis in axes:
                soltab[axis] = along[axis]
            for name, array in (("val", parts[kind]), ("weight", weight), *((n, e[kind]) for n, e in errors.items())):
                soltab[name] = array.reshape([len(along[axis]) for axis in axes])
                soltab[name].attrs["AXES"] = np.bytes_(",".join(axes))
            soltab["val"].attrs["HISTORY000"] = np.bytes_(history.encode()[:60000])  # an attribute holds 64 kB


def diagonal_gains(
    solution: Solution | JonesTable, at: Sampling
) -> tuple[Complex, Bool, Float, Float, tuple[str, ...]]:
    """Gains (t, f, A, 2) of receptors, which are usable (t, f, A); times, channels (0: constant) and stations.

    Raises `InputError` where entries off the diagonal would be lost.
    """
    values, _, slots_s, freq_hz, names = _stacked({"": solution}, at)
    one = values[:, :, :, 0]
    usable: Any = np.isfinite(one).all(axis=(-2, -1)) & np.isfinite(mat2.inverse(one)).all(axis=(-2, -1))
    return _in_pattern(one, "diagonal"), usable, slots_s, freq_hz, names


def _stacked(
    clusters: Mapping[str, Solution | JonesTable], at: Sampling | None
) -> tuple[Complex, Float, Float, Float, tuple[str, ...]]:
    """Matrices (t, f, A, C, 2, 2) of all clusters on one grid of times, errors; the grid, channels and stations."""
    tables = [one if isinstance(one, JonesTable) else one.term for one in clusters.values()]
    if not tables:
        raise InputError("the solution holds no cluster")
    names = tables[0].stations or (at.layout.names if at is not None else ())
    if not names:
        raise InputError("the table names no stations; give at=vis.at")
    if at is not None and at.layout.names != names:
        raise InputError("the table is of other stations than `at`, or in another order")
    lengths = [one.interval_s for one in clusters.values() if isinstance(one, Solution)]
    slots_s = _common_times(tables, lengths)
    out = np.full((len(slots_s), len(tables[0].freq_hz), len(names), len(tables), 2, 2), np.nan + 0j)
    error = np.full(out.shape, np.nan)
    for c, (table, one) in enumerate(zip(tables, clusters.values(), strict=True)):
        if table.stations not in ((), names) or not np.array_equal(table.freq_hz, tables[0].freq_hz):
            raise InputError("the clusters have other stations or channels than one another")
        if table.values.shape[2] not in (1, len(names)):
            raise InputError(f"the table holds {table.values.shape[2]} stations, but `at` {len(names)}")
        rows, known = np.arange(len(slots_s)), np.ones(len(slots_s), bool)
        if not np.array_equal(table.slots_s, slots_s):
            rows = nearest(table.slots_s, slots_s)
            known = np.abs(table.slots_s[rows] - slots_s) < lengths[c] / 2
        out[known, :, :, c] = table.values[rows[known]]
        if isinstance(one, Solution) and one.error.shape == table.values.shape:
            error[known, :, :, c] = one.error[rows[known]]
    return out, error, slots_s, tables[0].freq_hz, names


def _errors(error: Float, gains: Complex) -> dict[str, dict[str, Float]]:
    """Errors (t, f, A, C, 2, 2), if any, as those of amplitudes and of phases (rad) of gains (t, f, A, C, P)."""
    if not np.isfinite(error).any():
        return {}
    flat = error.reshape(*error.shape[:-2], 4)
    kept = flat[..., {1: [0], 2: [0, 3], 4: [0, 1, 2, 3]}[gains.shape[-1]]]
    with np.errstate(divide="ignore", invalid="ignore"):
        return {"error": {"amplitude": kept, "phase": kept / np.abs(gains)}}


def _common_times(tables: Sequence[JonesTable], lengths: Sequence[float]) -> Float:
    """The times of all tables where they are the same; or else the finest grid on which each interval is whole."""
    if all(np.array_equal(table.slots_s, tables[0].slots_s) for table in tables):
        return tables[0].slots_s
    step = lengths[0]
    for length in lengths[1:]:  # Euclid; intervals are whole numbers of integrations, known to rounding
        other = length
        while other > 1e-3 * min(step, length):
            step, other = other, abs(step - round(step / other) * other)
    edge = min(float(table.slots_s[0]) - length / 2 for table, length in zip(tables, lengths, strict=True))
    pieces: set[int] = set()
    for table, length in zip(tables, lengths, strict=True):
        for begin in np.round((table.slots_s - length / 2 - edge) / step).astype(int).tolist():
            pieces.update(range(begin, begin + round(length / step)))
    return edge + (np.array(sorted(pieces)) + 0.5) * step


@checked
def read_h5parm(
    path: str | os.PathLike[str],
    layout: Layout | None = None,
    direction: str | None = None,
    solset: str | None = None,
    soltabs: Sequence[str] | None = None,
    missing: Literal["error", "flag"] = "error",
) -> JonesTable:
    """Jones matrices (t, f, A, 2, 2) of the amplitudes and phases of an h5parm; NaN where flagged, or of weight 0.

    `layout` puts the stations in its order; one that the file lacks raises, or is NaN with `missing` "flag".
    `direction` picks one of several (a name, with or without its brackets); `solset` and `soltabs` choose when there is
    more than one solset, or more tables than one of amplitudes and one of phases. Tables without time or freq are
    constant along it. Raises `FileError` that names file, group and what is wrong.
    """
    if missing not in ("error", "flag"):
        raise InputError(f"missing = '{missing}' must be 'error' or 'flag'")
    where, tables = read_soltabs(path, solset, soltabs, direction)
    along: dict[str, Any] = {"time": np.zeros(1), "freq": np.zeros(1)}  # one entry at 0: constant
    for table in tables:
        for axis in AXES[:3]:
            both = table is not tables[0] and axis in tables[0].along and axis in table.along
            if both and not np.array_equal(tables[0].along[axis], table.along[axis]):
                raise FileError(
                    f"{where}: {tables[0].name} and {table.name} differ in axis '{axis}'; put them on one grid, or "
                    "read them one by one with soltabs= and put both into a Chain"
                )
            along[axis] = table.along.get(axis, along.get(axis))
    parts = {table.kind: table.values for table in tables}
    counts = {kind: part.shape[-1] for kind, part in parts.items()}
    if 4 in counts.values() and list(counts.values()) != [4, 4]:
        raise FileError(f"{where}: full Jones needs XX, XY, YX and YY of both an amplitude and a phase")
    gains = parts.get("amplitude", 1.0) * np.exp(1j * parts.get("phase", 0.0))
    values, stations = _matrices(gains), tuple(along["ant"])
    if layout is not None:
        values, stations = _in_order(where, values, stations, layout, missing), layout.names
    try:
        return JonesTable(values=values, slots_s=along["time"], freq_hz=along["freq"], stations=stations)
    except InputError as error:
        raise FileError(f"{where}: {error}") from None


def _in_pattern(values: Complex, pattern: Pattern) -> Complex:
    """The entries (..., P) that a pattern keeps of matrices (..., 2, 2); raises when it would lose others."""
    flat = values.reshape(*values.shape[:3], 4)
    if pattern == "full":
        return flat
    kept = flat[..., [0]] if pattern == "scalar" else flat[..., [0, 3]]
    if pattern == "phase":
        kept = np.exp(1j * np.angle(kept))
    change = np.abs(_matrices(kept) - values)
    lost, size = (np.nanmax(x, initial=0.0, where=np.isfinite(x)) for x in (change, np.abs(values)))
    if lost > 1e-6 * size:
        raise InputError(f"pattern '{pattern}' would lose entries of up to {lost:.3g} of {size:.3g}; use 'full'")
    return kept


def _matrices(gains: Any) -> Complex:
    """Matrices (..., 2, 2) of gains (..., P): P = 1 a scalar, 2 a diagonal, 4 all."""
    if gains.shape[-1] == 4:
        return gains.reshape(*gains.shape[:-1], 2, 2)
    out = np.zeros((*gains.shape[:-1], 2, 2), complex)
    out[..., 0, 0], out[..., 1, 1] = gains[..., 0], gains[..., -1]
    return out


def _bytes(names: Sequence[str]) -> Any:
    """Names as HDF5 text. One byte more than the longest: DP3 takes the last one for the end of the text."""
    coded = [name.encode() for name in names]
    return np.array(coded, f"S{max(map(len, coded), default=0) + 1}")


def _antenna(names: Sequence[str], at: Sampling | None) -> Any:
    coded = _bytes(names)
    out = np.zeros(len(names), [("name", f"S{max(16, coded.dtype.itemsize)}"), ("position", np.float32, 3)])
    out["name"], out["position"] = coded, np.nan if at is None else at.layout.positions_m
    return out


def _sources(names: Iterable[str], at: Sampling | None, directions: Mapping[str, Any] | None) -> Any:
    """The table `source`: where each direction is; the phase centre where it is the only one."""
    names = list(names)
    for name in directions or {}:
        if name not in names:
            raise InputError(f"directions names '{name}': {did_you_mean(name, names)}")
    where: dict[str, Any] = {name: direction(d, f"directions['{name}']") for name, d in (directions or {}).items()}
    if names == ["POINTING"] and at is not None:
        where = {"POINTING": at.centre} | where
    out = np.zeros(len(names), [("name", "S128"), ("dir", np.float64, 2)])
    out["name"] = [(name if name == "POINTING" else f"[{name.strip('[]')}]").encode()[:127] for name in names]
    out["dir"] = [tuple(where.get(name, (np.nan, np.nan))) for name in names]
    return out


def _in_order(where: str, values: Complex, names: Sequence[str], layout: Layout, missing: str) -> Complex:
    lacking = [name for name in layout.names if name not in names]
    if lacking and (missing == "error" or len(lacking) == len(layout)):
        more = f" and {len(lacking) - 1} more" if len(lacking) > 1 else ""
        raise FileError(f"{where}: no station '{lacking[0]}'{more}: {did_you_mean(lacking[0], names)}")
    rows = [names.index(name) if name in names else -1 for name in layout.names]
    out = values[:, :, rows]
    out[:, :, [row < 0 for row in rows]] = np.nan
    return out
