"""`instrument stress`: the cases run, a wrong answer is called one, the command says what it must."""

import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from astropy.table import Table

from instrument.cli import main
from instrument.errors import InputError, RefusedError
from instrument.foreground.base import ForegroundRemover
from instrument.jones.base import ElementBeam
from instrument.mat2 import pack
from instrument.predict.direct import Direct
from instrument.registry import load
from instrument.stress.case import NOT_THERE, REFUSED, RIGHT, WRONG, Answer, Case, Unfit, claim, held, judged
from instrument.stress.subjects import PARTS, TRIED, subjects
from instrument.stress.suite import all_cases

ROOT = Path(__file__).resolve().parents[2]


def verdicts(table):
    return {row["case"]: row["verdict"] for row in table}


def test_every_case_of_the_list_is_there_once_with_its_right_answer():
    cases = all_cases()
    keys = [c.key for c in cases]
    assert len(set(keys)) == len(keys)
    assert {c.stage for c in cases} <= {*TRIED, *PARTS}
    assert all(c.right and c.name and (c.tried is None) == bool(c.missing) for c in cases)


def test_the_references_are_those_of_the_generator():
    pytest.importorskip("mpmath")
    sys.path.insert(0, str(ROOT / "docs" / "reports"))
    try:
        import stress_references
    finally:
        sys.path.pop(0)
    assert stress_references.TARGET.read_text() == stress_references.text()


def one(tried, **more):
    return judged(Case("0", "run", "x", "y", tried, **more), None)


def raises(error):
    def tried(_):
        raise error

    return tried


def test_verdicts():
    assert one(lambda _: held(1 + 1e-13, 1.0, 1e-12)).verdict == RIGHT
    assert one(lambda _: held(1 + 1e-11, 1.0, 1e-12)).verdict == WRONG
    assert one(lambda _: held(np.nan, 1.0, 1e-12)).verdict == WRONG
    assert one(lambda _: claim(False)).verdict == WRONG
    assert one(raises(InputError("no"))).verdict == WRONG
    assert one(raises(InputError("no")), refusal=True).verdict == REFUSED
    assert one(raises(Unfit("no"))).verdict == REFUSED
    assert one(raises(ZeroDivisionError("x")), refusal=True).verdict == WRONG
    assert one(None).verdict == NOT_THERE


def test_digits_are_those_of_the_relative_error_and_15_at_most():
    assert held(1.001, 1.0, 1).digits == pytest.approx(3, abs=1e-3)
    assert held(1.0, 1.0, 1).digits == 15
    assert held([1e-30], [2e-30], 1).digits == pytest.approx(0.30103, abs=1e-5)
    assert Answer(np.inf, 1).digits == 0 and np.isnan(claim(True).digits)


class Careless(Direct):
    """Forgets the w-term, takes V_ba for V_ab, and makes a root of B."""

    def sums(self, problem):
        return np.conj(Direct().sums(problem))


def test_an_engine_of_the_wrong_sign_comes_out_wrong():
    from instrument.stress import cases_engines

    for case in (cases_engines.near, cases_engines.cancelled, cases_engines.no_root):
        assert judged(case, load("engines", "direct")).verdict == RIGHT
        assert judged(case, Careless()).verdict == WRONG


