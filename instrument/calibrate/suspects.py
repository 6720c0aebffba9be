"""Which visibilities spoil a fit: those that a fit to most of them, with all others held against it, cannot have."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from instrument import mat2
from instrument.calibrate.lanes import Lanes, levels
from instrument.units import Bool, Complex, Float, Int

ROUNDS = 6  # of weighting anew
STANDS_OUT = 64.0  # times the power of the others
FEW = 0.2  # of the visibilities: more than that are no outliers


@dataclass(frozen=True)
class _Quick:
    """Enough to tell which visibilities do not fit."""

    pattern: str
    tolerance: float = 1e-6
    iterations: int = 30


def suspects(v: Complex, m: Complex, a1: Int, a2: Int, active: Bool, settings: Any) -> dict[int, Bool]:
    """Samples (N,) by lane that stand out, of weighted data and model (L, N, 2, 2); lanes where few do.

    Amplitudes are brought to one level by least absolute values, the largest cut, and the fit to that is weighted anew
    by what it leaves: an outlier of any size then pulls no more than others do.
    """
    quick = _Quick(settings.pattern)
    power_v, power_m = (np.square(np.abs(x)).sum(axis=(-2, -1)) for x in (v, m))
    use = power_m > 0
    level = levels(v, m, a1, a2, active.shape[1], robust=True)
    both = np.tile(level[:, a1] * level[:, a2], v.shape[1] // len(a1))
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        cut = np.minimum(1.0, 2.0 * both * np.sqrt(power_m / power_v))
    flat = v * np.where(use & np.isfinite(cut), cut / both, 0.0)[..., None, None]
    lanes = Lanes(flat, m, a1, a2, active, quick)
    jones = lanes.iterate(lanes.eigenvectors(), far=0.02)[0] * level[:, :, None, None]
    for _ in range(ROUNDS):
        left, noise = _left(v, m, jones, a1, a2, use)
        # the root of Cauchy's weight
        trust = np.where(use, 1 / np.sqrt(1 + left / (9 * noise[:, None])), 0.0)[..., None, None]
        jones = Lanes(v * trust, m * trust, a1, a2, active, quick).iterate(jones)[0]
    left, noise = _left(v, m, jones, a1, a2, use)
    out = use & (left > STANDS_OUT * noise[:, None]) & (left > 1e-4 * power_v)
    few = out.any(axis=1) & (out.sum(axis=1) <= np.maximum(1, FEW * use.sum(axis=1)))
    return {int(k): out[k] for k in np.flatnonzero(few)}


def _left(v: Complex, m: Complex, jones: Complex, a1: Int, a2: Int, use: Bool) -> tuple[Float, Float]:
    """Power left over (L, N), and its median over what counts (L,), not less than 1e-10 of the median of the data."""
    rows = np.tile(a1, v.shape[1] // len(a1)), np.tile(a2, v.shape[1] // len(a1))
    left = np.square(np.abs(v - mat2.sandwich(jones[:, rows[0]], m, jones[:, rows[1]]))).sum(axis=(-2, -1))
    power = np.square(np.abs(v)).sum(axis=(-2, -1))
    with np.errstate(invalid="ignore"):
        medians = [np.nanmedian(np.where(use, x, np.nan), axis=1) for x in (left, power)]
    return left, np.maximum(np.maximum(medians[0], 1e-10 * medians[1]), 1e-300)
