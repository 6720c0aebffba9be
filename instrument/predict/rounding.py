"""Bound on the rounding of float64 in a sum of sources: phases, Jones matrices, brightness, the sum itself.

Every source has its own share, weighted with its flux: a direction 1 arcsec from a zenith loses 5 digits of its
azimuth, the others lose none. Held to sums in extended precision by docs/reports/bounds.py.
"""

from __future__ import annotations

import numpy as np

from instrument.jones.base import ElementBeam
from instrument.jones.chain import Chain
from instrument.jones.parallactic import Parallactic
from instrument.mat2 import UNIT
from instrument.observe.directions import LIGHT
from instrument.observe.sampling import Sampling
from instrument.predict.base import CHUNK, Problem
from instrument.sky.pixels import PixelSky
from instrument.sky.points import points_of
from instrument.sky.rounding import brightness_rounding, flux
from instrument.sky.sources import FLUX_CELLS
from instrument.units import Float, unit_vectors

SEEN = 16  # roundings of an apparent direction in the axes of a station: angles, M (s + v), unit length, axes
PRODUCT = 12  # of a product of two 2x2 matrices


def total_flux(problem: Problem) -> float:
    """|I| + P of all sources in the brightest channel and at the brightest time, Jy."""
    return float(problem.sky.total_jy(problem.at.freq_hz).max())


def rounding(problem: Problem, scale_jy: float) -> float:
    """Bound on the rounding of any visibility, relative to `scale_jy`; of a sum of skies that of each and of adding."""
    if problem.sky.kind == "sum":
        members = list(problem.members().values())
        return sum(rounding(one, scale_jy) for one in members) + len(members) * UNIT * known_gain(
            problem.chain, problem.at
        )
    gain = known_gain(problem.chain, problem.at)
    relative = gain * (_phase(problem) + UNIT * (2 * _added(problem) + 40)) + _jones(problem)
    largest = 0.0
    for part in _cells(problem):
        jansky = flux(part.sky, part.at)
        wrong = (jansky * relative).sum(axis=-1) + gain * brightness_rounding(part.sky, part.at).sum(axis=-1)
        largest = float(np.maximum(largest, wrong.max()))
    return largest / scale_jy


def known_gain(chain: Chain, at: Sampling) -> float:
    """Bound on |J|^2; where no bound is known of a term, 1, and the plan says that it is assumed."""
    peak = chain.peak(at)
    return peak * peak if np.isfinite(peak) else 1.0  # infinity where no float holds it; ** 2 would raise


def unknown_peaks(problem: Problem) -> list[str]:
    """Terms whose size no bound is known of; the rounding takes 1."""
    return [t.called for t in problem.chain.parts if not np.isfinite(t.peak(problem.at))]


