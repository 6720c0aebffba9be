"""FaradayCube: spectra in Faraday depth of every pixel, and what is made of them: RM-CLEAN, peaks, files."""

from __future__ import annotations

import os
from collections.abc import Callable
from typing import Any

from instrument.analyze.faraday.clean import FaradayClean, rm_clean
from instrument.analyze.faraday.file import write_faraday
from instrument.analyze.faraday.peaks import FaradayPeaks, find_peaks
from instrument.analyze.faraday.spectra import FaradaySpectra
from instrument.checked import checked


@checked
class FaradayCube(FaradaySpectra):
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

    def clean(
        self,
        cutoff: Any = None,
        sigmas: float | None = None,
        gain: float = 0.1,
        iterations: int = 1000,
        progress: Callable[[float], None] | None = None,
    ) -> FaradayClean[FaradayCube]:
        """Deconvolve every spectrum (RM-CLEAN) down to |F| = `cutoff`, in the unit of the cube, or `sigmas` of noise.

        See `FaradayClean`. Raises `InputError` for depths that are not evenly spaced.
        """
        return rm_clean(self, cutoff, sigmas, gain, iterations, progress)

    def peaks(self, snr: float = 8.0, noise: Any = None) -> FaradayPeaks:
        """Depth, polarized intensity and angle of the brightest peak of every pixel; see `FaradayPeaks`."""
        return find_peaks(self, snr, noise)

    def write(self, path: str | os.PathLike[str], overwrite: bool = False) -> None:
        """Write a FITS cube (axes RA, DEC, FDEP in rad/m², Stokes Q and U or real and imaginary part), with its tables.

        RMSF, CHANNELS and DEPTHS are tables; depths that are not evenly spaced are numbered on the axis and listed in
        the table only. The file is whole or not there.
        """
        write_faraday(self, path, overwrite)