def test_the_command_writes_a_table_and_ends_with_the_counts(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    assert main(["stress", "jones", "--out", "here"]) == 0
    assert [p.name for p in Path("here").iterdir()] == ["stress.ecsv"]
    table = Table.read("here/stress.ecsv")
    assert table.colnames == ["case", "stage", "verdict", "digits", "condition"]
    counts = [sum(table["verdict"] == v) for v in (RIGHT, REFUSED, WRONG, NOT_THERE)]
    last = capsys.readouterr().out.strip().splitlines()[-1]
    assert last == "{} right, {} refused, {} WRONG, {} not there".format(*counts)
    assert main(["stress", "jones", "--out", "here"]) == 2


def test_a_wrong_answer_is_status_3(monkeypatch, capsys):
    from instrument.jones import mueller

    monkeypatch.setattr(mueller, "ixr_jones", lambda jones: np.ones(1))
    assert main(["stress", "jones"]) == 3
    assert "1 WRONG" in capsys.readouterr().out.splitlines()[-1]


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["hamakr"], "did you mean 'hamaker'"),
        (["skies"], "no case fits a kind of plugins ('skies')"),
        (["jones", "--set", "a=1"], "--set a: settings are of one plugin"),
        (["none.toml"], "none.toml"),
    ],
)
def test_wrong_input_is_one_line_and_status_2(words, said, capsys):
    assert main(["stress", *words]) == 2
    err = capsys.readouterr().err
    assert said in err and err.count("\n") == 1


def test_a_scene_is_its_telescope_its_element_and_what_its_stages_hold():
    found = {s.stage: s for scene in ("di-errors", "mock-grid") for s in subjects(scene)}
    assert {"telescopes", "elements", "calibrators", "imagers"} <= set(found)


@pytest.mark.long
def test_all_cases(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    main(["stress", "--out", "here"])
    wrong = [case for case, verdict in verdicts(Table.read("here/stress.ecsv")).items() if verdict == WRONG]
    assert wrong == []


class Turned(ElementBeam):
    """Two crossed dipoles, of which one sign is wrong: the second counts its azimuth backwards."""

    real = True

    def jones(self, at):
        cos, sin = at.azimuth_cos_sin
        up = np.maximum(np.cos(at.zenith_angle), 0)
        return pack(up * cos, -up * sin, -up * sin, up * cos)[:, None]


class Mirrored(Direct):
    """Takes the brightness for its conjugate: V comes out with the other sign."""

    def sums(self, problem):
        found = Direct().sums(problem)
        return np.swapaxes(found, -1, -2)


class Rough(Direct):
    """Wrong by 1e-6 of the flux, of which it says this much."""

    says: float = 0.0
    boasts: bool = False  # that it takes any tolerance

    def sums(self, problem):
        return Direct().sums(problem) + 5e-7 * (1 + 1j)

    def prepare(self, problem, tolerance):
        if tolerance < self.says and not self.boasts:
            raise RefusedError("give a larger tolerance")
        return replace(super().prepare(problem, tolerance), bound=self.says)


def test_an_engine_that_approximates_is_held_to_what_it_says_of_itself():
    tried = [c for c in all_cases() if c.stage == "engines" and c.key in ("1", "5", "9", "10", "16", "X1")]
    assert {judged(c, Rough(says=2e-9)).verdict for c in tried} == {WRONG}
    assert {judged(c, Rough(says=2e-6)).verdict for c in tried} == {RIGHT}
    assert {judged(c, Rough(says=10.0, boasts=True)).verdict for c in tried} == {WRONG}
    assert {judged(c, Rough(says=1e9, boasts=True)).verdict for c in tried} == {WRONG}


class Greedy(ForegroundRemover):
    """Fits power laws, and takes a third of all the rest away as well."""

    def separate(self, given):
        found = load("foregrounds", "polynomial").separate(given)
        operator = found.operator + 0.3 * (np.eye(len(given)) - found.operator)
        return replace(found, operator=operator, basis=None)


@pytest.mark.parametrize(
    ("plugin", "stage", "keys"),
    [(Turned(), "elements", {"18"}), (Mirrored(), "engines", {"9", "16"}), (Greedy(), "foregrounds", {"FR5"})],
)
def test_a_strangers_plugin_that_is_wrong_on_purpose_comes_out_wrong(plugin, stage, keys):
    """All of its kind's cases are tried on it by `instrument stress NAME`; these find it."""
    tried = {c.key: c for c in all_cases() if c.stage == stage and c.tried is not None}
    assert {key for key in keys if judged(tried[key], plugin).verdict == WRONG} == keys
