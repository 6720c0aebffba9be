"""Msv4File and write_msv4: measurement sets of version 4 in Zarr, read in blocks and written, whole or not at all."""

from __future__ import annotations

import os
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np

from instrument import zarr_tree
from instrument.beam_state import BeamState
from instrument.checked import checked
from instrument.errors import FileError, InputError
from instrument.files.by_rows import Cells, RowFile, Rows, Where, coordinates, in_time, pairs_of
from instrument.files.ms_frame import NAMES, Frame, beam_state_of, beam_words, correlated, distinct, in_order
from instrument.files.ms_units import EQUATORIAL, jansky
from instrument.files_in import harmless
from instrument.msv4 import ANTENNAS, UNIX_S, cells, library, tree_of
from instrument.observe.layout import Layout
from instrument.store import FORMAT
from instrument.units import Direction, Float, Int
from instrument.visibilities import Visibilities, VisibilitySet
from instrument.visibility_sets import outline_and_blocks, places_in
from instrument.whole_file import whole_folder

KINDS = {name: kind for kind, name in NAMES.items()}
MARK = ".zgroup"  # of version 2 of Zarr, which has names of stations; in version 3 they have no place of their own yet
CUBES = ("VISIBILITY", "FLAG", "WEIGHT")
CHUNK_BYTES = 8e6  # of data that Zarr reads at once
BEAM = "instrument_beam"  # attribute of a main dataset: what has been taken out


@contextmanager
def _told(path: str | os.PathLike[str]) -> Iterator[None]:
    """What xarray and zarr make of broken folders as `FileError`s."""
    try:
        yield
    except (InputError, MemoryError):
        raise
    except Exception as error:  # of many kinds, by two libraries and their codecs
        text = " ".join((str(error) or type(error).__name__).split())
        raise FileError(f"{harmless(path)}: {harmless(text, 300)}") from None


