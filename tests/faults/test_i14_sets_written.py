"""Columns and sets that are written: looked at first, as they were where it fails or is stopped, nothing made up."""

import json
import os
import shutil
import signal
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from astropy import units as u

import instrument
from instrument import MeasurementSet, Observation, Visibilities
from instrument.cli import main
from instrument.errors import FileError, InputError, InstrumentWarning, RefusedError
from instrument.files import measurement_set, ms_write
from instrument.observe.sampling import Sampling
from instrument.partial_folders import PARTIAL

arrow = pytest.importorskip("arcae.lib.arrow_tables")
STATIONS = ("CS001HBA0", "CS002HBA1", "CS003HBA0", "CS004HBA1", "RS106HBA")
SCENE = """name = "night"
[instrument]
telescope = "lofar-hba"
beam = "none"
[sky]
kind = "grid"
shape = [1, 2]
spacing = "1 deg"
flux = "5 Jy"
[calibrate]
kind = "selfcal"
"""


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    """A folder with a scene and a set of its prediction, 6 times, 3 channels."""
    folder = tmp_path_factory.mktemp("made")
    (folder / "s.toml").write_text(SCENE)
    lofar = instrument.load("telescopes", "lofar-hba", stations=STATIONS, beam=None)
    night = Observation(
        phase_centre="08h13m36.0s +48d13m03s", transit="2012-12-07", duration=60 * u.s, interval=10 * u.s,
        frequencies=[150.0, 150.2, 150.4] * u.MHz, channel_width=0.2 * u.MHz,
    )  # fmt: skip
    layout, centre = lofar.layout(), night.phase_centre
    at = Sampling.build(layout, night.times(layout), night.freq_hz, centre.ra_rad, centre.dec_rad, centre)
    one, two = layout.baselines
    zero = Visibilities(np.zeros((6, 3, len(one), 2, 2), complex), at, one, two, 10.0, 0.2e6)
    MeasurementSet.create(folder / "empty.MS", zero, instrument=lofar)
    shutil.copytree(folder / "empty.MS", folder / "a.MS")
    assert do("predict", folder / "a.MS", "--into", "DATA", "--force", scene=folder) == 0
    return folder


@pytest.fixture
def one(made, tmp_path):
    shutil.copytree(made / "a.MS", tmp_path / "a.MS")
    shutil.copy(made / "s.toml", tmp_path)
    return tmp_path / "a.MS"


def do(verb, data, *more, scene=None):
    place = scene or data.parent
    words = [verb, str(place / "s.toml"), "--data", str(data), "--out", str(data.parent / "runs" / verb), *more]
    return main(words)


def column(path, name):
    with arrow.Table.from_filename(str(path)) as table:
        return np.array(table.getcol(name))


def put(path, **columns):
    with arrow.Table.from_filename(str(path), readonly=False) as table:
        for name, values in columns.items():
            table.putcol(name, values)


def names(path):
    with arrow.Table.from_filename(str(path)) as table:
        return set(table.columns())


def files(path):
    return sorted(f.name for f in Path(path).iterdir())


def in_steps(monkeypatch, steps, then):
    """Blocks of a kept file one time each; the put of number `steps` does something else first."""
    blocks, place, count = measurement_set.VisibilityFile.blocks, ms_write.put, [0]

    def short(self):
        for block in blocks(self):
            for t in range(len(block.at.slots_s)):
                yield block.block(slice(t, t + 1), slice(None))

    def stopped(*given):
        count[0] += 1
        if count[0] == steps:
            then()
        return place(*given)

    monkeypatch.setattr(measurement_set.VisibilityFile, "blocks", short)
    monkeypatch.setattr(measurement_set, "put", stopped)


def interrupt():
    raise KeyboardInterrupt


def full():
    raise OSError(28, "No space left on device")


@pytest.mark.parametrize("then", [interrupt, full])
@pytest.mark.parametrize("into", ["NEW", "DATA"])
def test_a_column_is_as_it_was_where_its_writing_ends_half_way(one, monkeypatch, capsys, into, then):
    before, data, had = files(one), column(one, "DATA"), names(one)
    (one.parent / "s.toml").write_text(SCENE.replace("5 Jy", "10 Jy"))
    with monkeypatch.context() as patch:
        in_steps(patch, 4, then)
        assert do("predict", one, "--into", into, "--force") == 1
    said = capsys.readouterr().err
    assert ("stopped; nothing was written" in said) == (then is interrupt)
    assert names(one) == had and files(one) == before and np.array_equal(column(one, "DATA"), data)
    assert files(one.parent) == ["a.MS", "runs", "s.toml"] or files(one.parent) == ["a.MS", "s.toml"]
    assert do("predict", one, "--into", into, "--force") == 0
    assert np.allclose(column(one, into), 2 * data, rtol=1e-5, atol=1e-5)