def _cells(problem: Problem) -> list[Problem]:
    """Pieces of times and channels that hold a brightness of moderate size."""
    times, channels, _, sources = problem.at.shape
    if problem.sky.kind != "other":
        times = 1  # the same at all
    slots = max(1, int(FLUX_CELLS / sources))
    nf = min(channels, slots)
    nt = max(1, slots // nf)
    return [
        problem.block(slice(t, min(t + nt, times)), slice(f, f + nf))
        for t in range(0, times, nt)
        for f in range(0, channels, nf)
    ]


def _added(problem: Problem) -> float:
    """Roundings of a sum of all directions: engines add images in chunks, and then the chunks."""
    count = problem.sky.count
    return count if problem.sky.kind != "image" else min(count, CHUNK + count / CHUNK)


def _phase(problem: Problem) -> Float:
    """Rounding of the fringe of each source on the longest baselines, and of the shape of a Gaussian, (S,)."""
    at = problem.at
    a, b = problem.antenna1, problem.antenna2
    offsets = at.layout.positions_m - at.layout.centre_m
    baseline = float(np.linalg.norm(offsets[a] - offsets[b], axis=1).max())
    size = np.linalg.norm(offsets, axis=1)
    per_m = float(at.freq_hz.max()) / LIGHT
    reach = np.linalg.norm(at.lmn, axis=1) + problem.sky.reach_rad
    # a baseline sees what its two stations have in common, the axes (16) and l, m (12, of 1 and not of themselves);
    # the products of each station round by its distance from the centre of the array, which may be far outside
    turns = baseline * (16 * reach + 12) + 8 * float((size[a] + size[b]).max()) * reach
    out = 2 * np.pi * per_m * turns + 12
    listed = points_of(problem.sky)
    if listed is not None and listed.gaussian.any():
        # 4 pi^2 x exp(-2 pi^2 x^2) <= 3.9 for each axis; x is good to 30 roundings of |uv| sigma
        out = out + 3.9 * 30 * per_m * baseline * np.linalg.norm(listed.shape_axes(at.centre), axis=-1).sum(axis=-1)
    return np.asarray(UNIT * out)


def _jones(problem: Problem) -> Float:
    """Rounding of J_a B J_b^H for a source of unit brightness, (S,) or (1,)."""
    at, parts = problem.at, problem.chain.parts
    if not parts:
        return np.zeros(1)
    peaks = [t.peak(at) for t in parts]
    peaks = [p if np.isfinite(p) else 1.0 for p in peaks]
    whole = float(np.prod(peaks))
    wrong = np.full(1, UNIT * PRODUCT * len(parts) * whole)
    for k, term in enumerate(parts):
        others = float(np.prod(peaks[:k] + peaks[k + 1 :]))
        wrong = wrong + others * term.rounding(at)
    # azimuths are good to a rounding over the distance from the zenith. An element that is one smooth field there turns
    # back what Parallactic turns, so that what is left is its jump; at a horizon, above or below is chance
    placed = any(isinstance(t, ElementBeam | Parallactic) for t in parts) or problem.chain.blind_below_horizon
    zenith, horizon = _nearest(problem) if placed else (np.ones(1), np.ones(1))
    elements = [(k, t) for k, t in enumerate(parts) if isinstance(t, ElementBeam)]
    turned = any(isinstance(t, Parallactic) for t in parts)
    if elements or turned:
        jump = 4 * whole if not turned else whole
        if turned and elements:
            k, element = elements[0]
            jump = element.jump(at) * float(np.prod(peaks[:k] + peaks[k + 1 :]))
        wrong = wrong + jump * np.minimum(UNIT * SEEN / np.maximum(zenith, UNIT), np.pi)
    if problem.chain.blind_below_horizon:
        wrong = wrong + np.where(horizon < UNIT * SEEN, whole, 0.0)
    with np.errstate(over="ignore"):  # then nothing is known
        return np.asarray(2 * whole * wrong + wrong**2)


def _nearest(problem: Problem) -> tuple[Float, Float]:
    """How near each direction comes to a zenith and to an antenna plane, sines (N,); of an image its nearest pixel.

    Pixels are looked at one by one only at the times when their cell is near: for 1024 x 1024 pixels and 2880 times all
    of them would take minutes.
    """
    at, sky = problem.at, problem.sky
    least = np.array([at.rising.zenith, at.rising.horizon])
    if not isinstance(sky, PixelSky):
        return least[0], least[1]
    reach = sky.reach_rad
    near = np.flatnonzero(np.any(least < 2 * reach, axis=0))
    least = np.where(least < 2 * reach, reach, least - reach)  # the others are never nearer than that
    pixels, cell = sky.pixels_of(near)
    if not len(pixels):
        return least[0], least[1]
    centres, vectors = unit_vectors(*sky.outline())[near], unit_vectors(*sky.grid.directions(pixels))
    where = np.searchsorted(near, cell)
    zeniths = at.layout.axes[at.layout.frames[0], 2]
    for matrix, velocity in zip(at.earth.matrices, at.earth.velocity, strict=True):
        axes = zeniths @ matrix  # ICRS
        up = centres @ axes.T + axes @ velocity  # to 1e-4 of itself: |v + velocity| is left out
        close = np.minimum(np.abs(up), np.sqrt(np.maximum(1 - up**2, 0))).min(axis=1) < 2 * reach
        chosen = np.flatnonzero(close[where])
        if not chosen.size:
            continue
        up = vectors[chosen] @ axes.T + axes @ velocity
        # 1 - up^2 has no digits at the zenith: |axis x (v + velocity)| has
        aside = np.sqrt(np.maximum(1 - up**2, 0))
        k, g = np.nonzero(aside < 1e-3)
        aside[k, g] = np.linalg.norm(np.cross(axes[g], vectors[chosen[k]] + velocity), axis=1)
        first = np.flatnonzero(np.diff(cell[chosen], prepend=-1))  # pixels are in the order of their cells
        for distance, each in zip(least, (aside, np.abs(up)), strict=True):
            lowest = 0.999 * np.minimum.reduceat(each.min(axis=1), first)
            np.minimum.at(distance, cell[chosen[first]], lowest)
    return least[0], least[1]
