"""Intervals: which integrations share one solution, by their times and never by their count."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from instrument.errors import InputError
from instrument.units import Float, Int


@dataclass(frozen=True)
class Intervals:
    """Integrations (T,) in N intervals of one length: `group` (T,) from 0, and the centres of the intervals (N,), s.

    Only intervals that hold data are counted. A centre is that of the whole interval even where part of it is a gap,
    so that every integration is nearer to the centre of its own interval than to any other.
    """

    group: Int
    centres_s: Float
    length_s: float
    step: int  # integrations in a whole interval

    def __len__(self) -> int:
        return len(self.centres_s)

    @property
    def slices(self) -> list[slice]:
        """The integrations of every interval."""
        edges = np.searchsorted(self.group, np.arange(len(self) + 1))
        return [slice(int(a), int(b)) for a, b in pairwise(edges)]


def intervals(
    slots_s: Float, interval_s: float | None, integration_s: float, start_s: float | None = None
) -> Intervals:
    """Times `slots_s` (T,), s, ascending, in intervals of `interval_s`; of one integration each where that is `None`.

    The first interval begins with the integration centred on `start_s` (the first slot unless given: give the first of
    the whole run where it is cut into blocks). The length is a whole number of integrations, the nearest to what was
    asked, at least one; compare `length_s` with `interval_s` to tell. Raises `InputError` for slots out of order.
    """
    slots_s = np.asarray(slots_s, float)
    if slots_s.ndim != 1 or slots_s.size == 0 or not np.all(np.isfinite(slots_s)) or np.any(np.diff(slots_s) <= 0):
        raise InputError("a solve needs times in ascending order, at least one")
    if not (np.isfinite(integration_s) and integration_s > 0):
        raise InputError(f"the integrations of the data last {integration_s} s: they must be positive")
    if interval_s is None:
        return Intervals(np.arange(len(slots_s)), slots_s.copy(), float(integration_s), 1)
    if not (np.isfinite(interval_s) and interval_s > 0):
        raise InputError(f"interval = {interval_s} s must be positive")
    begin = (slots_s[0] if start_s is None else start_s) - integration_s / 2
    # an interval longer than the data ends with them: its centre is then theirs
    most = max(1, int(np.floor((slots_s[-1] - begin) / integration_s)) + 1)
    step = int(min(max(np.floor(interval_s / integration_s + 0.5 - 1e-9), 1), most))
    length = step * integration_s
    # integrations of a regular grid lie half an integration from any edge: rounding cannot move one across
    number, group = np.unique(np.floor((slots_s - begin) / length).astype(int), return_inverse=True)
    centres = begin + (number + 0.5) * length
    # a centre that is a slot has its bits, which are the key of drawn gains
    near = slots_s[np.clip(np.searchsorted(slots_s, centres - 1e-3 * integration_s), 0, len(slots_s) - 1)]
    centres = np.where(np.abs(near - centres) < 1e-3 * integration_s, near, centres)
    return Intervals(group.reshape(-1), centres, float(length), step)
