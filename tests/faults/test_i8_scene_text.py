"""Scene files that are no scene files, and settings that no setting takes: one line that names the file and the key."""

import tomllib

import pytest

from instrument.cli import main
from instrument.errors import InputError
from instrument.pipeline.scene_text import override, read_tables, to_toml

TINY = """name = "tiny"
title = "caf\xe9"
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
"""


def refused(content, tmp_path):
    """What is said of a scene file of this content."""
    path = tmp_path / "s.toml"
    path.write_bytes(content if isinstance(content, bytes) else content.encode())
    with pytest.raises(InputError) as error:
        read_tables(path)
    said = str(error.value)
    assert "s.toml" in said or "nested" in said or "integer" in said or "control" in said, said
    return said


@pytest.mark.parametrize(
    ("content", "word"),
    [
        (TINY.encode("utf-16"), "UTF-16"),
        (TINY.encode("utf-32"), "UTF-16 or UTF-32"),
        (TINY.encode("latin-1"), "line 2: byte 0xe9 is not UTF-8"),
        (b"\x89PNG\r\n\x1a\n" + b"\0" * 99, "PNG image"),
        (b"SIMPLE  =                    T" + b" " * 99, "FITS file"),
        (b"\x1f\x8b\x08" + b"\0" * 99, "gzip"),
        (TINY.replace('flux = "1 Jy"', 'flux = "1 Jy"\nflux = "2 Jy"'), "line 17, column 14): flux"),
        ('name = "x"\n[sky\nkind = 1\n', "line 2"),
        ("a = " + "[" * 1200 + "]" * 1200, "nested deeper than 12 levels"),
        ("a = " + "[" * 30 + "]" * 30, "a: values are nested deeper than 12 levels"),
        ("a." + ".".join("b" * 2000) + " = 1", "nested deeper"),
        ("x = " + "9" * 5000, "digits"),
        ("x = " + "9" * 500, "x is an integer of more than 64 bits"),
        ('[sky]\nkind = "\\u0000"', r"sky.kind holds the control character \x00"),
        ('title = "\\u001b[31m"', r"title holds the control character \x1b"),
        ("x = 2012-02-30", "line 1"),
    ],
)
def test_i8_g9_what_is_no_scene_file_is_one_line(content, word, tmp_path):
    said = refused(content, tmp_path)
    assert word in said and "\n" not in said and said.isprintable()


def test_g9_a_mark_of_the_byte_order_before_utf8_is_no_fault(tmp_path):
    (tmp_path / "s.toml").write_bytes(b"\xef\xbb\xbf" + TINY.encode())
    assert read_tables(tmp_path / "s.toml")["title"] == "caf\xe9"


def test_i11_the_contents_of_a_file_that_is_no_scene_are_not_quoted(tmp_path):
    secret = "root:$6$saltsalt$verysecrethash:19000:0:99999:7:::\n"
    for name in ("shadow", "s.toml"):
        (tmp_path / name).write_text(secret)
        with pytest.raises(InputError) as error:
            read_tables(tmp_path / name)
        assert "saltsalt" not in str(error.value) and "19000" not in str(error.value)


@pytest.mark.parametrize("make", ["folder", "pipe", "zeros", "sparse"])
def test_i5_a_scene_is_a_regular_file_of_a_size(make, tmp_path):
    import os

    path = tmp_path / "s.toml"
    if make == "folder":
        path.mkdir()
    elif make == "pipe":
        os.mkfifo(path)
    elif make == "zeros":
        path.symlink_to("/dev/zero")
    else:
        with path.open("wb") as file:
            file.truncate(20 * 10**9)
    with pytest.raises(InputError) as error:
        read_tables(path)
    assert "s.toml" in str(error.value)


@pytest.mark.parametrize("name", ["x" * 5000, "a\0b", "", "\udcff", "no-such-scene"])
def test_i8_names_of_scenes_that_are_none(name):
    with pytest.raises(InputError):
        read_tables(name)


@pytest.mark.parametrize(
    ("setting", "word"),
    [
        ("seed=" + "9" * 5000, "not a value"),
        ("seed=" + "9" * 400, "64 bits"),
        ("x=" + "[" * 3000 + "]" * 3000, "not a value"),
        ("sky.count=3\nx=5", "one value"),
        ("title=\udcff", r"control character \udcff"),
        ("title=a\x7fb", r"control character \x7f"),
        (".".join("a" * 2000) + "=1", "nested deeper"),
        ("sky..count=1", "write it like"),
    ],
)
def test_i8_settings_that_no_setting_takes(setting, word):
    with pytest.raises(InputError) as error:
        override({"name": "x"}, [setting])
    assert word in str(error.value) and len(str(error.value)) < 300


def test_i8_what_is_written_can_be_read_back():
    tables = {
        "title": 'quotes " and \\ and \x7f and \t and é and 日本',
        "seed": 3,
        "tolerance": float("inf"),
        "odd key": {"an other": [1, 2.5, True, {"deep er": "x"}], "": "empty"},
    }
    assert tomllib.loads(to_toml(tables)) == tables


def test_i8_settings_that_clash_with_python_names_are_unknown_keys(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "s.toml").write_text(TINY)
    for key in ("sky.name", "sky.self", "self", "instrument.name", "instrument.kind", "instrument.self", "image.self"):
        assert main(["plan", "s.toml", "--set", f"{key}='x'"]) == 2
        said = capsys.readouterr().err
        assert said.count("\n") == 1 and "unexpected" not in said, said
