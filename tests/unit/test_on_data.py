"""Scenes on the visibilities of a set: what is predicted, calibrated, imaged and subtracted, and what is refused."""

import json
import shutil

import numpy as np
import pytest
from astropy import units as u

from instrument import MeasurementSet
from instrument.cli import main
from instrument.files.fits import read_cube
from instrument.pipeline.scene_file import parse
from instrument.pipeline.scene_text import read_tables

arrow = pytest.importorskip("arcae.lib.arrow_tables")
STATIONS = ["CS001HBA0", "CS002HBA1", "CS003HBA0", "CS004HBA1", "CS005HBA0", "CS006HBA1"]
INSTRUMENT = """
name = "night"
[instrument]
telescope = "lofar-hba"
beam = "none"
"""
SKY = """
[sky]
kind = "grid"
shape = [2, 2]
spacing = "1 deg"
flux = "5 Jy"
"""
OBSERVATION = """
[observation]
phase_centre = "08h13m36.0s +48d13m03s"
transit = "2012-12-07"
duration = "40 s"
interval = "10 s"
frequency = { centre = "150 MHz", channel_width = "0.2 MHz", channels = 3 }
"""
STAGES = """
[calibrate]
kind = "selfcal"
[image]
pixels = 64
pixel = "6 arcmin"
uv_range = [0, 200]
"""
ROUNDED = 3e-7  # of single precision, relative to the rms


@pytest.fixture(scope="module")
def night(tmp_path_factory):
    """A folder with a set of simulated visibilities with gains, another without, and scenes."""
    folder = tmp_path_factory.mktemp("night")
    stations = f"stations = {json.dumps(STATIONS)}\n"
    (folder / "data.toml").write_text(INSTRUMENT + SKY + STAGES)
    errors = "gain = { rms = 0.05 }\n"
    for name, some in (("seen", errors), ("perfect", "")):
        scene = INSTRUMENT + stations + some + SKY + OBSERVATION + f'[into]\nset = "{folder}/{name}.MS"\n'
        (folder / f"{name}.toml").write_text(scene)
        assert main(["run", str(folder / f"{name}.toml"), "--out", str(folder / name)]) == 0
    imaged = INSTRUMENT + stations + SKY + OBSERVATION + STAGES[STAGES.index("[image]") :]
    (folder / "imaged.toml").write_text(imaged)
    return folder


@pytest.fixture
def seen(night, tmp_path):
    shutil.copytree(night / "seen.MS", tmp_path / "seen.MS")
    return tmp_path / "seen.MS"


def values(path, column):
    return np.concatenate([block.data for block in MeasurementSet(path, column).blocks()])


def apart(found, wanted):
    return float(np.sqrt(np.mean(np.abs(found - wanted) ** 2) / np.mean(np.abs(wanted) ** 2)))


def do(verb, night, data, *more):
    return main([verb, str(night / "data.toml"), "--data", str(data), "--out", str(data.parent / verb), *more])


def test_a_scene_writes_a_set_of_what_it_simulates(night):
    wanted = parse(read_tables(str(night / "perfect.toml"))).scene().plan().run()
    assert apart(values(night / "perfect.MS", "DATA"), wanted.data) < ROUNDED
    assert apart(values(night / "seen.MS", "DATA"), wanted.data) > 0.01  # its gains


def test_predict_writes_what_the_set_would_hold(night, seen, capsys):
    assert do("predict", night, seen) == 0
    assert apart(values(seen, "MODEL_DATA"), values(night / "perfect.MS", "DATA")) < ROUNDED
    assert np.array_equal(values(seen, "DATA"), values(night / "seen.MS", "DATA"))
    assert "column MODEL_DATA" in capsys.readouterr().out


def test_subtract_leaves_what_the_sky_does_not_explain(night, tmp_path):
    shutil.copytree(night / "perfect.MS", tmp_path / "perfect.MS")
    assert do("subtract", night, tmp_path / "perfect.MS", "--into", "RESIDUAL") == 0
    left = values(tmp_path / "perfect.MS", "RESIDUAL")
    assert np.abs(left).max() < 1e-6 * np.abs(values(night / "perfect.MS", "DATA")).max()


def test_calibrate_takes_the_gains_out(night, seen):
    assert do("calibrate", night, seen) == 0
    assert apart(values(seen, "CORRECTED_DATA"), values(night / "perfect.MS", "DATA")) < 1e-5
    told = json.loads((seen.parent / "calibrate" / "run.json").read_text())
    assert told["data"]["column"] == "DATA" and (seen.parent / "calibrate" / "solutions.h5").is_file()


@pytest.mark.long
def test_images_are_those_of_the_simulation(night, tmp_path):
    shutil.copytree(night / "perfect.MS", tmp_path / "perfect.MS")
    assert do("image", night, tmp_path / "perfect.MS", "--set", 'image.weighting="uniform"') == 0
    scene = [str(night / "imaged.toml"), "--out", str(tmp_path / "sim"), "--set", 'image.weighting="uniform"']
    assert main(["run", *scene]) == 0
    found, wanted = (read_cube(tmp_path / name / "cube.fits") for name in ("image", "sim"))
    assert np.abs(found.data - wanted.data).max() < 1e-5 * np.abs(wanted.data).max()


