"""JonesTable: full Jones matrices of each station on a grid of times and channels, such as a solver gives."""

from __future__ import annotations

from typing import Annotated, Any, ClassVar, Literal, Self

import numpy as np
from pydantic import model_validator

from instrument.errors import InputError
from instrument.jones.base import Basis, JonesTerm
from instrument.observe.sampling import Sampling
from instrument.units import ArrayOf, Complex, Float

Matrices = Annotated[Any, ArrayOf(complex, (None, None, None, 2, 2))]
Axis = Annotated[Any, ArrayOf(float, (None,))]


class JonesTable(JonesTerm):
    """Jones matrices of each station, complex (T, F, A, 1, 2, 2), from `values` (t, f, A, 2, 2) on their own grid.

    `slots_s` (MJD seconds, UTC) and `freq_hz` are the centres of the intervals of `values`. Times between them take the
    nearest interval or, with `interpolation` "linear", the straight line between two (element by element: for
    solutions whose gauge drifts, align them first). NaN marks an interval or a station without a solution: what is
    corrected with it is flagged. Times farther than one interval outside the table raise `InputError`.
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

    def jones(self, at: Sampling) -> Complex:
        """The matrices at the times and channels of a sampling, (T, F, A, 1, 2, 2)."""
        if self.values.shape[2] not in (1, len(at.layout)):
            raise InputError(f"JonesTable holds {self.values.shape[2]} stations, the array has {len(at.layout)}")
        if self.stations and tuple(at.layout.names) != self.stations:
            raise InputError("JonesTable is of other stations than the array, or in another order")
        found = self._along(self.values, 0, self.slots_s, at.slots_s, "time", "s")
        return self._along(found, 1, self.freq_hz, at.freq_hz, "frequency", "Hz")[:, :, :, None]

    def _along(self, values: Complex, axis: int, known: Float, asked: Float, what: str, unit: str) -> Complex:
        if len(known) == 1:
            return values
        step = np.diff(known)
        outside = np.maximum(known[0] - asked, asked - known[-1]).max()
        if outside > step.max():
            raise InputError(f"a table is asked at a {what} {outside:.6g} {unit} outside it")
        right = np.clip(np.searchsorted(known, asked), 1, len(known) - 1)
        share = np.clip((asked - known[right - 1]) / step[right - 1], 0.0, 1.0)
        if self.interpolation == "nearest":
            return np.take(values, np.where(share < 0.5, right - 1, right), axis=axis)
        share = share.reshape([-1 if k == axis else 1 for k in range(values.ndim)])
        left, after = np.take(values, right - 1, axis=axis), np.take(values, right, axis=axis)
        # where one end is meant alone, the other may be NaN
        return np.where(share == 0, left, np.where(share == 1, after, (1 - share) * left + share * after))
