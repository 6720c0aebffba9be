"""Rotation measure synthesis: cubes in Faraday depth from cubes in frequency, for any depths, weights and flags."""

from __future__ import annotations

import os
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Literal, get_args

import numpy as np

from instrument.analyze.faraday.band import FaradayBand, number, one
from instrument.analyze.faraday.chunks import allocated, in_threads
from instrument.analyze.faraday.cube import FaradayCube
from instrument.analyze.faraday.kernels import combine, combine_real, divide, gather, has_data, mark
from instrument.analyze.faraday.noise import channel_noise
from instrument.analyze.faraday.product import Product
from instrument.analyze.power.fourier import Stokes
from instrument.errors import InputError, did_you_mean, warn
from instrument.image.cube import StokesCube
from instrument.memory import afford
from instrument.observe.directions import LIGHT
from instrument.units import NOT_NEGATIVE, Complex, Float

Precision = Literal["single", "double"]
Division = Literal[True, False, "voxel", "fit"]
SAMPLE = 4096  # pixels whose noise is measured
CHUNK_BYTES = 8 << 20  # of one product: 4 to 16 MB cost the same within 5 %
RELEASE_BYTES = 256 << 20  # written to a file between two releases of its pages


@dataclass(frozen=True)
class Synthesis:
    """How a cube is brought to Faraday depth; see `Analyzer.rm_synthesis`."""

    depths: Any = None
    stokes: Stokes = "P"
    weights: Any = None
    lambda2_0: Any = None
    spectral_index: float | None = None
    divide_by_i: Division = False
    precision: Precision | None = None
    out: str | os.PathLike[str] | None = None
    noise: Any = None

    def check(self) -> None:
        """Raises `InputError` for words that are not known, and for two ways to take the spectrum out."""
        stokes, precision = self.stokes, self.precision
        if stokes not in get_args(Stokes):
            raise InputError(f"stokes = '{stokes}' is not known; {did_you_mean(str(stokes), get_args(Stokes))}")
        if precision not in (None, *get_args(Precision)):
            raise InputError(f"precision = {precision!r} is not one of 'single', 'double' or None (that of the cube)")
        if self.divide_by_i and (stokes == "I" or self.spectral_index is not None):
            raise InputError(
                "divide_by_i takes the spectrum out of Q, U or V: leave out spectral_index, and stokes = 'I'"
            )


def rm_synthesis(cube: StokesCube, how: Synthesis, progress: Callable[[float], None] | None = None) -> FaradayCube:
    """Faraday dispersion function of a cube; see `Analyzer.rm_synthesis`.

    A chunk of pixels costs one real product with cos and sin of the distinct |phi|: half, where depths come in pairs.
    """
    how.check()
    stokes = how.stokes
    index = one(how.spectral_index or 0.0, "", "spectral_index")
    voxels = _Voxels(cube, stokes, how.weights, how.precision, index, how.divide_by_i)
    phi, band = _depths(how.depths, voxels)
    w, lambda2, real = voxels.w, voxels.lambda2, voxels.real
    mean = float(w @ lambda2 / w.sum())
    centre = mean if how.lambda2_0 is None else NOT_NEGATIVE.check(one(how.lambda2_0, "m2", "lambda2_0"), "lambda2_0")
    given = _noise(how.noise, cube.unit, len(voxels.freq), bool(how.divide_by_i))
    product = Product(phi, lambda2 - centre, voxels.scaled / w.sum(), real)
    pixels = voxels.values[0, 0].size
    chunks = _Chunks(voxels, product, phi)
    data, found = _transformed(chunks, pixels, how.out, progress)
    measured = voxels.measured([part for _, part in found])
    span = np.ptp(phi)
    steps = np.arange(1 - len(phi), len(phi)) if span else np.zeros(1)
    result = FaradayCube(
        data=data.reshape(len(phi), *voxels.values.shape[2:]),
        depths=phi,
        freq_hz=voxels.freq,
        weights=voxels.weight,
        lambda2_0=centre,
        rmsf_depths=steps * (span / max(1, len(phi) - 1)),
        rmsf=np.ones(1, complex),
        unit=cube.unit,
        stokes=stokes,
        noise=None if given is None else voxels.of_sum(given[voxels.channels] * voxels.scaled / w),
        measured_noise=voxels.of_sum(measured),
        channel_noise=voxels.all_channels(measured if given is None else given[voxels.channels] * voxels.scaled / w),
        flags=_flags([part for part, _ in found], len(voxels.freq), pixels, chunks.size),
        pixel_rad=cube.pixel_rad,
        centre=cube.centre,
        reference_hz=voxels.reference,
        spectral_index=how.spectral_index,
        divided=bool(how.divide_by_i),
    )
    object.__setattr__(result, "rmsf", result.rmsf_at(result.rmsf_depths))
    for text in band.complaints(phi) if stokes == "P" and band is not None else ():
        warn(text)
    return result


