"""`instrument compare`: two run folders, what changed; wrong folders are one line."""

import json
import re

import numpy as np
import pytest
from astropy import units as u
from astropy.io import fits
from astropy.table import Table

import instrument as ins
from instrument.cli import main
from instrument.pipeline.compare import Change, compare, percent

RECORD = {
    "name": "night",
    "title": "A night",
    "finished": "2026-11-26T03:00:00+00:00",
    "seed": 1,
    "scene_hash": "a" * 16,
    "versions": {"instrument": "0.1.0", "numpy": "2.0.0"},
    "machine": {"system": "x"},
    "scene": {"name": "night", "sky": {"count": 3, "kind": "random"}, "noise": {"sefd": "20 Jy"}},
    "plan": {"text": ["plan"], "engine": "matrix", "error_bound": 1e-10},
    "checks": {
        "prediction": {"error": 1e-14, "bound": 1e-10, "passed": True},
        "calibration": {"outcome": ["converged"], "passed": True},
    },
    "stage_errors": {"image": "gridding 1e-06"},
    "seconds": {"predict": 1.5},
    "leakage": {"median": 0.5, "list": [1.0, 2.0]},
}
PIXEL = bytes.fromhex(
    "89504e470d0a1a0a0000000d4948445200000001000000010802000000907753de0000000c4944415408d763f8cfc000000301010018dd8db0"
    "0000000049454e44ae426082"
)


def spectrum(scale):
    k = np.array([0.1, 0.2, 0.4])
    return Table(
        {"k": k / u.Mpc, "power": scale * np.array([100.0, 10.0, 1.0]) * u.K**2 * u.Mpc**3, "count": [4, 8, 16]}
    )


@pytest.fixture
def runs(tmp_path, monkeypatch):
    """Two run folders as `run` writes them, small."""
    monkeypatch.chdir(tmp_path)
    for name, more in (("a", {}), ("b", {"seed": 2})):
        folder = tmp_path / name
        folder.mkdir()
        (folder / "run.json").write_text(json.dumps(RECORD | more))
        spectrum(1.0 if name == "a" else 1.1).write(folder / "spectrum_spherical_I.ecsv", format="ascii.ecsv")
        rows = ["s1", "s2", "s3"] if name == "a" else ["s3", "s1", "s4"]
        flux = {"s1": 1.0, "s2": 2.0, "s3": 3.0, "s4": 4.0}
        values = [flux[row] + (0.3 if name == "b" and row == "s3" else 0) for row in rows]
        Table({"name": rows, "I": values * u.Jy, "measured": [True] * 3}).write(
            folder / "leakage.ecsv", format="ascii.ecsv"
        )
        cube = ins.StokesCube(
            np.full((2, 4, 8, 8), 2.0) + np.eye(8), [150, 151] * u.MHz, 1 * u.arcmin, "K", constants="data"
        )
        data = np.array(cube.data)
        data[1, 3, 0, 0] += 0.6 if name == "b" else 0
        cube.with_data(data).write(folder / "cube.fits")
        (folder / "images.png").write_bytes(PIXEL)
    return tmp_path


def change(folder, **more):
    path = folder / "run.json"
    path.write_text(json.dumps(json.loads(path.read_text()) | more))


def test_what_changed_in_the_record_is_told_by_key(runs):
    scene = {"name": "night", "sky": {"count": 4, "kind": "random"}, "image": {"pixels": 16}}
    checks = {
        "prediction": {"error": 1e-14, "bound": 1e-10, "passed": True},
        "calibration": {"outcome": ["poor fit"], "passed": False},
    }
    change(
        runs / "b",
        scene=scene,
        checks=checks,
        versions={"instrument": "0.2.0", "numpy": "2.0.0"},
        stage_errors={"image": "gridding 1e-05"},
        seconds={"predict": 3.0},
        leakage={"median": 0.25, "list": [1.0, 2.0]},
    )
    found = compare("a", "b")
    assert found.scene == [
        Change("sky.count", 3, 4),
        Change("noise.sefd", "20 Jy", None),
        Change("image.pixels", None, 16),
    ]
    assert found.versions == [Change("instrument", "0.1.0", "0.2.0")]
    assert found.checks == [Change("calibration", "held (converged)", "fell short (poor fit)")]
    assert found.errors == [Change("image", "gridding 1e-06", "gridding 1e-05")]
    assert found.numbers == [Change("leakage.median", 0.5, 0.25)]
    assert found.costs == [Change("seconds.predict", 1.5, 3.0)]


def test_tables_and_cubes_are_compared_number_by_number(runs):
    found = {(c.file, c.column): c for c in compare("a", "b").columns}
    power = found["spectrum_spherical_I.ecsv", "power"]
    rms = np.sqrt(np.mean(np.array([100.0, 10, 1]) ** 2))
    assert power.rms == pytest.approx(0.1) and power.largest == pytest.approx(10 / rms) and power.where == "0.1"
    flux = found["leakage.ecsv", "I"]  # rows go by their names: s1 and s3 are in both
    assert flux.rows == 2 and flux.where == "s3" and flux.largest == pytest.approx(0.3 / np.sqrt((1 + 9) / 2))
    cube = found["cube.fits", "images"]
    values = np.full((8, 8), 2.0) + np.eye(8)
    assert cube.where == "plane 1.3" and cube.largest == pytest.approx(0.6 / np.sqrt((values**2).mean()), rel=1e-6)
    assert set(found) == {("spectrum_spherical_I.ecsv", "power"), ("leakage.ecsv", "I"), ("cube.fits", "images")}


