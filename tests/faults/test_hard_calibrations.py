"""300 hard self-calibrations and 60 directional ones: none converges and is wrong by more than 1 % without a word."""

import importlib.util
from pathlib import Path

import numpy as np
import pytest

spec = importlib.util.spec_from_file_location("hard", Path(__file__).with_name("hard_calibrations.py"))
hard = importlib.util.module_from_spec(spec)
spec.loader.exec_module(hard)


def silent(kinds, cases, first=0, beams=False):
    found = []
    for kind in kinds:
        for seed in range(first, first + cases):
            v = hard.judged(hard.drawn(kind, seed, beams))
            if v.converged and v.worst > hard.WRONG and not v.said:
                found.append((kind, seed, v.worst))
    return found


def test_d2_a_sample_of_hard_cases_is_right_or_said():
    """One case of three kinds; all of them are in the long run."""
    assert silent(("between two groups", "model by a factor", "RFI x 1e3, one visibility"), 1, first=2) == []


def test_steps_that_rounding_alone_makes_are_an_end():
    """One source through beams, the data moved by one ulp: 17 of 100 such draws stopped at the limit of 400 steps."""
    case, rng = hard.drawn("one source", 0, True), np.random.default_rng(0)
    for _ in range(20):
        ulps = 1 + 2.0**-52 * rng.integers(-1, 2, case.data.data.shape)
        assert case.solver.solve(case.data.with_data(case.data.data * ulps), case.model).converged.all()


@pytest.mark.long
def test_d1_d2_d4_300_hard_cases_are_right_or_said():
    assert silent(hard.HARD, 15) == []


@pytest.mark.long
def test_300_hard_cases_through_beams_are_right_or_said():
    assert silent(hard.HARD, 15, beams=True) == []


@pytest.mark.long
@pytest.mark.parametrize("beams", [False, True])
def test_ordinary_cases_converge(beams):
    """No noise, noise, intervals of several samples, simpler patterns, incomplete models, short baselines left out."""
    kinds = [k for k in hard.NORMAL if k not in ("noise above the signal", "strong and weak stations, noise")]
    for kind in kinds:
        found = [hard.judged(hard.drawn(kind, seed, beams)) for seed in range(6)]
        assert sum(v.converged for v in found) == sum(v.intervals for v in found), kind


@pytest.mark.long
def test_d2_60_directional_cases_are_right_or_said():
    rows = hard.directional_rows(60)
    assert sum(row[2] for row in rows) == 60
    assert sum(row[4] for row in rows) == 0
