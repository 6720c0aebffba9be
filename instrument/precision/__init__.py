"""Error against run time: contests of plugins that do the same job, held against a truth that is none of them."""

from instrument.precision.contest import Contest, Entry, Form, Row, Trial
from instrument.precision.contests import contests_of

__all__ = ["Contest", "Entry", "Form", "Row", "Trial", "contests_of"]