def test_a_column_is_as_it_was_where_its_blocks_are_of_a_few_channels_each(one, monkeypatch):
    """Rows that are written twice, channels after channels, get what they had before the first time."""
    data, vis = column(one, "DATA"), next(MeasurementSet(one).blocks())
    blocks = measurement_set.VisibilityFile.blocks
    parts = [slice(0, 1), slice(1, 2), slice(2, 3)]
    with monkeypatch.context() as patch:
        patch.setattr(
            measurement_set.VisibilityFile, "blocks",
            lambda self: (b.block(slice(None), f) for b in blocks(self) for f in parts),
        )  # fmt: skip
        place, count = ms_write.put, []

        def stopped(*given):
            count.append(place(*given))
            if len(count) == 2:
                raise KeyboardInterrupt
            return count[-1]

        patch.setattr(measurement_set, "put", stopped)
        with pytest.raises(KeyboardInterrupt):
            MeasurementSet(one).write("DATA", vis.with_data(3 * vis.data), overwrite=True)
    assert len(count) == 2 and np.array_equal(column(one, "DATA"), data)


def test_visibilities_with_other_uvw_are_told(one):
    vis = next(MeasurementSet(one).blocks())
    MeasurementSet(one).write("SAME", vis)
    other = replace(vis, at=replace(vis.at, own_uvw_m=1.5 * vis.at.uvw_m))
    with pytest.warns(InstrumentWarning, match="UVW that are 50 % off those of"):
        MeasurementSet(one).write("OTHER", other)


def test_a_signal_while_a_column_is_written_leaves_the_old_one(one):
    data = column(one, "DATA")
    (one.parent / "s.toml").write_text(SCENE.replace("5 Jy", "10 Jy"))
    script = (
        "import os, signal, sys\nfrom instrument.files import measurement_set as m\nput, n = m.put, []\n"
        "def stopped(*given):\n    made = put(*given)\n    os.kill(os.getpid(), signal.SIGTERM)\n    return made\n"
        "m.put = stopped\nfrom instrument.cli import main\nsys.exit(main())\n"
    )
    words = ["predict", str(one.parent / "s.toml"), "--data", str(one), "--into", "DATA", "--force"]
    done = subprocess.run(
        [sys.executable, "-c", script, *words, "--out", str(one.parent / "o")], capture_output=True, text=True,
        timeout=120, env=os.environ | {"PYTHONPATH": os.pathsep.join(sys.path)},
    )  # fmt: skip
    assert done.returncode == 1 and "stopped; nothing was written" in done.stderr
    assert np.array_equal(column(one, "DATA"), data)
    assert not [f for f in os.listdir(one.parent) if f.startswith(".")]


def test_what_a_killed_process_has_left_beside_a_set_goes_with_the_next(one, capsys):
    script = (
        "import os, signal, sys\nfrom instrument.files import measurement_set as m\n"
        "m.add_column = lambda *given: os.kill(os.getpid(), signal.SIGKILL)\n"
        "from instrument.cli import main\nsys.exit(main())\n"
    )
    words = ["predict", str(one.parent / "s.toml"), "--data", str(one), "--out", str(one.parent / "o")]
    done = subprocess.run(
        [sys.executable, "-c", script, *words], capture_output=True, timeout=120,
        env=os.environ | {"PYTHONPATH": os.pathsep.join(sys.path)},
    )  # fmt: skip
    assert done.returncode == -signal.SIGKILL
    assert len([f for f in os.listdir(one.parent) if f.startswith(".a.MS.") and f.endswith(PARTIAL)]) >= 1
    assert do("predict", one) == 0
    assert "left by a run that was killed, removed" in capsys.readouterr().err
    assert not [f for f in os.listdir(one.parent) if f.startswith(".")]


@pytest.mark.parametrize("way", ["dots", "folder", "link"])
def test_the_set_that_is_read_is_known_by_any_of_its_names(one, way):
    """[into] with another name of the set of [data] writes a column of it, and does not replace it."""
    here = one.parent
    (here / "sub").mkdir()
    (here / "lnk").symlink_to(here)
    (here / "b.MS").symlink_to(one)
    name = {"dots": here / "sub" / ".." / "a.MS", "folder": here / "lnk" / "a.MS", "link": here / "b.MS"}[way]
    data = column(one, "DATA")
    (here / "into.toml").write_text(
        SCENE[: SCENE.index("[calibrate]")]
        + f'[data]\nset = "{one}"\n[into]\nset = "{name}"\nwhat = "model"\noverwrite = true\n'
    )
    assert main(["run", str(here / "into.toml"), "--out", str(here / "o")]) == 0
    assert "MODEL_DATA" in names(one) and np.array_equal(column(one, "DATA"), data)


