"""Measurement Sets with units, frames, channels, stations and locks that others give them: taken, or one line."""

import contextlib
import importlib.util
import json
import os
import re
import shutil
import subprocess
import sys
import time
import warnings
from pathlib import Path

import numpy as np
import pytest
from astropy import units as u
from astropy.time import Time

import instrument
from instrument import InputError
from instrument.cli import main
from instrument.errors import FileError, InstrumentWarning
from instrument.files import ms_lock
from instrument.files.measurement_set import MeasurementSet
from instrument.files.ms_tables import opened
from instrument.observe.sampling import Sampling, times_of
from instrument.pipeline.run import stream
from instrument.pipeline.scene_file import parse
from instrument.pipeline.scene_text import read_tables
from instrument.pipeline.stage import Running
from instrument.units import Direction

arrow = pytest.importorskip("arcae.lib.arrow_tables", reason="the extra 'ms'")
place = Path(__file__).parents[1] / "unit" / "small_set.py"
spec = importlib.util.spec_from_file_location("small_set", place)
small_set = importlib.util.module_from_spec(spec)
spec.loader.exec_module(small_set)

NAMES = ["CS001HBA0", "CS002HBA1", "CS017HBA0", "RS106HBA", "RS307HBA"]
FREQ = np.array([140e6, 140.1e6, 140.2e6])
TIME = 4861566000.0 + np.array([0, 10, 20, 30.0])
CENTRE = (2.15, 0.84)
A, B = np.triu_indices(len(NAMES), 1)
N = len(TIME) * len(A)


@pytest.fixture(scope="module")
def layout():
    return instrument.load("telescopes", "lofar-hba", stations=NAMES).layout()


@pytest.fixture(scope="module")
def plain(tmp_path_factory, layout):
    """A set with the UVW of its stations and data that are the number of the channel, plus noise; its rows and data."""
    at = Sampling.build(layout, times_of(TIME), FREQ, *np.atleast_2d(CENTRE).T, Direction(*CENTRE))
    uvw = (at.uvw_m[:, B] - at.uvw_m[:, A]).reshape(N, 3)
    rows = [np.repeat(TIME, len(A)), np.tile(A, len(TIME)), np.tile(B, len(TIME)), uvw, *np.zeros((2, N), int)]
    rng = np.random.default_rng(7)
    data = np.arange(3)[:, None] + 0.1 * rng.standard_normal((N, 3, 4)) + 0j
    path = tmp_path_factory.mktemp("plain") / "a.MS"
    small_set.write(path, layout, rows, FREQ, data, telescope="LOFAR")
    return path, rows, data


@pytest.fixture
def copied(plain, tmp_path):
    shutil.copytree(plain[0], tmp_path / "a.MS")
    return tmp_path / "a.MS"


def read(path, **settings):
    return next(MeasurementSet(path, **settings).blocks())


@contextlib.contextmanager
def table(path, sub=""):
    with arrow.Table.from_filename(f"{path}::{sub}" if sub else str(path), readonly=False) as opened:
        yield opened


def scaled(path, sub, name, factor, unit):
    with table(path, sub) as t:
        values = np.array(t.getcol(name))
        t.putcol(name, values * factor)
        t.putcolkeywords(name, {"QuantumUnits": [unit] * (values.shape[-1] if values.ndim > 1 else 1)})


def refused(path, match, error=InputError, **settings):
    with pytest.raises(error, match=match) as told:
        read(path, **settings)
    assert "\n" not in str(told.value) and str(path) in str(told.value)


def scene(folder, *more):
    (folder / "scene.toml").write_text(
        'name = "a"\n[instrument]\ntelescope = "lofar-hba"\nbeam = "none"\n[sky]\nkind = "grid"\n'
        'shape = [2, 2]\nspacing = "1 deg"\nflux = "5 Jy"\n' + "".join(more)
    )
    return str(folder / "scene.toml")


def varied(path, code, types=("J2000", "B1950", "GALACTIC", "AZEL"), codes=(0, 3, 5, 8), kind="INT"):
    """PHASE_DIR with a frame of each row."""
    described = {"valueType": kind, "option": 0, "maxlen": 0, "comment": "", "keywords": {}, "_c_order": True,
                 "dataManagerType": "StandardStMan", "dataManagerGroup": "refs"}  # fmt: skip
    words = {"type": "direction", "VarRefCol": "PhaseDir_Ref"}
    if types:
        words |= {"TabRefTypes": list(types), "TabRefCodes": np.array(codes, np.int32)}
    with table(path, "FIELD") as t:
        t.addcols({"PhaseDir_Ref": described}, {})
        t.putcol("PhaseDir_Ref", np.array([code], np.int32 if kind == "INT" else object))
        t.putcolkeywords("PHASE_DIR", {"MEASINFO": words})