def test_flagged_and_missing_visibilities_have_no_part_in_weights_or_images(night, seen, tmp_path):
    """Nonsense that is flagged, with uniform weights, leaves the image that the rest makes."""
    with arrow.Table.from_filename(str(seen), readonly=False) as table:
        data, flag = (np.array(table.getcol(name)) for name in ("DATA", "FLAG"))
        flag[::3] = True
        data[::3] = 1e6
        table.putcol("DATA", data)
        table.putcol("FLAG", flag)
    assert do("image", night, seen, "--set", 'image.weighting="uniform"') == 0
    told = json.loads((tmp_path / "image" / "run.json").read_text())
    assert told["data"]["flagged"] == pytest.approx(1 / 3, abs=0.02)
    block = next(MeasurementSet(seen).blocks())
    from instrument import Imager

    imager = Imager(pixels=64, pixel=6 * u.arcmin, uv_range=(0, 200), weighting="uniform")
    wanted, found = imager.image(block), read_cube(tmp_path / "image" / "cube.fits")
    assert np.abs(found.data - wanted.data).max() < 1e-5 * np.abs(wanted.data).max()
    assert np.abs(found.data).max() < 100


@pytest.mark.long
def test_stations_in_another_order_and_a_part_of_them_are_found(night, seen, tmp_path, capsys):
    some = json.dumps([STATIONS[4], STATIONS[0], STATIONS[2]])
    (tmp_path / "few.toml").write_text(
        (night / "data.toml").read_text().replace('beam = "none"', f'beam = "none"\nstations = {some}')
    )
    few = [str(tmp_path / "few.toml"), "--data", str(seen), "--out", str(tmp_path / "o")]
    assert main(["image", *few]) == 0
    told = json.loads((tmp_path / "o" / "run.json").read_text())
    assert told["data"]["flagged"] == 0
    assert main(["predict", *few, "--force"]) == 2
    assert "fewer stations" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("words", "line"),
    [
        (["predict", "--into", "DATA"], "has a column DATA"),
        (["predict", "--into", "UVW", "--force"], "UVW is no column for visibilities"),
        (["calibrate", "--column", "CORRECTED"], "has no column CORRECTED: it has DATA"),
        (["image", "--window", "3"], "has no window 3"),
        (["image", "--set", 'instrument.stations=["CS001HBA0", "CS030HBA0"]'], "no station CS030HBA0"),
        (["calibrate", "--set", "observation.interval=3"], "observation"),
    ],
)
def test_what_cannot_be_done_is_one_line_and_the_set_stays(night, seen, capsys, words, line):
    before = values(seen, "DATA")
    assert do(words[0], night, seen, *words[1:]) == 2
    said = capsys.readouterr().err.strip().splitlines()
    assert line in said[-1] and len([s for s in said if "warning" not in s]) == 1
    assert np.array_equal(values(seen, "DATA"), before)
    assert sorted(p.name for p in seen.parent.iterdir()) == ["seen.MS"]


def test_a_scene_without_what_a_verb_is_about_is_refused(night, seen, tmp_path, capsys):
    (tmp_path / "bare.toml").write_text(INSTRUMENT)
    bare = [str(tmp_path / "bare.toml"), "--data", str(seen)]
    assert main(["calibrate", *bare]) == 2 and "a table [calibrate]" in capsys.readouterr().err
    assert main(["subtract", *bare]) == 2 and "[into] needs a model of the sky" in capsys.readouterr().err


def test_a_failure_at_the_end_leaves_the_set_as_it_was(night, seen, monkeypatch, capsys):
    from instrument.files import measurement_set

    def full(*given):
        raise OSError(28, "No space left on device", str(seen))

    monkeypatch.setattr(measurement_set, "add_column", full)
    assert do("predict", night, seen) == 1
    assert "No space left on device" in capsys.readouterr().err
    monkeypatch.undo()
    with arrow.Table.from_filename(str(seen)) as table:
        assert "MODEL_DATA" not in table.columns()
    assert sorted(p.name for p in seen.parent.iterdir()) == ["seen.MS"]


def test_a_set_that_is_there_is_made_anew_with_overwrite_only(night, tmp_path, capsys):
    shutil.copytree(night / "perfect.MS", tmp_path / "a.MS")
    scene = [str(night / "perfect.toml"), "--set", f'into.set="{tmp_path}/a.MS"', "--out", str(tmp_path / "o")]
    assert main(["run", *scene]) == 2
    assert "a.MS exists" in capsys.readouterr().err
    assert main(["run", *scene, "--set", "into.overwrite=true"]) == 0


