"""`instrument paper`: verdicts, tables, the page, two folders compared; the experiment `ixr` whole."""

import json
from types import SimpleNamespace

import numpy as np
import pytest
from astropy.table import Table

from instrument import mueller
from instrument.cli import main
from instrument.paper import command, ixr
from instrument.paper.bench import Bench
from instrument.paper.experiments import EXPERIMENTS, SECONDS, experiment
from instrument.paper.finding import AGREES, CORRECTED, DIFFERS, DOUBTFUL, MORE, NOT, Finding, tally, verdict
from instrument.paper.galactic import Seen, _windows
from instrument.paper.patch import around, rings, square
from instrument.units import Direction

SOUND = Finding("width", 3.8, "deg", "3.8", (3.7, 3.9))
WHY = Finding("length", 129.0, "m", "127", (126.5, 127.5), "by survey 129.0 m", "130 m", changed=127.1)
SLIP = Finding("distance", 9.3, "Gpc", "2.1", (9.2, 9.4), "without c/H0 it is 2.1", changed=2.1, slip=True)
MISSED = Finding("leakage", 0.5, "%", "0.3", (0.2, 0.4))
BEYOND = Finding("depth", 7.0, "rad/m2")


def test_a_number_agrees_within_its_range_and_else_needs_a_reason():
    assert [f.agreement for f in (SOUND, WHY, MISSED, BEYOND)] == [AGREES, DIFFERS, NOT, MORE]
    assert SOUND._replace(ours=3.9).agreement == AGREES and SOUND._replace(ours=3.9001).agreement == NOT
    assert SOUND._replace(ours=float("nan")).agreement == NOT
    assert SOUND._replace(because="no reason is needed").agreement == AGREES


@pytest.mark.parametrize("changed", [float("nan"), 126.0, 129.0])
def test_a_reason_that_does_not_lead_into_the_range_is_none(changed):
    assert WHY._replace(changed=changed).agreement == NOT
    assert WHY._replace(because="").agreement == NOT


def test_a_slip_is_one_where_ours_is_right_and_the_printed_form_is_not():
    assert SLIP.agreement == CORRECTED
    assert [SLIP._replace(**x).agreement for x in ({"ours": 9.5}, {"changed": 9.3}, {"changed": np.nan})] == [NOT] * 3
    assert verdict([SLIP, BEYOND]) == "1 slip, 1 number: in 1 what is printed is not what is right"


def test_a_slip_that_is_kept_is_a_doubt_and_numbers_of_one_slip_are_one():
    two, one = [SLIP._replace(what=what) for what in ("5. width", "5. height")], SLIP._replace(what="6. depth")
    doubt = SLIP._replace(what="13. count", kept="the mock follows the paper")
    assert doubt.agreement == DOUBTFUL and doubt.why[-1] == "the mock follows the paper"
    assert doubt._replace(ours=9.5).agreement == NOT
    said = "3 slips, 4 numbers: in 3 what is printed is not what is right, in 1 it is doubtful and kept"
    assert verdict([*two, one, doubt, BEYOND]) == said
    mixed = verdict([SOUND, *two, one, doubt])
    assert mixed == "reproduced, 3 of 5 by what the paper should have, 1 of 5 doubtful and kept"


def test_the_last_value_of_an_axis_is_a_lower_limit_and_agrees_only_without_an_upper_end():
    last = Finding("reach", 0.9, "/Mpc", "about 1", (0.8, 1.0), end="Nyquist")
    assert last._replace(end="").agreement == AGREES and last.agreement == NOT
    assert last._replace(within=(0.8, np.inf)).agreement == AGREES
    assert last._replace(within=(1.0, np.inf)).agreement == NOT
    assert last.value == "at least 0.900 /Mpc" and last.why == ["the end of what was measured: Nyquist"]


