"""A column of a Measurement Set written: looked at first, and as it was where it fails or is stopped."""

from __future__ import annotations

import re
import shutil
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from instrument.errors import FileError, InputError, RefusedError
from instrument.files.ms_frame import CIRCULAR, LINEAR, Frame
from instrument.files.ms_rows import at_rows, put_rows
from instrument.files.ms_tables import column as values_of
from instrument.files.ms_tables import opened, parts, told
from instrument.files.ms_units import jansky, unit_of
from instrument.units import Bool, Complex, Int, si_prefix

# of the definition, of CASA and of DP3: columns of something else than visibilities
RESERVED = (
    *("TIME", "TIME_CENTROID", "INTERVAL", "EXPOSURE", "ANTENNA1", "ANTENNA2", "ANTENNA3", "FEED1", "FEED2", "FEED3"),
    *("DATA_DESC_ID", "FIELD_ID", "ARRAY_ID", "OBSERVATION_ID", "PROCESSOR_ID", "SCAN_NUMBER", "STATE_ID", "UVW"),
    *("UVW2", "FLAG", "FLAG_ROW", "FLAG_CATEGORY", "WEIGHT", "WEIGHT_SPECTRUM", "SIGMA", "SIGMA_SPECTRUM"),
    *("IMAGING_WEIGHT", "IMAGING_WEIGHT_SPECTRUM", "CORRECTED_WEIGHT_SPECTRUM", "BASELINE_REF", "PHASE_ID"),
    *("PULSAR_BIN", "PULSAR_GATE_ID", "TIME_EXTRA_PREC", "LOFAR_FULL_RES_FLAG"),
)
NAME = re.compile(r"[A-Za-z][A-Za-z0-9_]*")
BLOCK_ROWS = 10_000  # of a new column that are written at once
KEPT = 74.0  # bytes of a visibility in the file beside the set, with weight and flag
SPARE = 64e6  # bytes of the disk that are left alone


def demand_column(path: str, name: str, overwrite: bool, frame: Frame | None = None) -> None:
    """Raise `InputError` or `FileError` where visibilities cannot be written into a column, before they are made.

    With the `frame` also where a column that is there has no room for its channels and correlations.
    """
    if not NAME.fullmatch(name):
        raise InputError(f"'{name}' is no name for a column: letters, digits and underscores")
    if name.upper() in RESERVED:
        raise InputError(f"{name} is no column for visibilities")
    with (Path(path) / "table.dat").open("rb") as file:
        if b"RefTable" in file.read(64):
            raise InputError(f"{path} is a selection of rows of another set: write into that, or into a copy of this")
    with opened(path, writable=True) as table:
        if name not in table.columns():
            return
        if not overwrite:
            raise InputError(f"{path} has a column {name}: name another one, or allow to overwrite it (--force)")
        known = table.getcoldesc(name)
        kind, shape = str(known.get("valueType", "")).lower(), known.get("shape")
        want = None if frame is None or shape is None else [len(frame.freq_hz), len(frame.kinds)]
        if "complex" not in kind or known.get("ndim", 2) != 2 or (want is not None and list(shape) != want):
            of = f" of {' x '.join(map(str, shape))}" if shape is not None else ""
            to = f" of {' x '.join(map(str, want))} (channels, correlations)" if want is not None else ""
            raise InputError(f"{path}: column {name} holds {kind}{of}, the visibilities are complex{to}: name another")
        with warnings.catch_warnings(action="ignore"):
            jansky(unit_of(table, name, path), f"{path}: {name}")


def demand_space(path: str, visibilities: float, kept: bool = True) -> None:
    """Raise `RefusedError` where the disk has no room for so many visibilities, and for the file beside, if `kept`."""
    folder = Path(path).absolute().parent
    need = (KEPT * kept + 2 * 32.0) * visibilities + SPARE
    if need > (free := shutil.disk_usage(folder).free):
        raise RefusedError(
            f"{folder}: {si_prefix(need, 'B')} are needed there until {Path(path).name} is written, "
            f"{si_prefix(free, 'B')} are free: free some, or write less"
        )


class Part(NamedTuple):
    """Visibilities of some rows (N, F, n), which are flagged, and the rows and channels of the file they belong to."""

    values: Complex
    flag: Bool
    rows: Int
    channels: Int


def correlated(frame: Frame, data: Complex, flag: Bool, turned: Bool) -> tuple[Complex, Bool]:
    """Matrices of rows (N, F, 2, 2), and flags of them, as the correlations of the file; `turned` rows conjugated."""
    data, flag = np.array(data), np.array(np.broadcast_to(flag, data.shape), bool)
    data[turned] = np.conj(np.swapaxes(data[turned], -1, -2))
    flag[turned] = np.swapaxes(flag[turned], -1, -2)
    each: Any
    if frame.kinds[0] in CIRCULAR:
        each = np.broadcast_to(np.asarray(flag.any(axis=(-1, -2)))[..., None], (*flag.shape[:2], len(frame.kinds)))
    else:
        each = flag.reshape(*flag.shape[:2], 4)[..., [LINEAR.index(kind) for kind in frame.kinds]]
    values: Any = frame.correlated(data)
    return values, each


