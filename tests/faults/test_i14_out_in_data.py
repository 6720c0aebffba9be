"""A run folder never lies in data, nor takes the place of a folder that holds what the run reads or writes."""

import shutil

import pytest
from astropy import units as u

import instrument
from instrument import MeasurementSet
from instrument.cli import main
from instrument.errors import FileError, InputError
from instrument.files.formats import demand_free
from instrument.pipeline.folder import RunFolder
from instrument.units import Direction

SCENE = """name = "night"
[instrument]
telescope = "lofar-hba"
stations = ["CS001HBA0", "CS002HBA1", "CS003HBA0"]
beam = "none"
[sky]
kind = "grid"
shape = [1, 2]
spacing = "1 deg"
flux = "5 Jy"
"""
OBSERVATION = """[observation]
phase_centre = "08h13m36.0s +48d13m03s"
transit = "2012-12-07"
duration = "20 s"
interval = "10 s"
frequency = { centre = "150 MHz", channel_width = "0.2 MHz", channels = 1 }
"""
RUN = '{"versions": {}}'  # the record by which a folder is known as that of a run


@pytest.fixture
def here(tmp_path, monkeypatch):
    (tmp_path / "s.toml").write_text(SCENE)
    monkeypatch.chdir(tmp_path)
    return tmp_path


def tree(path):
    return {str(p): p.stat().st_mtime_ns for p in path.rglob("*") if p.name != "table.lock"}


def refused(capsys, words, line):
    assert main(words) == 2
    said = capsys.readouterr().err.strip().splitlines()
    assert len(said) == 1 and line in said[0]


@pytest.mark.parametrize("out", ["a.MS/run", "a.MS/deep/er/run", "link/run", "a.MS/HISTORY/run"])
@pytest.mark.parametrize("verb", ["predict", "subtract"])
def test_out_in_the_set_that_is_read_is_refused_and_the_set_stays(small_set, here, capsys, verb, out):
    shutil.copytree(small_set, here / "a.MS")
    (here / "link").symlink_to("a.MS")
    before = tree(here)
    what = "HISTORY" if "HISTORY" in out else "a.MS"
    words = [verb, "s.toml", "--data", "a.MS", "--out", out]
    refused(capsys, words, f"--out {out}: it lies in {what}, a Measurement Set; choose another")
    assert tree(here) == before


def test_the_usual_folder_is_refused_where_the_set_is_the_place_one_works_in(small_set, here, capsys, monkeypatch):
    shutil.copytree(small_set, here / "a.MS")
    monkeypatch.chdir(here / "a.MS")
    refused(capsys, ["predict", "../s.toml", "--data", "."], "it lies in a.MS, a Measurement Set; choose another")
    assert not (here / "a.MS" / "runs").exists()


@pytest.mark.parametrize(("mark", "what"), [("zarr.json", "data in Zarr"), (".zgroup", "data in Zarr")])
def test_out_in_any_folder_of_data_is_refused_by_every_verb(here, mark, what):
    (here / "v.zarr" / "set").mkdir(parents=True)
    (here / "v.zarr" / mark).write_text("{}")
    for out in ("v.zarr/run", "v.zarr/set/run"):
        with pytest.raises(InputError, match=rf"--out {out}: it lies in v.zarr, {what}; choose another"):
            RunFolder("scene", out)
    assert RunFolder("scene", "v.zarr.run").path.name == "v.zarr.run"  # beside it


def test_out_in_the_set_that_is_written_is_refused_before_the_work(here, capsys):
    pytest.importorskip("arcae")
    (here / "s.toml").write_text(SCENE + OBSERVATION + '[into]\nset = "new.MS"\n')
    for out in ("new.MS", "new.MS/run"):
        refused(capsys, ["run", "s.toml", "--out", out], f"--out {out}: it lies in new.MS, which is written")
    assert not (here / "new.MS").exists()


def test_a_new_set_within_another_is_refused(small_set, here, capsys):
    shutil.copytree(small_set, here / "a.MS")
    before = tree(here)
    words = ["predict", "s.toml", "--data", "a.MS", "--out", "run", "--into", "a.MS/b.MS"]
    refused(capsys, words, "a.MS/b.MS: it lies in a.MS, a Measurement Set: choose another place")
    assert tree(here) == before


