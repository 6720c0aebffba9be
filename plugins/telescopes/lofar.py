"""LofarHBA and LofarLBA: the Dutch stations of LOFAR, from surveyed positions."""

from __future__ import annotations

from typing import Any, ClassVar, Literal

import numpy as np
from astropy import units as u
from instrument_plugins.data import table
from instrument_plugins.elements.hamaker import Hamaker
from pydantic import Field, field_validator

from instrument.errors import InputError, did_you_mean
from instrument.jones.base import ElementBeam
from instrument.jones.chain import Chain
from instrument.jones.parallactic import Parallactic
from instrument.jones.station import ArrayFactor, Level, Phase, StationBeam
from instrument.model import Instrument
from instrument.numbers import brief
from instrument.observe.layout import Layout
from instrument.units import Float, PositiveHertz, SkyDirection

ALL = ("all",)  # stands for the stations of the paper; no list that is given can be it
AXES = ("px", "py", "pz", "qx", "qy", "qz", "rx", "ry", "rz")


class _Lofar(Instrument):
    """What the two bands share: stations by name from a table, the beam and where it points."""

    telescope_name = "LOFAR"
    station_file: ClassVar[str]
    parts_file: ClassVar[str]

    stations: tuple[str, ...] = Field(default=ALL, validate_default=True)
    beam_kind: Literal["full", "element", "array-factor"] | None = Field(default="full", alias="beam")
    beam_pointing: SkyDirection | None = None
    reference_frequency: PositiveHertz | None = None
    phase: Phase = "fringe"

    @field_validator("beam_kind", mode="before")
    @classmethod
    def _none_in_words(cls, value: Any) -> Any:
        return None if value == "none" else value  # a scene file has no other word for it

    @field_validator("stations", mode="before")
    @classmethod
    def _known(cls, value: Any) -> Any:
        rows = table(cls.station_file)
        names = list(map(str, rows["name"]))
        if value is ALL:
            return tuple(n for n, used in zip(names, rows["used"], strict=True) if used)
        if not isinstance(value, list | tuple) or not all(isinstance(name, str) for name in value):
            raise InputError(f"stations = {brief(value)} is not a list of station names")
        if not value:
            raise InputError(
                f"stations = [] names none: leave the key out for the {int(sum(rows['used']))} of the paper"
            )
        for name in value:
            if name not in names:
                raise InputError(f"no station {brief(name)} in {cls.__name__}: {did_you_mean(name, names)}")
        return tuple(value)

    def _rows(self) -> Any:
        rows = table(self.station_file)
        names = list(map(str, rows["name"]))
        return rows[[names.index(n) for n in self.stations]]

    def layout(self) -> Layout:
        """The stations: surveyed phase centres and the axes of their antenna planes."""
        rows = self._rows()
        columns = ("x", "y", "z") if "x" in rows.columns else ("x_m", "y_m", "z_m")
        positions = np.stack([rows[c] for c in columns], axis=1).astype(float)
        axes = np.stack([rows[k] for k in AXES], axis=1).astype(float).reshape(-1, 3, 3)
        return Layout(names=self.stations, positions_m=positions, axes=axes)

    def _surveyed(self, column: str, keep: range | None = None) -> Float:
        """Offsets (A, M, 3) in ITRF m of the tiles or antennas of every station."""
        rows = table(self.parts_file)
        xyz = np.stack([rows["dx_m"], rows["dy_m"], rows["dz_m"]], axis=1).astype(float)
        use = np.isin(rows[column], list(keep)) if keep is not None else np.ones(len(rows), bool)
        return np.stack([xyz[(rows["name"] == n) & use] for n in self.stations])

    def _chain(self, element: ElementBeam, levels: tuple[Level, ...]) -> Chain:
        reference = self.reference_frequency and self.reference_frequency * u.Hz
        if self.beam_kind is None:
            return Chain(*self.receivers())
        if self.beam_kind == "element" and self.phase == "fringe":
            return Chain(*self.receivers(), element, Parallactic())
        if self.beam_kind == "array-factor":
            alone = ArrayFactor(levels=levels, reference_frequency=reference, phase=self.phase)
            return Chain(*self.receivers(), alone)
        levels = levels if self.beam_kind == "full" else ()
        station = StationBeam(element=element, levels=levels, reference_frequency=reference, phase=self.phase)
        return Chain(*self.receivers(), station, Parallactic())


