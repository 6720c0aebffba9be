"""A new Measurement Set out of blocks, with the tables that LOFAR's programs ask for; nothing is read here."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from instrument.errors import InputError, warn
from instrument.files.ms_frame import LINEAR, beam_words
from instrument.files.ms_tables import created, opened, told
from instrument.files.ms_write import demand_single
from instrument.jones.station import Level, StationBeam
from instrument.model import Instrument
from instrument.observe.layout import Layout
from instrument.store import Store
from instrument.units import Direction, Float
from instrument.visibilities import Visibilities

METRES: dict[str, Any] = {"QuantumUnits": ["m", "m", "m"]}
POSITION = METRES | {"MEASINFO": {"type": "position", "Ref": "ITRF"}}
DIRECTION = {"QuantumUnits": ["rad", "rad"], "MEASINFO": {"type": "direction", "Ref": "J2000"}}
KINDS = {"c": "COMPLEX", "b": "BOOLEAN", "i": "INT", "f": "DOUBLE", "O": "STRING"}
NO_WEIGHT = float(np.sqrt(np.finfo(np.float32).max))  # SIGMA of weight 0: its square is the last that can be held
TILE_BYTES = 1e6


def make(path: str, store: Store, instrument: Instrument | None, told_by: str = "") -> None:
    """The set at `path`, whole but for its rows: room for them, stations, channels, field, correlations.

    Without an instrument the telescope is called as the file does that the visibilities are of (`told_by`).
    """
    times, channels, baselines = store.shape
    cubes = {"DATA": "COMPLEX", "FLAG": "BOOLEAN", "WEIGHT_SPECTRUM": "FLOAT"}
    tile = [4, channels, int(max(1, min(times * baselines, TILE_BYTES // (32 * channels))))]
    with told(path), created(path, {name: _cube(name, kind, channels) for name, kind in cubes.items()}, tile) as table:
        table.addrows(times * baselines)
        table.putcolkeywords("DATA", beam_words(store.beam_state) | {"UNIT": "Jy"})
    telescope = instrument.telescope_name if instrument is not None else told_by
    if instrument is None and telescope == "LOFAR":
        warn(f"{path}: no tables of its tiles and dipoles are written, so no beam is found in it: give instrument=")
    levels = _levels(instrument) if telescope == "LOFAR" else ()
    with told(path):
        _antennas(path, store.layout)
        if telescope == "LOFAR" and instrument is not None:
            _fields_of_lofar(path, store.layout, levels)
        _set_up(path, store, telescope, [level.pointing for level in levels])


def put(path: str, block: Visibilities, store: Store) -> None:
    """The rows of a block, which stand in order of time and then of the block's baselines, antenna 1 before 2.

    Channels are ascending. What is not finite is flagged. Raises `InputError` for data and weights that single
    precision does not hold.
    """
    shape, count = block.data.shape, len(block.antenna1)
    first = int(np.abs(store.slots_s - block.at.slots_s[0]).argmin())
    order = np.argsort(block.freq_hz)
    place = np.searchsorted(np.sort(store.freq_hz), block.freq_hz[order])
    channels: Any = slice(int(place[0]), int(place[0]) + len(place)) if np.all(np.diff(place) == 1) else place
    rows = slice(first * count, (first + shape[0]) * count)
    n = rows.stop - rows.start
    turned = block.antenna1 > block.antenna2
    one, two = np.minimum(block.antenna1, block.antenna2), np.maximum(block.antenna1, block.antenna2)

    def cube(values: Any, kind: Any, conjugate: bool = False) -> Any:
        whole = np.array(np.broadcast_to(values if values.ndim == len(shape) else values[..., None, None], shape))
        back = np.swapaxes(whole[:, :, turned], -1, -2)
        whole[:, :, turned] = back.conj() if conjugate else back
        flat = np.moveaxis(whole[:, order], 1, 2).reshape(n, shape[1], 4)
        if kind is not bool:
            demand_single(flat, "the visibilities" if conjugate else "their weights")
        return np.ascontiguousarray(flat, kind)

    weight = cube(block.weight, np.float32)
    if np.any((weight == 0) & (cube(block.weight, float) > 0)):
        raise InputError("their weights: numbers below 1e-45 cannot be written in single precision: scale them")
    mean = weight.mean(axis=1)
    per_row: dict[str, Any] = {
        "TIME": np.repeat(block.at.slots_s, count),
        "INTERVAL": np.repeat(np.broadcast_to(block.interval_s, shape[:1]), count),
        "ANTENNA1": np.tile(one, shape[0]).astype(np.int32),
        "ANTENNA2": np.tile(two, shape[0]).astype(np.int32),
        # antenna 2 minus antenna 1
        "UVW": (np.where(turned[:, None], 1.0, -1.0) * block.uvw_m).reshape(-1, 3),
        "WEIGHT": mean,
        "SIGMA": np.where(mean > 0, 1 / np.sqrt(np.maximum(mean, NO_WEIGHT**-2)), NO_WEIGHT).astype(np.float32),
        "FLAG_ROW": np.zeros(n, bool),
    }
    per_row |= {"TIME_CENTROID": per_row["TIME"], "EXPOSURE": per_row["INTERVAL"]}
    zeros = ("ARRAY_ID", "DATA_DESC_ID", "FEED1", "FEED2", "FIELD_ID", "OBSERVATION_ID", "PROCESSOR_ID", "SCAN_NUMBER")
    per_row |= dict.fromkeys((*zeros, "STATE_ID"), np.zeros(n, np.int32))
    with opened(path, writable=True) as table, told(path):
        if place[0] == 0:
            for name, values in per_row.items():
                table.putcol(name, values, (rows,))
        where = (rows, channels, slice(None))
        data = cube(block.data, np.complex64, conjugate=True)
        table.putcol("DATA", data, where)
        table.putcol("FLAG", cube(block.flag, bool) | ~np.isfinite(data), where)
        table.putcol("WEIGHT_SPECTRUM", weight, where)


def _cube(name: str, kind: str, channels: int) -> dict[str, Any]:
    return {
        "valueType": kind, "ndim": 2, "shape": [channels, 4], "option": 5, "maxlen": 0, "comment": "", "keywords": {},
        "_c_order": True, "dataManagerType": "TiledColumnStMan", "dataManagerGroup": f"Tiled{name}",
    }  # fmt: skip


def _antennas(path: str, layout: Layout) -> None:
    count = len(layout)
    names = np.array(layout.names, object)
    fill(path, "ANTENNA", {
        "NAME": names, "STATION": names, "POSITION": layout.positions_m, "DISH_DIAMETER": np.full(count, 31.3),
        "MOUNT": np.array(["X-Y"] * count, object), "TYPE": np.array(["GROUND-BASED"] * count, object),
        "OFFSET": np.zeros((count, 3)), "FLAG_ROW": np.zeros(count, bool),
    })  # fmt: skip
    fill(path, "FEED", {
        "ANTENNA_ID": np.arange(count, dtype=np.int32), "SPECTRAL_WINDOW_ID": np.full(count, -1, np.int32),
        "NUM_RECEPTORS": np.full(count, 2, np.int32), "RECEPTOR_ANGLE": np.tile([0.0, np.pi / 2], (count, 1)),
        "POLARIZATION_TYPE": np.tile(np.array(["X", "Y"], object), (count, 1)),
        "POL_RESPONSE": np.tile(np.eye(2, dtype=np.complex64), (count, 1, 1)),
        "BEAM_OFFSET": np.zeros((count, 2, 2)), "POSITION": np.zeros((count, 3)),
        **{name: np.full(count, value, np.int32) for name, value in (("BEAM_ID", -1), ("FEED_ID", 0))},
        "TIME": np.zeros(count), "INTERVAL": np.zeros(count),
    })  # fmt: skip


def _levels(instrument: Instrument | None) -> tuple[Level, ...]:
    terms = instrument.chain().terms if instrument is not None else ()
    return next((term.levels for term in terms if isinstance(term, StationBeam)), ())


def _fields_of_lofar(path: str, layout: Layout, levels: tuple[Level, ...]) -> None:
    """Stations, their axes, tiles and dipoles: HBA tiles and dipoles in a tile, LBA dipoles."""
    fill(path, "ANTENNA", {"LOFAR_PHASE_REFERENCE": layout.positions_m}, {"LOFAR_PHASE_REFERENCE": POSITION}, add=False)
    parts = {n: level.offsets_m for n, level in zip(("ELEMENT_OFFSET", "TILE_ELEMENT_OFFSET"), levels, strict=False)}
    values = {
        "ANTENNA_ID": np.arange(len(layout), dtype=np.int32),
        "NAME": np.array([name[5:] for name in layout.names], object),  # HBA0, HBA1, HBA or LBA
        "POSITION": layout.positions_m,
        "COORDINATE_AXES": layout.axes,  # rows p, q, r
        **parts,
    }
    if parts:
        values["ELEMENT_FLAG"] = np.zeros((*parts["ELEMENT_OFFSET"].shape[:2], 2), bool)
    fill(
        path,
        "LOFAR_ANTENNA_FIELD",
        values,
        {"POSITION": POSITION, "COORDINATE_AXES": METRES, **dict.fromkeys(parts, METRES)},
    )


def _set_up(path: str, store: Store, telescope: str, pointings: Sequence[Any]) -> None:
    """Field, channels, correlations, range of times."""
    centre = Direction(*map(float, store.small["centre"]))
    steered = store.small.get("steered", centre)
    order, slots = np.argsort(store.freq_hz), store.slots_s
    freq = store.freq_hz[order]
    known = store.small["width_hz"] if "width_hz" in store.small else _spacing(freq)
    width = np.array(np.broadcast_to(known, freq.shape), float)[order]
    half = store.small["interval_s"][[0, -1]] / 2
    span = np.array([[slots[0] - half[0], slots[-1] + half[1]]])
    middle = np.array([slots.mean()])
    station, tile, *_ = [p if p is not None else steered for p in (*pointings, None, None)]
    directions = {"PHASE_DIR": centre, "REFERENCE_DIR": centre, "DELAY_DIR": station, "LOFAR_TILE_BEAM_DIR": tile}
    fill(path, "FIELD", {
        **{n: np.array([[d]], float) for n, d in directions.items() if telescope == "LOFAR" or "LOFAR" not in n},
        "NAME": np.array(["field"], object), "CODE": np.array([""], object), "NUM_POLY": np.zeros(1, np.int32),
        "SOURCE_ID": np.full(1, -1, np.int32), "TIME": middle, "FLAG_ROW": np.zeros(1, bool),
    }, {"LOFAR_TILE_BEAM_DIR": DIRECTION})  # fmt: skip
    fill(path, "SPECTRAL_WINDOW", {
        "NUM_CHAN": np.array([len(freq)], np.int32), "CHAN_FREQ": freq[None],
        **dict.fromkeys(("CHAN_WIDTH", "EFFECTIVE_BW", "RESOLUTION"), width[None]),
        "REF_FREQUENCY": np.array([freq.mean()]), "TOTAL_BANDWIDTH": np.array([width.sum()]),
        "MEAS_FREQ_REF": np.array([5], np.int32),  # topocentric
        "NAME": np.array(["window"], object), "NET_SIDEBAND": np.ones(1, np.int32), "FLAG_ROW": np.zeros(1, bool),
    })  # fmt: skip
    products = np.array([[[0, 0], [0, 1], [1, 0], [1, 1]]], np.int32)
    fill(path, "POLARIZATION", {
        "NUM_CORR": np.array([4], np.int32), "CORR_TYPE": np.array([LINEAR], np.int32), "CORR_PRODUCT": products,
        "FLAG_ROW": np.zeros(1, bool),
    })  # fmt: skip
    fill(path, "DATA_DESCRIPTION", {
        **dict.fromkeys(("SPECTRAL_WINDOW_ID", "POLARIZATION_ID"), np.zeros(1, np.int32)),
        "FLAG_ROW": np.zeros(1, bool),
    })  # fmt: skip
    fill(path, "OBSERVATION", {
        "TELESCOPE_NAME": np.array([telescope], object), "TIME_RANGE": span, "FLAG_ROW": np.zeros(1, bool),
        "OBSERVER": np.array(["simulated"], object), "PROJECT": np.array([""], object),
    })  # fmt: skip


def _spacing(freq: Float) -> float:
    """Width of channels of which nothing is known but where they are: their distance."""
    width = float(np.diff(freq).min()) if len(freq) > 1 else 1e5
    warn(f"the width of channels is not known: CHAN_WIDTH is {width / 1e3:g} kHz (channel_width of the Observation)")
    return width


def fill(
    path: str, sub: str, values: Mapping[str, Any], words: Mapping[str, Any] | None = None, add: bool = True
) -> None:
    """Rows of a subtable, which is made if it is not there, as are columns that it lacks."""
    where = f"{path}/{sub}"
    if not Path(where).exists():
        with created(where, {name: _described(v) for name, v in values.items()}):
            pass
        with opened(path, writable=True) as table:
            table.putkeywords({sub: f"Table: {where}"})
    with opened(path, sub, writable=True) as table:
        lacking = {name: _described(v) for name, v in values.items() if name not in table.columns()}
        if lacking:
            table.addcols(lacking, {})
        for column, known in (words or {}).items():
            if column in table.columns():
                table.putcolkeywords(column, known)
        if add:
            table.addrows(len(next(iter(values.values()))))
        for name, value in values.items():
            table.putcol(name, value)


def _described(value: Any) -> dict[str, Any]:
    array: dict[str, Any] = {"ndim": value.ndim - 1, "shape": list(value.shape[1:])} if value.ndim > 1 else {}
    return {
        "valueType": KINDS[value.dtype.kind], "option": 5 if array else 0, "maxlen": 0, "comment": "", "keywords": {},
        "_c_order": True, "dataManagerType": "StandardStMan", "dataManagerGroup": "StandardStMan", **array,
    }  # fmt: skip
