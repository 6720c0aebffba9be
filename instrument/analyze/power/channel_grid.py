"""Channels of a cube on an even grid of frequencies: order, gaps, and what is put in them."""

from __future__ import annotations

import numpy as np

from instrument.errors import InputError, warn
from instrument.image.cube import StokesCube
from instrument.units import Bool, Float, Int


def even_channels(cube: StokesCube, infill: bool) -> tuple[Int, Float, Bool]:
    """Channels in growing order, the even grid of frequencies they lie on, and where it has a channel."""
    order = np.argsort(cube.freq_hz, kind="stable")
    freq = cube.freq_hz[order]
    if len(freq) < 2:
        raise InputError("one channel has no k_par: use spectrum_2d, or give a cube of two channels or more")
    steps = np.diff(freq)
    step = float(steps.min())
    if step <= 0:
        twice = freq[:-1][steps <= 0][0] / 1e6
        raise InputError(f"two channels at {twice:.6g} MHz: power along the line of sight needs each one once")
    # steps are rounded in files: counted one by one, and the whole span is the better ruler
    step = float(np.median(steps[steps < 1.5 * step]))
    number = np.append(0, np.cumsum(np.round(steps / step).astype(int)))
    if number[-1] >= 4 * len(freq):
        raise InputError(f"{len(freq)} channels lie on {number[-1] + 1} places: regrid them, or take a part of them")
    step = float((freq[-1] - freq[0]) / number[-1])
    off = np.abs(freq - freq[0] - number * step).max() / step
    if off > 0.01:
        raise InputError(f"channels are not evenly spaced (off by {off:.2g} of a channel): regrid them first")
    if number[-1] + 1 > len(freq) and not infill:
        gap = int(np.argmax(np.diff(number)))
        raise InputError(
            f"{number[-1] + 1 - len(freq)} channels are missing, the first between {freq[gap] / 1e6:.6g} and "
            f"{freq[gap + 1] / 1e6:.6g} MHz: fill them in with infill=300 * u.ns, or take a part without gaps"
        )
    grid = freq[0] + step * np.arange(number[-1] + 1)
    return order, grid, np.isin(np.arange(len(grid)), number)


def same_grid(cube: StokesCube, other: StokesCube) -> StokesCube:
    """The other cube; raises `InputError` unless its shape, channels, pixel and unit are those of the first."""
    same = cube.data.shape == other.data.shape and cube.unit == other.unit
    same = same and np.allclose(cube.freq_hz, other.freq_hz, rtol=1e-9, atol=0)
    if not same or not np.isclose(cube.pixel_rad, other.pixel_rad, rtol=1e-9, atol=0):
        raise InputError("cross needs a cube of the same shape, channels, pixel and unit")
    return other


def infill_operator(freq_hz: Float, here: Bool, delay_s: float) -> Float:
    """Operator (missing, there): the likeliest values of a spectrum of delays below `delay_s`, 1e6 times the noise.

    Wiener interpolation with the covariance sinc(2 delay (f - f')) of power that is even out to that delay.
    """
    if not delay_s > 0:
        raise InputError(f"infill = {delay_s} s must be above 0: the largest delay to fill in, such as 300 * u.ns")
    kernel = np.sinc(2 * delay_s * (freq_hz[:, None] - freq_hz))
    there = kernel[np.ix_(here, here)] + 1e-12 * np.eye(int(here.sum()))
    found = np.asarray(np.linalg.lstsq(there, kernel[np.ix_(here, ~here)], rcond=1e-13)[0].T)
    worst = float(np.sqrt((found**2).sum(axis=1)).max())
    if worst > 2:
        text = f"filling in makes noise {worst:.2g} times as large in some channel: take a smaller delay, or a part"
        warn(f"{text} of the band without wide gaps")
    return found
