"""StationBeam: an element beam phased over dipoles, tiles and stations; ArrayFactor, its scalar part."""

from __future__ import annotations

from functools import cached_property
from typing import Annotated, Any, ClassVar, Literal, Self

import numpy as np
from pydantic import model_validator

from instrument import mat2
from instrument.checked import checked
from instrument.component import Component
from instrument.errors import InputError
from instrument.jones.base import Basis, ElementBeam, JonesTerm, PerStation, ScalarTerm
from instrument.jones.motion import product, touchard
from instrument.observe.directions import LIGHT
from instrument.observe.sampling import Sampling
from instrument.phasor import array_factor
from instrument.units import ArrayOf, Complex, Float, Int, PositiveHertz, SkyDirection

Phase = Literal["fringe", "everybeam"]
Offsets = Annotated[Any, ArrayOf(float, (None, None, 3))]


@checked
class Level(Component):
    """One level of a phased station: M parts at ITRF offsets in m (A or 1, M, 3), steered to `pointing`.

    `pointing` defaults to the phase centre. A HBA station has two levels: tiles about the station's centre, dipoles
    about a tile's centre.
    """

    offsets_m: Offsets
    pointing: SkyDirection | None = None

    @model_validator(mode="after")
    def _has_parts(self) -> Self:
        if self.offsets_m.shape[1] == 0 or not np.all(np.isfinite(self.offsets_m)):
            raise InputError("a level of a phased station needs at least one part, at finite offsets")
        return self

    @cached_property
    def distinct(self) -> tuple[Float, Int]:
        """The different layouts (U, M, 3) among the stations, and which one each station has (A or 1,)."""
        flat = self.offsets_m.reshape(len(self.offsets_m), -1)
        _, first, which = np.unique(flat, axis=0, return_index=True, return_inverse=True)
        return self.offsets_m[first], which.reshape(-1)