def test_the_plan_says_how_far_the_sign_of_dp3_is(night, seen, capsys):
    assert do("predict", night, seen, "--set", 'instrument.beam="full"') == 0
    line = next(s for s in capsys.readouterr().out.splitlines() if "phase = 'fringe'" in s)
    assert 1e-6 < float(line.rsplit(" ", 1)[1]) < 1e-2
    assert (
        do(
            "predict",
            night,
            seen,
            "--force",
            "--set",
            'instrument.phase="everybeam"',
            "--set",
            'instrument.beam="full"',
        )
        == 0
    )
    assert "phase = 'fringe'" not in capsys.readouterr().out


@pytest.mark.long
def test_a_beam_that_was_taken_out_is_put_back_where_the_data_are_compared(night, tmp_path, capsys):
    """Predicted with the beam, written corrected towards the centre: no other than the prediction is left of it."""
    beam = ["--set", 'instrument.beam="full"']
    scene = (night / "perfect.toml").read_text().replace(f'"{night}/perfect.MS"', f'"{tmp_path}/c.MS"')
    (tmp_path / "c.toml").write_text(scene + "[correct]\n")
    assert main(["run", str(tmp_path / "c.toml"), "--out", str(tmp_path / "run"), *beam]) == 0
    assert MeasurementSet(tmp_path / "c.MS").beam_state.removed == "centre"
    capsys.readouterr()
    assert do("subtract", night, tmp_path / "c.MS", *beam) == 0
    assert "put back, as the model has it" in capsys.readouterr().out
    left, had = values(tmp_path / "c.MS", "SUBTRACTED_DATA"), values(tmp_path / "c.MS", "DATA")
    assert np.abs(left).max() < 1e-6 * np.abs(had).max()
    assert MeasurementSet(tmp_path / "c.MS", "SUBTRACTED_DATA").beam_state.removed == "nothing"
    assert do("calibrate", night, tmp_path / "c.MS") == 2
    said = capsys.readouterr().err
    assert "the model has none: read a column that has it" in said and len(said.strip().splitlines()) == 1


def test_a_verb_has_a_folder_of_its_own_and_a_set_named_twice_its_usual_column(night, tmp_path, monkeypatch, capsys):
    """predict --force takes no folder of calibrate; --into the set that is read writes what the verb writes."""
    shutil.copytree(night / "perfect.MS", tmp_path / "a.MS")
    monkeypatch.chdir(tmp_path)
    for verb, more in (("predict", []), ("subtract", ["--into", "a.MS"]), ("predict", ["--force"])):
        assert main([verb, str(night / "data.toml"), "--data", "a.MS", *more]) == 0
    assert sorted(p.name for p in (tmp_path / "runs").iterdir()) == ["night-predict", "night-subtract"]
    with arrow.Table.from_filename("a.MS") as table:
        assert {"MODEL_DATA", "SUBTRACTED_DATA"} <= set(table.columns()) and "CORRECTED_DATA" not in table.columns()
    capsys.readouterr()
    for verb in ("predict", "image"):
        assert main([verb, str(night / "data.toml"), "--data", str(night / "data.toml")]) == 2
        assert "data.toml holds no visibilities: a Measurement Set, UVFITS" in capsys.readouterr().err


def test_nothing_is_told_of_a_prediction_that_is_not_made(night, tmp_path, capsys):
    shutil.copytree(night / "perfect.MS", tmp_path / "a.MS")
    assert do("image", night, tmp_path / "a.MS") == 0
    said = capsys.readouterr().out
    assert "no prediction" in said and "total flux" not in said and "engine" not in said
    page = (tmp_path / "image" / "report.html").read_text()
    assert "a.MS" in page and "flagged, missing or not finite" in page


def test_progress_never_goes_back_nor_beyond_the_end():
    """Shares of a run that are summed in two orders differ in their last bit."""
    from instrument.pipeline.run import _forward

    told = []
    progress = _forward(lambda done, name=None: told.append(done))
    for done in (0.1 + 0.2 + 0.3, 0.6, 0.9, 1 + 1e-16, 1.1):
        progress(done, "x")
    assert told == [0.1 + 0.2 + 0.3, 0.1 + 0.2 + 0.3, 0.9, 1.0, 1.0]


def test_progress_is_told_where_visibilities_are_only_read(night, tmp_path, monkeypatch):
    """Four blocks of a time each: a quarter done after each, of the share of the run that is theirs."""
    from contextlib import contextmanager

    from instrument.pipeline import run as running

    told = []

    @contextmanager
    def bar(text):
        yield lambda done, name="": told.append(done)

    monkeypatch.setattr(running, "progress_bar", bar)
    memory = ["--memory", "10 GB", "--set", "image.pixels=16", "--set", 'image.pixel="20 arcmin"']
    shutil.copytree(night / "perfect.MS", tmp_path / "a.MS")
    from instrument.plan import Plan

    one = property(lambda self: [(slice(t, t + 1), slice(0, 3)) for t in range(4)])
    monkeypatch.setattr(Plan, "slices", one)
    assert do("image", night, tmp_path / "a.MS", *memory) == 0
    assert len(told) > 4 and told == sorted(told) and len(set(told[:4])) == 4
