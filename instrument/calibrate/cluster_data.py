"""Data and models of several clusters in one stretch, held twice, and what matrices of all stations leave of them."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from instrument.calibrate.gauge import UNKNOWNS
from instrument.units import Bool, Complex, Float, Int

MEDIAN_CHI2_8 = 7.344  # of |r|^2 / sigma^2 of a visibility: four complex correlations


@dataclass(frozen=True)
class Limits:
    """When to stop, the pattern of the matrices, and the degrees of freedom of Student's t (None: Gaussian)."""

    pattern: str
    tolerance: float
    iterations: int
    robust: float | None
    unexplained: float


@dataclass
class Block:
    """Data of one stretch, cut in P pieces of s samples within which no solution changes.

    data (P, s, B, 2, 2), models (C, P, s, B, 2, 2), weight (P, s, B); `column` (P, C) names the unknown, 0 ... K-1,
    that a cluster has in a piece. Each baseline is held twice, seen from either end.
    """

    data: Complex
    models: Complex
    weight: Float
    a1: Int
    a2: Int
    stations: int
    column: Int
    limits: Limits
    v: Complex = field(init=False)
    m: Complex = field(init=False)
    w: Float = field(init=False)
    columns: int = field(init=False)
    active: Bool = field(init=False)

    def __post_init__(self) -> None:
        pieces, samples = self.weight.shape[:2]
        clusters, stations = len(self.models), self.stations
        self.columns = int(self.column.max()) + 1
        good = self.weight > 0
        data = np.where(good[..., None, None], self.data, 0.0)
        models = np.where(good[None, ..., None, None], self.models, 0.0)
        self.v = np.zeros((pieces, stations, 2, stations, samples, 2), complex)
        self.m = np.zeros((pieces, stations, clusters, 2, stations, samples, 2), complex)
        self.w = np.zeros((pieces, stations, stations, samples))
        for here, there, turn in ((self.a1, self.a2, False), (self.a2, self.a1, True)):
            d, m = (np.conj(np.swapaxes(x, -1, -2)) if turn else x for x in (data, models))
            self.v[:, here, :, there] = d.transpose(2, 0, 3, 1, 4)
            self.m[:, here, :, :, there] = m.transpose(3, 1, 0, 4, 2, 5)
            self.w[:, here, there] = self.weight.transpose(0, 2, 1)
        self.active = self._counts(np.abs(self.m) ** 2) > 0
        # a station that gives nothing at all is dead: no matrix describes it
        self.active &= self._spread(np.einsum("pabs,paibsj->pa", self.w, np.abs(self.v) ** 2)) > 0

    @property
    def used(self) -> int:
        """Visibilities that count."""
        return int((self.w > 0).sum()) // 2

    @property
    def unknowns(self) -> int:
        """Real numbers that are solved for."""
        return UNKNOWNS[self.limits.pattern] * int(self.active.sum())

    def seen(self, x: Complex) -> tuple[Complex, Complex]:
        """Z (P, A, 2C, A s 2), and the data less sum_c J_a^c Z_ab^c (P, A, 2, A, s, 2), for matrices x (A, 2, K, 2)."""
        h = np.conj(x[:, :, self.column].transpose(2, 3, 0, 1, 4))[
            :, None, :, None, :, None
        ]  # (P, 1, C, 1, A, 1, j, k)
        z = self.m[..., 0, None] * h[..., 0] + self.m[..., 1, None] * h[..., 1]
        z = z.reshape(*z.shape[:2], 2 * z.shape[2], -1)
        return z, self.v - (self.rows(x) @ z).reshape(self.v.shape)

    def rows(self, x: Complex) -> Complex:
        """Matrices x (A, 2, K, 2) as they stand in each piece, (P, A, 2, 2C)."""
        here = x[:, :, self.column].transpose(2, 0, 1, 3, 4)
        return here.reshape(*here.shape[:3], -1)

    def onto(self, x: Complex) -> Complex:
        """The nearest matrices of the pattern that are not a step: phases of unit size."""
        if self.limits.pattern != "phase":
            return x
        size = np.abs(x) * np.eye(2)[:, None, :]
        return np.where(size > 0, x / np.where(size > 0, size, 1), 0.0)

    def cost(self, left: Complex, weight: Float) -> float:
        """Weighted power of what is left, each baseline once."""
        return 0.5 * float((weight * power_of(left)).sum())

    def variance(self, left: Complex, weight: Float) -> float:
        """Of the noise of a real number of weight 1, by what is left."""
        return self.cost(left, weight) / max(8 * self.used - self.unknowns, 1)

    def weights(self, left: Complex) -> Float:
        """Weights (P, A, A, s) of this round; Student's are w (nu + 8) / (nu + w |r|^2 / sigma^2), by what is left."""
        freedom = self.limits.robust
        if freedom is None:
            return self.w
        chi2 = self.w * power_of(left)
        chi2 = (chi2 + chi2.swapaxes(1, 2)) / 2  # rounding is not the same at both ends
        return self.w * (freedom + 8) / (freedom + chi2 / self.scatter(chi2[self.w > 0]))

    def scatter(self, chi2: Float) -> float:
        """Variance of a real number of weight 1, from the median of w |r|^2 over all visibilities that count."""
        # the fit takes its share of the scatter
        taken = 1 - min(0.9, self.unknowns / (8 * self.used))
        floor = 1e-24 * self.cost(self.v, self.w) / self.used
        return max(float(np.median(chi2)) / MEDIAN_CHI2_8 / taken, floor, 1e-300)

    def share(self, left: Complex, weight: Float) -> Float:
        """Rms of what is left over that of the data in each piece (P,)."""
        one, whole = ((weight * power_of(x)).sum(axis=(1, 2, 3)) for x in (left, self.v))
        with np.errstate(invalid="ignore", divide="ignore"):
            return np.sqrt(one / whole)

    def _counts(self, power: Float) -> Float:
        """Weighted power of the models for each unknown, (K, A)."""
        return self._spread(np.einsum("pabs,pacibsj->pac", self.w, power))

    def _spread(self, values: Float) -> Float:
        """Sums (P, A) or (P, A, C) of pieces as sums of unknowns (K, A)."""
        if values.ndim == 2:
            values = np.repeat(values[..., None], self.column.shape[1], axis=2)
        out = np.zeros((self.columns, self.stations))
        for p, col in enumerate(self.column):
            out[col] += values[p].T
        return out


def power_of(values: Complex) -> Float:
    """Power of visibilities (P, A, 2, A, s, 2) over the four correlations, (P, A, A, s)."""
    return np.asarray((values.real**2 + values.imag**2).sum(axis=(2, 5)))
