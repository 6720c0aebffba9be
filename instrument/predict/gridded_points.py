"""GriddedPoints: very many point sources off one grid for all nodes, as images are; `gridded.py` decides.

What a transform of pixels makes of an image, a non-uniform one (ducc0) makes of sources where they are; all else,
beams at nodes, kernels and samples in time, is that of images. tests/accuracy/test_gridded_points.py holds it to sums
over all sources.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any, Self

import numpy as np
from astropy import units as u

from instrument.checked import checked
from instrument.errors import RefusedError
from instrument.jones.mueller import stokes
from instrument.observe.directions import lmn
from instrument.observe.grid import ImageGrid
from instrument.predict.base import Problem
from instrument.predict.gridded_images import GriddedImages
from instrument.predict.gridded_work import cells_of
from instrument.predict.gridding import FINEST
from instrument.predict.separable import SAFETY, WIDTHS, Kernels, fits, kernel, kernels_for
from instrument.predict.separable_atom import SeparableAtom
from instrument.units import Complex, Direction, Float, Int, unit_vectors

MANY = 300  # sources below which they are not tried where no engine is named
PRODUCTS = 1e9  # of sources and visibilities, the same
SIDE = 32  # pixels of the box about them, for what looks at its edge
LOOKED = 16  # places between cells at which it is looked how much kernels amplify
OURS = 0.25  # of what gridding may be wrong by, the share of the transforms


def few(problem: Problem) -> str | None:
    """Why sums over the sources of a problem take less than finding nodes for them; `None` where they are very many."""
    sources, visibilities = problem.sky.count, float(np.prod(problem.shape))
    if sources >= MANY and sources * visibilities >= PRODUCTS:
        return None
    return f"{sources} sources in {visibilities:.3g} visibilities are summed sooner than beams are carried over them"


@checked
class Box(ImageGrid):
    """A field about some sources, as a grid."""

    def __str__(self) -> str:
        ny, nx = (np.rad2deg(n * self.pixel) for n in self.pixels)
        return f"sources over {nx:.3g} x {ny:.3g} deg"


@dataclass(frozen=True)
class Gathered:
    """A box about some sources, and where these are about its centre: l, m, n - 1 (S, 3)."""

    box: Box
    lmn: Float


def gathered(problem: Problem) -> Gathered:
    """The box about the sources of a problem; raises `RefusedError` where they lie all over the sky."""
    vectors = unit_vectors(*problem.sky.directions())
    middle = vectors.mean(axis=0)
    size = float(np.linalg.norm(middle))
    centre = Direction(*_angles(middle / size)) if size > 0 else problem.at.centre
    found = np.asarray(lmn(vectors, centre))
    far = np.abs(found[:, :2]).max(axis=0)
    pixel = max(float(far.max()), 1e-9) / (SIDE // 2 - 1)
    sides = [2 * int(np.ceil(a / pixel) + 1) for a in far[::-1]]
    if (found[:, 2] <= -1).any() or float(np.hypot(sides[0], sides[1])) / 2 * pixel >= 1:
        raise RefusedError("sources lie all over the sky: beams are carried over a field of less than a hemisphere")
    return Gathered(Box(pixels=(sides[0], sides[1]), pixel=pixel * u.rad, centre=centre), found)


def _angles(vector: Float) -> tuple[float, float]:
    x, y, z = (float(a) for a in vector)
    return float(np.arctan2(y, x) % (2 * np.pi)), float(np.arcsin(np.clip(z, -1, 1)))


@dataclass(frozen=True)
class GriddedPoints(GriddedImages):
    """The operator of `Gridded` for points: their Stokes parameters (F, 4, S) are its images."""

    around: Gathered | None = field(default=None, kw_only=True)

    def sums(self, times: slice, channels: slice, pairs: tuple[Int, Int] | None = None) -> Complex:
        """Visibilities in Jy, complex (T, F, B, 2, 2), of the sources of the sky."""
        out = np.empty((*self.block(times, channels, pairs).shape, 2, 2), complex)
        for f, channel in enumerate(range(*channels.indices(self.problem.shape[1]))):
            one = slice(channel, channel + 1)  # the brightness of a million sources in all channels fits nowhere
            bright = self.problem.sky.brightness(self.problem.at.block(slice(0, 1), one))[0]
            fluxes: Float = np.asarray(stokes(bright).real, float)
            largest = int(np.frexp(np.abs(fluxes).max(initial=0.0))[1])
            size = np.ldexp(1.0, largest - 1)  # transforms square what they get
            seen = self.forward(np.ascontiguousarray(fluxes.swapaxes(1, 2) / size), times, one, pairs)
            out[:, f : f + 1] = np.multiply(seen, size, out=seen)
        return out

    def with_kernels(self) -> Self:
        """With one grid for all nodes; raises `RefusedError` where there is none or it is too large."""
        kernels = kernels_for(self.nodes, (1 - OURS) * self._allowed)
        if kernels is None:
            raise RefusedError("no kernel reads sources off a grid to this tolerance: give a larger one")
        found = replace(self, kernels=kernels)
        if (least := FINEST / max(found._epsilon, 1e-300)) > 1:
            raise RefusedError(f"its transforms are {least:.1f} times too coarse for this tolerance: give a larger one")
        if why := found.too_large(kernels):
            raise RefusedError(why)
        return found

    def too_large(self, kernels: Kernels | None = None) -> str | None:
        """Why there is no grid for some kernels, or for the least of all; `None` where it fits."""
        kernels = kernels or Kernels(kernel(WIDTHS[0], 0), kernel(WIDTHS[0], 0), 0.0)
        if fits(cells := cells_of(self, kernels)):
            return None
        return "the grid of {} x {} x {} cells is too large: give a smaller uv range".format(*cells)

    @property
    def grid(self) -> ImageGrid:
        """The box about the sources."""
        return self._around.box

    @property
    def extent(self) -> tuple[int, ...]:
        """How many sources."""
        return (len(self._around.lmn),)

    def plane_seconds(self, cells: tuple[int, int, int], kinds: int) -> float:
        """Of the transforms of one plane of w, of so many cells, on one core."""
        return kinds * (1e-7 * self.extent[0] + 3e-8 * cells[0] * cells[1])

    @property
    def _around(self) -> Gathered:
        assert self.around is not None  # always given
        return self.around

    @property
    def _allowed(self) -> float:
        return self.accuracy * self.nodes.growth

    @cached_property
    def _epsilon(self) -> float:
        """What may be asked of the transforms."""
        assert self.kernels is not None
        return OURS * self._allowed / _amplified(self.kernels, self.nodes.series)

    def _separable(self, *there: Any) -> SeparableAtom:
        return PointsAtom(*there, points=self._around.lmn, epsilon=self._epsilon)


def _amplified(kernels: Kernels, series: Float) -> float:
    """By how much what is wrong in cells, relative to one source, is wrong in samples of it, summed over nodes."""
    edge = [float(k.taper(np.array([0.25]))[0]) for k in (kernels.across, kernels.deep)]
    rows = kernels.across.table[:: len(kernels.across.table) // LOOKED, :, : series.shape[1]]
    found = 0.0
    for u_row, v_row in zip(rows, rows[::-1], strict=True):
        read = np.einsum("kab,ua,vb->kuv", series, u_row, v_row, optimize=True)
        found = max(found, float(np.abs(read).sum()))
    deep = float(np.abs(kernels.deep.table).sum(axis=1).max()) / edge[1]
    return SAFETY * found / edge[0] ** 2 * deep


@dataclass(frozen=True)
class PointsAtom(SeparableAtom):
    """Samples of points (S,) at l, m, n - 1 (S, 3), whose cells come of non-uniform transforms to `epsilon`."""

    points: Any = field(default=None, kw_only=True)
    epsilon: float = field(default=1e-12, kw_only=True)

    @property
    def extent(self) -> tuple[int, ...]:
        """How many points."""
        return (len(self.points),)

    def _screens(self) -> Iterator[Complex]:
        """One at each point as each plane of w sees it, over what the kernels taper it by, (S,) each."""
        middle, step = self._depth
        depth, across = self.points[:, 2] - middle, self.kernels.across
        x, y = (self._cycles[:, i] for i in range(2))
        taper = across.taper(x) * across.taper(y) * self.kernels.deep.taper(depth * step)
        turns = self._cycles @ self._middle
        ramp = np.exp(-2j * np.pi * (turns - np.rint(turns))) / taper
        first, count = (int(n[2]) for n in self.window)
        for plane in range(first, first + count):
            yield np.exp(-2j * np.pi * plane * step * depth) * ramp

    @cached_property
    def _cycles(self) -> Float:
        """Cycles a cell of each point along u and v (S, 2)."""
        return np.ascontiguousarray(self.points[:, :2] / self._sides)

    @property
    def _middle(self) -> Float:
        """The cells along u and v that are the middle of the transforms."""
        first, count = self.window
        return np.asarray(first[:2] + count[:2] // 2, float)

    def _transform(self) -> Any:
        """For one call: a plan of ducc0 works for one thread at a time, and other threads may ask for the same atom."""
        from ducc0.nufft import plan

        shape = tuple(int(n) for n in self.window[1][:2])
        return plan(
            nu2u=True, coord=self._cycles, grid_shape=shape, epsilon=max(self.epsilon, FINEST), periodicity=1.0,
            nthreads=self.threads,
        )  # fmt: skip

    def _cells(self, images: Float) -> Float:
        """Cells (nu, nw, nv 2n) of the fluxes of points (n, S)."""
        shape, (nu, nv) = self._shape(len(images)), self.window[1][:2]
        out = np.empty((shape[0], shape[1], nv, len(images)), complex)
        transform = self._transform()
        for plane, screen in enumerate(self._screens()):
            made = transform.nu2u(forward=True, points=images * screen)
            out[:, plane] = np.moveaxis(made.reshape(len(images), nu, nv), 0, -1)
        return out.reshape(shape[0], shape[1], -1).view(float)

    def _images(self, cells: Float) -> Float:
        """The adjoint of `_cells`: (n, S)."""
        nu, nv = self.window[1][:2]
        planes = cells.view(complex).reshape(nu, cells.shape[1], nv, -1)
        out = np.zeros((planes.shape[3], len(self.points)))
        transform = self._transform()
        for plane, screen in enumerate(self._screens()):
            here = np.ascontiguousarray(np.moveaxis(planes[:, plane], -1, 0))
            found = transform.u2nu(forward=False, grid=here)
            out += (found.reshape(len(out), -1) * screen.conj()).real
        return out
