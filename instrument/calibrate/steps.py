"""Steps J_a exp(e_a) of the matrices of an interval, compiled: their gradient, their length, where they lead."""

from __future__ import annotations

from typing import Any

import numpy as np

from instrument.compiled import compiled, inlined


@inlined
def _exponential(e: Any) -> Any:
    """exp of a 2x2 matrix as `mat2.exponential`: exp(t) (cosh(d) 1 + sinh(d) / d H)."""
    half = (e[0, 0] + e[1, 1]) / 2
    h = (e[0, 0] - e[1, 1]) / 2
    d = np.sqrt(h * h + e[0, 1] * e[1, 0])
    ratio = np.sinh(d) / d if abs(d) > 1e-5 else 1 + d * d / 6
    size, whole = np.exp(half), np.cosh(d)
    return size * (whole + ratio * h), size * ratio * e[0, 1], size * ratio * e[1, 0], size * (whole - ratio * h)


@compiled(nogil=True, error_model="numpy")
def downhill(jones: Any, left_over: Any, tangents: Any, pull: Any, out: Any) -> None:
    """J^H (L - sum_n pull_n T_n) of stations: the gradient (A, 2, 2) for what is left over, and what a prior pulls."""
    left = np.empty((2, 2), np.complex128)
    for a in range(len(jones)):
        for i in range(2):
            for j in range(2):
                left[i, j] = left_over[a, i, j]
                for n in range(len(pull)):
                    left[i, j] -= pull[n] * tangents[n, a, i, j]
        for i in range(2):
            for j in range(2):
                out[a, i, j] = np.conj(jones[a, 0, i]) * left[0, j] + np.conj(jones[a, 1, i]) * left[1, j]


@compiled(nogil=True, error_model="numpy")
def lengths(jones: Any, step: Any, active: Any, generators: Any, hidden: Any) -> Any:
    """Largest change of a matrix by J e relative to itself, and the largest |e|.

    What all stations have in common along directions that data hardly see does not count: hidden (n, n) projects the
    coordinates of generators (n, 2, 2) onto them. Matrices below 1e-12 of the largest do not count either.
    """
    common = np.zeros((2, 2), np.complex128)
    count = 0
    for a in range(len(jones)):
        if active[a]:
            count += 1
            for i in range(2):
                for j in range(2):
                    common[i, j] += step[a, i, j]
    mean = common / max(count, 1)
    y = np.zeros(len(generators))
    for n in range(len(generators)):
        for i in range(2):
            for j in range(2):
                y[n] += (np.conj(generators[n, i, j]) * mean[i, j]).real / 2
    common[:] = 0
    for n in range(len(generators)):
        for m in range(len(generators)):
            for i in range(2):
                for j in range(2):
                    common[i, j] += hidden[n, m] * y[m] * generators[n, i, j]
    largest = 0.0
    for a in range(len(jones)):
        largest = max(largest, _power(jones[a]))
    floor = max(1e-24 * largest, 1e-300)
    moved, long = 0.0, 0.0
    change = np.empty((2, 2), np.complex128)
    for a in range(len(jones)):
        long = max(long, _power(step[a]))
        size = _power(jones[a])
        if size > floor:
            for i in range(2):
                for j in range(2):
                    change[i, j] = jones[a, i, 0] * (step[a, 0, j] - common[0, j]) + jones[a, i, 1] * (
                        step[a, 1, j] - common[1, j]
                    )
            moved = max(moved, _power(change) / size)
    return np.sqrt(moved), np.sqrt(long)


@compiled(nogil=True, error_model="numpy")
def turned(jones: Any, step: Any, share: float, out: Any) -> None:
    """J exp(share e) of stations, (A, 2, 2)."""
    e = np.empty((2, 2), np.complex128)
    for a in range(len(jones)):
        for i in range(2):
            for j in range(2):
                e[i, j] = share * step[a, i, j]
        e00, e01, e10, e11 = _exponential(e)
        for i in range(2):
            out[a, i, 0] = jones[a, i, 0] * e00 + jones[a, i, 1] * e10
            out[a, i, 1] = jones[a, i, 0] * e01 + jones[a, i, 1] * e11


@inlined
def _power(x: Any) -> float:
    total = 0.0
    for i in range(2):
        for j in range(2):
            total += x[i, j].real * x[i, j].real + x[i, j].imag * x[i, j].imag
    return total
