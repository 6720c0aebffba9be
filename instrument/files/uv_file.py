"""UVFile: a UVFITS or UVH5 file as a set of visibilities, in blocks; its own UVW; drift scans phased."""

from __future__ import annotations

import os
from typing import Any

import numpy as np

from instrument import h5
from instrument.beam_state import BeamState
from instrument.checked import checked
from instrument.errors import FileError, InputError, warn
from instrument.files.by_rows import Cells, RowFile, Rows, Where, coordinates, in_time, pairs_of
from instrument.files.ms_frame import Frame, beam_state_of, correlated, distinct, in_order, one_of
from instrument.files.uv_data import CORRELATIONS, library, told
from instrument.files_in import harmless, open_regular
from instrument.observe.directions import LIGHT
from instrument.observe.layout import Layout
from instrument.units import Direction, Int, direction
from instrument.visibilities import Visibilities

JD_OF_MJD = 2400000.5
MEAN, SUM = "avg", "sum"  # of xx and yy, which is Stokes I
WHAT = "UVFITS or UVH5 file"


@checked
class UVFile(RowFile):
    """One window and phase centre of a UVFITS or UVH5 file, in blocks of at most 64 MB of data (extra `uv`, pyuvdata).

    Rows may stand in any order, times be irregular, baselines missing (they are flagged), antenna numbers have gaps:
    stations are those of the file in its order, by name. Autocorrelations are left out, with a warning. Weights are
    numbers of samples. The UVW of the file are used, as `MeasurementSet` uses those of a set. A drift scan has no phase
    centre ("unprojected"): with `centre` it is phased by the UVW of the IERS Earth, without it is refused. xx is pp
    whatever x points to; circular feeds come as linear ones; data whose I is xx + yy are doubled. Raises `FileError`
    for what is no such file, `InputError` where a window or phase centre (`field`, its number) is to be chosen.
    """

    def __init__(
        self, path: str | os.PathLike[str], window: int | None = None, field: int | None = None, centre: Any = None
    ) -> None:
        self.path, self.kind = str(path), _kind(path)
        uv = self._read(read_data=False)
        _demand_plain(self.path, uv)
        fields = [int(k) for k in np.unique(uv.phase_center_id_array)]
        which = one_of(self.path, field, fields, "field", "phase centres")
        chosen = one_of(self.path, window, [int(w) for w in np.unique(uv.flex_spw_id_array)], "window", "windows")
        self.drift = uv.phase_center_catalog[which]["cat_type"] == "unprojected"
        found = _centre(self.path, uv.phase_center_catalog[which], centre)
        self.channels = np.flatnonzero(uv.flex_spw_id_array == chosen)
        self.frame = _frame(self.path, uv, chosen, found, which)
        self.beam_state = _beam_state(uv.extra_keywords, self.path)
        self.doubled = uv.pol_convention == SUM
        self.rows, self._one, self._two = _rows(self.path, uv, which)
        self._uvw = None if self.drift else np.asarray(uv.uvw_array, float)
        self._say_autos()

    def _coordinates(self, times: slice) -> Where:
        numbers = self.rows.of(times)
        uvw = None if self._uvw is None else self._uvw[numbers]
        return coordinates(self.path, self.frame, self.rows, times, self._one[numbers], self._two[numbers], uvw)

    def _block(self, times: slice, channels: slice, which: Int | None = None) -> Visibilities:
        block = super()._block(times, channels, which)
        turned = block.data * 2 if self.doubled else block.data
        if self.drift:
            waves = block.uvw_m[:, None, :, 2] * (block.freq_hz / LIGHT)[:, None]
            turned = turned * np.exp(2j * np.pi * (waves - np.rint(waves)))[..., None, None]
        return block if turned is block.data else block.with_data(turned)

    def _cells(self, numbers: Int, channels: slice) -> Cells:
        order = np.argsort(numbers)
        inside = self.frame.inside(channels)
        some: dict[str, Any] = {"blt_inds": numbers[order], "freq_chans": self.channels[inside]}
        uv = self._read(**some)
        rows = np.argsort(order)  # as they were asked for
        arrays = (uv.data_array, uv.flag_array, uv.nsample_array)
        return Cells(*(self.frame.ascending(x[rows], channels) for x in arrays))

    def _read(self, **how: Any) -> Any:
        """What pyuvdata reads."""
        uv = library().UVData()
        with told(self.path):
            read = uv.read_uvh5 if self.kind == "uvh5" else uv.read_uvfits
            read(self.path, run_check=False, background_lsts=False, **how)
        return uv


def _kind(path: Any) -> str:
    """Which of the two formats a file is of, by its first bytes; raises `FileError` for others."""
    library()
    with open_regular(path, what=WHAT) as file:
        first = file.read(16)
    if first.startswith(b"SIMPLE  ="):
        return "uvfits"
    if first.startswith(b"\x89HDF"):
        with h5.opened(path, WHAT) as inside:
            if "Header" in h5.members(inside):
                return "uvh5"
        raise FileError(f"{harmless(path)} is HDF5 without the group Header of UVH5: Visibilities.open reads our own")
    raise FileError(f"{harmless(path)} is neither UVFITS nor UVH5")


