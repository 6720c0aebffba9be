"""BeamError: a beam that is not the one that is known, by errors of its polarization drawn from a seed."""

from __future__ import annotations

import zlib
from typing import Annotated, Any, ClassVar, Self

import numpy as np
from pydantic import model_validator

from instrument import mat2
from instrument.checked import checked
from instrument.errors import InputError
from instrument.jones.base import Basis, JonesTerm, Simplified
from instrument.jones.chain import Chain
from instrument.observe.directions import tangents
from instrument.observe.sampling import Sampling
from instrument.units import Complex, Direction, Float, NotNegative, Real, Seed, unit_vectors

FEED: tuple[Basis, Basis] = ("feed", "feed")


@checked
class BeamError(JonesTerm):
    """A `beam` whose polarization is wrong by `rms` of itself, (T, F, A, S, 2, 2); the identity where it has no beam.

    J' = J0 P(J0^-1 J R^T) R, J0 the beam towards its pointing. P multiplies the two entries off the diagonal, and the
    half-difference of those on it, by 1 + rms N(0, 1): three numbers for each station and seed (of the name of the
    station: fewer stations keep theirs), or three for all (`common`), the same at all times and channels. R, (S, 2, 2),
    turns north and east of each direction into axes carried from the pointing along the great circle: off the diagonal
    of J0^-1 J there is otherwise mostly the turn of local north, which is geometry and not wrong. Towards the pointing
    J' is J. Where J0 cannot be undone nothing is changed.

    Among the `terms` of an instrument it takes all that differs between directions, and stands before it in the chain,
    for its beam. What corrects for beams does not know it: see `known`.
    """

    maps: ClassVar[tuple[Basis, Basis]] = FEED
    beam: Chain = Chain()
    rms: Annotated[float, Real(at_least=0, at_most=1e3)] = 0.0
    seed: Seed = 0
    common: bool = False

    @model_validator(mode="after")
    def _is_of_a_beam(self) -> Self:
        if not self.beam.terms:
            return self
        maps = (self.beam.terms[-1].maps[0], self.beam.terms[0].maps[1])
        if maps[1] != "feed" or maps[0] == "horizon":
            raise InputError(
                f"BeamError takes a beam from 'sky' to 'feed', this one is from '{maps[0]}' to '{maps[1]}': "
                "give Chain(StationBeam(...), Parallactic())"
            )
        object.__setattr__(self, "maps", maps)
        object.__setattr__(self, "blind_below_horizon", self.beam.blind_below_horizon)
        return self

    def enter(self, chain: Chain, begin: int = 0) -> Chain:
        """The chain with its beams in this term; without any, or without an error, it stands left of them alone."""
        gains, beams = chain.gains().terms, chain.beams()
        if any(isinstance(t, BeamError) and t.with_fields(beam=self.beam) == self for t in beams.terms):
            return chain
        if not (self.rms and beams.terms):
            return Chain(*gains, self, *beams.terms)
        return Chain(*gains, self.with_fields(beam=beams))

    def known(self) -> tuple[JonesTerm, ...]:
        """The terms of the beam, without its errors."""
        return self.beam.terms

    def parts(self) -> tuple[JonesTerm, ...]:
        """Those of the beam where nothing is wrong with it."""
        return (self.beam.parts or (self,)) if not self.rms else (self,)

    def simplify(self, at: Sampling, tolerance: NotNegative) -> Simplified:
        """Leaves the term out where there is no beam to be wrong."""
        if self.beam.terms:
            of = ", ".join(t.called for t in self.beam.terms)
            drawn = f"with errors of {self.rms:g}, drawn {'once for all' if self.common else 'for each station'}"
            return Simplified(self, f"{of} {drawn if self.rms else 'without errors'}", 0.0)
        return Simplified(None, "rms 0: no error of the beam" if not self.rms else "no beam to be wrong", 0.0)

    def peak(self, at: Sampling) -> float:
        """That of the beam, grown by the largest draw over the least sensitive receptor at the centre."""
        return self.beam.peak(at) * self._grown(at)

    def rounding(self, at: Sampling) -> Float:
        """Of the parts of the beam, grown alike."""
        parts = self.beam.parts
        peaks = [p if np.isfinite(p) else 1.0 for p in (t.peak(at) for t in parts)]
        wrong = 64 * mat2.UNIT * np.prod(peaks, initial=1.0) * np.ones(1)
        for k, term in enumerate(parts):
            wrong = wrong + np.prod(peaks[:k] + peaks[k + 1 :]) * term.rounding(at)
        return np.asarray(wrong * self._grown(at))

    def draws(self, at: Sampling) -> Float:
        """rms N(0, 1) of the half-difference and of the entries pq and qp, (A or 1, 3)."""
        names = ("",) if self.common else at.layout.names
        drawn = [np.random.default_rng([self.seed, zlib.crc32(n.encode())]).standard_normal(3) for n in names]
        return self.rms * np.array(drawn)

    def jones(self, at: Sampling) -> Complex:
        """J0 P(J0^-1 J R^T) R, (T, F, A, S, 2, 2)."""
        beam = self.beam.jones(at)
        if not (self.rms and self.beam.terms):
            return beam
        there, back = self._centre(at)
        turn = carried(at.pointing, at.ra_rad, at.dec_rad)
        seen = mat2.mul(back, mat2.mul(beam, np.swapaxes(turn, -1, -2)))
        half = (seen[..., 0, 0] - seen[..., 1, 1]) / 2
        difference, pq, qp = (f[:, None] for f in self.draws(at).T)
        wrong = mat2.pack(difference * half, pq * seen[..., 0, 1], qp * seen[..., 1, 0], -difference * half)
        return np.asarray(beam + mat2.mul(there, mat2.mul(wrong, turn + 0j)))

    def _centre(self, at: Sampling) -> tuple[Complex, Complex]:
        """The beam towards its pointing and its inverse, (T, F, A, 1, 2, 2); 0 where it has none."""
        d = at.pointing
        there = self.beam.jones(at.towards(np.array([d.ra_rad]), np.array([d.dec_rad])))
        back = mat2.inverse(there)
        return there, np.where(np.isfinite(back).all(axis=(-2, -1), keepdims=True), back, 0.0)

    def _grown(self, at: Sampling) -> float:
        if not (self.rms and self.beam.terms):
            return 1.0
        there, back = (mat2.singular_values(j)[0] for j in self._centre(at))
        # the norm of what P adds is at most sqrt(2) times the largest factor times that of its argument
        return float(1 + 2**0.5 * np.abs(self.draws(at)).max() * np.max(there * back))


def carried(centre: Direction, ra_rad: Float, dec_rad: Float) -> Any:
    """Rotations (S, 2, 2) from north and east of each direction to those of the centre, carried on great circles."""
    east, north = tangents(ra_rad, dec_rad)
    e0, n0 = tangents(np.array([centre.ra_rad]), np.array([centre.dec_rad]))
    c, s = centre.vector, unit_vectors(ra_rad, dec_rad)
    axis = np.cross(c, s)
    share = 1 / np.maximum(1 + s @ c, mat2.UNIT)[:, None]  # the antipode has no great circle of its own
    moved = [v + np.cross(axis, v) + share * np.cross(axis, np.cross(axis, v)) for v in (n0, e0)]
    return np.stack([np.stack([(v * w).sum(-1) for w in (north, east)], axis=-1) for v in moved], axis=-2)
