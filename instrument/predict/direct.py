"""Direct: the definition of a visibility, summed baseline by baseline in float64."""

from __future__ import annotations

import numpy as np

from instrument import mat2
from instrument.observe.directions import LIGHT
from instrument.predict.base import Predictor, Problem, Work
from instrument.units import Complex


class Direct(Predictor):
    """V_ab = sum_s J_a B_s J_b^H exp(-2 pi i (u l + v m + w (n-1))) as it stands, (T, F, B, 2, 2).

    Slow on purpose: every other engine is held to it. Phases are float64 cycles, reduced modulo 1.
    """

    def work(self, problem: Problem) -> Work:
        """About 150 operations for each visibility and source, 150 ns on one core, and 0.1 ms to begin a baseline."""
        times, channels, baselines = problem.shape
        stations, sources = problem.at.shape[2:]
        units = times * channels * baselines * sources
        held = times * channels * sources * (64 * stations * 3 + 64 * 6) + 64 * times * channels * baselines
        return Work(150.0 * units, 0.0, float(held), 150e-9 * units + 1e-4 * baselines)

    def sums(self, problem: Problem) -> Complex:
        """Visibilities in Jy, complex (T, F, B, 2, 2)."""
        at = problem.at
        jones = problem.chain.jones(at)
        sky = problem.sky.brightness(at)
        out = np.empty((*problem.shape, 2, 2), complex)
        per_hz = at.freq_hz[:, None, None] / LIGHT
        for i, (a, b) in enumerate(zip(problem.antenna1, problem.antenna2, strict=True)):
            uvw = (at.uvw_m[:, a] - at.uvw_m[:, b])[:, None, None] * per_hz
            cycles = (uvw @ at.lmn.T)[:, :, 0]
            fringe = np.exp(-2j * np.pi * (cycles - np.rint(cycles)))
            envelope = problem.sky.envelope(at, uvw)
            if envelope is not None:
                fringe = fringe * envelope[:, :, 0]
            ja, jb = (jones[:, :, k if jones.shape[2] > 1 else 0] for k in (a, b))
            terms = mat2.mul(mat2.mul(ja, sky), mat2.herm(jb)) * fringe[..., None, None]
            out[:, :, i] = terms.sum(axis=2)
        return out
