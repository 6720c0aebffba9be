"""The normal matrix of one interval: what steps J_a exp(e_a) of all stations do to the data, to second order."""

from __future__ import annotations

from typing import Any

import numpy as np

from instrument.compiled import compiled, inlined
from instrument.phasor import FAST
from instrument.units import Complex, Float, Int

# real coordinates of e that a pattern has, of (re, im) of e00, e01, e10, e11, (8, k)
_COORDINATES = np.eye(8)
BASIS: dict[str, Float] = {
    "full": _COORDINATES,
    "diagonal": _COORDINATES[:, [0, 1, 6, 7]],
    "scalar": _COORDINATES[:, [0, 1]] + _COORDINATES[:, [6, 7]],
    "phase": _COORDINATES[:, [1, 7]],
}


def normal_matrix(
    v: Complex, m: Complex, a1: Int, a2: Int, jones: Complex, pattern: str, left_over: Complex | None = None
) -> Float:
    """Half the second derivative of the power that steps J_a exp(e_a) leave, (A k, A k); its lower triangle counts.

    v, m (N, 2, 2) weighted data and model, jones (A, 2, 2). With `left_over`, sum_b J_a^H E_ab J_b M_ab^H (A, 2, 2) for
    what is left E (less what a prior makes of it), it is all of it (Newton); without, that of the fit (Gauss, Newton).
    """
    stations, second = len(jones), left_over is not None
    out, inner = np.zeros((8 * stations, 8 * stations)), np.zeros((stations, 2, 2), complex)
    square = np.conj(np.swapaxes(jones, 1, 2)) @ jones
    _fill(v, m, np.stack([a1, a2]), jones, square, second, out, inner)
    own = np.einsum("aik,alj->aijkl", square, inner).reshape(stations, 4, 4)
    block = np.empty((stations, 4, 2, 4, 2))
    block[:, :, 0, :, 0] = block[:, :, 1, :, 1] = own.real
    block[:, :, 0, :, 1], block[:, :, 1, :, 0] = -own.imag, own.imag
    if left_over is not None:  # e_a e_a in exp(e_a): Re conj(g[ik]) e[ij] e[jk]
        twice = np.einsum("aik,jl->aijlk", left_over.conj(), np.eye(2)).reshape(stations, 4, 4)
        twice = (twice + twice.swapaxes(1, 2)) / 2
        block[:, :, 0, :, 0] -= twice.real
        block[:, :, 1, :, 1] += twice.real
        block[:, :, 0, :, 1] += twice.imag
        block[:, :, 1, :, 0] += twice.imag
    each = out.reshape(stations, 8, stations, 8)
    each[np.arange(stations), :, np.arange(stations)] += block.reshape(stations, 8, 8)
    if pattern == "full":
        return out
    basis = BASIS[pattern]
    both = np.tril(out) + np.tril(out, -1).T
    size = basis.shape[1] * stations
    return np.asarray(
        np.einsum("ki,akbl,lj->aibj", basis, both.reshape(stations, 8, stations, 8), basis, optimize=True).reshape(
            size, size
        )
    )


@inlined
def _entries(x: Any) -> Any:
    return x[0, 0], x[0, 1], x[1, 0], x[1, 1]


@compiled(nogil=True, fastmath=FAST, error_model="numpy")
def _fill(v: Any, m: Any, ends: Any, jones: Any, square: Any, second: Any, out: Any, inner: Any) -> None:
    """Blocks of pairs of stations, below the diagonal of out, and sum M Q_b M^H (A, 2, 2) of each station in inner.

    With X = Q_a M, Y = M Q_b, Q = J^H J, two steps have conj(e_a[ij]) conj(e_b[kl]) X[il] conj(Y[jk]) in common, and
    what is left, E, has conj(F[ik]) M[jl] with e_a[ij] conj(e_b[kl]), F = J_a^H E J_b.
    """
    baselines = ends.shape[1]
    x, y = np.empty((2, 2), np.complex128), np.empty((2, 2), np.complex128)
    f, mm = np.empty((2, 2), np.complex128), np.empty((2, 2), np.complex128)
    for n in range(len(m)):
        p, q = ends[0, n % baselines], ends[1, n % baselines]
        m00, m01, m10, m11 = _entries(m[n])
        if p == q or (m00 == 0 and m01 == 0 and m10 == 0 and m11 == 0):
            continue
        a00, a01, a10, a11 = _entries(square[p])
        b00, b01, b10, b11 = _entries(square[q])
        mm[0, 0], mm[0, 1], mm[1, 0], mm[1, 1] = m00, m01, m10, m11
        x[0, 0], x[0, 1] = a00 * m00 + a01 * m10, a00 * m01 + a01 * m11
        x[1, 0], x[1, 1] = a10 * m00 + a11 * m10, a10 * m01 + a11 * m11
        y[0, 0], y[0, 1] = m00 * b00 + m01 * b10, m00 * b01 + m01 * b11
        y[1, 0], y[1, 1] = m10 * b00 + m11 * b10, m10 * b01 + m11 * b11
        for i in range(2):
            for j in range(2):
                for k in range(2):
                    inner[p, i, j] += y[i, k] * np.conj(mm[j, k])
                    inner[q, i, j] += np.conj(mm[k, i]) * x[k, j]
        if second:
            f[:] = 0
            for r in range(2):
                for c in range(2):
                    left = v[n, r, c]
                    for i in range(2):
                        for j in range(2):
                            left -= jones[p, r, i] * mm[i, j] * np.conj(jones[q, c, j])
                    for i in range(2):
                        for k in range(2):
                            f[i, k] += np.conj(jones[p, r, i]) * left * jones[q, c, k]
        for i in range(2):
            for j in range(2):
                row = 8 * p + 4 * i + 2 * j
                for k in range(2):
                    for l in range(2):
                        column = 8 * q + 4 * k + 2 * l
                        z = x[i, l] * np.conj(y[j, k])
                        same, turn = z.real, z.imag
                        other, across = -z.real, z.imag
                        if second:
                            w = np.conj(f[i, k]) * mm[j, l]
                            same, other, turn, across = same - w.real, other - w.real, turn - w.imag, across + w.imag
                        if p > q:
                            out[row, column] += same
                            out[row, column + 1] += turn
                            out[row + 1, column] += across
                            out[row + 1, column + 1] += other
                        else:
                            out[column, row] += same
                            out[column + 1, row] += turn
                            out[column, row + 1] += across
                            out[column + 1, row + 1] += other
