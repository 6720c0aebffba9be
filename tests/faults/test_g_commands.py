"""G: commands, scene files, messages, as a new user tries them."""

import ast
import json
import os
import re
import subprocess
import sys
import warnings
from pathlib import Path

import h5py
import numpy as np
import pytest
from astropy import units as u
from astropy.io import fits
from astropy.table import Table

import instrument as ins
from instrument.cli import main
from instrument.errors import InputError
from instrument.pipeline.folder import RunFolder
from instrument.pipeline.observation_table import Frequency

TINY = """name = "tiny"
seed = 5
[instrument]
telescope = "lofar-hba"
stations = ["CS001HBA0", "CS002HBA0", "RS508HBA"]
[observation]
phase_centre = "08h13m36.0s +48d13m03s"
start = "2012-12-07T20:00:00"
duration = "20 min"
interval = "10 min"
frequency = { centre = "150 MHz", channel_width = "0.19 MHz", channels = 2 }
[sky]
kind = "random"
count = 3
[image]
pixels = 16
pixel = "30 arcmin"
[analyze]
products = ["leakage"]
"""


@pytest.fixture
def here(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "s.toml").write_text(TINY)
    return tmp_path


def said_by(capsys, *words):
    status = main(list(words))
    captured = capsys.readouterr()
    return status, captured.out, captured.err


# G1: channels -------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("given", [{"channel_width": "0.4 MHz"}, {"bandwidth": "32 MHz"}, {"width": "0.4 MHz"}])
def test_g1_either_width_or_both_where_they_agree(given):
    for more in ({}, {"channel_width": "400 kHz", "bandwidth": "32000 kHz"}):
        table = Frequency(centre="150 MHz", channels=80, **{**given, **more})
        assert table.values_hz()[[0, -1]] == pytest.approx([134.2e6, 165.8e6])
        assert table.width_hz == pytest.approx(0.4e6)


@pytest.mark.parametrize(
    ("settings", "words"),
    [
        (
            {"channel_width": "4 MHz", "bandwidth": "4 MHz", "channels": 20},
            ("4 MHz of each of 20", "bandwidth 200 kHz"),
        ),
        ({"channel_width": "4 MHz", "width": "1 MHz"}, ("channel_width makes 4 MHz, but width 1 MHz",)),
        ({}, ("needs 'channel_width' or 'bandwidth'",)),
        (
            {"channel_width": "4 MHz", "channels": 80},
            ("80 channels of 4 MHz about 150 MHz begin below 0: channel_width",),
        ),
        ({"bandwidth": "400 MHz", "channels": 80}, ("begin below 0: bandwidth",)),
        # the centres are above 0, the lowest edge is at -50 MHz
        ({"bandwidth": "400 MHz", "channels": 2}, ("begin below 0: bandwidth",)),
        ({"channel_width": "1e-9 Hz", "channels": 2}, ("channel_width = 1e-09 Hz is too narrow",)),
        ({"channels": 2, "channel_with": "4 MHz"}, ("did you mean 'channel_width'",)),
    ],
)
def test_g1_errors_name_the_keys_that_were_written(settings, words):
    with pytest.raises(InputError) as error:
        Frequency(centre="150 MHz", **settings)
    assert all(word in str(error.value) for word in words), str(error.value)


def test_g1_the_plan_prints_the_range_and_a_second_width_must_agree(here, capsys):
    change = ["--set", 'observation.frequency={centre="150 MHz",channel_width="4 MHz",channels=20}']
    assert "20 channels (110 to 190 MHz)" in said_by(capsys, "plan", "s.toml", *change)[1]
    assert (
        "2 channels (149.81 to 150.19 MHz)"
        in said_by(capsys, "plan", "s.toml", "--set", "observation.channel_width='190 kHz'")[1]
    )
    status, _, said = said_by(capsys, "plan", "s.toml", "--set", "observation.channel_width='1 MHz'")
    assert status == 2 and "channel_width = 1 MHz, but 'frequency' has channels of 190 kHz" in said


