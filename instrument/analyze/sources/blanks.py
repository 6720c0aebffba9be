"""Blank places beside the sources: the scatter of what is left there is the error, of noise and of confusion alike.

What is left of sources that are not in the model is neither independent between times nor between baselines: towards
a blank place it adds up as it does towards a source, whatever the sampling. Sums over chunks of time scatter too
little instead (0.8 of it at 15 min for 8 core stations of LOFAR: fringes of short baselines live longer), so these
only tell whether there is anything but noise.
"""

from __future__ import annotations

import numpy as np

from instrument.observe.directions import tangents
from instrument.units import Float

PLACES = 32
NEAREST, FURTHEST = 1.0, 10.0  # of 1 / median baseline, from a source
CHUNKS = 16  # of time
FREE = 0.1  # of its weight, below which a place is not told apart from the sources
FEWEST = 8  # such places, below which they tell nothing


def places(ra_rad: Float, dec_rad: Float, stations: Float, uv_range: tuple[float, float] | None) -> Float:
    """Unit vectors (M, 3) spread about sources (G,), in all directions; stations (A, 3) are in wavelengths."""
    baselines = np.linalg.norm(stations[:, None] - stations, axis=-1)[np.triu_indices(len(stations), 1)]
    if uv_range is not None:
        baselines = np.clip(baselines, *uv_range)
    k = np.arange(PLACES)
    pick = k * len(ra_rad) // PLACES
    # steps of the plastic number's powers fill the square of angle and distance evenly
    angle, step = 2 * np.pi * (k * 0.7548776662 % 1), k * 0.5698402910 % 1
    apart = NEAREST / max(float(np.median(baselines)), 1.0) * (FURTHEST / NEAREST) ** step
    ra, dec = ra_rad[pick], dec_rad[pick]
    east, north = tangents(ra, dec)
    outwards = np.cos(angle)[:, None] * east + np.sin(angle)[:, None] * north
    vector = np.stack([np.cos(dec) * np.cos(ra), np.cos(dec) * np.sin(ra), np.sin(dec)], axis=1)
    return np.asarray(np.cos(apart)[:, None] * vector + np.sin(apart)[:, None] * outwards)


def excess(scores: Float, free: Float, variance: Float, data: int) -> Float:
    """Variance of sums towards places over what independent noise would give them, (4,).

    `scores` (C, M, 4) are sums of weighted residuals in chunks of time, `free` (M,) the weight of each place that no
    source takes (0 where it is not to be used), `variance` (4,) that of a datum of weight 1, `data` how many there are.
    Where the chunks scatter as noise does it is 1 (within 2 sigma; wholly measured beyond 3): sums over all the time
    are as many as there are places, and tell it to 1/4 only. Of a variance from M sums, M / (M - 2) makes pulls 1.
    """
    good = free > 0
    count = int(good.sum())
    if count < FEWEST:
        return np.ones(4)
    scores, free = scores[:, good], free[good]
    with np.errstate(divide="ignore", invalid="ignore"):
        whole = (scores.sum(axis=0) ** 2 / free[:, None]).sum(axis=0) / (count - 2) / variance
        parts = (scores**2).sum(axis=(0, 1)) / free.sum() / variance
    sure = np.clip(np.abs(parts - 1) / np.sqrt(2 / min(len(scores) * count, data)) - 2, 0, 1)
    return np.where(variance > 0, 1 + sure * (whole - 1), 1.0)