def test_windows_that_reach_the_last_bins_say_that_they_are_limits():
    edges = np.array([0.1, 0.3, 0.6, 0.9, 1.2])
    counts = np.array([[True, True, True, False]] * 2)  # nothing counts above 0.9

    def seen(reach, below):
        window = SimpleNamespace(
            leakage=SimpleNamespace(par_edges=edges), counts=counts, reach=lambda removed=0: (0.1, reach[removed > 0]),
            area=lambda: (1.0, 0.5),
        )  # fmt: skip
        return Seen(None, None, SimpleNamespace(edges=edges, k=edges[:-1], delta2=1e-6 * np.array(below)), window)

    signal = SimpleNamespace(delta2=np.ones_like)
    quiet = seen((0.9, 0.9), [0, 0, 0, 0])
    found = {f.what: f for f in _windows(seen((0.6, 0.9), [0.5] * 4), quiet, signal, 4.0)}
    top, more = found["window open up to k_par"], found["the same, 70 % of the leakage removed"]
    assert (top.end, more.value, more.agreement) == ("", "at least 0.900 /Mpc", AGREES)
    sphere = found["k up to which the spherical leakage is below the signal, field of 4 deg"]
    assert (sphere.value, sphere.agreement) == ("at least 1.20 /Mpc", NOT)
    crossing = _windows(seen((0.6, 0.6), [0.5, 2, 2, 2]), quiet, signal, 4.0)
    ours = [f for f in crossing if f.what == sphere.what]
    assert (ours[0].value, ours[0].agreement, ours[0].end) == ("0.300 /Mpc", AGREES, "")


def test_a_value_has_the_digits_that_show_on_which_side_it_lies():
    small = Finding("leakage", 0.0020031, "%", "< 0.002", (0.0, 0.002))
    assert (small.agreement, small.value) == (NOT, "0.002003 %")
    assert small._replace(ours=0.0019996, within=(0.002, 1.0)).value == "0.0019996 %"
    assert small._replace(ours=0.0123456).value == "0.0123 %" and small._replace(ours=float("nan")).value == "– %"


def test_the_tally_counts_every_verdict():
    assert tally([SOUND, WHY, SLIP, SLIP, BEYOND]) == (
        "4 numbers of the paper: 1 reproduced, 1 different for a reason, 2 corrected as slips, 0 not reproduced"
    )
    assert tally([MISSED]) == "1 number of the paper: 1 not reproduced"


def test_the_verdict_is_that_of_the_worst_number():
    assert verdict([SOUND, BEYOND]) == "reproduced"
    assert verdict([SOUND, WHY, BEYOND]) == "reproduced, 1 of 2 with a reason for the difference"
    assert verdict([SOUND, WHY, MISSED]) == "1 of 3 not reproduced: leakage"
    assert verdict([BEYOND]).startswith("beyond the paper")


def findings(*given):
    def run(bench):
        from matplotlib.figure import Figure

        figure = Figure()
        figure.subplots().plot([0, bench.seed or 1])
        bench.draw("line", figure, "A line.")
        return list(given)

    return run


@pytest.fixture
def scripted(monkeypatch):
    """Experiments replaced by lists of findings."""

    def script(**given):
        monkeypatch.setattr(command, "experiment", lambda name: findings(*given[name]))
        for name in given:
            monkeypatch.setitem(EXPERIMENTS, name, (name, f"title of {name}", "section 9"))

    return script