# G3: other programs' data -------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "words", [["run", "x.ms"], ["plan", "x.ms/"], ["analyze", "x.MS"], ["analyze", "set"], ["run", "none.ms"]]
)
def test_g3_a_measurement_set_is_named_and_what_to_do(here, capsys, words):
    for name in ("x.ms", "x.MS", "set"):
        (here / name).mkdir()
        (here / name / "table.dat").write_bytes(b"\xbe\xbe\xbe\xbe")
    status, _, said = said_by(capsys, *words)
    assert status == 2 and said.count("\n") == 1
    assert "is a Measurement Set: instrument.MeasurementSet reads it in Python" in said


# G8: leakage that is none -------------------------------------------------------------------------------------------


def test_g8_a_scalar_beam_leaks_nothing_and_nothing_is_said():
    from astropy.time import Time

    layout = ins.load("telescopes", "lofar-hba", stations=["CS001HBA0", "CS002HBA0"]).layout()
    dish = ins.load("elements", "airy", diameter=10 * u.m)
    scalar = ins.Composed(stations=layout, terms=ins.Chain(dish, ins.Parallactic()))
    cube = ins.polarized_screens(16, 15 * u.arcmin, np.array([150.0, 151]) * u.MHz)
    centre = ins.units.direction("08h13m36.0s +48d13m03s")
    cube = ins.StokesCube(cube.data, cube.freq_hz * u.Hz, 15 * u.arcmin, "K", centre)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        found = ins.leaked_through(cube, scalar, Time("2012-12-07T23:00:00"))
    assert np.abs(found.data[:, 0] - cube.data[:, 0]).max() < 1e-6 * np.abs(cube.data).max()


# G10: nothing is overwritten ----------------------------------------------------------------------------------------


def test_g10_every_writer_refuses_what_is_there_and_takes_overwrite(tmp_path, world):
    writers = {
        "cube.fits": world.cube.write, "faraday.fits": world.faraday.write, "p.ecsv": world.cylinders.write,
        "s.ecsv": world.spheres.write, "d.ecsv": world.plane.write, "w.ecsv": world.window.write,
        "l.ecsv": world.leak.write, "loss.ecsv": world.loss.write, "v.h5": world.vis.save,
        "s.h5": lambda path, **k: ins.write_h5parm(path, world.solution, **k),
    }  # fmt: skip
    for name, write in writers.items():
        write(tmp_path / name)
        (tmp_path / name).write_text("precious")
        with pytest.raises(InputError, match=f"{re.escape(name)} exists: give overwrite=True, or another name"):
            write(tmp_path / name)
        assert (tmp_path / name).read_text() == "precious"
        write(tmp_path / name, overwrite=True)
        assert (tmp_path / name).read_bytes() != b"precious"
    assert len([*tmp_path.iterdir()]) == len(writers)


def test_g10_every_public_write_has_the_argument():
    lacking = []
    for path in (Path(ins.__file__).parent).rglob("*.py"):
        text = path.read_text(encoding="utf-8")
        for node in ast.walk(ast.parse(text)) if "def write" in text or "def save" in text else ():
            if isinstance(node, ast.FunctionDef) and (node.name in ("write", "save") or node.name.startswith("write_")):
                names = [a.arg for a in node.args.args]
                fresh = {"folder", "partial", "self"} & set(names[:2]) and "path" not in names
                internal = path.name in ("style.py", "page.py")
                if "path" in names and "overwrite" not in names and not internal and not fresh:
                    lacking.append(f"{path.name}: {node.name}")
    assert lacking == []


def run_in(folder, text, force=False, name="s"):
    with RunFolder(name, folder, force) as one:
        (one.partial / "run.json").write_text(json.dumps({"versions": {}, "text": text}))
        return one.finish()


