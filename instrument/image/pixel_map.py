"""PixelMap: what holds for the pixels of a cube without being an image of the sky: a noise, a condition number."""

from __future__ import annotations

import os
from dataclasses import dataclass
from typing import Any, Literal

from instrument.image.cube import StokesCube
from instrument.image.cube_file import write_cube
from instrument.units import Direction, Float


@dataclass(frozen=True, eq=False)
class PixelMap:
    """Values without a unit (F, 4, Ny, Nx) of I, Q, U, V, or (F, 1, Ny, Nx) of all of them, on the pixels of `cube`.

    NaN where nothing is known. `what` says in words what they are.
    """

    data: Float
    cube: StokesCube
    what: str
    unit: Literal[""] = ""
    psf: None = None

    @property
    def freq_hz(self) -> Float:
        """Channels, Hz (F,)."""
        return self.cube.freq_hz

    @property
    def centre(self) -> Direction | None:
        """The direction of pixel (Ny // 2, Nx // 2)."""
        return self.cube.centre

    @property
    def wcs(self) -> Any:
        """World coordinates, those of the cube."""
        return self.cube.wcs

    def write(self, path: str | os.PathLike[str], overwrite: bool = False) -> None:
        """Write it as FITS, float32, its axes those of the cube; whole or not at all."""
        write_cube(self, path, overwrite)
