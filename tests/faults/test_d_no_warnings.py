"""A fit is judged without a numpy warning, whatever it holds: amplitudes of 1e+-6, dead stations, models of zero."""

import importlib.util
import warnings
from contextlib import suppress
from dataclasses import replace
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np
import pytest
from astropy import units as u

from instrument import DirectionalCal, InputError, SelfCal
from instrument.calibrate.fit import Left, strange
from instrument.files.solutions import write_h5parm
from instrument.report.calibration import common_errors, convergence, outcomes, residuals
from instrument.report.stations import bandpass, gain_errors, gains

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


SOLVES = ("amplitudes", "dead station", "zero model", "zero data", "zero weight", "one baseline", "one good interval",
          "infinite data", "all flagged")  # fmt: skip


def spoilt(kind, beams):
    """Data and model of a kind, and a model of other directions."""
    rng = np.random.default_rng(7)
    array = hard.array(6, 0, beams)
    truth, other = (hard.seen(array, *hard.sky_of(rng, 3, 0.0 if beams else 0.3), 2, 1) for _ in range(2))
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
    elif kind == "zero weight":
        data = replace(data, weight=np.zeros(data.data.shape[:3]))
    elif kind == "one baseline":
        data.data[0, :, 3] *= 1e3
    elif kind == "one good interval":
        data.data[1] = 0.0
    elif kind == "infinite data":
        data.data[0, 0, 2] = np.inf
    elif kind == "all flagged":
        data = data.flagged(np.ones((1, 1, 1), bool))
    return data, model, other


def used(found, data, folder):
    """Prints a solution, writes it, draws it, takes it out of the data."""
    str(found), repr(found)
    write_h5parm(folder / "gains.h5", found, at=data.at, overwrite=True)
    for solution in getattr(found, "clusters", {"all": found}).values():
        data.corrected(solution.term)
        for draw in (gains, gain_errors, bandpass, outcomes, convergence, residuals, common_errors):
            with suppress(InputError):  # in one line: there is nothing to draw
                draw(solution)
            plt.close("all")


@pytest.mark.parametrize("beams", [False, True])
@pytest.mark.parametrize("kind", SOLVES)
def test_d4_solves_end_without_a_warning(kind, beams):
    data, model, other = spoilt(kind, beams)
    with warnings.catch_warnings():
        warnings.simplefilter("error", RuntimeWarning)
        for pattern in ("full", "phase"):
            str(SelfCal(iterations=30, pattern=pattern).solve(data, model))
        str(DirectionalCal(iterations=5).solve(data, {"all": model}))
        str(DirectionalCal(iterations=5, robust=5.0, interval=120 * u.s).solve(data, {"a": model, "b": other}))
        str(SelfCal(iterations=30).solve(data, model.with_data(0 * model.data)))


@pytest.mark.long
@pytest.mark.parametrize("beams", [False, True])
@pytest.mark.parametrize("kind", SOLVES)
def test_solutions_are_used_without_a_warning(kind, beams, tmp_path):
    data, model, other = spoilt(kind, beams)
    with warnings.catch_warnings():
        warnings.simplefilter("error", RuntimeWarning)
        for sefd in (0, 2820):
            seen = data.with_noise(sefd * u.Jy, seed=1) if sefd else data
            for pattern in hard.PATTERNS:
                used(SelfCal(iterations=60, pattern=pattern).solve(seen, model), data, tmp_path)
                long = {"iterations": 10, "pattern": pattern, "interval": 120 * u.s}
                for robust in (None, 5.0):
                    both = DirectionalCal(**long, robust=robust).solve(seen, {"a": model, "b": other})
                    used(both, data, tmp_path)