def test_a_folder_has_the_record_the_tables_the_text_and_the_page(tmp_path, scripted, capsys):
    scripted(one=[SOUND, WHY], two=[BEYOND])
    assert main(["paper", "one", "two", "one", "--quick", "--seed", "5", "--out", str(tmp_path / "p")]) == 0
    said = capsys.readouterr().out.splitlines()
    assert [line for line in said if line.startswith("one:")][-1].startswith("one: reproduced, 1 of 2")
    assert sum(line.startswith("one: title") for line in said) == 1  # asked for twice, run once
    what = json.loads((tmp_path / "p" / "run.json").read_text())
    assert what["numbers"] == {"one": {"width": 3.8, "length": 129.0}, "two": {"depth": 7.0}}
    assert (what["form"], what["seed"]) == ("quick", 5) and what["memory"]["two"] > 1e7
    assert what["command"].startswith("instrument paper one two one --quick")
    assert what["paper"]["one"]["width"] == {"printed": "3.8", "low": 3.7, "high": 3.9, "agreement": AGREES}
    assert what["paper"]["two"] == {}
    table = Table.read(tmp_path / "p" / "one.ecsv")
    keys = ("experiment", "form", "seed", "command")
    assert [table.meta[key] for key in keys] == ["one", "quick", 5, what["command"]]
    assert all(table[name].description for name in table.colnames)
    assert list(table["agreement"]) == [AGREES, DIFFERS] and table["low"][1] == 126.5
    assert np.isnan(Table.read(tmp_path / "p" / "two.ecsv")["high"][0])
    text = (tmp_path / "p" / "paper.md").read_text()
    assert "### `one`: title of one" in text and "| width | 3.80 deg | 3.8 (3.7 to 3.9) | agrees |" in text
    assert "| length | 129 m | 127 (126.5 to 127.5) | differs, for a reason; by survey 129.0 m; 130 m |" in text
    page = (tmp_path / "p" / "paper.html").read_text()
    assert "2 numbers of the paper: 1 reproduced, 1 different for a reason, 0 not reproduced." in page
    assert "instrument paper one two --quick --seed 5</pre>" in page and 'class="stack"' in page
    assert "by survey 129.0 m" in page and "A line." in page
    assert (tmp_path / "p" / "one" / "line.png").stat().st_size > 1000


@pytest.mark.parametrize("error", [ValueError("lost"), KeyboardInterrupt()])
def test_what_has_ended_is_kept_where_an_experiment_fails(tmp_path, scripted, monkeypatch, error):
    scripted(one=[SOUND], two=[MISSED], three=[BEYOND])

    def fail(bench):
        raise error

    ordinary = command.experiment
    monkeypatch.setattr(command, "experiment", lambda name: fail if name == "two" else ordinary(name))
    said = []
    with pytest.raises(type(error)):
        command.paper(["one", "two", "three"], out=str(tmp_path / "p"), show=said.append)
    assert said[-1] == "of 3 experiments 1 ended; not two, three" and said[0].startswith("1 of 3        one, about")
    assert json.loads((tmp_path / "p" / "run.json").read_text())["seed"] == "those of the scenes"
    assert json.loads((tmp_path / "p" / "run.json").read_text())["not_run"] == ["two", "three"]
    assert (tmp_path / "p" / "one.ecsv").exists() and not (tmp_path / "p" / "two").exists()
    page = (tmp_path / "p" / "paper.html").read_text()
    assert "two, three not run" in page and "Not run: two, three" in (tmp_path / "p" / "paper.md").read_text()
    whole = tmp_path / "whole"
    command.paper(["one", "three"], out=str(whole), show=said.append)
    with pytest.raises(type(error)):  # a run that is stopped replaces none that is whole
        command.paper(["one", "two"], out=str(whole), show=said.append, force=True)
    assert json.loads((whole / "run.json").read_text())["not_run"] == []
    assert json.loads((tmp_path / "whole-stopped" / "run.json").read_text())["not_run"] == ["two"]
    with pytest.raises(type(error)):
        command.paper(["two", "three"], out=str(tmp_path / "q"), show=said.append)
    assert not (tmp_path / "q").exists()


def test_every_experiment_has_its_seconds():
    assert set(SECONDS) == set(EXPERIMENTS)


def test_a_number_that_is_not_reproduced_is_status_3(tmp_path, scripted, capsys):
    scripted(one=[MISSED])
    assert main(["paper", "one", "--out", str(tmp_path / "p")]) == 3
    assert "one: 1 of 1 not reproduced: leakage" in capsys.readouterr().out
    page = (tmp_path / "p" / "paper.html").read_text()
    assert "1 number of the paper: 1 not reproduced." in page and '<pre tabindex="0">instrument paper one</pre>' in page


def test_two_folders_are_compared(tmp_path, scripted, capsys):
    for name, width in (("a", 3.8), ("b", 3.9)):
        scripted(one=[SOUND._replace(ours=width), WHY])
        assert main(["paper", "one", "--out", str(tmp_path / name)]) == 0
    capsys.readouterr()
    assert main(["compare", str(tmp_path / "a"), str(tmp_path / "b")]) == 0
    numbers = [line for line in capsys.readouterr().out.splitlines() if line.startswith("numbers")]
    assert len(numbers) == 1 and "width" in numbers[0] and "3.8" in numbers[0] and "3.9" in numbers[0]


