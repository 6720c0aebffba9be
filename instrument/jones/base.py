"""JonesTerm: one effect of the instrument, as 2x2 matrices per time, channel, station and direction."""

from __future__ import annotations

from abc import abstractmethod
from typing import Any, ClassVar, Literal, NamedTuple

import numpy as np

from instrument import mat2
from instrument.checked import checked
from instrument.component import Component
from instrument.observe.sampling import Sampling
from instrument.units import Complex, Float, NotNegative

Basis = Literal["sky", "horizon", "feed"]
Structure = Literal["scalar", "diagonal", "full"]
PerStation = Literal["shared", "frame", "own"]


Knob = tuple[str, str, tuple[float, ...]]  # field, its unit, and values of it: what a contest turns


class Simplified(NamedTuple):
    """What is left of a term for a scene: the term or `None`, why, and a bound on the error of J.

    The bound is relative to the largest matrix of the term.
    """

    term: JonesTerm | None
    reason: str
    bound: float


@checked
class JonesTerm(Component):
    """One effect as Jones matrices, complex (T, F, A, S, 2, 2), axes of length 1 where it is constant.

    A new effect is a subclass with `maps` and `jones`. `maps` names the basis it takes and the one it gives ("sky": x
    north, y east at each source; "horizon": e_theta away from the zenith and e_phi; "feed": the receptors). The other
    class attributes say what may be left out, and are checked by `instrument.conformance`:

    - `structure`: "scalar" (a number times the identity), "diagonal" or "full";
    - `per_station`: "own" (may differ for every station), "frame" (depends on a station only through its axes) or
      "shared" (the same for all);
    - `directional`: False when it is the same for every direction.
    """

    plugin_kind: ClassVar[str | None] = "terms"
    maps: ClassVar[tuple[Basis, Basis]]
    structure: ClassVar[Structure] = "full"
    per_station: ClassVar[PerStation] = "own"
    directional: ClassVar[bool] = True
    blind_below_horizon: ClassVar[bool] = False

    @abstractmethod
    def jones(self, at: Sampling) -> Complex:
        """Jones matrices (T, F, A, S, 2, 2), length 1 where constant."""

    def scalar(self, at: Sampling) -> Complex:
        """The factor (T, F, A, S) of a term whose structure is "scalar"."""
        return self.jones(at)[..., 0, 0]

    @property
    def called(self) -> str:
        """What text calls the term."""
        return type(self).__name__

    def parts(self) -> tuple[JonesTerm, ...]:
        """The terms this one is the product of, receiver to sky; itself unless it is a composite."""
        return (self,)

    def in_chain(self) -> JonesTerm:
        """What a chain multiplies for the term: itself, but for elements, which have a sign of time of their own."""
        return self

    def enter(self, chain: Any, begin: int = 0) -> Any:
        """A chain with this term: at the leftmost place from `begin` on where its bases fit."""
        return chain.with_term(self, begin)

    def known(self) -> tuple[JonesTerm, ...]:
        """What those who correct for the term put in its place: itself, unless it is wrong in a way nobody knows."""
        return (self,)

    def phasors(self) -> int:
        """How many sines and cosines it takes for each time, channel and direction: what an engine plans with."""
        return 0

    def motion(self, at: Sampling, order: int) -> tuple[Float, Float] | None:
        """How fast the term changes as the Earth turns, if it knows: bounds that hold at any time of a sampling.

        On d^n J / d angle^n for n = 0 ... order, (order + 1, S), of a smooth rotation, and on the change of J for each
        radian of any other motion, (S,). For terms whose structure is "scalar".
        """
        return None

    def peak(self, at: Sampling) -> float:
        """A bound on the largest singular value of the term at any time, station and direction; infinity if unknown.

        For a term without direction it is the largest that occurs; a directional one says what it knows.
        """
        if self.directional:
            return float("inf")
        return float(np.nanmax(mat2.singular_values(self.jones(at))[0], initial=0.0))

    def rounding(self, at: Sampling) -> Float:
        """A bound on the rounding of J (largest singular value of the error), (S,), or (1,) for every direction.

        64 roundings of the peak. A term that loses more says so: a phase of n turns is good to 2 pi n roundings. What
        the azimuth loses near a zenith is counted elsewhere (`ElementBeam.jump`).
        """
        peak = self.peak(at)
        return np.array([64 * mat2.UNIT * (peak if np.isfinite(peak) else 1.0)])

    def sharing(self, at: Sampling) -> str:
        """How many different matrices the stations of an array need of this term, in words."""
        if self.per_station == "own":
            return f"{self.called} one per station"
        sizes = [len(at.layout)] if self.per_station == "shared" else np.bincount(at.layout.frames[1])
        return f"{self.called} shared by {'+'.join(str(n) for n in sorted(sizes, reverse=True))} stations"

    def simplify(self, at: Sampling, tolerance: NotNegative) -> Simplified:
        """What a scene needs of this term: itself, something simpler, or nothing; its bound is below `tolerance`."""
        return Simplified(self, "", 0.0)


