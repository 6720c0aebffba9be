"""Principal components: the spectra along which the channels vary most."""

from __future__ import annotations

from typing import Annotated

import numpy as np

from instrument.errors import Outcome
from instrument.foreground.base import ForegroundRemover, Separation
from instrument.foreground.linear import principal, projection
from instrument.foreground.maps import StokesMaps
from instrument.units import Whole


class PCA(ForegroundRemover):
    """Projects out the `components` leading eigenvectors of the covariance of channels X X^T / p; no mean is taken off.

    An image of an interferometer has no mean; a mean map would count as one more component.
    """

    components: Annotated[int, Whole(at_least=0)] = 4

    def separate(self, given: StokesMaps) -> Separation:
        """Foreground V V^T X."""
        maps = given.plane
        n = min(self.components, len(maps))
        values, vectors = principal(maps, min(n + 1, len(maps)))
        vectors = vectors[:, :n]
        shares = ", ".join(f"{v / values[0]:.1e}" for v in values[: min(n, 8)]) + (", ..." if n > 8 else "")
        remark = f"{n} principal components, eigenvalues {shares} of the largest" if n else "no component"
        outcome = Outcome.CONVERGED
        eps = float(np.finfo(maps.dtype).eps)
        if 0 < n < len(maps) and values[n] > max((1 - 100 * eps) * values[n - 1], (1000 * eps) ** 2 * values[0]):
            outcome, remark = Outcome.SINGULAR, f"{remark}; the next is as strong: rounding decides which is taken"
        return projection(maps, vectors, outcome, remark)
