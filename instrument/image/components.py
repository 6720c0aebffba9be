"""The compiled loops of a minor cycle: components at the peaks of pixels, taken out of them with the PSF."""

from __future__ import annotations

from typing import Any

import numpy as np

from instrument.compiled import compiled

WORSE = 2.0  # of its start: a peak that has grown by this diverges


@compiled(nogil=True, error_model="numpy")
def take(
    values: Any, places: Any, psf: Any, share: Any, fit: Any, gain: Any, limits: Any, taken: Any
) -> tuple[int, float]:
    """Take components from n pixels `values` (n, K, F), in place, and add them to `taken` (n, K, F).

    `places` (n, 2) are rows and columns, `psf` (Ny, Nx, F) has its centre at (Ny // 2, Nx // 2). The next component is
    where sqrt(sum_k (sum_f share_kf values_kf)^2) is largest: gain_f times what `fit` (K, F, F) makes of the values
    there. `limits` are the floor of that, the most components, and 1 where a single value may be negative. Returns how
    many were taken, and the peak that is left; stops where that has grown to twice its start.
    """
    count, kinds, channels = values.shape
    ny, nx = psf.shape[:2]
    floor, most, signed = limits[0] * limits[0], int(limits[1]), limits[2] > 0
    part = np.zeros((kinds, channels))
    best, top, first, done, row, column = 0, 0.0, 0.0, 0, 0, 0
    while True:
        top, found = -1.0, 0
        for j in range(count):
            y, x = places[j, 0] - row, places[j, 1] - column
            inside = done > 0 and 0 <= y < ny and 0 <= x < nx
            power = 0.0
            for k in range(kinds):
                total = 0.0
                for f in range(channels):
                    value = values[j, k, f]
                    if inside:
                        value -= part[k, f] * psf[y, x, f]
                        values[j, k, f] = value
                    total += share[k, f] * value
                power += total * total if signed or total > 0 else 0.0
            if power > top:
                top, found = power, j
        best = found
        if done == 0:
            first = top
        if top <= floor or done >= most or top > WORSE * WORSE * first:
            break
        for k in range(kinds):
            for f in range(channels):
                total = 0.0
                for g in range(channels):
                    total += fit[k, f, g] * values[best, k, g]
                part[k, f] = gain[f] * total
                taken[best, k, f] += part[k, f]
        row, column = places[best, 0] - ny // 2, places[best, 1] - nx // 2
        done += 1
    return done, np.sqrt(max(top, 0.0))


@compiled(nogil=True, error_model="numpy", fastmath={"nnan", "nsz", "reassoc", "contract"})
def take_whole(image: Any, psf: Any, mask: Any, gain: float, limits: Any, taken: Any) -> tuple[int, float]:
    """The same for all pixels of one image (Ny, Nx), in place, row by row: 8 times as quick a pixel as a list of them.

    `mask` (Ny, Nx) is 1 where components may be and 0 elsewhere. Without a test whether a value is NaN, compilers find
    the largest of a row in vectors.
    """
    ny, nx = image.shape
    high, wide = psf.shape
    signed = limits[2] > 0
    flux, row, column, done, first = 0.0, 0, 0, 0, 0.0
    while True:
        top, where = -1.0, 0
        for y in range(ny):
            dy = y - row
            if done > 0 and 0 <= dy < high:
                left, right = max(column, 0), min(column + wide, nx)
                line, lobe = image[y, left:right], psf[dy, left - column : right - column]
                for x in range(right - left):
                    line[x] -= flux * lobe[x]
            most, whole, seen = 0.0, image[y], mask[y]
            if signed:
                for x in range(nx):
                    most = max(most, abs(whole[x]) * seen[x])
            else:
                for x in range(nx):
                    most = max(most, whole[x] * seen[x])
            if most > top:
                top, where = most, y
        if done == 0:
            first = top
        if top <= limits[0] or done >= limits[1] or top > WORSE * first:
            return done, top
        best = 0
        for x in range(nx):
            if (abs(image[where, x]) if signed else image[where, x]) * mask[where, x] >= top:
                best = x
                break
        flux = gain * image[where, best]
        taken[where, best] += flux
        row, column = where - high // 2, best - wide // 2
        done += 1
