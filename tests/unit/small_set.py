"""A small Measurement Set written by arcae alone: stations, channels and rows as asked for."""

import numpy as np

COMPLEX = {"valueType": "COMPLEX", "ndim": 2, "option": 0, "maxlen": 0, "comment": "", "keywords": {}, "_c_order": True,
           "dataManagerType": "StandardStMan", "dataManagerGroup": "cubes"}  # fmt: skip
KINDS = {"i": "INT", "f": "DOUBLE", "b": "BOOLEAN", "U": "STRING"}


def fill(path, sub, values):
    """Rows of a subtable."""
    from arcae.lib.arrow_tables import Table

    with Table.from_filename(f"{path}::{sub}", readonly=False) as table:
        table.addrows(len(next(iter(values.values()))))
        for name, value in values.items():
            table.putcol(name, np.asarray(value))


def write(
    path, layout, rows, freq_hz, data, flag=None, weight=None, kinds=(9, 10, 11, 12), windows=1, fields=1,
    centre=(2.15, 0.84), telescope="SKA", keywords=None, spectrum=True,
):  # fmt: skip
    """A set of `rows` (time, antenna 1 and 2, uvw, window, field) and data (N, F, n) in the column DATA."""
    from arcae.lib.arrow_tables import Table

    count, channels, n = data.shape
    cube = {**COMPLEX, "shape": [channels, n]}
    columns = {"DATA": {**cube, "keywords": keywords or {}}}
    if spectrum:
        columns["WEIGHT_SPECTRUM"] = {**cube, "valueType": "FLOAT"}
    with Table.ms_from_descriptor(str(path), "MAIN", columns) as table:
        table.addrows(count)
        time, one, two, uvw, window, field = rows
        flag = np.zeros(data.shape, bool) if flag is None else flag
        weight = np.ones(data.shape) if weight is None else weight
        values = {
            "TIME": time, "TIME_CENTROID": time, "ANTENNA1": one.astype(np.int32), "ANTENNA2": two.astype(np.int32),
            "UVW": uvw, "DATA_DESC_ID": window.astype(np.int32), "FIELD_ID": field.astype(np.int32),
            "INTERVAL": np.full(count, 10.0), "EXPOSURE": np.full(count, 10.0), "FLAG": flag,
            "FLAG_ROW": np.zeros(count, bool), "WEIGHT": weight.mean(axis=1).astype(np.float32),
            "SIGMA": np.ones((count, n), np.float32), "DATA": data.astype(np.complex64),
        }  # fmt: skip
        if spectrum:
            values["WEIGHT_SPECTRUM"] = weight.astype(np.float32)
        for name, value in values.items():
            table.putcol(name, value)
    fill(path, "ANTENNA", {"NAME": np.array(layout.names, object), "POSITION": layout.positions_m})
    fill(path, "DATA_DESCRIPTION", {"SPECTRAL_WINDOW_ID": np.arange(windows, dtype=np.int32),
                                    "POLARIZATION_ID": np.zeros(windows, np.int32)})  # fmt: skip
    fill(path, "SPECTRAL_WINDOW", {
        "CHAN_FREQ": np.tile(freq_hz, (windows, 1)) + 1e6 * np.arange(windows)[:, None],
        "CHAN_WIDTH": np.full((windows, channels), 1e5), "MEAS_FREQ_REF": np.full(windows, 5, np.int32),
    })  # fmt: skip
    fill(path, "POLARIZATION", {"NUM_CORR": np.array([n], np.int32), "CORR_TYPE": np.array([kinds], np.int32)})
    fill(path, "FIELD", dict.fromkeys(("PHASE_DIR", "DELAY_DIR"), np.tile(centre, (fields, 1, 1)).astype(float)))
    fill(path, "OBSERVATION", {"TELESCOPE_NAME": np.array([telescope], object)})
