"""BeamState: which beam is in visibilities, what of it has been taken out, and towards where."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Literal, get_args

from instrument.checked import checked
from instrument.errors import BeamStateError, warn
from instrument.jones.chain import Chain
from instrument.jones.towards import Towards
from instrument.units import Direction

Part = Literal["Full", "Element", "ArrayFactor"]  # of a station's beam, as LOFAR's programs name them
PARTS: tuple[Part, ...] = get_args(Part)


@checked
@dataclass(frozen=True)
class BeamState:
    """What has been taken out of visibilities: "nothing" or "centre" (the beam), and towards where.

    `beams` is the part of the chain in the data that differs between directions; `None` where nobody knows it (data
    from elsewhere). `other` says that it was another beam that has been taken out, of which `part` is what others have.
    """

    removed: Literal["nothing", "centre"] = "nothing"
    towards: Direction | None = None
    beams: Chain | None = field(default=None, compare=False)
    other: bool = False
    part: Part = "Full"

    def __str__(self) -> str:
        if self.removed == "centre":
            which = "another beam" if self.other else "differential beam"
            which += f" ({self.part} only)" if self.part != "Full" else ""
            return f"{which}, removed towards {self.towards}"
        return "no beam" if self.beams is not None and not self.beams.terms else "absolute beam"

    def without(self, beam: Towards, centre: Direction) -> BeamState:
        """The state after a beam is taken out; raises `BeamStateError` where it cannot be in the data (any more)."""
        if self.removed != "nothing":
            raise BeamStateError(f"a beam has been taken out already ({self}): start from uncorrected visibilities")
        taken = beam.chain.beams()
        if self.beams is not None and taken.terms and not self.beams.terms:
            raise BeamStateError("there is no beam in these visibilities (beam=None): there is none to take out")
        other = self.beams is not None and taken != self.beams
        if other and self.beams is not None and beam.direction in (None, centre):
            other = taken.known() != self.beams.known()  # towards where it points a beam has no error
        if other:
            warn("the beam that is taken out is not the beam that is in the data: their ratio is left at the centre")
        return BeamState("centre", beam.direction or centre, self.beams, other)

    def with_beam(self, beam: Towards) -> BeamState:
        """The state after the beam at one direction is put on; raises `BeamStateError` where one is there."""
        if self.removed == "centre":
            return BeamState(beams=self.beams)
        if self.beams is not None and self.beams.terms and beam.chain.beams().terms:
            raise BeamStateError("a beam is in the data already: it would be there twice")
        return BeamState(beams=beam.chain.beams())