@pytest.mark.parametrize(
    ("code", "how", "known"),
    [
        (3, {}, "B1950"), (8, {}, "AZEL"), (5, {}, "GALACTIC"), (7, {}, "CASACORE'S 7"), (0, {}, None),
        (4, {"types": ()}, "B1950"), (21, {"types": ()}, None), ("B1950", {"kind": "STRING"}, "B1950"),
    ],
)  # fmt: skip
def test_the_frame_of_each_row_of_a_direction_is_read(copied, code, how, known):
    varied(copied, code, **how)
    if known is None:
        assert np.allclose(MeasurementSet(copied).frame.centre, CENTRE, atol=1e-12, rtol=0)
    else:
        refused(copied, f"PHASE_DIR of the field is in {known}, this takes J2000 or ICRS")


def test_columns_come_in_the_units_of_their_keywords(plain, copied):
    want = read(plain[0])
    for sub, name, factor, unit in (
        ("SPECTRAL_WINDOW", "CHAN_FREQ", 1e-9, "GHz"), ("SPECTRAL_WINDOW", "CHAN_WIDTH", 1e-3, "kHz"),
        ("ANTENNA", "POSITION", 1e-3, "km"), ("FIELD", "PHASE_DIR", 180 / np.pi, "deg"),
        ("FIELD", "DELAY_DIR", 180 / np.pi * 3600, "arcsec"), ("", "UVW", 1e3, "mm"), ("", "TIME", 1 / 86400, "d"),
        ("", "INTERVAL", 1 / 60, "min"),
    ):  # fmt: skip
        scaled(copied, sub, name, factor, unit)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        found = read(copied)
    assert np.allclose(found.freq_hz, FREQ, atol=1e-6, rtol=0) and np.allclose(found.width_hz, 1e5, rtol=1e-12)
    assert np.allclose(found.phase_centre, CENTRE, atol=1e-12, rtol=0) and found.at.steered is None
    assert np.abs(found.layout.positions_m - want.layout.positions_m).max() < 1e-7
    assert np.abs(found.at.slots_s - TIME).max() < 2e-5 and np.allclose(found.interval_s, 10.0)  # days to 1e-11
    assert np.abs(found.uvw_m - want.uvw_m).max() < 1e-8 and np.array_equal(found.data, want.data)
    scaled(copied, "", "UVW", 1.0, "lambda")
    refused(copied, "UVW is in 'lambda', which is no unit of m")


def test_times_of_other_scales_are_brought_to_utc(plain, copied):
    scales = {"TAI": "tai", "TT": "tt", "TDT": "tt"}
    for name, scale in scales.items():
        with table(copied) as t:
            times = getattr(times_of(plain[1][0]), scale)
            t.putcol("TIME", (times.jd1 - 2400000.5) * 86400 + times.jd2 * 86400)
            t.putcolkeywords("TIME", {"MEASINFO": {"type": "epoch", "Ref": name}})
        assert np.abs(MeasurementSet(copied).rows.slots_s - TIME).max() < 2e-6, name
    assert Time(TIME[0] / 86400, format="mjd", scale="utc").tai.mjd * 86400 - TIME[0] == pytest.approx(35, abs=1e-3)
    with table(copied) as t:
        t.putcolkeywords("TIME", {"MEASINFO": {"type": "epoch", "Ref": "LAST"}})
    refused(copied, "TIME is in LAST, this takes UTC, TAI or TT")


def test_a_time_that_is_no_date_is_told_by_its_value(plain, copied):
    with table(copied) as t:
        t.putcol("TIME", plain[1][0] * 1e6)
    refused(copied, r"TIME is 4.86157e\+15 s: it is to be a date", FileError)


def words(path, mode, value=CENTRE, unit="rad", frame="J2000"):
    parts = {m: {"value": x, "unit": unit} for m, x in zip(("m0", "m1"), value, strict=True)}
    towards = {"type": "direction", "refer": frame, **parts}
    with table(path) as t:
        t.putcolkeywords("DATA", {"LOFAR_APPLIED_BEAM_MODE": mode, "LOFAR_APPLIED_BEAM_DIR": towards})


