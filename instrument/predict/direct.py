"""Direct: the definition of a visibility, summed baseline by baseline in float64, and its adjoint for images."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from instrument import mat2
from instrument.observe.directions import LIGHT
from instrument.predict.base import CHUNK, Blockwise, Predictor, Prepared, Problem, Work
from instrument.predict.operator import STOKES, ImageOperator
from instrument.sky.image import ImageSky
from instrument.units import Complex, Float, Int


class Direct(Predictor):
    """V_ab = sum_s J_a B_s J_b^H exp(-2 pi i (u l + v m + w (n-1))) as it stands, (T, F, B, 2, 2).

    Slow on purpose: every other engine is held to it. Phases are float64 cycles, reduced modulo 1.
    """

    def prepare(self, problem: Problem, tolerance: float) -> Prepared:
        """As it is; for an image also the adjoint."""
        return DirectImages(self, problem) if problem.sky.kind == "image" else Blockwise(self, problem)

    def work(self, problem: Problem) -> Work:
        """About 150 operations for each visibility and source, 150 ns on one core, and 0.1 ms to begin a baseline."""
        times, channels, baselines = problem.shape
        stations, sources = problem.at.shape[2], problem.sky.count
        units = times * channels * baselines * sources
        # measured, 4 to 59 stations: four Jones matrices and terms of one in all, directions in the axes of a station
        held = float(times) * min(sources, CHUNK) * (channels * (275 * stations + 110) + 85 * stations)
        held += 64 * times * channels * baselines + problem.sky.held_bytes(channels)
        return Work(150.0 * units, 0.0, held, 150e-9 * units + 1e-4 * baselines)

    def sums(self, problem: Problem) -> Complex:
        """Visibilities in Jy, complex (T, F, B, 2, 2)."""
        out = np.zeros((*problem.shape, 2, 2), complex)
        for part in problem.parts():
            sky = part.sky.brightness(part.at)
            for i, ja, jb, fringe in _baselines(part):
                terms = mat2.mul(mat2.mul(ja, sky), mat2.herm(jb)) * fringe[..., None, None]
                out[:, :, i] += terms.sum(axis=2)
        return out


class DirectImages(ImageOperator):
    """The definition for images, pixel by pixel: slow, and the reference of every other `ImageOperator`."""

    def sums(self, times: slice, channels: slice, pairs: tuple[Int, Int] | None = None) -> Complex:
        """Visibilities in Jy, complex (T, F, B, 2, 2), of the images of the sky, without a copy of them."""
        return self.engine.sums(self.block(times, channels, pairs))

    def forward(self, images: Float, times: slice, channels: slice, pairs: tuple[Int, Int] | None = None) -> Complex:
        """A x, complex (T, F, B, 2, 2)."""
        return self.engine.sums(self._of(images, times, channels, pairs))

    def adjoint(
        self,
        data: Complex,
        times: slice,
        channels: slice,
        pairs: tuple[Int, Int] | None = None,
        kinds: tuple[int, ...] = STOKES,
    ) -> Float:
        """A^H y, real (F, 4, Ny, Nx): Re tr(P_k^H sum_tab J_a^H y_ab J_b conj(K_ab)), P_k the matrix of a Stokes."""
        shape = (len(self.problem.at.freq_hz[channels]), 4, *self.sky.grid.pixels)
        pieces = []
        # no pixel is left out: all are 1
        for part in self._of(np.ones(shape), times, channels, pairs).parts():
            total = np.zeros((part.at.shape[1], part.at.shape[3], 2, 2), complex)
            for i, ja, jb, fringe in _baselines(part):
                back = mat2.mul(mat2.mul(mat2.herm(ja), data[:, :, i, None]), jb) * fringe.conj()[..., None, None]
                total += back.sum(axis=0)
            c = total
            pieces.append(np.stack([
                (c[..., 0, 0] + c[..., 1, 1]).real, (c[..., 0, 0] - c[..., 1, 1]).real,
                (c[..., 0, 1] + c[..., 1, 0]).real, (c[..., 0, 1] - c[..., 1, 0]).imag,
            ], axis=1))  # fmt: skip
        out = np.concatenate(pieces, axis=-1).reshape(shape)
        out[:, [s for s in STOKES if s not in kinds]] = 0.0
        return out

    def _of(self, images: Float, times: slice, channels: slice, pairs: tuple[Int, Int] | None) -> Problem:
        """The problem of a block, for other images."""
        from astropy import units as u

        block = self.block(times, channels, pairs)
        sky = ImageSky(grid=self.sky.grid, stokes=images, frequencies=block.at.freq_hz * u.Hz)
        return replace(block, sky=sky)


def _baselines(problem: Problem) -> Iterator[tuple[int, Complex, Complex, Complex]]:
    """Every baseline: its number, Jones matrices of its stations (T, F, S, 2, 2), fringe and envelope (T, F, S)."""
    at = problem.at
    jones = problem.chain.jones(at)
    per_hz = at.freq_hz[:, None, None] / LIGHT
    for i, (a, b) in enumerate(zip(problem.antenna1, problem.antenna2, strict=True)):
        uvw = (at.uvw_m[:, a] - at.uvw_m[:, b])[:, None, None] * per_hz
        cycles = (uvw @ at.lmn.T)[:, :, 0]
        fringe = np.exp(-2j * np.pi * (cycles - np.rint(cycles)))
        envelope = problem.sky.envelope(at, uvw)
        if envelope is not None:
            fringe = fringe * envelope[:, :, 0]
        ja, jb = (jones[:, :, k if jones.shape[2] > 1 else 0] for k in (a, b))
        yield i, ja, jb, fringe
