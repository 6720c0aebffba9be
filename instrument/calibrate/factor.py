"""The Cholesky factor of a normal matrix with a prior, and its inverse for a prior of any lower weight."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.linalg import lapack

from instrument.units import Complex, Float


@dataclass
class Factor:
    """R (n, n), upper, of N + w P^T P = R^T R at matrices (A, 2, 2): N a normal matrix, P (m, n) the rows of a prior.

    With P A P^T = U d U^T for A the inverse, that for a lower weight, as it is `now`, is A + B diag(c) B^T for
    B = A P^T U (n, m): no second factorization where a prior weakens as data are fitted.
    """

    upper: Float
    prior: Float
    weight: float
    at: Complex

    def __post_init__(self) -> None:
        back = lapack.dpotrs(self.upper, self.prior.T, lower=0)[0]
        values, turn = np.linalg.eigh(self.prior @ back)
        self.values, self.back, self.rows = np.maximum(values, 0.0), back @ turn, turn.T @ self.prior
        self.now = self.weight

    def exact(self, weight: float) -> bool:
        """Whether a weight is near enough to that of the factor for eight digits along every direction."""
        return bool(np.all((self.weight - weight) * self.values < 1 - 1e-8))

    def grown(self) -> Float:
        """How much further a pull goes along each direction of U than with the prior as it was, (m,)."""
        return 1 / np.maximum(1 - (self.weight - self.now) * self.values, 1e-300)

    def solve(self, right: Float) -> Float:
        """(N + now P^T P)^-1 times right (n) or (n, k)."""
        found: Any = lapack.dpotrs(self.upper, right, lower=0)[0]
        if self.now != self.weight:
            more = (self.weight - self.now) * self.grown()
            found += self.back @ ((self.rows @ found).T * more).T
        return np.asarray(found)
