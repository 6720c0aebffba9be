"""I13: what a calibration keeps of an integration is its solution, 64 bytes a station and 32 for its errors."""

import copy
import tracemalloc
from dataclasses import replace

import numpy as np
import pytest
from astropy import units as u

import instrument
from instrument import DirectionalCal, FeedTerm, GainTerm, Observation, Scene, SelfCal
from instrument.calibrate.base import Solution
from instrument.jones.chain import Chain
from instrument.pipeline.stage import Running
from instrument.pipeline.stages.calibrate import _CalibrateRun

BLOCK, STATIONS = 5, 16
SOLUTION = 64 * STATIONS  # bytes an integration; its data are 64 x 120 baselines = 7.5 times as much
ERRORS = 32 * STATIONS + 64  # of the matrices and of what is common to them, where a solver knows them
LIMIT = 4 * SOLUTION  # parts, their join, its copy when it is checked; and 0.8 kB of objects in blocks so short


@pytest.fixture(scope="module")
def scene():
    names = list(instrument.load("telescopes", "lofar-hba", beam=None).layout().names[:STATIONS])
    return Scene(
        instrument=instrument.load(
            "telescopes", "lofar-hba", beam=None, stations=names,
            gain=GainTerm(rms=1e-3, seed=1), feed=FeedTerm(rms=1e-3, seed=2),
        ),
        sky=instrument.load("skies", "grid", shape=(2, 2), spacing=1 * u.deg, flux=5 * u.Jy),
        observation=Observation(
            phase_centre="08h13m36.0s +48d13m03s", transit="2012-12-07", duration=BLOCK * 10 * u.s, interval=10 * u.s,
            frequencies=[150] * u.MHz,
        ),
    )  # fmt: skip


def later(vis, block):
    return replace(vis, at=replace(vis.at, slots_s=vis.at.slots_s + 1e3 * block))


class Again:
    """A solver whose first solution comes again for every block, each in memory of its own."""

    def __init__(self, solver, data, model):
        self.first = solver.solve(data, model)

    def solve(self, data, _):
        new = copy.deepcopy(self.first)
        return replace(new, term=new.term.with_fields(slots_s=data.at.slots_s))


def bytes_per_integration(work):
    """Growth of the peak of traced memory from 4 blocks to 12."""
    work(2)  # what is made once and kept
    peaks = []
    for blocks in (4, 12):
        tracemalloc.start()
        work(blocks)
        peaks.append(tracemalloc.get_traced_memory()[1])
        tracemalloc.stop()
    return (peaks[1] - peaks[0]) / (8 * BLOCK)


@pytest.mark.parametrize("spoilt", [False, True])
def test_i13_a_run_grows_by_its_solutions(scene, spoilt):
    model = scene.with_fields(instrument=scene.instrument.with_fields(gain=None, feed=None)).plan().run()
    data = model.corrupted(Chain(*scene.instrument.receivers()))
    if spoilt:  # marks of visibilities that stand out are as large as flags
        data.data[:, :, 7] *= 1e3
    solver = Again(SelfCal(tolerance=1e-6, iterations=20), data, model)
    assert solver.first.suspects.any() == spoilt

    def work(blocks):
        run = Running("x", 0, scene.instrument, scene.plan(), {})
        stage = _CalibrateRun(solver, run, {})
        for k in range(blocks):
            run.model = later(model, k)
            stage.take(later(data, k))
        found = stage.finish()
        assert len(found.solution.outcome) == blocks * BLOCK
        assert bool(found.solution.spoilt) == spoilt
        assert np.isfinite(found.errors.linear["input"]["s"])

        assert all(part.suspects.size == 1 for part in stage.parts)

    assert bytes_per_integration(work) < LIMIT


def test_i13_solutions_of_blocks_hold_no_data(scene):
    model = scene.plan().run()
    single = Again(SelfCal(), model, model)
    many = Again(Named(DirectionalCal()), model, model)
    for solver in (single, many):
        known = np.isfinite(solver.first.error).any()
        assert bytes_per_integration(
            lambda n, s=solver: Solution.joined([s.solve(later(model, k), model) for k in range(n)])
        ) < LIMIT + known * 4 * ERRORS  # fmt: skip
        assert solver.first.suspects.size == 1


class Named:
    """One cluster of a directional solve."""

    def __init__(self, solver):
        self.solver = solver

    def solve(self, data, model):
        return self.solver.solve(data, {"all": model})["all"]