class _Voxels:
    """One Stokes parameter, or Q and U, of the channels of a cube with data and weight: read, flagged, divided by I."""

    def __init__(
        self,
        cube: StokesCube,
        stokes: Stokes,
        weights: Any,
        precision: Precision | None,
        index: float,
        divide_by_i: Any,
    ) -> None:
        values = np.asarray(cube.data)
        plain = {2: np.float32, 4: np.float32}.get(values.dtype.itemsize, float) if values.dtype.kind == "f" else float
        self.values = values.astype(plain, copy=False)
        double = precision == "double" if precision else self.values.dtype.itemsize > 4
        self.real: Any = np.float64 if double else np.float32
        self.stokes, self.freq = stokes, cube.freq_hz
        self.a, self.b = (1, 2) if stokes == "P" else ("IQUV".index(stokes),) * 2
        self.weight = _weights(weights, len(self.freq)) * has_data(self.values, self.a, self.b)
        if not self.weight.any():
            raise InputError(f"Stokes {stokes} of this cube has no channel with data and weight: nothing to transform")
        self.channels = np.flatnonzero(self.weight)
        self.w, self.lambda2 = self.weight[self.channels], (LIGHT / self.freq[self.channels]) ** 2
        self.reference = float(LIGHT / np.sqrt(float(self.w @ self.lambda2 / self.w.sum())))
        ratio = self.freq[self.channels] / self.reference
        self.offset, self.scaled = np.log(ratio), self.w * ratio**-index  # divides P by the spectrum
        self.order = np.argsort(self.offset, kind="stable")
        self.limit = float(np.finfo(self.real).max) / 1e3  # sums of 1e6 channels do not overflow
        modes: dict[Any, int] = {False: -1, "voxel": 0, "fit": 1, True: 2}
        if not isinstance(divide_by_i, bool | np.bool_) and divide_by_i not in get_args(Division):
            raise InputError(f"divide_by_i = {divide_by_i!r} is not one of True, False, 'voxel' or 'fit'")
        self.division = modes[bool(divide_by_i) if isinstance(divide_by_i, np.bool_) else divide_by_i]

    def of(self, first: int, n: int) -> tuple[Any, Any, Float]:
        """Values (N, 2, n) of n pixels; which have data (N, n), None where all have; what F is multiplied with (n,)."""
        x, level = np.empty((len(self.channels), 2, n), self.real), np.ones(n)
        of = self.values, self.a, self.b, self.channels, first, self.limit
        if not gather(*of, x) and self.division < 0:
            return x, None, level
        good = np.empty((len(self.channels), n), bool)
        if (wrong := mark(*of, good)) >= 0:
            raise InputError(
                f"Stokes {self.stokes} has values beyond {self.limit:.2g} in channel {wrong}: make infinite pixels NaN"
            )
        if self.division >= 0:
            axis = self.w, self.offset, self.order
            divide(self.values, self.channels, first, axis, self.division, good, x, level)
        return x, good, level

    def sample(self, x: Any, good: Any, level: Float, phi: Float, size: Float) -> tuple[Any, ...]:
        """What is summed (N, m), where it has data, and the brightest depth and |F| (m,), of some pixels of a chunk."""
        values = (x[:, 0] + 1j * x[:, 1] if self.stokes == "P" else x[:, 0] + 0j) * level
        values *= (self.scaled / self.w)[:, None]
        there = np.isfinite(values) if good is None else good & np.isfinite(values)
        size = np.nan_to_num(size)
        return np.where(there, values, 0), there, phi[size.argmax(axis=0)], size.max(axis=0)

    def measured(self, samples: list[tuple[Any, ...]]) -> Float:
        """Noise of what is summed, of every channel in use (N,), from samples of all chunks."""
        value, there, depth, bright = (np.concatenate(part, axis=-1) for part in zip(*samples, strict=True))
        if self.stokes != "P":
            bright = np.zeros(len(bright))  # real: what is smooth along frequency is at depth 0
        return channel_noise(value, there, depth, bright, self.lambda2, self.w, self.stokes != "P")

    def of_sum(self, sigma: Float) -> float:
        """Noise of F, of that of the channels in use (N,)."""
        return float(np.sqrt(((self.w * sigma) ** 2).sum()) / self.w.sum())

    def all_channels(self, values: Float) -> Float:
        """Values of the channels in use (N,) as (F,), NaN for the others."""
        out = np.full(len(self.freq), np.nan)
        out[self.channels] = values
        return out