@checked
class ArrayFactor(ScalarTerm):
    """Product over levels of mean exp(-2 pi i (f d - f0 d0) . r / c), complex (T, F, A, S); 1 at the pointing.

    d is the apparent direction, d0 the pointing of the level, f0 the channel frequency, or `reference_frequency` where
    a beam former works with one set of phases for a whole band. The same factor for both receptors. Not clipped at the
    horizon. `phase` "fringe" has the sign of the fringe, so that a station is the mean of its parts; "everybeam" is the
    conjugate, as EveryBeam has it. Source: docs/conventions.md; checked against EveryBeam in tests/peers.
    """

    maps: ClassVar[tuple[Basis, Basis]] = ("feed", "feed")
    levels: tuple[Level, ...]
    reference_frequency: PositiveHertz | None = None
    phase: Phase = "fringe"

    def scalar(self, at: Sampling) -> Complex:
        """The array factor (T, F, A, S)."""
        out: Any = np.ones((1, 1, 1, 1))
        times, channels, _, sources = at.shape
        for level in self.levels:
            offsets, which = level.distinct
            if len(which) not in (1, len(at.layout)):
                raise InputError(f"a level holds {len(which)} stations, the array has {len(at.layout)}")
            waves = np.swapaxes(self._waves(level, at), 2, 3).reshape(-1, 3, sources)
            out = out * array_factor(waves, offsets).reshape(times, channels, -1, sources)[:, :, which]
        return np.asarray(out)

    def _waves(self, level: Level, at: Sampling) -> Float:
        """Cycles of phase per m of offset, (T, F, S, 3)."""
        light = -LIGHT if self.phase == "fringe" else LIGHT
        steer = at.pointing_itrf if level.pointing is None else at.earth.itrf(level.pointing.vector[None])[:, 0]
        f0 = np.full(at.shape[1], self.reference_frequency) if self.reference_frequency else at.freq_hz
        return (at.freq_hz[:, None, None] * at.itrf[:, None] - (f0[:, None] * steer[:, None])[:, :, None]) / light

    def phasors(self) -> int:
        """One for each part of every different layout, level by level."""
        return sum(level.offsets_m.shape[1] * len(level.distinct[0]) for level in self.levels)

    def peak(self, at: Sampling) -> float:
        """1: a mean of unit vectors."""
        return 1.0

    def motion(self, at: Sampling, order: int) -> tuple[Float, Float] | None:
        """Phases turn with offset and direction across the axis of the Earth; none for directions of other frames."""
        if at.seen is not None or at.seen_centre is not None:
            return None
        powers = np.arange(order + 1)[:, None]
        derivatives, per_rad = np.where(powers == 0, 1.0, np.zeros(at.shape[3])), np.zeros(at.shape[3])
        for level in self.levels:
            waves = 2 * np.pi * self._waves(level, at.some(np.arange(1)))[0]  # at any time of this length
            whole = np.linalg.norm(waves, axis=-1)
            # 1e-3: precession in four years, aberration
            across = (np.linalg.norm(waves[..., :2], axis=-1) * 1.001 + 1e-3 * whole).max(axis=0)
            offsets = level.distinct[0]
            moments = (np.linalg.norm(offsets[..., :2], axis=-1) ** powers[..., None]).mean(axis=2).max(axis=1)
            derivatives = product(derivatives, touchard(order, moments[:, None] * across**powers))
            per_rad += whole.max(axis=0) * np.linalg.norm(offsets, axis=-1).mean(axis=1).max()
        return derivatives, per_rad

    def rounding(self, at: Sampling) -> Float:
        """That of the phases of the outermost parts, and of the mean."""
        out = 0.0
        for level in self.levels:
            turns = np.linalg.norm(level.offsets_m, axis=-1).max() / LIGHT
            turns *= (at.freq_hz + (self.reference_frequency or at.freq_hz)).max()
            # 18: those of two directions, their products with the frequencies, and three products with an offset
            out += mat2.UNIT * (2 * np.pi * 18 * turns + 8 + level.offsets_m.shape[1])
        return np.array([out])

    def sharing(self, at: Sampling) -> str:
        """How many different array factors there are."""
        return f"{self.distinct_count} array factors"

    @property
    def distinct_count(self) -> int:
        """How many different array factors the stations have between them."""
        which = np.stack(np.broadcast_arrays(*(level.distinct[1] for level in self.levels)), axis=1)
        return len(np.unique(which, axis=0))


@checked
class StationBeam(JonesTerm):
    """A phased station, horizon to feed, (T, F, A, S, 2, 2): `ArrayFactor` times the element's pattern.

    `phase` "fringe" gives array factor and element the sign of the fringe: a station is the mean of its elements.
    "everybeam" is the conjugate of both, as EveryBeam and DP3 have them beside the fringe of LOFAR sets.
    """

    maps: ClassVar[tuple[Basis, Basis]] = ("horizon", "feed")
    per_station: ClassVar[PerStation] = "own"
    blind_below_horizon: ClassVar[bool] = True

    element: ElementBeam
    levels: tuple[Level, ...]
    reference_frequency: PositiveHertz | None = None
    phase: Phase = "fringe"

    @cached_property
    def array(self) -> ArrayFactor:
        """The scalar part."""
        from astropy import units as u

        reference = self.reference_frequency and self.reference_frequency * u.Hz
        return ArrayFactor(levels=self.levels, reference_frequency=reference, phase=self.phase)

    @cached_property
    def pattern(self) -> ElementBeam:
        """The element with the sign of the array factor: as it is for "everybeam"."""
        return self.element.in_chain() if self.phase == "fringe" else self.element

    def parts(self) -> tuple[JonesTerm, ...]:
        """(ArrayFactor, element), the element alone where there is no level."""
        return ((self.array,) if self.levels else ()) + self.pattern.parts()

    def peak(self, at: Sampling) -> float:
        """That of the element: an array factor is at most 1."""
        return self.element.peak(at)

    def jones(self, at: Sampling) -> Complex:
        """Array factor times element, (T, F, A, S, 2, 2)."""
        return np.asarray(self.array.scalar(at)[..., None, None] * self.pattern.jones(at))
