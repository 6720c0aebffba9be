"""ImageOperator: an engine made ready for images: the visibilities of any image, and the image of any visibilities."""

from __future__ import annotations

from abc import abstractmethod
from dataclasses import replace
from typing import Self

from instrument.errors import InputError
from instrument.observe.grid import ImageGrid
from instrument.predict.base import Prepared
from instrument.sky.pixels import PixelSky
from instrument.units import Complex, Float, Int

STOKES = (0, 1, 2, 3)  # I, Q, U, V
SAME = 1e-9  # by which pixels and ranges may differ


class ImageOperator(Prepared):
    """The linear map A of images x, real (F, 4, Ny, Nx), to visibilities (T, F, B, 2, 2), and its exact adjoint.

    Exact means: Re sum conj(y) A x = sum x A^H y to rounding for all x and y, however well A approximates the sums; so
    both use the same numbers. The grid is that of the sky of the problem, and A x for its images are the sums.
    """

    @property
    def sky(self) -> PixelSky:
        """The sky of the problem, an image."""
        sky = self.problem.sky
        assert isinstance(sky, PixelSky)  # or it would have been refused
        return sky

    def demand(self, grid: ImageGrid, uv_range: tuple[float, float] | None) -> None:
        """Raise `InputError` where an imager has other images, or takes visibilities that the operator leaves at 0."""
        mine, own = self.sky.grid, self.problem.uv_range
        if mine.pixels != grid.pixels or abs(mine.pixel / grid.pixel - 1) > SAME:
            raise InputError(
                f"the operator is of images of {mine} of {mine.pixel:.6g} rad, the imager of {grid} of "
                f"{grid.pixel:.6g} rad: give both the same"
            )
        low, high = uv_range or (0.0, float("inf"))
        if own is not None and (low < own[0] * (1 - SAME) or high > own[1] * (1 + SAME)):
            asked = "all baselines" if uv_range is None else f"uv_range = {list(uv_range)}"
            raise InputError(
                f"the operator is of {own[0]:g} to {own[1]:g} wavelengths, and the imager takes {asked}: give it that "
                "range, or prepare the operator by a plan with the range of the imager"
            )

    def within(self, uv_range: tuple[float, float] | None) -> Self:
        """The operator of these visibilities alone, and 0 for others; itself where it has a range already."""
        if uv_range is None or self.problem.uv_range is not None:
            return self
        return replace(self, problem=replace(self.problem, uv_range=uv_range))

    @abstractmethod
    def forward(self, images: Float, times: slice, channels: slice, pairs: tuple[Int, Int] | None = None) -> Complex:
        """A x: visibilities in Jy, complex (T, F, B, 2, 2), of images (F, 4, Ny, Nx) of these channels in Jy/pixel."""

    @abstractmethod
    def adjoint(
        self,
        data: Complex,
        times: slice,
        channels: slice,
        pairs: tuple[Int, Int] | None = None,
        kinds: tuple[int, ...] = STOKES,
    ) -> Float:
        """A^H y: images, real (F, 4, Ny, Nx), of visibilities (T, F, B, 2, 2) of whole atoms; those of blocks add up.

        Of some `kinds` of Stokes parameters only, 0 in the others, where that is less work. No weights and no
        normalisation: multiply the data by weights, divide by what the sum of them needs.
        """

    def sums(self, times: slice, channels: slice, pairs: tuple[Int, Int] | None = None) -> Complex:
        """Visibilities in Jy, complex (T, F, B, 2, 2), of the images of the sky."""
        return self.forward(self.sky.planes(self.problem.at.freq_hz[channels]), times, channels, pairs)
