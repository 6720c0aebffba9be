"""Error against run time: contests keep failures, find broken promises, and name what to take."""

import time
from dataclasses import replace

import numpy as np
import pytest
from astropy.table import QTable

import instrument.precision.command as command
from instrument import InputError
from instrument.cli import main
from instrument.errors import RefusedError
from instrument.precision import Contest, Entry, Form, Trial, contests_of
from instrument.precision.contest import COLUMNS, OVER, WRONG, choice, front, measured
from instrument.precision.engines import SHORT
from instrument.registry import available


def good(asked):
    return asked / 2


def slow(asked):
    time.sleep(0.002)
    return asked / 10


def liar(asked):
    return 3 * asked


def picky(asked):
    if asked < 1e-3:
        raise RefusedError("its bound is 1e-3: the floor")
    return asked


def broken(asked):
    raise ZeroDivisionError("no")


def contest(**entries):
    return Contest(
        name="halves", kind="engines", knob="tolerance", values=(1e-2, 1e-4),
        judge=lambda found, asked: Trial(found, found),
        entries=tuple(Entry(name, answer) for name, answer in entries.items()), error="of a number",
        error_user="the same", truth="zero", honoured=True,
    )  # fmt: skip


def test_what_is_refused_fails_or_lies_stays_in_the_table():
    rows = measured(contest(good=good, picky=picky, broken=broken, liar=liar), quick=True)
    found = {(row.plugin, row.asked): row for row in rows}
    assert len(rows) == 8
    assert found["good", 1e-2].outcome == "right" and found["good", 1e-4].error == 5e-5
    assert found["picky", 1e-4].outcome == "refused: its bound is 1e-3: the floor"
    assert found["broken", 1e-2].outcome == "failed: ZeroDivisionError: no"
    assert {found["liar", asked].outcome for asked in (1e-2, 1e-4)} == {OVER}
    assert np.isnan(found["broken", 1e-2].seconds) and found["good", 1e-2].seconds > 0


def test_the_front_is_of_those_that_none_beats():
    rows = measured(contest(good=good, slow=slow, liar=liar), quick=True)
    best = front(rows)
    assert [row.seconds for row in best] == sorted(row.seconds for row in best)
    assert [row.error for row in best] == sorted((row.error for row in best), reverse=True)
    assert best[-1].plugin == "slow" and best[-1].asked == 1e-4
    assert choice(rows, 1e-5).plugin == "slow" and choice(rows, 1e-9) is None


def test_the_full_form_repeats_until_the_median_is_known(monkeypatch):
    """The 95 % interval of the median of n numbers, by their order."""
    clock = iter(np.cumsum([x for k in range(200) for x in (0.0, 1.0 + 0.2 * (k % 7 == 3))]))
    monkeypatch.setattr(time, "perf_counter", lambda: next(clock))
    (row,) = measured(replace(contest(good=good), values=(1e-2,)))
    assert row.seconds == pytest.approx(1.0) and row.seconds_spread < 0.05


def test_a_table_a_figure_and_a_page_are_written(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(command, "contests_of", lambda *given: [contest(good=good, slow=slow, picky=picky)])
    assert main(["precision", "engines", "--quick", "--out", str(tmp_path / "p")]) == 0
    table = QTable.read(tmp_path / "p" / "precision.ecsv")
    assert table.colnames == list(COLUMNS) and len(table) == 6 and table.meta["versions"]["numpy"]
    assert (tmp_path / "p" / "precision.png").stat().st_size > 10000
    page = (tmp_path / "p" / "precision.html").read_text()
    assert "instrument precision engines --quick" in page and "its bound is 1e-3: the floor" in page
    assert main(["precision", "engines", "--quick", "--out", str(tmp_path / "p"), "--force"]) == 0  # replaces its own
    said = capsys.readouterr().out
    assert "halves: for an error of 1e-06" not in said and "take good, tolerance" in said


@pytest.mark.parametrize("word", [OVER, WRONG])
def test_a_broken_promise_is_status_3(tmp_path, monkeypatch, word):
    bad = contest(liar=liar) if word == OVER else replace(
        contest(good=good), judge=lambda found, asked: Trial(found, found, WRONG)
    )  # fmt: skip
    monkeypatch.setattr(command, "contests_of", lambda *given: [bad])
    assert main(["precision", "engines", "--quick", "--out", str(tmp_path / "p")]) == 3


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["nothing"], "no scene, stage, kind of plugin or plugin with a contest is called 'nothing'"),
        (["enginse"], "'engines'"),
        (["engines", "--plugins", "matrixx"], "no engine is called 'matrixx'"),
    ],
)
def test_wrong_words_are_one_line_and_leave_nothing(tmp_path, capsys, words, said):
    assert main(["precision", *words, "--out", str(tmp_path / "p")]) == 2
    err = capsys.readouterr().err
    assert said in err and err.count("\n") == 1 and "Traceback" not in err
    assert not list(tmp_path.iterdir())