class _Chunks:
    """Chunks of pixels of one synthesis, brought to the depths phi (D,)."""

    def __init__(self, voxels: _Voxels, product: Product, phi: Float) -> None:
        self.voxels, self.product, self.phi = voxels, product, phi
        self.planes, pixels = (2 if voxels.stokes == "P" else 1), voxels.values[0, 0].size
        each = 2 * len(product.rows) * self.planes * voxels.real().itemsize
        self.size = int(np.clip(CHUNK_BYTES // each, 64, 8192))
        self.sample = -(-SAMPLE * self.size // pixels)

    def transform(self, first: int, data: Complex) -> Any:
        """F of the pixels from `first` on into data (D, pixels); bits of what is missing, a sample for the noise."""
        voxels, w = self.voxels, self.voxels.w
        n = min(self.size, data.shape[1] - first)
        x, good, level = voxels.of(first, n)
        factor, missing = np.ones(n, voxels.real), None
        if good is not None:
            if not good.all():
                missing = np.zeros((len(voxels.freq), n), bool)
                missing[voxels.channels] = ~good
                missing = np.packbits(missing, axis=0)
            left = w @ good
            factor[:] = np.divide(level * w.sum(), left, out=np.full(n, np.nan), where=left > 0)
        sums = self.product(x[:, : self.planes].reshape(len(w), -1)).reshape(2, -1, self.planes, n)
        merge = combine if voxels.stokes == "P" else combine_real
        merge(sums, self.product.place, self.product.sign, factor, first, data)
        some = slice((n - min(n, self.sample)) // 2, (n + min(n, self.sample)) // 2)
        f = np.abs(data[:, first + some.start : first + some.stop])
        part = good if good is None else good[:, some]
        return missing, voxels.sample(x[:, :, some], part, level[some], self.phi, f)


def _transformed(chunks: _Chunks, pixels: int, out: Any, progress: Any) -> tuple[Complex, list[Any]]:
    """F (D, pixels), in memory or mapped from a file, and what every chunk found."""
    depths, size = len(chunks.phi), chunks.size
    kind = np.dtype(np.complex128 if chunks.voxels.real is np.float64 else np.complex64)
    if out is None:
        what = f"a Faraday cube of {depths} depths and {pixels} pixels"
        afford(depths * pixels * kind.itemsize, what, "give fewer depths, a part of the image, or out='f.npy'")
    every = max(1, RELEASE_BYTES // (depths * size * kind.itemsize))
    with allocated((depths, pixels), kind, out) as (data, release):
        found = in_threads(
            lambda first: chunks.transform(first, data), range(0, pixels, size), progress, release, every
        )
    if out is not None:
        data = np.load(out, mmap_mode="c")  # what is written to the array does not go to the file
    return data, found


def _depths(depths: Any, voxels: _Voxels) -> tuple[Float, FaradayBand | None]:
    """The depths asked for, or those that the band has by default; and the band."""
    from astropy import units as u

    band = FaradayBand.of(voxels.freq * u.Hz, voxels.weight)
    if depths is None:
        return band.depths(), None
    phi = np.atleast_1d(number(depths, "rad/m2", "depths"))
    if phi.ndim != 1 or not len(phi):
        raise InputError(f"depths have shape {phi.shape}: give one axis of at least one depth in rad/m²")
    return phi, band


def _flags(found: list[Any], channels: int, pixels: int, size: int) -> Any:
    """Bits of voxels that are missing (F / 8, pixels), of those of chunks of pixels; None where there are none."""
    if all(part is None for part in found):
        return None
    flags = np.zeros((-(-channels // 8), pixels), np.uint8)
    for first, part in zip(range(0, pixels, size), found, strict=True):
        if part is not None:
            flags[:, first : first + part.shape[1]] = part
    return flags


def _weights(weights: Any, channels: int) -> Float:
    out = np.ones(channels) if weights is None else number(weights, "", "weights")
    if out.shape != (channels,) or (out < 0).any():
        raise InputError(f"weights must be {channels} numbers, one a channel and none below 0; 0 leaves a channel out")
    return out


def _noise(noise: Any, unit: str, count: int, divided: bool) -> Float | None:
    """Sigmas (F,) in the unit of the cube, given as one for all channels or one each."""
    if noise is None:
        return None
    sigma = number(noise, unit, "noise")
    if sigma.shape not in ((), (count,)) or (sigma < 0).any():
        raise InputError(f"noise must be one number or {count} (one a channel), none below 0")
    if divided:
        raise InputError("noise of the channels says nothing about Q/I and U/I: leave it out, it is measured")
    return np.broadcast_to(sigma, count).astype(float)
