"""Alternating least squares for station matrices, compiled, many solutions side by side in vector lanes.

One sweep solves every station with the others held: J_a = (sum_b V_ab Z_ab^H) (sum_b Z_ab Z_ab^H)^-1,
Z_ab = M_ab J_b^H (Salvini & Wijnholds 2014; Smirnov & Tasse 2015). What to do with the step is decided in selfcal.py.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from instrument.compiled import compiled, inlined
from instrument.phasor import FAST
from instrument.units import Complex, Float

LANES = 16


@inlined
def _mul_h(a: Any, b: Any) -> Any:
    """A B^H of matrices given as 8 reals: re 00, im 00, re 01, im 01, re 10, im 10, re 11, im 11."""
    return (
        a[0] * b[0] + a[1] * b[1] + a[2] * b[2] + a[3] * b[3],
        a[1] * b[0] - a[0] * b[1] + a[3] * b[2] - a[2] * b[3],
        a[0] * b[4] + a[1] * b[5] + a[2] * b[6] + a[3] * b[7],
        a[1] * b[4] - a[0] * b[5] + a[3] * b[6] - a[2] * b[7],
        a[4] * b[0] + a[5] * b[1] + a[6] * b[2] + a[7] * b[3],
        a[5] * b[0] - a[4] * b[1] + a[7] * b[2] - a[6] * b[3],
        a[4] * b[4] + a[5] * b[5] + a[6] * b[6] + a[7] * b[7],
        a[5] * b[4] - a[4] * b[5] + a[7] * b[6] - a[6] * b[7],
    )


@inlined
def _herm(a: Any) -> Any:
    return (a[0], -a[1], a[4], -a[5], a[2], -a[3], a[6], -a[7])


@inlined
def _at(x: Any, i: int, lane: int) -> Any:
    return (
        x[i, 0, lane], x[i, 1, lane], x[i, 2, lane], x[i, 3, lane],
        x[i, 4, lane], x[i, 5, lane], x[i, 6, lane], x[i, 7, lane],
    )  # fmt: skip


@compiled(nogil=True, fastmath=FAST, error_model="numpy")
def sweep(data: Any, model: Any, a1: Any, a2: Any, jones: Any, right: Any, left: Any) -> None:
    """Sums of one sweep: right (A, 8, L) = sum V Z^H, left (A, 4, L) = sum Z Z^H as (00, 11, re 01, im 01).

    data and model are (samples * B, 8, L), weighted by the root of the weights; jones (A, 8, L).
    """
    right[:] = 0.0
    left[:] = 0.0
    baselines = len(a1)
    lanes = jones.shape[2]
    for i in range(data.shape[0]):
        p, q = a1[i % baselines], a2[i % baselines]
        for lane in range(lanes):
            v, m = _at(data, i, lane), _at(model, i, lane)
            z = _mul_h(m, _at(jones, q, lane))
            n = _mul_h(v, z)
            for k in range(8):
                right[p, k, lane] += n[k]
            left[p, 0, lane] += z[0] * z[0] + z[1] * z[1] + z[2] * z[2] + z[3] * z[3]
            left[p, 1, lane] += z[4] * z[4] + z[5] * z[5] + z[6] * z[6] + z[7] * z[7]
            left[p, 2, lane] += z[0] * z[4] + z[1] * z[5] + z[2] * z[6] + z[3] * z[7]
            left[p, 3, lane] += z[1] * z[4] - z[0] * z[5] + z[3] * z[6] - z[2] * z[7]
            z = _mul_h(_herm(m), _at(jones, p, lane))
            n = _mul_h(_herm(v), z)
            for k in range(8):
                right[q, k, lane] += n[k]
            left[q, 0, lane] += z[0] * z[0] + z[1] * z[1] + z[2] * z[2] + z[3] * z[3]
            left[q, 1, lane] += z[4] * z[4] + z[5] * z[5] + z[6] * z[6] + z[7] * z[7]
            left[q, 2, lane] += z[0] * z[4] + z[1] * z[5] + z[2] * z[6] + z[3] * z[7]
            left[q, 3, lane] += z[1] * z[4] - z[0] * z[5] + z[3] * z[6] - z[2] * z[7]


@compiled(nogil=True, fastmath=FAST, error_model="numpy")
def residual(data: Any, model: Any, a1: Any, a2: Any, jones: Any, out: Any) -> None:
    """Power of V - J_a M J_b^H, of V and of J_a M J_b^H on each baseline, (3, B, L)."""
    out[:] = 0.0
    baselines = len(a1)
    for i in range(data.shape[0]):
        row = i % baselines
        p, q = a1[row], a2[row]
        for lane in range(jones.shape[2]):
            v, m = _at(data, i, lane), _at(model, i, lane)
            # (J_p M) J_q^H, as J_p (M^H)^H
            s = _mul_h(_mul_h(_at(jones, p, lane), _herm(m)), _at(jones, q, lane))
            for k in range(8):
                d = v[k] - s[k]
                out[0, row, lane] += d * d
                out[1, row, lane] += v[k] * v[k]
                out[2, row, lane] += s[k] * s[k]


def planar(values: Any, lanes: int) -> Float:
    """Complex matrices (L, N, 2, 2) as reals (N, 8, lanes), contiguous in the lanes; lanes beyond L are zero."""
    count, rows = values.shape[:2]
    flat = np.ascontiguousarray(values, complex).view(float).reshape(count, rows, 8)
    out = np.zeros((rows, 8, lanes))
    out[:, :, :count] = flat.transpose(1, 2, 0)
    return out


def matrices(planes: Float) -> Any:
    """Inverse of `planar` for stations: (A, 8, L) to complex (L, A, 2, 2)."""
    flat = np.ascontiguousarray(planes.transpose(2, 0, 1))
    return flat.view(complex).reshape(flat.shape[0], flat.shape[1], 2, 2)


def solve_stations(right: Float, left: Float, pattern: str) -> Any:
    """Station matrices (L, A, 2, 2) of the sums of a sweep, in a pattern; NaN where a station has no equation."""
    n = matrices(right)
    d00, d11, re, im = np.moveaxis(left, 1, 0).transpose(0, 2, 1)
    out = np.zeros_like(n)
    with np.errstate(divide="ignore", invalid="ignore"):
        if pattern == "full":
            d01 = re + 1j * im
            det = d00 * d11 - np.abs(d01) ** 2
            size = (d00 + d11) ** 2
            # a model seen through one receptor only leaves half of J open: least squares of least norm needs a floor
            det = np.where(det > 1e-14 * size, det, np.nan)
            inverse = np.stack([np.stack([d11, -d01], -1), np.stack([-d01.conj(), d00], -1)], -2) / det[..., None, None]
            for i in range(2):
                for j in range(2):
                    out[..., i, j] = n[..., i, 0] * inverse[..., 0, j] + n[..., i, 1] * inverse[..., 1, j]
        elif pattern == "scalar":
            out[..., 0, 0] = out[..., 1, 1] = (n[..., 0, 0] + n[..., 1, 1]) / (d00 + d11)
        else:
            p, q = n[..., 0, 0] / d00, n[..., 1, 1] / d11
            if pattern == "phase":
                p, q = p / np.abs(p), q / np.abs(q)
            out[..., 0, 0], out[..., 1, 1] = p, q
    return out


def power_of(values: Complex) -> Float:
    """Sum of |x|^2 of matrices (..., 2, 2), (...); without the roots of `abs`."""
    flat = np.ascontiguousarray(values).view(float).reshape(*values.shape[:-2], 8)
    return np.asarray(np.einsum("...i,...i->...", flat, flat))


def unit_diagonal(jones: Complex) -> Complex:
    """Matrices (..., 2, 2) with diagonal entries of size 1."""
    size = np.abs(jones)
    out = np.where(size > 0, jones / np.where(size > 0, size, 1), 0.0)
    return np.where((size > 0) | (np.eye(2) == 0), out, 1.0)
