"""Gridding: visibilities of an image and images of visibilities, by ducc0's w-gridder, in our signs and axes."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

from instrument.observe.directions import LIGHT
from instrument.observe.grid import ImageGrid
from instrument.units import Complex, Float

LEAST = 32  # pixels a side that ducc0 is given: smaller images stand in the middle of zeros
FINEST = 2e-13  # the smallest error that is asked of it
FEW = 400_000  # products of visibilities and pixels up to which a matrix of fringes is made: 6 MB, and no transforms


@dataclass(frozen=True)
class Gridder:
    """Images (Ny, Nx) of pixels of so many rad, x to the west, seen at `uvw` (N, 3) in wavelengths about their centre.

    The sums of `accuracy`, relative to their norm, and one the exact adjoint of the other.
    """

    uvw: Float
    pixels: tuple[int, int]
    pixel: float
    accuracy: float
    threads: int = 1

    def visibilities(self, image: Float) -> Complex:
        """sum_p image_p exp(-2 pi i (u l + v m + w (n - 1))), complex (N,)."""
        if self._fringes is not None:
            return np.asarray(self._fringes @ image.ravel())
        from ducc0.wgridder.experimental import dirty2vis

        return np.asarray(dirty2vis(dirty=self._padded(image), **self._given())[:, 0])

    def image(self, data: Complex) -> Float:
        """Re sum_k data_k exp(+2 pi i (u l + v m + w (n - 1))), real (Ny, Nx)."""
        if self._fringes is not None:
            return np.asarray((data.conj() @ self._fringes).real.reshape(self.pixels))
        from ducc0.wgridder.experimental import vis2dirty

        nx, ny = (_even(n) for n in self.pixels[::-1])
        # ducc0 leaves zeros out, and with them what it chose its planes by: the adjoint would be that of another sum
        data = np.where(data == 0, 1e-150, data)
        wide = vis2dirty(vis=data[:, None], npix_x=nx, npix_y=ny, **self._given())
        return np.asarray(wide.T[self._inner()])

    @cached_property
    def _fringes(self) -> Complex | None:
        """exp(-2 pi i (u l + v m + w (n - 1))) (N, Ny Nx), where they are few: exact."""
        if len(self.uvw) * self.pixels[0] * self.pixels[1] > FEW:
            return None
        cycles = self.uvw @ ImageGrid.of(self.pixels, self.pixel).lmn.T
        return np.exp(-2j * np.pi * (cycles - np.rint(cycles)))

    def _given(self) -> dict[str, Any]:
        # a wavelength is 1 m; ducc0 has exp(+2 pi i (u l + v m - w (n-1))) for images: flip w, and u for x to the west
        return {
            "uvw": self.uvw, "freq": _METRE, "pixsize_x": self.pixel, "pixsize_y": self.pixel,
            "epsilon": max(self.accuracy, FINEST), "do_wgridding": True, "divide_by_n": False,
            "flip_u": True, "flip_w": True, "nthreads": self.threads,
        }  # fmt: skip

    def _inner(self) -> tuple[slice, slice]:
        """Where an image stands in one that ducc0 takes: their centres, N // 2, are one."""
        first = [_even(n) // 2 - n // 2 for n in self.pixels]
        return slice(first[0], first[0] + self.pixels[0]), slice(first[1], first[1] + self.pixels[1])

    def _padded(self, image: Float) -> Float:
        wide = np.zeros(tuple(_even(n) for n in self.pixels))
        wide[self._inner()] = image
        return np.ascontiguousarray(wide.T)


_METRE = np.array([LIGHT])


def _even(n: int) -> int:
    return max(LEAST, n + n % 2)
