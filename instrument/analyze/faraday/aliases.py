"""Aliases: other depths at which the RMSF comes back, so that a source may lie there as well."""

from __future__ import annotations

from typing import Any

import numpy as np

from instrument.units import Float

CHUNK_BYTES = 32 << 20
MOST = 200_000  # steps of FWHM / 8 in which aliases are looked for


def summits(lambda2: Float, weights: Float, span: float, fwhm: float) -> tuple[Float, Float]:
    """Depths and heights of the peaks of |R| between 0 and `span` rad/m² (K,), the main one left out.

    Its own end of the span counts where |R| rises towards it.
    """
    phi = _axis(span, fwhm)
    if len(phi) < 2:
        return np.zeros(0), np.zeros(0)
    size = _size(lambda2, weights[None], phi)[0]
    inner = np.flatnonzero((size[1:-1] >= size[:-2]) & (size[1:-1] > size[2:])) + 1
    depth, height = phi[inner], size[inner]
    d = phi[1] - phi[0]
    for _ in range(6):
        d /= 4
        three = np.stack([_at(lambda2, weights, depth + k * d) for k in (-1, 0, 1)])
        curve = three[0] - 2 * three[1] + three[2]
        with np.errstate(divide="ignore", invalid="ignore"):
            move = 0.5 * (three[0] - three[2]) / curve
        move = np.where(curve < 0, np.clip(move, -4, 4), 4 * np.sign(three[2] - three[0]))
        depth = np.minimum(depth + move * d, span)
    height = np.sqrt(_at(lambda2, weights, depth))
    if size[-1] > size[-2]:
        depth, height = np.append(depth, span), np.append(height, size[-1])
    return depth, height


def sidelobe(lambda2: Float, weights: Float, flags: Any, fwhm: float, span: float, sides: Float) -> Float:
    """Height of the highest peak of |R| beside the main one (n,) that lies in the axis, of some pixels (n,).

    `sides` (n,) is how far each pixel's axis goes on from its peak; `flags` are the bits (F / 8, n) of their voxels.
    Pixels with voxels of their own missing have RMSFs of their own: theirs is looked for in the whole span.
    """
    channels = np.flatnonzero(weights > 0)
    x, w = lambda2[channels], weights[channels]
    depth, height = summits(x, w, span, fwhm)
    order = np.argsort(depth)
    highest = np.append(0.0, np.maximum.accumulate(height[order]))
    out = highest[np.searchsorted(depth[order], sides, "right")]
    if flags is None or not len(sides):
        return np.minimum(out, 1.0)
    some = np.flatnonzero(flags.any(axis=0))
    patterns, place = np.unique(flags[:, some], axis=1, return_inverse=True)
    there = np.unpackbits(patterns, axis=0, count=len(weights))[channels].T == 0
    found = np.empty(len(there))
    phi = _axis(span, fwhm)
    size = max(1, CHUNK_BYTES // (8 * max(len(phi), len(x))))
    for first in range(0, len(there), size):
        found[first : first + size] = _highest(x, there[first : first + size] * w, phi)
    out[some] = found[place.ravel()]
    return np.minimum(out, 1.0)


def _highest(lambda2: Float, weights: Float, phi: Float) -> Float:
    """Highest peak of |R| beside the main one, of sets of weights (n, N); between depths a parabola through |R|²."""
    if len(phi) < 3:
        return np.zeros(len(weights))
    square = _size(lambda2, weights, phi) ** 2
    down, top, up = square[:, :-2], square[:, 1:-1], square[:, 2:]
    curve = down - 2 * top + up
    with np.errstate(divide="ignore", invalid="ignore"):
        peak = top - (down - up) ** 2 / (8 * curve)
    inner = np.where((top >= down) & (top > up), peak, 0.0).max(axis=1)
    last = np.where(square[:, -1] > square[:, -2], square[:, -1], 0.0)
    return np.sqrt(np.maximum(inner, last))


def _axis(span: float, fwhm: float) -> Float:
    many = span / (fwhm / 8) if 0 < fwhm < np.inf else 0.0
    return np.linspace(0, span, int(min(np.ceil(many), MOST)) + 1)


def _size(lambda2: Float, weights: Float, phi: Float) -> Float:
    """|R| at depths (M,) of sets of weights (n, N): (n, M)."""
    mean = lambda2.mean()
    out = np.empty((len(weights), len(phi)))
    total = weights.sum(axis=1, keepdims=True)
    step = max(1, CHUNK_BYTES // (16 * len(lambda2)))
    for first in range(0, len(phi), step):
        angle = 2 * np.multiply.outer(lambda2 - mean, phi[first : first + step])
        out[:, first : first + step] = np.hypot(weights @ np.cos(angle), weights @ np.sin(angle)) / total
    return out


def _at(lambda2: Float, weights: Float, phi: Float) -> Any:
    """|R|² at depths (M,)."""
    return _size(lambda2, weights[None], phi)[0] ** 2
