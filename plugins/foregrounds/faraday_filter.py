"""Faraday rotation as a foreground: the spectra that leaked polarization of moderate Faraday depth can have."""

from __future__ import annotations

from typing import Annotated

import numpy as np
from pydantic import BeforeValidator

from instrument.errors import Outcome
from instrument.foreground.base import ForegroundRemover, Separation
from instrument.foreground.linear import leading, projection
from instrument.foreground.maps import StokesMaps
from instrument.observe.directions import LIGHT
from instrument.units import NOT_NEGATIVE, Real, to_si

Depth = Annotated[
    float, NOT_NEGATIVE, BeforeValidator(lambda x: to_si(x, "rad/m2", "depth") if hasattr(x, "unit") else x)
]


class FaradayFilter(ForegroundRemover):
    """Projects out exp(+-2i phi lambda^2) for all |phi| below `depth` (rad/m^2): F_I(phi) around 0.

    The modes are the eigenvectors of the covariance of a spectrum that is even over those depths, sin(x)/x of
    x = 2 depth (lambda^2 - lambda'^2), above `keep` of the largest eigenvalue.
    """

    depth: Depth = 3.0
    keep: Annotated[float, Real(above=0, below=1)] = 1e-9

    def separate(self, given: StokesMaps) -> Separation:
        """Foreground V V^T X."""
        maps, freq_hz = given.plane, given.freq_hz
        lambda2 = (LIGHT / freq_hz) ** 2
        kernel = np.sinc(2 * self.depth / np.pi * (lambda2[:, None] - lambda2))
        values, vectors = leading(kernel, len(kernel))
        n = int((values > self.keep * values[0]).sum())
        remark = f"{n} modes of Faraday depths within {self.depth:g} rad/m^2"
        return projection(maps, vectors[:, :n], Outcome.CONVERGED, remark, adapted=False)
