"""Chain: Jones terms in order, receiver to sky, their bases checked, their product and its cheap factors."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property, reduce
from typing import Any, Self

import numpy as np
from pydantic import model_validator

from instrument import mat2
from instrument.checked import checked
from instrument.component import Component
from instrument.errors import BasisError
from instrument.jones.base import JonesTerm, Simplified, Structure
from instrument.numbers import Index
from instrument.observe.sampling import Sampling
from instrument.units import Complex, Float, Int, NotNegative

RANK: dict[str, int] = {"scalar": 0, "diagonal": 1, "full": 2}


@dataclass(frozen=True)
class Factors:
    """J_a = outer_a * scalar_a * shared_group(a), each `None` where it is 1.

    outer (T, F, A, 1, 2, 2), the same for every direction; scalar (T, F, A, S); shared (T, F, G, S, 2, 2) with the
    group (A,) of every station. The limit of cost is set by G, not by the number of stations.
    """

    outer: Complex | None
    scalar: Complex | None
    shared: Complex | None
    group: Int


@checked
class Chain(Component):
    """Product of Jones terms, (T, F, A, S, 2, 2), written from receiver to sky: `Chain(GainTerm(), StationBeam())`."""

    terms: tuple[JonesTerm, ...] = ()

    def __init__(self, *terms: JonesTerm, **fields: Any) -> None:
        super().__init__(**({"terms": terms} if terms else {}), **fields)

    def _shown(self) -> Iterator[tuple[str, Any, str]]:
        yield from (("", term, "") for term in self.terms)

    @model_validator(mode="after")
    def _bases_meet(self) -> Self:
        for left, right in zip(self.terms[:-1], self.terms[1:], strict=True):
            if left.maps[0] != right.maps[1]:
                raise BasisError(
                    f"{type(left).__name__} takes '{left.maps[0]}' but {type(right).__name__} gives '{right.maps[1]}'; "
                    "write terms from receiver to sky"
                )
        return self

    @cached_property
    def multiplied(self) -> tuple[JonesTerm, ...]:
        """The terms as they are multiplied, all with the sign of the fringe: elements conjugated."""
        return tuple(term.in_chain() for term in self.terms)

    @cached_property
    def parts(self) -> tuple[JonesTerm, ...]:
        """The same with composites taken apart."""
        return tuple(p for term in self.multiplied for p in term.parts())

    @property
    def structure(self) -> Structure:
        """The least special structure among the terms; "scalar" for an empty chain."""
        return max((t.structure for t in self.parts), key=RANK.__getitem__, default="scalar")

    @property
    def blind_below_horizon(self) -> bool:
        """Whether the product is exactly zero for directions below the antenna plane."""
        return any(t.blind_below_horizon for t in self.parts)

    def jones(self, at: Sampling) -> Complex:
        """The plain product of the terms, (T, F, A, S, 2, 2), length 1 where constant: the definition."""
        if not self.terms:
            return np.array(mat2.IDENTITY).reshape(1, 1, 1, 1, 2, 2)
        return reduce(mat2.mul, (term.jones(at) for term in self.multiplied))

    def shares(self, layout: Any) -> int:
        """Number G of different shared matrices for the stations of `layout`."""
        kinds = {t.per_station for t in self._shared_terms()}
        return len(layout) if "own" in kinds else len(layout.frames[0]) if "frame" in kinds else 1

    def peak(self, at: Sampling) -> float:
        """A bound on the largest singular value of the product anywhere; infinity where a term knows none."""
        return float(np.prod([t.peak(at) for t in self.parts]))

    def simplified(
        self, at: Sampling, tolerance: NotNegative = 0.0
    ) -> tuple[Chain, list[tuple[JonesTerm, Simplified]]]:
        """What a scene needs of the chain, and what became of each term."""
        fates = [(term, term.simplify(at, tolerance)) for term in self.terms]
        return Chain(*(fate.term for _, fate in fates if fate.term is not None)), fates

    def gains(self) -> Chain:
        """The terms that are the same for every direction, as far as the left end of the chain holds no other.

        `gains()` and then `beams()` are the chain.
        """
        return Chain(*self.terms[: self._first_beam()])

    def beams(self) -> Chain:
        """The terms that differ between directions: the chain without its direction-independent left end."""
        return Chain(*self.terms[self._first_beam() :])

    def known(self) -> Chain:
        """The chain as those who correct for it know it: beams without the errors that were drawn for them."""
        return Chain(*(k for t in self.terms for k in t.known()))

    def _first_beam(self) -> int:
        return next((i for i, t in enumerate(self.terms) if any(p.directional for p in t.parts())), len(self.terms))

    def with_term(self, term: JonesTerm, begin: Index = 0) -> Chain:
        """The chain with one term more, at the leftmost place from `begin` on where its bases fit.

        Raises `BasisError` where there is none.
        """
        takes, gives = term.maps
        for k in range(begin, len(self.terms) + 1):
            before, after = self.terms[k - 1 : k] if k else (), self.terms[k : k + 1]
            if all(t.maps[0] == gives for t in before) and all(t.maps[1] == takes for t in after):
                return Chain(*self.terms[:k], term, *self.terms[k:])
        places = [t.maps[1] for t in self.terms[:1]] + [t.maps[0] for t in self.terms]
        raise BasisError(
            f"{type(term).__name__} takes '{takes}' and gives '{gives}', which fits nowhere in the chain "
            f"{', '.join(type(t).__name__ for t in self.terms)}, whose bases are {', '.join(map(repr, places))}: "
            "give one that takes and gives one of these"
        )

    def _outer_count(self) -> int:
        return next((i for i, t in enumerate(self.parts) if t.directional), len(self.parts))

    def _shared_terms(self) -> list[JonesTerm]:
        return [t for t in self.parts[self._outer_count() :] if t.structure != "scalar"]

    def moving(self, at: Sampling, order: int) -> list[tuple[JonesTerm, tuple[Float, Float]]]:
        """The scalar terms that know how fast they change, each with its `motion`."""
        return [(t, found) for t in self.scalar_terms() if (found := t.motion(at, order)) is not None]

    def scalar_terms(self) -> list[JonesTerm]:
        """Those that are a number for each direction, which `factors` multiplies into one."""
        return [t for t in self.parts[self._outer_count() :] if t.structure == "scalar"]

    def factors(self, at: Sampling, without: Sequence[JonesTerm] = ()) -> Factors:
        """The product as cheap factors, without some terms; equal to `jones` (tests/accuracy/test_agreement.py)."""
        split = self._outer_count()
        outer = [t.jones(at) for t in self.parts[:split]]
        scalars = [t.scalar(at) for t in self.scalar_terms() if not any(t is other for other in without)]
        matrices = self._shared_terms()
        group = np.zeros(len(at.layout), int)
        where = at
        kinds = {t.per_station for t in matrices}
        if "own" in kinds:
            group = np.arange(len(at.layout))
        elif "frame" in kinds:
            group = at.layout.frames[1]
            where = at.one_per_frame()
        shared = reduce(mat2.mul, (t.jones(where) for t in matrices)) if matrices else None
        if shared is not None and shared.shape[2] == 1:
            group = np.zeros_like(group)  # terms of each station whose values are the same for all
        return Factors(
            outer=reduce(mat2.mul, outer) if outer else None,
            scalar=reduce(np.multiply, scalars) if scalars else None,
            shared=shared,
            group=group,
        )