def put(table: Any, name: str, part: Part, there: bool, journal: Callable[[Int, Any], None]) -> int:
    """Write a part into a column, once `journal` has what was there; how many visibilities are NaN for lack of one.

    What is flagged and not in the FLAG of the set has no value: NaN. What is flagged in both stays as it is where the
    column is `there`. Raises `InputError` for values that single precision does not hold.
    """
    inside = (slice(None), part.channels)
    flags: Any = at_rows(table, "FLAG", part.rows).astype(bool)
    if "FLAG_ROW" in table.columns():
        alone: Any = at_rows(table, "FLAG_ROW", part.rows)
        flags = flags | alone.astype(bool)[:, None, None]
    flagged = flags[inside]
    try:
        whole = at_rows(table, name, part.rows)
        if there:
            journal(part.rows, whole)
    except FileError:  # cells that were never written: nothing to go back to
        whole = np.zeros(flags.shape, np.complex64)
    values = np.where(part.flag & ~flagged, np.nan, part.values)
    if there:
        values = np.where(part.flag & flagged, whole[inside], values)
    if whole.dtype == np.complex64:
        demand_single(values, name)
    out = np.array(whole)
    out[inside] = values
    put_rows(table, name, part.rows, out)
    return int((part.flag & ~flagged).sum())


def stored(table: Any, name: str, part: Part) -> float:
    """By how much what a column gives back of a part differs from what was written, rms over rms."""
    inside = (slice(None), part.channels)
    back, wanted = at_rows(table, name, part.rows)[inside], np.asarray(part.values)
    use = np.isfinite(back) & ~part.flag
    power = float((np.abs(wanted[use]) ** 2).sum())
    return float(np.sqrt((np.abs(back[use] - wanted[use]) ** 2).sum() / power)) if power else 0.0


def demand_single(values: Any, what: str) -> None:
    """Raise `InputError` for numbers that are beyond single precision."""
    most = float(np.finfo(np.float32).max)
    parts_of = (values.real, values.imag) if np.iscomplexobj(values) else (values,)
    if any(np.any(np.isfinite(x) & (np.abs(x) > most)) for x in parts_of):
        raise InputError(f"{what}: numbers above {most:.2g} cannot be written in single precision: scale them")


def add_column(table: Any, name: str, like: str, path: str) -> None:
    """A new column of the kind of another, zero in all rows, as many channels and correlations as their window has."""
    described = dict(table.getcoldesc(like))
    described.update({"dataManagerGroup": f"Tiled{name}", "comment": "visibilities", "keywords": {}})
    described["dataManagerType"] = "TiledShapeStMan" if "shape" not in described else "TiledColumnStMan"
    kind = np.complex128 if str(described["valueType"]).lower().startswith("d") else np.complex64
    shapes = _shapes(path)
    with told(f"column {name}"):
        table.addcols({name: described}, {})
        for r, (which,) in parts(table, "DATA_DESC_ID"):
            for one in np.unique(which):
                rows = r + np.flatnonzero(which == one)
                for k in range(0, len(rows), BLOCK_ROWS):  # or it holds what the disk held
                    some = rows[k : k + BLOCK_ROWS]
                    table.putcol(name, np.zeros((len(some), *shapes[int(one)]), kind), (some,))


def _shapes(path: str) -> list[tuple[int, int]]:
    """Channels and correlations of each row of DATA_DESCRIPTION."""
    counts = []
    for sub, name in (("SPECTRAL_WINDOW", "CHAN_FREQ"), ("POLARIZATION", "CORR_TYPE")):
        with opened(path, sub) as table:
            counts.append([values_of(table, name, slice(k, k + 1)).shape[1] for k in range(table.nrow())])
    channels, kinds = counts
    with opened(path, "DATA_DESCRIPTION") as table:
        pairs = values_of(table, "SPECTRAL_WINDOW_ID"), values_of(table, "POLARIZATION_ID")
    return [(int(channels[w]), int(kinds[p])) for w, p in zip(*pairs, strict=True)]


@contextmanager
def undone(path: str, name: str, folder: Path) -> Iterator[Callable[[Int, Any], None]]:
    """Whatever ends what is inside early, an error or a signal: the set is as it was.

    A column that was there gets its old values back, which are to be given, rows and values, before they are replaced;
    a new one goes. Raises `FileError` where even that fails.
    """
    place, kept = Path(path), folder / "undo"
    kept.mkdir()
    files = {file.name for file in place.iterdir()}
    for file in place.glob("table.*"):
        if file.suffix in (".dat", ".info", ".lock"):
            shutil.copy2(file, kept)
    with opened(path) as table:
        there = name in table.columns()
        words = dict(table.getcolkeywords(name)) if there else {}
    count = 0

    def journal(rows: Int, values: Any) -> None:
        nonlocal count
        np.savez(kept / f"{count:08d}.npz", rows=rows, values=values)
        count += 1

    try:
        yield journal
    except BaseException as error:  # also a signal
        try:
            if there:
                with opened(path, writable=True) as table:
                    for one in sorted(kept.glob("*.npz"), reverse=True):  # rows may be there twice: the oldest last
                        with np.load(one) as old:
                            put_rows(table, name, old["rows"], old["values"])
                    with told(f"column {name}"):
                        table.putcolkeywords(name, words)
            else:
                for file in place.iterdir():
                    if file.name not in files and file.name.startswith("table.f"):
                        file.unlink()
                for saved in kept.glob("table.*"):
                    shutil.copy2(saved, place)
        except Exception as second:  # whatever stands in the way of it is said
            raise FileError(
                f"{path}: column {name} is neither as it was nor whole, write it again ({second}; first: {error})"
            ) from None
        raise
