"""What a Measurement Set says beside its rows: stations, channels, correlations, phase centre, beam taken out."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from instrument.beam_state import BeamState
from instrument.errors import FileError, InputError, warn
from instrument.files.ms_tables import column, demand, opened
from instrument.observe.layout import Layout
from instrument.shown import short_repr
from instrument.units import Complex, Direction, Float, Int

LINEAR, CIRCULAR = (9, 10, 11, 12), (5, 6, 7, 8)  # XX XY YX YY, RR RL LR LL (casacore's Stokes)
NAMES = {1: "I", 2: "Q", 3: "U", 4: "V", **dict(zip(CIRCULAR, ("RR", "RL", "LR", "LL"), strict=True)),
         **dict(zip(LINEAR, ("XX", "XY", "YX", "YY"), strict=True))}  # fmt: skip
EQUATORIAL = ("J2000", "ICRS")  # of directions: 0.02 arcsec apart
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
    backwards: bool  # channels stand in the file from high to low
    kinds: tuple[int, ...]  # correlations, as casacore numbers them
    centre: Direction
    pointing: Direction
    field: int
    described: int  # row of DATA_DESCRIPTION

    def of(self, channels: slice) -> Frame:
        """The same for some channels."""
        return replace(self, freq_hz=self.freq_hz[channels], width_hz=self.width_hz[channels])

    def inside(self, channels: slice, count: int) -> slice:
        """Where channels, of `count` in all, stand in the file."""
        first, last, _ = channels.indices(count)
        return slice(count - last, count - first) if self.backwards else slice(first, last)

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
    freq, width, backwards = _channels(path, chosen)
    centre, pointing = _directions(path, which)
    layout, telescope = _stations(path)
    return Frame(
        layout, telescope, freq, width, backwards, _correlations(path, int(kinds[rows[0]])), centre, pointing,
        which, rows[0],
    )  # fmt: skip


def one_of(path: str, asked: int | None, have: list[int], name: str, what: str) -> int:
    """The window or field asked for, or the only one; raises `InputError` where one is to be chosen."""
    if asked is None and len(have) == 1:
        return have[0]
    if asked in have:
        return int(asked)
    known = ", ".join(map(str, have)) or "none"
    if asked is None:
        raise InputError(f"{path} holds {len(have)} {what} ({known}): choose one, {name}={have[0] if have else 0}")
    raise InputError(f"{path} has no {name} {asked}: its rows are of {known}")


def _channels(path: str, window: int) -> tuple[Float, Float, bool]:
    with opened(path, "SPECTRAL_WINDOW") as table:
        demand(table, ("CHAN_FREQ", "CHAN_WIDTH"), f"{path}::SPECTRAL_WINDOW")
        row = slice(window, window + 1)
        freq, width = column(table, "CHAN_FREQ", row)[0], np.abs(column(table, "CHAN_WIDTH", row)[0])
        kind = int(column(table, "MEAS_FREQ_REF", row)[0]) if "MEAS_FREQ_REF" in table.columns() else 5
    if kind not in TOPOCENTRIC:
        warn(f"{path}: channels are not topocentric (frame {kind} of casacore): taken as they stand, 1e-4 off at most")
    if np.any(np.diff(freq) == 0) or not np.all(np.isfinite(freq) & (freq > 0) & (width > 0)):
        raise FileError(f"{path}: channels of window {window} are not positive frequencies, each once")
    backwards = len(freq) > 1 and bool(freq[-1] < freq[0])
    return (freq[::-1], width[::-1], True) if backwards else (freq, width, False)


def _correlations(path: str, row: int) -> tuple[int, ...]:
    with opened(path, "POLARIZATION") as table:
        return correlated(path, tuple(int(k) for k in column(table, "CORR_TYPE", slice(row, row + 1))[0]))


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
        found = []
        for name in ("PHASE_DIR", "DELAY_DIR"):
            if name not in table.columns():
                continue
            known = table.getcolkeywords(name).get("MEASINFO", {}).get("Ref", "J2000")
            if known not in EQUATORIAL:
                raise InputError(
                    f"{path}: {name} of the field is in {known}, this takes J2000 or ICRS: convert the set"
                )
            ra, dec = np.ravel(column(table, name, slice(field, field + 1))[0])[:2]
            found.append(Direction(float(ra) % (2 * np.pi), float(dec)))
    return found[0], found[-1]


def _stations(path: str) -> tuple[Layout, str]:
    """Stations with the axes of their fields where the set has them, local ones else; the telescope's name."""
    with opened(path, "ANTENNA") as table:
        demand(table, ("NAME", "POSITION"), f"{path}::ANTENNA")
        names, places = [str(n) for n in column(table, "NAME")], column(table, "POSITION")
    with opened(path, "OBSERVATION") as table:
        known = "TELESCOPE_NAME" in table.columns() and table.nrow()
        telescope = str(column(table, "TELESCOPE_NAME", slice(0, 1))[0]) if known else ""
    names = distinct(names)
    with opened(path) as table:
        fields = "LOFAR_ANTENNA_FIELD" in table.getkeywords()
    if not fields:
        return Layout.geodetic(names, places), telescope
    with opened(path, "LOFAR_ANTENNA_FIELD") as table:
        demand(table, ("ANTENNA_ID", "COORDINATE_AXES"), f"{path}::LOFAR_ANTENNA_FIELD")
        numbers, axes = column(table, "ANTENNA_ID"), column(table, "COORDINATE_AXES")
    first = [int(np.flatnonzero(numbers == k)[0]) if np.any(numbers == k) else -1 for k in range(len(names))]
    if -1 in first:
        raise FileError(f"{path}: station '{names[first.index(-1)]}' has no row in LOFAR_ANTENNA_FIELD")
    return Layout(names=tuple(names), positions_m=places, axes=axes[first]), telescope


def distinct(names: list[str]) -> list[str]:
    """Names of stations, with their numbers where there are several of one name or none."""
    twice = {n for n in names if names.count(n) > 1}
    return [f"{n}-{k}" if n in twice or not n else n for k, n in enumerate(names)]


def beam_state_of(words: dict[str, Any], path: str) -> BeamState:
    """What the keywords of a LOFAR column say has been taken out."""
    mode = str(words.get("LOFAR_APPLIED_BEAM_MODE", "None"))
    if mode == "None":
        return BeamState()
    known = words.get("LOFAR_APPLIED_BEAM_DIR", {})
    try:
        ra, dec = (float(known[key]["value"]) for key in ("m0", "m1"))
    except (KeyError, TypeError, ValueError):
        raise FileError(f"{path}: a beam ({mode}) has been taken out, and the set does not say towards where") from None
    if mode != "Full":
        warn(f"{path}: of the beam only the part '{mode}' has been taken out")
    return BeamState("centre", Direction(ra % (2 * np.pi), dec), None, mode != "Full")


def beam_words(state: BeamState) -> dict[str, Any]:
    """The keywords of LOFAR for what has been taken out."""
    if state.removed != "centre" or state.towards is None:
        return {"LOFAR_APPLIED_BEAM_MODE": "None"}
    ra, dec = ({"value": float(x), "unit": "rad"} for x in state.towards)
    return {
        "LOFAR_APPLIED_BEAM_MODE": "Full",
        "LOFAR_APPLIED_BEAM_DIR": {"type": "direction", "refer": "J2000", "m0": ra, "m1": dec},
    }
