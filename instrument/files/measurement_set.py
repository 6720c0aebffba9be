"""MeasurementSet: a Measurement Set as a set of visibilities, in blocks; its own UVW; columns read and written."""

from __future__ import annotations

import os
from collections.abc import Iterable
from pathlib import Path
from typing import Any, Self

import numpy as np

from instrument.checked import checked
from instrument.errors import FileError, InputError, warn
from instrument.files import ms_create
from instrument.files.by_rows import FAR, SAME_S, Cells, RowFile, Where, coordinates, places
from instrument.files.ms_frame import beam_state_of, beam_words, frame_of
from instrument.files.ms_history import add_history
from instrument.files.ms_rows import at_rows, filled, pairs_at, rows_of
from instrument.files.ms_tables import demand, kinds_of, opened, told
from instrument.files.ms_units import in_unit, jansky, unit_of
from instrument.files.ms_write import Part, add_column, correlated, demand_column, demand_space, put, stored, undone
from instrument.model import Instrument
from instrument.partial_folders import beside
from instrument.store import Store
from instrument.units import Int
from instrument.visibilities import Visibilities, VisibilitySet
from instrument.visibility_sets import VisibilityFile, as_set, in_pieces
from instrument.whole_file import whole_folder

SAME_RAD = 1e-9  # phase centres as near as this are one
NEEDED = ("TIME", "INTERVAL", "ANTENNA1", "ANTENNA2", "DATA_DESC_ID", "FIELD_ID", "UVW", "FLAG")

LOSS = 1e-6  # of the rms, above which a column is said to compress what is written
MARK = "table.dat"  # a file of every set


