"""Sets of visibilities made of what is at hand: a list of blocks, an iterator that can be gone through once."""

from __future__ import annotations

from collections.abc import Iterable, Iterator

from instrument.errors import InputError
from instrument.visibilities import Visibilities, VisibilitySet


def as_set(given: VisibilitySet | Iterable[Visibilities], twice: str = "") -> VisibilitySet:
    """What was given as a `VisibilitySet`: a set as it is, blocks in anything that can be gone through.

    An iterator (`plan.blocks()`) can be gone through once. It is refused at once where `twice` names work that needs
    several passes, and at the second pass else.
    """
    if isinstance(given, VisibilitySet):
        return given
    blocks = _Blocks(given)
    if twice and blocks.once:
        raise InputError(f"{twice} go over the visibilities twice: {REMEDY}")
    return blocks


REMEDY = "these blocks can be gone through once: give the plan itself, a list of blocks, or a file of them"


class _Blocks(VisibilitySet):
    """Blocks of anything iterable."""

    def __init__(self, given: Iterable[Visibilities]) -> None:
        self.given = given
        self.once = iter(given) is given
        self.gone = False

    def blocks(self) -> Iterator[Visibilities]:
        """The blocks; raises `InputError` for a second pass over an iterator, and for what is no block."""
        if self.gone:
            raise InputError(f"a second pass over visibilities: {REMEDY}")
        self.gone = self.once
        for block in self.given:
            if not isinstance(block, Visibilities):
                raise InputError(f"a {type(block).__name__} stands among the blocks: give Visibilities")
            yield block
