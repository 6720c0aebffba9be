"""ImageSky: a sky of pixels, Stokes images in every channel."""

from __future__ import annotations

from collections.abc import Callable
from functools import cached_property
from typing import Annotated, Any, Self

import numpy as np
from pydantic import model_validator

from instrument.checked import checked
from instrument.errors import InputError
from instrument.numbers import Finite
from instrument.sky.pixels import PixelSky
from instrument.units import ArrayOf, Direction, Float, Int, PositiveHertzArray

NEAR = 1e-6  # of the frequency: two channels that near are one


@checked
class ImageSky(PixelSky):
    """Stokes I, Q, U, V in Jy per pixel, real (F, 4, Ny, Nx): each pixel is a point at its centre, constant in time.

    `frequencies` are those of the channels; without any, one image is that of every frequency. One image with one
    frequency and a `spectral_index` is at f as it stands times (f / f0)^index (of Jy: that of kelvin plus 2). A grid
    without a centre is placed about the phase centre. `remarks` (what, how) stand in the plan under "not modelled".
    Raises `InputError` for pixels without data, which must be given a value first.
    """

    stokes: Annotated[Any, ArrayOf(float, (None, 4, None, None))]
    frequencies: PositiveHertzArray | None = None
    spectral_index: Finite | None = None
    remarks: tuple[tuple[str, str], ...] = ()

    @model_validator(mode="after")
    def _consistent(self) -> Self:
        channels, images = len(self.stokes), self.stokes.shape[2:]
        if images != self.grid.pixels:
            raise InputError(f"stokes has images of {images}, the grid {self.grid.pixels}: give (channels, 4, Ny, Nx)")
        known = 1 if self.frequencies is None else len(self.frequencies)
        if channels != known:
            say = "no frequencies" if self.frequencies is None else f"{known} frequencies"
            raise InputError(f"stokes has {channels} channels but {say}: give one frequency for each")
        if self.spectral_index is not None and (channels > 1 or self.frequencies is None):
            raise InputError(
                f"spectral_index = {self.spectral_index:g} is of one image with its frequency, there are {channels} "
                f"images and {0 if self.frequencies is None else known} frequencies: leave it out, or give one of each"
            )
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
        if self.spectral_index is not None:
            return np.asarray(self.stokes * self._scale(freq_hz)[:, None, None, None])
        if self.frequencies is None:
            return np.broadcast_to(self.stokes, (len(freq_hz), *self.stokes.shape[1:]))
        return np.asarray(self.stokes[self._rows(freq_hz)])

    def _scale(self, freq_hz: Float) -> Float:
        """What the image is multiplied with at each frequency (F,)."""
        freq_hz = np.atleast_1d(freq_hz)
        if self.spectral_index is None or self.frequencies is None:
            return np.ones(len(freq_hz))
        return np.asarray((freq_hz / self.frequencies[0]) ** self.spectral_index)

    def _rows(self, freq_hz: Float) -> Int:
        """Which image is that of each channel (F,)."""
        freq_hz = np.atleast_1d(freq_hz)
        if self.frequencies is None or self.spectral_index is not None:
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

    def taker(self, freq_hz: Float) -> Callable[[Int], Float]:
        """What gives Stokes parameters (F, S, 4) of some pixels of the list in some channels, without a copy of all."""
        flat, channels = self.stokes.reshape(*self.stokes.shape[:2], -1), self._rows(freq_hz)[:, None]
        if self.spectral_index is None:
            return lambda rows: np.asarray(flat[channels, :, rows])
        scale = self._scale(freq_hz)[:, None, None]
        return lambda rows: np.asarray(flat[channels, :, rows] * scale)

    def nonzero(self, freq_hz: Float) -> tuple[bool, bool, bool, bool]:
        """Which of I, Q, U, V differ from zero in any pixel of these channels."""
        found = self._nonzero[np.unique(self._rows(freq_hz))].any(axis=0)
        return tuple(found.tolist())

    @cached_property
    def _nonzero(self) -> Any:
        return np.any(self.stokes != 0, axis=(2, 3))

    def cells_jy(self, freq_hz: Float) -> Float:
        """|I| + P in every cell of the outline, Jy (F, N)."""
        return np.asarray(self._cells_jy[self._rows(freq_hz)] * self._scale(freq_hz)[:, None])

    @cached_property
    def _cells_jy(self) -> Float:
        return np.stack([self.in_cells(images) for images in self.stokes])

    def doubts(self, freq_hz: Float) -> dict[str, str]:
        """Its remarks."""
        return dict(self.remarks)
