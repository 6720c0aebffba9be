"""Mueller matrices of a whole array: the mean over its baselines and over times."""

from __future__ import annotations

import numpy as np

from instrument import mat2
from instrument.jones.chain import Chain
from instrument.jones.mueller import TO_LINEAR, TO_STOKES
from instrument.observe.sampling import Sampling
from instrument.units import Bool, Complex


def mean_mueller(chain: Chain, at: Sampling, differential: bool) -> Complex:
    """Mueller matrix of each direction, the mean over all baselines a < b and the times of `at`, complex (F, S, 4, 4).

    Both orders of a baseline are counted, so what is antisymmetric between stations cancels, as it does in an image.
    Stations whose beam at the centre cannot be inverted at a time are left out of it, as they are flagged in data; NaN
    where no baseline is left.
    """
    times, channels, stations, sources = at.shape
    centre = chain.jones(at.at_centre()) if differential else None
    total, count = np.zeros((channels, sources, 4, 4), complex), np.zeros(channels)
    for t in range(times):
        one = at.block(slice(t, t + 1), slice(None))
        jones = np.broadcast_to(chain.jones(one), (1, channels, stations, sources, 2, 2))[0]
        good: Bool = np.ones((channels, stations), bool)
        if centre is not None:
            inverse = mat2.inverse(np.broadcast_to(centre, (times, channels, stations, 1, 2, 2))[t])
            good = np.asarray(np.isfinite(inverse).all(axis=(-3, -2, -1)))
            jones = mat2.mul(np.where(good[..., None, None, None], inverse, 0.0), jones)
        whole = jones.sum(axis=1)
        total += _kron(whole, whole) - _kron(jones, jones).sum(axis=1)
        left = good.sum(axis=1)
        count += left * (left - 1)
    mean = total / np.where(count > 0, count, np.nan)[:, None, None, None]
    return np.asarray(TO_STOKES @ mean @ TO_LINEAR)


def _kron(a: Complex, b: Complex) -> Complex:
    return np.einsum("...ij,...kl->...ikjl", a, b.conj()).reshape(*a.shape[:-2], 4, 4)
