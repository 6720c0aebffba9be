"""Matrix: a point sky as one BLAS product per time and channel, V = Z diag(C) Z^H.

The chain is written as (number per station) x (matrix shared by a group of stations); the shared matrices are absorbed
into the brightness, C_gh = M_g B M_h^H, and Z = number x fringe is (stations, sources). The sky is never factored as a
square root: one with P > I has none. The slow twin is `direct.py`; tests/accuracy/test_agreement.py compares them.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from instrument import mat2
from instrument.compiled import compiled
from instrument.jones.chain import Factors
from instrument.observe.directions import LIGHT
from instrument.phasor import FAST, station_phases
from instrument.predict.base import Predictor, Problem, Work
from instrument.sky.points import points_of
from instrument.units import Complex, Int

FEW = 6  # groups of stations up to which products are made per pair of groups


class Matrix(Predictor):
    """Point and Gaussian sources through chains of any kind, (T, F, B, 2, 2), float64."""

    def refuses(self, problem: Problem) -> str | None:
        """Refuses skies that are not lists of sources."""
        return None if problem.sky.kind == "points" else "the sky is not a list of sources"

    def work(self, problem: Problem) -> Work:
        """8 operations for each pair of stations, source and product (1 to 4 of them), and the beams before."""
        times, channels, _ = problem.shape
        stations, sources = problem.at.shape[2:]
        slots = times * channels
        shares = problem.chain.shares(problem.at.layout)
        products = _products(problem, shares)
        gemm = 8.0 * slots * sources * stations**2 * products
        parts = sum(term.phasors() for term in problem.chain.parts)
        # 40 operations for each sine and cosine (2.3 ns), 600 for each shared 2x2 matrix and source (250 ns)
        phasors = float(slots * sources * (stations + parts))
        matrices = float(slots * sources * shares)
        flops = gemm + 40 * phasors + 600 * matrices
        seconds = gemm / 25e9 + 2.5e-9 * phasors + 4e-7 * matrices + 4e-9 * slots * sources * stations
        seconds += 4e-7 * slots * len(problem.antenna1)  # sorting products into baselines
        scalars = 16 * stations * sources
        shared = 64 * shares * sources * (8 if shares <= FEW else 4)
        wide = 16 * 8 * stations * sources if shares > FEW else 0
        held = slots * (3.2 * scalars + shared + wide + 24 * 8 * sources + 64 * 2.1 * len(problem.antenna1))
        return Work(flops, 0.0, held, seconds)

    def sums(self, problem: Problem) -> Complex:
        """Visibilities in Jy, complex (T, F, B, 2, 2)."""
        at = problem.at
        times, channels, stations, sources = at.shape
        uvw = at.uvw_m[:, None] * (at.freq_hz[:, None, None] / LIGHT)
        z = station_phases(uvw.reshape(-1, stations, 3), at.lmn).reshape(times, channels, stations, sources)
        factors = problem.chain.factors(at)
        if factors.scalar is not None:
            z *= factors.scalar
        sky = np.broadcast_to(problem.sky.brightness(at), (times, channels, sources, 2, 2))
        out = np.zeros((*problem.shape, 2, 2), complex)
        listed = points_of(problem.sky)
        assert listed is not None  # or it would have been refused
        points, shaped = np.flatnonzero(~listed.gaussian), np.flatnonzero(listed.gaussian)
        if len(points):
            whole = len(points) == sources
            _point_sums(problem, factors, z, sky, slice(None) if whole else points, out)
        if len(shaped):
            axes = listed.shape_axes(at.centre)[shaped]
            _gaussian_sums(problem, factors, z[..., shaped], sky[:, :, shaped], shaped, axes, uvw, out)
        if factors.outer is not None:
            g = np.broadcast_to(factors.outer[:, :, :, 0], (times, channels, stations, 2, 2))
            out = mat2.sandwich(g[:, :, problem.antenna1], out, g[:, :, problem.antenna2])
        return out


def _products(problem: Problem, shares: int) -> float:
    """How many (A, S) x (S, A) products each time and channel needs."""
    polarized = problem.sky.nonzero(problem.at.freq_hz)
    structure = problem.chain.structure
    if shares <= FEW:
        if structure == "scalar" and not any(polarized[1:]):
            return 1
        if structure != "full" and not any(polarized[2:]):
            return 2
        return 3 if shares == 1 else 3.1
    return 8


def _point_sums(problem: Problem, factors: Factors, z: Complex, sky: Complex, rows: Any, out: Complex) -> None:
    times, channels, stations, _ = z.shape
    if not isinstance(rows, slice):
        z, sky = np.ascontiguousarray(z[..., rows]), sky[:, :, rows]
    m = factors.shared
    if m is not None:
        m = np.broadcast_to(m, (times, channels, *m.shape[2:]))
        m = m if m.shape[3] == 1 or isinstance(rows, slice) else m[:, :, :, rows]
    groups = int(factors.group.max()) + 1
    if groups > FEW:
        assert m is not None
        _wide(problem, z, mat2.mul(m, sky[:, :, None]), m, out)
        return
    members = [np.flatnonzero(factors.group == g) for g in range(groups)]
    full = np.empty((stations, stations, 2, 2), complex)
    for g, of_g in enumerate(members):
        for h in range(g, groups):
            of_h = members[h]
            c = sky if m is None else mat2.mul(mat2.mul(m[:, :, g], sky), mat2.herm(m[:, :, h]))
            wanted = _entries(c, same=g == h)
            # baselines of these two groups, in either order of their stations
            forward = np.flatnonzero(np.isin(problem.antenna1, of_g) & np.isin(problem.antenna2, of_h))
            back = np.flatnonzero(np.isin(problem.antenna1, of_h) & np.isin(problem.antenna2, of_g))
            if g == h:
                back = back[:0]
            block: Any = np.ix_(of_g, of_h)
            for t in range(times):
                for f in range(channels):
                    zg = z[t, f] if groups == 1 else z[t, f, of_g]
                    zh = zg if g == h else z[t, f, of_h]
                    right = zh.conj().T
                    for i, j, source in wanted:
                        if source is None:
                            full[(*block, i, j)] = (zg * c[t, f, :, i, j]) @ right
                        elif source == (i, j):
                            full[(*block, i, j)] = 0.0
                        elif source == (j, i) and i != j:  # C is Hermitian, so this product is the other one's
                            full[(*block, i, j)] = full[(*block, j, i)].conj().T
                        else:
                            full[(*block, i, j)] = full[(*block, *source)]
                    out[t, f, forward] += full[problem.antenna1[forward], problem.antenna2[forward]]
                    if len(back):  # V_ab = V_ba^H
                        out[t, f, back] += mat2.herm(full[problem.antenna2[back], problem.antenna1[back]])


def _entries(c: Complex, same: bool) -> list[tuple[int, int, tuple[int, int] | None]]:
    """Products needed for C (T, F, S, 2, 2): (row, column, `None` to compute, itself for zero, another entry to copy).

    Exact: an entry is left out only where it is exactly zero or exactly equal to another everywhere.
    """
    found: list[tuple[int, int, tuple[int, int] | None]] = [(0, 0, None)]
    found.append((1, 1, (0, 0) if np.array_equal(c[..., 0, 0], c[..., 1, 1]) else None))
    found.append((0, 1, None if c[..., 0, 1].any() else (0, 1)))
    if not c[..., 1, 0].any():
        found.append((1, 0, (1, 0)))
    else:
        found.append((1, 0, (0, 1) if same else None))
    return found


def _wide(problem: Problem, z: Complex, mb: Complex, m: Complex, out: Complex) -> None:
    """Every station has its own matrices: one product (2A, 2S) x (2S, 2A) per time and channel."""
    times, channels, stations, sources = z.shape
    a, b = problem.antenna1, problem.antenna2
    for t in range(times):
        for f in range(channels):
            zt = z[t, f, :, :, None, None]
            left = np.ascontiguousarray((zt * mb[t, f]).transpose(0, 2, 1, 3)).reshape(2 * stations, 2 * sources)
            right = np.ascontiguousarray((zt * m[t, f]).transpose(0, 2, 1, 3)).reshape(2 * stations, 2 * sources)
            v = (left @ right.conj().T).reshape(stations, 2, stations, 2)
            out[t, f] += v[a, :, b, :]


def _gaussian_sums(
    problem: Problem, factors: Factors, z: Complex, sky: Complex, rows: Int, axes: Any, uvw: Any, out: Complex
) -> None:
    """Sources with shapes, baseline by baseline: their envelope differs for each, so no product of stations serves."""
    times, channels, stations, count = z.shape
    m = factors.shared
    if m is None:
        m = mat2.IDENTITY.reshape(1, 1, 1, 1, 2, 2)
    m = np.broadcast_to(m, (times, channels, m.shape[2], problem.at.shape[3], 2, 2))[:, :, :, rows]
    own = m[:, :, factors.group]
    right = z[..., None, None] * own
    left = mat2.mul(right, sky[:, :, None])
    slots = times * channels
    _envelope_sum(
        np.ascontiguousarray(left).reshape(slots, stations, count, 2, 2),
        np.ascontiguousarray(right).reshape(slots, stations, count, 2, 2),
        np.ascontiguousarray(uvw).reshape(slots, stations, 3),
        np.ascontiguousarray(axes),
        problem.antenna1,
        problem.antenna2,
        out.reshape(slots, len(problem.antenna1), 2, 2),
    )


@compiled(nogil=True, fastmath=FAST, error_model="numpy")
def _envelope_sum(left: Any, right: Any, uvw: Any, axes: Any, a1: Any, a2: Any, out: Any) -> None:
    scale = -2.0 * math.pi**2
    for n in range(left.shape[0]):
        for b in range(len(a1)):
            p, q = a1[b], a2[b]
            u = uvw[n, p, 0] - uvw[n, q, 0]
            v = uvw[n, p, 1] - uvw[n, q, 1]
            w = uvw[n, p, 2] - uvw[n, q, 2]
            for s in range(left.shape[2]):
                x = u * axes[s, 0, 0] + v * axes[s, 0, 1] + w * axes[s, 0, 2]
                y = u * axes[s, 1, 0] + v * axes[s, 1, 1] + w * axes[s, 1, 2]
                e = math.exp(scale * (x * x + y * y))
                for i in range(2):
                    for j in range(2):
                        total = left[n, p, s, i, 0] * np.conj(right[n, q, s, j, 0])
                        total += left[n, p, s, i, 1] * np.conj(right[n, q, s, j, 1])
                        out[n, b, i, j] += e * total
