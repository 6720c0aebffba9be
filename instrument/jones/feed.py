"""FeedTerm: feed errors (D-terms) of each station, [[1, e_p], [-e_q, 1]]."""

from __future__ import annotations

import numpy as np

from instrument import mat2
from instrument.checked import checked
from instrument.jones.gain import StationTable
from instrument.observe.sampling import Sampling
from instrument.units import Complex


@checked
class FeedTerm(StationTable):
    """Feed errors of each station, [[1, e_p], [-e_q, 1]], complex (T, F, A, 1, 2, 2); `values` holds (e_p, e_q)."""

    def jones(self, at: Sampling) -> Complex:
        """[[1, e_p], [-e_q, 1]], (T, F, A, 1, 2, 2)."""
        e = self.table(at)[:, :, :, None]
        one = np.ones_like(e[..., 0])
        return mat2.pack(one, e[..., 0], -e[..., 1], one)
