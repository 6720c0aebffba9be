"""Some of the clusters taken out, and solutions undone: no solve is needed, the matrices are known."""

from functools import cache

import numpy as np
import pytest
from astropy import units as u
from astropy.coordinates import SkyCoord

import instrument
from instrument import Chain, GainTerm, InputError, JonesTable, Observation, Outcome, PointSky, Scene, SelfCal
from instrument.calibrate.base import Solution
from instrument.calibrate.by_station import rms_by_station
from instrument.calibrate.directional_solution import DirectionalSolution
from instrument.calibrate.gauge import gauge_of

CENTRE = SkyCoord("08h13m36.0s +48d13m03s")
STATIONS = ["CS001HBA0", "CS003HBA1", "CS302HBA1", "RS106HBA"]
NAMES = ("near", "3C196", "far")


def predicted(sky):
    night = Observation(
        phase_centre=CENTRE, start="2012-12-07T01:00:00", duration=40 * u.s, interval=10 * u.s,
        frequencies=[150] * u.MHz, channel_width=0.2 * u.MHz,
    )  # fmt: skip
    array = instrument.load("telescopes", "lofar-hba", beam=None, stations=STATIONS)
    return Scene(instrument=array, sky=sky, observation=night).plan(workers=1).run()


def known(model, seed, lost=()):
    """A solution of random matrices; `lost` intervals have none."""
    jones = np.eye(2) + 0.1 * np.random.default_rng(seed).normal(size=(4, 1, 4, 2, 2, 2)).view(complex)[..., 0]
    outcome = np.full((4, 1), Outcome.CONVERGED, object)
    jones[list(lost)], outcome[list(lost)] = np.nan, Outcome.POOR_FIT
    return Solution(
        term=JonesTable(values=jones, slots_s=model.at.slots_s, freq_hz=model.freq_hz, stations=tuple(STATIONS)),
        outcome=outcome, iterations=np.ones((4, 1), int), residual=np.zeros((4, 1)),
        gauge=gauge_of(model.data, np.ones(model.data.shape[:3])), history=np.zeros(1), interval_s=10.0,
    )  # fmt: skip


@cache
def laboratory():
    """Data, models and solutions of three clusters."""
    models = {
        name: predicted(PointSky.at(CENTRE.spherical_offsets_by(x * u.deg, 0 * u.deg), [flux]))
        for name, x, flux in zip(NAMES, (0, 1, 3), (10.0, 5.0, 2.0), strict=True)
    }
    solution = DirectionalSolution({name: known(m, k) for k, (name, m) in enumerate(models.items())})
    return solution.predicted(models), models, solution


def test_any_subset_is_taken_out_by_what_is_kept_or_by_what_is_meant():
    data, models, solution = laboratory()
    parts = {name: models[name].corrupted(solution[name].term).data for name in NAMES}
    for some in ((), ("near",), ("3C196", "far"), NAMES):
        due = data.data - sum((parts[name] for name in some), np.zeros_like(data.data))
        rest = [name for name in NAMES if name not in some]
        by_only, by_keep = solution.subtracted(data, models, only=some), solution.subtracted(data, models, keep=rest)
        assert np.abs(by_only.data - due).max() < 1e-13
        assert np.array_equal(by_only.data, by_keep.data)
        assert np.abs((solution.predicted(models, only=some) + by_only).data - data.data).max() < 1e-13
    assert np.array_equal(solution.subtracted(data, models, only="3C196").data, data.data - parts["3C196"])
    few = {"far": models["far"]}  # of what stays, no model is asked
    assert np.array_equal(solution.subtracted(data, few, only="far").data, data.data - parts["far"])


@pytest.mark.parametrize(
    ("asked", "said"),
    [
        ({"only": "3C19"}, "no cluster '3C19': .*3C196"),
        ({"keep": ["near", "farr"]}, "no cluster 'farr': .*far"),
        ({"only": "far", "keep": "near"}, "keep= and only= say the same in two ways"),
    ],
)
def test_names_of_no_cluster_are_refused(asked, said):
    data, models, solution = laboratory()
    with pytest.raises(InputError, match=said):
        solution.subtracted(data, models, **asked)
    with pytest.raises(InputError, match="no model of cluster 'far'"):
        solution.subtracted(data, {"near": models["near"]}, only=("near", "far"))
    with pytest.raises(InputError, match="models is empty"):
        solution.predicted({}, only=())


