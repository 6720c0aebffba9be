"""What float64 does to the brightness of a sky: the flux of each source, and a bound on its rounding."""

from __future__ import annotations

import numpy as np

from instrument.jones.mueller import stokes
from instrument.mat2 import UNIT
from instrument.observe.directions import LIGHT
from instrument.observe.sampling import Sampling
from instrument.sky.base import PlacedSky, polarized, power
from instrument.sky.pixels import PixelSky
from instrument.sky.points import PointSky, points_of
from instrument.sky.sums import side_by_side
from instrument.units import Float


def flux(sky: PlacedSky, at: Sampling) -> Float:
    """|I| + P towards the outline of a sky, Jy (T, F, N), length 1 where constant; of an image in its cells."""
    listed = points_of(sky)
    if listed is not None:
        return power(listed.stokes(at.freq_hz))[None]
    if isinstance(sky, PixelSky):
        return sky.cells_jy(at.freq_hz)[None]
    if sky.kind == "sum":
        return np.asarray(side_by_side([flux(one, at.towards(*one.outline())) for one in sky.members().values()]))
    return power(np.asarray(stokes(sky.brightness(at)).real))


def brightness_rounding(sky: PlacedSky, at: Sampling) -> Float:
    """Bound on the rounding of the brightness of each source, Jy (T, F, N), length 1 where constant."""
    listed = points_of(sky)
    return UNIT * (8 * flux(sky, at) if listed is None else _of_list(listed, at.freq_hz)[None])


def _of_list(sky: PointSky, freq_hz: Float) -> Float:
    """Roundings in Jy (F, S) of spectra, whose terms may cancel, and of the phase 2 RM (lambda^2 - lambda0^2)."""
    found = sky.stokes(freq_hz)
    linear = polarized(found)
    out = 8 * (np.abs(found[..., 0]) + linear)
    if sky.reference_hz is None:
        return out
    given = np.asarray(sky.stokes_jy)
    ratio = freq_hz[:, None] / sky.reference_hz
    if sky.spectral_terms is not None:
        log = np.ones(len(sky), bool) if sky.logarithmic is None else sky.logarithmic
        x, y = np.abs(np.log10(ratio)), np.abs(ratio - 1.0)
        index, added = np.zeros_like(ratio), np.zeros_like(ratio)
        for k in range(sky.spectral_terms.shape[1]):
            term = np.abs(sky.spectral_terms[:, k])
            index += term * (3 * (k + 1) * x**k + k * x ** max(k - 1, 0))  # log10 near 1 is good to a rounding of 1
            added += term * y**k * ((2 * k + 6) * y + (k + 1) * ratio)  # y is good to a rounding of the ratio
        relative = np.where(log, np.abs(np.log(ratio)) * index + 2 * index + 8, 0.0)
        wrong = np.abs(found[..., 0]) * relative + np.where(log, 0.0, added + 4 * np.abs(given[:, 0]))
        out = out + wrong
        if sky.polarization_follows_i is not None:
            flat = given[:, 0] == 0
            share = np.where(flat, linear * relative, polarized(given) * wrong / np.where(flat, 1.0, given[:, 0]))
            out = out + np.where(sky.polarization_follows_i, np.abs(share), 0.0)
    if sky.rotation_measure is not None:
        turn = 2 * np.abs(sky.rotation_measure) * ((LIGHT / freq_hz[:, None]) ** 2 + (LIGHT / sky.reference_hz) ** 2)
        out = out + 5 * turn * np.hypot(found[..., 1], found[..., 2])
    return np.asarray(out)
