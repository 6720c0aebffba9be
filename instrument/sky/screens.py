"""Polarized emission in Faraday screens: random fields, their sum at any wavelength, and where its peak is."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import Annotated, Any

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from instrument.component import Component
from instrument.errors import InputError
from instrument.observe.directions import LIGHT
from instrument.units import Complex, Float, Radians

ARCMIN = np.pi / 180 / 60
REFERENCE = 150e6  # Hz
Real32 = NDArray[np.float32]
Positive = Annotated[float, Field(gt=0, allow_inf_nan=False)]
NotNegative = Annotated[float, Field(ge=0, allow_inf_nan=False)]
Finite = Annotated[float, Field(allow_inf_nan=False)]


class Screens(Component):
    """Faraday screens that emit: depths in rad/m², each with brightness exp(-(phi - brightest)² / 2 width²) + floor.

    Each emits a complex Gaussian field of angular power l^-slope between `uv_range` (wavelengths), and its Faraday
    depth varies over the field by a real one of rms `ripple` (rad/m²) and slope `ripple_slope`. `fwhm` is the beam at
    150 MHz, the same in all channels or (`chromatic`) as wide as the wavelength. Brightness goes as nu^spectral_index.
    The largest |F(phi)| becomes `peak_k` kelvin and lies at `brightest`.
    """

    depths: tuple[Finite, ...] = (-1.5, -0.75, 0.0, 0.6, 1.2, 1.8, 2.5, 3.3, 4.1, 5.0)
    brightest: Finite = 1.2
    width: Positive = 1.0
    floor: NotNegative = 0.15
    slope: Finite = 2.2
    uv_range: tuple[NotNegative, Positive] = (30.0, 800.0)
    fwhm: Annotated[Radians, Field(ge=0)] = 4.3 * ARCMIN
    chromatic: bool = False
    ripple: NotNegative = 0.15
    ripple_slope: Finite = 8 / 3
    spectral_index: Finite = -2.55
    peak_k: Positive = 5.0

    @property
    def weights(self) -> Float:
        """Brightness of each screen (K,)."""
        off = (np.array(self.depths) - self.brightest) / self.width
        return np.asarray(np.exp(-0.5 * off**2) + self.floor)

    def beam_rad(self, freq_hz: Float) -> Float:
        """Full width of the beam at half maximum (F,)."""
        return np.asarray(self.fwhm * (REFERENCE / freq_hz if self.chromatic else np.ones(len(freq_hz))))

    def check(self, pixels: int, pixel_rad: float) -> None:
        """Raise `InputError` for screens that a grid cannot have."""
        if not self.depths or not self.uv_range[0] < self.uv_range[1]:
            raise InputError(f"screens need depths and a uv_range that grows, got {self.depths}, {self.uv_range}")
        uv = uv_of(pixels, pixel_rad)
        if not ((uv > 0) & (uv >= self.uv_range[0]) & (uv <= self.uv_range[1])).any():
            raise InputError(
                f"{pixels} pixels have no cell within uv_range = {self.uv_range}: take more or larger ones"
            )

    def bytes_of(self, pixels: int) -> float:
        """What the fields of all screens take, complex64 and float32, with a transform beside them."""
        return float(pixels) ** 2 * 8.0 * (2 * len(self.depths) + 4)


TEN = Screens()  # the recipe
FINE = Screens(
    depths=tuple(np.linspace(-1.5, 5, 27).tolist()),
    width=0.55,
    floor=0.04,
    uv_range=(0.0, 800.0),
    fwhm="3 arcmin",
    chromatic=True,
    ripple=0.0,
)


@dataclass(frozen=True, eq=False)
class Emission:
    """The fields of screens on N x N pixels: what each emits, complex64, and ripples of its depth, float32 (N, N)."""

    screens: Screens
    pixel_rad: float
    emitted: tuple[Complex, ...]
    ripples: tuple[Real32, ...]

    @classmethod
    def draw(cls, screens: Screens, pixels: int, pixel_rad: float, seed: int) -> Emission:
        """Fields of a seed; with a beam that is the same in all channels they are blurred already."""
        uv, rng = uv_of(pixels, pixel_rad), np.random.default_rng(seed)
        emitted = [random_field(rng, uv, screens.slope, screens.uv_range) for _ in screens.depths]
        emitted = [unit_rms(e if screens.chromatic else filtered(e, _transfer(uv, screens.fwhm))) for e in emitted]
        ripples = [
            np.float32(screens.ripple)
            * unit_rms(random_field(rng, uv, screens.ripple_slope, (0, screens.uv_range[1])).real)
            for _ in (screens.depths if screens.ripple else ())
        ]
        return cls(screens, pixel_rad, tuple(emitted), tuple(ripples))

    def at(self, freq_hz: float, pixels: Any = slice(None)) -> Complex:
        """Q + iU = sum_k A_k e_k (nu / 150 MHz)^s exp(2i (phi_k + d_k) lambda²), complex64 (N N,) or some `pixels`."""
        screens, lambda2 = self.screens, (LIGHT / freq_hz) ** 2
        few = slice(None) if screens.chromatic else pixels
        total = np.zeros_like(self.emitted[0].reshape(-1)[few])
        for k, (e, phi, weight) in enumerate(zip(self.emitted, screens.depths, screens.weights, strict=True)):
            turned = e.reshape(-1)[few] * np.complex64(weight * np.exp(2j * phi * lambda2))
            if self.ripples:
                phase = np.float32(2 * lambda2) * self.ripples[k].reshape(-1)[few]  # a few rad: float32 is enough
                turn = np.empty_like(turned)
                turn.real, turn.imag = np.cos(phase), np.sin(phase)
                turned *= turn
            total += turned
        if screens.chromatic:
            shape = self.emitted[0].shape
            width = float(screens.beam_rad(np.array([freq_hz]))[0])
            total = filtered(total.reshape(shape), _transfer(uv_of(shape[0], self.pixel_rad), width))
            total = total.reshape(-1)[pixels]
        total *= np.float32((freq_hz / REFERENCE) ** screens.spectral_index)
        return total


@lru_cache(maxsize=2)
def emission(screens: Screens, pixels: int, pixel_rad: float, seed: int) -> Emission:
    """`Emission.draw`, the latest two remembered: 30 MB for ten screens of 480 x 480."""
    return Emission.draw(screens, pixels, pixel_rad, seed)


@lru_cache(maxsize=8)
def turned_to_peak(
    screens: Screens, pixels: int, pixel_rad: float, seed: int, band: tuple[float, float], channels: int
) -> tuple[float, float]:
    """Factor and shift in rad/m² that put the largest |F(phi)| of even channels of a band at its height and depth.

    Looked for in every fifth channel; pixels within 4 % of the highest of these, in all of them.
    """
    freq = np.linspace(*band, channels)
    fields = emission(screens, pixels, pixel_rad, seed)
    few = freq[:: max(1, (channels - 1) // 32)]
    near = np.flatnonzero((found := _coarse(screens, few, np.stack([fields.at(f) for f in few]))) > 0.96 * found.max())
    spectra = np.stack([fields.at(f, near) for f in freq]).astype(complex)
    return turn_of(screens, (LIGHT / freq) ** 2, spectra)


def _coarse(screens: Screens, freq_hz: Float, spectra: Any) -> Float:
    return highest(screens, (LIGHT / freq_hz) ** 2, lambda part: spectra[:, part], spectra.shape[1])


CHUNK = 16384  # pixels whose Faraday spectra are searched at once


def highest(screens: Screens, lambda2: Float, spectra: Any, count: int) -> Float:
    """Largest |F(phi)| of each pixel (S,), in steps of 0.1 rad/m²; `spectra(slice)` gives Q + iU (F, S) of some."""
    kernel = (np.exp(-2j * np.multiply.outer(_depths(screens, lambda2), _off(lambda2))) / len(lambda2)).astype(
        np.complex64
    )
    return np.concatenate([np.abs(kernel @ spectra(slice(i, i + CHUNK))).max(axis=0) for i in range(0, count, CHUNK)])


def turn_of(screens: Screens, lambda2: Float, spectra: Any) -> tuple[float, float]:
    """Factor and shift in rad/m² that the highest |F(phi)| of spectra (F, S), in steps of 0.005 rad/m², asks for."""
    depths = _depths(screens, lambda2)
    fine = np.arange(depths[0], depths[-1] + 0.002, 0.005) if len(lambda2) > 1 else depths
    found = np.abs(np.exp(-2j * np.multiply.outer(fine, _off(lambda2))) @ spectra) / len(lambda2)
    i, _ = np.unravel_index(np.argmax(found), found.shape)
    shift = screens.brightest - fine[i] if len(lambda2) > 1 else 0.0
    return float(screens.peak_k / found.max()), float(shift)


def _off(lambda2: Float) -> Float:
    return np.asarray(lambda2 - lambda2.mean())


def _depths(screens: Screens, lambda2: Float) -> Float:
    if len(lambda2) < 2:
        return np.zeros(1)
    return np.arange(min(screens.depths) - 2, max(screens.depths) + 2.05, 0.1)


def uv_of(pixels: int, pixel_rad: float) -> Float:
    """Length of the baseline of every cell, wavelengths (N, N)."""
    u = np.fft.fftfreq(pixels, pixel_rad)
    return np.asarray(np.hypot(u[:, None], u))


def _transfer(uv: Float, fwhm_rad: float) -> Float:
    """Transform of a round Gaussian of peak transfer 1."""
    return np.asarray(np.exp(-((np.pi * fwhm_rad * uv) ** 2) / (4 * np.log(2))))


def random_field(rng: np.random.Generator, uv: Float, slope: float, uv_range: tuple[float, float]) -> Complex:
    """Complex Gaussian field of power uv^-slope within a range, complex64."""
    from ducc0 import fft

    use = (uv > 0) & (uv >= uv_range[0]) & (uv <= uv_range[1])
    amplitude = np.where(use, np.where(uv > 0, uv, 1.0) ** (-slope / 2), 0.0).astype(np.float32)
    white = rng.standard_normal((*uv.shape, 2), dtype=np.float32).view(np.complex64)[..., 0]
    return np.asarray(fft.c2c(white * amplitude, forward=False, nthreads=0))


def unit_rms(field: Any) -> Any:
    """A field over its rms."""
    return field / np.float32(np.sqrt(np.mean(np.abs(field) ** 2, dtype=np.float64)))


def filtered(field: Complex, transfer: Float) -> Complex:
    """A complex field times a transfer function in its Fourier plane, complex64 (N, N)."""
    from ducc0 import fft

    cells = fft.c2c(field, nthreads=0)
    cells *= transfer.astype(np.float32)
    return np.asarray(fft.c2c(cells, forward=False, inorm=2, nthreads=0))