def text_in(folder):
    return json.loads((folder / "run.json").read_text())["text"]


def test_g10_a_run_is_replaced_only_when_asked_and_only_a_run(here):
    run_in("a", "1")
    with pytest.raises(InputError, match="there is a run in it; choose another, or replace it with --force"):
        run_in("a", "2")
    assert text_in(here / "a") == "1"
    assert run_in("a", "3", force=True) == Path("a")
    assert text_in(here / "a") == "3"
    (here / "mine").mkdir()
    (here / "mine" / "thesis.tex").write_text("precious")
    with pytest.raises(InputError, match="is not an empty folder"):
        run_in("mine", "4", force=True)
    for record in ("{}", "[]", "3", "no record"):  # a file of that name is not yet a run
        (here / "mine" / "run.json").write_text(record)
        with pytest.raises(InputError, match="is not an empty folder"):
            run_in("mine", "4", force=True)
    assert (here / "mine" / "thesis.tex").read_text() == "precious"
    assert sorted(p.name for p in here.iterdir()) == ["a", "mine", "s.toml"]
    # without --out: the next free name, or the same with --force
    assert [run_in(None, "x"), run_in(None, "y"), run_in(None, "z", force=True)] == [
        Path("runs/s"),
        Path("runs/s-2"),
        Path("runs/s"),
    ]
    assert text_in(here / "runs" / "s") == "z"
    assert sorted(p.name for p in (here / "runs").iterdir()) == ["s", "s-2"]


def test_g10_a_run_that_fails_leaves_the_earlier_one(here):
    run_in("a", "1")
    with pytest.raises(ZeroDivisionError), RunFolder("s", "a", True) as one:
        (one.partial / "run.json").write_text(str(1 / 0))
    assert text_in(here / "a") == "1" and sorted(p.name for p in here.iterdir()) == ["a", "s.toml"]


def test_g10_the_help_says_what_happens(capsys):
    for verb in ("run", "analyze"):
        text = " ".join(said_by(capsys, verb, "--help")[1].split())
        assert "NAME-2, NAME-3, ... where that is taken); nothing that is there is overwritten" in text
        assert "--force replace an earlier run in that folder" in text


# G11: a few lines ---------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def world():
    sys.path.insert(0, str(Path(__file__).parent))
    try:
        from test_api_walk import world as made
    finally:
        sys.path.pop(0)
    return made()


def test_g11_every_public_object_shows_itself_in_a_few_lines(world):
    lofar = ins.load("telescopes", "lofar-hba")
    big = ins.load("skies", "random", count=300).about(ins.Direction(2.1, 0.8))
    more = [lofar, lofar.chain(), lofar.layout(), big, *lofar.chain().terms, world.solution.term, world.jansky.psf]
    seen = {}
    for one in [*vars(world).values(), *more]:
        for text in (repr(one), str(one)) if not isinstance(one, ins.Plan) else (repr(one),):
            if not isinstance(one, ins.EoRWindow | ins.Solution):  # their str is a report of some lines
                assert len(text) <= 400, f"{type(one).__name__}: {len(text)} characters"
            seen[type(one).__name__] = text
    assert len(seen) > 25
    assert repr(lofar.chain()) == "Chain(GainTerm(), FeedTerm(), StationBeam(...), Parallactic())"
    assert "freq_hz=(16,) 1.5e+08 to 1.575e+08 Hz" in repr(world.cube) and "unit='K'" in repr(world.cube)


def test_g11_settings_are_shown_with_their_units():
    imager = ins.Imager(pixels=32, pixel=1.5 * u.arcmin, uv_range=(30, 800))
    assert repr(imager) == "Imager(pixels=32, pixel=1.5 arcmin, uv_range=(30, 800))"
    observation = ins.Observation(
        phase_centre="08h13m36.0s +48d13m03s", start="2012-12-07", duration=8 * u.hour, interval=10 * u.s,
        frequencies=[150] * u.MHz,
    )  # fmt: skip
    assert repr(observation) == (
        "Observation(phase_centre=08h13m36.000s +48d13m03.000s, start=2012-12-07T00:00:00.000, duration=28800 s, "
        "interval=10 s, frequencies=[1.5e+08] Hz)"
    )


