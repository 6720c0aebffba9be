"""Imaging weights: natural, uniform and Briggs, from the density of visibilities on the uv plane."""

from __future__ import annotations

from typing import Literal

import numpy as np

from instrument.units import Float

Weighting = Literal["natural", "uniform", "briggs"]


class Density:
    """Sum of weights in cells of the uv plane, (K, N, N), both halves of it; cells as wide as the image allows.

    K is 1, or 4 for weights of I, Q, U, V from the first block on that has them.
    """

    def __init__(self, pixels: int, pixel_rad: float) -> None:
        self.cell = 1.0 / (pixels * pixel_rad)
        self.pixels = pixels
        self.sums = np.zeros((1, pixels * pixels))
        self.total = np.zeros(1)

    def _cells(self, uv: Float) -> tuple[np.ndarray, np.ndarray]:
        half = self.pixels // 2
        index = np.rint(uv / self.cell).astype(int) + half
        inside = np.all((index >= 0) & (index < self.pixels), axis=-1)
        return index[..., 1] * self.pixels + index[..., 0], inside

    def add(self, uv: Float, weight: Float) -> None:
        """Count visibilities at uv (N, 2) in wavelengths with weights (N, K), and their conjugates."""
        many = max(len(self.sums), weight.shape[1])
        if many > len(self.sums):
            self.sums, self.total = np.repeat(self.sums, many, axis=0), np.repeat(self.total, many)
        for sign in (1, -1):
            cells, inside = self._cells(sign * uv)
            for total, each in zip(self.sums, np.broadcast_to(weight, (len(weight), many)).T, strict=True):
                total += np.bincount(cells[inside], each[inside], len(total))
        self.total += weight.sum(axis=0)

    def factor(self, uv: Float, weighting: Weighting, robust: float) -> Float:
        """What to multiply natural weights by, (N, K).

        Uniform: 1/density. Briggs (1995): 1/(1 + f2 density), f2 = (5 10^-R)^2 / mean density.
        """
        cells, inside = self._cells(uv)
        inside = inside[:, None]
        density = np.where(inside, self.sums.T[np.where(inside[:, 0], cells, 0)], 0.0)
        if weighting == "uniform":
            return np.where(density > 0, 1.0 / np.where(density > 0, density, 1.0), 0.0)
        with np.errstate(divide="ignore", invalid="ignore"):  # a Stokes parameter that no visibility knows
            f2 = (5.0 * 10.0**-robust) ** 2 / ((self.sums**2).sum(axis=1) / (2 * self.total))
            f2 = np.where(self.total > 0, f2, 1.0)
        return np.where(inside, 1.0 / (1.0 + f2 * density), 0.0)
