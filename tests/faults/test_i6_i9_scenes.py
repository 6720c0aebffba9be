"""Scenes that ask for more than there is, or for what cannot be: refused by `plan` too, in one line with the key."""

import time

import pytest

from instrument.cli import main
from instrument.errors import RefusedError

TINY = """name = "tiny"
[instrument]
telescope = "lofar-hba"
stations = ["CS001HBA0", "CS002HBA0", "RS508HBA"]
[observation]
phase_centre = "08h13m36.0s +48d13m03s"
transit = "2012-12-07"
duration = "40 min"
interval = "10 min"
frequency = { centre = "150 MHz", width = "0.19 MHz", channels = 1 }
[sky]
kind = "random"
count = 3
[noise]
sefd = "2820 Jy"
[image]
pixels = 16
pixel = "30 arcmin"
"""


@pytest.fixture
def planned(tmp_path, monkeypatch, capsys):
    """What `plan` says of the tiny scene with some settings: status, shown, said."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "s.toml").write_text(TINY)

    def plan(*settings):
        words = [w for s in settings for w in (("--set", s) if "=" in s and not s.startswith("--") else (s,))]
        begin = time.process_time()
        status = main(["plan", "s.toml", *words])
        assert time.process_time() - begin < 5
        out = capsys.readouterr()
        return status, out.out, out.err

    return plan


@pytest.mark.parametrize(
    ("setting", "words"),
    [
        ("observation.frequency.channels=1000000000", ("channels = 1000000000", "at most 1e+06")),
        ("observation.frequency.channels=1e20", ("channels = 1e+20", "whole number")),
        (
            'observation.interval="1e-6 s"',
            ("duration = 2400 s by interval = 1e-06 s", "2.4e+09 integrations", "lengthen"),
        ),
        ('observation.duration="1e15 yr"', ("duration = ", "integrations")),
        ("sky.count=1000000000", ("sky of 1000000000 sources", "1 TB", "count")),
        ('sky={kind="grid",shape=[30000,30000],spacing="1 arcsec"}', ("sky of 900000000 sources", "shape")),
        ('image={pixels=32768,pixel="0.1 arcsec"}', ("image.pixels = 32768", "103 GB", "lower image.pixels")),
    ],
)
def test_i6_every_size_is_priced_before_anything_is_allocated(setting, words, planned, monkeypatch):
    from instrument import memory

    monkeypatch.setattr(memory, "machine_memory", lambda: 64e9)
    status, _, said = planned(setting)
    assert status == 2 and said.count("\n") == 1
    for word in words:
        assert word in said


def test_i6_the_price_is_that_of_the_machine(monkeypatch):
    from instrument import memory

    monkeypatch.setattr(memory, "machine_memory", lambda: 1e9)
    memory.afford(0.7e9, "this", "lower it")
    with pytest.raises(RefusedError, match="this would take 800 MB of memory, and 750 MB may be taken: lower it"):
        memory.afford(0.8e9, "this", "lower it")
    with pytest.raises(RefusedError):
        memory.afford(float("nan"), "this", "lower it")


@pytest.mark.parametrize(
    ("settings", "words"),
    [
        (["calibrate={kind='selfcal',bogus=1}"], ("[calibrate]", "bogus")),
        (["calibrate={kind='many-directions',clusters=-1}"], ("[calibrate]", "clusters = -1")),
        (["calibrate={kind='many-directions',interval='-5 s'}"], ("[calibrate]", "interval")),
        (["calibrate={kind='many-directions',period='-5 s'}"], ("[calibrate]", "period")),
        (["calibrate={kind='selfcal',interval='-5 s'}"], ("[calibrate]", "interval")),
        (["calibrate={kind='incomplete-model',models=[-1]}"], ("[calibrate]", "models")),
        (["instrument.reference_frequency='-1 MHz'"], ("[instrument]", "reference_frequency")),
        (["instrument.phase='everybem'"], ("[instrument]", "phase = 'everybem'", "did you mean 'everybeam'?")),
        (["instrument.phase=1"], ("[instrument]", "phase = 1", "'fringe', 'everybeam'")),
        (["sky.count=true"], ("[sky]", "count = True")),
        (["sky.count=2.5"], ("[sky]", "count = 2.5")),
        (["sky.seed=-1"], ("[sky]", "seed = -1")),
        (["observation.frequency.width='0 Hz'"], ("width",)),
        (["observation.frequency.centre='-1 MHz'"], ("centre",)),
        (["tolerance=2.0"], ("tolerance = 2.0",)),
        (["--tolerance", "2"], ("tolerance = 2",)),
        (["--tolerance", "nan"], ("tolerance = nan",)),
        (["instrument.stations=[]"], ("stations = []", "59")),
        (["instrument.stations=['CS001LBA','CS002LBA']"], ("CS001LBA", "LofarHBA")),
        (["instrument.stations=[1,2]"], ("stations = [1, 2]",)),
        (["instrument.gain={rms=1e200}"], ("rms",)),
        (["instrument.gain={rms=nan}"], ("rms",)),
        (["seed=true"], ("seed = True",)),
        (["seed=2.5"], ("seed = 2.5",)),
        (["analyze={every=0}"], ("every = 0",)),
        (["analyze={uv_range=[5,1]}"], ("uv_range",)),
        (["name='a\nb'"], ("name",)),
        (["name='" + "n" * 300 + "'"], ("name",)),
        (["--memory", "[1,2] GB"], ("memory",)),
        (["--memory", "nan GB"], ("memory",)),
        (["--memory", "-1 GB"], ("memory",)),
    ],
)
def test_i9_g9_what_cannot_be_is_refused_by_the_plan(settings, words, planned):
    status, _, said = planned(*settings)
    assert status == 2, said
    assert said.count("\n") == 1 and "unexpected" not in said
    for word in words:
        assert word in said, said


@pytest.mark.parametrize(
    ("settings", "line"),
    [
        (["instrument.beam='none'", "correct={}"], "scene: not used: [correct] (the instrument has no beam"),
        (
            ["calibrate={kind='many-directions',clusters=2}", "correct={}", "analyze={products=[]}"],
            "scene: not used: [image], [correct], [analyze] (a laboratory",
        ),
        (
            ["calibrate={kind='incomplete-model',models=[1]}", "analyze={products=[]}"],
            "scene: not used: [analyze] (a lab",
        ),
        (["analyze={products=['spectrum-2d'],every=3,uv_range=[1,2]}"], "[analyze]: not used: uv_range, every (they"),
        (["image.robust=1"], "[image]: not used: robust (it is of weighting = 'briggs'"),
    ],
)
def test_what_was_not_used_is_named(settings, line, planned):
    status, _, said = planned(*settings)
    assert status == 0
    assert f"instrument: warning: {line}" in said


def test_g9_a_negative_flux_of_a_grid_is_said(planned):
    status, _, said = planned("sky={kind='grid',shape=[3,3],flux='-1 Jy'}")
    assert status == 0 and "flux = -1 Jy" in said and said.count("\n") == 1


def test_what_is_used_is_not_named(planned):
    assert planned("correct={}")[::2] == (0, "")
    assert planned("image.weighting='briggs'", "image.robust=1")[::2] == (0, "")


@pytest.mark.parametrize(
    "setting",
    ["instrument.component='this:X'", "observation.component='this:X'", "noise.component='this:X'",
     "instrument.element={component='this:X'}", "instrument.element={kind='this:X'}", "component='this:X'",
     "image.kind='this:X'", "sky.kind='this:X'", "analyze.cube={component='this:X'}", "analyze.kind='os:path'"],
)  # fmt: skip
def test_i2_no_setting_imports_a_module(setting, planned, tmp_path, monkeypatch):
    (tmp_path / "this.py").write_text("open('ran', 'w')\nclass X: pass\n")
    monkeypatch.syspath_prepend(tmp_path)
    status, _, said = planned(setting)
    assert status == 2 and said.count("\n") == 1
    assert not (tmp_path / "ran").exists()


def test_g2_one_door_for_what_has_settings(planned):
    assert planned("instrument.element={kind='dipole',height='0.5 m'}")[0] == 0
    status, _, said = planned("instrument.element='dipole'")
    assert status == 2 and "height" in said and "{ kind" in said


def test_unused_what_was_not_used_stands_in_run_json(tmp_path, monkeypatch, capsys):
    import json

    monkeypatch.chdir(tmp_path)
    (tmp_path / "s.toml").write_text(TINY.partition("[noise]")[0])
    words = ["--no-verify", "--out", "o", "--set", "instrument.beam='none'", "--set", "correct={}"]
    assert main(["run", "s.toml", *words]) == 0
    assert json.loads((tmp_path / "o" / "run.json").read_text())["unused"] == {"scene": ["[correct]"]}


def test_g9_stations_in_the_same_place_are_said():
    import numpy as np
    from astropy import units as u
    from astropy.coordinates import SkyCoord

    import instrument as ins
    from instrument.errors import InstrumentWarning

    enu = np.array([[0, 0, 0], [50, 0, 0], [0, 0, 0.0]]) * u.m
    layout = ins.Layout.from_enu(["a", "b", "c"], enu, 6 * u.deg, 50 * u.deg, 0 * u.m)
    scene = ins.Scene(
        instrument=ins.Composed(stations=layout),
        sky=ins.PointSky.at(SkyCoord("08h13m36.0s +48d13m03s"), [1.0]),
        observation=ins.Observation(
            phase_centre="08h13m36.0s +48d13m03s", transit="2012-12-07", duration=10 * u.s, interval=10 * u.s,
            frequencies=[150] * u.MHz,
        ),
    )  # fmt: skip
    with pytest.warns(InstrumentWarning, match="stations a and c stand in the same place"):
        scene.plan()
