"""Noise maps and islands: where an image rises above its noise, and the peaks in there."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from instrument.units import Bool, Float, Int

CLIP = 3.0  # sigma, beyond which pixels are left out of the noise
MOST = 30_000  # pixels of which a noise is told
BEAMS = 40  # widths of the beam along a side of the boxes in which noise is measured, unless said


def noise_map(image: Float, box: int) -> tuple[Float, Float]:
    """Level and rms (Ny, Nx) of an image, from medians in boxes of half overlap, with sources clipped off.

    NaN pixels do not count; where a box has fewer than 50 that do, it is like its neighbours. One level and one rms
    where the image is smaller than three boxes.
    """
    ny, nx = image.shape
    box = min(box, ny, nx)
    counts = [max(1, round(2 * n / box) - 1) if n >= 3 * box else 1 for n in (ny, nx)]
    middles = []
    for n, c in zip((ny, nx), counts, strict=True):
        middles.append(np.linspace(box / 2, n - box / 2, c) if c > 1 else np.array([n / 2]))
    level, rms = np.full(counts, np.nan), np.full(counts, np.nan)
    for i, y in enumerate(middles[0]):
        rows = slice(int(y - box / 2), int(y + box / 2)) if counts[0] > 1 else slice(None)
        for j, x in enumerate(middles[1]):
            columns = slice(int(x - box / 2), int(x + box / 2)) if counts[1] > 1 else slice(None)
            level[i, j], rms[i, j] = clipped(image[rows, columns])
    known = np.isfinite(rms)
    if not known.any():
        return np.full((ny, nx), np.nan), np.full((ny, nx), np.nan)
    level, rms = np.where(known, level, np.median(level[known])), np.where(known, rms, np.median(rms[known]))
    if counts == [1, 1]:
        return np.full((ny, nx), level[0, 0]), np.full((ny, nx), rms[0, 0])
    across = [_between(n, middle) for n, middle in zip((ny, nx), middles, strict=True)]
    return across[0] @ level @ across[1].T, across[0] @ rms @ across[1].T


def _between(count: int, middles: Float) -> Float:
    """Weights (N, M) that take values at middles of boxes linearly to N pixels."""
    return np.stack([np.interp(np.arange(count) + 0.5, middles, one) for one in np.eye(len(middles))], axis=1)


def clipped(values: Float) -> tuple[float, float]:
    """Median and rms of a noise without its sources: of what lies within 3 sigma, again and again.

    Of a large image every n-th pixel, 30000 to 60000 in all, which tells the rms to 0.4 %.
    """
    good = values.ravel()[:: max(1, values.size // MOST)]
    good = good[np.isfinite(good)]
    if len(good) < 50:
        return np.nan, np.nan
    middle = float(np.median(good))
    sigma = 1.4826 * float(np.median(np.abs(good - middle)))
    for _ in range(5):
        kept = good[np.abs(good - middle) <= CLIP * sigma]
        if len(kept) < 50 or len(kept) == len(good):
            break
        good = kept
        middle = float(np.median(good))
        # the rms of a Gaussian cut at 3 sigma is 0.9866 of its own
        sigma = float(np.sqrt(np.mean((good - middle) ** 2))) / 0.9866
    return middle, sigma


@dataclass(frozen=True)
class Islands:
    """Labels (Ny, Nx) of islands, 0 for none, and peaks (n, 2) in them, rows and columns, with the label of each."""

    labels: Int
    peaks: Int
    label: Int


def find_islands(height: Float, low: float, high: float, near: float) -> Islands:
    """Islands of an image in units of its noise: above `low`, with a peak above `high`, and the peaks in each.

    Peaks are the largest within `near` pixels of themselves.
    """
    from scipy.ndimage import label, maximum_filter

    height = np.where(np.isfinite(height), height, 0.0)
    labels, _ = label(height > low, structure=np.ones((3, 3)))
    reach = max(1, round(near))
    y, x = np.meshgrid(*[np.arange(-reach, reach + 1)] * 2, indexing="ij")
    disc: Bool = y**2 + x**2 <= max(near, 1.0) ** 2 + 0.5
    candidates = np.argwhere(height > high)
    if not len(candidates):
        return Islands(labels, np.zeros((0, 2), int), np.zeros(0, int))
    top = maximum_filter(height, footprint=disc) if len(candidates) > 0.001 * height.size else None
    keep = []
    for row, column in candidates:
        if top is not None:
            keep.append(height[row, column] == top[row, column])
            continue
        part = height[max(row - reach, 0) : row + reach + 1, max(column - reach, 0) : column + reach + 1]
        cut = disc[max(reach - row, 0) :, max(reach - column, 0) :][: part.shape[0], : part.shape[1]]
        keep.append(height[row, column] >= part[cut].max())
    peaks = candidates[np.array(keep)]
    return Islands(labels, peaks, labels[peaks[:, 0], peaks[:, 1]])
