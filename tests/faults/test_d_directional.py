"""DirectionalCal: outliers, graphs, scales and robust weights, with the right values."""

import importlib.util
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from astropy import units as u

from instrument import InputError, Outcome
from instrument.calibrate.directional import DirectionalCal

where = Path(__file__).parents[1] / "accuracy/test_directional.py"
spec = importlib.util.spec_from_file_location("laboratory", where)
lab = importlib.util.module_from_spec(spec)
spec.loader.exec_module(lab)
SETTINGS = DirectionalCal(interval=60 * u.s, tolerance=1e-6)


@cache
def scene():
    """One minute of 10 stations, two clusters, no noise."""
    return lab.laboratory(slots=6, stations=10, hold=6, clusters=2)[:2]


def hit(data, factor):
    wild = np.array(data.data)
    wild[2, 0, 17] *= factor
    return data.with_data(wild)


def test_d6_robust_weights_that_put_an_outlier_aside_make_no_poor_fit():
    data, sky = scene()
    solution = SETTINGS.with_fields(robust=2.0).solve(hit(data, 1e4), sky)
    solution.check()
    assert max(s.residual.max() for s in solution.clusters.values()) < 1e-6
    assert lab.rms(solution.predicted(sky) - data) < 1e-6 * lab.rms(data)


def test_d6_an_outlier_that_is_all_that_its_baseline_has_is_put_aside():
    """Intervals of one integration: the baseline then has no other sample, and was called a misfit."""
    data, sky = scene()
    one, part = slice(2, 3), {name: sky[name].block(slice(2, 3), slice(None)) for name in sky}
    solution = SETTINGS.with_fields(robust=2.0, interval=None).solve(hit(data, 1e3).block(one, slice(None)), part)
    solution.check()
    left = (solution.predicted(part) - data.block(one, slice(None))).data
    assert lab.rms(data.with_data(np.broadcast_to(left, data.data.shape))) < 1e-5 * lab.rms(data)


@pytest.mark.parametrize("factor", [10.0, 1e3])
def test_d2_one_wild_visibility_is_reported_in_a_directional_solve(factor):
    data, sky = scene()
    noisy = data.with_noise(lab.SEFD, seed=1)
    solution = SETTINGS.solve(hit(noisy, factor), sky)["80 Jy"]
    assert not solution.converged.any()
    if solution.outcome[0, 0] is Outcome.POOR_FIT:
        assert solution.suspects[2, 0, 17]
    quiet = SETTINGS.solve(noisy, sky)
    quiet.check()
    assert not quiet["80 Jy"].spoilt


def test_d1_a_directional_solve_on_baselines_between_two_groups_is_singular():
    data, sky = scene()
    between = data.antenna1 % 2 != data.antenna2 % 2
    solution = SETTINGS.solve(data.weighted(between[None, None].astype(float)), sky)
    assert all(s.outcome[0, 0] is Outcome.SINGULAR for s in solution.clusters.values())


@pytest.mark.parametrize("scale", [1e170, 1e-170])
def test_d5_directional_fluxes_of_1e170_are_solved_as_those_of_1(scale):
    data, sky = scene()
    strong = {name: m.with_data(m.data * scale) for name, m in sky.items()}
    solution = SETTINGS.solve(data.with_data(data.data * scale), strong)
    solution.check()
    plain = SETTINGS.solve(data, sky)
    assert np.abs(solution["80 Jy"].jones - plain["80 Jy"].jones).max() < 1e-6


@pytest.mark.parametrize("value", [np.nan, -1.0])
def test_d5_directional_weights_that_are_none_are_refused(value):
    data, sky = scene()
    with pytest.raises(InputError, match="weight"):
        SETTINGS.solve(replace(data, weight=np.full((1, 1, 1), value)), sky)
