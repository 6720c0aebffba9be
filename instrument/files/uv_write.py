"""write_uv: visibilities as UVFITS or UVH5, for AIPS, CASA and the 21-cm packages; whole or not at all."""

from __future__ import annotations

import os
from collections.abc import Iterable
from pathlib import Path
from typing import Any, Literal

import numpy as np

from instrument.checked import checked
from instrument.errors import InputError
from instrument.files.ms_frame import beam_words
from instrument.files.uv_data import KINDS, library, name_antennas, say_utc, telescope_of, told
from instrument.files.uv_file import JD_OF_MJD, MEAN
from instrument.memory import afford
from instrument.provenance import written_by
from instrument.visibilities import Visibilities, VisibilitySet
from instrument.visibility_sets import as_one, outline_and_blocks, places_in
from instrument.whole_file import whole_file

LINEAR = (-5, -6, -7, -8)  # xx, yy, xy, yx, as AIPS numbers them
PLACES = [0, 3, 1, 2]  # of these among pp, pq, qp, qq
KINDS_OF = {"single": (np.complex64, np.float32), "double": (np.complex128, np.float64)}  # data; weights of UVFITS


@checked
def write_uv(
    path: str | os.PathLike[str],
    visibilities: VisibilitySet | Iterable[Visibilities],
    overwrite: bool = False,
    precision: Literal["single", "double"] | None = None,
    telescope: str = "unknown",
) -> None:
    """Write visibilities to a file in .uvfits or .uvh5, through pyuvdata (extra `uv`), which `UVFile` reads.

    Antennas are numbered from 1 in the order of the stations, with their names; the first of a baseline has the lower
    number; UVW are those of the visibilities (antenna 2 minus 1 in UVH5, 1 minus 2 in UVFITS, each with its phase).
    `precision` of data is double in UVH5 and single in UVFITS unless given. Times are Julian days, to 20 microseconds;
    weights single in UVH5, of the precision of the data in UVFITS, where a weight of 0 is a flag. Raises `InputError`
    where a channel has no width, and in UVFITS for channels that are not as far apart as they are wide.
    """
    kind = KINDS.get(Path(path).suffix.lower())
    if kind is None:
        raise InputError(f"{path}: the name of the file is to end in one of {', '.join(KINDS)}")
    library()
    precision = precision or ("double" if kind == "uvh5" else "single")
    with whole_file(path, overwrite) as partial:
        if kind == "uvh5":
            outline, blocks = outline_and_blocks(visibilities, partial.parent / "blocks.h5")
            uv = _uv_data(path, outline, telescope)
            with told(path):
                uv.initialize_uvh5_file(str(partial), data_write_dtype=np.dtype(KINDS_OF[precision][0]))
                for block in blocks:
                    uv.write_uvh5_part(str(partial), check_header=False, **_part(outline, block, precision))
            return
        vis = as_one(visibilities, partial.parent / "blocks.h5")
        afford(4 * vis.data.nbytes, f"{path}: all of it at once", "write fewer channels or times in a file, or UVH5")
        uv = _uv_data(path, vis, telescope, _rows(vis, precision, KINDS_OF[precision][1]))
        with told(path):
            uv.write_uvfits(str(partial))
            name_antennas(partial, "AIPS AN", "ANNAME", vis.layout.names)
            say_utc(partial)


def _rows(vis: Visibilities, precision: str, weights: type) -> dict[str, Any]:
    """Data, flags and weights in rows by time, then by baseline, of the correlations of pyuvdata."""
    times, channels, baselines = vis.data.shape[:3]
    turned = vis.antenna1 > vis.antenna2

    def rows(values: Any, conjugate: bool = False) -> Any:
        wide = values if values.ndim == 5 else values[..., None, None]
        wide = np.array(np.broadcast_to(wide, vis.data.shape))
        back = np.swapaxes(wide[:, :, turned], -1, -2)
        wide[:, :, turned] = back.conj() if conjugate else back
        flat = wide.reshape(times, channels, baselines, 4)[..., PLACES]
        return np.ascontiguousarray(np.moveaxis(flat, 1, 2)).reshape(times * baselines, channels, 4)

    return {
        "data_array": rows(vis.data, conjugate=True).astype(KINDS_OF[precision][0]),
        "flag_array": rows(vis.flag),
        "nsample_array": rows(vis.weight).astype(weights),
    }


def _part(outline: Visibilities, block: Visibilities, precision: str) -> dict[str, Any]:
    """A block, and where its rows and channels are in the file."""
    times, channels = places_in(outline, block)
    count = len(outline.antenna1)
    return _rows(block, precision, np.float32) | {
        "blt_inds": np.arange(times.start * count, times.stop * count),
        "freq_chans": np.arange(channels.start, channels.stop),
    }


def _uv_data(path: Any, vis: Visibilities, telescope: str, rows: dict[str, Any] | None = None) -> Any:
    """What pyuvdata holds of visibilities: rows by time, then by baseline; without `rows` their coordinates alone."""
    if vis.width_hz is None:
        raise InputError(
            f"{path}: channels need a width, which is not known: give channel_width to the Observation, or "
            "dataclasses.replace(vis, width_hz=...)"
        )
    times, channels = vis.data.shape[:2]
    turned = vis.antenna1 > vis.antenna2
    first, second = np.minimum(vis.antenna1, vis.antenna2), np.maximum(vis.antenna1, vis.antenna2)
    with told(path):
        uv = library().UVData.new(
            freq_array=vis.freq_hz, polarization_array=np.array(LINEAR), times=JD_OF_MJD + vis.at.slots_s / 86400.0,
            telescope=telescope_of(vis.layout, telescope), antpairs=np.stack([first, second], 1) + 1, do_blt_outer=True,
            integration_time=np.array(np.broadcast_to(vis.interval_s, times)),
            channel_width=np.array(np.broadcast_to(vis.width_hz, channels)), update_telescope_from_known=False,
            history=f"{written_by()['software']}, {written_by()['written']}. ", vis_units="Jy", pol_convention=MEAN,
            time_axis_faster_than_bls=False, extra_keywords=_beam(vis), **(rows or {}),
            phase_center_catalog={
                0: {
                    "cat_name": "phase centre", "cat_type": "sidereal", "cat_frame": "icrs", "cat_epoch": 2000.0,
                    "cat_lon": vis.phase_centre.ra_rad, "cat_lat": vis.phase_centre.dec_rad,
                }
            },
        )  # fmt: skip
    uv.uvw_array = (np.where(turned[:, None], 1.0, -1.0) * vis.uvw_m).reshape(-1, 3)
    return uv


def _beam(vis: Visibilities) -> dict[str, Any]:
    """Keywords of what has been taken out, which UVFITS has room for."""
    words = beam_words(vis.beam_state)
    towards = words.get("LOFAR_APPLIED_BEAM_DIR")
    out: dict[str, Any] = {"BEAMMODE": words["LOFAR_APPLIED_BEAM_MODE"]}
    return out if towards is None else {**out, "BEAMRA": towards["m0"]["value"], "BEAMDEC": towards["m1"]["value"]}
