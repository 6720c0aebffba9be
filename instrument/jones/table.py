"""JonesTable: full Jones matrices of each station on a grid of times and channels, such as a solver gives."""

from __future__ import annotations

from typing import Annotated, Any, ClassVar, Literal, Self

import numpy as np
from pydantic import model_validator

from instrument import mat2
from instrument.checked import checked
from instrument.errors import InputError
from instrument.jones.base import Basis, JonesTerm
from instrument.jones.lookup import between, demand_within, nearest
from instrument.observe.sampling import Sampling
from instrument.units import ArrayOf, Complex, Float

Matrices = Annotated[Any, ArrayOf(complex, (None, None, None, 2, 2))]
Axis = Annotated[Any, ArrayOf(float, (None,))]


@checked
class JonesTable(JonesTerm):
    """Jones matrices of each station, complex (T, F, A, 1, 2, 2), from `values` (t, f, A, 2, 2) on their own grid.

    `slots_s` (MJD seconds, UTC) and `freq_hz` are the centres of the intervals of `values`. Times between them take the
    nearest interval or, with `interpolation` "linear", what lies between two in amplitude and phase (full matrices in
    their Hermitian and unitary parts; for solutions whose gauge drifts, align them first). NaN marks an interval or a
    station without a solution: what is corrected with it is flagged. Times and channels farther than one entry outside
    the table raise `InputError`, and so does a single entry asked more than a day or a factor of 2 in frequency away;
    a single entry at 0 has no place and is constant.
    """

    maps: ClassVar[tuple[Basis, Basis]] = ("feed", "feed")
    directional: ClassVar[bool] = False

    values: Matrices
    slots_s: Axis
    freq_hz: Axis
    stations: tuple[str, ...] = ()
    interpolation: Literal["nearest", "linear"] = "nearest"

    @model_validator(mode="after")
    def _axes_fit(self) -> Self:
        times, channels, stations = self.values.shape[:3]
        if len(self.slots_s) != times or len(self.freq_hz) != channels or times == 0 or channels == 0:
            raise InputError(
                f"values has {times} times and {channels} channels, slots_s {len(self.slots_s)} and freq_hz "
                f"{len(self.freq_hz)}"
            )
        if self.stations and len(self.stations) != stations:
            raise InputError(f"values holds {stations} stations, but {len(self.stations)} are named")
        for name in ("slots_s", "freq_hz"):
            axis = getattr(self, name)
            if not np.all(np.isfinite(axis)) or np.any(np.diff(axis) <= 0):
                raise InputError(f"{name} must be finite and ascending")
        return self

    def inverse(self) -> JonesTable:
        """The table of J^-1, entry by entry; NaN where a matrix has none.

        `vis.corrected(table)` is `vis.corrupted(table.inverse())`, and the one undoes the other. Between entries
        ("linear") the inverse of what lies between two is not what lies between two inverses.
        """
        return self.with_fields(values=mat2.inverse(self.values))

    def jones(self, at: Sampling) -> Complex:
        """The matrices at the times and channels of a sampling, (T, F, A, 1, 2, 2)."""
        if self.values.shape[2] not in (1, len(at.layout)):
            raise InputError(f"JonesTable holds {self.values.shape[2]} stations, the array has {len(at.layout)}")
        if self.stations and tuple(at.layout.names) != self.stations:
            raise InputError("JonesTable is of other stations than the array, or in another order")
        found = self._along(self.values, 0, self.slots_s, at.slots_s, "time")
        return self._along(found, 1, self.freq_hz, at.freq_hz, "frequency")[:, :, :, None]

    def _along(self, values: Complex, axis: int, known: Float, asked: Float, what: str) -> Complex:
        demand_within(known, asked, what, reach=1.0)
        if len(known) == 1:
            return values
        if self.interpolation == "nearest":
            return np.take(values, nearest(known, asked), axis=axis)
        right = np.clip(np.searchsorted(known, asked), 1, len(known) - 1)
        share = np.clip((asked - known[right - 1]) / np.diff(known)[right - 1], 0.0, 1.0)
        share = share[:, None, None] if axis == 0 else share[:, None]
        left, after = np.take(values, right - 1, axis=axis), np.take(values, right, axis=axis)
        ends = share[..., None, None]
        # where one end is meant alone, the other may be NaN
        return np.where(ends == 0, left, np.where(ends == 1, after, between(left, after, share)))
