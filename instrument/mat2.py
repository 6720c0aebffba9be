"""Algebra of stacks of 2x2 matrices, (..., 2, 2): products, inverses, condition numbers, without LAPACK calls."""

from __future__ import annotations

from typing import Any

import numpy as np

from instrument.compiled import compiled
from instrument.units import Complex, Float, Int

IDENTITY: Complex = np.eye(2, dtype=complex)
IDENTITY.setflags(write=False)
UNIT = 2.0**-53  # no operation of float64 is wrong by more, relative to its result


def pack(a: Any, b: Any, c: Any, d: Any) -> Complex:
    """[[a, b], [c, d]] of broadcastable arrays, (..., 2, 2)."""
    a, b, c, d = np.broadcast_arrays(a, b, c, d)
    out = np.empty((*a.shape, 2, 2), np.result_type(a, b, c, d, np.complex64))
    out[..., 0, 0], out[..., 0, 1], out[..., 1, 0], out[..., 1, 1] = a, b, c, d
    return out


def mul(a: Complex, b: Complex) -> Complex:
    """Matrix product a b, broadcasting; 4 to 8 times faster than `matmul` on stacks of this size."""
    shape = np.broadcast_shapes(a.shape, b.shape)
    out = np.empty(shape, np.result_type(a, b))
    for i in range(2):
        for j in range(2):
            out[..., i, j] = a[..., i, 0] * b[..., 0, j] + a[..., i, 1] * b[..., 1, j]
    return out


def herm(a: Complex) -> Complex:
    """Conjugate transpose."""
    return np.conj(np.swapaxes(a, -1, -2))


def det(a: Complex) -> Complex:
    """Determinant, (...)."""
    return np.asarray(a[..., 0, 0] * a[..., 1, 1] - a[..., 0, 1] * a[..., 1, 0])


def sandwich(a: Complex, v: Complex, b: Complex) -> Complex:
    """a v b^H: visibilities v corrupted by the Jones matrices of their two stations."""
    return mul(mul(a, v), herm(b))


def between(jones: Complex, v: Complex, one: Int, other: Int) -> Complex:
    """J_a v J_b^H of matrices of stations (T, F, A | 1, 2, 2) and visibilities (T, F, B, 2, 2) of their pairs (B,)."""
    shape = np.broadcast_shapes(jones.shape[:2], v.shape[:2])
    out = np.empty((*shape, *v.shape[2:]), complex)
    if jones.shape[2] == 1:
        one = other = np.zeros(len(one), int)
    j = np.array(np.broadcast_to(jones, (*shape, *jones.shape[2:])), complex, order="C")
    v = np.ascontiguousarray(np.broadcast_to(v, out.shape), complex)
    if out.size:
        _between(j.reshape(-1, j.shape[2], 4), v.reshape(-1, len(one), 4), one, other, out.reshape(-1, len(one), 4))
    return out


@compiled(nogil=True, fastmath={"contract"}, error_model="numpy")  # data may hold infinities
def _between(jones: Any, v: Any, one: Any, other: Any, out: Any) -> None:
    for t in range(v.shape[0]):
        for n in range(v.shape[1]):
            a, b = jones[t, one[n]], jones[t, other[n]]
            p, q, r, s = v[t, n, 0], v[t, n, 1], v[t, n, 2], v[t, n, 3]
            for i in (0, 2):
                y, z = a[i] * p + a[i + 1] * r, a[i] * q + a[i + 1] * s
                out[t, n, i] = y * np.conj(b[0]) + z * np.conj(b[1])
                out[t, n, i + 1] = y * np.conj(b[2]) + z * np.conj(b[3])


def inverse(a: Complex) -> Complex:
    """Inverse; NaN where the matrix is singular to working precision (condition above 1e15) or not finite."""
    # scaled by its largest entry so that matrices of 1e-200 and 1e200 invert as well as those of 1
    size = np.abs(a).max(axis=(-2, -1), keepdims=True)
    with np.errstate(all="ignore"):
        scaled = a / size
        d = det(scaled)
        out = pack(scaled[..., 1, 1], -scaled[..., 0, 1], -scaled[..., 1, 0], scaled[..., 0, 0])
        out = out / d[..., None, None] / size
        bad = ~(np.abs(d) > 1e-15) | ~np.isfinite(size[..., 0, 0])
    out[bad] = np.nan
    return out


def exponential(matrix: Complex) -> Complex:
    """exp of matrices (..., 2, 2) in closed form: exp(t) (cosh(d) 1 + sinh(d) / d H), t half the trace, H the rest."""
    half = (matrix[..., 0, 0] + matrix[..., 1, 1]) / 2
    rest = matrix - half[..., None, None] * IDENTITY
    d = np.sqrt(-det(rest) + 0j)
    far = np.abs(d) > 1e-5
    ratio = np.where(far, np.sinh(d) / np.where(far, d, 1.0), 1 + d * d / 6)
    return np.asarray(
        np.exp(half)[..., None, None] * (np.cosh(d)[..., None, None] * IDENTITY + ratio[..., None, None] * rest)
    )


def singular_values(a: Complex) -> tuple[Float, Float]:
    """Largest and smallest singular value, (...), in closed form; NaN where the matrix is not finite."""
    # scaled by its largest entry: the fourth powers below leave float64 at 1e-81 and 1e77
    size = np.abs(a).max(axis=(-2, -1))
    with np.errstate(all="ignore"):
        scaled = a / np.where(size > 0, size, 1.0)[..., None, None]
        rows = (np.abs(scaled) ** 2).sum(axis=-1)
        across = scaled[..., 0, 0] * scaled[..., 1, 0].conj() + scaled[..., 0, 1] * scaled[..., 1, 1].conj()
        # not the root of power^2 - 4 |det|^2: near a multiple of a unitary matrix that keeps half the digits
        gap = np.hypot(rows[..., 0] - rows[..., 1], 2 * np.abs(across))
        high = np.sqrt(0.5 * (rows.sum(axis=-1) + gap))
        # |det| / high, not the root of a difference: keeps every digit of a small value
        low = np.where(high > 0, np.abs(det(scaled)) / high, 0.0)
        # of a multiple of a unitary matrix both are one: a root and a quotient may round apart, and IXR be 1e32
        low = np.where(gap > 0, np.minimum(low, high), high)
        return high * size, low * size


def condition(a: Complex) -> Float:
    """Condition number, >= 1; infinity where singular."""
    high, low = singular_values(a)
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.asarray(np.where(low > 0, np.maximum(high / low, 1.0), np.inf))