def test_the_direction_of_a_beam_has_a_unit_and_a_frame(copied):
    words(copied, "Full", np.degrees(CENTRE), "deg")
    assert np.allclose(MeasurementSet(copied).beam_state.towards, CENTRE, atol=1e-12, rtol=0)
    for mode, value, unit, frame, error, line in (
        ("Full", CENTRE, "rad", "AZEL", InputError, "LOFAR_APPLIED_BEAM_DIR is in AZEL, this takes J2000"),
        ("Full", CENTRE, "m", "J2000", FileError, "LOFAR_APPLIED_BEAM_DIR is no direction: 'm'"),
        ("Full", np.degrees(CENTRE), "rad", "J2000", FileError, "123.186, 48.1285 rad: no direction"),
        ("Tile", CENTRE, "rad", "J2000", InputError, "is 'Tile', none of Full, Element, ArrayFactor, None"),
    ):
        words(copied, mode, value, unit, frame)
        refused(copied, line, error)


@pytest.mark.parametrize(
    ("mode", "known"), [("Element", "Element"), ("arrayfactor", "ArrayFactor"), ("FULL", "Full"), ("NONE", "None")]
)
def test_the_part_of_a_beam_that_was_taken_out_is_written_again(copied, mode, known):
    words(copied, mode)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        one = MeasurementSet(copied)
        one.write("COPY", one)
        again = MeasurementSet.create(copied.parent / "b.MS", one)
    for path, column in ((copied, "COPY"), (copied.parent / "b.MS", "DATA")):
        with table(path) as t:
            assert t.getcolkeywords(column)["LOFAR_APPLIED_BEAM_MODE"] == known
    assert again.beam_state == one.beam_state and (known in ("Full", "None") or known in str(one.beam_state))


def test_weights_that_some_rows_lack_are_refused_and_none_at_all_are_those_of_rows(tmp_path, plain, layout):
    _, rows, data = plain
    weight = np.full(data.shape, 3.0)
    small_set.write(tmp_path / "a.MS", layout, rows, FREQ, data, weight=weight, spectrum=False)
    column = {"valueType": "FLOAT", "ndim": 2, "option": 0, "maxlen": 0, "comment": "", "keywords": {},
              "_c_order": True, "dataManagerType": "StandardStMan", "dataManagerGroup": "late"}  # fmt: skip
    with table(tmp_path / "a.MS") as t:
        t.addcols({"WEIGHT_SPECTRUM": column}, {})
    assert MeasurementSet(tmp_path / "a.MS").weights == "WEIGHT" and np.all(read(tmp_path / "a.MS").weight == 3)
    with table(tmp_path / "a.MS") as t:
        t.putcol("WEIGHT_SPECTRUM", 7 * weight[1:].astype(np.float32), (slice(1, N),))
    refused(tmp_path / "a.MS", f"WEIGHT_SPECTRUM has values in {N - 1} of {N} rows: fill it", FileError)


def test_damaged_weights_are_not_replaced_by_others(plain):
    path = plain[0].parent / "cut.MS"
    MeasurementSet.create(path, MeasurementSet(plain[0]))
    with table(path) as t:
        name = t.getcoldesc("WEIGHT_SPECTRUM")["dataManagerGroup"]
        assert "WEIGHT" in name
    cut = [f for f in path.glob("table.f*_TSM0") if f.stat().st_size == N * 3 * 4 * 4]
    assert len(cut) == 1
    cut[0].write_bytes(cut[0].read_bytes()[: N * 3 * 4 * 2])
    with pytest.raises(
        FileError, match=r"cut\.MS: column WEIGHT_SPECTRUM: it is cut short or damaged, copy the set again"
    ):
        read(path)


@pytest.mark.parametrize("order", [[2, 0, 1], [1, 0, 2], [2, 1, 0]])
def test_channels_in_any_order_are_read_and_written(plain, copied, order):
    want = read(plain[0])
    with table(copied, "SPECTRAL_WINDOW") as t:
        t.putcol("CHAN_FREQ", FREQ[None, order])
    with table(copied) as t:
        data = np.array(t.getcol("DATA"))[:, order]
        t.putcol("DATA", data)
    one = MeasurementSet(copied)
    found = next(one.blocks())
    assert np.array_equal(found.freq_hz, FREQ) and np.array_equal(found.data, want.data)
    for part in (slice(0, 1), slice(1, 3), slice(0, 2)):
        assert np.array_equal(one.part(found.block(slice(None), part)).data, want.data[:, part])
    one.write("WHOLE", [found])
    one.write("PARTS", [found.block(slice(None), slice(f, f + 1)) for f in range(3)])
    with table(copied) as t:
        assert np.array_equal(t.getcol("WHOLE"), data) and np.array_equal(t.getcol("PARTS"), data)


