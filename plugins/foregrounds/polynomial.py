"""Smooth spectra: a polynomial in the logarithm of frequency along every line of sight."""

from __future__ import annotations

from typing import Annotated

import numpy as np

from instrument.errors import Outcome
from instrument.foreground.base import ForegroundRemover, Separation
from instrument.foreground.linear import projection
from instrument.foreground.maps import StokesMaps
from instrument.units import Whole


class Polynomial(ForegroundRemover):
    """Least-squares polynomial of `terms` terms in log(nu), fitted to the power itself: pixels may be negative.

    The basis is Legendre's on the band, made orthonormal on its channels by QR; powers of nu in Hz would have a
    condition of 1e28 for four terms.
    """

    terms: Annotated[int, Whole(at_least=0)] = 4

    def separate(self, given: StokesMaps) -> Separation:
        """Foreground Q Q^T X."""
        maps, freq_hz = given.plane, given.freq_hz
        n, x = min(self.terms, len(freq_hz)), np.log(freq_hz)
        span = np.ptp(x)
        x = (2 * x - x.min() - x.max()) / span if span > 0 else np.zeros(len(x))
        basis = np.linalg.qr(np.polynomial.legendre.legvander(x, max(n - 1, 0)))[0][:, :n]
        return projection(maps, basis, Outcome.CONVERGED, f"polynomial of {n} terms in log(nu)", adapted=False)
