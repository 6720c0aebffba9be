"""Linear algebra that foreground removers share: covariance of channels, calm threads, projections on a subspace."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np

from instrument.errors import Outcome
from instrument.foreground.separation import Separation
from instrument.foreground.separation import apply as apply
from instrument.units import Bool, Float

RANGE = 1e-4  # of the largest eigenvalue that one covariance is trusted for: vectors of it are right to 1e-12
CHUNK = 16384  # pixels turned to float64 at once: 21 MB at 161 channels


@contextmanager
def one_thread() -> Iterator[None]:
    """BLAS in one thread: below 200 x 200 the threads cost more than they bring (eigh of 161: 2 to 30 times)."""
    from threadpoolctl import threadpool_limits

    with threadpool_limits(1, user_api="blas"):
        yield


def seen(maps: Any) -> Bool:
    """Pixels that are not a hole (Ny, Nx): holes are 0 in every channel."""
    return np.asarray(maps.any(axis=0))


def covariance(maps: Any, without: Float | None = None) -> Float:
    """X X^T / p of channels over the p pixels that are not holes (F, F), summed in float64 whatever the maps are.

    In float32 a component of 1e-3 of the brightest, 1e-6 of its power, is below the rounding of the sums. `without`
    are orthonormal spectra (F, n) taken off first.
    """
    x = maps.reshape(len(maps), -1)
    total = np.zeros((len(x), len(x)))
    for a in range(0, x.shape[1], CHUNK):
        part = x[:, a : a + CHUNK].astype(np.float64)
        if without is not None:
            part -= without @ (without.T @ part)
        total += part @ part.T
    return total / max(int(seen(maps).sum()), 1)


def leading(matrix: Float, n: int) -> tuple[Float, Float]:
    """The n largest eigenvalues (n,) and orthonormal eigenvectors (F, n) of a symmetric matrix, largest first."""
    from scipy.linalg import eigh

    size = len(matrix)
    if not n:
        return np.zeros(0), np.zeros((size, 0))
    power = int(np.frexp(np.abs(matrix).max())[1])  # of two: no digit changes, and the same steps at every scale
    with one_thread():
        values, vectors = eigh(np.ldexp(matrix, -power), subset_by_index=(size - n, size - 1))
    return np.ldexp(values[::-1], power), vectors[:, ::-1]


def principal(maps: Any, n: int) -> tuple[Float, Float]:
    """The n largest eigenvalues (n,) and eigenvectors (F, n) of the covariance of channels, whatever their range.

    A covariance holds powers down to 1e-16 of the largest, amplitudes of 1e-8. What lies below 1e-4 of the largest is
    therefore found in what is left of the maps without the vectors above it: a pixel of 1e12 hides nothing, and noise
    of 1 % of the foreground turns by 1e-12 with the order of the sums.
    """
    values, vectors = np.zeros(0), np.zeros((len(maps), 0))
    while len(values) < n:
        more, new = leading(covariance(maps, vectors if len(values) else None), n - len(values))
        sure = max(int((more > RANGE * more[0]).sum()), 1)
        # without what was found before, to rounding; with nothing left any directions complete the basis
        basis = np.linalg.qr(np.hstack([vectors, new[:, :sure]]))[0]
        values, vectors = np.append(values, np.maximum(more[:sure], 0.0)), basis
    return values, vectors


def pinv(matrix: Float) -> Float:
    """Inverse of a small symmetric matrix, eigenvalues floored at 1e-9 of the largest: finite for equal columns."""
    values, vectors = np.linalg.eigh(matrix)
    floor = max(1e-9 * values[-1], np.finfo(float).tiny)
    return np.asarray((vectors / np.maximum(values, floor)) @ vectors.T)


def projection(
    maps: Any, columns: Float, outcome: Outcome, remark: str, adapted: bool = True, rank: float = 1e-12
) -> Separation:
    """What a subspace of spectra holds of the maps: foreground = A A^+ X, for columns A (F, n).

    Mixing has unit columns of positive sum, ordered by the power of their components S = A^+ X. Directions below
    `rank` of the largest singular value of A are left out of A^+.
    """
    length = np.sqrt((columns**2).sum(axis=0))
    a = columns / np.where(length > 0, length, 1.0)
    a = a * np.where(a.sum(axis=0) < 0, -1.0, 1.0)
    left, size, right = np.linalg.svd(a, full_matrices=False)
    use = size > rank * size.max(initial=0)
    basis, unmix = left[:, use], (right[use].T / size[use]) @ left[:, use].T
    components = apply(unmix, maps)
    power = np.einsum("nyx,nyx->n", components, components, dtype=np.float64)
    order = np.argsort(-power, kind="stable")
    a, unmix, components = a[:, order], unmix[order], components[order]
    return Separation(outcome, remark, a, components, operator=basis @ basis.T, basis=basis, adapted=adapted)
