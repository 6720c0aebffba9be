"""Error against run time: contests of plugins that do the same job, held against a truth that is none of them."""

from instrument.precision.contest import Contest, Entry, Row, Trial
from instrument.precision.contests import contests_of

__all__ = ["Contest", "Entry", "Row", "Trial", "contests_of"]
