"""G7: who is handed something between two steps of a long job finds the threads of BLAS as they were."""

import ast
from pathlib import Path

import numpy as np
import pytest
import scipy.linalg  # brings a BLAS of its own, which is to be there from the start
from astropy import units as u
from threadpoolctl import threadpool_info, threadpool_limits

import instrument
from instrument import GainTerm, Observation, Scene, SelfCal
from instrument.analyze.faraday.chunks import in_threads
from instrument.calibrate import chunk
from instrument.calibrate.directional import DirectionalCal
from instrument.experiments import incomplete_model, many_directions
from instrument.experiments.incomplete_model import IncompleteModel
from instrument.experiments.incomplete_model_result import ranks
from instrument.experiments.many_directions import ManyDirections

assert scipy.linalg
STATIONS = ["CS001HBA0", "CS002HBA0", "CS003HBA0", "CS004HBA0"]


def blas():
    """Threads of every library: one that was built without threads stays at 1, whatever the limit."""
    return {i["filepath"]: i["num_threads"] for i in threadpool_info() if i["user_api"] == "blas"}


@pytest.fixture
def two():
    """A limit of two threads, and what that makes of the libraries."""
    with threadpool_limits(2, user_api="blas"):
        before = blas()
        assert 2 in before.values()
        yield before


@pytest.fixture(scope="module")
def plan():
    """Gains on four sources; one block, so that no worker is busy when something is handed out."""
    lofar = instrument.load("telescopes", "lofar-hba", stations=STATIONS, beam=None, gain=GainTerm(rms=1e-2, seed=1))
    sky = instrument.load("skies", "grid", shape=(2, 2), spacing=1 * u.deg, flux=5 * u.Jy)
    night = Observation(
        phase_centre="08h13m36.0s +48d13m03s", transit="2012-12-07", duration=40 * u.s, interval=10 * u.s,
        frequencies=[150] * u.MHz,
    )  # fmt: skip
    return Scene(instrument=lofar, sky=sky, observation=night).plan(workers=1)


def test_g7_blocks_of_the_laboratories_leave_the_threads_alone(plan, two):
    sky = plan.problem.sky
    incomplete = incomplete_model._Job(IncompleteModel(models=(2, 4)), plan, sky, ranks(sky))
    settings = ManyDirections(clusters=2)
    many = many_directions._Job(settings, plan, sky, np.array([0, 0, 1, 1]))
    for job in (incomplete, many):
        assert [blas() for _ in job.blocks()] == [two]
    assert blas() == two


def test_g7_progress_of_long_jobs_is_told_with_the_threads_as_they_were(plan, two):
    seen = []
    IncompleteModel(models=(2, 4)).run(plan, progress=lambda _: seen.append(blas()))
    ManyDirections(clusters=2).run(plan, progress=lambda _: seen.append(blas()))
    in_threads(lambda first: first, range(1), progress=lambda _: seen.append(blas()))
    assert blas() == two
    assert len(seen) >= 3
    assert all(each == two for each in seen)


def test_g7_solvers_use_one_thread_of_blas_in_each_of_their_own(plan, monkeypatch, two):
    """Their own threads are as many as there are cores already."""
    inside = []
    gathered = chunk.Job._gathered

    def looks(self, cells):
        inside.append(blas())
        return gathered(self, cells)

    monkeypatch.setattr(chunk.Job, "_gathered", looks)
    model = plan.run()
    SelfCal().solve(model, model)
    DirectionalCal().solve(model, {"all": model})
    assert blas() == two
    assert [set(each.values()) for each in inside] == [{1}]


def test_g7_no_generator_holds_a_limit_while_it_is_suspended():
    """A `with` that limits threads around a `yield` binds whoever takes what is yielded; context managers are to."""
    found = []
    names = ("threadpool_limits", "one_thread", "ONE_THREAD")
    texts = {path: path.read_text(encoding="utf-8") for path in Path(instrument.__file__).parent.rglob("*.py")}
    for path, text in texts.items():
        if not any(name in text for name in names):
            continue
        for function in (n for n in ast.walk(ast.parse(text)) if isinstance(n, ast.FunctionDef)):
            if any("contextmanager" in ast.unparse(d) for d in function.decorator_list):
                continue
            for block in (n for n in ast.walk(function) if isinstance(n, ast.With)):
                limits = any(name in ast.unparse(item) for item in block.items for name in names)
                if limits and any(isinstance(n, ast.Yield | ast.YieldFrom) for n in ast.walk(block)):
                    found.append(f"{path.name}:{block.lineno}")
    assert found == []
