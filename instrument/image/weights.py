"""Imaging weights: natural, uniform and Briggs, from the density of visibilities on the uv plane."""

from __future__ import annotations

from typing import Literal

import numpy as np

from instrument.units import Float

Weighting = Literal["natural", "uniform", "briggs"]


class Density:
    """Sum of weights in cells of the uv plane, (N, N), both halves of it; cells as wide as the image allows."""

    def __init__(self, pixels: int, pixel_rad: float) -> None:
        self.cell = 1.0 / (pixels * pixel_rad)
        self.pixels = pixels
        self.sums = np.zeros(pixels * pixels)
        self.total = 0.0

    def _cells(self, uv: Float) -> tuple[np.ndarray, np.ndarray]:
        half = self.pixels // 2
        index = np.rint(uv / self.cell).astype(int) + half
        inside = np.all((index >= 0) & (index < self.pixels), axis=-1)
        return index[..., 1] * self.pixels + index[..., 0], inside

    def add(self, uv: Float, weight: Float) -> None:
        """Count visibilities at uv (N, 2) in wavelengths with weights (N,), and their conjugates."""
        for sign in (1, -1):
            cells, inside = self._cells(sign * uv)
            self.sums += np.bincount(cells[inside], weight[inside], len(self.sums))
        self.total += float(weight.sum())

    def factor(self, uv: Float, weighting: Weighting, robust: float) -> Float:
        """What to multiply natural weights by, (N,).

        Uniform: 1/density. Briggs (1995): 1/(1 + f2 density), f2 = (5 10^-R)^2 / mean density.
        """
        cells, inside = self._cells(uv)
        density = np.where(inside, self.sums[np.where(inside, cells, 0)], 0.0)
        if weighting == "uniform":
            return np.where(density > 0, 1.0 / np.where(density > 0, density, 1.0), 0.0)
        f2 = (5.0 * 10.0**-robust) ** 2 / ((self.sums**2).sum() / (2 * self.total))
        return np.where(inside, 1.0 / (1.0 + f2 * density), 0.0)