def test_a_channel_that_is_there_twice_is_refused(copied):
    with table(copied, "SPECTRAL_WINDOW") as t:
        t.putcol("CHAN_FREQ", FREQ[None, [0, 1, 0]])
    refused(copied, "window 0: a channel is there twice", FileError)


def test_numbers_of_rows_that_are_not_there_are_one_line(plain, copied, layout):
    for name in ("DATA_DESC_ID", "FIELD_ID"):
        with table(copied) as t:
            t.putcol(name, np.full(N, -1, np.int32))
        refused(copied, f"rows have {name} -1", FileError)
        with table(copied) as t:
            t.putcol(name, np.zeros(N, np.int32))
    for name, sub in (("POLARIZATION_ID", "POLARIZATION"), ("SPECTRAL_WINDOW_ID", "SPECTRAL_WINDOW")):
        with table(copied, "DATA_DESCRIPTION") as t:
            t.putcol(name, np.array([3], np.int32))
        refused(copied, rf"{sub}: row 3 is asked for \w+, of 1 that are there", FileError)
        with table(copied, "DATA_DESCRIPTION") as t:
            t.putcol(name, np.array([0], np.int32))
    _, rows, data = plain
    small_set.write(copied.parent / "b.MS", layout, [*rows[:4], np.arange(N), rows[5]], FREQ, data, windows=N)
    refused(copied.parent / "b.MS", r"holds 40 spectral windows \(0, 1, 2, 3, 4, 5, 6, 7, \.\.\.\): choose one")


@pytest.mark.parametrize("unit", [1.0, 299792458.0])
def test_uvw_in_single_precision_are_those_of_stations(plain, copied, unit):
    """In metres, or in seconds of which UVFITS is made."""
    rounded = (plain[1][3] / unit).astype(np.float32).astype(float) * unit
    with table(copied) as t:
        t.putcol("UVW", rounded)
    with pytest.warns(InstrumentWarning, match=r"UVW are rounded to single precision: they close .* to .*0\.000\d+ m"):
        found = read(copied)
    assert found.given_uvw_m is None and np.abs(found.uvw_m.reshape(-1, 3) + rounded).max() > 1e-6
    assert np.abs(found.uvw_m - read(plain[0]).uvw_m).max() < 6e-8 * np.abs(rounded).max()
    off = rounded.copy()
    off[3, 0] += 1e-4  # no rounding
    with table(copied) as t:
        t.putcol("UVW", off)
    assert read(copied).given_uvw_m is not None
    with pytest.raises(InputError, match=r"do not close .* can be imaged as it stands; .* \(CASA's fixvis\)"):
        MeasurementSet(copied).observation()


def cube_of(text):
    """The cube of a scene on data, without its report."""
    file = parse(read_tables(str(text)))
    made = file.scene()
    run = Running(file.name, file.seed, made.instrument, file.plan(made), file.running, modelled=False, read=True)
    stream(run)
    return run.results["image"].cube.data


def test_a_set_whose_uvw_do_not_close_is_imaged_and_not_predicted(plain, copied, tmp_path, capsys):
    with table(copied) as t:
        uvw = np.array(plain[1][3])
        uvw[:: len(A)] += [3.0, 20.0, 0]
        t.putcol("UVW", uvw)
    imager = instrument.Imager(pixels=32, pixel=1 * u.arcmin, uv_range=(0, 2000), weighting="uniform")
    was, want = (imager.image(MeasurementSet(path)).data for path in (plain[0], copied))
    assert np.abs(was - want).max() > 1e-3 * np.abs(want).max()
    image = '[image]\npixels = 32\npixel = "1 arcmin"\nuv_range = [0, 2000]\nweighting = "uniform"\n'
    data = f'[data]\nset = "{copied}"\n'
    for stations in ("", f"stations = {json.dumps(NAMES[::-1])}\n"):
        place = Path(scene(tmp_path, data, image))
        place.write_text(place.read_text().replace('beam = "none"\n', f'beam = "none"\n{stations}'))
        found = cube_of(place)
        assert np.abs(found - want).max() < 1e-5 * np.abs(want).max()
    again = f'[data]\nset = "{copied}"\n[into]\nset = "{tmp_path}/new.MS"\n'
    assert main(["run", scene(tmp_path, again), "--out", str(tmp_path / "q")]) == 0
    assert np.array_equal(read(tmp_path / "new.MS").uvw_m, read(copied).uvw_m)
    capsys.readouterr()
    assert main(["predict", scene(tmp_path), "--data", str(copied), "--out", str(tmp_path / "p")]) == 2
    assert "do not close around triangles" in capsys.readouterr().err


