"""`instrument plan SCENE --data`: what a verb would print before it computes; nothing is written, nothing else done."""

import json
import re
import shutil

import pytest

from instrument import MeasurementSet, write_uv
from instrument.cli import main

pytest.importorskip("arcae")
SCENE = """name = "night"
[instrument]
telescope = "lofar-hba"
beam = "none"
[sky]
kind = "grid"
shape = [1, 2]
spacing = "1 deg"
flux = "5 Jy"
[image]
pixels = 16
pixel = "20 arcmin"
uv_range = [0, 200]
"""
CALIBRATE = '[calibrate]\nkind = "selfcal"\n'


@pytest.fixture(scope="module")
def made(small_set, tmp_path_factory):
    """A folder with a set of two times and three stations, and scenes."""
    folder = tmp_path_factory.mktemp("made")
    shutil.copytree(small_set, folder / "a.MS")
    (folder / "s.toml").write_text(SCENE)
    (folder / "c.toml").write_text(SCENE + CALIBRATE)
    return folder


def planned(made, *words, scene="c.toml", data="a.MS"):
    return main(["plan", str(made / scene), "--data", str(made / data), *words])


def steps(text):
    """The lines of a plan, but seconds, which are measured, and the memory of this process."""
    lines = [re.sub(r"about [\d.]+ \w+", "about", line) for line in text.splitlines()]
    return [line for line in lines if line and not line.startswith("whole run")]


@pytest.mark.parametrize("verb", ["predict", "calibrate", "image", "subtract"])
def test_the_plan_of_a_verb_is_what_the_verb_prints_before_it_works(made, tmp_path, capsys, verb):
    more = [] if verb == "image" else ["--into", str(tmp_path / "new.MS")]
    assert planned(made, "--for", verb, *more) == 0
    found = capsys.readouterr()
    assert not (tmp_path / "new.MS").exists()
    assert main([verb, str(made / "c.toml"), "--data", str(made / "a.MS"), "--out", str(tmp_path / "o"), *more]) == 0
    told = steps(capsys.readouterr().out)
    mine = steps(found.out)
    assert len(mine) > 7 and told[: len(mine)] == mine
    assert f"scene night-{verb}" in mine[0]


def test_without_a_verb_each_that_the_scene_has_tables_for_is_planned_and_the_set_stays(made, capsys):
    def every():
        return {str(p): (p.stat().st_mtime_ns, p.stat().st_size) for p in (made / "a.MS").rglob("table.[df]*")}

    before = every()
    assert planned(made) == 0
    assert re.findall("scene night-([a-z]+)", capsys.readouterr().out) == ["predict", "calibrate", "image", "subtract"]
    assert planned(made, scene="s.toml") == 0
    assert re.findall("scene night-([a-z]+)", capsys.readouterr().out) == ["predict", "image", "subtract"]
    assert every() == before


def test_what_one_verb_refuses_the_others_are_planned_for(made, capsys):
    assert planned(made, "--into", "DATA") == 0
    said = capsys.readouterr().out
    assert re.findall("^refused +([a-z]+): .* has a column DATA", said, re.M) == ["predict", "calibrate", "subtract"]
    assert re.findall("scene night-([a-z]+)", said) == ["image"]
    assert planned(made, "--into", "DATA", "--force") == 0
    assert "refused       predict" not in capsys.readouterr().out


@pytest.mark.parametrize(
    ("words", "line"),
    [
        (["--for", "predict", "--into", "DATA"], "has a column DATA: name another one, or allow to overwrite it"),
        (["--column", "NONE"], "has no column NONE: it has DATA"),
        (["--for", "correct"], "--for: invalid choice: 'correct'"),
        (["--window", "3"], "has no window 3"),
        (["--for", "image", "--into", "X"], "--into goes with predict, calibrate, subtract: 'image' writes no visib"),
    ],
)
def test_what_no_verb_can_do_is_one_line(made, capsys, words, line):
    assert planned(made, *words) == 2
    said = capsys.readouterr()
    assert len(said.err.strip().splitlines()) == 1 and line in said.err
    assert not said.out  # one reason is told once, and not for each verb


@pytest.mark.parametrize("data", ["", " "])
def test_data_without_a_name_are_refused_by_every_verb(made, capsys, data):
    for verb in ("plan", "predict"):
        assert main([verb, str(made / "c.toml"), "--data", data]) == 2
        assert "--data is empty: name a Measurement Set" in capsys.readouterr().err


@pytest.mark.parametrize("word", ["--for=image", "--column=DATA", "--into=X", "--window=0", "--field=0", "--force"])
def test_what_is_told_of_data_that_are_not_there_is_refused(made, capsys, word):
    assert main(["plan", str(made / "s.toml"), word]) == 2
    assert capsys.readouterr().err.strip().endswith(f"{word.partition('=')[0]} goes with --data, the visibilities")


def test_a_file_without_columns_is_planned_with_the_new_file_that_it_goes_to(made, tmp_path, capsys):
    pytest.importorskip("pyuvdata")
    write_uv(made / "a.uvh5", MeasurementSet(made / "a.MS"), overwrite=True)
    assert planned(made, "--for", "subtract", data="a.uvh5") == 2
    assert "give --into a new file" in capsys.readouterr().err
    assert planned(made, "--for", "subtract", "--into", str(tmp_path / "b.uvh5"), data="a.uvh5") == 0
    assert f"into {tmp_path}/b.uvh5" in capsys.readouterr().out and not (tmp_path / "b.uvh5").exists()


def test_the_observation_of_a_scene_is_said_not_to_be_that_of_the_data(made, tmp_path, capsys):
    """In a line, and in run.json."""
    observed = '[observation]\nphase_centre = "08h13m36.0s +48d13m03s"\ntransit = "2012-12-07"\nduration = "1 h"\n'
    observed += 'interval = "2 min"\nfrequency = { centre = "150 MHz", channel_width = "0.2 MHz", channels = 1 }\n'
    (tmp_path / "o.toml").write_text(SCENE + observed)
    line = "scene: not used: [observation] (times, channels and stations are those of"
    assert main(["plan", str(tmp_path / "o.toml"), "--data", str(made / "a.MS"), "--for", "image"]) == 0
    assert capsys.readouterr().err.count(line) == 1
    out = tmp_path / "run"
    assert main(["image", str(tmp_path / "o.toml"), "--data", str(made / "a.MS"), "--out", str(out)]) == 0
    assert capsys.readouterr().err.count(line) == 1
    assert json.loads((out / "run.json").read_text())["unused"] == {"scene": ["[observation]"]}