def test_every_image_of_a_file_is_compared(runs):
    for name, value in (("a", 1.0), ("b", 1.5)):
        depth = fits.ImageHDU(np.full((3, 3), value), name="DEPTH")
        fits.HDUList([fits.PrimaryHDU(), depth, fits.ImageHDU(np.ones((3, 3)), name="PEAK")]).writeto(
            runs / name / "p.fits"
        )
        fits.HDUList([fits.PrimaryHDU()]).writeto(runs / name / "empty.fits")
    found = compare("a", "b")
    assert [(c.column, c.rms) for c in found.columns if c.file == "p.fits"] == [("depth", 0.5)]
    assert "empty.fits: there is no image in it" in found.apart


def test_a_run_is_the_same_as_itself(runs, capsys):
    assert main(["compare", "a", "a"]) == 0
    text = capsys.readouterr().out
    for name in ("scene", "versions", "checks", "errors", "numbers", "costs"):
        assert re.search(rf"^{name} +the same$", text, re.MULTILINE), text
    assert "the same to the last bit: cube.fits, leakage.ecsv, spectrum_spherical_I.ecsv" in text


def test_what_cannot_be_compared_is_named_and_the_rest_goes_on(runs):
    (runs / "b" / "leakage.ecsv").write_text("# %ECSV 1.0\n# ---\nno table")
    (runs / "a" / "alone.ecsv").write_bytes((runs / "a" / "spectrum_spherical_I.ecsv").read_bytes())
    (runs / "b" / "cube.fits").write_bytes(b"SIMPLE")
    found = compare("a", "b")
    assert [text.partition(":")[0] for text in found.apart] == ["alone.ecsv", "cube.fits", "leakage.ecsv"]
    assert "not in b" in found.apart[0] and all("\n" not in text for text in found.apart)
    assert [c.file for c in found.columns] == ["spectrum_spherical_I.ecsv"]


def test_the_page_has_both_sides_and_nothing_is_overwritten(runs, capsys):
    assert main(["compare", "a", "b", "--out", "c"]) == 0
    page = (runs / "c" / "compare.html").read_text()
    assert page.count("data:image/png;base64,") == 3  # the spectra on common axes, and the images of both
    for text in ("images: a", "images: b", "spectrum spherical I", "leakage.ecsv", "plane 1.3"):
        assert text in page, text
    record = json.loads((runs / "c" / "compare.json").read_text())
    assert record["runs"] == ["a", "b"] and record["columns"]
    capsys.readouterr()
    assert main(["compare", "a", "b", "--out", "c"]) == 2
    assert "there is a run in it; choose another, or replace it with --force" in capsys.readouterr().err
    assert main(["compare", "a", "b", "--out", "c", "--force"]) == 0
    assert sorted(p.name for p in runs.iterdir()) == ["a", "b", "c"]


@pytest.mark.parametrize(
    ("folder", "text"),
    [
        ("none", "'none' is no folder"),
        ("empty", "no run folder: there is no run.json in it"),
        ("a/run.json", "is no folder: give the folder of a run"),
        ("text", "run.json is no JSON"),
        ("list", "is not that of a run: it names no versions"),
        ("deep", "run.json is no JSON"),
        ("folder", "is a folder"),
        ("x\0y", "null byte|is no folder"),
        ("x" * 300, "File name too long|is no folder"),
    ],
)
def test_wrong_folders_are_one_line_and_status_2(runs, capsys, folder, text):
    (runs / "empty").mkdir()
    (runs / "folder" / "run.json").mkdir(parents=True)
    for name, content in (("text", "{"), ("list", "[]"), ("deep", "[" * 100_000)):
        (runs / name).mkdir()
        (runs / name / "run.json").write_text(content)
    for words in (("a", folder), (folder, "a")):
        assert main(["compare", *words, "--out", "o"]) == 2
        said = capsys.readouterr().err
        assert said.count("\n") == 1 and re.search(text, said) and "unexpected" not in said, said
    assert not (runs / "o").exists()


def test_records_that_anyone_may_have_written_do_no_harm(runs, capsys):
    odd = {
        "scene": {"\x1b[31m": {"a": [{"b": 1}] * 3}},
        "checks": {"x": 3, "prediction": {"error": "?", "bound": None}},
        "seconds": [1, 2],
        "plan": "no",
        "name": ["n"],
        "leakage": {"nan": None},
        "finished": 7,
    }
    change(runs / "b", **odd)
    assert main(["compare", "a", "b", "--out", "c"]) == 0
    said = capsys.readouterr()
    assert "\x1b" not in said.out and said.err == ""


def test_shares_are_said_as_a_person_says_them():
    assert [percent(x) for x in (0.123, np.nan, np.inf)] == ["12 %", "other words", "no number in one of them"]


@pytest.mark.parametrize("out", ["a", "b"])
def test_a_run_that_is_compared_is_not_replaced_by_what_is_said_of_it(runs, capsys, out):
    assert main(["compare", "a", "b", "--out", out, "--force"]) == 2
    assert f"--out {out}: what is read lies in it ({out}/run.json); choose another" in capsys.readouterr().err
    assert (runs / out / "run.json").is_file() and not (runs / out / "compare.json").exists()