def test_a_short_last_integration_is_read_predicted_and_written(copied, tmp_path):
    with table(copied) as t:
        lengths = np.array(t.getcol("INTERVAL"))
        lengths[-len(A) :] = 7.0
        t.putcol("INTERVAL", lengths)
    assert np.array_equal(read(copied).interval_s, [10, 10, 10, 7])
    with pytest.warns(
        InstrumentWarning, match="integrations of 7 to 10 s: what is predicted is smeared as the longest"
    ):
        assert MeasurementSet(copied).observation().interval == 10.0
    again = f'[data]\nset = "{copied}"\n[into]\nset = "{tmp_path}/new.MS"\n'
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        assert main(["predict", scene(tmp_path), "--data", str(copied), "--out", str(tmp_path / "p")]) == 0
        assert main(["run", scene(tmp_path, again), "--out", str(tmp_path / "q")]) == 0
    assert read(copied, column="MODEL_DATA").data.any()
    assert np.array_equal(MeasurementSet(tmp_path / "new.MS").rows.interval_s, [10, 10, 10, 7])
    assert np.array_equal(read(tmp_path / "new.MS").data, read(copied).data)
    with table(copied) as t:
        t.putcol("INTERVAL", np.zeros(N))
    with pytest.raises(InputError, match=r"a.MS: INTERVAL is 0 to 0 s: integrations need a length"):
        MeasurementSet(copied).observation()


def test_a_storage_manager_that_is_not_there_is_named_with_the_remedy(plain):
    path = plain[0].parent / "dysco.MS"
    MeasurementSet.create(path, MeasurementSet(plain[0]))
    text = (path / "table.dat").read_bytes()
    assert text.count(b"TiledColumnStMan") > 1
    (path / "table.dat").write_bytes(text.replace(b"TiledColumnStMan", b"DyscoStManOfTest"))
    refused(path, r"storage manager dyscostmanoftest is not installed here: put .*CASACORE_LDPATH.*DP3", FileError)


def with_more(path, plain, layout, first=False, position=(0, 0, 0)):
    """The set with a station that no row has and that stands nowhere, after the others or before them."""
    _, rows, data = plain
    rows = list(rows)
    names, places = [*layout.names], layout.positions_m
    rows[1], rows[2] = rows[1] + first, rows[2] + first
    names.insert(0 if first else len(names), "DEAD")
    places = np.insert(places, 0 if first else len(places), position, axis=0)
    broken = type("Broken", (), {"names": names, "positions_m": places})
    small_set.write(path, broken, rows, FREQ, data, telescope="LOFAR")


@pytest.mark.parametrize("first", [False, True])
@pytest.mark.parametrize("position", [(0, 0, 0), (np.nan, 0, 0)])
def test_a_station_that_no_row_has_may_stand_nowhere(tmp_path, plain, layout, first, position):
    with_more(tmp_path / "a.MS", plain, layout, first, position)
    want, one = read(plain[0]), MeasurementSet(tmp_path / "a.MS")
    found = next(one.blocks())
    assert found.layout.names == want.layout.names and np.array_equal(found.data, want.data)
    assert np.abs(found.uvw_m - want.uvw_m).max() < 1e-8
    one.write("COPY", [found.with_data(2 * found.data)])
    with table(tmp_path / "a.MS") as t:
        assert np.array_equal(t.getcol("COPY"), 2 * np.array(t.getcol("DATA")))
    with table(tmp_path / "a.MS") as t:
        t.putcol("ANTENNA1" if first else "ANTENNA2", np.full(N, 0 if first else 5, np.int32))
    refused(tmp_path / "a.MS", "station 'DEAD' stands at no place on the Earth, and rows have it", FileError)