@checked
class MeasurementSet(RowFile):
    """One window and field of a Measurement Set: its column `column` in blocks of at most 64 MB of data.

    Data are in Jy, from the unit of the column. Rows may stand in any order, times may be irregular and baselines
    missing (they are flagged); autocorrelations are left out, with a warning. Weights are WEIGHT_SPECTRUM, or WEIGHT;
    flags FLAG or FLAG_ROW. The UVW of the file are used, antenna 2 minus antenna 1: those of its stations
    (`Sampling.own_uvw_m`), or those of its baselines where they do not close (`given_uvw_m`). Circular feeds come as
    linear ones: V = C^H V_RL C with R = (X + iY) / sqrt(2) of coherencies, RR = I + V. Raises `FileError` for what is
    no whole set, `InputError` where a window or field is to be chosen, and for units that are not of flux. Source of
    the format: Kemball & Wieringa (2000), MeasurementSet definition version 2.0.
    """

    def __init__(
        self, path: str | os.PathLike[str], column: str = "DATA", window: int | None = None, field: int | None = None
    ) -> None:
        self.path, self.column = str(path), column
        with opened(self.path) as table:
            demand(table, NEEDED, self.path)
            self._known(table)
            if not table.nrow():
                raise FileError(f"{self.path} has no rows")
            described, fields = (kinds_of(table, name) for name in ("DATA_DESC_ID", "FIELD_ID"))
            self.frame = frame_of(self.path, window, field, described, fields)
            self.rows = rows_of(table, self.frame, self.path)
            self.weights = next(
                (n for n in ("WEIGHT_SPECTRUM", "WEIGHT") if filled(table, n, self.rows, self.path)), ""
            )
            self.beam_state = beam_state_of(table.getcolkeywords(column), self.path)
        self._say_autos()

    @property
    def _which(self) -> str:  # type: ignore[override]
        return f", {self.column}"

    @checked
    def write(self, column: str, blocks: VisibilitySet | Iterable[Visibilities], overwrite: bool = False) -> int:
        """Write visibilities of the same times, channels and stations into a column, which is made if it is not there.

        The blocks are worked out and kept beside the set first; where that fails, or the writing, or where it is
        stopped, the set is as it was. A column that is there is written with `overwrite` only. Rows that no block has,
        of autocorrelations and of other windows and fields, stay as they are, zero in a new column. Data are written,
        with the keywords of LOFAR on which beam has been taken out; weights and flags are not: what is flagged and not
        in the FLAG of the set is NaN, what is flagged in both stays as it was in a column that was there. The number
        of correlations that are NaN for it. HISTORY, where the set has it, gets a row. Raises `InputError` for blocks
        that are of something else, and for what is no column for visibilities; `RefusedError` where the disk has no
        room.
        """
        self.demand_column(column, overwrite)
        demand_space(self.path, float(np.prod(self.shape)), kept=not isinstance(blocks, VisibilityFile))
        lacking = 0
        with beside(Path(self.path).absolute()) as folder:
            kept = _kept(blocks, folder)
            self._same(kept.store)
            with undone(self.path, column, folder) as journal, opened(self.path, writable=True) as table:
                there = column in table.columns()
                if not there:
                    add_column(table, column, self.column, self.path)
                unit = jansky(unit_of(table, column, self.path), f"{self.path}: {column}") if there else 1.0
                for number, block in enumerate(in_pieces(kept.blocks())):
                    if not number:
                        self._say_uvw(block)
                    part = self._placed(table, block, unit)
                    lacking += put(table, column, part, there, journal)
                    if not number and (apart := stored(table, column, part)) > LOSS:
                        warn(
                            f"column {column} of {self.path} keeps visibilities to {apart:.1e} of their rms only: its "
                            "storage manager compresses them (Dysco); name another column to keep single precision"
                        )
                with told(f"column {column}"):
                    words = {} if there else {"UNIT": "Jy"}
                    table.putcolkeywords(column, beam_words(kept.store.beam_state) | words)
                silent = add_history(self.path, f"column {column}", folder)
            if silent:
                warn(f"column {column} of {self.path} is written, its HISTORY does not say so: {silent}")
        return lacking

    def demand_column(self, column: str, overwrite: bool) -> None:
        """Raise `InputError` for a column that may not be written, or is there without `overwrite`."""
        demand_column(self.path, column, overwrite, self.frame)

    @classmethod
    def create(
        cls,
        path: str | os.PathLike[str],
        blocks: VisibilitySet | Iterable[Visibilities],
        overwrite: bool = False,
        instrument: Instrument | None = None,
    ) -> Self:
        """Write blocks as a new set, which DP3, EveryBeam, WSClean and CASA read; the set.

        Data go to DATA in single precision, weights to WEIGHT_SPECTRUM, their means to WEIGHT, 1/sqrt of those to
        SIGMA; UVW are those of the blocks, antenna 2 minus antenna 1. With the `instrument` the telescope has its name,
        and a LOFAR its tables of stations, tiles and dipoles, without which no other program finds its beam. The set is
        whole or not there; one that is there is replaced with `overwrite` only. Raises `InputError` for other folders
        of that name, `FileError` where nothing can be written.
        """
        with whole_folder(path, MARK, overwrite) as partial:
            kept = _kept(blocks, partial.parent)
            told_by = blocks.frame.telescope if isinstance(blocks, RowFile) else ""
            ms_create.make(str(partial), kept.store, instrument, told_by)
            for block in in_pieces(kept.blocks()):
                ms_create.put(str(partial), block, kept.store)
            if silent := add_history(str(partial), "set", partial.parent):
                raise FileError(f"{path}: {silent}")
        return cls(path)

    def _known(self, table: Any) -> None:
        if self.column not in table.columns():
            kinds = {n: str(table.getcoldesc(n).get("valueType", "")).lower() for n in table.columns()}
            cubes = [n for n, kind in kinds.items() if "complex" in kind]
            raise InputError(f"{self.path} has no column {self.column}: it has {', '.join(cubes) or 'no visibilities'}")
        kind = str(table.getcoldesc(self.column).get("valueType", "")).lower()
        if "complex" not in kind:
            raise InputError(f"{self.path}: column {self.column} holds {kind}, not visibilities")
        self.jansky = jansky(unit_of(table, self.column, self.path), f"{self.path}: {self.column}")

    def _cells(self, numbers: Int, channels: slice) -> Cells:
        with opened(self.path) as table:
            flags = self._cube(table, "FLAG", numbers, channels)
            if "FLAG_ROW" in table.columns():
                flags = flags.astype(bool) | at_rows(table, "FLAG_ROW", numbers).astype(bool)[:, None, None]
            data = self._cube(table, self.column, numbers, channels)
            return Cells(data, flags, self._weight(table, numbers, channels))

    def _cube(self, table: Any, name: str, numbers: Int, channels: slice = slice(None)) -> Any:
        """Values (N, F, n) of a column, channels ascending."""
        inside = self.frame.inside(channels)
        have = inside.stop - inside.start
        values = at_rows(table, name, numbers, None if have == len(self.frame.freq_hz) else inside)
        want = (len(numbers), have, len(self.frame.kinds))
        if values.shape != want:
            raise FileError(f"{self.path}: {name} has shape {values.shape}, channels and correlations need {want}")
        return self.frame.ascending(values, channels)

    def _weight(self, table: Any, numbers: Int, channels: slice) -> Any:
        shape = (len(numbers), len(self.frame.freq_hz[channels]), len(self.frame.kinds))
        if self.weights == "WEIGHT_SPECTRUM":
            return self._cube(table, self.weights, numbers, channels)
        one = at_rows(table, "WEIGHT", numbers)[:, None] if self.weights == "WEIGHT" else np.ones(())
        return np.broadcast_to(one, shape)

    def _coordinates(self, times: slice) -> Where:
        numbers = self.rows.of(times)
        with opened(self.path) as table:
            one, two = pairs_at(table, self.frame, numbers)
            uvw = in_unit(table, "UVW", at_rows(table, "UVW", numbers), "m", self.path)
        return coordinates(self.path, self.frame, self.rows, times, one, two, uvw)

    def _same(self, kept: Store) -> None:
        """Raise `InputError` unless what was kept is of these times, channels and baselines."""
        rows, small = self.rows, kept.small
        if kept.layout.names != self.frame.layout.names:
            raise InputError(f"the visibilities are of other stations than {self.path}")
        centre = self.frame.centre
        if np.abs(small["centre"] - np.array(centre)).max() > SAME_RAD:
            raise InputError(f"the visibilities are about another phase centre than {self.path}, which has {centre}")
        for name in ("antenna1", "antenna2"):
            if not np.array_equal(small[name], getattr(rows, name)):
                raise InputError(f"the visibilities are of other baselines than {self.path}")
        if kept.shape[0] != self.shape[0] or np.abs(kept.slots_s - rows.slots_s).max() > SAME_S:
            raise InputError(f"the visibilities are of other times than {self.path}")
        if kept.shape[1] != self.shape[1] or np.abs(kept.freq_hz - self.freq_hz).max() > 1.0:
            raise InputError(f"the visibilities are of other channels than {self.path}")

    def _say_uvw(self, block: Visibilities) -> None:
        """Warn where visibilities have other UVW than the set, which keeps its own."""
        where = self._coordinates(self._where(block)[0])
        ours = where.given_uvw_m
        if ours is None:
            ours = where.at.uvw_m[:, self.rows.antenna1] - where.at.uvw_m[:, self.rows.antenna2]
        apart, size = (float(np.sqrt((x**2).sum())) for x in (block.uvw_m - ours, ours))
        if apart > FAR * size:
            off = f"{100 * apart / size:.2g}" if size else "infinitely many"
            warn(f"the visibilities have UVW that are {off} % off those of {self.path}, which keeps its own")

    def _placed(self, table: Any, block: Visibilities, unit: float) -> Part:
        """A block in the rows and correlations of the file and a unit of so many Jy, and its times and channels."""
        rows, frame = self.rows, self.frame
        times, channels = self._where(block)
        numbers = rows.of(times)
        one, two = pairs_at(table, frame, numbers)
        place = places(self.path, rows, len(frame.layout), times, one, two)

        def in_rows(x: Any) -> Any:
            wide = np.broadcast_to(x if x.ndim == block.data.ndim else x[..., None, None], block.data.shape)
            return np.moveaxis(wide, 1, 2).reshape(-1, len(block.freq_hz), 2, 2)[place]

        data, flag = in_rows(block.data), in_rows(block.flag)
        values, flags = correlated(frame, data, flag, one > two)
        return Part(values / unit, flags, numbers, frame.order[channels])


def _kept(blocks: VisibilitySet | Iterable[Visibilities], folder: Path) -> VisibilityFile:
    """Blocks in a file: where they cannot be worked out, it is known before anything is written."""
    if isinstance(blocks, VisibilityFile):
        return blocks
    as_set(blocks).save(folder / "blocks.h5")
    return VisibilityFile(folder / "blocks.h5")
