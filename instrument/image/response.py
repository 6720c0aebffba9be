"""Response: what beams of an operator leave of the sky at each pixel, and its inverse."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Self

import numpy as np

from instrument.jones.mean_mueller import mean_mueller
from instrument.observe.grid import ImageGrid
from instrument.predict.operator import ImageOperator
from instrument.units import Bool, Float, Int

NODES = 17  # a side, at which beams are worked out, and cubic splines between them
TIMES = 9  # integrations of a run, evenly spread
LEAST = 0.05  # of the largest mean power, below which a pixel is not looked at


@dataclass(frozen=True)
class Response:
    """Mean Mueller matrices of an operator over its baselines and times, at nodes (F, 4, 4, M, M); none without beams.

    Real parts: an image sees both orders of a baseline. `usable` (F, Ny, Nx) is where the power is above 5 % of its
    largest.
    """

    grid: ImageGrid
    usable: Bool
    nodes: Float | None = None

    @classmethod
    def of(cls, operator: ImageOperator | None, grid: ImageGrid, channels: int) -> Self:
        """That of an operator, or of none."""
        whole = np.ones((channels, *grid.pixels), bool)
        if operator is None:
            return cls(grid, whole)
        problem = operator.problem
        y, x = (np.linspace(0, n - 1, NODES) for n in grid.pixels)
        ra, dec = operator.sky.grid.at(*(a.ravel() for a in np.meshgrid(y, x, indexing="ij")))
        some = np.unique(np.linspace(0, len(problem.at.slots_s) - 1, TIMES).round().astype(int))
        found = mean_mueller(problem.chain, problem.at.some(some).towards(ra, dec), differential=False).real
        nodes: Float = np.moveaxis(found.reshape(len(found), NODES, NODES, 4, 4), (3, 4), (1, 2)).astype(float)
        if np.abs(nodes - np.eye(4)[:, :, None, None]).max() < 1e-12:
            return cls(grid, whole)
        made = cls(grid, whole, nodes)
        power = np.stack([made.at(f)[..., 0, 0] for f in range(len(nodes))])
        return cls(grid, power > LEAST * power.max(axis=(1, 2), keepdims=True), nodes)

    def at(self, channel: int) -> Float:
        """Mueller matrices of all pixels (Ny, Nx, 4, 4) in a channel."""
        from scipy.interpolate import RectBivariateSpline

        assert self.nodes is not None
        out = np.empty((*self.grid.pixels, 4, 4))
        y, x = (np.arange(n, dtype=float) for n in self.grid.pixels)
        places = [np.linspace(0, n - 1, NODES) for n in self.grid.pixels]
        for i in range(4):
            for j in range(4):
                out[..., i, j] = RectBivariateSpline(*places, self.nodes[channel, i, j])(y, x)
        return out

    def undone(self, planes: Float, channels: Int) -> Float:
        """M^-1 I: Stokes images (F, 4, Ny, Nx) of some channels before the beams; 0 where they are not usable."""
        if self.nodes is None:
            return planes
        out = np.zeros_like(planes)
        for image, seen, f in zip(out, planes, channels.tolist(), strict=True):
            use = self.usable[f]
            image[:, use] = np.linalg.solve(self.at(f)[use], seen[:, use].T[..., None])[..., 0].T
        return out
