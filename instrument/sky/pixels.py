"""PixelSky: a sky that is a grid of pixels, whatever its images come from."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Callable, Iterator
from functools import cached_property
from typing import Any, ClassVar, Literal

import numpy as np

from instrument.checked import checked
from instrument.jones.mueller import brightness
from instrument.observe.grid import ImageGrid
from instrument.observe.sampling import Sampling
from instrument.sky.base import PlacedSky, power
from instrument.units import Complex, Float, Int, unit_vectors

CELLS = 32  # a side, at most: what a plan looks at of an image


@checked
class PixelSky(PlacedSky):
    """Images on a grid, Stokes I, Q, U, V in Jy per pixel (F, 4, Ny, Nx): each pixel is a point, constant in time."""

    kind: ClassVar[Literal["points", "image", "sum", "other"]] = "image"
    grid: ImageGrid

    @abstractmethod
    def planes(self, freq_hz: Float) -> Float:
        """The images of some channels (F, 4, Ny, Nx), float64; raises `InputError` for one that is not there."""

    @abstractmethod
    def cells_jy(self, freq_hz: Float) -> Float:
        """|I| + P in every cell of the outline, Jy (F, N); `in_cells` of the images."""

    @property
    @abstractmethod
    def used(self) -> Int:
        """Pixels, in the list of all, that are not zero in every channel and Stokes parameter (S,)."""

    @abstractmethod
    def taker(self, freq_hz: Float) -> Callable[[Int], Float]:
        """What gives Stokes parameters (F, S, 4) of some pixels of the list in some channels."""

    @property
    def count(self) -> int:
        """How many pixels are summed: those that are not zero throughout."""
        return len(self.used)

    @property
    def size(self) -> str:
        """How large it is, in words."""
        return str(self.grid)

    def directions(self) -> tuple[Float, Float]:
        """ICRS right ascension and declination of all pixels in rad, (Ny Nx,) each."""
        return self.grid.directions()

    def brightness(self, at: Sampling) -> Complex:
        """Brightness matrices of all pixels (1, F, Ny Nx, 2, 2)."""
        planes = self.planes(at.freq_hz)
        return brightness(np.moveaxis(planes.reshape(*planes.shape[:2], -1), 1, -1))[None]

    def envelope(self, at: Sampling, uvw_lambda: Float) -> None:
        """`None`: pixels are points."""
        return None

    def total_jy(self, freq_hz: Float) -> Float:
        """Sum of |I| + P of all pixels, Jy (F,)."""
        return np.asarray(self.cells_jy(freq_hz).sum(axis=1))

    def in_cells(self, images: Any) -> Float:
        """|I| + P of images (4, Ny, Nx), summed in every cell of the outline (N,)."""
        y, x = (edges[:-1] for edges in self._edges)
        # plane by plane, those that are there: `power` of a view along the last axis takes five times as long
        found = np.hypot(images[1], images[2])
        if images[3].any():
            found = np.hypot(found, images[3])
        if images[0].any():
            found = found + np.abs(images[0])
        return np.asarray(np.add.reduceat(np.add.reduceat(found, y, axis=0), x, axis=1).ravel())

    @cached_property
    def _edges(self) -> tuple[Int, Int]:
        """Where cells of pixels begin and end along y and x: as even as can be, at most CELLS a side."""
        first, second = (np.linspace(0, n, min(n, CELLS) + 1).round().astype(int) for n in self.grid.pixels)
        return first, second

    def pixels_of(self, cells: Int) -> tuple[Int, Int]:
        """Pixels of some cells that are not zero throughout, in the order of cells, and the cell of each, (S,) both."""
        y, x = np.divmod(self.used, self.grid.pixels[1])
        row, column = (np.searchsorted(e, at, side="right") - 1 for e, at in zip(self._edges, (y, x), strict=True))
        cell = row * (len(self._edges[1]) - 1) + column
        chosen = np.flatnonzero(np.isin(cell, cells))
        chosen = chosen[np.argsort(cell[chosen], kind="stable")]
        return self.used[chosen], cell[chosen]

    def outline(self) -> tuple[Float, Float]:
        """ICRS right ascension and declination of the middles of the cells, (N,) each."""
        y, x = ((edges[:-1] + edges[1:] - 1) / 2 for edges in self._edges)
        return self.grid.at(*(a.ravel() for a in np.meshgrid(y, x, indexing="ij")))

    @cached_property
    def reach_rad(self) -> float:
        """Half the diagonal of the largest cell."""
        middles = unit_vectors(*self.outline())
        far = 0.0
        for ends in ((0, 0), (0, 1), (1, 0), (1, 1)):
            y, x = (edges[1:] - 1 if end else edges[:-1] for edges, end in zip(self._edges, ends, strict=True))
            corners = unit_vectors(*self.grid.at(*(a.ravel() for a in np.meshgrid(y, x, indexing="ij"))))
            far = max(far, float(2 * np.arcsin(np.linalg.norm(middles - corners, axis=1).max() / 2)))
        return far

    def parts(self, most: int, freq_hz: Float) -> Iterator[PlacedSky]:
        """Pixels that are not zero throughout, in pieces of at most so many, in these channels."""
        take = self.taker(freq_hz)
        for first in range(0, len(self.used), most):
            rows = self.used[first : first + most]
            ra, dec = self.grid.directions(rows)
            yield _Pixels.model_construct(ra_rad=ra, dec_rad=dec, stokes=take(rows), freq_hz=np.atleast_1d(freq_hz))


class _Pixels(PlacedSky):
    """Some pixels of an image, Stokes parameters (F, S, 4) in the channels for which they were taken."""

    ra_rad: Any
    dec_rad: Any
    stokes: Any
    freq_hz: Any

    def directions(self) -> tuple[Float, Float]:
        """ICRS right ascension and declination, rad (S,)."""
        return self.ra_rad, self.dec_rad

    def brightness(self, at: Sampling) -> Complex:
        """Brightness matrices (1, F, S, 2, 2)."""
        assert np.array_equal(at.freq_hz, self.freq_hz)
        return brightness(self.stokes)[None]

    def envelope(self, at: Sampling, uvw_lambda: Float) -> None:
        """`None`: pixels are points."""
        return None

    def total_jy(self, freq_hz: Float) -> Float:
        """Sum of |I| + P, Jy (F,)."""
        return np.asarray(power(self.stokes).sum(axis=1))
