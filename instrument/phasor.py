"""Sums of exp(2 pi i phase), compiled: array factors of phased stations, and the phases of stations on the sky.

Phases are in cycles. They are formed in float64, reduced modulo 1 and only then turned into a sine and a cosine by
polynomials (below 1e-16), which the compiler turns into vector instructions: about 2 ns each. The slow twins are
`array_factor_reference` and `station_phases_reference`; tests/accuracy/test_phasor.py holds them together.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from instrument.compiled import compiled, inlined
from instrument.units import Complex, Float

FAST = {"contract", "nsz", "nnan", "ninf"}  # no reassociation: sums keep their order, so results repeat
CHUNK = 256


@inlined
def cis(cycles: float) -> Any:
    """Cosine and sine of 2 pi `cycles`; Taylor series on an eighth of a turn, error below 1.2e-16."""
    q = np.rint(4.0 * cycles)
    x = (cycles - 0.25 * q) * (2.0 * math.pi)
    z = x * x
    s = -7.647163731819816e-13
    for c in (1.6059043836821613e-10, -2.505210838544172e-8, 2.7557319223985893e-6, -1.984126984126984e-4):
        s = s * z + c
    s = x * (1.0 + z * (-1.6666666666666666e-1 + z * (8.333333333333333e-3 + z * s)))
    c = 4.779477332387385e-14
    for d in (-1.1470745597729725e-11, 2.08767569878681e-9, -2.755731922398589e-7, 2.48015873015873e-5):
        c = c * z + d
    c = 1.0 + z * (-0.5 + z * (4.1666666666666664e-2 + z * (-1.388888888888889e-3 + z * c)))
    k = q - 4.0 * np.floor(0.25 * q)
    odd = k == 1.0 or k == 3.0
    cosine = s if odd else c
    sine = c if odd else s
    cosine = -cosine if (k == 1.0 or k == 2.0) else cosine
    sine = -sine if k >= 2.0 else sine
    return cosine, sine


@compiled(nogil=True, fastmath=FAST, error_model="numpy")
def _array_factor(waves: Any, offsets: Any, out: Any) -> None:
    rows, _, count = waves.shape
    units, parts, _ = offsets.shape
    re = np.empty(CHUNK)
    im = np.empty(CHUNK)
    for b in range(rows):
        for first in range(0, count, CHUNK):
            n = min(CHUNK, count - first)
            for u in range(units):
                re[:n] = 0.0
                im[:n] = 0.0
                for m in range(parts):
                    x, y, z = offsets[u, m, 0], offsets[u, m, 1], offsets[u, m, 2]
                    for i in range(n):
                        c, s = cis(waves[b, 0, first + i] * x + waves[b, 1, first + i] * y + waves[b, 2, first + i] * z)
                        re[i] += c
                        im[i] += s
                for i in range(n):
                    out[b, u, first + i] = complex(re[i] / parts, im[i] / parts)


def array_factor(waves: Float, offsets_m: Float) -> Complex:
    """Mean over parts of exp(2 pi i waves . offset), complex (N, U, S).

    `waves` (N, 3, S) in cycles per m, `offsets_m` (U, M, 3): M parts of U different stations.
    """
    out = np.empty((waves.shape[0], offsets_m.shape[0], waves.shape[2]), complex)
    _array_factor(np.ascontiguousarray(waves), np.ascontiguousarray(offsets_m), out)
    return out


def array_factor_reference(waves: Float, offsets_m: Float) -> Complex:
    """The same by numpy: the definition."""
    return np.asarray(np.exp(2j * np.pi * np.einsum("ncs,umc->nums", waves, offsets_m)).mean(axis=2))


@compiled(nogil=True, fastmath=FAST, error_model="numpy")
def _station_phases(uvw: Any, lmn: Any, out: Any) -> None:
    rows, stations, _ = uvw.shape
    count = lmn.shape[1]
    for b in range(rows):
        for a in range(stations):
            u, v, w = uvw[b, a, 0], uvw[b, a, 1], uvw[b, a, 2]
            for i in range(count):
                c, s = cis(-(u * lmn[0, i] + v * lmn[1, i] + w * lmn[2, i]))
                out[b, a, i] = complex(c, s)


def station_phases(uvw_lambda: Float, lmn: Float) -> Complex:
    """exp(-2 pi i (u l + v m + w (n - 1))) of stations, complex (N, A, S).

    `uvw_lambda` (N, A, 3) in wavelengths, `lmn` (S, 3) holding l, m and n - 1.
    """
    out = np.empty((*uvw_lambda.shape[:2], lmn.shape[0]), complex)
    _station_phases(np.ascontiguousarray(uvw_lambda), np.ascontiguousarray(lmn.T), out)
    return out


def station_phases_reference(uvw_lambda: Float, lmn: Float) -> Complex:
    """The same by numpy: the definition; cycles reduced modulo 1 in float64 first."""
    cycles = uvw_lambda @ lmn.T
    return np.asarray(np.exp(-2j * np.pi * (cycles - np.rint(cycles))))