@pytest.mark.parametrize(("word", "said"), [("bem", "did you mean 'beam'?"), ("nothing-of-it", "known: ")])
def test_an_unknown_experiment_is_one_line_and_leaves_nothing(tmp_path, capsys, word, said):
    assert main(["paper", "ixr", word, "--out", str(tmp_path / "p")]) == 2
    err = capsys.readouterr().err
    assert f"no experiment is called '{word}'" in err and said in err and err.count("\n") == 1
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(("seed", "shown"), [("0", "0"), ("x", "'x'"), ("1.5", "'1.5'"), ("2147483648", "2147483648")])
def test_a_seed_that_is_none_is_refused(tmp_path, capsys, seed, shown):
    assert main(["paper", "ixr", "--seed", seed, "--out", str(tmp_path / "p")]) == 2
    assert capsys.readouterr().err.count(f"--seed {shown}: give 1 to 2147483647") == 1
    assert not list(tmp_path.iterdir())


def test_experiments_with_commas_between_them_are_told_apart(capsys):
    assert main(["paper", "Beam,ixr"]) == 2
    assert "'Beam,ixr': separate experiments by spaces: beam ixr" in capsys.readouterr().err


def test_its_help_has_a_line_for_each_experiment(capsys):
    assert main(["paper", "--help"]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert all(
        any(line.split() == [name, *title.split()] for line in lines) for name, (_, title, _) in EXPERIMENTS.items()
    )


@pytest.mark.parametrize("name", EXPERIMENTS)
def test_every_experiment_is_there(name):
    assert callable(experiment(name))


def test_the_bench_gives_its_seed_to_scenes(tmp_path):
    assert Bench(tmp_path, seed=7).tables("di-errors")["seed"] == 7
    assert Bench(tmp_path).tables("di-errors", "sky.flux=1 Jy")["sky"]["flux"] == "1 Jy"
    assert (Bench(tmp_path, True).choose(1, 2), Bench(tmp_path).choose(1, 2)) == (1, 2)


def test_patches_and_rings_are_where_they_say():
    centre = Direction(1.0, 0.8)
    l, m = rings(np.array([2.0, 5.0]), np.array([0.0, 90.0]))
    away = around(centre, l, m).separation(centre.skycoord).deg
    assert away == pytest.approx([2, 2, 5, 5], abs=1e-9)
    assert l[1] > 0 and abs(m[1]) < 1e-12 and m[0] > 0  # north first, then east
    l, m = square(5, 10.0)
    assert len(l) == 25 and l[0] == m[0] == -np.sin(np.deg2rad(10)) and m[4] == m[0] and l[4] == -l[0]


def test_the_experiment_ixr_whole(tmp_path, capsys):
    """The whole verb; and its maps against leakages of Mueller matrices: IXR_M is one over the largest."""
    assert main(["paper", "ixr", "--quick", "--out", str(tmp_path / "p")]) == 0
    assert "NOT REPRODUCED" not in capsys.readouterr().out
    numbers = json.loads((tmp_path / "p" / "run.json").read_text())["numbers"]["ixr"]
    worst = numbers["LOFAR HBA, 150 MHz, transit: IXR_M in the main beam, worst"]
    assert worst == pytest.approx(27.5, abs=0.5)  # 0.18 % at 2 deg, worst direction: EveryBeam's too
    assert numbers["Airy dish of 25 m, 4 h before: largest leakage in the main beam"] == 0


def test_stations_of_the_experiment_ixr_leak_what_they_should():
    for leaks in (0.003, 0.03, 0.3):
        m = mueller.mueller(*[ixr.station(leaks)] * 2).real
        assert np.linalg.norm(m[0, 1:]) / m[0, 0] == pytest.approx(leaks, rel=1e-12)
        left = mueller.mueller(*[ixr.corrected(ixr.station(leaks), 0.3)] * 2).real
        # tanh(0.3 artanh d): 0.3 d for a small d
        assert np.linalg.norm(left[0, 1:]) / left[0, 0] == pytest.approx(np.tanh(0.3 * np.arctanh(leaks)), rel=1e-12)
