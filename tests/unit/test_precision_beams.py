"""Contests of beams and whole runs: every element, ours and a stranger's, against its formula in more digits."""

import numpy as np
import pytest

import instrument
from instrument.cli import main
from instrument.errors import RefusedError
from instrument.jones.base import ElementBeam
from instrument.jones.mueller import ixr_jones
from instrument.pipeline.on_curve import on_curve
from instrument.pipeline.scene_text import read_tables
from instrument.precision import Form, contests_of, elements
from instrument.precision.elements import differential, distance, leakage
from instrument.report.style import drawer

QUICK = Form(quick=True)


@pytest.fixture
def few(monkeypatch):
    """Contests on few directions, stations and times: what is looked at is the machinery."""
    monkeypatch.setattr("instrument.precision.elements.DIRECTIONS", (60, 60))
    monkeypatch.setattr("instrument.precision.elements.SPACINGS", (15.0, 7.5, 5.0, 3.0))
    monkeypatch.setattr("instrument.precision.telescopes.DIRECTIONS", (4, 4))
    monkeypatch.setattr("instrument.precision.telescopes.JUDGED", 3)
    monkeypatch.setattr("instrument.precision.telescopes.STATIONS", 3)
    monkeypatch.setattr("instrument.precision.telescopes.TIMES", 12)


def test_leakage_is_that_of_ixr_and_keeps_its_digits_where_there_is_none():
    rng = np.random.default_rng(1)
    j = rng.normal(size=(50, 2, 2)) + 1j * rng.normal(size=(50, 2, 2))
    assert leakage(j).astype(float) == pytest.approx(1 / np.sqrt(ixr_jones(j)), rel=1e-12)
    unitary = np.linalg.qr(j)[0] * 3.7
    assert leakage(unitary).max() < 1e-15
    small = np.array([[1, 1e-9], [1e-9, 1]])
    assert float(leakage(small)) == pytest.approx(1e-9, rel=1e-6)


def test_distance_is_relative_to_the_largest_matrix():
    one, worse = np.tile(np.eye(2), (3, 1, 1)), np.tile(np.diag([1.1, 0.9]), (3, 1, 1))
    error, leaked, *_ = distance(one + 1e-3 * np.eye(2), one)
    assert error == pytest.approx(1e-3) and leaked == pytest.approx(0.0, abs=1e-15)
    worse[1:] = one[1:]
    found = distance(worse, one)
    assert found.error_user == pytest.approx(0.1 / np.sqrt(3)) and found.user_max == pytest.approx(0.1)
    assert differential(np.array([2j * np.eye(2), np.diag([1.0, 3.0])])) == pytest.approx(
        np.array([np.eye(2), np.diag([-0.5j, -1.5j])])
    )


def told(contest):
    """What each entry is worth at each value: (plugin, asked) -> Trial."""
    return {
        (entry.plugin, asked): contest.judge(entry.answer(asked), asked)
        for entry in contest.entries
        for asked in entry.values or contest.values
    }


def test_our_elements_are_right_to_rounding_and_finer_tables_are_better(few):
    found = [c for c in contests_of("elements", form=QUICK) if c.name.startswith("element ")]
    assert len(found) == len(instrument.available("elements"))
    for contest in found:
        rows = told(contest)
        (formula,) = (trial.error for (_, asked), trial in rows.items() if not asked)
        assert formula < 1e-13  # rounding of trigonometric functions at angles of a few rad
        for kind in ("linear", "cubic"):
            errors = [trial.error for (name, _), trial in rows.items() if name.endswith(kind)]
            assert len(errors) == 2 and errors[0] > 3 * errors[1] > 3 * formula


def test_a_dipole_is_a_rough_model_of_lofars_and_a_dish_is_none(few):
    for contest in contests_of("elements", ("hamaker", "dipole"), QUICK)[-2:]:
        rows = told(contest)
        (itself,) = (trial for (name, _), trial in rows.items() if name == "hamaker")
        assert itself.error < 1e-13 and itself.error_user < 1e-13
        assert 1e-2 < min(trial.error for (name, _), trial in rows.items() if name.startswith("dipole")) < 0.5
    dish = contests_of("elements", ("airy",), QUICK)[-1].entries[0]
    with pytest.raises(RefusedError, match="its receptors turn with their mount"):
        dish.answer(dish.values[0])


