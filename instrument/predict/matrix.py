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
from instrument.predict.base import Predictor, Prepared, Problem, Work
from instrument.predict.time_nodes import EXACT
from instrument.predict.within import WHOLE, Way, quickest
from instrument.sky.points import points_of
from instrument.units import Complex, Int

FEW = 6  # groups of stations up to which products are made per pair of groups, and in 32 bit where that is allowed


class Matrix(Predictor):
    """Point and Gaussian sources through chains of any kind, (T, F, B, 2, 2), float64."""

    def refuses(self, problem: Problem) -> str | None:
        """Refuses skies that are not lists of sources."""
        return None if problem.sky.kind == "points" else "the sky is not a list of sources"

    def prepare(self, problem: Problem, tolerance: float) -> Prepared:
        """With a tolerance, array factors at few integrations and products of 32 bit, where that is quicker."""
        return quickest(self, problem, tolerance)

    def work(self, problem: Problem, way: Way = WHOLE) -> Work:
        """8 operations for each pair of stations, source and product (1 to 4 of them), and the beams before."""
        times, channels, _ = problem.shape
        stations, sources = problem.at.shape[2:]
        slots = times * channels
        shares = problem.chain.shares(problem.at.layout)
        products = _products(problem, shares)
        gemm = 8.0 * slots * sources * stations**2 * products
        parts = sum(term.phasors() for term in problem.chain.parts)
        # 40 operations for each sine and cosine (2.3 ns), 600 for each shared 2x2 matrix and source (250 ns)
        phasors = float(slots * sources * (stations + parts * way.panels.share))
        matrices = float(slots * sources * shares)
        between = 4.0 * slots * sources * stations * way.panels.between
        flops = gemm + 40 * phasors + 600 * matrices + between
        seconds = gemm / 25e9 + 4e-7 * matrices + (2.5e-9 + 4e-9) * slots * sources * stations
        # products of many groups are always of 64 bit
        seconds -= 0.5 * gemm / 25e9 if way.single and shares <= FEW else 0.0
        seconds += slots * sources * way.panels.seconds(parts, stations)
        seconds += 4e-7 * slots * len(problem.antenna1)  # sorting products into baselines
        scalars = 16 * stations * sources
        shared = 64 * shares * sources * (8 if shares <= FEW else 4)
        wide = 16 * 8 * stations * sources if shares > FEW else 0
        held = slots * (3.2 * scalars + shared + wide + 24 * 8 * sources + 64 * 2.1 * len(problem.antenna1))
        return Work(flops, 0.0, held, seconds)

    def sums(self, problem: Problem, way: Way = WHOLE) -> Complex:
        """Visibilities in Jy, complex (T, F, B, 2, 2)."""
        at = problem.at
        times, channels, stations, sources = at.shape
        uvw = at.uvw_m[:, None] * (at.freq_hz[:, None, None] / LIGHT)
        z = station_phases(uvw.reshape(-1, stations, 3), at.lmn).reshape(times, channels, stations, sources)
        moving = [] if way.panels == EXACT else [term for term, _ in problem.chain.moving(at, 0)]
        if moving:
            way.panels.multiply(z, at, moving)
        factors = problem.chain.factors(at, moving)
        if factors.scalar is not None:
            z *= factors.scalar
        sky = np.broadcast_to(problem.sky.brightness(at), (times, channels, sources, 2, 2))
        out = np.zeros((*problem.shape, 2, 2), complex)
        listed = points_of(problem.sky)
        assert listed is not None  # or it would have been refused
        points, shaped = np.flatnonzero(~listed.gaussian), np.flatnonzero(listed.gaussian)
        if len(points):
            whole = len(points) == sources
            _point_sums(problem, factors, z, sky, slice(None) if whole else points, out, way.single)
        if len(shaped):
            axes = listed.shape_axes(at.centre)[shaped]
            _gaussian_sums(problem, factors, z[..., shaped], sky[:, :, shaped], shaped, axes, uvw, out)
        if factors.outer is not None:
            g = np.broadcast_to(factors.outer[:, :, :, 0], (times, channels, stations, 2, 2))
            out = mat2.between(g, out, problem.antenna1, problem.antenna2)
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


def _point_sums(
    problem: Problem, factors: Factors, z: Complex, sky: Complex, rows: Any, out: Complex, single: bool
) -> None:
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
    # stations of a group side by side, so that products are of slices
    order = np.argsort(factors.group, kind="stable")
    place = np.argsort(order)
    index = place[problem.antenna1] * stations + place[problem.antenna2]
    ends = np.searchsorted(factors.group[order], np.arange(groups + 1))
    z = z if groups == 1 else z[:, :, order]
    blocks: list[Any] = []
    for g in range(groups):
        for h in range(g, groups):
            c = sky if m is None else mat2.mul(mat2.mul(m[:, :, g], sky), mat2.herm(m[:, :, h]))
            span = slice(ends[g], ends[g + 1]), slice(ends[h], ends[h + 1])
            blocks.append((span, _entries(c, same=g == h), np.ascontiguousarray(np.moveaxis(c, (3, 4), (0, 1)))))
    size = np.float64(1.0)
    if single:  # no flux is too large or too small for 32 bit
        size = np.float64(max(np.abs(c).max() for _, _, c in blocks))
        z, blocks = z.astype(np.complex64), [(*block, (c / size).astype(np.complex64)) for *block, c in blocks]
    full = np.zeros((2, 2, stations, stations), z.dtype)
    found = np.empty((4, len(index)), z.dtype)
    for t in range(times):
        for f in range(channels):
            right = z[t, f].conj().T
            for (of_g, of_h), wanted, c in blocks:
                for i, j, source in wanted:
                    if source is None:
                        np.matmul(z[t, f, of_g] * c[i, j, t, f], right[:, of_h], out=full[i, j, of_g, of_h])
                    elif source == (j, i) and i != j:  # C is Hermitian, so this product is the other one's
                        full[i, j, of_g, of_h] = full[j, i, of_g, of_h].conj().T
                    elif source != (i, j):  # else it is zero, and stays it
                        full[i, j, of_g, of_h] = full[(*source, of_g, of_h)]
                if of_g != of_h:  # V_ab = V_ba^H
                    full[:, :, of_h, of_g] = full[:, :, of_g, of_h].conj().transpose(1, 0, 3, 2)
            np.take(full.reshape(4, -1), index, axis=1, out=found)
            out[t, f] += (size * found if single else found).T.reshape(-1, 2, 2)


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
