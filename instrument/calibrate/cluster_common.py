"""Matrices common to all stations, x_k -> x_k exp(sum_n y_kn G_n): what a polarized beam shows of them is little.

The orbit of such matrices is curved: a straight step J y G leaves it by y^2 / 2, which the data see, though they hardly
see the step itself (1e-5 of it, through a beam). So steps along it are exponentials.
"""

from __future__ import annotations

import numpy as np

from instrument import mat2
from instrument.calibrate.cluster_equations import Equations
from instrument.calibrate.gauge import GENERATORS
from instrument.units import Complex, Float

SAMPLES = 8  # whose changes by all common directions are held at once
ALONE = 1e-12  # of the largest eigenvalue of a Gram matrix: less is a direction that moves no station


class Common:
    """The common directions of every unknown at matrices x (A, 2, K, 2): tangents x_k G_n, (K, n, A 2 2) complex."""

    def __init__(self, x: Complex, pattern: str) -> None:
        self.shape = x.shape
        self.generators = GENERATORS[pattern]
        tangents = np.einsum("aikj,njl->knail", x, self.generators)
        self.tangents = np.ascontiguousarray(tangents).reshape(x.shape[2], len(self.generators), -1).view(float)
        gram = self.tangents @ self.tangents.swapaxes(1, 2)
        self.inverse = np.linalg.pinv(gram, rcond=ALONE, hermitian=True)

    def along(self, y: Float) -> Complex:
        """The step (A, 2, K, 2) of coordinates y (K, n)."""
        flat = (y[:, None] @ self.tangents)[:, 0].view(complex)
        stations, _, columns, _ = self.shape
        return flat.reshape(columns, stations, 2, 2).transpose(1, 2, 0, 3)

    def against(self, right: Complex) -> Float:
        """Products (K, n) of the tangents with sums (A, 2, K, 2)."""
        flat = np.ascontiguousarray(right.transpose(2, 0, 1, 3)).reshape(self.shape[2], -1).view(float)
        return (self.tangents @ flat[..., None])[..., 0]

    def coordinates(self, step: Complex) -> Float:
        """The y (K, n) of the common part of a step, by least squares."""
        return (self.inverse @ self.against(step)[..., None])[..., 0]

    def spread(self, y: Float) -> Complex:
        """The adjoint of `coordinates`."""
        return self.along((self.inverse @ y[..., None])[..., 0])

    def moved(self, x: Complex, step: Complex) -> Complex:
        """Matrices x after a step: what is not common in a straight line, what is as an exponential."""
        y = self.coordinates(step)
        common = mat2.exponential(np.einsum("kn,nij->kij", y, self.generators))
        return np.asarray(np.einsum("aikj,kjl->aikl", x + (step - self.along(y)), common))

    def prior_form(self, other: Common) -> Float:
        """Products (K n, K n) of the coordinates of the tangents of others."""
        columns, many = self.tangents.shape[:2]
        y = self.inverse @ self.tangents @ other.tangents.swapaxes(1, 2)  # (K, n, n) of each tangent
        out = np.zeros((columns, many, columns, many))
        out[range(columns), :, range(columns)] = y.swapaxes(1, 2) @ y
        return out.reshape(columns * many, -1)

    def own_form(self, equations: Equations) -> Float:
        """What the common directions weigh with the stations held, t_i^H D t_j (K n, K n)."""
        columns, many = self.tangents.shape[:2]
        steps = self.tangents.view(complex).reshape(columns, many, -1, 2, 2)
        normal = equations.normal.reshape(-1, columns, 2, columns, 2)
        moved = np.einsum("knail,aklqm->qknaim", steps, normal, optimize=True).reshape(columns, columns * many, -1)
        form = moved @ steps.reshape(columns, many, -1).conj().swapaxes(1, 2)
        return np.asarray(form.real.transpose(1, 0, 2).reshape(columns * many, -1))

    def seen_form(self, equations: Equations) -> Float:
        """What the data see of the common directions, t_i^H H t_j (K n, K n): products of what they do to the data."""
        block, z, weight = equations.block, equations.z, np.sqrt(equations.weight)
        columns, many = self.tangents.shape[:2]
        steps = self.tangents.view(complex).reshape(columns, many, -1, 2, 2)
        clusters, samples = block.column.shape[1], block.v.shape[4]
        z = z.reshape(*z.shape[:2], clusters, 2, block.stations, samples, 2)
        form = np.zeros((columns, columns, many, many))
        for p, col in enumerate(block.column):
            for first in range(0, samples, SAMPLES):
                span = slice(first, first + SAMPLES)
                seen = np.empty((clusters, many, len(block.a1), 2, len(range(samples)[span]), 2), complex)
                for c, k in enumerate(col):
                    left = steps[k].transpose(1, 0, 2, 3).reshape(block.stations, -1, 2)
                    there = z[p, :, c, :, :, span].reshape(block.stations, 2, -1)
                    change = (left @ there).reshape(block.stations, many, 2, block.stations, -1, 2)
                    back = np.conj(change[block.a2, :, :, block.a1])  # (B, n, j, s, i)
                    seen[c] = np.moveaxis(change[block.a1, :, :, block.a2] + back.swapaxes(2, 4), 1, 0)
                seen *= weight[p, block.a1, block.a2, span][:, None, :, None]
                flat = seen.reshape(clusters * many, -1).view(float)
                pairs = (flat @ flat.T).reshape(clusters, many, clusters, many)
                form[col[:, None], col[None, :]] += pairs.transpose(0, 2, 1, 3)
        return form.transpose(0, 2, 1, 3).reshape(columns * many, -1)

    def bent_form(self, curvature: Complex) -> Float:
        """Newton's second-order term of the common directions (K n, K n)."""
        columns, many = self.tangents.shape[:2]
        steps = self.tangents.view(complex)
        out = np.zeros((columns, many, columns, many))
        out[range(columns), :, range(columns)] = (steps.conj() @ curvature @ steps.swapaxes(1, 2)).real
        return out.reshape(columns * many, -1)
