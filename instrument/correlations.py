"""Weights and flags of four correlations: of a visibility as a whole, of Stokes parameters, after Jones matrices."""

from __future__ import annotations

from typing import Any

import numpy as np

from instrument import mat2
from instrument.units import Bool, Complex, Float

ALL_FOUR = np.ones((2, 2), bool)
ALL_FOUR.setflags(write=False)
APART = 5  # axes of an array that has values for each correlation, (T, F, B, 2, 2)


def alike(first: Any, *others: Any) -> list[Any]:
    """Arrays (T, F, B) or (T, F, B, 2, 2) with the same number of axes: that of the largest."""
    most = max(x.ndim for x in (first, *others))
    return [x[..., None, None] if x.ndim < most else x for x in (first, *others)]


def either(one: Bool, other: Bool) -> Bool:
    """What one or the other flags, (T, F, B), or (T, F, B, 2, 2) where one of them is of correlations."""
    one, other = alike(one, other)
    return np.asarray(one | other)


def plain_axes(array: Any) -> Any:
    """Values (T, F, B, 1, 1) as (T, F, B), those constant along one axis of correlations as (T, F, B, 2, 2)."""
    if array.ndim != APART:
        return array
    if array.shape[3:] == (1, 1):
        return array[..., 0, 0]
    return np.broadcast_to(array, (*array.shape[:3], 2, 2)) if set(array.shape[3:]) == {1, 2} else array


def whole(weight: Float, of: Bool = ALL_FOUR) -> Float:
    """Weights (T, F, B) of visibilities as a whole, of those of correlations: the harmonic mean, 0 where one is 0.

    That is the inverse of the mean variance, so four that are alike stay as they are. With `of` (2, 2) of some only.
    """
    return weight if weight.ndim < APART else _harmonic(weight[..., of])


def of_stokes(weight: Float) -> Float:
    """Weights of I, Q, U, V, (T, F, B, 4), or (T, F, B, 1) where one weight holds for all correlations.

    I and Q are made of pp and qq, U and V of pq and qp: the harmonic mean of the two, 0 where one is 0.
    """
    if weight.ndim < APART:
        return weight[..., None]
    parallel = _harmonic(np.stack([weight[..., 0, 0], weight[..., 1, 1]], axis=-1))
    crossed = _harmonic(np.stack([weight[..., 0, 1], weight[..., 1, 0]], axis=-1))
    return np.stack([parallel, parallel, crossed, crossed], axis=-1)


def _harmonic(weight: Float) -> Float:
    """Harmonic mean over the last axis, 0 where one is 0; equal ones stay to the last bit."""
    least = weight.min(axis=-1)
    with np.errstate(divide="ignore", invalid="ignore"):
        share = (least[..., None] / weight).mean(axis=-1)  # 1 where all are alike, and never infinite
        return np.where(least > 0, least / share, 0.0)


def reached(left: Complex, bad: Bool, right: Complex) -> Bool:
    """Which correlations of L V R^H have a bad one of V in them, bool (T, F, B, 2, 2)."""
    return np.asarray(mat2.sandwich((left != 0).astype(float), bad.astype(float), (right != 0).astype(float)) > 0)


def carried(left: Complex, weight: Float, right: Complex) -> Float:
    """Weights (T, F, B, 2, 2) of the correlations of L V R^H, of those of V.

    1/w'_ij is the mean of 1/w_kl with the shares |L_ik|^2 |R_jl|^2 of the noise: equal weights stay as they are, and
    those of diagonal matrices too. 0 where a correlation without weight has a share.
    """
    shares = [np.abs(x) ** 2 for x in (_near_one(left), _near_one(right))]
    dead = reached(left, weight == 0, right)
    with np.errstate(divide="ignore", invalid="ignore"):
        # against the largest, or weights of 1e-100 would overflow
        top = weight.max(initial=0.0)
        inverse = np.where(weight > 0, top / np.where(weight > 0, weight, 1.0), 0.0)
        total = mat2.sandwich(shares[0], np.ones_like(inverse), shares[1])
        found = top * total / mat2.sandwich(shares[0], inverse, shares[1])
    return np.where(dead | ~np.isfinite(found), 0.0, found)


def _near_one(jones: Complex) -> Complex:
    """Matrices over their largest element, so that no square leaves float64; those of zeros stay."""
    size = np.abs(jones).max(axis=(-2, -1), keepdims=True)
    return jones / np.where(size > 0, size, 1.0)
