"""Gridded: images through beams that differ in time, channel and station, by node images on few samples in time.

V_ab(t) = sum_k J_a(p_k, t) F[c_k B](u_ab(t)) J_b(p_k, t)^H: beams at nodes p_k and functions c_k between them
(`beam_nodes.py`), all node images off one grid (`separable.py`) or by a w-gridder each (`gridding.py`), on as few
instants of each baseline as it needs (`time_samples.py`). Very many points go the same way (`gridded_points.py`). The
slow twin is `direct.py`; tests/accuracy/test_gridded.py and test_gridded_points.py compare them.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from instrument.errors import RefusedError
from instrument.observe.grid import ImageGrid
from instrument.predict.base import Predictor, Problem, Work
from instrument.predict.beam_nodes import BeamNodes, beam_nodes, heights
from instrument.predict.beam_times import EACH, BeamTimes, beam_times
from instrument.predict.gridded_images import ROOT2, GriddedImages, towards
from instrument.predict.gridded_points import GriddedPoints, few, gathered
from instrument.predict.gridding import FINEST
from instrument.predict.rounding import known_gain
from instrument.predict.time_samples import LONGEST_S, taps_for
from instrument.sky.image import ImageSky
from instrument.sky.points import points_of

LARGEST_ATOM = 2.6e8  # bytes of the visibilities of one channel that are made at once
FEW = 48  # integrations up to which all are worked out as they are
NODES, TIMES, BETWEEN, GRIDDING = 0.5, 0.1, 0.15, 0.2  # shares of a tolerance


class Gridded(Predictor):
    """Images and points of any extent, (T, F, B, 2, 2), to a tolerance above 0; the adjoint is exact to rounding."""

    def refuses(self, problem: Problem) -> str | None:
        """Refuses skies that are neither images nor lists of points."""
        if problem.sky.kind == "image":
            return None
        listed = points_of(problem.sky)
        if listed is None:
            return "the sky is neither an image nor a list of sources"
        if listed.gaussian.any():
            return "a source is a Gaussian, and not a point"
        try:
            return self._points(problem).too_large()
        except RefusedError as why:
            return str(why)

    def skips(self, problem: Problem) -> str | None:
        """Points that are summed sooner than nodes are found for them."""
        return few(problem) if problem.sky.kind == "points" else None

    def prepare(self, problem: Problem, tolerance: float) -> GriddedImages:
        """Nodes, instants and gridding for a tolerance, each with its share of it."""
        if not tolerance > 0:
            raise RefusedError("it interpolates beams and visibilities: give a tolerance above 0")
        made = self._made(problem)
        outer = known_gain(problem.chain.gains(), problem.at)
        share = tolerance / (ROOT2 * max(outer, 1.0))
        nodes = beam_nodes(problem, made.grid, NODES * share)
        least = FINEST * 2 * nodes.growth * nodes.peak / GRIDDING
        if share < least:
            raise RefusedError(
                f"tolerance = {tolerance:g} is below what its gridding can give here, "
                f"{least * ROOT2 * max(outer, 1.0):.1e}: give that or more, or engine = 'direct'"
            )
        peak = max(nodes.peak, 1e-300)
        instants = EACH
        if problem.shape[0] > FEW and problem.at.regular(problem.interval_s):
            tail = int(taps_for(BETWEEN * share / peak)[0] / 2 * LONGEST_S / problem.interval_s)
            instants = _instants(problem, made.grid, nodes, (-tail, problem.shape[0] + tail), TIMES * share)
        sampled = min(GRIDDING * share / (2 * peak), 1e-2 * nodes.growth)  # the error left to gridding, of all nodes
        ready = replace(
            made,
            nodes=nodes,
            instants=instants,
            between=BETWEEN * share / peak if instants.step else 0.0,
            accuracy=sampled / nodes.growth,
        )
        ready = ready.with_kernels()
        error = nodes.error + 2 * nodes.growth * peak**0.5 * ROOT2 * instants.error
        error += peak * (taps_for(ready.between)[1] if ready.between else 0.0) + 2 * peak * sampled
        return replace(ready, bound=ROOT2 * max(outer, 1.0) * error, omission=ready.said())

    def work(self, problem: Problem) -> Work:
        """That of an exact beam at one node, for what is not prepared."""
        return self._made(problem).work()

    def _made(self, problem: Problem) -> GriddedImages:
        """With an exact beam at one node."""
        if problem.sky.kind == "points":
            return self._points(problem)
        return GriddedImages(engine=self, problem=problem, atom=(_atom(problem), 1))

    def _points(self, problem: Problem) -> GriddedPoints:
        return GriddedPoints(engine=self, problem=problem, atom=(_atom(problem), 1), around=gathered(problem))


def _atom(problem: Problem) -> int:
    """Integrations of one channel that are made together."""
    times, _, baselines = problem.shape
    return max(1, min(times, max(FEW, int(LARGEST_ATOM / (64 * baselines)))))


def image_operator(problem: Problem, grid: ImageGrid, tolerance: float) -> GriddedImages:
    """The operator of images of a grid through the beams of a problem as they are known, whatever its sky and gains."""
    sky = ImageSky(grid=grid, stokes=np.ones((1, 4, *grid.pixels))).about(problem.at.centre)
    beams = replace(problem, sky=sky, at=problem.at.towards(*sky.outline()), chain=problem.chain.beams().known())
    return Gridded().prepare(beams, tolerance)


def _instants(problem: Problem, grid: ImageGrid, nodes: BeamNodes, span: tuple[int, int], share: float) -> BeamTimes:
    """Instants of beams at the nodes for integrations of a span; every one where that will not do."""
    if problem.chain.blind_below_horizon:
        low, high = heights(problem.at.every(problem.interval_s, np.arange(*span)), grid)
        if low.min() < 0 < high.max():  # it rises or sets in the tails of samples, or between integrations
            return EACH
    wanted = share / (2 * ROOT2 * nodes.growth * max(nodes.peak, 1e-300) ** 0.5)
    return beam_times(problem.chain.beams(), towards(problem, grid, nodes), problem.interval_s, span, wanted)