def test_contests_are_of_plugins_that_can_be_had():
    with pytest.raises(InputError, match="no scene"):
        contests_of("elements-of-style")


@pytest.mark.long
def test_engines_keep_their_tolerance_against_extended_precision():
    """On a sky that they take: every one of them has its contest."""
    found = [one for one in contests_of("engines", form=Form(quick=True)) if one.honoured]
    assert {entry.plugin for one in found for entry in one.entries} == set(available("engines"))
    for one in found:
        for entry in one.entries:
            for asked in SHORT[:8]:
                trial = one.judge(entry.answer(asked), asked)
                assert trial.error <= asked
                assert trial.error_user <= 100 * asked  # of a leakage of 1 %: it is not lost in the error of all


def trial(contest, plugin, asked):
    (entry,) = (e for e in contest.entries if e.plugin == plugin)
    return contest.judge(entry.answer(asked), asked)


@pytest.mark.long
def test_of_a_plugin_there_are_the_contests_it_takes_part_in_and_the_floor_falls_with_the_square_of_the_tolerance():
    found = contests_of("gridded", form=Form(quick=True))
    assert [one.name.partition(",")[0] for one in found] == ["predict a diffuse sky of 16 x 16 pixels", "floor in P(k)"]
    floors = [trial(found[1], "gridded", asked) for asked in (1e-2, 1e-4)]
    assert floors[1].error < 1e-3 * floors[0].error < 1e-6  # power
    assert all(floor.error_user < 1e-2 * floor.error for floor in floors)  # coherent, most of it


@pytest.mark.long
def test_each_way_to_look_through_beams_leaves_less_of_the_leakage_that_it_is_for():
    sources, diffuse = contests_of("beam", form=Form(quick=True))[1:]
    assert {e.plugin for e in sources.entries} == {"beam, normalised", "beam, joint", "clean, CLEAN"}
    assert {e.plugin for e in diffuse.entries} == {"beam, normalised", "beam, predict"}
    assert trial(sources, "beam, joint", 8).error < 0.1 * trial(sources, "beam, joint", 2).error < 0.05
    assert trial(diffuse, "beam, predict", 8).error < 0.5 * trial(diffuse, "beam, normalised", np.nan).error


@pytest.mark.long
def test_solvers_that_say_converged_are_right():
    found = contests_of("calibrators", form=Form(quick=True))
    assert len(found) == 2  # patterns
    for one in found:
        for entry in one.entries:
            for asked in one.values:
                assert one.judge(entry.answer(asked), asked).outcome == "right"


def test_a_run_is_drawn_on_the_curves_that_come_along():
    from instrument.pipeline.on_curve import curves
    from instrument.report.precision import point_figure

    rows = curves()["mock-grid"]
    assert all(isinstance(row[0], str) and all(isinstance(x, float) for x in row[1:]) for row in map(tuple, rows))
    (axes,) = point_figure(rows, "matrix", 1e-6, (1e-14, 1e-10)).axes
    assert {text.get_text() for text in axes.get_legend().get_texts()} >= {"matrix", "direct", "this run (matrix)"}
