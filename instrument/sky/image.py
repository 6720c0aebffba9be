"""ImageSky: a sky of pixels, Stokes images in every channel."""

from __future__ import annotations

from collections.abc import Iterator
from functools import cached_property
from typing import Annotated, Any, ClassVar, Literal, Self

import numpy as np
from pydantic import model_validator

from instrument.checked import checked
from instrument.errors import InputError
from instrument.jones.mueller import brightness
from instrument.observe.grid import ImageGrid
from instrument.observe.sampling import Sampling
from instrument.sky.base import PlacedSky, power
from instrument.units import ArrayOf, Complex, Direction, Float, Int, PositiveHertzArray, unit_vectors

CELLS = 32  # a side, at most: what a plan looks at of an image
NEAR = 1e-6  # of the frequency: two channels that near are one


@checked
class ImageSky(PlacedSky):
    """Stokes I, Q, U, V in Jy per pixel, real (F, 4, Ny, Nx): each pixel is a point at its centre, constant in time.

    `frequencies` are those of the channels; without any, one image is that of every frequency. A grid without a centre
    is placed about the phase centre. Raises `InputError` for pixels without data, which must be given a value first.
    """

    kind: ClassVar[Literal["points", "image", "other"]] = "image"
    grid: ImageGrid
    stokes: Annotated[Any, ArrayOf(float, (None, 4, None, None))]
    frequencies: PositiveHertzArray | None = None

    @model_validator(mode="after")
    def _consistent(self) -> Self:
        channels, images = len(self.stokes), self.stokes.shape[2:]
        if images != self.grid.pixels:
            raise InputError(f"stokes has images of {images}, the grid {self.grid.pixels}: give (channels, 4, Ny, Nx)")
        known = 1 if self.frequencies is None else len(self.frequencies)
        if channels != known:
            say = "no frequencies" if self.frequencies is None else f"{known} frequencies"
            raise InputError(f"stokes has {channels} channels but {say}: give one frequency for each")
        if not np.isfinite(self.stokes).all():
            bad = np.argwhere(~np.isfinite(self.stokes))[0].tolist()
            raise InputError(f"stokes{bad} is not finite: give pixels without data a value, such as 0")
        self.grid.on_the_sky()
        return self

    def about(self, centre: Direction) -> ImageSky:
        """Itself; about the phase centre where the grid has no centre of its own."""
        if self.grid.centre is not None:
            return self
        return self.with_fields(grid=self.grid.with_fields(centre=centre))

    def planes(self, freq_hz: Float) -> Float:
        """The images of some channels (F, 4, Ny, Nx); raises `InputError` for a frequency that is not there."""
        freq_hz = np.atleast_1d(freq_hz)
        if self.frequencies is None:
            return np.broadcast_to(self.stokes, (len(freq_hz), *self.stokes.shape[1:]))
        return np.asarray(self.stokes[self._rows(freq_hz)])

    def _rows(self, freq_hz: Float) -> Int:
        """Which image is that of each channel (F,)."""
        freq_hz = np.atleast_1d(freq_hz)
        if self.frequencies is None:
            return np.zeros(len(freq_hz), int)
        apart = np.abs(freq_hz[:, None] - self.frequencies)
        rows = np.argmin(apart, axis=1)
        off = apart[np.arange(len(rows)), rows] > NEAR * freq_hz
        if off.any():
            f, known = freq_hz[np.argmax(off)] / 1e6, np.asarray(self.frequencies) / 1e6
            span = f"{len(known)} from {known.min():.10g} to {known.max():.10g} MHz"
            raise InputError(
                f"the image has no channel at {f:.10g} MHz ({span}): "
                "observe the channels of the image, or make images at those of the observation"
            )
        return np.asarray(rows)

    @cached_property
    def used(self) -> Int:
        """Pixels, in the list of all, that are not zero in every channel and Stokes parameter (S,)."""
        return np.flatnonzero(np.any(self.stokes != 0, axis=(0, 1)))

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

    def nonzero(self, freq_hz: Float) -> tuple[bool, bool, bool, bool]:
        """Which of I, Q, U, V differ from zero in any pixel of these channels."""
        found = self._nonzero[np.unique(self._rows(freq_hz))].any(axis=0)
        return tuple(found.tolist())

    @cached_property
    def _nonzero(self) -> Any:
        return np.any(self.stokes != 0, axis=(2, 3))

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

    def cells_jy(self, freq_hz: Float) -> Float:
        """|I| + P in every cell of the outline, Jy (F, N)."""
        return np.asarray(self._cells_jy[self._rows(freq_hz)])

    @cached_property
    def _cells_jy(self) -> Float:
        y, x = (edges[:-1] for edges in self._edges)
        planes = (power(np.moveaxis(images, 0, -1)) for images in self.stokes)
        return np.stack([np.add.reduceat(np.add.reduceat(p, y, axis=0), x, axis=1).ravel() for p in planes])

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
        flat, channels = self.stokes.reshape(*self.stokes.shape[:2], -1), self._rows(freq_hz)[:, None]
        for first in range(0, len(self.used), most):
            rows = self.used[first : first + most]
            ra, dec = self.grid.directions(rows)
            found = flat[channels, :, rows]
            yield _Pixels.model_construct(ra_rad=ra, dec_rad=dec, stokes=found, freq_hz=np.atleast_1d(freq_hz))


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
