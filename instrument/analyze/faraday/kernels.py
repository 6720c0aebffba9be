"""Compiled loops of Faraday synthesis over pixels: gather and flag, combine products, fit Stokes I, find peaks.

Slow twins are the plain sums of tests/accuracy/test_faraday.py. No `fastmath` that assumes finite numbers: NaN is data.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from instrument.compiled import compiled

CLEAR = 10.0  # times its noise: voxels of I as faint as that are not divided by, 1/I of 10 sigma is biased by 1 %
SLOPE = 3.0  # scatter of spectral indices where I is too faint to tell
POINTS = 13  # depths through which F is interpolated about a peak: to 1e-6 of it at steps of FWHM / 4


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
def channel_scatter(values: Any, order: Any) -> float:
    """Noise of a channel (N,), from the median square of the second differences in `order`; 0 of fewer than three."""
    there = order[np.isfinite(values[order])]
    if len(there) < 3:
        return 0.0
    v = values[there]
    return np.sqrt(np.median((v[:-2] - 2 * v[1:-1] + v[2:]) ** 2) / (6 * 0.4549))  # of chi² with one degree


@compiled(nogil=True, error_model="numpy")
def power_law(values: Any, weights: Any, offset: Any, sigma: float) -> Any:
    """A and s of A exp(s offset), least squares of values (N,) as they are: those below 0 count, NaN does not.

    A slope that the noise `sigma` leaves open is held by a prior of 0 +- SLOPE. A is NaN without a value.
    """
    total, mean = 0.0, 0.0
    for j in range(len(values)):
        if not np.isnan(values[j]):
            total += weights[j]
            mean += weights[j] * values[j]
    if not total > 0:
        return np.nan, 0.0
    amplitude, slope = mean / total, 0.0
    hold = (sigma / SLOPE) ** 2 * total / len(values)
    for _ in range(30):
        aa, ab, bb, ra, rb = 0.0, 0.0, hold, 0.0, -hold * slope
        for j in range(len(values)):
            if np.isnan(values[j]):
                continue
            w, e = weights[j], np.exp(slope * offset[j])
            b = amplitude * offset[j] * e
            left = values[j] - amplitude * e
            aa += w * e * e
            ab += w * e * b
            bb += w * b * b
            ra += w * e * left
            rb += w * b * left
        det = aa * bb - ab * ab
        if not det > 1e-12 * aa * bb:  # one channel
            amplitude += ra / aa
            break
        more = (bb * ra - ab * rb) / det
        turn = min(max((aa * rb - ab * ra) / det, -1.0), 1.0)
        amplitude, slope = amplitude + more, min(max(slope + turn, -10.0), 10.0)
        if abs(more) <= 1e-14 * abs(amplitude) and abs(turn) <= 1e-14:
            break
    return amplitude, slope


@compiled(nogil=True, error_model="numpy")
def divide(cube: Any, channels: Any, first: int, axis: Any, fit: int, good: Any, x: Any, level: Any) -> None:
    """Divide x (N, 2, n) by Stokes I of the cube, as level (n,) at offset 0.

    `axis` are of the channels (N,) the weights, the offset ln(nu/nu0), and their order by frequency.

    `fit` 0 divides each voxel by its own I and takes voxels without I > 0 out of `good`; 1 divides by the power law
    fitted to I of the pixel, and takes pixels without a positive one out; 2 fits where I is below CLEAR times its
    noise, the median of differences of neighbours in `order`. The level is that of the power law, of one channel I.
    """
    nx = cube.shape[3]
    weights, offset, order = axis
    values = np.empty(len(channels))
    for i in range(x.shape[2]):
        row, column = (first + i) // nx, (first + i) % nx
        for j in range(len(channels)):
            values[j] = cube[channels[j], 0, row, column]
            if not np.isfinite(values[j]):
                values[j] = np.nan
        sigma = channel_scatter(values, order)
        amplitude, slope = power_law(values, weights, offset, sigma)
        smooth = fit == 1 or (fit == 2 and amplitude < CLEAR * sigma)
        if smooth:
            level[i] = amplitude
            for j in range(len(channels)):
                shape = np.exp(slope * offset[j])
                if not amplitude > 0:
                    good[j, i] = False
                    shape = np.inf
                else:
                    shape *= amplitude
                x[j, 0, i] /= shape
                x[j, 1, i] /= shape
            continue
        s0, s1, s2, t0, t1 = 0.0, 0.0, 0.0, 0.0, 0.0
        for j in range(len(channels)):
            value = values[j]
            if not (good[j, i] and value > 0):
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
def summit(data: Any, axis: Any, turn: float, pixels: Any, place: Any, depth: Any, value: Any) -> None:
    """Depth (n,) and F (n,) of the largest |F| about `place` (n,) of some pixels, of F in order of growing phi (P,).

    F turned by exp(i turn phi), so that it hardly rotates, goes through a polynomial of the POINTS nearest depths in
    the same piece of the axis. `axis` are the order, phi, and (2, P) where the piece of each depth begins and ends.
    """
    order, phi, ends = axis
    z, x, share = np.empty(POINTS, np.complex128), np.empty(POINTS), np.empty(3, np.complex128)
    for i in range(len(pixels)):
        p, k = pixels[i], place[i]
        begin, end = ends[0, k], ends[1, k]
        many = min(POINTS, end - begin)
        a = min(max(k - many // 2, begin), end - many)
        for m in range(many):
            x[m] = phi[a + m] - phi[k]
            angle = turn * x[m]
            z[m] = data[order[a + m], p] * complex(np.cos(angle), np.sin(angle))
        low, high = phi[k - 1] - phi[k], phi[k + 1] - phi[k]
        # a parabola through the three values, then through ever nearer ones of the polynomial
        at, d = 0.0, min(-low, high) / 2
        for step in range(20):
            for side in range(3):
                here = at + (side - 1) * d
                share[side] = 0
                for m in range(many):
                    weight = 1.0
                    for q in range(many):
                        if q != m:
                            weight *= (here - x[q]) / (x[m] - x[q])
                    share[side] += weight * z[m]
            down, top, up = abs(share[0]) ** 2, abs(share[1]) ** 2, abs(share[2]) ** 2
            if step == 19 or d < 2e-4 * min(-low, high):
                break
            curve = down - 2 * top + up
            move = 0.5 * d * (down - up) / curve if curve < 0 else (d if up > down else -d)
            d, move = (d / 4, move) if abs(move) < d else (d, min(max(move, -d), d))
            at = min(max(at + move, low), high)
        depth[i] = phi[k] + at
        angle = -turn * at
        value[i] = share[1] * complex(np.cos(angle), np.sin(angle))


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