def _demand_plain(path: str, uv: Any) -> None:
    """Raise `InputError` for times, frames and units that are not those of visibilities in Jy seen from the Earth."""
    for found, known, remedy in (
        (uv.telescope._location.frame, ("itrs",), "positions are to be on the Earth, ITRF"),
        (uv.timesys, (None, "", "UTC"), "times are to be UTC"),
        (uv.vis_units, ("Jy", "JY", "uncalib"), "visibilities are to be in Jy: convert them (pyuvdata's UVData)"),
        (uv.pol_convention, (None, MEAN, SUM), "Stokes I is to be the mean or the sum of xx and yy"),
    ):
        if found not in known:
            raise InputError(f"{path} has '{harmless(found, 40)}': {remedy}")
    if uv.flex_spw_polarization_array is not None:
        raise InputError(f"{path}: its windows are of a correlation each: read and write it with pyuvdata, as plain")
    if uv.vis_units == "uncalib":
        warn(f"{path}: its visibilities are not calibrated: they are taken as Jy")


def _centre(path: str, entry: Any, given: Any) -> Direction:
    """Phase centre, ICRS: the one of the file, or the one given for a drift scan."""
    kind, frame = entry["cat_type"], entry.get("cat_frame")
    if kind == "unprojected":
        if given is None:
            raise InputError(f"{path} is a drift scan without a phase centre: give centre=, and it is phased to there")
        return direction(given, "centre")
    if kind != "sidereal":
        raise InputError(f"{path}: its phase centre is of kind '{kind}': phase it to a fixed place (pyuvdata's phase)")
    if given is not None:
        raise InputError(f"{path} has a phase centre: centre= is for drift scans; vis.shifted_to turns its blocks")
    if frame not in ("icrs", "fk5") or (frame == "fk5" and entry.get("cat_epoch") not in (None, 2000.0, "J2000")):
        epoch = entry.get("cat_epoch")
        raise InputError(f"{path}: its phase centre is in {frame}, epoch {epoch}, this takes ICRS or J2000: convert it")
    return Direction(float(np.ravel(entry["cat_lon"])[0]) % (2 * np.pi), float(np.ravel(entry["cat_lat"])[0]))


def _frame(path: str, uv: Any, window: int, centre: Direction, field: int) -> Frame:
    channels = np.flatnonzero(uv.flex_spw_id_array == window)
    scope = uv.telescope
    freq, width = np.asarray(uv.freq_array, float)[channels], np.abs(np.asarray(uv.channel_width, float))[channels]
    freq, width, order = in_order(f"{path}: window {window}", freq, width)
    kinds = correlated(path, tuple(CORRELATIONS.get(int(k), int(k)) for k in uv.polarization_array))
    with told(path):
        site = np.array([getattr(scope.location, axis).to_value("m") for axis in "xyz"])
        places, names = site + scope.antenna_positions, distinct([str(n).strip() for n in scope.antenna_names])
    return Frame(
        Layout.geodetic(names, places), str(scope.name or ""), freq, width, order, kinds, centre, centre,
        field, 0,
    )  # fmt: skip


def _rows(path: str, uv: Any, field: int) -> tuple[Rows, Int, Int]:
    """Rows of a phase centre, in order of time; of all rows, the stations by their place in the file."""
    stations = np.asarray(uv.telescope.antenna_numbers)
    order = np.argsort(stations)
    numbers = [np.asarray(x) for x in (uv.ant_1_array, uv.ant_2_array)]
    known = [np.minimum(np.searchsorted(stations[order], x), len(order) - 1) for x in numbers]
    for asked, found in zip(numbers, known, strict=True):
        if np.any(unknown := stations[order][found] != asked):
            raise FileError(f"{path}: rows are of antenna {asked[unknown][0]}, which is not described")
    one, two = (order[found] for found in known)
    mine = np.asarray(uv.phase_center_id_array) == field
    cross = np.flatnonzero(mine & (one != two))
    if not cross.size:
        raise FileError(f"{path} has no cross-correlations of this phase centre")
    seconds = (np.asarray(uv.time_array, float) - JD_OF_MJD) * 86400.0
    pairs = pairs_of(one[cross], two[cross], len(stations), path)
    rows = in_time(cross, seconds[cross], pairs, len(stations), path)
    interval = np.asarray(uv.integration_time, float)[rows.numbers[rows.begins[:-1]]]
    return rows._replace(interval_s=interval, autos=int((mine & (one == two)).sum())), one, two


def _beam_state(words: Any, path: str) -> BeamState:
    """What the keywords of `write_uv` say has been taken out."""
    mode = words.get("BEAMMODE", "None")
    towards = {key: {"value": words.get(word)} for key, word in (("m0", "BEAMRA"), ("m1", "BEAMDEC"))}
    return beam_state_of({"LOFAR_APPLIED_BEAM_MODE": mode, "LOFAR_APPLIED_BEAM_DIR": towards}, path)
