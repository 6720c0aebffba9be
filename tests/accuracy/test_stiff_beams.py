"""Stiff and extreme calibrations through beams: right, or an outcome with words that say why not."""

import importlib.util
from pathlib import Path

import numpy as np
import pytest
from astropy import units as u

from instrument import Outcome
from instrument.calibrate.gauge import GENERATORS, Gauge

spec = importlib.util.spec_from_file_location("stiff", Path(__file__).with_name("stiff_beams.py"))
stiff = importlib.util.module_from_spec(spec)
spec.loader.exec_module(stiff)
SOLVERS = ("self", "towards")
FAST = {"ordinary", "two stations", "one source", "all in one place", "a cluster without flux", "islands",
        "between two groups", "start at -1", "start at i"}  # fmt: skip
ALSO = {("self", "null of one receptor"), ("towards", "all polarized"), ("self", "start at 1e6")}
CASES = [
    pytest.param(solver, kind, noisy, marks=[] if kind in FAST or (solver, kind) in ALSO else [pytest.mark.long])
    for solver in SOLVERS
    for kind in stiff.KINDS
    for noisy in (False, True)
]


@pytest.mark.parametrize(("solver", "kind", "noisy"), CASES)
def test_stiff_and_extreme(solver, kind, noisy):
    found = stiff.judged(stiff.case(kind, solver, noisy))
    right, words = stiff.ends(kind, solver, noisy)
    assert words in found.said
    if not right:
        assert found.outcome in ("SINGULAR", "POOR_FIT", "InputError")
    elif noisy:
        assert found.outcome == "CONVERGED" and abs(found.off - 1) < 0.4
    else:
        assert found.outcome == "CONVERGED" and found.off < 10 * stiff.TOLERANCE


@pytest.mark.long
@pytest.mark.parametrize("solver", SOLVERS)
@pytest.mark.parametrize("kind", stiff.KINDS)
def test_with_noise_the_errors_are_those_of_noise(solver, kind):
    """Over 20 draws: off as Cramer and Rao allow; pulls of gains are 1, unless gains are said to be noise."""
    right, words = stiff.ends(kind, solver, True)
    if not right:
        pytest.skip("has no solution, as test_stiff_and_extreme says")
    found = [stiff.judged(stiff.case(kind, solver, True, seed)) for seed in range(20)]
    good = [v for v in found if v.outcome == "CONVERGED"]
    assert len(good) >= (10 if words else 19)
    assert all(v.outcome in ("CONVERGED", "SINGULAR", "ITERATION_LIMIT") and words in v.said for v in good)
    off = np.sqrt(np.mean([v.off**2 for v in good]))
    # 96 unknowns of 20 draws scatter by 2 %; where gains are noise the fit is no longer linear in them
    assert off == pytest.approx(1, abs=0.12 if words else 0.06)
    if not words:
        assert np.sqrt(np.mean(np.concatenate([v.squares for v in good]))) == pytest.approx(1, abs=0.1)


@pytest.mark.long
def test_what_is_said_of_stations_helps():
    """Gains of stations in the null of a beam are noise: flagged as is said, errors are those of noise."""
    squares = []
    for seed in range(20):
        one = stiff.case("null of some stations", "self", True, seed)
        there = (one.data.antenna1 < 4) | (one.data.antenna2 < 4)
        one.data = one.data.flagged(there[None, None])
        found = stiff.judged(one)
        assert "are noise" not in found.said
        squares.append(found.squares)
    assert np.sqrt(np.mean(np.concatenate(squares))) == pytest.approx(1, abs=0.1)


def test_matrices_that_are_noise_are_aligned_without_running_away():
    """Gains of some stations 30 times too large and random, directions free that are not unitary."""
    rng = np.random.default_rng(1)
    truth = np.eye(2) + 0.1 * rng.normal(size=(20, 12, 2, 4)).view(complex)
    found = truth.copy()
    found[:, :4] = 30 * rng.normal(size=(20, 4, 2, 4)).view(complex)
    gauge = Gauge(GENERATORS["full"], np.zeros(8), "full")
    x = gauge.nearest(found, truth)
    left = (np.abs(truth - found @ x[:, None]) ** 2).sum(axis=(1, 2, 3))
    assert np.all(left <= (np.abs(truth - found) ** 2).sum(axis=(1, 2, 3)))
    # the best matrix of all, which exponentials of these generators reach, by least squares
    best = np.linalg.pinv(found.reshape(20, 24, 2)) @ truth.reshape(20, 24, 2)
    assert left == pytest.approx((np.abs(truth - found @ best[:, None]) ** 2).sum(axis=(1, 2, 3)), rel=1e-6)


def test_few_iterations_are_said_to_be_few():
    """A limit of iterations below what a solve takes is no singular problem, and no poor fit."""
    for solver in SOLVERS:
        found = stiff.judged(stiff.case("ordinary", solver, True, iterations=2))
        assert found.outcome == "ITERATION_LIMIT" and "raise the limit" in found.said


def test_a_cluster_that_is_seen_in_some_intervals_only():
    one = stiff.case("ordinary", "towards", True)
    gone = one.sky["c"].with_data(np.where(np.arange(6)[:, None, None, None, None] < 2, 0.0, one.sky["c"].data))
    found = one.solver.with_fields(interval=20 * u.s).solve(one.data, {**one.sky, "c": gone})["c"]
    assert found.outcome.ravel().tolist() == [Outcome.REFUSED, Outcome.CONVERGED, Outcome.CONVERGED]
    assert "no solution of 1 interval: its model is zero wherever data count" in str(found)


@pytest.mark.parametrize("leaks", [0.0, 1e-9, 0.01])
def test_one_cluster_of_one_polarization(leaks):
    """What a model does not show has no solution: no errors that are large, but not infinite."""
    one = stiff.case("one source", "towards", True)
    shown = np.array([[1, leaks], [leaks, leaks**2]])
    sky = {"a": one.sky["a"].with_data(one.sky["a"].data[..., :1, :1] * shown)}
    found = one.solver.solve(one.data, sky)["a"]
    assert found.outcome[0, 0] is Outcome.SINGULAR and np.isnan(found.error).all()
    assert "the model of 'a' shows" in str(found) and "polarization" in str(found)


def test_errors_that_are_not_known_are_said(monkeypatch):
    monkeypatch.setattr("instrument.calibrate.cluster_errors.MOST", 100)
    found = stiff.judged(stiff.case("ordinary", "towards", True))
    assert found.outcome == "CONVERGED"
    assert "errors of gains, and weak directions, of 1 solutions are not known: too many unknowns" in found.said


def test_the_table_of_the_docs_is_the_one_that_is_tested():
    page = (Path(__file__).parents[2] / "docs/calibrating.md").read_text()
    assert "\n".join(stiff.table()) in page