class LofarHBA(_Lofar):
    """LOFAR high band, 120-240 MHz: 24-tile core fields, and remote stations tapered to their inner 24 tiles.

    `stations` (the 59 of Asad et al. 2015 by default; the paper does not name its 11 remote ones), `element`, `beam`
    "full" (element, tiles and station), "element", "array-factor" or `None` (feeds along north and east), `tiles`
    "surveyed" or "ideal" (the 5.15 m lattice: stations with one tile rotation then share their array factor, at an
    error of 1.5e-4 of the peak within 10 deg, 4.5e-4 for CS401HBA1), `tile_pointing` and `beam_pointing` (the phase
    centre by default), `phase` "fringe" (a station is the mean of its dipoles) or "everybeam" (as EveryBeam, and DP3 on
    LOFAR sets, have it: array factor and element conjugated).
    """

    station_file: ClassVar[str] = "lofar_hba_stations.ecsv"
    parts_file: ClassVar[str] = "lofar_hba_tiles.csv"
    element: ElementBeam = Hamaker(band="hba")
    tiles: Literal["surveyed", "ideal"] = "surveyed"
    tile_pointing: SkyDirection | None = None

    def chain(self) -> Chain:
        """Gains and feeds if given, station beam, parallactic rotation."""
        return self._chain(
            self.element,
            (
                Level(offsets_m=self.tile_offsets(), pointing=self.beam_pointing),
                Level(offsets_m=self.dipole_offsets(), pointing=self.tile_pointing or self.beam_pointing),
            ),
        )

    def tile_offsets(self) -> Float:
        """Tile centres about the station's, ITRF m (A, 24, 3)."""
        if self.tiles == "surveyed":
            return self._surveyed("tile")
        meta = table(self.station_file).meta
        rows, pitch = meta["ideal_tile_rows"], meta["ideal_tile_pitch_m"]
        top = (len(rows) - 1) / 2
        lattice = [(i - (n - 1) / 2, top - j) for j, n in enumerate(rows) for i in range(n)]
        return self._turned(pitch * np.array(lattice))

    def dipole_offsets(self) -> Float:
        """Dipoles about the centre of their tile, ITRF m (A, 16, 3): a 4x4 lattice turned with the tile."""
        meta = table(self.station_file).meta
        side, pitch = meta["dipoles_per_tile_side"], meta["dipole_pitch_m"]
        steps = np.arange(side) - (side - 1) / 2
        return self._turned(pitch * np.array([(x, y) for y in steps[::-1] for x in steps]))

    def _turned(self, lattice_m: Float) -> Float:
        """A lattice in the p-q plane (M, 2) turned clockwise by each station's tile rotation, ITRF m (A, M, 3)."""
        rows = self._rows()
        turn = np.deg2rad(np.asarray(rows["tile_rotation"], float))
        cos, sin = np.cos(turn), np.sin(turn)
        x, y = lattice_m.T
        p = cos[:, None] * x + sin[:, None] * y
        q = -sin[:, None] * x + cos[:, None] * y
        axes = self.layout().axes
        return np.asarray(p[..., None] * axes[:, None, 0] + q[..., None] * axes[:, None, 1])


class LofarLBA(_Lofar):
    """LOFAR low band, 10-100 MHz: stations of 48 dipole pairs phased in one level.

    `antennas` "outer" (numbers 48 to 95 of each field), "inner" (0 to 47) or "all"; the other fields as for `LofarHBA`.
    """

    station_file: ClassVar[str] = "lofar_lba_stations.csv"
    parts_file: ClassVar[str] = "lofar_lba_antennas.csv"
    element: ElementBeam = Hamaker(band="lba")
    antennas: Literal["outer", "inner", "all"] = "outer"

    def chain(self) -> Chain:
        """Gains and feeds if given, station beam, parallactic rotation."""
        use = {"outer": range(48, 96), "inner": range(48), "all": range(96)}[self.antennas]
        offsets = self._surveyed("antenna", use)
        return self._chain(self.element, (Level(offsets_m=offsets, pointing=self.beam_pointing),))