def test_force_removes_no_folder_that_holds_what_is_read_or_written(small_set, here, capsys):
    (here / "old").mkdir()
    (here / "old" / "run.json").write_text(RUN)
    shutil.copytree(small_set, here / "old" / "a.MS")
    (here / "old" / "sky.csv").write_text("ra_deg,dec_deg,i_jy\n123.4,48.2,1\n")
    before = tree(here)
    force = ["--out", "old", "--force"]
    refused(capsys, ["predict", "s.toml", "--data", "old/a.MS", *force], "what is read lies in it (old/a.MS); choose")
    (here / "c.toml").write_text(
        SCENE[: SCENE.index("[sky]")] + OBSERVATION + '[sky]\nkind = "catalogue"\npath = "x"\n'
    )
    words = ["run", "c.toml", "--set", 'sky.path="old/sky.csv"', *force]
    refused(capsys, words, "what is read lies in it (old/sky.csv)")
    (here / "n.toml").write_text(SCENE + OBSERVATION + '[into]\nset = "old/new.MS"\n')
    refused(capsys, ["run", "n.toml", *force], "what is read lies in it (old/new.MS)")
    assert tree(here / "old") == {k: v for k, v in before.items() if k.startswith(f"{here}/old/")}
    (here / "s.toml").write_text(SCENE + OBSERVATION)
    assert main(["run", "s.toml", "--no-verify", *force]) == 0  # nothing of this scene lies there
    assert not (here / "old" / "sky.csv").exists()


@pytest.mark.parametrize("name", ["a.MS/sky.skymodel", "a.MS/HISTORY/deep.ecsv", "link/sky.csv"])
def test_no_writer_of_files_writes_into_a_folder_of_data(small_set, here, name):
    """Not even a sky or a table by Python: a copy of the set would hold it, and its next whole write remove it."""
    shutil.copytree(small_set, here / "a.MS")
    (here / "link").symlink_to("a.MS")
    sky = instrument.load("skies", "grid", shape=(1, 2), spacing=1 * u.deg, flux=5 * u.Jy).about(Direction(2.15, 0.84))
    before = tree(here)
    with pytest.raises(InputError, match=r"it lies in (a.MS|HISTORY), a Measurement Set: choose another place"):
        sky.write(here / name)
    assert tree(here) == before


def test_what_only_looks_like_data_and_sets_within_sets_are_written(small_set, here):
    """A text called table.dat is no set; a set within a set (a multi-MS has such) gets its columns."""
    sky = instrument.load("skies", "grid", shape=(1, 2), spacing=1 * u.deg, flux=5 * u.Jy).about(Direction(2.15, 0.84))
    (here / "mine").mkdir()
    (here / "mine" / "table.dat").write_text("1 2 3")
    sky.write(here / "mine" / "sky.csv")
    shutil.copytree(small_set, here / "m.mms")
    shutil.copytree(small_set, here / "m.mms" / "SUBMSS" / "m.0000.ms")
    inner = MeasurementSet(here / "m.mms" / "SUBMSS" / "m.0000.ms")
    inner.write("MODEL_DATA", inner.blocks())
    assert len(list(MeasurementSet(inner.path, "MODEL_DATA").blocks())) == 1


def test_links_are_where_they_stand(small_set, here):
    sky = instrument.load("skies", "grid", shape=(1, 2), spacing=1 * u.deg, flux=5 * u.Jy).about(Direction(2.15, 0.84))
    shutil.copytree(small_set, here / "a.MS")
    (here / "a.MS" / "in.csv").symlink_to(here / "real.csv")
    with pytest.raises(InputError, match=r"it lies in a\.MS"):
        sky.write(here / "a.MS" / "in.csv", overwrite=True)
    (here / "out.csv").symlink_to(here / "a.MS" / "t.csv")
    sky.write(here / "out.csv", overwrite=True)
    assert not (here / "out.csv").is_symlink() and not (here / "a.MS" / "t.csv").exists()
    for loop, other in (("p", "q"), ("q", "p")):
        (here / loop).symlink_to(here / other)
    with pytest.raises(FileError):
        sky.write(here / "p" / "x.csv")
    with pytest.raises(FileError):
        sky.write(here / ("x" * 300) / "y.csv")
    for name in ("a\0.csv", "a\0.zarr"):
        with pytest.raises(InputError, match="no null byte"):
            demand_free(str(here / name), True) if name.endswith("zarr") else sky.write(here / name)
