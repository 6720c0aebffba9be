"""The starlet transform (isotropic undecimated B3-spline wavelets) of a stack of maps, compiled.

c_0 = map, c_{j+1} = h_j * c_j with h = (1, 4, 6, 4, 1)/16 along both axes, taps 2^j apart, edges mirrored;
w_j = c_j - c_{j+1}, and the map is the sum of all w and the last c, exactly (Starck, Fadili & Murtagh 2007, IEEE Trans.
Image Proc. 16, 297). The slow twin is `starlet_reference`; tests/accuracy/test_foregrounds.py compares them.
"""

from __future__ import annotations

import os
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import numpy as np

from instrument.compiled import compiled
from instrument.units import Float

# rms of w_j, and of c_{j+1}, of white noise of rms 1 in two dimensions far from edges: means of the squared transfer
GAINS = (0.890796, 0.200664, 0.085508, 0.041217, 0.020425, 0.010190, 0.005092, 0.002546)
SMOOTH = (0.273438, 0.123474, 0.060359, 0.030015, 0.014987, 0.007491, 0.003745, 0.001873)


@compiled(nogil=True)
def _mirror(i: int, n: int) -> int:
    """Index of a mirrored axis: ... 2 1 0 1 2 ... n-2 n-1 n-2 ..."""
    if n == 1:
        return 0
    i = abs(i) % (2 * n - 2)
    return i if i < n else 2 * n - 2 - i


@compiled(nogil=True, fastmath=True)
def _smooth(source: Any, rows: Any, out: Any, step: int) -> None:
    ny, nx = source.shape
    a, b, c = source.dtype.type(0.0625), source.dtype.type(0.25), source.dtype.type(0.375)
    for y in range(ny):
        p, q = _mirror(y - 2 * step, ny), _mirror(y - step, ny)
        r, s = _mirror(y + step, ny), _mirror(y + 2 * step, ny)
        for x in range(nx):
            rows[y, x] = a * (source[p, x] + source[s, x]) + b * (source[q, x] + source[r, x]) + c * source[y, x]
    edge = min(2 * step, nx)
    for y in range(ny):
        row = rows[y]
        for x in range(edge, nx - edge):
            out[y, x] = a * (row[x - 2 * step] + row[x + 2 * step]) + b * (row[x - step] + row[x + step]) + c * row[x]
        for x in range(nx):
            if x < edge or x >= nx - edge:
                far = row[_mirror(x - 2 * step, nx)] + row[_mirror(x + 2 * step, nx)]
                near = row[_mirror(x - step, nx)] + row[_mirror(x + step, nx)]
                out[y, x] = a * far + b * near + c * row[x]


@compiled(nogil=True)
def _starlet(image: Any, details: Any, last: Any) -> None:
    rows, smooth = np.empty_like(image), np.empty_like(image)
    last[:] = image
    for j in range(len(details)):
        _smooth(last, rows, smooth, 2**j)
        details[j] = last - smooth
        last[:] = smooth


def starlet(maps: Any, scales: int) -> tuple[Any, Any]:
    """Wavelet planes (n, scales, Ny, Nx) and the last smooth plane (n, Ny, Nx) of each map (n, Ny, Nx)."""
    images = np.ascontiguousarray(maps)
    details, last = np.empty((len(maps), scales, *maps.shape[1:]), maps.dtype), np.empty_like(images)
    with ThreadPoolExecutor(os.cpu_count() or 1) as pool:
        list(pool.map(_starlet, images, details, last))
    return details, last


def starlet_reference(maps: Float, scales: int) -> tuple[Float, Float]:
    """The same by scipy: the definition."""
    from scipy.ndimage import correlate1d

    out, now = [], np.asarray(maps, float)
    for j in range(scales):
        taps = np.zeros(4 * 2**j + 1)
        taps[:: 2**j] = np.array([1, 4, 6, 4, 1]) / 16
        smooth = correlate1d(correlate1d(now, taps, axis=1, mode="mirror"), taps, axis=2, mode="mirror")
        out.append(now - smooth)
        now = smooth
    return np.stack(out, axis=1), now
