"""Compiled loops of Faraday synthesis over pixels: gather and flag, combine products, fit Stokes I, find peaks.

Slow twins are the plain sums of tests/accuracy/test_faraday.py. No `fastmath` that assumes finite numbers: NaN is data.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from instrument.compiled import compiled


@compiled(nogil=True, error_model="numpy")
def gather(cube: Any, a: int, b: int, channels: Any, first: int, limit: float, x: Any) -> int:
    """Planes a and b of a cube (F, 4, Ny, Nx) as x (N, 2, n), pixels from `first` on; returns how many are flagged.

    A voxel that is NaN or beyond `limit` in one is zero in both.
    """
    bad, nx, n = 0, cube.shape[3], x.shape[2]
    for j in range(len(channels)):
        f, done = channels[j], 0
        while done < n:  # along one row of the image after the other
            row, column = (first + done) // nx, (first + done) % nx
            run = min(nx - column, n - done)
            for i in range(run):
                x[j, 0, done + i] = cube[f, a, row, column + i]
                x[j, 1, done + i] = cube[f, b, row, column + i]
            done += run
        for i in range(n):
            if not (abs(x[j, 0, i]) <= limit and abs(x[j, 1, i]) <= limit):
                x[j, 0, i] = 0
                x[j, 1, i] = 0
                bad += 1
    return bad


@compiled(nogil=True, error_model="numpy")
def mark(cube: Any, a: int, b: int, channels: Any, first: int, limit: float, good: Any) -> int:
    """Which voxels have data, good (N, n); returns the first channel with an absolute value above `limit`, or -1."""
    nx, infinite = cube.shape[3], -1
    for j in range(len(channels)):
        f = channels[j]
        for i in range(good.shape[1]):
            p, q = cube[f, a, (first + i) // nx, (first + i) % nx], cube[f, b, (first + i) // nx, (first + i) % nx]
            good[j, i] = not (np.isnan(p) or np.isnan(q))
            if infinite < 0 and (abs(p) > limit or abs(q) > limit):
                infinite = f
    return infinite


@compiled(nogil=True, error_model="numpy")
def divide(cube: Any, channels: Any, first: int, weights: Any, offset: Any, good: Any, x: Any, level: Any) -> None:
    """Divide x (N, 2, n) by Stokes I of the cube, take voxels without I > 0 out of `good`; I at offset 0 as level (n,).

    `offset` (N,) is ln(nu/nu0); the level is that of the power law fitted to I with the weights, of one channel I.
    """
    nx = cube.shape[3]
    for i in range(x.shape[2]):
        row, column = (first + i) // nx, (first + i) % nx
        s0, s1, s2, t0, t1 = 0.0, 0.0, 0.0, 0.0, 0.0
        for j in range(len(channels)):
            value = float(cube[channels[j], 0, row, column])
            if not (good[j, i] and value > 0 and np.isfinite(value)):
                good[j, i] = False
                x[j, 0, i] = 0
                x[j, 1, i] = 0
                continue
            x[j, 0, i] /= value
            x[j, 1, i] /= value
            w, d, v = weights[j], offset[j], np.log(value)
            s0 += w
            s1 += w * d
            s2 += w * d * d
            t0 += w * v
            t1 += w * v * d
        spread = s0 * s2 - s1 * s1
        if spread > 1e-12 * s0 * s2:
            level[i] = np.exp((s2 * t0 - s1 * t1) / spread)
        else:
            level[i] = np.exp(t0 / s0)


@compiled(nogil=True, error_model="numpy")
def combine(g: Any, index: Any, sign: Any, factor: Any, first: int, out: Any) -> None:
    """F of Q + iU at all depths from g (2, M, 2, n): rows cos and sin of M |phi|, columns Q and U; times factor (n,).

    F(+phi) = (CQ + SU) + i(CU - SQ), F(-phi) = (CQ - SU) + i(CU + SQ), into out (depths, pixels) from `first` on.
    """
    for k in range(len(index)):
        r, s = index[k], sign[k]
        for i in range(len(factor)):
            re = g[0, r, 0, i] + s * g[1, r, 1, i]
            im = g[0, r, 1, i] - s * g[1, r, 0, i]
            out[k, first + i] = complex(re * factor[i], im * factor[i])


@compiled(nogil=True, error_model="numpy")
def combine_real(g: Any, index: Any, sign: Any, factor: Any, first: int, out: Any) -> None:
    """F of a real Stokes parameter from g (2, M, 1, n): F(-phi) is the conjugate of F(phi)."""
    for k in range(len(index)):
        r, s = index[k], sign[k]
        for i in range(len(factor)):
            out[k, first + i] = complex(g[0, r, 0, i] * factor[i], -s * g[1, r, 0, i] * factor[i])


@compiled(nogil=True, error_model="numpy")
def brightest(data: Any, order: Any, first: int, power: Any, place: Any) -> None:
    """Largest |F|² (n,) over depths and its place in `order`, of pixels from `first` on; -1 where none is a number."""
    power[:] = -1.0
    place[:] = -1
    for k in range(len(order)):
        d = order[k]
        for i in range(len(power)):
            z = data[d, first + i]
            p = z.real * z.real + z.imag * z.imag
            if p > power[i]:
                power[i] = p
                place[i] = k


@compiled(nogil=True, error_model="numpy")
def has_data(cube: Any, a: int, b: int) -> Any:
    """Which channels (F,) have a voxel with data in planes a and b; looks no further than the first."""
    out = np.zeros(cube.shape[0], np.bool_)
    for f in range(cube.shape[0]):
        for row in range(cube.shape[2]):
            for column in range(cube.shape[3]):
                if not (np.isnan(cube[f, a, row, column]) or np.isnan(cube[f, b, row, column])):
                    out[f] = True
                    break
            if out[f]:
                break
    return out
