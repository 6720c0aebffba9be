"""Images of the point spread function of a cube, from a FITS cube of them."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

import numpy as np

from instrument.checked import checked
from instrument.errors import FileError, InputError
from instrument.files.fits import read_cube
from instrument.image.cube import StokesCube
from instrument.image.psf import Psf, fit_psf


@checked
def read_psf(path: str | os.PathLike[str], cube: StokesCube) -> Psf:
    """PSF of a cube: images (F, Ny, Nx) of a FITS file, peak 1 at the centre pixel, and the beams fitted to them.

    One channel stands for all. Where the file names no frequencies those of the cube are taken. Raises `FileError`
    where grid or channels are not those of the cube, or a channel has no peak of 1 (within 1 %) at its centre pixel.
    """
    file = Path(path).name
    found = _read(path, cube)
    if found.data.shape[2:] != cube.data.shape[2:] or abs(found.pixel_rad / cube.pixel_rad - 1) > 1e-6:
        sizes = (f"{c.data.shape[3]} x {c.data.shape[2]} of {60 * np.rad2deg(c.pixel_rad):.6g}'" for c in (found, cube))
        raise FileError(f"{file} and the cube have pixels {' and '.join(sizes)}: needed the same grid")
    if len(found.data) not in (1, len(cube.data)):
        raise FileError(f"{file} has {len(found.data)} channels, the cube {len(cube.data)}: needed as many, or one")
    off = len(found.data) > 1 and not np.allclose(found.freq_hz, cube.freq_hz, rtol=1e-6, atol=0)
    if off:
        k = int(np.argmax(np.abs(found.freq_hz / cube.freq_hz - 1)))
        both = f"{found.freq_hz[k] / 1e6:.9g} and {cube.freq_hz[k] / 1e6:.9g} MHz"
        raise FileError(f"{file} and the cube have channel {k} at {both}: needed the same channels")
    planes = found.data[:, 0].astype(float)
    top = planes[:, planes.shape[1] // 2, planes.shape[2] // 2]
    peak = np.array([np.nanmax(p) if np.isfinite(p).any() else np.nan for p in planes])
    wrong = np.isfinite(peak) & ~((np.abs(top - 1) < 0.01) & (peak < 1.01))
    if wrong.any():
        k = int(np.flatnonzero(wrong)[0])
        what = f"channel {k} has {top[k]:.4g} at the centre pixel and {peak[k]:.4g} at most"
        raise FileError(f"{file}: {what}: a PSF has its peak, 1, at pixel (Ny // 2, Nx // 2)")
    return fit_psf(planes, cube.pixel_rad).of(len(cube.data))


def _read(path: Any, cube: StokesCube) -> StokesCube:
    """The file as it says, or with what it does not say: Stokes I, Jy/beam, the frequencies of the cube."""
    from astropy import units as u

    error: InputError | None = None
    tries: tuple[dict[str, Any], ...] = ({}, {"stokes": "I"}, {"stokes": "I", "frequencies": cube.freq_hz * u.Hz})
    for given in tries:
        try:
            return read_cube(path, unit="Jy/beam", **given)
        except InputError as refused:
            error = error or refused
    assert error is not None
    raise error
