"""Calibrators: each claim of their contract can fail, and a stranger's works from a scene file."""

from dataclasses import replace
from typing import ClassVar

import numpy as np
import pytest
from astropy import units as u
from pydantic import PrivateAttr

from instrument import Calibrator, DirectionalCal, InputError, Outcome, SelfCal, Solution
from instrument.calibrate.judged import judged
from instrument.conformance import calibrators, check
from instrument.conformance.bench import Broken
from instrument.conformance.checking import a_round_trip_through_json_gives_an_equal_object
from instrument.pipeline.run import stream
from instrument.pipeline.scene_file import parse
from instrument.pipeline.scene_text import override, read_tables
from instrument.pipeline.stage import Running


class Answers(SelfCal):
    """SelfCal whose answer is spoilt: each class below in one way."""

    tolerance: float = 1e-6
    iterations: int = 80

    def solve(self, data, model, /):
        return self.spoilt(super().solve(data, model), data, model)

    def spoilt(self, found, data, model):
        return found


class Off(Answers):
    def spoilt(self, found, data, model):
        return replace(found, term=found.term.with_fields(values=found.jones * np.array([1, 1.001])))


class LiesAboutWhatItLeaves(Answers):
    def spoilt(self, found, data, model):
        return replace(found, residual=found.residual + 1)


class AlwaysContent(Answers):
    def spoilt(self, found, data, model):
        return replace(found, outcome=np.full(found.outcome.shape, Outcome.CONVERGED, object))


class SeesFlagged(Answers):
    def solve(self, data, model, /):
        bare = replace(data, flag=np.zeros((1, 1, 1), bool))
        return super().solve(bare, model)


class Mixes(Answers):
    """Every interval gets the mean of all."""

    def spoilt(self, found, data, model):
        mean = np.broadcast_to(found.jones.mean(axis=0), found.jones.shape)
        return replace(found, term=found.term.with_fields(values=mean))


class Remembers(Answers):
    calls: ClassVar[list] = []

    def spoilt(self, found, data, model):
        self.calls.append(1)
        return replace(found, term=found.term.with_fields(values=found.jones * (1 + 1e-9 * len(self.calls))))


class Secret(Answers):
    _secret: int = PrivateAttr(0)

    def __eq__(self, other):
        return self is other

    __hash__ = None


BROKEN = [
    (Off(), calibrators.it_finds_the_phases_of_stations_to_its_own_tolerance),
    (LiesAboutWhatItLeaves(), calibrators.its_solution_fits_the_data_it_came_with),
    (AlwaysContent(), calibrators.data_that_it_did_not_fit_are_never_converged),
    (SeesFlagged(), calibrators.flagged_data_weigh_nothing),
    (Mixes(), calibrators.a_block_of_times_gives_what_it_has_within_the_whole),
    (Remembers(), calibrators.a_call_of_solve_has_no_side_effects),
]


@pytest.mark.parametrize(("broken", "claim"), BROKEN, ids=lambda x: type(x).__name__)
def test_what_breaks_a_claim_is_caught_by_it(broken, claim):
    with pytest.raises(Broken):
        claim(broken)


def test_every_claim_has_one_that_breaks_it():
    assert {claim for _, claim in BROKEN} == set(calibrators.CLAIMS)
    with pytest.raises(Broken, match="unequal"):
        a_round_trip_through_json_gives_an_equal_object(Secret(), Calibrator)


@pytest.mark.long
@pytest.mark.parametrize("cls", [SelfCal, DirectionalCal])
@pytest.mark.parametrize(
    "settings",
    [
        {"pattern": "diagonal"}, {"pattern": "scalar"}, {"pattern": "phase"}, {"tolerance": 1e-4},
        {"interval": 30 * u.s, "channels": 2},
    ],
)  # fmt: skip
def test_other_settings_keep_the_contract(cls, settings):
    check(cls(**settings)).raise_if_failed()


# Directions, and judged ------------------------------------------------------------------------------------------


def test_a_directional_calibrator_takes_one_model_as_any_other():
    gains, term = calibrators._phases()
    model = calibrators._model()
    alone, named = (DirectionalCal().solve(model.corrupted(term), m) for m in (model, {"sky": model}))
    assert isinstance(alone, Solution)
    assert np.array_equal(alone.jones, named["sky"].jones)
    assert np.allclose(np.abs(alone.jones[0, 0, :, 0, 0]), np.abs(gains))


def test_judged_is_what_a_solver_says_of_the_same_matrices():
    _, term = calibrators._phases()
    model = calibrators._model()
    noise = np.random.default_rng(0).normal(size=(*model.data.shape, 2)).view(complex)[..., 0]
    data = model.corrupted(term).with_data(model.corrupted(term).data + noise)
    solver = SelfCal(interval=20 * u.s)
    due = solver.solve(data, model)
    found = judged(solver, data, model, due.jones, np.ones(due.outcome.shape, bool), due.history, 20.0)
    for name in ("residual", "unexplained"):
        assert np.allclose(getattr(found, name), getattr(due, name), rtol=1e-9), name
    assert np.array_equal(found.outcome, due.outcome) and np.array_equal(found.term.slots_s, due.term.slots_s)
    assert found.gauge.count == due.gauge.count and found.interval_s == due.interval_s


