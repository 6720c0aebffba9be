"""The compiled loops of `separable_atom.py`: samples from cells, and cells from samples, through beams at all nodes.

Everything runs over arrays side by side (cells, degrees, nodes), and no sum is reordered, so results repeat.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from instrument.compiled import compiled, inlined
from instrument.phasor import FAST

CELLS, POINTS = 64, 6  # intervals of the table of a kernel, and the rows that each place is made of
_SHARES = np.array([1 / np.prod([float(i - j) for j in range(POINTS) if j != i]) for i in range(POINTS)])


class Places(NamedTuple):
    """Where samples are, in cells (N,) each from the first of the grid; which stand the other way round; the order."""

    u: Any
    v: Any
    w: Any
    turned: Any
    order: Any


class Tables(NamedTuple):
    """Weights of cells across (rows, W, D) and along w (rows, W, 4); series of nodes, (d + 1, D, K), (d + 1, K, D)."""

    across: Any
    deep: Any
    series: Any
    turned: Any


class Towards(NamedTuple):
    """Beams towards the nodes (A, instants, 8, K), real and imaginary parts apart, and weights between instants."""

    beams: Any
    step: int
    weights: Any
    one: Any
    other: Any
    slots: Any


@inlined
def _weights(at: Any, table: Any, out: Any) -> Any:
    """Fill `out` (W, D) with the weights of the cells about a place; the first of these cells."""
    width, columns = out.shape
    cell = int(np.floor(at))
    x = (at - cell) * CELLS
    row = min(int(x), CELLS - 1)
    x += POINTS // 2 - 1 - row
    flat, rows = out.ravel(), table.reshape(table.shape[0], width * columns)
    flat[:] = 0.0
    for i in range(POINTS):
        share = _SHARES[i]
        for j in range(POINTS):
            if j != i:
                share *= x - j
        for c in range(width * columns):
            flat[c] += share * rows[row + i, c]
    return cell - width // 2 + 1


@inlined
def _beam(towards: Any, station: Any, slot: Any, out: Any) -> None:
    """Fill `out` (8, K) with the beam of a station at a slot."""
    flat = out.ravel()
    size = len(flat)
    beams = towards.beams[station].reshape(towards.beams.shape[1], size)
    if towards.step == 0:
        for c in range(size):
            flat[c] = beams[slot, c]
        return
    first = slot // towards.step
    phase = slot - first * towards.step
    flat[:] = 0.0
    for q in range(towards.weights.shape[1]):
        share = towards.weights[phase, q]
        for c in range(size):
            flat[c] += share * beams[first + 1 + q, c]


@compiled(nogil=True, fastmath=FAST, error_model="numpy")
def read(grid: Any, places: Any, tables: Any, towards: Any, there: Any, out: Any) -> None:
    """Samples `out` (N, 4) of cells (nu, nw, nv 2n): the sums over nodes of J_a F J_b^H, F of n Stokes parameters."""
    width, columns = tables.across.shape[1:]
    depth, count = tables.deep.shape[1], 2 * len(there)
    degrees, nodes = tables.series.shape[0], tables.series.shape[2]
    ku, kv, kw = np.empty((width, columns)), np.empty((width, columns)), np.empty((depth, tables.deep.shape[2]))
    cells, half = np.empty((width, width * count)), np.empty((degrees, width * count))
    moments, seen = np.empty((count, columns)), np.empty((count, nodes))
    sky, a, b, between = np.empty((8, nodes)), np.empty((8, nodes)), np.empty((8, nodes)), np.empty((8, nodes))
    for s in places.order:
        u0, v0 = _weights(places.u[s], tables.across, ku), _weights(places.v[s], tables.across, kv)
        w0 = _weights(places.w[s], tables.deep, kw)
        cells[:] = 0.0
        for t in range(width):
            for p in range(depth):
                patch, share = grid[u0 + t, w0 + p, v0 * count : (v0 + width) * count], kw[p, 0]
                for y in range(width * count):
                    cells[t, y] += share * patch[y]
        half[:] = 0.0
        for i in range(degrees):
            for t in range(width):
                share = ku[t, i]
                for y in range(width * count):
                    half[i, y] += share * cells[t, y]
        seen[:] = 0.0
        for i in range(degrees):
            moments[:] = 0.0
            for y in range(width):
                for c in range(count):
                    share = half[i, y * count + c]
                    for j in range(columns):
                        moments[c, j] += share * kv[y, j]
            for j in range(degrees - i):
                odd = (i & 1) + (j & 1)  # times (-i)^odd
                for c in range(0, count, 2):
                    real, imag = moments[c, j], moments[c + 1, j]
                    if odd == 1:
                        real, imag = imag, -real
                    elif odd == 2:
                        real, imag = -real, -imag
                    for k in range(nodes):
                        seen[c, k] += real * tables.series[i, j, k]
                        seen[c + 1, k] += imag * tables.series[i, j, k]
        _brightness(seen, -1.0 if places.turned[s] else 1.0, there, sky)
        _beam(towards, towards.one[s], towards.slots[s], a)
        _beam(towards, towards.other[s], towards.slots[s], b)
        _product(a, sky, b, between)
        for e in range(4):
            real = imag = 0.0
            for k in range(nodes):
                real += sky[2 * e, k]
                imag += sky[2 * e + 1, k]
            out[s, e] = real + 1j * imag


@inlined
def _brightness(seen: Any, sign: Any, there: Any, sky: Any) -> None:
    """Fill `sky` (8, K) with pp, pq, qp, qq of Stokes parameters (2n, K), of their conjugates where the sign is -1."""
    sky[:] = 0.0
    for i in range(len(there)):
        stokes, real, imag = there[i], seen[2 * i], seen[2 * i + 1]
        one, other, odd = (0, 6, stokes == 1) if stokes < 2 else (2, 4, stokes == 3)
        second = -1.0 if odd else 1.0
        for k in range(sky.shape[1]):
            x, y = real[k], sign * imag[k]
            if stokes == 3:  # i V and -i V
                x, y = -y, x
            sky[one, k] += x
            sky[one + 1, k] += y
            sky[other, k] += second * x
            sky[other + 1, k] += second * y


@inlined
def _stokes(sky: Any, sign: Any, there: Any, seen: Any) -> None:
    """The adjoint of `_brightness`: Stokes parameters (2n, K) of pp, pq, qp, qq (8, K)."""
    for i in range(len(there)):
        stokes = there[i]
        one, other, odd = (0, 6, stokes == 1) if stokes < 2 else (2, 4, stokes == 3)
        second = -1.0 if odd else 1.0
        for k in range(sky.shape[1]):
            x = sky[one, k] + second * sky[other, k]
            y = sky[one + 1, k] + second * sky[other + 1, k]
            if stokes == 3:
                x, y = y, -x
            seen[2 * i, k] = x
            seen[2 * i + 1, k] = sign * y


@inlined
def _product(a: Any, x: Any, b: Any, between: Any) -> None:
    """Turn matrices x (8, K) into a x b^H, node by node; `between` (8, K) is overwritten."""
    nodes = a.shape[1]
    for row in range(0, 8, 4):
        for m in range(0, 4, 2):
            for k in range(nodes):
                p, q, r, s = a[row, k], a[row + 1, k], a[row + 2, k], a[row + 3, k]
                e, f, g, h = x[m, k], x[m + 1, k], x[m + 4, k], x[m + 5, k]
                between[row + m, k] = p * e - q * f + r * g - s * h
                between[row + m + 1, k] = p * f + q * e + r * h + s * g
    for row in range(0, 8, 4):
        for m in range(0, 8, 4):
            for k in range(nodes):
                p, q, r, s = between[row, k], between[row + 1, k], between[row + 2, k], between[row + 3, k]
                e, f, g, h = b[m, k], b[m + 1, k], b[m + 2, k], b[m + 3, k]
                x[row + m // 2, k] = p * e + q * f + r * g + s * h
                x[row + m // 2 + 1, k] = q * e - p * f + s * g - r * h


@inlined
def _dagger(a: Any) -> None:
    """Turn matrices a (8, K) into a^H."""
    for k in range(a.shape[1]):
        a[1, k], a[7, k] = -a[1, k], -a[7, k]
        a[2, k], a[3, k], a[4, k], a[5, k] = a[4, k], -a[5, k], a[2, k], -a[3, k]


@compiled(nogil=True, fastmath=FAST, error_model="numpy")
def write(grid: Any, places: Any, tables: Any, towards: Any, there: Any, data: Any) -> None:
    """The adjoint of `read`: add samples (N, 4) to cells (nu, nw, nv 2n)."""
    width, columns = tables.across.shape[1:]
    depth, count = tables.deep.shape[1], 2 * len(there)
    degrees, nodes = tables.series.shape[0], tables.series.shape[2]
    ku, kv, kw = np.empty((width, columns)), np.empty((width, columns)), np.empty((depth, tables.deep.shape[2]))
    turned, row, cells = np.empty((columns, width)), np.empty(count * width), np.empty(count * width)
    half, moments, seen = np.empty((degrees, count * width)), np.empty((count, columns)), np.empty((count, nodes))
    sky, a, b, between = np.empty((8, nodes)), np.empty((8, nodes)), np.empty((8, nodes)), np.empty((8, nodes))
    for s in places.order:
        u0, v0 = _weights(places.u[s], tables.across, ku), _weights(places.v[s], tables.across, kv)
        w0 = _weights(places.w[s], tables.deep, kw)
        for y in range(width):
            for j in range(columns):
                turned[j, y] = kv[y, j]
        _beam(towards, towards.one[s], towards.slots[s], a)
        _beam(towards, towards.other[s], towards.slots[s], b)
        _dagger(a)
        _dagger(b)
        for e in range(4):
            sky[2 * e], sky[2 * e + 1] = data[s, e].real, data[s, e].imag
        _product(a, sky, b, between)
        _stokes(sky, -1.0 if places.turned[s] else 1.0, there, seen)
        half[:] = 0.0
        for i in range(degrees):
            moments[:] = 0.0
            for c in range(count):
                for k in range(nodes):
                    share = seen[c, k]
                    for j in range(columns):
                        moments[c, j] += share * tables.turned[i, k, j]
            for j in range(degrees - i):
                odd = (i & 1) + (j & 1)  # times i^odd
                for c in range(0, count, 2):
                    real, imag = moments[c, j], moments[c + 1, j]
                    if odd == 1:
                        real, imag = -imag, real
                    elif odd == 2:
                        real, imag = -real, -imag
                    for y in range(width):
                        half[i, c * width + y] += real * turned[j, y]
                        half[i, (c + 1) * width + y] += imag * turned[j, y]
        for t in range(width):
            row[:] = 0.0
            for i in range(degrees):
                share = ku[t, i]
                for y in range(count * width):
                    row[y] += share * half[i, y]
            for c in range(count):
                for y in range(width):
                    cells[y * count + c] = row[c * width + y]
            for p in range(depth):
                patch, share = grid[u0 + t, w0 + p, v0 * count : (v0 + width) * count], kw[p, 0]
                for y in range(count * width):
                    patch[y] += share * cells[y]
