"""GainTerm: complex gains of the two receptors of each station, fixed, tabulated, or drawn from a seed."""

from __future__ import annotations

import zlib
from typing import Annotated, Any, ClassVar, Self

import numpy as np
from pydantic import model_validator

from instrument import mat2
from instrument.checked import checked
from instrument.errors import InputError
from instrument.jones.base import Basis, JonesTerm, Simplified, Structure
from instrument.jones.lookup import demand_within, nearest
from instrument.observe.sampling import Sampling
from instrument.units import ArrayOf, Complex, Float, NotNegative, Real, Seed

Table = Annotated[Any, ArrayOf(complex, (None, None, None, 2))]
Axis = Annotated[Any, ArrayOf(float, (None,))]


@checked
class StationTable(JonesTerm):
    """Two complex numbers per station, (T, F, A, 2): `values`, plus errors of rms `rms` drawn anew for every time.

    `values` has axes of length 1 where constant; `slots_s` (MJD seconds, UTC) and `freq_hz` say where its times and
    channels are when there is more than one, and the nearest is taken (half a step outside at most). The drawn part is
    complex Gaussian with E|x|^2 = rms^2, independent between stations, receptors and integrations, equal for all
    channels, and depends only on the seed and the time, never on how a run was cut into blocks.
    """

    maps: ClassVar[tuple[Basis, Basis]] = ("feed", "feed")
    directional: ClassVar[bool] = False
    neutral: ClassVar[complex] = 0.0

    values: Table | None = None
    slots_s: Axis | None = None
    freq_hz: Axis | None = None
    rms: Annotated[float, Real(at_least=0, at_most=1e6)] = 0.0  # squares of squares stay in range
    seed: Seed = 0

    @model_validator(mode="after")
    def _axes_fit(self) -> Self:
        axes = ((0, "slots_s", self.slots_s), (1, "freq_hz", self.freq_hz))
        for _, name, known in axes:
            if known is not None and not (np.all(np.isfinite(known)) and np.all(np.diff(np.sort(known)))):
                raise InputError(f"{name} must be finite, and no entry twice")
            if known is not None and self.values is None:
                raise InputError(f"{name} says where entries of `values` are: give values")
        if self.values is None:
            return self
        if not np.all(np.isfinite(self.values)):
            raise InputError("values must be finite: leave out a station rather than giving it NaN")
        for axis, name, coordinate in axes:
            count = self.values.shape[axis]
            if count > 1 and (coordinate is None or len(coordinate) != count):
                raise InputError(f"values has {count} entries along axis {axis}: {name} must name as many")
        return self

    def table(self, at: Sampling) -> Complex:
        """The two numbers of each station at a sampling, (T, F, A, 2), length 1 where constant."""
        out = np.full((1, 1, 1, 2), self.neutral, complex)
        if self.values is not None:
            if self.values.shape[2] not in (1, len(at.layout)):
                raise InputError(
                    f"{type(self).__name__} holds {self.values.shape[2]} stations, the array has {len(at.layout)}"
                )
            rows = _entries(self.slots_s, at.slots_s, self.values.shape[0], "time")
            cols = _entries(self.freq_hz, at.freq_hz, self.values.shape[1], "frequency")
            out = self.values[rows][:, cols]
        if self.rms:
            salt = zlib.crc32(type(self).__name__.encode())
            drawn = slot_normals((self.seed, salt), at.slots_s, (len(at.layout), 2))
            out = out + self.rms * drawn[:, None]
        return out

    def simplify(self, at: Sampling, tolerance: NotNegative) -> Simplified:
        """Leaves the term out when it is exactly the identity."""
        plain = self.values is None or np.all(self.values == self.neutral)
        return Simplified(None, "identity", 0.0) if plain and not self.rms else Simplified(self, "", 0.0)


@checked
class GainTerm(StationTable):
    """Gains of each station, diag(g_p, g_q), complex (T, F, A, 1, 2, 2)."""

    structure: ClassVar[Structure] = "diagonal"
    neutral: ClassVar[complex] = 1.0

    def jones(self, at: Sampling) -> Complex:
        """diag(g_p, g_q), (T, F, A, 1, 2, 2)."""
        g = self.table(at)[:, :, :, None]
        zero = np.zeros_like(g[..., 0])
        return mat2.pack(g[..., 0], zero, zero, g[..., 1])


def _entries(known: Float | None, asked: Float, count: int, what: str) -> Any:
    """The entry of a table that each time or channel takes; half an entry's width outside it at most."""
    if known is None or len(known) != count:
        return slice(None)
    order = np.argsort(known)
    demand_within(known[order], asked, what, reach=0.5)
    return slice(None) if count == 1 else order[nearest(known[order], asked)]


def slot_normals(key: tuple[int, ...], slots_s: Float, shape: tuple[int, ...]) -> Complex:
    """Complex normal numbers of unit power for each time slot, (T, *shape); a draw depends on key and time only."""
    out = np.empty((len(slots_s), *shape), complex)
    for row, slot in zip(out, slots_s, strict=True):
        rng = np.random.default_rng([*key, exact_key(slot)])
        row[...] = rng.standard_normal((*shape, 2)).view(complex)[..., 0]
    return out * np.sqrt(0.5)


def exact_key(value: float) -> int:
    """A whole number that no other time or frequency has: its bits. Rounded to 1 ms, 88 of 200 slots of 1 ms meet."""
    return int((np.float64(value) + 0.0).view(np.uint64))  # + 0.0: -0.0 is 0.0