@checked
def write_msv4(
    path: str | os.PathLike[str],
    visibilities: VisibilitySet | Iterable[Visibilities],
    overwrite: bool = False,
    telescope: str = "unknown",
) -> None:
    """Write visibilities as a processing set of one measurement set of version 4 (xradio's schema), a Zarr folder.

    Extras `xarray` and `zarr`. Data, flags, weights, times and channels to the last bit; which beam has been taken out
    stands in the attributes. Raises `InputError` where channels have no width, or several.
    """
    if not zarr_tree.is_zarr(path):
        raise InputError(f"{path}: the name of a set of version 4 is to end in {zarr_tree.SUFFIX}")
    xarray, zarr = library(), zarr_tree.library()
    with whole_folder(path, MARK, overwrite) as partial:
        outline, blocks = outline_and_blocks(visibilities, partial.parent / "blocks.h5")
        tree = tree_of(outline, telescope or "unknown")
        tree.attrs[BEAM] = beam_words(outline.beam_state)
        root = xarray.DataTree.from_dict({"/": xarray.Dataset(attrs={"type": "processing_set"})})
        root["set"] = tree
        times, channels, baselines = outline.data.shape[:3]
        chunk = (int(max(1, min(times, CHUNK_BYTES // (64 * channels * baselines)))), baselines, channels, 4)
        chunks = {"/set": {name: {"chunks": chunk} for name in CUBES}}
        with _told(path), zarr.config.set({"array.write_empty_chunks": True}):  # or -0.0 comes back as 0.0
            root.to_zarr(partial, mode="w-", consolidated=True, zarr_format=2, encoding=chunks)
            group = zarr.open_group(str(partial), mode="r+", zarr_format=2)["set"]
            for block in blocks:
                t, f = places_in(outline, block)
                for name, values in zip(CUBES, (block.data, block.flag, block.weight), strict=True):
                    group[name][t, :, f] = cells(values, block.data.shape)


@checked
class Msv4File(RowFile):
    """One measurement set of version 4 in a Zarr folder, in blocks of at most 64 MB of data (extras `xarray`, `zarr`).

    `name` chooses where a processing set holds several, `group` the data of one that has more than "base". Baselines
    without UVW are flagged; autocorrelations are left out, with a warning. The UVW of the file are used, as
    `MeasurementSet` uses those of a set. Raises `FileError` for what is no such folder, `InputError` for a choice to be
    made and for times, frames and fields that are not taken.
    """

    def __init__(self, path: str | os.PathLike[str], name: str | None = None, group: str = "base") -> None:
        self.path = str(path)
        with zarr_tree.opened(path, "measurement set of version 4") as folder:
            if folder.attrs.get("format") == FORMAT:
                raise FileError(f"{harmless(path)} is a file of visibilities of our own: Visibilities.open reads it")
        with _told(path):
            tree = library().open_datatree(self.path, engine="zarr", chunks=None, consolidated=False)
            found = {n.path.strip("/"): n for n in tree.subtree if n.attrs.get("type") == "visibility"}
            node = _chosen(self.path, found, name)
            groups = node.attrs["data_groups"]
            if group not in groups:
                raise InputError(f"{self.path} has no group of data '{group}': it has {', '.join(groups)}")
            self.group, self.main = groups[group], node.to_dataset(inherit=False)
            self.frame = _frame(self.path, node, self.group)
            data = self.group["correlated_data"]
            self.jansky = jansky(self.main[data].attrs.get("units", "Jy"), f"{self.path}: {data}")
            self.beam_state: BeamState = beam_state_of(node.attrs.get(BEAM, {}), self.path)
            self.rows, self._one, self._two, self._uvw = self._all_rows()
        self._say_autos()

    def _all_rows(self) -> tuple[Rows, Int, Int, Float]:
        """All pairs of a time and a baseline as rows, those with UVW."""
        main, names = self.main, list(self.frame.layout.names)
        pairs = [[names.index(str(n)) for n in main[f"baseline_antenna{k}_name"].values] for k in (1, 2)]
        times = main.sizes["time"]
        one, two = (np.tile(np.array(p), times) for p in pairs)
        uvw = np.asarray(main[self.group["uvw"]].values, float).reshape(-1, 3)
        seen = np.isfinite(uvw).all(axis=1)
        cross = np.flatnonzero(seen & (one != two))
        if not cross.size:
            raise FileError(f"{self.path} has no cross-correlations with UVW")
        seconds = np.repeat(np.asarray(main["time"].values, float) + UNIX_S, len(pairs[0]))
        pairs_seen = pairs_of(one[cross], two[cross], len(names), self.path)
        rows = in_time(cross, seconds[cross], pairs_seen, len(names), self.path)
        interval = np.full(len(rows.slots_s), float(main["time"].attrs["integration_time"]["data"]))
        if "EFFECTIVE_INTEGRATION_TIME" in main and main["EFFECTIVE_INTEGRATION_TIME"].ndim == 2:
            each = np.asarray(main["EFFECTIVE_INTEGRATION_TIME"].values, float).ravel()
            each = each[rows.numbers[rows.begins[:-1]]]
            interval = np.where(each > 0, each, interval)
        return rows._replace(interval_s=interval, autos=int((seen & (one == two)).sum())), one, two, uvw

    def _coordinates(self, times: slice) -> Where:
        numbers = self.rows.of(times)
        one, two, uvw = self._one[numbers], self._two[numbers], self._uvw[numbers]
        return coordinates(self.path, self.frame, self.rows, times, one, two, uvw)

    def _cells(self, numbers: Int, channels: slice) -> Cells:
        baselines = self.main.sizes["baseline_id"]
        first, last = int(numbers.min()) // baselines, int(numbers.max()) // baselines + 1
        some = {"time": slice(first, last), "frequency": self.frame.inside(channels)}
        found = []
        with _told(self.path):
            for key in ("correlated_data", "flag", "weight"):
                cube = self.main[self.group[key]].isel(some).values
                flat = cube.reshape(-1, *cube.shape[2:])[numbers - first * baselines]
                found.append(self.frame.ascending(flat, channels))
        return Cells(*found)


def _chosen(path: str, found: dict[str, Any], name: str | None) -> Any:
    if not found:
        raise FileError(f"{path} holds no interferometric set of version 4 (a dataset of type 'visibility')")
    if name is None and len(found) == 1:
        return next(iter(found.values()))
    if name not in found:
        asked = f"has no set '{name}'" if name is not None else f"holds {len(found)} sets"
        raise InputError(f"{path} {asked}: choose one by name=, {', '.join(sorted(found))}")
    return found[name]


def _frame(path: str, node: Any, group: Any) -> Frame:
    main, antennas = node.to_dataset(inherit=False), node[ANTENNAS].to_dataset(inherit=False)
    field = node[group["field_and_source"]].to_dataset(inherit=False)
    centre, time = field["FIELD_PHASE_CENTER_DIRECTION"], main["time"].attrs
    if centre.ndim != 2 or len(centre) != 1:
        raise InputError(f"{path} holds {len(centre)} fields, or one that moves: take one of them (xradio)")
    if (time.get("format"), time.get("scale")) != ("unix", "utc"):
        raise InputError(f"{path}: times are {time.get('scale')} as {time.get('format')}: this takes utc as unix")
    known = str(centre.attrs.get("frame", "icrs"))
    if known not in ("icrs", "fk5", *EQUATORIAL):
        raise InputError(f"{path}: its phase centre is in {known}, this takes ICRS or J2000 (fk5): convert it")
    freq = np.asarray(main["frequency"].values, float)
    width = np.full(len(freq), float(main["frequency"].attrs["channel_width"]["data"]))
    freq, width, order = in_order(path, freq, width)
    kinds = correlated(path, tuple(KINDS.get(str(p), 0) for p in main["polarization"].values))
    names = distinct([str(n) for n in antennas["antenna_name"].values])
    places = np.asarray(antennas["ANTENNA_POSITION"].values, float)
    ra, dec = (float(x) for x in centre.values[0])
    towards = Direction(ra % (2 * np.pi), dec)
    return Frame(
        Layout.geodetic(names, places), str(antennas.attrs.get("overall_telescope_name", "")),
        freq, width, order, kinds, towards, towards, 0, 0,
    )  # fmt: skip