def test_an_element_of_a_stranger_is_drawn_in(stranger, few):
    stranger("elements", "cosine", "Cosine")
    own, hba, _ = contests_of("elements", ("cosine",), QUICK)
    rows = told(own)
    assert rows["cosine", 0.0].error < 1e-14 < rows["cosine, table, cubic", 3.0].error < 1e-4
    assert hba.entries[0].plugin == "cosine (power)" and contests_of("cosine", form=QUICK)[0].name.startswith(
        "element "
    )


@pytest.mark.long
def test_the_command_draws_an_element_of_a_stranger_beside_ours(stranger, few, tmp_path, capsys):
    stranger("elements", "cosine", "Cosine")
    out = tmp_path / "p"
    assert main(["precision", "elements", "--plugins", "hamaker,cosine", "--quick", "--out", str(out)]) == 0
    said = capsys.readouterr().out
    assert "element cosine, 60 directions" in said and "cosine, table, cubic" in said
    text = (out / "precision.ecsv").read_text()
    assert '"cosine (power)"' in text and '"hamaker, table, linear"' in text
    assert (out / "precision.html").stat().st_size > 10000


def test_an_element_without_a_formula_in_more_digits_is_judged_by_its_tables(few):
    class Plain(ElementBeam):
        real = True

        def jones(self, at):
            return np.cos(at.zenith_angle)[:, None, ..., None, None] * np.eye(2)

    Plain.__module__ = "elsewhere"
    own, *_ = elements.contests({"plain": Plain}, QUICK)
    formula, _, cubic = own.entries
    with pytest.raises(RefusedError, match="gives no truth"):
        formula.answer(0.0)
    assert 1e-12 < own.judge(cubic.answer(3.0), 3.0).error < 1e-5


def test_beams_of_stations_are_right_to_rounding_and_change_while_they_are_held(few):
    (contest,) = contests_of("telescopes", ("lofar-hba",), QUICK)
    rows = told(contest)
    assert rows["lofar-hba", 60.0].error < 1e-11  # phases of 100 turns
    assert rows["lofar-hba", 180.0].error > 1e-5 and rows["lofar-hba", 600.0].error > 2 * rows["lofar-hba", 180.0].error
    assert 1e-5 < rows["lofar-hba, tiles ideal", 60.0].error < 1e-2


def test_the_page_of_a_run_has_its_point_on_the_curve_of_its_scene(tmp_path):
    tables = read_tables("mock-grid")
    check = {"error": 3e-13, "bound": 1e-10, "passed": True, "seen": {"times": [3, 6], "channels": [1, 1]}}
    check["seen"] |= {"baselines": [1711, 1711], "stations": [59, 59]}
    record = {
        "name": "mock-grid", "scene": tables, "plan": {"engine": "matrix"}, "checks": {"prediction": check},
        "stages": {name: {"seconds": {"measured": 0.2}} for name in ("plan", "predict")},
    }  # fmt: skip
    (section,) = on_curve(record, drawer(tmp_path))
    assert section.title == "Error against run time" and (tmp_path / "precision.png").stat().st_size > 10000
    other = record | {"scene": tables | {"sky": tables["sky"] | {"flux": "1 Jy"}}}
    unchecked = record | {"checks": {"prediction": check | {"passed": None, "error": None}}}
    for without in (other, unchecked, record | {"name": "mine"}):
        assert on_curve(without, drawer(tmp_path)) == []


@pytest.mark.long
def test_the_run_of_a_scene_is_right_to_rounding_where_little_is_allowed():
    (run,) = [c for c in contests_of("mock-grid", ("matrix",), QUICK) if c.name == "run mock-grid"]
    rows = told(run)
    assert rows["matrix", 1e-6].error < 1e-6 and rows["matrix", 1e-6].error < rows["matrix", 1e-2].error < 1e-2