def test_only_what_is_taken_out_flags_where_it_has_no_solution():
    data, models, _ = laboratory()
    solution = DirectionalSolution({n: known(models[n], k, (2,) if n == "far" else ()) for k, n in enumerate(NAMES)})
    assert not solution.subtracted(data, models, keep="far").flag.any()
    left = solution.subtracted(data, models, only="far")
    assert np.array_equal(np.broadcast_to(left.flag, data.data.shape[:3]).any(axis=(1, 2)), np.arange(4) == 2)
    assert not left.data[2].any()


def test_flags_of_single_correlations_stay_single():
    data, models, solution = laboratory()
    flag = np.random.default_rng(0).uniform(size=data.data.shape) < 0.2
    bad = data.with_data(np.where(flag, np.nan, data.data)).flagged(flag)
    left = solution.subtracted(bad, models, only=("near", "far"))
    due = solution.subtracted(data, models, only=("near", "far")).data
    assert np.array_equal(left.flag, flag)
    assert np.abs(np.where(flag, 0, left.data - due)).max() < 1e-13
    assert np.isfinite(left.data).all()


def test_the_inverse_of_a_solution_undoes_it():
    data, models, solution = laboratory()
    one = solution["near"]
    there = data.corrected(one.term)
    assert np.abs(data.corrupted(one.inverse()).data - there.data).max() < 1e-13
    assert np.abs(there.corrected(one.inverse()).data - data.data).max() < 1e-13
    assert np.abs(data.corrupted(Chain(one.inverse(), one.term)).data - data.data).max() < 1e-13
    lost = known(models["near"], 0, (1,))
    corrected = data.corrected(lost.inverse())
    assert np.array_equal(np.broadcast_to(corrected.flag, data.data.shape[:3]).any(axis=(1, 2)), np.arange(4) == 1)
    singular = JonesTable(values=np.ones((1, 1, 1, 2, 2)), slots_s=[0.0], freq_hz=[0.0])
    assert np.isnan(singular.inverse().values).all()


def test_the_inverse_of_a_solve_takes_the_errors_out():
    _, models, _ = laboratory()
    model = sum((models[n] for n in NAMES[1:]), models["near"])
    errors = GainTerm(rms=0.1, seed=3)
    solution = SelfCal(pattern="diagonal", tolerance=1e-10).solve(model.corrupted(errors), model)
    found = model.corrupted(errors).corrupted(solution.inverse())
    assert np.abs(found.data - model.data).max() < 1e-8


def test_what_is_left_is_told_by_station_and_integration():
    data, _, _ = laboratory()
    share = np.full(data.data.shape[:3], 0.1)
    share[1] *= 3
    hit = (data.antenna1 == 2) | (data.antenna2 == 2)
    share[:, :, hit] *= 2
    left = data.with_data(data.data * share[..., None, None])
    power = (np.abs(data.data) ** 2).sum(axis=(1, 3, 4))
    for a in range(4):
        own = (data.antenna1 == a) | (data.antenna2 == a)
        due = np.sqrt((share[:, 0, own] ** 2 * power[:, own]).sum(axis=1) / power[:, own].sum(axis=1))
        assert np.allclose(rms_by_station(left, data)[:, a], due, rtol=1e-13)
    flag = np.zeros(data.data.shape[:3], bool)
    flag[:, :, hit] = True
    spoilt = left.with_data(np.where(flag[..., None, None], np.nan, left.data)).flagged(flag)
    found = rms_by_station(spoilt, data)
    assert np.isnan(found[:, 2]).all()
    assert np.allclose(found[:, [0, 1, 3]], np.array([0.1, 0.3, 0.1, 0.1])[:, None], rtol=1e-13)
