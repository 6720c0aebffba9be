"""GriddedImages: the operator of the gridded engine for images, and how it cuts time into atoms; see `gridded.py`."""

from __future__ import annotations

import os
from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, Self

import numpy as np

from instrument import mat2
from instrument.observe.directions import LIGHT, lmn, offset
from instrument.observe.grid import ImageGrid
from instrument.predict.base import EVERY, Problem, Work
from instrument.predict.beam_nodes import ONE, BeamNodes
from instrument.predict.beam_times import EACH, BeamTimes
from instrument.predict.grid_atom import Atom, Span, about
from instrument.predict.gridded_work import KEPT, cells_of, work_of
from instrument.predict.gridding import Gridder
from instrument.predict.operator import STOKES, ImageOperator
from instrument.predict.pairs import picked, placed
from instrument.predict.separable import Kernels, fits, kernels_for
from instrument.predict.separable_atom import SeparableAtom
from instrument.predict.time_samples import TimeSamples, time_samples, windows, with_skirts
from instrument.units import Bool, Complex, Direction, Float, Int, unit_vectors

FEW_NODES = 3  # up to which each has a gridder of its own
ROOT2 = 2**0.5  # the norm of the brightness of 1 Jy
AnyAtom = Atom | SeparableAtom


@dataclass(frozen=True)
class GriddedImages(ImageOperator):
    """The operator of `Gridded`: beams at K nodes, at some instants, gridding to an accuracy."""

    nodes: BeamNodes = ONE
    instants: BeamTimes = EACH
    between: float = 0.0  # the error of interpolation between samples, 0 for every integration
    accuracy: float = 1e-6
    kernels: Kernels | None = None  # for all nodes at once, where they are many

    def __getstate__(self) -> dict[str, Any]:
        """What goes to another process: what was decided, and nothing that can be made again there."""
        return {name: getattr(self, name) for name in self.__dataclass_fields__}

    def within(self, uv_range: tuple[float, float] | None) -> Self:
        """The operator of these visibilities alone; short baselines may do with one grid where all could not."""
        found = super().within(uv_range)
        return found if found is self else found.with_kernels()

    def with_kernels(self) -> Self:
        """With one grid for all nodes, where they are many and it is small enough."""
        kernels = kernels_for(self.nodes, self.accuracy * self.nodes.growth) if len(self.nodes) > FEW_NODES else None
        return replace(self, kernels=kernels if kernels and fits(cells_of(self, kernels)) else None)

    def forward(self, images: Float, times: slice, channels: slice, pairs: tuple[Int, Int] | None = None) -> Complex:
        """A x: visibilities in Jy, complex (T, F, B, 2, 2); 0 outside the uv range of the problem."""
        block = self.block(times, channels)
        out = np.zeros((*block.shape, 2, 2), complex)
        for seen, f, atom in self._atoms(times, channels):
            atom.samples.spread(atom.forward(images[f]), out[seen, f].reshape(-1, block.shape[2], 4))  # a view
        if (gains := self._gains(block)) is not None:
            out = mat2.between(gains, out, block.antenna1, block.antenna2)
        return out if pairs is None else picked(self.problem, out, pairs)

    def adjoint(
        self,
        data: Complex,
        times: slice,
        channels: slice,
        pairs: tuple[Int, Int] | None = None,
        kinds: tuple[int, ...] = STOKES,
    ) -> Float:
        """A^H y: images, real (F, 4, Ny, Nx), of visibilities (T, F, B, 2, 2) of whole atoms."""
        block = self.block(times, channels)
        if pairs is not None:
            data = placed(self.problem, data, pairs)
        if (gains := self._gains(block)) is not None:
            data = mat2.between(mat2.herm(gains), data, block.antenna1, block.antenna2)
        out = np.zeros((block.shape[1], 4, *self.extent))
        for seen, f, atom in self._atoms(times, channels):
            here = np.ascontiguousarray(data[seen, f]).reshape(-1, block.shape[2], 4)
            out[f] += atom.adjoint(atom.samples.gather(here), kinds)
        return out

    def left_out(self, times: slice, channels: slice) -> Bool | None:
        """What lies outside the uv range of the problem, (T, F, B)."""
        if self.problem.uv_range is None:
            return None
        out = np.ones(self.block(times, channels).shape, bool)
        for seen, f, first, last, channel in self._cuts(times, channels):
            begin, end = self._windows(first, last, channel)
            t = np.arange(last - first)[:, None]
            out[seen, f] = (t < begin) | (t >= end)
        return out

    def work(self, times: slice = EVERY, channels: slice = EVERY) -> Work:
        """Of the nodes, the samples and what lies between."""
        return work_of(self, times, channels)

    def said(self) -> tuple[str, str]:
        """What is interpolated, for a plan."""
        of = self.problem.shape[0] * self.problem.shape[2]
        text = f"beams at {len(self.nodes)} nodes" if len(self.nodes) > 1 else "no beam differs over the image"
        text += f", every {self.instants.step * self.problem.interval_s:.0f} s" if self.instants.step else ""
        if self.between:
            text += f"; {self._count / of:.0%} of the visibilities, the others between"
        return "beams of every pixel", f"{text} (leakage alone {ROOT2 * self.nodes.leakage:.1e})"

    @cached_property
    def functions(self) -> Float:
        """The functions between nodes on the image, (K, Ny, Nx)."""
        return self.nodes.on(self.grid)

    @cached_property
    def _count(self) -> int:
        """Samples of the first atom of the middle channel, times the number of atoms in time."""
        nt = min(self.atom[0], self.problem.shape[0])
        return int(self._samples(0, nt, self.problem.shape[1] // 2).count * self.problem.shape[0] / nt)

    @cached_property
    def _rates(self) -> Float:
        """How fast each baseline moves, m/s, times the reach of the image (B,): turns a second for each 1/m."""
        at, interval = self.problem.at, self.problem.interval_s
        slots = np.unique(np.linspace(0, at.shape[0] - 1, min(at.shape[0], 97)).round().astype(int))
        if len(slots) < 2:
            return np.zeros(self.problem.shape[2])
        some = at.at_centre().every(interval, np.stack([slots, slots + 1], axis=1).ravel())
        uvw = some.uvw_m.reshape(len(slots), 2, -1, 3)
        moved = (uvw[:, 1] - uvw[:, 0]) / interval
        moved = moved[:, self.problem.antenna1] - moved[:, self.problem.antenna2]
        rate = np.hypot(moved[..., 0], moved[..., 1]) * self.reach[0] + np.abs(moved[..., 2]) * self.reach[1]
        return np.asarray(1.02 * rate.max(axis=0))  # between the instants that were looked at

    @cached_property
    def reach(self) -> tuple[float, float]:
        """The largest distance of a pixel from the phase centre, sin and 1 - cos."""
        ny, nx = self.grid.pixels
        edge = np.concatenate([
            np.stack([np.repeat(y, nx), np.arange(nx)], axis=1) for y in (0, ny - 1)
        ] + [np.stack([np.arange(ny), np.repeat(x, ny)], axis=1) for x in (0, nx - 1)])  # fmt: skip
        seen = np.abs(lmn(unit_vectors(*self.grid.at(*edge.T)), self.problem.at.centre))
        return float(np.hypot(seen[:, 0], seen[:, 1]).max()), float(seen[:, 2].max())

    def _windows(self, first: int, last: int, channel: int) -> tuple[Int, Int]:
        """Where each baseline enters the uv range of the problem, and leaves it for good, (B,) each, from `first`."""
        count, problem = last - first, self.problem
        if problem.uv_range is None:
            return np.zeros(problem.shape[2], int), np.full(problem.shape[2], count)
        uv = problem.at.at_centre().block(slice(first, last), slice(channel, channel + 1)).uvw_m[..., :2]
        uv = uv * (float(problem.at.freq_hz[channel]) / LIGHT)
        begin, end = np.zeros((2, problem.shape[2]), int)
        windows(uv, problem.antenna1, problem.antenna2, np.square(problem.uv_range), begin, end)
        return begin, end

    def _samples(self, first: int, last: int, channel: int) -> TimeSamples:
        """Samples of some integrations of a channel."""
        begin, end = self._windows(first, last, channel)
        interval = self.problem.interval_s
        if not self.between:
            return time_samples(np.zeros(len(begin)), begin, end, interval, 0.0)
        # what polynomials through 8 instants carry turns no faster than that
        beams = 0.06 / (self.instants.step * interval) if len(self.nodes) > 1 else 0.0
        turns = self._rates * float(self.problem.at.freq_hz[channel]) / LIGHT + beams
        return time_samples(with_skirts(turns, self.between), begin, end, interval, self.between)

    def _cuts(self, times: slice, channels: slice) -> Iterator[tuple[slice, int, int, int, int]]:
        """Each atom of some times and channels: its times and channel among them, and in the problem."""
        start, stop, _ = times.indices(self.problem.shape[0])
        for first in range(start, stop, self.atom[0]):
            last = min(first + self.atom[0], stop)
            for f, channel in enumerate(range(*channels.indices(self.problem.shape[1]))):
                yield slice(first - start, last - start), f, first, last, channel

    def _atoms(self, times: slice, channels: slice) -> Iterator[tuple[slice, int, AnyAtom]]:
        """Each atom of some times and channels that has samples: its times and its channel among them."""
        for seen, f, *where in self._cuts(times, channels):
            atom = self._kept.get((*where,)) or self._made(*where)
            if atom is not None:
                yield seen, f, atom

    @cached_property
    def _kept(self) -> dict[tuple[int, ...], AnyAtom]:
        """The latest atoms, for those who ask for the same again."""
        return {}

    def _made(self, first: int, last: int, channel: int) -> AnyAtom | None:
        """An atom, kept in the place of the oldest; `None` where it has no samples."""
        samples = self._samples(first, last, channel)
        if not samples.count:
            return None
        atom = self._atom(samples, first, last, channel)
        for oldest in list(self._kept)[: 1 - KEPT]:  # a list at once: other threads add theirs
            self._kept.pop(oldest, None)
        self._kept[first, last, channel] = atom
        return atom

    def _atom(self, samples: TimeSamples, first: int, last: int, channel: int) -> AnyAtom:
        at, freq = self.problem.at, float(self.problem.at.freq_hz[channel])
        rows, slots = samples.listed()
        span = self._span(first, last, int(slots.min()), int(slots.max()) + 1)
        one, other = self.problem.antenna1[rows], self.problem.antenna2[rows]
        slots = slots - span.begin
        uvw = (span.stations_m[slots, one] - span.stations_m[slots, other]) * (freq / LIGHT)
        uvw, shift = about(uvw, self._centre, at.centre)
        beams = span.moments.block(slice(None), slice(channel, channel + 1))
        jones = self.problem.chain.beams().jones(beams)
        jones = np.broadcast_to(jones, (len(beams.slots_s), 1, at.shape[2], len(self.nodes), 2, 2))[:, 0]
        threads = 1 if self.problem.shape[1] > 1 else os.cpu_count() or 1
        listed = one.astype(np.int32), other.astype(np.int32), slots.astype(np.int32)
        if self.kernels is not None:
            there = samples, listed, uvw, shift, self.grid, self.nodes, self.kernels, jones, self.instants
            if fits((separable := self._separable(*there, threads)).window[1]):
                return separable
        gridder = Gridder(uvw, self.grid.pixels, self.grid.pixel, self.accuracy, threads)
        return Atom(samples, listed, gridder, shift, jones, self.instants, span.end - span.begin, self.functions)

    def _separable(self, *there: Any) -> SeparableAtom:
        return SeparableAtom(*there)

    def _span(self, first: int, last: int, begin: int, end: int) -> Span:
        """Where stations and the Earth stand at integrations `begin` to `end`, the same for all channels of an atom."""
        known = self._spans.get((first, last))
        if known is not None and known.begin <= begin and end <= known.end:
            return known
        if known is not None:
            begin, end = min(begin, known.begin), max(end, known.end)
        at, interval = self.problem.at.block(slice(first, last), EVERY), self.problem.interval_s
        stations = at.at_centre().every(interval, np.arange(begin, end)).uvw_m
        moments = towards(self.problem, self.grid, self.nodes).block(slice(first, last), EVERY)
        made = Span(begin, end, stations, moments.every(interval, self.instants.instants(begin, end)))
        self._spans.clear()
        self._spans[first, last] = made
        return made

    @cached_property
    def _spans(self) -> dict[tuple[int, int], Span]:
        """The latest of them."""
        return {}

    @property
    def grid(self) -> ImageGrid:
        """The pixels of the sky."""
        return self.sky.grid

    @property
    def extent(self) -> tuple[int, ...]:
        """The shape of one image."""
        return self.grid.pixels

    def plane_seconds(self, cells: tuple[int, int, int], kinds: int) -> float:
        """Of the transforms of one plane of w, of so many cells, on one core."""
        return 5e-8 * kinds * len(self.grid)

    @property
    def _centre(self) -> Direction:
        centre = self.grid.centre
        assert centre is not None  # placed, or it would have been refused
        return centre

    def _gains(self, block: Problem) -> Complex | None:
        """What is left of the beams, (T, F, A, 2, 2), or `None` for nothing."""
        gains = block.chain.gains()
        if not gains.terms:
            return None
        found = gains.jones(block.at.at_centre())[:, :, :, 0]
        return np.broadcast_to(found, (*block.at.shape[:3], 2, 2))


def towards(problem: Problem, grid: ImageGrid, nodes: BeamNodes) -> Any:
    """The sampling of a problem towards the nodes of a grid."""
    assert grid.centre is not None  # placed, or it would have been refused
    return problem.at.towards(*offset(grid.centre, nodes.lm[:, 0], nodes.lm[:, 1]))
