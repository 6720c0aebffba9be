"""Standard errors of the matrices of all clusters, from the normal matrix and what is left over.

What the data hardly see is held by the prior of the solve: noise moves the estimate by A H A s^2, A = (H + p W^T W)^-1,
with W the common coordinates, p the weight of the prior and s^2 the variance of the noise. M = H + c W^T W, c what the
coordinates weigh with the stations held, is well conditioned; A follows from M^-1 and N = M^-1 W^T.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from instrument.calibrate.cluster_common import ALONE, Common
from instrument.calibrate.cluster_data import Block, power_of
from instrument.calibrate.cluster_equations import RIDGE, Equations, dot
from instrument.calibrate.cluster_rounds import TAU
from instrument.calibrate.gauge import BLIND
from instrument.units import Complex, Float

MOST = 4096  # unknown real numbers: their matrix fills 134 MB
LITTLE = 0.1 * BLIND  # of what common directions weigh with the stations held: rounding leaves that much of none


@dataclass(frozen=True)
class Errors:
    """Standard errors of K unknown matrices a station.

    `gains` (K, A, 2, 2) of real and imaginary parts, what is free or weak taken out; `common` (K, n) of the common
    directions, largest first, infinite where they are free; `loose` the generators (q, 2, 2) of those above `TAU`.
    """

    gains: Float
    common: Float
    loose: list[Complex]


def errors_of(block: Block, x: Complex, left: Complex, prior: float) -> Errors | None:
    """Errors of matrices x (A, 2, K, 2) that leave `left`, held by a prior; none where there are too many unknowns."""
    if 2 * x.size > MOST:
        return None
    weight = block.weights(left)
    equations = Equations(block, x, block.seen(x)[0], weight)
    common = Common(x, block.limits.pattern)
    normal = _Normal.of(equations, common, _Pattern(block.limits.pattern, x))
    held = np.maximum(prior / normal.scale, LITTLE)
    free = float(np.trace(np.linalg.solve(normal.seen + np.diag(held), np.diag(held))))
    variance = block.cost(left, weight) / max(8 * block.used - block.unknowns + free, 1) * _student(block, left)
    columns, many = common.tangents.shape[:2]
    marginal = np.linalg.inv(normal.seen + LITTLE * np.eye(len(normal.seen))).reshape(columns, many, columns, many)
    values, vectors = np.linalg.eigh(np.einsum("kikj->kij", marginal))
    with np.errstate(divide="ignore"):
        scale = normal.scale.reshape(columns, many)[:, :1]
        errors = np.where(values > 1 / BLIND, np.inf, np.sqrt(variance * np.maximum(values, 0) / scale))
    loose = [vectors[k][:, errors[k] > TAU] for k in range(columns)]
    return Errors(
        np.sqrt(variance * np.maximum(normal.variances(held, loose), 0.0)).transpose(2, 0, 1, 3),
        errors[:, ::-1],
        [np.einsum("nq,nij->qij", y, common.generators) for y in loose],
    )


@dataclass(frozen=True)
class _Pattern:
    """The real numbers that a pattern leaves of matrices x (A, 2, K, 2), as orthonormal directions."""

    name: str
    x: Complex

    def narrowed(self, rows: Float) -> Float:
        """Products (p, q) of the directions with vectors (8 A K, q) of all real numbers."""
        if self.name == "full":
            return rows
        parts = rows.reshape(*self.x.shape, 2, -1)
        parts = np.stack([parts[:, 0, :, 0], parts[:, 1, :, 1]], axis=1)  # (A, 2, K, re im, q)
        if self.name == "scalar":
            parts = parts.sum(axis=1, keepdims=True) / np.sqrt(2)
        if self.name == "phase":
            x = np.stack([self.x[:, 0, :, 0], self.x[:, 1, :, 1]], axis=1)
            parts = (parts * np.stack([-x.imag, x.real], axis=-1)[..., None]).sum(axis=3, keepdims=True)
        return np.asarray(parts.reshape(-1, parts.shape[-1]))

    def elements(self, variance: Float) -> Float:
        """Means (A, 2, K, 2) over real and imaginary part of the variances of elements, by those (p,) of directions."""
        stations, _, columns, _ = self.x.shape
        if self.name == "full":
            return np.asarray(variance.reshape(*self.x.shape, 2).mean(axis=-1))
        out = np.zeros(self.x.shape)
        each = variance.reshape(stations, -1, columns, 1 if self.name == "phase" else 2).sum(axis=-1) / 2
        for k in range(2):
            out[:, k, :, k] = each[:, 0] / 2 if self.name == "scalar" else each[:, k]
        return out


@dataclass(frozen=True)
class _Normal:
    """M = H + W^T W, W the common coordinates in units in which they weigh as much as with the stations held.

    `inverse` (p,) is the diagonal of M^-1, `across` (p, m) is N, `both` (m, m) is W N; `seen` (m, m) is what the data
    say of common directions whatever the rest; `scale` (m,) the square of the unit.
    """

    common: Common
    pattern: _Pattern
    inverse: Float
    across: Float
    both: Float
    seen: Float
    scale: Float

    @classmethod
    def of(cls, equations: Equations, common: Common, pattern: _Pattern) -> _Normal:
        """By inverting the triangle of Cholesky."""
        from scipy.linalg import cholesky
        from scipy.linalg.lapack import dtrtri

        columns, many = common.tangents.shape[:2]
        steps = [common.along(y) for y in np.eye(columns * many).reshape(-1, columns, many)]
        weighs = np.array([dot(d, equations.own(d)) for d in steps]).reshape(columns, many).mean(axis=1)
        scale = np.repeat(np.where(weighs > 0, weighs, 1.0), many)
        units = np.sqrt(scale).reshape(columns, many)
        rows = [common.spread(y * units) for y in np.eye(columns * many).reshape(-1, columns, many)]
        w = pattern.narrowed(np.stack([_flat(row) for row in rows], axis=1))  # (p, m)
        m = pattern.narrowed(pattern.narrowed(normal_matrix(equations)).T)
        m += w @ w.T
        diagonal = np.diag(m)
        root = np.sqrt(np.where(diagonal > 0, diagonal, 1.0))
        m /= root[:, None]
        m /= root
        m[np.diag_indices_from(m)] = 1 + RIDGE
        triangle = dtrtri(cholesky(m, lower=True, overwrite_a=True, check_finite=False), lower=1, overwrite_c=1)[0]
        across = triangle.T @ (triangle @ (w / root[:, None])) / root[:, None]
        both = w.T @ across
        both[np.diag_indices_from(both)] += np.repeat(weighs <= 0, many)
        seen = np.linalg.inv(both) - np.eye(len(both))
        inverse = np.einsum("ij,ij->j", triangle, triangle) / root**2
        return cls(common, pattern, inverse, across, both, (seen + seen.T) / 2, scale)

    def variances(self, held: Float, loose: list[Float]) -> Float:
        """Diagonal of A H A as elements (A, 2, K, 2), prior `held` (m,), common directions (n, q) of each taken out."""
        eye = np.eye(len(self.both))
        share = 1 - held
        inner = np.linalg.solve(eye - share[:, None] * self.both, np.diag(share))
        turned = eye + inner @ self.both
        inner = inner - (turned * held) @ turned.T
        cross = self.across @ inner
        out = self.inverse + np.einsum("pm,pm->p", cross, self.across)
        columns, many = self.common.tangents.shape[:2]
        for k, y in enumerate(loose):
            if not y.shape[1]:
                continue
            gram = self.common.tangents[k] @ self.common.tangents[k].T
            sizes, turn = np.linalg.eigh(y.T @ gram @ y)
            y = y @ (turn / np.sqrt(np.where(sizes > ALONE * sizes[-1], sizes, np.inf)))  # orthonormal steps
            own = slice(k * many, (k + 1) * many)
            where = np.zeros((columns, many, y.shape[1]))
            where[k] = y
            steps = np.stack([_flat(self.common.along(d)) for d in np.moveaxis(where, 2, 0)], axis=1)
            steps = self.pattern.narrowed(steps)
            moved = self.across[:, own] @ (gram @ y / np.sqrt(self.scale[own][0])) + cross @ (self.across.T @ steps)
            out -= 2 * np.einsum("pq,pq->p", moved, steps)
            out += np.einsum("pq,qr,pr->p", steps, steps.T @ moved, steps)
        return self.pattern.elements(out)


def normal_matrix(equations: Equations) -> Float:
    """What real and imaginary parts of all elements (A, 2, K, 2) do to each other's sums, (8 A K, 8 A K)."""
    block, z = equations.block, equations.z
    stations, columns, samples = block.stations, block.columns, block.v.shape[4]
    clusters = block.column.shape[1]
    z = z.reshape(len(z), stations, clusters, 2, stations, samples, 2)
    out = np.zeros((stations, 2, columns, 2, 2, stations, 2, columns, 2, 2))
    for a in range(stations):
        # (k, l, alpha, j; b, i, beta): a conjugate step of station b in the sums of station a
        row = np.zeros((columns, columns, 2, 2, stations, 2, 2), complex)
        for p, col in enumerate(block.column):
            here = z[p, a].transpose(2, 0, 1, 4, 3) * equations.weight[p, a][:, None, None, None]  # (b, c, alpha, i, s)
            there = z[p, :, :, :, a].transpose(0, 3, 1, 2, 4)  # (b, s, c, beta, j)
            pairs = here.reshape(stations, -1, samples) @ there.reshape(stations, samples, -1)
            pairs = pairs.reshape(stations, clusters, 2, 2, clusters, 2, 2)
            row[col[:, None], col[None, :]] += np.conj(pairs).transpose(1, 4, 2, 6, 0, 3, 5)
        row = row.transpose(3, 0, 2, 4, 5, 1, 6)  # (j, k, alpha; b, i, l, beta)
        out[a, :, :, :, 0, ..., 0], out[a, :, :, :, 0, ..., 1] = row.real, row.imag
        out[a, :, :, :, 1, ..., 0], out[a, :, :, :, 1, ..., 1] = row.imag, -row.real
        own = equations.normal[a].reshape(columns, 2, columns, 2).transpose(2, 3, 0, 1)  # (k, alpha; l, beta)
        for i in range(2):
            out[a, i, :, :, 0, a, i, :, :, 0] += own.real
            out[a, i, :, :, 1, a, i, :, :, 1] += own.real
            out[a, i, :, :, 1, a, i, :, :, 0] += own.imag
            out[a, i, :, :, 0, a, i, :, :, 1] -= own.imag
    return out.reshape(8 * stations * columns, -1)


def _student(block: Block, left: Complex) -> float:
    """Student's weights tell an error that is not that of a Gaussian fit of these weights: by how much, in variance."""
    freedom = block.limits.robust
    if freedom is None:
        return 1.0
    used = block.w > 0
    chi2 = (block.w * power_of(left))[used]
    q = chi2 / block.scatter(chi2)
    w = (freedom + 8) / (freedom + q)
    falls = np.mean(w * (1 - q / (4 * (freedom + q))))  # of w r with r, mean over the eight directions
    return float(np.mean(w**2 * q) * np.mean(w) / falls**2 / np.mean(w * q))


def _flat(step: Complex) -> Float:
    return np.ascontiguousarray(step).reshape(-1).view(float)