def test_what_has_no_data_is_no_number(one, capsys):
    """NaN that is not flagged stays NaN: no minus the model, no zero; what is flagged is told by FLAG."""
    data, flag = column(one, "DATA"), column(one, "FLAG")
    data[4, 1, :], data[7, 0, 1] = np.nan, np.inf
    data[9, 2, :], flag[9, 2, :] = np.nan, True
    put(one, DATA=data, FLAG=flag)
    assert do("subtract", one) == 0
    left = column(one, "SUBTRACTED_DATA")
    lacking = np.isnan(left)
    assert lacking[4, 1].all() and lacking[7, 0, 1] and lacking.sum() <= 4 + 4
    assert np.abs(left[~lacking & ~flag]).max() < 1e-4
    assert "has no data or no solution: NaN there" in capsys.readouterr().out


def test_calibration_over_its_own_data_keeps_what_is_flagged_and_makes_no_zeros(one):
    flag, data = column(one, "FLAG"), column(one, "DATA")
    flag[:, 1] = True
    put(one, FLAG=flag)
    assert do("calibrate", one, "--into", "DATA", "--force") == 0  # of what has data every interval converged
    told = json.loads((one.parent / "runs" / "calibrate" / "run.json").read_text())["calibration"]
    assert told["intervals_without_data"] == 6 and told["visibility_rms_share"]["corrected - model"] < 1e-4
    found = column(one, "DATA")
    assert np.array_equal(found[:, 1], data[:, 1])
    assert np.allclose(found[:, [0, 2]], data[:, [0, 2]], rtol=1e-3, atol=1e-3)


def test_nothing_is_written_where_nothing_is_solved(one, capsys):
    put(one, FLAG=np.ones_like(column(one, "FLAG")))
    assert do("calibrate", one) in (1, 2)
    assert "every visibility is flagged" in capsys.readouterr().err
    assert "CORRECTED_DATA" not in names(one)


@pytest.mark.parametrize(
    ("name", "line"),
    [
        ("SIGMA_SPECTRUM", "SIGMA_SPECTRUM is no column for visibilities"),
        ("IMAGING_WEIGHT", "is no column for visibilities"),
        ("", "'' is no name for a column"),
        ("A\nB", "is no name for a column: letters, digits and underscores"),
        ("ODD", "column ODD holds int of 3 x 4, the visibilities are complex"),
        ("SHORT", "column SHORT holds complex of 2 x 4, the visibilities are complex of 3 x 4"),
    ],
)
def test_a_column_that_cannot_take_visibilities_is_told_before_the_work(one, capsys, name, line):
    with arrow.Table.from_filename(str(one), readonly=False) as table:
        like = dict(table.getcoldesc("DATA"))
        like.update({"dataManagerGroup": "Tiled1", "keywords": {}})
        table.addcols({"SHORT": like | {"shape": [2, 4]}}, {})
        table.addcols({"ODD": like | {"valueType": "INT", "dataManagerGroup": "Tiled2"}}, {})
    before = files(one)
    assert do("predict", one, "--into", name, "--force") == 2
    said = capsys.readouterr()
    assert line in said.err and len(said.err.strip().splitlines()) == 1 and "time  " not in said.out
    assert files(one) == before


def test_a_full_disk_is_told_before_the_work(one, monkeypatch, capsys):
    monkeypatch.setattr(ms_write.shutil, "disk_usage", lambda path: shutil._ntuple_diskusage(10**9, 10**9, 10**7))
    assert do("predict", one) == 2
    assert "10 MB are free" in capsys.readouterr().err and "MODEL_DATA" not in names(one)
    with pytest.raises(RefusedError, match="free"):
        MeasurementSet(one).write("COPY", MeasurementSet(one))


