"""Rotation measure synthesis: cubes in Faraday depth from cubes in frequency, for any depths, weights and flags."""

from __future__ import annotations

import os
from collections.abc import Callable
from typing import Any, Literal, get_args

import numpy as np

from instrument.analyze.faraday_band import number, one
from instrument.analyze.faraday_chunks import allocated, in_threads
from instrument.analyze.faraday_cube import FaradayCube
from instrument.analyze.faraday_kernels import combine, combine_real, divide, gather, has_data, mark
from instrument.analyze.faraday_product import Product
from instrument.analyze.fourier import Stokes
from instrument.errors import InputError, did_you_mean
from instrument.image.cube import StokesCube
from instrument.observe.directions import LIGHT
from instrument.units import Complex, Float, Int

Precision = Literal["single", "double"]
CHUNK_BYTES = 8 << 20  # of one product: 4 to 16 MB cost the same within 5 %
RELEASE_BYTES = 256 << 20  # written to a file between two releases of its pages


def rm_synthesis(
    cube: StokesCube,
    depths: Any,
    stokes: Stokes = "P",
    weights: Any = None,
    lambda2_0: Any = None,
    spectral_index: float | None = None,
    divide_by_i: bool = False,
    precision: Precision | None = None,
    out: str | os.PathLike[str] | None = None,
    noise: Any = None,
    progress: Callable[[float], None] | None = None,
) -> FaradayCube:
    """Faraday dispersion function of a cube; see `Analyzer.rm_synthesis`.

    A chunk of pixels costs one real product with cos and sin of the distinct |phi|: half, where depths come in pairs.
    """
    phi = np.atleast_1d(number(depths, "rad/m2", "depths"))
    if phi.ndim != 1 or not len(phi):
        raise InputError(f"depths have shape {phi.shape}: give one axis of at least one depth in rad/m²")
    if stokes not in get_args(Stokes):
        raise InputError(f"stokes = '{stokes}' is not known; {did_you_mean(str(stokes), get_args(Stokes))}")
    if precision not in (None, *get_args(Precision)):
        raise InputError(f"precision = {precision!r} is not one of 'single', 'double' or None (that of the cube)")
    if divide_by_i and (stokes == "I" or spectral_index is not None):
        raise InputError("divide_by_i takes the spectrum out of Q, U or V: leave out spectral_index, and stokes = 'I'")
    freq = cube.freq_hz
    values = np.asarray(cube.data)
    plain = {2: np.float32, 4: np.float32}.get(values.dtype.itemsize, float) if values.dtype.kind == "f" else float
    values = values.astype(plain, copy=False)
    double = precision == "double" if precision else values.dtype.itemsize > 4
    a, b = (1, 2) if stokes == "P" else ("IQUV".index(stokes),) * 2
    weight = _weights(weights, len(freq)) * has_data(values, a, b)
    if not weight.any():
        raise InputError(f"Stokes {stokes} of this cube has no channel with data and weight: nothing to transform")
    channels, real = np.flatnonzero(weight), np.float64 if double else np.float32
    w, lambda2 = weight[channels], (LIGHT / freq[channels]) ** 2
    mean = float(w @ lambda2 / w.sum())
    centre = mean if lambda2_0 is None else one(lambda2_0, "m2", "lambda2_0")
    reference = LIGHT / np.sqrt(mean)
    ratio = freq[channels] / reference
    index = one(spectral_index or 0.0, "", "spectral_index")
    scaled = w * ratio**-index  # divides P by the spectrum
    product = Product(phi, lambda2 - centre, scaled / w.sum(), real)
    planes, pixels = (2 if stokes == "P" else 1), values[0, 0].size
    size = int(np.clip(CHUNK_BYTES // (2 * len(product.rows) * planes * (8 if double else 4)), 64, 8192))
    merge = combine if stokes == "P" else combine_real
    limit = float(np.finfo(real).max) / 1e3  # sums of 1e6 channels do not overflow

    def transform(first: int, data: Complex) -> Any:
        n = min(size, pixels - first)
        x = np.empty((len(channels), 2, n), real)
        factor, missing = np.ones(n, real), None
        if gather(values, a, b, channels, first, limit, x) or divide_by_i:
            good = np.empty((len(channels), n), bool)
            if (wrong := mark(values, a, b, channels, first, limit, good)) >= 0:
                raise InputError(
                    f"Stokes {stokes} has values beyond {limit:.2g} in channel {wrong}: make infinite pixels NaN"
                )
            level = np.ones(n)
            if divide_by_i:
                divide(values, channels, first, w, np.log(ratio), good, x, level)
            if not good.all():
                missing = np.zeros((len(freq), n), bool)
                missing[channels] = ~good
                missing = np.packbits(missing, axis=0)
            left = w @ good
            factor[:] = np.divide(level * w.sum(), left, out=np.full(n, np.nan), where=left > 0)
        sums = product(x[:, :planes].reshape(len(channels), -1)).reshape(2, -1, planes, n)
        merge(sums, product.place, product.sign, factor, first, data)
        return missing

    kind = np.dtype(np.complex128 if double else np.complex64)
    every = max(1, RELEASE_BYTES // (len(phi) * size * kind.itemsize))
    with allocated((len(phi), pixels), kind, out) as (data, release):
        found = in_threads(lambda first: transform(first, data), range(0, pixels, size), progress, release, every)
    flags = None
    if any(part is not None for part in found):
        flags = np.zeros((-(-len(freq) // 8), pixels), np.uint8)
        for first, part in zip(range(0, pixels, size), found, strict=True):
            if part is not None:
                flags[:, first : first + part.shape[1]] = part
    if out is not None:
        data = np.load(out, mmap_mode="c")  # what is written to the array does not go to the file
    span = np.ptp(phi)
    steps = np.arange(1 - len(phi), len(phi)) if span else np.zeros(1)
    result = FaradayCube(
        data=data.reshape(len(phi), *values.shape[2:]),
        depths=phi,
        freq_hz=freq,
        weights=weight,
        lambda2_0=centre,
        rmsf_depths=steps * (span / max(1, len(phi) - 1)),
        rmsf=np.ones(1, complex),
        unit=cube.unit,
        stokes=stokes,
        noise=_noise(noise, cube.unit, scaled, w, channels, len(freq), divide_by_i),
        flags=flags,
        pixel_rad=cube.pixel_rad,
        centre=cube.centre,
        reference_hz=float(reference),
        spectral_index=spectral_index,
        divided=divide_by_i,
    )
    object.__setattr__(result, "rmsf", result.rmsf_at(result.rmsf_depths))
    return result


def _weights(weights: Any, channels: int) -> Float:
    out = np.ones(channels) if weights is None else number(weights, "", "weights")
    if out.shape != (channels,) or (out < 0).any():
        raise InputError(f"weights must be {channels} numbers, one a channel and none below 0; 0 leaves a channel out")
    return out


def _noise(noise: Any, unit: str, scaled: Float, w: Float, channels: Int, count: int, divided: bool) -> float | None:
    """sqrt(sum w² sigma²) / sum w, of sigmas in the unit of the cube, one for all channels or one each (F,)."""
    if noise is None:
        return None
    sigma = number(noise, unit, "noise")
    if sigma.shape not in ((), (count,)) or (sigma < 0).any():
        raise InputError(f"noise must be one number or {count} (one a channel), none below 0")
    if divided:
        raise InputError("noise of the channels says nothing about Q/I and U/I: leave it out, it is measured")
    return float(np.sqrt(((scaled * np.broadcast_to(sigma, count)[channels]) ** 2).sum()) / w.sum())
