"""Noise of the channels of a cube from differences of neighbouring channels, the brightest emission turned still."""

from __future__ import annotations

from typing import Any

import numpy as np

from instrument.units import Bool, Complex, Float

ENOUGH = 30  # pixels that tell the noise of channels apart; of fewer all channels are taken to have the same
UNEVEN = 2.5  # steps of one difference may differ by it: more is a gap, over which emission turns


def channel_noise(
    values: Complex, good: Bool, depths: Float, bright: Float, lambda2: Float, weights: Float, real: bool
) -> Float:
    """Noise of Q and of U in every channel (N,), from values (N, n) of n pixels, their brightest depths and |F| (n,).

    Differences of five neighbours in lambda² (of three, where there are fewer than 12 channels) are blind to emission
    at the brightest depth, and take little of others near it. A depth that noise might have made is left alone: there
    the differences would find 5 % too little in 33 channels. The median over pixels is not moved by the few where
    more is taken. Each difference is weighed as if the variance went with 1 / weight: right for such weights, and
    for any that change slowly from channel to channel. NaN where there are fewer than three channels, or no pixel with
    data.
    """
    order = np.argsort(lambda2, kind="stable")
    x, w = lambda2[order], weights[order]
    taken = _differences(x, w)
    use = values.any(axis=0)  # spectra of zeros are no data
    if taken is None or not use.any():
        return np.full(len(lambda2), np.nan)
    first, factors = taken
    still, there = values[np.ix_(order, use)], good[np.ix_(order, use)]
    power = (np.abs(still) ** 2).sum(axis=0) / np.maximum(there.sum(axis=0), 1)
    chance = power * (np.log(len(x)) + 5) / len(x)  # of noise one in 100 has a larger |F|²
    turned = np.where(bright[use] ** 2 > chance, depths[use], 0.0)
    still *= np.exp(-2j * np.multiply.outer(x - x.mean(), turned))
    size = np.zeros((len(first), still.shape[1]), complex)
    has = np.ones(size.shape, bool)
    for k, factor in enumerate(factors.T):
        size += factor[:, None] * still[first + k]
        has &= there[first + k]
    power = np.abs(size) ** 2 / (1 if real else 2)
    middle = w[first + factors.shape[1] // 2]
    whole = middle @ has
    total = np.divide(middle @ np.where(has, power, 0), whole, out=np.full(len(whole), np.nan), where=whole > 0)
    if not np.isfinite(total).any():
        return np.full(len(lambda2), np.nan)
    quiet = has & (total <= 2 * np.nanmedian(total))
    seen, shares = quiet.sum(axis=1), factors**2 / w[_places(first, factors)]
    variance = np.ones(len(x))
    if seen.min() >= ENOUGH:
        variance = _of_channels(first, shares, np.where(quiet, power, 0).sum(axis=1) / seen, len(x), 3 / seen.min())
    variance = variance if variance.any() else np.ones(len(x))
    mean, freedom = _spread(first, factors, variance / w, middle, real)
    # the median of chi²_k over its mean is (1 - 2/9k)³, and k goes with the differences that a pixel has
    total /= np.maximum(1 - 2 / (9 * freedom * np.maximum(whole, 1e-3 * middle.sum()) / middle.sum()), 0.3) ** 3
    out = np.empty(len(lambda2))
    out[order] = np.sqrt(float(np.nanmedian(total)) / mean * variance / w)
    return out


def _of_channels(first: Any, shares: Float, found: Float, many: int, hold: float) -> Float:
    """Variance of every channel times its weight, least squares, of that of differences (D,) and its shares (D, k).

    What these leave open (the ends, the highest ripple) is held, by `hold`, to the difference about each channel.
    """
    points = shares.shape[1]
    mix = np.zeros((len(first), many))
    mix[np.arange(len(first))[:, None], _places(first, shares)] = shares
    near = np.interp(np.arange(many), first + points // 2, found)
    square = mix.T @ mix + hold * np.eye(many)
    return np.maximum(np.linalg.solve(square, mix.T @ found + hold * near), 0.0)


def _places(first: Any, shares: Float) -> Any:
    """The channels (D, k) of each difference."""
    return first[:, None] + np.arange(shares.shape[1])


def _differences(x: Float, w: Float) -> tuple[Any, Float] | None:
    """Where differences begin among growing lambda² (D,) and their factors (D, 3 or 5), sum factor² / weight = 1."""
    points = 5 if len(x) >= 12 else 3
    if len(x) < points:
        return None
    first = np.arange(len(x) - points + 1)
    steps = np.diff(x)[first[:, None] + np.arange(points - 1)]
    apart = steps.min(axis=1) > 1e-9 * np.ptp(x)  # the same channel twice has no difference in lambda²
    fits = apart & (steps.max(axis=1) <= UNEVEN * steps.min(axis=1))
    first = first[fits if fits.any() else apart]
    if not len(first):
        return None
    at = x[first[:, None] + np.arange(points)]
    pairs = (at[:, :, None] - at[:, None, :]) / (at[:, -1] - at[:, 0])[:, None, None]
    pairs[:, np.arange(points), np.arange(points)] = 1
    factors = 1 / pairs.prod(axis=2)  # of divided differences
    factors /= np.sqrt((factors**2 / w[first[:, None] + np.arange(points)]).sum(axis=1))[:, None]
    return first, factors


def _spread(first: Any, factors: Float, variance: Float, middle: Float, real: bool) -> tuple[float, float]:
    """Weighted mean of the squared differences of Gaussian noise, and of how many degrees of freedom it is."""
    spread, places = np.zeros((len(first), len(variance))), _places(first, factors)
    spread[np.arange(len(first))[:, None], places] = factors * np.sqrt(variance)[places]
    alike = spread @ spread.T
    mean = float(middle @ np.diagonal(alike))
    freedom = mean**2 / float(middle @ alike**2 @ middle) * (1 if real else 2)
    return mean / float(middle.sum()), freedom
