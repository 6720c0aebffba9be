"""Wrong input gives one line that names the thing, the value and the remedy; exit status 2; nothing is written."""

import pytest

from instrument.cli import main

TINY = """
name = "tiny"
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
kind = "grid"
shape = [3, 3]
spacing = "1 deg"
flux = "1 Jy"
[correct]
beam = "centre"
[analyze]
products = ["leakage"]
"""


@pytest.fixture
def tiny(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "tiny.toml").write_text(TINY)
    return tmp_path


def refused(capsys, *words):
    """Run the command; its one line of complaint."""
    status = main(list(words))
    out = capsys.readouterr()
    assert status == 2
    assert "Traceback" not in out.err
    lines = out.err.strip().splitlines()
    assert len(lines) == 1
    assert lines[0].startswith("instrument: ")
    return lines[0]


CASES = {
    "observation.interval=10": ("interval", "unit", "bare 10"),
    "observation.interval='10 m'": ("interval", "10.0 m"),
    "observation.intervall='10 s'": ("intervall", "did you mean 'interval'"),
    "observation.interval='-10 s'": ("interval = -10 s", "positive"),
    "observation.duration='1 s'": ("duration = 1 s", "interval"),
    "observation.transit='yesterday'": ("yesterday", "2012-12-07"),
    "observation.start='2012-12-07T00:00:00'": ("start", "transit", "not both"),
    "observation.phase_centre='nowhere'": ("nowhere", "08h13m36.0s"),
    "observation.phase_centre='08h13m36.0s -88d13m03s'": ("never rises", "elevation"),
    "observation.frequency.channels=0": ("channels = 0",),
    "observation.frequency.centre='-150 MHz'": ("centre", "above 0 Hz"),
    "instrument.telescope='lofar'": ("lofar", "lofar-hba"),
    "instrument.stations=['CS001HBA0','CS001HBA9']": ("CS001HBA9", "did you mean 'CS001HBA"),
    "instrument.stations=['CS001HBA0']": ("at least two stations", "CS001HBA0"),
    "instrument.stations=['CS001HBA0','CS001HBA0']": ("CS001HBA0", "twice"),
    "instrument.elemnt='hamaker'": ("elemnt", "did you mean 'element'"),
    "instrument.element='hamakr'": ("hamakr", "did you mean 'hamaker'"),
    "instrument.gain.rms=-1": ("instrument.gain", "rms = -1"),
    "sky.kind='gird'": ("gird", "did you mean 'grid'"),
    "sky.spacng='1 deg'": ("spacng", "did you mean 'spacing'"),
    "sky.flux='1 m'": ("flux", "Jy"),
    "sky.flux='nan Jy'": ("flux", "finite"),
    "sky.shape=[0,0]": ("shape",),
    "analyze.products=['leak']": ("products", "leakage"),
    "imge.pixels=64": ("imge", "did you mean 'image'"),
    "image={pixels=63,pixel='1 arcmin'}": ("pixels = 63", "even"),
    "image={pixels=64,pixel='0 arcmin'}": ("pixel",),
    "image={pixels=64,pixel='1 arcmin',uv_range=[800,30]}": ("uv_range",),
    "noise.sefd='-3 Jy'": ("sefd",),
    "tolerance=-1": ("tolerance = -1",),
    "engine='gpu'": ("gpu", "direct, gridded, matrix"),
    "name='../up'": ("name",),
}


@pytest.mark.parametrize("setting", list(CASES))
def test_a_wrong_setting_is_one_clear_line(setting, tiny, capsys):
    line = refused(capsys, "run", "tiny.toml", "--set", setting)
    for word in CASES[setting]:
        assert word in line
    assert [p.name for p in tiny.iterdir()] == ["tiny.toml"]


def test_wrong_words_on_the_command_line_are_one_clear_line(tiny, capsys):
    assert "did you mean 'plan'" in refused(capsys, "plna", "tiny.toml")
    assert "mock-grid" in refused(capsys, "plan", "mock-gird")
    assert "other.toml" in refused(capsys, "plan", "other.toml")
    assert "--set" in refused(capsys, "plan", "tiny.toml", "--set", "novalue")
    assert "memory" in refused(capsys, "plan", "tiny.toml", "--memory", "3")
    assert "give more memory (--memory)" in refused(capsys, "plan", "tiny.toml", "--memory", "1 kB")
    assert "--workers" in refused(capsys, "plan", "tiny.toml", "--workers", "0")


def test_a_broken_scene_file_names_file_and_line(tiny, capsys):
    (tiny / "broken.toml").write_text('name = "x"\n[sky\nkind = 1\n')
    line = refused(capsys, "run", "broken.toml")
    assert "broken.toml" in line
    assert "line 2" in line
    (tiny / "empty.toml").write_text('name = "x"\n')
    assert "a scene needs a table [instrument]" in refused(capsys, "run", "empty.toml")


def test_a_folder_that_is_not_empty_is_left_alone(tiny, capsys):
    (tiny / "full").mkdir()
    (tiny / "full" / "mine.txt").write_text("keep")
    assert "not an empty folder" in refused(capsys, "run", "tiny.toml", "--out", "full")
    assert [p.name for p in (tiny / "full").iterdir()] == ["mine.txt"]


def test_a_frequency_outside_the_band_warns_and_says_it_extrapolates(tiny, capsys):
    assert main(["plan", "tiny.toml", "--set", "observation.frequency.centre='250 MHz'"]) == 0
    err = capsys.readouterr().err
    assert "120 to 240 MHz" in err
    assert "extrapolates at 250 MHz" in err


def test_a_broken_catalogue_names_file_line_and_field(tiny, capsys):
    (tiny / "sky.txt").write_text(
        "FORMAT = Name, Type, Ra, Dec, I\na, POINT, 08:13:36, +48.13.03, 1\nb, POINT, 08:13:36, +48:13:03, 1\n"
    )
    line = refused(capsys, "run", "tiny.toml", "--set", "sky={kind='catalogue',path='sky.txt'}")
    for word in ("sky.txt", "3", "Dec"):
        assert word in line
    (tiny / "nan.csv").write_text("ra_deg,dec_deg,i_jy\n123.4,48.2,1\n123.5,48.2,nan\n")
    line = refused(capsys, "run", "tiny.toml", "--set", "sky={kind='catalogue',path='nan.csv'}")
    assert "nan.csv" in line
    (tiny / "none.csv").write_text("ra_deg,dec_deg,i_jy\n")
    assert "none.csv" in refused(capsys, "run", "tiny.toml", "--set", "sky={kind='catalogue',path='none.csv'}")
    assert "gone.csv" in refused(capsys, "run", "tiny.toml", "--set", "sky={kind='catalogue',path='gone.csv'}")