def test_judged_knows_stations_that_nothing_ties_to_the_others():
    model = calibrators._model()
    one = np.broadcast_to(np.eye(2), (6, 2, 8, 2, 2)).astype(complex)
    still, few = np.ones((6, 2), bool), np.zeros((6, 2, 28), bool)
    apart = (model.antenna1 < 3) != (model.antenna2 < 3)
    few[0, :, apart], few[1, :, (model.antenna1 < 5) == (model.antenna2 < 5)] = True, True
    data, solver = model.flagged(few), SelfCal()
    found, due = judged(solver, data, model, one, still, np.ones(1)), solver.solve(data, model)
    assert np.array_equal(found.outcome, due.outcome) and found.outcome[1, 0] is Outcome.SINGULAR
    assert np.array_equal(np.isfinite(found.jones), np.isfinite(due.jones))
    assert np.isnan(found.jones[0, 0, :3]).all() and np.isfinite(found.jones[0, 0, 3:]).all()


def test_judged_never_takes_what_does_not_fit_or_is_not_known():
    model = calibrators._model()
    one = np.broadcast_to(np.eye(2), (6, 2, 8, 2, 2)).astype(complex)
    still = np.ones((6, 2), bool)
    still[0] = False
    wild, bad = np.array(one), np.array(model.data)
    wild[1], wild[2, 0, 3] = 0.2, np.nan
    bad[3] = np.nan
    few = np.zeros((6, 2, 28), bool)
    few[4], few[5, 1, 3:] = True, True
    found = judged(SelfCal(), model.flagged(few), model.with_data(bad), wild, still, np.ones(1))
    assert [o.name for o in found.outcome[:, 0]] == [
        "ITERATION_LIMIT", "POOR_FIT", "SINGULAR", "NON_FINITE", "REFUSED", "CONVERGED"
    ]  # fmt: skip
    assert found.outcome[5, 1] is Outcome.SINGULAR and found.outcome[2, 1] is Outcome.CONVERGED
    assert np.array_equal(np.isfinite(found.jones).all(axis=(2, 3, 4)), found.converged)
    with pytest.raises(InputError, match=r"matrices of shape \(6, 2, 7, 2, 2\)"):
        judged(SelfCal(), model, model, one[:, :, 1:], still, np.ones(1))


# From a scene file -----------------------------------------------------------------------------------------------

SMALL = [
    "instrument.stations=['CS001HBA0', 'CS003HBA1', 'CS302HBA1', 'RS106HBA', 'RS205HBA']", "sky.shape=[3, 3]",
    "observation.duration='40 min'", "observation.interval='10 min'",
]  # fmt: skip


def calibration(*settings):
    tables = override(read_tables("mock-grid"), [*SMALL, *settings])
    file = parse({name: table for name, table in tables.items() if name not in ("image", "analyze", "correct")})
    scene = file.scene()
    running = Running(file.name, file.seed, scene.instrument, file.plan(scene), file.running)
    stream(running)
    return running.results["calibrate"], running.stages["calibrate"].calibrator


GAINS = "instrument.gain.values={real=[[[[1,1],[0.9,0.9],[1,1],[1.1,1.1],[0.8,0.8]]]], imag=[[[[0,0],[0.5,0.5],[-0.3,-0.3],[0,0],[0,0]]]]}"  # noqa: E501


def test_a_calibrator_of_a_stranger_works_from_a_scene_file(stranger):
    stranger("calibrators", "alternating", "Alternating")
    found, solver = calibration("calibrate={kind='alternating', unexplained=0.2}", GAINS)
    assert found.passed and type(solver).__module__ == "my_package" and solver.unexplained == 0.2
    assert found.rms["corrupted - corrected"] > 0.1 * found.rms["model"]
    assert found.rms["corrected - model"] < 1e-7 * found.rms["model"]
    with pytest.raises(InputError, match=r"\[calibrate\] Alternating has no 'mots': did you mean 'most'"):
        calibration("calibrate={kind='alternating', mots=3}")
    with pytest.raises(InputError, match=r"\[calibrate\] kind = 'alternatin': did you mean 'alternating'"):
        calibration("calibrate={kind='alternatin'}")


def test_the_directional_calibrator_works_from_a_scene_file_on_the_whole_model():
    found, solver = calibration("calibrate={kind='directional', tolerance=1e-9}", GAINS)
    assert found.passed and solver == DirectionalCal(tolerance=1e-9)
    assert found.rms["corrected - model"] < 1e-7 * found.rms["model"]
