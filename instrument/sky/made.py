"""ImageMaker: skies of pixels that are generated about a phase centre, channel by channel; MadeImage: one placed."""

from __future__ import annotations

from abc import abstractmethod
from collections import OrderedDict
from collections.abc import Callable
from threading import Lock
from typing import Annotated, Any

import numpy as np
from pydantic import PrivateAttr

from instrument.checked import checked
from instrument.numbers import Whole
from instrument.observe.directions import LIGHT
from instrument.observe.grid import ImageGrid
from instrument.sky.base import Sky
from instrument.sky.pixels import PixelSky
from instrument.units import Direction, Float, Int, PositiveRadians

BOLTZMANN = 1.380649e-23  # J/K
JY = 1e-26  # W m^-2 Hz^-1
KEPT = 64e6  # bytes of images that are remembered, and the least is one
Side = Annotated[int, Whole(at_least=4, at_most=32768)]


def jy_per_k(freq_hz: Any, solid_angle_sr: Any) -> Any:
    """Flux in Jy of 1 K over a solid angle, Rayleigh-Jeans: 2 k nu² Omega / c²."""
    return 2 * BOLTZMANN * np.square(freq_hz) / LIGHT**2 * solid_angle_sr / JY


class ImageMaker(Sky):
    """A sky of `pixels` x `pixels` of `pixel` each, made about the phase centre at whatever frequency is asked for.

    A subclass gives `kelvin`, the images of a channel, and may say which Stokes parameters are `there`.
    """

    pixels: Side = 480
    pixel: PositiveRadians = float(np.deg2rad(0.5 / 60))

    @abstractmethod
    def kelvin(self, freq_hz: float) -> Any:
        """Stokes I, Q, U, V of one frequency in K, real (4, Ny, Nx); raises `InputError` where it has none."""

    @property
    def there(self) -> tuple[bool, bool, bool, bool]:
        """Which of I, Q, U, V are not zero throughout."""
        return (True, True, True, True)

    @property
    def held_bytes(self) -> float:
        """What it holds to make images from."""
        return 0.0

    def about(self, centre: Direction) -> MadeImage:
        """The sky for a phase centre."""
        return MadeImage(grid=ImageGrid.of((self.pixels, self.pixels), self.pixel, centre), maker=self)


@checked
class MadeImage(PixelSky):
    """Images that a maker gives (F, 4, Ny, Nx), each when it is asked for: the latest are remembered, 64 MB of them.

    A kelvin is the Jy of a pixel of `pixel`², as in `StokesCube.sky()`.
    """

    maker: ImageMaker
    _images: OrderedDict[float, Any] = PrivateAttr(default_factory=OrderedDict)
    _cells: dict[float, Any] = PrivateAttr(default_factory=dict)
    _lock: Any = PrivateAttr(default_factory=Lock)

    def __getstate__(self) -> dict[Any, Any]:
        # a lock does not travel, and images are made again where they arrive
        return {**super().__getstate__(), "__pydantic_private__": None}

    def __setstate__(self, state: dict[Any, Any]) -> None:
        super().__setstate__(state)
        self.model_post_init(None)

    def planes(self, freq_hz: Float) -> Float:
        """The images of some channels (F, 4, Ny, Nx)."""
        return np.stack([self._image(float(f)) for f in np.atleast_1d(freq_hz)])

    def _image(self, freq_hz: float) -> Any:
        """The image of one channel (4, Ny, Nx), read-only."""
        with self._lock:
            if freq_hz in self._images:
                self._images.move_to_end(freq_hz)
                return self._images[freq_hz]
        image = np.asarray(self.maker.kelvin(freq_hz), float) * jy_per_k(freq_hz, self.grid.pixel**2)
        image.setflags(write=False)
        with self._lock:
            self._images[freq_hz] = image
            while len(self._images) > max(1, int(KEPT / image.nbytes)):
                self._images.popitem(last=False)
        return image

    def cells_jy(self, freq_hz: Float) -> Float:
        """|I| + P in every cell of the outline, Jy (F, N); remembered for every channel."""
        for f in np.atleast_1d(freq_hz).tolist():
            if f not in self._cells:
                self._cells[f] = self.in_cells(self._image(f))
        return np.stack([self._cells[f] for f in np.atleast_1d(freq_hz).tolist()])

    @property
    def used(self) -> Int:
        """All pixels."""
        return np.arange(len(self.grid))

    def taker(self, freq_hz: Float) -> Callable[[Int], Float]:
        """What gives Stokes parameters (F, S, 4) of some pixels of the list in some channels."""
        planes = [self._image(float(f)).reshape(4, -1) for f in np.atleast_1d(freq_hz)]
        return lambda rows: np.stack([plane[:, rows].T for plane in planes])

    def nonzero(self, freq_hz: Float) -> tuple[bool, bool, bool, bool]:
        """Which of I, Q, U, V the maker gives."""
        return self.maker.there

    def held_bytes(self, channels: int) -> float:
        """What its images take while so many channels are summed, and what they are made from."""
        return 32.0 * len(self.grid) * (channels + 2) + self.maker.held_bytes
