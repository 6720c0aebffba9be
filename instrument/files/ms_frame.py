"""What a Measurement Set says beside its rows: stations, channels, correlations, phase centre, beam taken out."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.linalg import norm

from instrument.beam_state import PARTS, BeamState
from instrument.errors import FileError, InputError, warn
from instrument.files.ms_tables import column, demand, kinds_of, opened
from instrument.files.ms_units import EQUATORIAL, angles, cell, direction_at, frame_named, in_unit
from instrument.files_in import harmless
from instrument.observe.layout import Layout
from instrument.shown import short_repr
from instrument.units import Complex, Direction, Float, Int

LINEAR, CIRCULAR = (9, 10, 11, 12), (5, 6, 7, 8)  # XX XY YX YY, RR RL LR LL (casacore's Stokes)
NAMES = {1: "I", 2: "Q", 3: "U", 4: "V", **dict(zip(CIRCULAR, ("RR", "RL", "LR", "LL"), strict=True)),
         **dict(zip(LINEAR, ("XX", "XY", "YX", "YY"), strict=True))}  # fmt: skip
LISTED = 8  # numbers of windows or fields that a message tells
SAME_RAD = 1e-12  # rounding of units: directions as near as this are one
DEEP_M = 1e6  # from the centre of the Earth: nearer than this stands nothing
TOPOCENTRIC = (1, 5)  # of channels: at rest, topocentric
# receptors R, L of X, Y as IAU has them, with which RR = I + V
TO_CIRCULAR = np.array([[1, 1j], [1, -1j]]) / np.sqrt(2)


@dataclass(frozen=True)
class Frame:
    """One window and field of a set."""

    __repr__ = short_repr
    layout: Layout
    telescope: str
    freq_hz: Float
    width_hz: Float
    order: Int  # where the channels, ascending, stand in the file
    kinds: tuple[int, ...]  # correlations, as casacore numbers them
    centre: Direction
    pointing: Direction
    field: int
    described: int  # row of DATA_DESCRIPTION
    dropped: tuple[int, ...] = ()  # stations of the file that no row has, and that stand nowhere

    def of(self, channels: slice) -> Frame:
        """The same for some channels."""
        return replace(
            self, freq_hz=self.freq_hz[channels], width_hz=self.width_hz[channels], order=self.order[channels]
        )

    def inside(self, channels: slice) -> slice:
        """What of the file has these channels in it, and others where they stand apart."""
        where = self.order[channels]
        return slice(int(where.min()), int(where.max()) + 1)

    def ascending(self, values: Any, channels: slice) -> Any:
        """Values (N, k, ...) of the file, of what is `inside`, as those of the channels, ascending."""
        where = self.order[channels]
        where = where - where.min()
        for step in (1, -1):  # without a copy
            if np.array_equal(where, np.arange(values.shape[1])[::step]):
                return values[:, ::step]
        return values[:, where]

    def numbered(self, stations: Int) -> Int:
        """Numbers of stations in the file, of which `dropped` occur nowhere, as those of the layout."""
        return stations - np.searchsorted(self.dropped, stations) if self.dropped else stations

    def linear(self, data: Complex) -> Complex:
        """Correlations (..., n) in the order of the file as matrices (..., 2, 2) of receptors p, q.

        Those that were not correlated are 0.
        """
        out = np.zeros((*data.shape[:-1], 4), complex)
        order = CIRCULAR if self.kinds[0] in CIRCULAR else LINEAR
        for k, kind in enumerate(self.kinds):
            out[..., order.index(kind)] = data[..., k]
        found = out.reshape(*data.shape[:-1], 2, 2)
        return TO_CIRCULAR.conj().T @ found @ TO_CIRCULAR if order is CIRCULAR else found

    def spread(self, values: Any, lacking: Any) -> Any:
        """Weights or flags (..., n) as (..., 2, 2): of circular ones the worst, `lacking` where there is none."""
        if self.kinds[0] in CIRCULAR:  # each linear one has all four in it
            worst = values.min(axis=-1) if values.dtype != bool else values.any(axis=-1)
            return np.broadcast_to(worst[..., None, None], (*values.shape[:-1], 2, 2))
        out = np.full((*values.shape[:-1], 4), lacking, values.dtype)
        for k, kind in enumerate(self.kinds):
            out[..., LINEAR.index(kind)] = values[..., k]
        return out.reshape(*values.shape[:-1], 2, 2)

    def alike(self, values: Any, step: int) -> bool:
        """Whether flags or weights (N, F, n) of the file are one for all four receptors, looked at in `step` rows."""
        if self.kinds[0] in CIRCULAR:
            return True
        return len(self.kinds) == 4 and all(
            np.array_equal(some[..., 1:], some[..., :-1], equal_nan=some.dtype != bool)
            for some in (values[r : r + step] for r in range(0, len(values), step))
        )

    def correlated(self, data: Complex) -> Complex:
        """Matrices (..., 2, 2) as the correlations (..., n) of the file."""
        order = CIRCULAR if self.kinds[0] in CIRCULAR else LINEAR
        found = TO_CIRCULAR @ data @ TO_CIRCULAR.conj().T if order is CIRCULAR else data
        flat = found.reshape(*data.shape[:-2], 4)
        return flat[..., [order.index(kind) for kind in self.kinds]]


def frame_of(path: str, window: int | None, field: int | None, described: Int, fields: Int) -> Frame:
    """The frame of one window and field, of those that rows have (`described`, `fields`)."""
    for name, found in (("DATA_DESC_ID", described), ("FIELD_ID", fields)):
        if found.size and found.min() < 0:
            raise FileError(f"{path}: rows have {name} {found.min()}: it is to name a row, from 0")
    with opened(path, "DATA_DESCRIPTION") as table:
        windows, kinds = column(table, "SPECTRAL_WINDOW_ID"), column(table, "POLARIZATION_ID")
    if described.size and described.max() >= len(windows):
        raise FileError(f"{path}: rows have DATA_DESC_ID {described.max()}, of {len(windows)} that are described")
    have = sorted({int(windows[d]) for d in described})
    chosen = one_of(path, window, have, "window", "spectral windows")
    rows = [int(d) for d in described if windows[d] == chosen]
    if len(rows) > 1:
        raise FileError(f"{path}: spectral window {chosen} has {len(rows)} sets of correlations: split the set")
    which = one_of(path, field, [int(f) for f in fields], "field", "fields")
    freq, width, order = _channels(path, chosen)
    centre, pointing = _directions(path, which)
    layout, telescope, dropped = _stations(path)
    return Frame(
        layout, telescope, freq, width, order, _correlations(path, int(kinds[rows[0]])), centre, pointing,
        which, rows[0], dropped,
    )  # fmt: skip


def one_of(path: str, asked: int | None, have: list[int], name: str, what: str) -> int:
    """The window or field asked for, or the only one; raises `InputError` where one is to be chosen."""
    if asked is None and len(have) == 1:
        return have[0]
    if asked in have:
        return int(asked)
    known = ", ".join(map(str, have[:LISTED])) or "none"
    known += ", ..." if len(have) > LISTED else ""
    if asked is None:
        raise InputError(f"{path} holds {len(have)} {what} ({known}): choose one, {name}={have[0] if have else 0}")
    raise InputError(f"{path} has no {name} {asked}: its rows are of {known}")


def _channels(path: str, window: int) -> tuple[Float, Float, Int]:
    where = f"{path}::SPECTRAL_WINDOW"
    with opened(path, "SPECTRAL_WINDOW") as table:
        demand(table, ("CHAN_FREQ", "CHAN_WIDTH"), where)
        freq, width = (
            in_unit(table, name, cell(table, name, window, where), "Hz", where) for name in ("CHAN_FREQ", "CHAN_WIDTH")
        )
        kind = int(cell(table, "MEAS_FREQ_REF", window, where)) if "MEAS_FREQ_REF" in table.columns() else 5
    if kind not in TOPOCENTRIC:
        warn(f"{path}: channels are not topocentric (frame {kind} of casacore): taken as they stand, 1e-4 off at most")
    return in_order(f"{path}: window {window}", freq, width)


def in_order(where: str, freq: Float, width: Float) -> tuple[Float, Float, Int]:
    """Channels and their widths, ascending, and where they stand; raises `FileError` for what are none."""
    order, width = np.argsort(freq, kind="stable"), np.abs(width)
    if freq.shape != width.shape or not np.all(np.isfinite(freq) & (freq > 0) & (width > 0)):
        raise FileError(f"{where}: channels are not positive frequencies with a width each")
    if np.any(np.diff(freq[order]) == 0):
        raise FileError(f"{where}: a channel is there twice: each frequency is to be there once")
    return freq[order], width[order], order


def _correlations(path: str, row: int) -> tuple[int, ...]:
    with opened(path, "POLARIZATION") as table:
        return correlated(path, tuple(int(k) for k in cell(table, "CORR_TYPE", row, f"{path}::POLARIZATION")))


def correlated(path: str, kinds: tuple[int, ...]) -> tuple[int, ...]:
    """Correlations as casacore numbers them; raises `InputError` for those that no 2 x 2 matrices can be made of."""
    for known in (LINEAR, CIRCULAR):
        if set(kinds) <= set(known) and {known[0], known[3]} <= set(kinds) and len(set(kinds)) == len(kinds):
            if known is CIRCULAR and len(kinds) < 4:
                break
            return kinds
    names = ", ".join(NAMES.get(k, f"casacore's {k}") for k in kinds)
    raise InputError(
        f"{path} has correlations {names}: this takes XX, YY with or without XY, YX, or all four of RR, RL, LR, LL"
    )


def _directions(path: str, field: int) -> tuple[Direction, Direction]:
    """Phase centre, and where beam formers point."""
    with opened(path, "FIELD") as table:
        demand(table, ("PHASE_DIR",), f"{path}::FIELD")
        if field >= table.nrow():
            raise FileError(f"{path}: rows are of field {field}, of {table.nrow()} that are described")
        names = [name for name in ("PHASE_DIR", "DELAY_DIR") if name in table.columns()]
        found = [Direction(*direction_at(table, name, field, path)) for name in names]
    same = np.abs(np.array(found[-1]) - found[0]).max() < SAME_RAD
    return found[0], found[0] if same else found[-1]


def _stations(path: str) -> tuple[Layout, str, tuple[int, ...]]:
    """Stations with the axes of their fields where the set has them, local ones else; the telescope's name.

    Those that no row has may be without a place or axes: they are left out, and their numbers in the file told.
    """
    with opened(path, "ANTENNA") as table:
        demand(table, ("NAME", "POSITION"), f"{path}::ANTENNA")
        names, places = [str(n) for n in column(table, "NAME")], column(table, "POSITION")
        if len(names) and all(n.isdigit() for n in names) and "STATION" in table.columns():  # as CASA imports UVFITS
            names = [str(n) or names[k] for k, n in enumerate(column(table, "STATION"))]
        places = in_unit(table, "POSITION", places, "m", f"{path}::ANTENNA")
        if len(names) and (known := frame_named(table, "POSITION", 0, "ITRF", path)) != "ITRF":
            raise InputError(f"{path}: POSITION of stations is in {harmless(known, 40)}, this takes ITRF: convert it")
    with opened(path, "OBSERVATION") as table:
        told = "TELESCOPE_NAME" in table.columns() and table.nrow()
        telescope = str(cell(table, "TELESCOPE_NAME", 0, path)) if told else ""
    names = distinct(names)
    first = axes = None
    with np.errstate(invalid="ignore"):
        lost = {int(k): "stands at no place on the Earth" for k in np.flatnonzero(~(norm(places, axis=1) > DEEP_M))}
    with opened(path) as table:
        if "LOFAR_ANTENNA_FIELD" in table.getkeywords():
            first, axes = _axes(path, len(names))
            lost |= {int(k): "has no row in LOFAR_ANTENNA_FIELD" for k in np.flatnonzero(first < 0)}
        seen = [kinds_of(table, name) for name in ("ANTENNA1", "ANTENNA2")] if lost else []
    if needed := [k for k in lost if any(k in some for some in seen)]:
        raise FileError(f"{path}: station '{names[needed[0]]}' {lost[needed[0]]}, and rows have it")
    kept = np.array([k for k in range(len(names)) if k not in lost], int)
    names, places, dropped = [names[k] for k in kept], places[kept], tuple(sorted(lost))
    if first is None or axes is None:
        return Layout.geodetic(names, places), telescope, dropped
    return Layout(names=tuple(names), positions_m=places, axes=axes[first[kept]]), telescope, dropped


def _axes(path: str, count: int) -> tuple[Int, Float]:
    """Of each station the number of its field, -1 where it has none; and the axes of fields."""
    with opened(path, "LOFAR_ANTENNA_FIELD") as table:
        demand(table, ("ANTENNA_ID", "COORDINATE_AXES"), f"{path}::LOFAR_ANTENNA_FIELD")
        numbers, axes = column(table, "ANTENNA_ID"), column(table, "COORDINATE_AXES")
    first = [int(np.flatnonzero(numbers == k)[0]) if np.any(numbers == k) else -1 for k in range(count)]
    return np.array(first, int), axes


def distinct(names: list[str]) -> list[str]:
    """Names of stations, with their numbers where there are several of one name or none."""
    twice = {n for n in names if names.count(n) > 1}
    return [f"{n}-{k}" if n in twice or not n else n for k, n in enumerate(names)]


def beam_state_of(words: dict[str, Any], path: str) -> BeamState:
    """What the keywords of a LOFAR column say has been taken out."""
    told = str(words.get("LOFAR_APPLIED_BEAM_MODE", "None")).strip()
    if told.lower() in ("none", ""):
        return BeamState()
    mode = {part.lower(): part for part in PARTS}.get(told.lower())
    if mode is None:
        raise InputError(f"{path}: LOFAR_APPLIED_BEAM_MODE is '{harmless(told, 40)}', none of {', '.join(PARTS)}, None")
    towards = f"{path}: LOFAR_APPLIED_BEAM_DIR"
    from astropy import units as u

    known = words.get("LOFAR_APPLIED_BEAM_DIR", {})
    try:
        found = [
            u.Quantity(float(known[m]["value"]), known[m].get("unit", "rad")).to_value("rad") for m in ("m0", "m1")
        ]
        frame = str(known.get("refer", "J2000")).upper()
    except (KeyError, TypeError, ValueError, AttributeError) as error:
        if known:
            raise FileError(f"{towards} is no direction: {harmless(error, 80)}") from None
        raise FileError(f"{path}: a beam ({mode}) has been taken out, and the set does not say towards where") from None
    if frame not in EQUATORIAL:
        raise InputError(f"{towards} is in {harmless(frame, 40)}, this takes J2000 or ICRS: convert it")
    if mode != "Full":
        warn(f"{path}: of the beam only the part '{mode}' has been taken out")
    return BeamState("centre", Direction(*angles(found, towards)), None, mode != "Full", mode)


def beam_words(state: BeamState) -> dict[str, Any]:
    """The keywords of LOFAR for what has been taken out."""
    if state.removed != "centre" or state.towards is None:
        return {"LOFAR_APPLIED_BEAM_MODE": "None"}
    ra, dec = ({"value": float(x), "unit": "rad"} for x in state.towards)
    return {
        "LOFAR_APPLIED_BEAM_MODE": state.part,
        "LOFAR_APPLIED_BEAM_DIR": {"type": "direction", "refer": "J2000", "m0": ra, "m1": dec},
    }
