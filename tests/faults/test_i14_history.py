"""The HISTORY of a set: a row of what was written, by what and for which scene; no write fails for it."""

import shutil
import time

import numpy as np
import pytest

import instrument
from instrument import MeasurementSet
from instrument.cli import main
from instrument.errors import InstrumentWarning
from instrument.files import ms_history, ms_write

arrow = pytest.importorskip("arcae.lib.arrow_tables")
SCENE = """name = "night"
[instrument]
telescope = "lofar-hba"
beam = "none"
[sky]
kind = "grid"
shape = [1, 2]
spacing = "1 deg"
flux = "5 Jy"
"""


@pytest.fixture
def one(small_set, tmp_path):
    shutil.copytree(small_set, tmp_path / "a.MS")
    (tmp_path / "s.toml").write_text(SCENE)
    return tmp_path / "a.MS"


def history(path):
    with arrow.Table.from_filename(f"{path}::HISTORY") as table:
        rows = [(slice(k, k + 1),) for k in range(table.nrow())]
        return {name: [table.getcol(name, row).tolist()[0] for row in rows] for name in table.columns()}


def files(path):
    return {f.name: f.read_bytes() for f in (path / "HISTORY").iterdir() if f.name != "table.lock"}


def predicted(path, *more):
    return main(["predict", str(path.parent / "s.toml"), "--data", str(path), "--out", str(path.parent / "out"), *more])


def written(path, column="NEW", overwrite=False):
    found = MeasurementSet(path)
    return found.write(column, found, overwrite=overwrite)


def test_a_new_set_and_each_column_say_who_wrote_them_when_and_for_what(one):
    before = time.time()
    assert history(one)["MESSAGE"] == [f"set written by instrument {instrument.__version__}"]
    assert predicted(one, "--into", "MINE") == 0
    found = history(one)
    said = f"column MINE written by instrument {instrument.__version__}, scene night-predict"
    assert found["MESSAGE"][1:] == [said]
    assert found["CLI_COMMAND"][1][0].startswith("instrument predict /") and "--into MINE" in found["CLI_COMMAND"][1][0]
    assert any(text.startswith("scene = ") for text in found["APP_PARAMS"][1])
    unix = found["TIME"][1] - 40587 * 86400
    assert before - 1 < unix < time.time() + 1
    written(one)
    assert history(one)["MESSAGE"][:2] == found["MESSAGE"]
    assert history(one)["MESSAGE"][2] == f"column NEW written by instrument {instrument.__version__}"
    assert history(one)["CLI_COMMAND"][2] == ["-"]


def test_a_new_set_of_a_scene_names_it(tmp_path):
    (tmp_path / "s.toml").write_text(
        SCENE + f'[observation]\nphase_centre = "08h13m36.0s +48d13m03s"\ntransit = "2012-12-07"\nduration = "20 s"\n'
        f'interval = "10 s"\nfrequencies = ["150 MHz"]\nchannel_width = "0.2 MHz"\n[into]\nset = "{tmp_path}/new.MS"\n'
    )
    assert main(["run", str(tmp_path / "s.toml"), "--out", str(tmp_path / "out"), "--no-verify"]) == 0
    assert history(tmp_path / "new.MS")["MESSAGE"][0].endswith(", scene night")


def test_a_set_without_history_is_written_without(one, recwarn):
    shutil.rmtree(one / "HISTORY")
    written(one)
    assert not (one / "HISTORY").exists() and not [w for w in recwarn if "HISTORY" in str(w.message)]
    assert np.array_equal(next(MeasurementSet(one, "NEW").blocks()).data, next(MeasurementSet(one).blocks()).data)


def test_the_history_of_another_set_that_a_link_leads_to_is_left_alone(one, tmp_path):
    shutil.copytree(one, tmp_path / "b.MS")
    shutil.rmtree(one / "HISTORY")
    (one / "HISTORY").symlink_to(tmp_path / "b.MS" / "HISTORY")
    before = files(tmp_path / "b.MS")
    written(one)
    assert files(tmp_path / "b.MS") == before


def test_a_history_that_cannot_be_written_is_as_it_was_and_the_column_is_whole(one):
    (one / "HISTORY" / "table.dat").write_bytes(b"no table")
    before = files(one)
    with pytest.warns(InstrumentWarning, match="column NEW of .* is written, its HISTORY does not say so: "):
        written(one)
    assert files(one) == before
    assert np.array_equal(next(MeasurementSet(one, "NEW").blocks()).data, next(MeasurementSet(one).blocks()).data)


def test_a_row_that_fails_half_way_is_not_there(one, monkeypatch):
    before, known = history(one), files(one)
    monkeypatch.setattr(ms_history, "command", lambda: 5)  # no text: the put of CLI_COMMAND fails once the row is there
    with pytest.warns(InstrumentWarning, match="its HISTORY does not say so"):
        written(one)
    assert history(one) == before and files(one) == known


def test_an_interrupt_in_the_history_leaves_neither_row_nor_column(one, monkeypatch):
    known = files(one)

    def stopped(*given):
        raise KeyboardInterrupt

    monkeypatch.setattr(ms_history, "in_unit", stopped)
    with pytest.raises(KeyboardInterrupt):
        written(one)
    with arrow.Table.from_filename(str(one)) as table:
        assert "NEW" not in table.columns()
    assert files(one) == known


def test_a_column_that_is_not_written_has_no_row(one, monkeypatch):
    before = history(one)
    monkeypatch.setattr(ms_write, "put_rows", lambda *given: (_ for _ in ()).throw(OSError(28, "No space left")))
    with pytest.raises(OSError, match="No space"):
        written(one)
    assert history(one) == before