def test_a_station_that_no_row_has_needs_no_field_of_lofar(plain, copied, layout):
    from instrument.files.ms_create import fill

    fill(
        str(copied),
        "LOFAR_ANTENNA_FIELD",
        {"ANTENNA_ID": np.arange(4, dtype=np.int32), "COORDINATE_AXES": layout.axes[:4]},
    )
    refused(copied, "station 'RS307HBA' has no row in LOFAR_ANTENNA_FIELD, and rows have it", FileError)
    _, rows, data = plain
    use = (rows[1] < 4) & (rows[2] < 4)
    small_set.write(copied.parent / "b.MS", layout, [x[use] for x in rows], FREQ, data[use])
    fill(
        str(copied.parent / "b.MS"),
        "LOFAR_ANTENNA_FIELD",
        {"ANTENNA_ID": np.arange(4, dtype=np.int32), "COORDINATE_AXES": layout.axes[:4]},
    )
    assert read(copied.parent / "b.MS").layout.names == layout.names[:4]


def test_times_that_differ_between_baselines_are_said(plain, copied):
    with table(copied) as t:
        t.putcol("TIME", plain[1][0] + np.tile(3e-3 * np.arange(len(A)), len(TIME)))
    with pytest.warns(InstrumentWarning, match="half of its 40 times have at most 1 of 10 baselines: where TIME"):
        MeasurementSet(copied)


HOLD = {
    "fcntl": "import fcntl, os; f = os.open(path + '/table.lock', os.O_RDWR); fcntl.lockf(f, fcntl.LOCK_EX, 1)",
    "shared": "import fcntl, os; f = os.open(path + '/table.lock', os.O_RDWR); fcntl.lockf(f, fcntl.LOCK_SH, 1)",
    **{
        kind: "from casacore.tables import table\n"
        f"t = table(path, ack=False, readonly=False, lockoptions={kind!r}); t.lock()"
        for kind in ("permanent", "auto", "user")
    },
}


@contextlib.contextmanager
def held(path, how):
    """The set while another process keeps it locked."""
    text = f"import time; path = {str(path)!r}\n{HOLD[how]}\nprint('held', flush=True); time.sleep(60)"
    other = subprocess.Popen([sys.executable, "-c", text], stdout=subprocess.PIPE, text=True)
    try:
        assert other.stdout.readline() == "held\n"
        yield other
    finally:
        other.kill()
        other.wait()
        other.stdout.close()


@pytest.mark.parametrize(
    "how", ["fcntl", *(pytest.param(k, marks=pytest.mark.peer) for k in ("permanent", "auto", "user"))]
)
def test_a_set_that_another_process_keeps_locked_is_refused_after_a_while(copied, monkeypatch, how):
    if how != "fcntl":
        pytest.importorskip("casacore.tables")
    assert ms_lock.WAIT_S == 5.0
    monkeypatch.setattr(ms_lock, "WAIT_S", 0.5)
    one = MeasurementSet(copied)
    with held(copied, how) as other:
        begun = time.monotonic()
        refused(copied, re.escape(f"is locked by another process (number {other.pid}): wait until"), FileError)
        with pytest.raises(FileError, match="is locked by another process"):
            one.write("COPY", [])
        assert 0.9 < time.monotonic() - begun < 5
    assert not ms_lock.OPEN and read(copied).data.any()


def test_a_lock_that_readers_share_keeps_writers_out_and_one_that_ends_is_waited_for(copied, monkeypatch):
    whole = read(copied)
    monkeypatch.setattr(ms_lock, "WAIT_S", 0.5)
    with held(copied, "shared"):
        assert np.array_equal(read(copied).data, whole.data)
        with pytest.raises(FileError, match="is locked by another process"):
            MeasurementSet(copied).write("COPY", [whole])
    with table(copied) as t:
        assert "COPY" not in t.columns()
    monkeypatch.setattr(ms_lock, "WAIT_S", 30)
    with held(copied, "fcntl") as other:
        end = subprocess.Popen([sys.executable, "-c", f"import os, time; time.sleep(0.5); os.kill({other.pid}, 9)"])
        assert np.array_equal(read(copied).data, whole.data)
        end.wait()


def test_a_lock_is_looked_at_where_this_process_has_the_table_not_open(copied, monkeypatch):
    """To close any file of a table drops the locks that a process has on it, casacore's own too."""
    looked, holder = [], ms_lock.holder
    monkeypatch.setattr(ms_lock, "holder", lambda lock, writable: looked.append(lock) or holder(lock, writable))
    with opened(str(copied)):
        read(copied)
    main = os.path.realpath(copied / "table.lock")
    assert looked.count(main) == 1 and os.path.realpath(copied / "FIELD" / "table.lock") in looked
    read(copied)
    assert looked.count(main) > 1 and not ms_lock.OPEN