# G12: versions, provenance, warnings --------------------------------------------------------------------------------


def test_g12_version(capsys):
    assert said_by(capsys, "--version") == (0, f"instrument {ins.__version__}\n", "")


def test_g12_every_file_of_a_run_says_what_made_it(here, capsys, monkeypatch):
    pixel = bytes.fromhex("89504e470d0a1a0a0000000d4948445200000001000000010802000000907753de")
    monkeypatch.setattr("instrument.report.style.save", lambda drawing, path: path.write_bytes(pixel) and path)  # 5 s
    assert main(["run", "s.toml", "--out", "o"]) in (0, 3)
    record = json.loads((here / "o" / "run.json").read_text())
    assert re.fullmatch(r"[0-9a-f]{16}", record["scene_hash"])
    want = {"object": "tiny", "start": "2012-12-07T20:00:00.000", "seed": 5, "scene": record["scene_hash"]}
    want["software"] = f"instrument {ins.__version__}"
    tables = [*(here / "o").rglob("*.ecsv")]
    assert tables and [*(here / "o").rglob("*.fits")]
    for path in tables:
        said = Table.read(path).meta["provenance"]
        assert {key: said[key] for key in want} == want and said["written"].startswith("20")
    for path in (here / "o").rglob("*.fits"):
        head = fits.getheader(path)
        assert [head[key] for key in ("OBJECT", "DATE-OBS", "SEED", "SCENE", "CREATOR")] == [*want.values()]
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        ins.read_cube(here / "o" / "cube.fits")  # its own cards are no unknown ones


def test_g12_what_python_writes_says_what_is_known(tmp_path, world):
    world.cube.write(tmp_path / "c.fits")
    world.cylinders.write(tmp_path / "p.ecsv")
    head, meta = fits.getheader(tmp_path / "c.fits"), Table.read(tmp_path / "p.ecsv").meta["provenance"]
    assert (
        head["CREATOR"] == meta["software"] == f"instrument {ins.__version__}"
        and "SEED" not in head
        and "seed" not in meta
    )


def test_g12_solutions_and_visibilities_say_what_made_them(tmp_path, world):
    from instrument.provenance import provenance

    with provenance(object="night", seed=196, scene="0123456789abcdef"):
        ins.write_h5parm(tmp_path / "s.h5", world.solution)
        world.vis.save(tmp_path / "v.h5")
    with h5py.File(tmp_path / "s.h5") as file:
        said = file["sol000/phase000/val"].attrs["HISTORY000"].decode()
    assert f"CREATE by instrument {ins.__version__} (object night, seed 196, scene 0123456789abcdef)" in said
    with h5py.File(tmp_path / "v.h5") as file:
        assert (file.attrs["object"], file.attrs["seed"], file.attrs["scene"]) == ("night", 196, "0123456789abcdef")


def test_g12_warnings_point_at_the_line_of_the_caller(world):
    cases = (
        lambda: ins.Imager(pixels=16, pixel=1 * u.deg).image(world.vis),  # the PSF
        lambda: world.remover.split(world.cube.flagged([3])),
        lambda: ins.Analyzer(world.cube.with_data(np.where(np.arange(16) == 3, np.nan, world.cube.data))).cylindrical(),
    )
    for case in cases:
        with warnings.catch_warnings(record=True) as said:
            warnings.simplefilter("always")
            case()
        assert said and {w.filename for w in said} == {__file__}, [(w.filename, str(w.message)) for w in said]


