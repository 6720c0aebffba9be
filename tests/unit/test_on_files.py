"""Scenes on visibilities in other formats than Measurement Sets: UVFITS, UVH5 and version 4 in Zarr."""

import json
from functools import partial

import numpy as np
import pytest

from instrument import Msv4File, UVFile
from instrument.cli import main
from instrument.files.fits import read_cube
from instrument.pipeline.scene_file import parse
from instrument.pipeline.scene_text import read_tables

OWN = """
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
STATIONS = ["CS001HBA0", "CS002HBA1", "CS003HBA0", "CS004HBA1", "CS005HBA0", "CS006HBA1"]
READ = {".zarr": Msv4File, ".uvh5": UVFile, ".uvfits": UVFile}
ROUNDED = {".zarr": 1e-12, ".uvh5": 1e-12, ".uvfits": 3e-7}  # as the format keeps them, relative to the rms


@pytest.fixture(scope="module", params=READ)
def kind(request):
    """The suffix of a format that is there."""
    pytest.importorskip("xarray" if request.param == ".zarr" else "pyuvdata")
    if request.param == ".zarr":
        pytest.importorskip("zarr", reason="the extra 'zarr'")
    return request.param


@pytest.fixture(scope="module")
def night(tmp_path_factory, kind):
    """A folder with simulated visibilities with gains, others without, and scenes."""
    folder = tmp_path_factory.mktemp("night")
    stations = f"stations = {json.dumps(STATIONS)}\n"
    (folder / "data.toml").write_text(OWN + SKY + STAGES)
    for name, some in (("seen", "gain = { rms = 0.05 }\n"), ("perfect", "")):
        scene = OWN + stations + some + SKY + OBSERVATION + f'[into]\nset = "{folder}/{name}{kind}"\n'
        (folder / f"{name}.toml").write_text(scene)
        assert main(["run", str(folder / f"{name}.toml"), "--out", str(folder / name)]) == 0
    return folder


def values(path, kind):
    return np.concatenate([block.data for block in READ[kind](path).blocks()])


def apart(found, wanted):
    return float(np.sqrt(np.mean(np.abs(found - wanted) ** 2) / np.mean(np.abs(wanted) ** 2)))


def do(verb, night, name, kind, to, *more):
    data = ["--data", str(night / f"{name}{kind}"), "--out", str(to / verb)]
    return main([verb, str(night / "data.toml"), *data, *more])


def test_what_a_scene_simulates_is_in_the_file(night, kind):
    wanted = parse(read_tables(str(night / "perfect.toml"))).scene().plan().run()
    assert apart(values(night / f"perfect{kind}", kind), wanted.data) < ROUNDED[kind]
    assert apart(values(night / f"seen{kind}", kind), wanted.data) > 0.01
    assert "LOFAR" in repr(READ[kind](night / f"seen{kind}"))


def test_predicted_subtracted_and_calibrated_into_new_files(night, kind, tmp_path, capsys):
    perfect = values(night / f"perfect{kind}", kind)
    new = {verb: tmp_path / f"{verb}{kind}" for verb in ("predict", "subtract", "calibrate")}
    on = partial(do, night=night, kind=kind, to=tmp_path)
    for verb, name in (("predict", "seen"), ("subtract", "perfect"), ("calibrate", "seen")):
        given = ["--into", str(new[verb])]
        assert main([verb, str(night / "data.toml"), "--data", str(night / f"{name}{kind}"), *given,
                     "--out", str(tmp_path / verb)]) == 0  # fmt: skip
    # times of UVFITS and UVH5 are kept to 20 us, but UVW are those of the file
    assert apart(values(new["predict"], kind), perfect) < 3 * ROUNDED[".uvfits"]
    assert np.abs(values(new["subtract"], kind)).max() < 3e-6 * np.abs(perfect).max()
    assert apart(values(new["calibrate"], kind), perfect) < 1e-5
    assert f"{new['calibrate']} is written" not in capsys.readouterr().err
    assert on("predict", name="seen") == 2
    assert "has no columns to write: give --into a new file" in capsys.readouterr().err
    assert main(["predict", str(night / "data.toml"), "--data", str(night / f"seen{kind}"),
                 "--into", str(new["predict"]), "--out", str(tmp_path / "again")]) == 2  # fmt: skip
    assert "exists" in capsys.readouterr().err


def test_images_of_a_file_are_those_of_the_simulation(night, kind, tmp_path):
    assert do("image", night, "perfect", kind, tmp_path, "--set", 'image.weighting="uniform"') == 0
    scene = (night / "perfect.toml").read_text()
    scene = scene[: scene.index("[into]")] + STAGES[STAGES.index("[image]") :] + 'weighting = "uniform"\n'
    (tmp_path / "imaged.toml").write_text(scene)
    assert main(["run", str(tmp_path / "imaged.toml"), "--out", str(tmp_path / "sim")]) == 0
    found, wanted = (read_cube(tmp_path / name / "cube.fits") for name in ("image", "sim"))
    assert np.abs(found.data - wanted.data).max() < 1e-5 * np.abs(wanted.data).max()


def test_a_choice_that_a_format_has_not_is_refused(night, kind, tmp_path, capsys):
    other = "--window" if kind == ".zarr" else "--column"
    assert do("image", night, "seen", kind, tmp_path, other, "1") == 2
    said = capsys.readouterr().err
    assert f"which has no {other[2:]} to choose: leave it out" in said and len(said.strip().splitlines()) == 1
    if kind == ".zarr":
        assert do("image", night, "seen", kind, tmp_path, "--column", "corrected") == 2
        assert "has no group of data 'corrected': it has base" in capsys.readouterr().err
