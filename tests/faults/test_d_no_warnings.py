"""A fit is judged without a numpy warning, whatever it holds: amplitudes of 1e+-6, dead stations, models of zero."""

import importlib.util
import warnings
from pathlib import Path

import numpy as np
import pytest

from instrument import DirectionalCal, SelfCal
from instrument.calibrate.fit import Left, strange

spec = importlib.util.spec_from_file_location("hard", Path(__file__).with_name("hard_calibrations.py"))
hard = importlib.util.module_from_spec(spec)
spec.loader.exec_module(hard)


def lefts(rng, kind, lanes=3, stations=8):
    """What fits may leave of data of stations whose amplitudes differ by up to 1e12."""
    a1, a2 = np.triu_indices(stations, 1)
    amplitude = 10 ** rng.uniform(-6, 6, (lanes, stations))
    data = rng.chisquare(8, (lanes, len(a1))) * (amplitude[:, a1] * amplitude[:, a2]) ** 2
    rest, fit = data * 10 ** rng.uniform(-6, 0.3, data.shape), data * rng.uniform(0.5, 1.5, data.shape)
    samples = rng.integers(1, 4, data.shape)
    if kind == "dead station":
        for x in (rest, data, fit):
            x[:, a1 == 0] = 0.0
    elif kind == "zero model":
        rest, fit = data.copy(), np.zeros_like(fit)
    elif kind == "few samples":
        samples[:, rng.random(len(a1)) < 0.8] = 0
    elif kind == "nothing":
        rest, data = np.zeros_like(rest), np.zeros_like(data)
    return Left(rest, data, fit, samples), a1, a2, stations


@pytest.mark.parametrize("kind", ["amplitudes", "dead station", "zero model", "few samples", "nothing"])
def test_d4_baselines_are_judged_without_a_warning(kind):
    rng = np.random.default_rng(5)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        for _ in range(30):
            left, a1, a2, stations = lefts(rng, kind)
            odd = strange(left, a1, a2, stations, 1e-8, "full")
            assert not odd[left.samples == 0].any()
            assert np.isfinite(left.worst).all() or kind == "nothing"


@pytest.mark.parametrize(
    "kind", ["amplitudes", "dead station", "zero model", "zero data", "zero weight", "one baseline"]
)
def test_d4_solves_end_without_a_warning(kind):
    rng = np.random.default_rng(7)
    truth = hard.seen(hard.array(6, 0), *hard.sky_of(rng, 3, 0.3), 1, 1)
    jones = hard.jones_of(rng, "diagonal", (1, 1, 6))
    if kind == "amplitudes":
        jones = jones * 10 ** rng.uniform(-6, 6, (1, 1, 6, 1, 1))
    data, model = hard.put(truth, jones), truth
    of_first = (truth.antenna1 == 0) | (truth.antenna2 == 0)
    if kind == "dead station":
        data.data[:, :, of_first] = 0.0
    elif kind == "zero model":
        model = truth.with_data(truth.data * np.where(of_first, 0.0, 1.0)[:, None, None])
    elif kind == "zero data":
        data = data.with_data(0 * data.data)
    elif kind == "one baseline":
        data.data[0, :, 3] *= 1e3
    with warnings.catch_warnings():
        warnings.simplefilter("error", RuntimeWarning)
        SelfCal(iterations=30).solve(data, model)
        DirectionalCal(iterations=5).solve(data, {"all": model})
        str(SelfCal(iterations=30).solve(data, model.with_data(0 * model.data)))
