"""FaradayCube: spectra in Faraday depth of every pixel, with their RMSF, noise and flags."""

from __future__ import annotations

import os
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np

from instrument.analyze.faraday.band import FaradayBand, PerhapsNaN, number
from instrument.checked import checked
from instrument.observe.directions import LIGHT
from instrument.shown import short_repr
from instrument.units import Complex, Direction, Float

if TYPE_CHECKING:
    from instrument.analyze.faraday.clean import FaradayClean
    from instrument.analyze.faraday.peaks import FaradayPeaks


@checked
@dataclass(frozen=True, eq=False)
class FaradayCube:
    """Faraday dispersion function, complex (N, Ny, Nx), at depths in rad/m² (N,), in `unit` per RMSF.

    F(phi) = sum w_j P_j exp(-2i phi (lambda²_j - lambda²_0)) / sum w_j (Brentjens & de Bruyn 2005, eq. 25 to 38) of
    P = Q + iU or of a real Stokes parameter; the sums are over the voxels that have data, NaN where there is none.
    `rmsf` (R,) is the same of P = 1 with every channel that counts, at `rmsf_depths`: the differences of depths, of an
    uneven axis as many even steps. `weights` (F,) are 0 for channels left out. `noise` is that of the real and of the
    imaginary part of F (of a real Stokes parameter: of both together), None where no sigma was given;
    `measured_noise` the same from differences of neighbouring channels, the median over pixels, NaN of fewer than
    three channels.
    `channel_noise` (F,) is that of Q and of U in every channel, given or measured. `flags` are bits (F / 8, pixels),
    set where a voxel is missing, None where none is.
    """

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

    def clean(
        self,
        cutoff: Any = None,
        sigmas: float | None = None,
        gain: float = 0.1,
        iterations: int = 1000,
        progress: Callable[[float], None] | None = None,
    ) -> FaradayClean:
        """Deconvolve every spectrum (RM-CLEAN) down to |F| = `cutoff`, in the unit of the cube, or `sigmas` of noise.

        See `FaradayClean`. Raises `InputError` for depths that are not evenly spaced.
        """
        from instrument.analyze.faraday.clean import rm_clean

        return rm_clean(self, cutoff, sigmas, gain, iterations, progress)

    def peaks(self, snr: float = 8.0, noise: Any = None) -> FaradayPeaks:
        """Depth, polarized intensity and angle of the brightest peak of every pixel; see `FaradayPeaks`."""
        from instrument.analyze.faraday.peaks import find_peaks

        return find_peaks(self, snr, noise)

    def write(self, path: str | os.PathLike[str], overwrite: bool = False) -> None:
        """Write a FITS cube (axes RA, DEC, FDEP in rad/m², Stokes Q and U or real and imaginary part), with its tables.

        RMSF, CHANNELS and DEPTHS are tables; depths that are not evenly spaced are numbered on the axis and listed in
        the table only. The file is whole or not there.
        """
        from instrument.analyze.faraday.file import write_faraday

        write_faraday(self, path, overwrite)
