"""Motion: bounds on how fast means of exp(i phase) and their products change, as derivatives by an angle."""

from __future__ import annotations

from math import comb

import numpy as np

from instrument.units import Float


def touchard(order: int, moments: Float) -> Float:
    """Mean of Touchard's polynomials T_n(a) for n = 0 ... order, (order + 1, ...), of moments <a^j> (order + 1, ...).

    |d^n exp(i phase)| <= T_n(a) where every derivative of the phase is at most a (Faa di Bruno; rates of 1).
    """
    second = np.zeros((order + 1, order + 1))  # Stirling's numbers
    second[0, 0] = 1.0
    for n in range(1, order + 1):
        for j in range(1, n + 1):
            second[n, j] = j * second[n - 1, j] + second[n - 1, j - 1]
    return np.tensordot(second, moments, axes=1)


def product(one: Float, other: Float) -> Float:
    """Bounds on derivatives 0 ... n of a product, of those of its factors (n + 1, ...): Leibniz."""
    return np.stack([sum(comb(n, j) * one[j] * other[n - j] for j in range(n + 1)) for n in range(len(one))])
