"""MSv4: visibilities as an xarray DataTree in the schema of xradio, version 4.0.1 (extra `xarray`)."""

from __future__ import annotations

from typing import Any

import numpy as np

from instrument.errors import InputError
from instrument.provenance import written_by

MISSING = "MSv4 needs xarray: pip install 'instrument[xarray]'"
SCHEMA = "4.0.1"
UNIX_S = 40587 * 86400.0  # MJD of 1970; taken off without rounding
CORRELATIONS = ("XX", "XY", "YX", "YY")
ANTENNAS, FIELDS = "antenna_xds", "field_and_source_base_xds"


def library() -> Any:
    """The module; raises `InputError` with the way to get it."""
    try:
        import xarray
    except ImportError:
        raise InputError(MISSING) from None
    return xarray


def cells(values: Any, shape: tuple[int, ...]) -> Any:
    """Values (T, F, B), or of correlations (T, F, B, 2, 2), as (T, B, F, 4); of one that is repeated, a view."""
    wide = np.broadcast_to(values if values.ndim == 5 else values[..., None, None], shape)
    if not any(wide.strides):
        return np.broadcast_to(wide[:1, :1, :1, :1, 0].ravel(), (shape[0], shape[2], shape[1], 4))
    return np.moveaxis(wide, 1, 2).reshape(shape[0], shape[2], shape[1], 4).copy()


def tree_of(vis: Any, telescope: str = "unknown") -> Any:
    """A measurement set of version 4: the main dataset, and in it those of antennas and of the field.

    UVW are antenna 2 minus antenna 1; a flag, a weight and a UVW for each visibility. Raises `InputError` where
    channels have no width, or several.
    """
    xarray = library()
    if vis.width_hz is None or np.ptp(vis.width_hz) > 0:
        raise InputError("MSv4 says one width of all channels: these have none, or several; give channel_width")
    said = written_by()
    date = f"{said['written']}.000"
    axes = ("time", "baseline_id", "frequency", "polarization")
    names, shape = np.array(vis.layout.names), vis.data.shape

    def cube(values: Any) -> Any:
        return cells(values, shape)

    interval = np.broadcast_to(vis.interval_s, shape[0])
    width, first = float(np.ravel(vis.width_hz)[0]), float(vis.freq_hz[0])
    spectral = {"units": "Hz", "observer": "TOPO", "type": "spectral_coord"}
    base = {
        "correlated_data": "VISIBILITY", "flag": "FLAG", "weight": "WEIGHT", "uvw": "UVW", "field_and_source": FIELDS,
        "description": str(vis.beam_state), "date": date,
    }  # fmt: skip
    main = xarray.Dataset(
        {
            "VISIBILITY": (axes, cube(vis.data), {"units": "Jy"}),
            "FLAG": (axes, cube(vis.flag)),
            "WEIGHT": (axes, cube(vis.weight)),
            "UVW": (("time", "baseline_id", "uvw_label"), -vis.uvw_m, {"type": "uvw", "frame": "icrs", "units": "m"}),
            "EFFECTIVE_INTEGRATION_TIME": (
                axes[:2], np.repeat(interval[:, None], shape[2], 1), {"units": "s", "type": "quantity"},
            ),
        },
        {
            "time": ("time", vis.at.slots_s - UNIX_S, {
                "type": "time", "units": "s", "scale": "utc", "format": "unix",
                "integration_time": _quantity(float(np.median(interval)), "s"),
            }),
            "baseline_id": np.arange(shape[2]),
            "baseline_antenna1_name": ("baseline_id", names[vis.antenna1]),
            "baseline_antenna2_name": ("baseline_id", names[vis.antenna2]),
            "frequency": ("frequency", vis.freq_hz, {
                **spectral, "spectral_window_name": "window", "spectral_window_intents": ["UNSPECIFIED"],
                "reference_frequency": {"data": first, "dims": [], "attrs": spectral},
                "channel_width": _quantity(width, "Hz"),
            }),
            "polarization": list(CORRELATIONS), "uvw_label": ["u", "v", "w"],
            "field_name": ("time", np.full(shape[0], "field")),
            "scan_name": ("time", np.full(shape[0], "1"), {"scan_intents": ["OBSERVE_TARGET#UNSPECIFIED"]}),
        },
        {
            "schema_version": SCHEMA, "type": "visibility", "creation_date": date, "data_groups": {"base": base},
            "creator": {"software_name": "instrument", "version": str(said["software"]).rpartition(" ")[2]},
            "observation_info": {"observer": [""], "release_date": date, "project_UID": ""},
            "processor_info": {"type": "CORRELATOR", "sub_type": "SIMULATOR"},
        },
    )  # fmt: skip
    antennas = _antennas(vis.layout, telescope)
    return xarray.DataTree.from_dict({"/": main, f"/{ANTENNAS}": antennas, f"/{FIELDS}": _field(vis)})


def _quantity(value: float, units: str) -> dict[str, Any]:
    return {"data": value, "dims": [], "attrs": {"units": units, "type": "quantity"}}


def _antennas(layout: Any, telescope: str) -> Any:
    count = len(layout)
    place = {"units": "m", "frame": "ITRS", "coordinate_system": "geocentric", "origin_object_name": "earth",
             "type": "location"}  # fmt: skip
    return library().Dataset(
        {"ANTENNA_POSITION": (("antenna_name", "cartesian_pos_label"), np.array(layout.positions_m), place)},
        {
            "antenna_name": list(layout.names), "station_name": ("antenna_name", list(layout.names)),
            "mount": ("antenna_name", ["UNKNOWN"] * count), "telescope_name": ("antenna_name", [telescope] * count),
            "receptor_label": ["pol_0", "pol_1"], "cartesian_pos_label": ["x", "y", "z"],
            "polarization_type": (("antenna_name", "receptor_label"), [["X", "Y"]] * count),
        },
        {"type": "antenna", "overall_telescope_name": telescope, "relocatable_antennas": False},
    )  # fmt: skip


def _field(vis: Any) -> Any:
    sky = {"units": "rad", "type": "sky_coord", "frame": "icrs"}
    centre = np.array([list(vis.phase_centre)])
    return library().Dataset(
        {"FIELD_PHASE_CENTER_DIRECTION": (("field_name", "sky_dir_label"), centre, sky)},
        {"field_name": ["field"], "source_name": ("field_name", ["field"]), "sky_dir_label": ["ra", "dec"]},
        {"type": "field_and_source"},
    )
