"""The folder of a run: tried before the work, whole or not there, never over another; leftovers of dead runs go."""

import os
import subprocess
import sys

import pytest

from instrument.errors import InputError, InstrumentWarning
from instrument.partial_folders import PARTIAL, leftovers
from instrument.pipeline import folder as run_folder
from instrument.pipeline.folder import RunFolder


@pytest.fixture(autouse=True)
def here(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    return tmp_path


def written(name="scene", out=None, text="result"):
    """Write a folder as a run does; where it went."""
    with RunFolder(name, out) as folder:
        (folder.partial / "run.json").write_text(text)
        return folder.finish()


def names(folder):
    return sorted(p.name for p in folder.iterdir())


@pytest.mark.parametrize(
    ("out", "why"),
    [
        ("x" * 300, "File name too long"),
        ("a\0b", "null byte"),
        ("file/x", "File exists|Not a directory"),
        ("file", "not an empty folder"),
        ("/proc", "mount point|not an empty folder"),
        ("/proc/1/x", "choose another folder"),
        ("/dev/full", "not an empty folder"),
        ("~nobody-of-this-name/x", "home"),
    ],
)
def test_i7_a_folder_that_cannot_be_is_refused_before_the_work(here, out, why):
    (here / "file").write_text("mine")
    with pytest.raises(InputError, match=why) as error, RunFolder("scene", out):
        raise AssertionError("the work began")
    assert "\n" not in str(error.value)
    assert names(here) == ["file"]


def test_i7_a_home_is_meant_as_the_shell_means_it(here, monkeypatch):
    monkeypatch.setenv("HOME", str(here / "home"))
    written(out="~/x")
    assert names(here) == ["home"] and (here / "home" / "x" / "run.json").is_file()


def test_i7_links_that_lead_to_one_another_are_refused_before_the_work(here):
    (here / "a").symlink_to("b")
    (here / "b").symlink_to("a")
    with pytest.raises(InputError, match="--out a: its links lead to one another; choose another"):
        RunFolder("tiny", "a")


@pytest.mark.parametrize("there", [True, False])
def test_i7_a_link_is_followed(here, there):
    if there:
        (here / "real").mkdir()
    (here / "link").symlink_to("real")
    written(out="link")
    assert (here / "link").is_symlink() and (here / "real" / "run.json").is_file()


def test_i7_a_mount_point_is_refused_before_the_work(here, monkeypatch):
    (here / "disk").mkdir()
    monkeypatch.setattr(run_folder.os.path, "ismount", lambda path: str(path).endswith("disk"))
    with pytest.raises(InputError, match=r"mount point.*inside it"), RunFolder("scene", "disk"):
        raise AssertionError("the work began")


def test_i7_a_parent_that_is_removed_meanwhile_is_an_error_of_the_disk_and_leaves_nothing(here):
    import shutil

    with pytest.raises(OSError), RunFolder("scene", "a/b") as folder:
        shutil.rmtree(here / "a")
        folder.finish()
    assert names(here) == []


def test_g5_three_runs_into_one_folder_lose_nothing(here):
    with RunFolder("s", "o") as one, RunFolder("s", "o") as two, RunFolder("s", "o") as three:
        for folder, text in ((one, "1"), (two, "2"), (three, "3")):
            (folder.partial / "run.json").write_text(text)
        assert one.finish().name == "o"
        with pytest.warns(InstrumentWarning, match="o was taken meanwhile: the results are in o-2"):
            two.finish()
        with pytest.warns(InstrumentWarning, match="the results are in o-3"):
            three.finish()
    assert names(here) == ["o", "o-2", "o-3"]
    assert [(here / n / "run.json").read_text() for n in names(here)] == ["1", "2", "3"]


def test_i7_a_failed_run_leaves_nothing_not_even_folders_made_for_it(here):
    with pytest.raises(ZeroDivisionError), RunFolder("scene", "a/b/c") as folder:
        (folder.partial / "half").write_text("x")
        raise ZeroDivisionError
    assert names(here) == []


def test_g6_what_a_killed_run_left_is_removed_by_the_next_and_named(here):
    script = (
        "import os, signal\nfrom instrument.pipeline.folder import RunFolder\n"
        "with RunFolder('scene', 'o') as folder:\n"
        "    (folder.partial / 'cube.fits').write_bytes(b'0' * 1000)\n"
        "    os.kill(os.getpid(), signal.SIGKILL)\n"
    )
    subprocess.run([sys.executable, "-c", script], timeout=60)
    (left,) = names(here)
    assert left.startswith(".o.") and left.endswith(PARTIAL)
    assert [p.name for p in leftovers(here)] == [left]
    with pytest.warns(InstrumentWarning, match=r"left by a run that was killed, removed"):
        written(out="other")
    assert names(here) == ["other"]


def test_g6_the_partial_folder_of_a_run_that_lives_is_left_alone(here):
    with RunFolder("s", "one") as living:
        assert leftovers(here) == []
        written(out="two")
        assert living.partial.is_dir()
        living.finish()
    assert names(here) == ["one", "two"]


def test_g6_a_link_that_looks_like_a_leftover_is_not_followed(here):
    (here / "precious").mkdir()
    (here / f".x.{PARTIAL}").symlink_to("precious")
    written(out="o")
    assert (here / "precious").is_dir()


def test_i7_a_name_of_255_bytes_still_has_a_partial_folder(here):
    written(out="é" * 127)
    assert names(here) == ["é" * 127]
    assert os.listdir(here / ("é" * 127)) == ["run.json"]


def test_i7_the_name_of_a_hidden_file_does_not_name_the_folder_of_all_runs(here):
    assert written(name="").parts == ("runs", "run")
    assert written(name="..").parts == ("runs", "run-2")


@pytest.mark.parametrize("out", ["run", "link"])
def test_a_folder_is_not_replaced_by_what_is_made_of_its_files(here, out):
    written("run", "run", '{"versions": {}}')
    (here / "run" / "cube.fits").touch()
    (here / "link").symlink_to("run")
    with pytest.raises(InputError, match=rf"--out {out}: what is read lies in it \(run/cube.fits\); choose another"):
        RunFolder("cube", out, force=True, reads=["run/cube.fits"])
    assert RunFolder("cube", out, force=True, reads=["cube.fits"]).path
