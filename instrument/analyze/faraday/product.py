"""The one product of Faraday synthesis: cos and sin of all |phi| with the channels of a chunk of pixels."""

from __future__ import annotations

from typing import Any

import numpy as np

from instrument.units import Float, Int


class Product:
    """Weighted sums over channels (2, M, columns) with cos and sin of 2 |phi| `offsets`, for M distinct |phi|.

    `offsets` (N,) are lambda² - lambda²_0, m²; `place` (P,) is the row of each depth and `sign` (P,) its sign. Phases
    are float64 and rounded once. In double precision it is one plain product. In single it is taken in factors where
    the depths do not fill the band, such as 94 x 161 and 201 x 47 (twice) for 402 x 161, which the factors match to
    1e-9 of its largest entry: 0.31 s, not 0.45 s, for 230400 spectra. The 161 terms are added in two halves, which
    halves the error of sums in float32.
    """

    def __init__(self, phi: Float, offsets: Float, weights: Float, real: Any) -> None:
        self.rows, self.place, sign = distinct(phi)
        self.sign, self.real, self.half = sign.astype(real), real, (len(offsets) + 1) // 2
        angle = 2 * np.outer(self.rows, offsets)
        parts = np.cos(angle), np.sin(angle)
        found = [_factors(part, self.rows[-1] * np.ptp(offsets) / np.pi) for part in parts if real == np.float32]
        self.left = [np.ascontiguousarray(x[0], real) for x in found if x is not None]
        self.factored = len(self.left) == 2
        whole = [x[1] for x in found if x is not None] if self.factored else parts
        self.right = np.ascontiguousarray(np.concatenate(whole) * weights, real)

    def __call__(self, x: Any) -> Any:
        """Of values (N, columns)."""
        if self.real == np.float32:
            y = self.right[:, : self.half] @ x[: self.half]
            y += self.right[:, self.half :] @ x[self.half :]
        else:
            y = self.right @ x
        if not self.factored:
            return y.reshape(2, len(self.rows), -1)
        out, middle = np.empty((2, len(self.rows), x.shape[1]), self.real), self.left[0].shape[1]
        np.matmul(self.left[0], y[:middle], out=out[0])
        np.matmul(self.left[1], y[middle:], out=out[1])
        return out


def _factors(matrix: Float, turns: float) -> tuple[Float, Float] | None:
    """Two factors that cost less than the matrix, from its product with random vectors; None where there are none.

    The rank is about the turns of phase over the band at the largest depth, and some for the accuracy; for lambda²_0
    outside of the band it is twice that, and the factors fail their check.
    """
    rank = int(turns) + 20
    if rank * sum(matrix.shape) > 0.7 * matrix.size:
        return None
    vectors = np.random.default_rng(0).normal(size=(matrix.shape[1], rank))
    left = np.linalg.qr(matrix @ vectors)[0]
    right = left.T @ matrix
    return (left, right) if np.abs(left @ right - matrix).max() <= 1e-9 else None


def distinct(phi: Float) -> tuple[Float, Int, Float]:
    """Distinct |phi|, the place of each depth among them, and its sign; x and -x of a computed axis differ by 1e-16."""
    order = np.argsort(np.abs(phi), kind="stable")
    size = np.abs(phi)[order]
    new = np.diff(size, prepend=-1.0) > 2 * np.finfo(float).eps * size[-1]
    place = np.empty(len(phi), np.int64)
    place[order] = np.cumsum(new) - 1
    return size[new], place, np.where(phi < 0, -1.0, 1.0)
