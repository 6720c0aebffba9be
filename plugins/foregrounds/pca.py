"""Principal components: the spectra along which the channels vary most."""

from __future__ import annotations

from typing import Annotated, Any

from pydantic import Field

from instrument.errors import Outcome
from instrument.foreground.base import ForegroundRemover, Separation
from instrument.foreground.linear import principal, projection
from instrument.units import Float


class PCA(ForegroundRemover):
    """Projects out the `components` leading eigenvectors of the covariance of channels X X^T / p; no mean is taken off.

    An image of an interferometer has no mean; a mean map would count as one more component.
    """

    components: Annotated[int, Field(ge=0)] = 4

    def separate(self, maps: Any, freq_hz: Float) -> Separation:
        """Foreground V V^T X."""
        n = min(self.components, len(maps))
        values, vectors = principal(maps, n)
        shares = ", ".join(f"{v / values[0]:.1e}" for v in values[:8]) + (", ..." if n > 8 else "")
        remark = f"{n} principal components, eigenvalues {shares} of the largest" if n else "no component"
        return projection(maps, vectors, Outcome.CONVERGED, remark)