def test_the_columns_of_windows_of_unlike_size_are_whole(one):
    """Rows of another window, with as many channels as that has, are zero in a new column, and its own are filled."""
    with arrow.Table.from_filename(str(one), readonly=False) as table:
        rows, like = table.nrow(), dict(table.getcoldesc("DATA"))
        (
            like.pop("shape"),
            like.update({"option": 0, "dataManagerType": "TiledShapeStMan", "dataManagerGroup": "TiledV"}),
        )
        table.addcols({"VARIED": like | {"keywords": {}}}, {})
        table.putcol("VARIED", np.array(table.getcol("DATA")))
        table.addrows(rows)
        for name in ("TIME", "TIME_CENTROID", "INTERVAL", "ANTENNA1", "ANTENNA2", "UVW", "EXPOSURE"):
            table.putcol(name, np.array(table.getcol(name, (slice(0, rows),))), (slice(rows, 2 * rows),))
        table.putcol("DATA_DESC_ID", np.ones(rows, np.int32), (slice(rows, 2 * rows),))
        table.putcol("VARIED", np.ones((rows, 2, 4), np.complex64), (slice(rows, 2 * rows),))
    with arrow.Table.from_filename(f"{one}::DATA_DESCRIPTION", readonly=False) as table:
        table.addrows(1)
        table.putcol("SPECTRAL_WINDOW_ID", np.ones(1, np.int32), (slice(1, 2),))
    with arrow.Table.from_filename(f"{one}::SPECTRAL_WINDOW", readonly=False) as table:
        table.addrows(1)
        table.putcol("NUM_CHAN", np.array([2], np.int32), (slice(1, 2),))
        for name in ("CHAN_FREQ", "CHAN_WIDTH"):
            table.putcol(name, np.array([[1.6e8, 1.61e8]]), (slice(1, 2),))
    assert do("predict", one, "--window", "0", "--column", "VARIED") == 0
    with arrow.Table.from_filename(str(one)) as table:
        mine = np.array(table.getcol("MODEL_DATA", (slice(0, rows),)))
        other = np.array(table.getcol("MODEL_DATA", (slice(rows, 2 * rows),)))
    assert np.allclose(mine, column(one, "DATA")[:rows], atol=1e-4) and other.shape == (rows, 2, 4) and not other.any()


def test_a_new_set_is_of_ascending_channels_and_first_stations(made, tmp_path):
    vis = next(MeasurementSet(made / "a.MS").blocks())
    turned = replace(
        vis, antenna1=vis.antenna2, antenna2=vis.antenna1, data=np.conj(np.swapaxes(vis.data, -1, -2)),
        weight=vis.weight, flag=vis.flag,
    )  # fmt: skip
    order = [turned.block(slice(None), slice(f, f + 1)) for f in (2, 0, 1)]
    back = next(MeasurementSet.create(tmp_path / "b.MS", order).blocks())
    assert np.all(column(tmp_path / "b.MS", "ANTENNA1") < column(tmp_path / "b.MS", "ANTENNA2"))
    assert np.all(np.diff(column(f"{tmp_path}/b.MS::SPECTRAL_WINDOW", "CHAN_FREQ")) > 0)
    assert np.array_equal(back.data, vis.data) and np.abs(back.uvw_m - vis.uvw_m).max() < 1e-8


def test_what_single_precision_does_not_hold_is_refused_and_what_is_no_number_is_flagged(made, tmp_path):
    vis = next(MeasurementSet(made / "a.MS").blocks())
    for bad, line in (
        (replace(vis, data=vis.data * 1e39), "the visibilities: numbers above"),
        (replace(vis, weight=vis.weight * 1e39), "their weights: numbers above"),
        (replace(vis, weight=vis.weight * 1e-46), "their weights: numbers below"),
    ):
        with pytest.raises(InputError, match=line):
            MeasurementSet.create(tmp_path / "b.MS", bad)
    assert not list(tmp_path.iterdir())
    data = vis.data.copy()
    data[2, 1, 3, 0, 1] = np.nan
    back = next(MeasurementSet.create(tmp_path / "b.MS", replace(vis, data=data)).blocks())
    assert back.flag[2, 1, 3, 0, 1] and np.sum(back.flag) == 1
    with pytest.warns(InstrumentWarning, match="width of channels is not known"):
        MeasurementSet.create(tmp_path / "c.MS", replace(vis, width_hz=None))


def test_a_selection_of_rows_is_no_set_to_write_into(made, tmp_path):
    shutil.copytree(made / "a.MS", tmp_path / "a.MS")
    dat = (tmp_path / "a.MS" / "table.dat").read_bytes()
    (tmp_path / "a.MS" / "table.dat").write_bytes(dat.replace(b"\x0aPlainTable", b"\x08RefTable", 1))
    with pytest.raises((InputError, FileError), match="a selection of rows of another set"):
        ms_write.demand_column(str(tmp_path / "a.MS"), "MODEL_DATA", False)
