"""A LOFAR Measurement Set made from our own objects, with all that EveryBeam and DP3 ask for.

Positions, axes, tiles, dipoles, times and uvw are the package's numbers in double precision, so a comparison sees the
other program and not another survey. UVW has the sign of Measurement Sets: position of ANTENNA2 minus ANTENNA1.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from os import PathLike
from pathlib import Path
from typing import Any

import numpy as np

from instrument.jones.station import StationBeam
from instrument.model import Instrument
from instrument.observe.observation import Observation
from instrument.observe.sampling import Sampling, mjd_seconds

METRES: dict[str, Any] = {"QuantumUnits": ["m", "m", "m"]}
POSITION = METRES | {"MEASINFO": {"type": "position", "Ref": "ITRF"}}
DIRECTION = {"QuantumUnits": ["rad", "rad"], "MEASINFO": {"type": "direction", "Ref": "J2000"}}
KINDS: dict[str, tuple[str, Any]] = {"i": ("int", 0), "f": ("double", 0.0), "b": ("bool", False)}


def make_ms(
    path: str | PathLike[str],
    lofar: Instrument,
    observation: Observation,
    columns: Sequence[str] = ("DATA",),
    turned: bool = False,
) -> None:
    """Write the set at `path`, `columns` zero and weights 1; rows in time order, then in that of `layout.baselines`.

    `turned` makes UVW position of ANTENNA1 minus ANTENNA2: the sign with which DP3's fringes agree with its beams.
    """
    from casacore import tables

    path, layout, centre = str(path), lofar.layout(), observation.phase_centre
    channels, interval = len(observation.freq_hz), observation.interval
    times = observation.times(layout)
    at = Sampling.build(layout, times, observation.freq_hz, centre.ra_rad, centre.dec_rad, centre)
    a, b = layout.baselines
    slots = mjd_seconds(times)
    rows = len(slots) * len(a)

    with tables.default_ms(path, _main_description(channels, columns), {}) as ms:
        _fill(
            ms,
            {
                "ANTENNA1": np.tile(a, len(slots)).astype(np.int32),
                "ANTENNA2": np.tile(b, len(slots)).astype(np.int32),
                "UVW": (at.uvw_m[:, b] - at.uvw_m[:, a]).reshape(-1, 3) * (-1 if turned else 1),
                **dict.fromkeys(("TIME", "TIME_CENTROID"), np.repeat(slots, len(a))),
                **dict.fromkeys(("INTERVAL", "EXPOSURE"), np.full(rows, interval)),
                **dict.fromkeys(("WEIGHT", "SIGMA"), np.ones((rows, 4), np.float32)),
                "FLAG": np.zeros((rows, channels, 4), bool),
                "WEIGHT_SPECTRUM": np.ones((rows, channels, 4), np.float32),
                **dict.fromkeys(columns, np.zeros((rows, channels, 4), np.complex64)),
            },
        )
        for name in columns:
            ms.putcolkeyword(name, "LOFAR_APPLIED_BEAM_MODE", "None")
    _antennas(path, lofar)
    _set_up(path, observation, (slots[0] - interval / 2, slots[-1] + interval / 2))


def _antennas(path: str, lofar: Instrument) -> None:
    """Stations, their tiles and dipoles, and feeds."""
    layout = lofar.layout()
    count = len(layout)
    numbers = np.arange(count, dtype=np.int32)
    _subtable(
        path,
        "ANTENNA",
        {
            "NAME": list(layout.names),
            "POSITION": layout.positions_m,
            "LOFAR_PHASE_REFERENCE": layout.positions_m,
            "DISH_DIAMETER": np.full(count, 31.3),
        },
        {"LOFAR_PHASE_REFERENCE": POSITION},
    )
    # tiles and dipoles of the high band, antennas of the low band
    levels = next(term.levels for term in lofar.chain().terms if isinstance(term, StationBeam))
    parts = {n: level.offsets_m for n, level in zip(("ELEMENT_OFFSET", "TILE_ELEMENT_OFFSET"), levels, strict=False)}
    _subtable(
        path,
        "LOFAR_ANTENNA_FIELD",
        {
            "ANTENNA_ID": numbers,
            "NAME": [name[5:] for name in layout.names],  # HBA0, HBA1, HBA or LBA
            "POSITION": layout.positions_m,
            "COORDINATE_AXES": layout.axes,  # rows p, q, r
            **parts,
            "ELEMENT_FLAG": np.zeros((*parts["ELEMENT_OFFSET"].shape[:2], 2), bool),
        },
        {"POSITION": POSITION, **dict.fromkeys(("COORDINATE_AXES", *parts), METRES)},
    )
    _subtable(
        path,
        "FEED",
        {
            "ANTENNA_ID": numbers,
            "SPECTRAL_WINDOW_ID": np.full(count, -1, np.int32),
            "NUM_RECEPTORS": np.full(count, 2, np.int32),
            "RECEPTOR_ANGLE": np.tile([0.0, np.pi / 2], (count, 1)),
            "POLARIZATION_TYPE": {"shape": [count, 2], "array": ["X", "Y"] * count},
        },
    )


def _set_up(path: str, observation: Observation, span: tuple[float, float]) -> None:
    """Pointing, channels, correlations, and the range of times."""
    centre, channels = observation.phase_centre, len(observation.freq_hz)
    pointings = ("DELAY_DIR", "PHASE_DIR", "REFERENCE_DIR", "LOFAR_TILE_BEAM_DIR")
    towards = np.array([[[centre.ra_rad, centre.dec_rad]]])
    _subtable(path, "FIELD", dict.fromkeys(pointings, towards), {"LOFAR_TILE_BEAM_DIR": DIRECTION})
    width = observation.width_hz or 1e5
    _subtable(
        path,
        "SPECTRAL_WINDOW",
        {
            "NUM_CHAN": [channels],
            "CHAN_FREQ": observation.freq_hz[None],
            **dict.fromkeys(("CHAN_WIDTH", "EFFECTIVE_BW", "RESOLUTION"), np.full((1, channels), width)),
            "REF_FREQUENCY": [observation.freq_hz.mean()],
            "TOTAL_BANDWIDTH": [width * channels],
            "MEAS_FREQ_REF": [5],  # topocentric
        },
    )
    _subtable(
        path,
        "POLARIZATION",
        {
            "NUM_CORR": [4],
            "CORR_TYPE": np.array([[9, 10, 11, 12]], np.int32),  # XX XY YX YY
            "CORR_PRODUCT": np.array([[[0, 0], [0, 1], [1, 0], [1, 1]]], np.int32),
        },
    )
    _subtable(path, "DATA_DESCRIPTION", {"SPECTRAL_WINDOW_ID": [0], "POLARIZATION_ID": [0]})
    _subtable(path, "OBSERVATION", {"TELESCOPE_NAME": ["LOFAR"], "TIME_RANGE": np.array([span])})


def _main_description(channels: int, columns: Sequence[str]) -> Any:
    """The required columns of the main table, and those that hold (channel, correlation) arrays."""
    from casacore import tables

    tiled = {"shape": [channels, 4], "datamanagertype": "TiledColumnStMan"}
    cubes = [tables.makearrcoldesc(n, 0j, valuetype="complex", datamanagergroup=n, **tiled) for n in columns]
    cubes.append(tables.makearrcoldesc("WEIGHT_SPECTRUM", 0.0, valuetype="float", datamanagergroup="WS", **tiled))
    found = tables.required_ms_desc("MAIN")
    found.update(tables.maketabdesc(cubes))
    return found


def _subtable(path: str, name: str, values: Mapping[str, Any], keywords: Mapping[str, Any] | None = None) -> None:
    """Fill a subtable, made if it is not there; columns it lacks are added, with the type of their values."""
    from casacore import tables

    where = f"{path}/{name}"
    if not Path(where).exists():
        tables.table(where, tables.maketabdesc([_describe(*item) for item in values.items()]), ack=False).close()
        with tables.table(path, readonly=False, ack=False) as ms:
            ms.putkeyword(name, f"Table: {where}")
    with tables.table(where, readonly=False, ack=False) as sub:
        lacking = [_describe(*item) for item in values.items() if item[0] not in sub.colnames()]
        if lacking:
            sub.addcols(tables.maketabdesc(lacking))
        for column, words in (keywords or {}).items():
            for key, value in words.items():
                sub.putcolkeyword(column, key, value)
        _fill(sub, values)


def _describe(name: str, value: Any) -> Any:
    from casacore import tables

    if isinstance(value, list):
        return tables.makescacoldesc(name, "", valuetype="string")
    kind, zero = KINDS[value.dtype.kind]
    if value.ndim == 1:
        return tables.makescacoldesc(name, zero, valuetype=kind)
    return tables.makearrcoldesc(name, zero, valuetype=kind, ndim=value.ndim - 1)


def _fill(table: Any, values: Mapping[str, Any]) -> None:
    table.addrows(len(next(iter(values.values()))))
    for column, value in values.items():
        table.putcol(column, value)
