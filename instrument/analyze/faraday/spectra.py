"""Spectra in Faraday depth of every pixel, with their RMSF, noise and flags: what a `FaradayCube` holds."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

from instrument.analyze.faraday.band import FaradayBand, PerhapsNaN, number
from instrument.checked import checked
from instrument.observe.directions import LIGHT
from instrument.shown import short_repr
from instrument.units import Complex, Direction, Float


@checked
@dataclass(frozen=True, eq=False)
class FaradaySpectra:
    """Data and axes of a `FaradayCube`, whose fields are described there, and what follows from them."""

    __repr__ = short_repr
    data: Complex
    depths: Float
    freq_hz: Float
    weights: Float
    lambda2_0: float
    rmsf_depths: Float
    rmsf: Complex
    unit: str
    stokes: str
    noise: float | None
    measured_noise: PerhapsNaN
    channel_noise: Float
    flags: Any
    pixel_rad: float
    centre: Direction | None
    reference_hz: float  # of spectral_index and divide_by_i
    spectral_index: float | None = None
    divided: bool = False

    @property
    def lambda2(self) -> Float:
        """Wavelengths squared of the channels, m² (F,)."""
        return (LIGHT / self.freq_hz) ** 2

    @cached_property
    def band(self) -> FaradayBand:
        """Resolution, largest depth and largest scale of the channels that count."""
        from astropy import units as u

        return FaradayBand.of(self.freq_hz * u.Hz, self.weights)

    @property
    def fwhm(self) -> float:
        """Full width at half maximum of the RMSF of pixels without flags, rad/m²."""
        return self.band.fwhm

    @property
    def flagged(self) -> bool:
        """Whether single voxels (not whole channels) are missing: their pixels have RMSFs of their own."""
        return self.flags is not None

    def has_voxel(self, pixels: slice) -> Any:
        """Which voxels have data, bool (F, n), of a slice of the pixels in rows; channels left out have none."""
        return self.has_pixels(np.arange(*pixels.indices(self.data[0].size)))

    def has_pixels(self, pixels: Any) -> Any:
        """Which voxels of some pixels (indices, n) have data, bool (F, n); channels left out have none."""
        used = self.weights > 0
        if self.flags is None:
            return np.broadcast_to(used[:, None], (len(used), len(pixels)))
        return used[:, None] & (np.unpackbits(self.flags[:, pixels], axis=0, count=len(used)) == 0)

    def noise_map(self) -> Float:
        """Noise of every pixel (Ny, Nx): `noise` or else `measured_noise`, more where voxels are missing."""
        shape = self.data.shape[1:]
        level = self.noise if self.noise is not None else self.measured_noise
        out = np.full(shape[0] * shape[1], level)
        if self.flags is not None:
            w, size = self.weights, max(1, (32 << 20) // len(self.weights))
            square = (w * np.nan_to_num(self.channel_noise, nan=1.0)) ** 2
            square = square if square.any() else w**2
            whole = square.sum() / w.sum() ** 2
            for start in range(0, out.size, size):
                there = self.has_voxel(slice(start, start + size))
                with np.errstate(invalid="ignore"):
                    out[start : start + size] *= np.sqrt((square @ there) / (w @ there) ** 2 / whole)
        return out.reshape(shape)

    def rmsf_at(self, depths: Any) -> Complex:
        """R(phi) at depths in rad/m², of pixels without flags; the shape of the depths."""
        phi = number(depths, "rad/m2", "depths")
        waves: Any = np.exp(-2j * np.multiply.outer(phi, self.lambda2 - self.lambda2_0))
        return np.asarray(waves @ self.weights / self.weights.sum(), complex)
