"""What the gridded engine costs: seconds and bytes of its parts, measured on two cores with another worker beside."""

from __future__ import annotations

from typing import Any

import numpy as np

from instrument.observe.directions import LIGHT
from instrument.predict.base import Work
from instrument.predict.separable import Kernels

KEPT = 2  # atoms
LOOKED = 16  # times at which it is looked how far w goes
BACK = 1.4  # of a uv range: baselines leave it, and come back


def work_of(ready: Any, times: slice, channels: slice) -> Work:
    """Of a `GriddedImages`: transforms of every node or of every plane, beams at instants, and what lies between."""
    problem, pixels, nodes = ready.problem, float(np.prod(ready.extent)), len(ready.nodes)
    nt, nf, baselines = ready.block(times, channels).shape
    stations, kinds = problem.at.shape[2], sum(problem.sky.nonzero(problem.at.freq_hz[channels]))
    samples = float(ready._count * nt / problem.shape[0]) * nf
    atoms = nf * -(-nt // ready.atom[0])
    moments = len(ready.instants.instants(0, min(nt, ready.atom[0])))
    if ready.kernels is None:
        digits = 1 - np.log10(ready.accuracy) / 6  # 30 ms at 1e-6 for 480 x 480
        seconds = nodes * kinds * (6.5e-8 * digits * pixels * atoms + 2.1e-7 * digits * samples)
        seconds += 6e-8 * nodes * samples
        grid = 0.0
    else:
        cells = cells_of(ready, ready.kernels)
        seconds = cells[2] * ready.plane_seconds(cells, kinds) * atoms + ready.kernels.seconds(nodes, kinds) * samples
        grid = 16.0 * kinds * float(np.prod(cells, dtype=float))
    seconds += 8e-7 * atoms * nodes * moments * stations + 1.5e-7 * nt * nf * baselines
    held = grid + (64 + 16 * kinds + 100 * KEPT) * samples / max(atoms, 1) + 2 * 64.0 * stations * nodes * moments
    held += 64.0 * stations * min(nt, ready.atom[0]) * 2 + 200.0 * pixels + 2 * 64.0 * nt * nf * baselines
    return Work(2e9 * seconds, 8.0 * nodes * pixels + problem.sky.held_bytes(min(nf, 2)), held, seconds)


def cells_of(ready: Any, kernels: Kernels) -> tuple[int, int, int]:
    """Cells along u, v and w that kernels need."""
    at, problem = ready.problem.at, ready.problem
    places = at.layout.positions_m
    longest = np.linalg.norm(places[problem.antenna1] - places[problem.antenna2], axis=-1).max(initial=0.0)
    w = float(longest * at.freq_hz.max() / LIGHT)
    if problem.uv_range is None:
        return kernels.cells(ready.grid, w, w)
    widest = BACK * problem.uv_range[1]
    some = at.block(slice(None, None, -(-problem.shape[0] // LOOKED)), slice(-1, None))
    uvw = some.uvw_m[:, problem.antenna1] - some.uvw_m[:, problem.antenna2]
    there = np.hypot(uvw[..., 0], uvw[..., 1]) * at.freq_hz.max() / LIGHT <= widest
    deep = BACK * float(np.abs(uvw[..., 2][there]).max(initial=0.0) * at.freq_hz.max() / LIGHT)
    return kernels.cells(ready.grid, min(w, widest), min(w, deep))
