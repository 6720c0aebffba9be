"""Jones matrices of stations on both sides of visibilities: their data, and the weights and flags of correlations."""

from __future__ import annotations

from typing import Any

import numpy as np

from instrument import correlations, mat2
from instrument.errors import InputError
from instrument.jones.base import JonesTerm
from instrument.jones.chain import Chain
from instrument.numbers import LARGEST
from instrument.observe.sampling import Sampling
from instrument.units import Bool, Complex

CANCELS = 1e6  # of a Jones matrix: its inverse twice in double precision leaves 1e-4


def station_jones(term: JonesTerm | Chain, at: Sampling) -> Complex:
    """The matrices (T, F, A | 1, 2, 2) of a term; raises `InputError` for one that differs between directions."""
    found = term.jones(at)[:, :, :, :1]
    spread = [t for t in (term.parts if isinstance(term, Chain) else term.parts()) if t.directional]
    if spread:
        raise InputError(
            f"{spread[0].called} differs between directions: visibilities can be corrected towards one "
            "direction only; use Towards(chain=...)"
        )
    return found[:, :, :, 0]


def inverted(jones: Complex) -> tuple[Complex, Bool]:
    """The inverses, zero where they or their squares are not finite or cancel to 1e-6; and where they are good."""
    inverse = mat2.inverse(jones)
    largest = np.abs(inverse).max(axis=(-2, -1))  # the data are multiplied with two of them
    # |J^-1| |J| (Skeel): rounding of the data grows with its square; 1 where receptors differ in scale alone
    lost = mat2.mul(np.abs(inverse), np.abs(jones)).max(axis=(-2, -1)).real
    good = np.asarray((largest > 1 / LARGEST) & (largest < LARGEST) & (lost < CANCELS))
    return np.where(good[..., None, None], inverse, 0.0), good


def through(vis: Any, jones: Complex, good: Bool | None = None) -> dict[str, Any]:
    """J_a V J_b^H as `data` (T, F, B, 2, 2), with `flag` and `weight`, of matrices (T, F, A | 1, 2, 2).

    Flagged where they are not `good`. Where correlations differ, what has a share of one that is not known is flagged
    too, and weights go with the noise.
    """
    one = jones.shape[2] == 1
    a, b = (slice(None) if one else antenna for antenna in (vis.antenna1, vis.antenna2))
    weight, flag = vis.weight, vis.flag
    if correlations.APART not in (weight.ndim, flag.ndim):
        with np.errstate(invalid="ignore"):  # data may hold infinities
            data = mat2.between(jones, vis.data, vis.antenna1, vis.antenna2)
    else:
        left, right = jones[:, :, a], jones[:, :, b]
        unknown = correlations.alike(vis.data, flag)[1] | ~np.isfinite(vis.data)
        flag = correlations.reached(left, unknown, right)
        data = np.where(flag, 0.0, mat2.sandwich(left, np.where(unknown, 0.0, vis.data), right))
        if weight.ndim == correlations.APART:
            weight = correlations.carried(left, weight, right)
    if good is not None:
        flag = correlations.either(flag, ~(good[:, :, a] & good[:, :, b]))
    return {"data": data, "weight": weight, "flag": flag}