@checked
class ScalarTerm(JonesTerm):
    """A term that is a number times the identity: a subclass gives `scalar`, complex (T, F, A, S)."""

    structure: ClassVar[Structure] = "scalar"

    @abstractmethod
    def scalar(self, at: Sampling) -> Complex:
        """The factor (T, F, A, S), length 1 where constant."""

    def jones(self, at: Sampling) -> Complex:
        """The factor times the identity, (T, F, A, S, 2, 2)."""
        return np.asarray(self.scalar(at)[..., None, None] * mat2.IDENTITY)


@checked
class ElementBeam(JonesTerm):
    """One antenna's pattern, horizon to feed, (T, F, A, S, 2, 2); zero below the antenna plane.

    A subclass gives `jones`; `at.zenith_angle` and `at.azimuth_cos_sin` are in the axes of each station. Columns are
    the field along e_theta (away from the zenith) and e_phi (azimuth increasing from p, east, to q, north).

    `jones` is as electromagnetic codes and EveryBeam give it, for fields exp(+i omega t). The fringe is of
    exp(-i omega t): a chain and a `StationBeam` take the conjugate (`in_chain`), here and nowhere else. `real` promises
    that there is nothing to conjugate. `zenith_seam` is by how much of its largest entry J at the zenith may depend
    on the azimuth from which it is reached, where a published model leaves that: plans of directions near it say so.
    """

    plugin_kind: ClassVar[str | None] = "elements"
    maps: ClassVar[tuple[Basis, Basis]] = ("horizon", "feed")
    per_station: ClassVar[PerStation] = "frame"
    blind_below_horizon: ClassVar[bool] = True
    real: ClassVar[bool] = False
    knob: ClassVar[Knob | None] = None
    zenith_seam: ClassVar[float] = 0.0

    def in_chain(self) -> ElementBeam:
        """The element with the sign of the fringe: itself if it is real, or its conjugate."""
        return self if self.real else Conjugate(element=self)

    def band_hz(self) -> tuple[float, float]:
        """Frequencies between which the model was made; outside it extrapolates."""
        return 0.0, float("inf")

    def jump(self, at: Sampling) -> float:
        """How fast the field seen by the receptors turns about the zenith, per rad of azimuth at a fixed direction.

        0 for an antenna whose response is one smooth field there, as that of anything that stands still is; an
        alt-azimuth mount turns once, its `peak` per rad. The cautious default is that of four turns.
        """
        peak = self.peak(at)
        return 4 * (peak if np.isfinite(peak) else 1.0)


@checked
class Conjugate(ElementBeam):
    """An element with the sign of the fringe, (T, F, A, S, 2, 2): the conjugate of what its maker gives."""

    element: ElementBeam

    def model_post_init(self, context: Any, /) -> None:
        """Its promises are those of the element."""
        for promise in ("maps", "structure", "per_station", "directional", "blind_below_horizon", "zenith_seam"):
            object.__setattr__(self, promise, getattr(self.element, promise))

    @property
    def called(self) -> str:
        """The element's name: there is no other effect in it."""
        return self.element.called

    def in_chain(self) -> ElementBeam:
        """Itself: it is not turned twice."""
        return self

    def band_hz(self) -> tuple[float, float]:
        """That of the element."""
        return self.element.band_hz()

    def phasors(self) -> int:
        """Those of the element."""
        return self.element.phasors()

    def peak(self, at: Sampling) -> float:
        """That of the element."""
        return self.element.peak(at)

    def rounding(self, at: Sampling) -> Float:
        """That of the element."""
        return self.element.rounding(at)

    def jump(self, at: Sampling) -> float:
        """That of the element."""
        return self.element.jump(at)

    def sharing(self, at: Sampling) -> str:
        """That of the element."""
        return self.element.sharing(at)

    def jones(self, at: Sampling) -> Complex:
        """The conjugate of the element's matrices, (T, F, A, S, 2, 2)."""
        return self.element.jones(at).conj()