def test_g12_there_is_one_helper_for_warnings():
    found = [
        path.name
        for top in ("instrument", "instrument_plugins")
        for path in Path(__import__(top).__file__).parent.rglob("*.py")
        if "warnings.warn(" in path.read_text(encoding="utf-8") and path.name != "errors.py"
    ]
    assert found == []


# G5, G9: what goes wrong is one line -------------------------------------------------------------------------------


def test_g5_a_field_that_is_assigned_is_one_line_with_the_remedy():
    imager = ins.Imager(pixels=32, pixel=1 * u.arcmin)
    for name, value in (("pixels", 64), ("none", 1)):
        with pytest.raises(InputError, match=rf"^Imager is frozen: use .with_fields\({name}=...\), a copy$"):
            setattr(imager, name, value)
    with pytest.raises(InputError, match=r"^Imager is frozen: .pixels. stays$"):
        del imager.pixels
    assert imager.pixels == 32 and imager.with_fields(pixels=64).pixels == 64


def test_g5_places_that_are_not_there_and_lists_for_one_value(tmp_path, world):
    for write in (world.cube.write, world.vis.save, world.cylinders.write):
        with pytest.raises(InputError, match="none/x cannot be written: No such file or directory"):
            write(tmp_path / "none" / "x")
    with pytest.raises(InputError, match="sefd takes one value"):
        world.vis.with_noise(sefd=[1, 2] * u.Jy, seed=1)
    assert not [*tmp_path.iterdir()]


def test_g5_a_terminal_of_ascii_shows_all_text():
    script = "from instrument.terminal import process, show\nprocess(lambda: show('k\\u22a5 \\u2192') or 0)"
    done = subprocess.run(
        [sys.executable, "-c", script], env={**os.environ, "PYTHONIOENCODING": "ascii"}, capture_output=True, check=True
    )
    assert done.stdout == b"k\\u22a5 \\u2192\n" and done.stderr == b""


def test_g5_a_scene_that_may_not_be_read_is_one_line(here, capsys, monkeypatch):
    def forbidden(*_):
        raise PermissionError(13, "Permission denied")

    monkeypatch.setattr("os.open", forbidden)
    status, _, said = said_by(capsys, "plan", "s.toml")
    assert (status, said) == (2, "instrument: scene file 's.toml' cannot be opened: Permission denied\n")


@pytest.mark.parametrize(
    ("content", "text"),
    [
        (b"\xef\xbb\xbf" + TINY.encode(), None),
        (TINY.replace("tiny", "caf\xe9").encode("latin-1"), "line 1: byte 0xe9 is not UTF-8 (Latin-1?)"),
        (TINY.encode("utf-16"), "is UTF-16 or UTF-32 text: a scene file is TOML in UTF-8"),
        (b"\x89PNG\r\n\x1a\n", "is a PNG image"),
        (TINY.replace("[sky]", "[sky]\ncount = 2").encode(), "(at line 15, column 10): count"),
    ],
)
def test_g9_scenes_that_are_none(here, capsys, content, text):
    (here / "s.toml").write_bytes(content)
    status, _, said = said_by(capsys, "plan", "s.toml")
    assert status == (2 if text else 0) and said.count("\n") == (1 if text else 0)
    assert not text or text in said


def test_g9_a_redshift_beside_the_band_and_a_negative_flux_are_said_by_the_plan(here, capsys):
    change = ["observation.frequency.channels=16", "analyze.products=[]", "analyze.cube={redshift=3}"]
    change += ["sky={kind='grid',shape=[2,2],spacing='1 deg',flux='-5 Jy'}"]
    status, _, said = said_by(capsys, "plan", "s.toml", *(word for one in change for word in ("--set", one)))
    assert status == 0
    assert "redshift = 3 has its 21-cm line at 355.1 MHz, the cube is at 148.6 to 151.4 MHz, z = 8.47" in said
    assert "warning: flux = -5 Jy: a negative flux is taken as it stands" in said
