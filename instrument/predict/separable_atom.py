"""One atom of the gridded engine on one grid for all nodes: `grid_atom.py` where they are many."""

from __future__ import annotations

from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

from instrument.observe.grid import ImageGrid
from instrument.predict.beam_nodes import BeamNodes
from instrument.predict.beam_times import BeamTimes, weights
from instrument.predict.separable import SIGMA, Kernels, planes
from instrument.predict.separable_loops import Places, Tables, Towards, read, write
from instrument.predict.time_samples import TimeSamples
from instrument.units import Complex, Float, Int

LANES = 4  # numbers that are worked on side by side


@dataclass(frozen=True)
class SeparableAtom:
    """Samples (N,) with their antennas, slots and `uvw`, kernels, and beams at the instants (instants, A, K, 2, 2)."""

    samples: TimeSamples
    listed: tuple[Any, Any, Any]
    uvw: Float  # (N, 3) in wavelengths about the centre of the image
    shift: Complex | None  # (N,): from the centre of the image to that of the visibilities
    grid: ImageGrid
    nodes: BeamNodes
    kernels: Kernels
    beams: Complex
    instants: BeamTimes
    threads: int = 1

    def forward(self, images: Float) -> Complex:
        """Samples (N, 4) of images (4, Ny, Nx)."""
        out = np.zeros((self.samples.count, 4), complex)
        there = np.array([s for s in range(4) if images[s].any()], int)
        if len(there):
            cells = self._cells(images[there])
            parts = np.array_split(self._places.order, self.threads)
            self._each(parts, lambda part: read(cells, part, self._tables, self._towards, there, out))
            out *= self._turn[:, None]
        return out

    def adjoint(self, samples: Complex, kinds: tuple[int, ...]) -> Float:
        """Images (4, Ny, Nx) of samples (N, 4), of some Stokes parameters, 0 in the others."""
        out, there = np.zeros((4, *self.extent)), np.array(kinds, int)
        if len(there):
            cells = np.zeros(self._shape(len(there)))
            data = samples * self._turn.conj()[:, None]
            for parts in self._strips():
                self._each(parts, lambda part: write(cells, part, self._tables, self._towards, there, data))
            out[there] = self._images(cells)
        return out

    @property
    def extent(self) -> tuple[int, ...]:
        """The shape of one image."""
        return self.grid.pixels

    @cached_property
    def window(self) -> tuple[Int, Int]:
        """The cells that the samples need: the first along u, v and w, and how many (3,)."""
        low, high = (np.floor(found(self._scaled, axis=1)).astype(int) for found in (np.min, np.max))
        widths = np.array([self.kernels.across.width] * 2 + [self.kernels.deep.width])
        return low - widths // 2 + 1, high - low + widths

    def _each(self, parts: Any, work: Any) -> None:
        """Work on some samples at a time, on as many threads as there are."""
        placed = [self._places._replace(order=part) for part in parts if len(part)]
        if self.threads == 1:
            for places in placed:
                work(places)
            return
        with ThreadPoolExecutor(self.threads) as pool:
            list(pool.map(work, placed))

    def _strips(self) -> Iterator[list[Int]]:
        """The samples in strips along u: those of one list touch no cell that another one of it does."""
        if self.threads == 1:
            yield [self._places.order]
            return
        strip = self._places.u.astype(int) // self.kernels.across.width
        for odd in (0, 1):
            yield [np.flatnonzero(strip == number) for number in range(odd, int(strip.max()) + 1, 2)]

    @cached_property
    def _depth(self) -> tuple[float, float]:
        return planes(self.grid)

    @cached_property
    def _turned(self) -> Any:
        return self.uvw[:, 2] < 0  # images are real, V(-u) = conj V(u), and half of the planes will do

    @cached_property
    def _turn(self) -> Complex:
        """What is left of the phases of samples (N,)."""
        cycles = self.uvw[:, 2] * self._depth[0]
        turn = np.exp(-2j * np.pi * (cycles - np.rint(cycles)))
        return np.asarray(turn if self.shift is None else turn * self.shift)

    @property
    def _sides(self) -> tuple[float, float]:
        """One over a cell along u and v, in wavelengths."""
        ny, nx = self.grid.pixels
        return SIGMA * nx * self.grid.pixel, SIGMA * ny * self.grid.pixel

    @cached_property
    def _scaled(self) -> Float:
        """Samples in cells (3, N)."""
        scale = np.array([*self._sides, 1 / self._depth[1]])
        return np.asarray(np.where(self._turned, -1.0, 1.0) * (self.uvw * scale).T)

    @cached_property
    def _places(self) -> Places:
        u, v, w = self._scaled - self.window[0][:, None]
        order = np.arange(len(u))  # as they are listed a baseline moves from cell to cell, and beams little by little
        return Places(u, v, w, self._turned, order)

    @cached_property
    def _tables(self) -> Tables:
        series, across = self.nodes.series, self.kernels.across.table
        wide = np.zeros((series.shape[1], across.shape[2], -(-len(series) // LANES) * LANES))
        wide[:, : series.shape[2], : len(series)] = np.moveaxis(series, 0, -1)
        return Tables(across, self.kernels.deep.table, wide, np.ascontiguousarray(wide.swapaxes(1, 2)))

    @cached_property
    def _towards(self) -> Towards:
        instants, stations, nodes = self.beams.shape[:3]
        apart = np.zeros((stations, instants, 4, 2, self._tables.series.shape[2]))
        flat = self.beams.reshape(instants, stations, nodes, 4).transpose(1, 0, 3, 2)
        apart[..., 0, :nodes], apart[..., 1, :nodes] = flat.real, flat.imag
        step = self.instants.step
        return Towards(apart.reshape(stations, instants, 8, -1), step, weights(max(step, 1)), *self.listed)

    def _screens(self) -> Iterator[Complex]:
        """The image of ones as each plane of w sees it, over what the kernels taper it by: (Ny, Nx) each."""
        middle, step = self._depth
        depth, across = self.grid.lmn[:, 2].reshape(self.grid.pixels) - middle, self.kernels.across
        x, y = across.taper(self.grid.east / self._sides[0]), across.taper(self.grid.north / self._sides[1])
        taper = np.outer(y, x) * self.kernels.deep.taper(depth * step)
        first, count = (int(n[2]) for n in self.window)
        for plane in range(first, first + count):
            yield np.exp(-2j * np.pi * plane * step * depth) / taper

    def _shape(self, kinds: int) -> tuple[int, int, int]:
        nu, nv, nw = (int(n) for n in self.window[1])
        return nu, nw, nv * 2 * kinds

    @cached_property
    def _ramps(self) -> tuple[tuple[Int, Complex], tuple[Int, Complex]]:
        """Along x and y, where each cell is in the transform, and the turn from pixel 0 to the centre."""
        found = []
        for axis, sign in ((1, -1), (0, 1)):
            pixels = self.grid.pixels[axis]
            cells = int(self.window[0][1 - axis]) + np.arange(int(self.window[1][1 - axis]))
            turns = cells * (pixels // 2) / (SIGMA * pixels)
            found.append((cells % (SIGMA * pixels), np.exp(sign * 2j * np.pi * (turns - np.rint(turns)))))
        return found[0], found[1]

    def _cells(self, images: Float) -> Float:
        """Cells (nu, nw, nv 2n) of images (n, Ny, Nx); x runs to the west, so that its transform has the other sign."""
        import scipy.fft as sf

        (at_u, ramp_u), (at_v, ramp_v) = self._ramps
        ny, nx = self.grid.pixels
        shape = self._shape(len(images))
        out = np.empty((shape[0], shape[1], len(at_v), len(images)), complex)
        for plane, screen in enumerate(self._screens()):
            for s, image in enumerate(images):
                wide = sf.ifft(screen * image, SIGMA * nx, axis=1, norm="forward", overwrite_x=True)
                wide = sf.fft(wide[:, at_u], SIGMA * ny, axis=0, overwrite_x=True)
                out[:, plane, :, s] = (wide[at_v] * ramp_v[:, None]).T * ramp_u[:, None]
        return out.reshape(shape[0], shape[1], -1).view(float)

    def _images(self, cells: Float) -> Float:
        """The adjoint of `_cells`: images (n, Ny, Nx)."""
        import scipy.fft as sf

        (at_u, ramp_u), (at_v, ramp_v) = self._ramps
        ny, nx = self.grid.pixels
        planes = cells.view(complex).reshape(len(at_u), cells.shape[1], len(at_v), -1)
        out = np.zeros((planes.shape[3], ny, nx))
        for plane, screen in enumerate(self._screens()):
            for s in range(len(out)):
                tall = _folded((planes[:, plane, :, s] * ramp_u.conj()[:, None]).T * ramp_v.conj()[:, None], at_v, ny)
                wide = _folded(sf.ifft(tall, axis=0, norm="forward", overwrite_x=True)[:ny].T, at_u, nx)
                out[s] += (screen.conj() * sf.fft(wide, axis=0, overwrite_x=True)[:nx].T).real
        return out


def _folded(cells: Complex, at: Int, pixels: int) -> Complex:
    """Cells (N, M) added where they are in a transform (SIGMA pixels, M): it comes again and again along u and v."""
    size = SIGMA * pixels
    out = np.zeros((size, cells.shape[1]), complex)
    for first in range(0, len(at), size):
        out[at[first : first + size]] += cells[first : first + size]
    return out
