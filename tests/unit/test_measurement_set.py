"""Measurement Sets read as they stand: rows in any order, baselines missing, channels backwards, feeds circular."""

import importlib.util
import warnings
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import instrument
from instrument import InputError
from instrument.errors import FileError, InstrumentWarning
from instrument.files import by_rows
from instrument.files.measurement_set import MeasurementSet
from instrument.files.ms_frame import TO_CIRCULAR
from instrument.observe.sampling import Sampling, times_of
from instrument.units import Direction

pytest.importorskip("arcae", reason="the extra 'ms'")
spec = importlib.util.spec_from_file_location("small_set", Path(__file__).with_name("small_set.py"))
small_set = importlib.util.module_from_spec(spec)
spec.loader.exec_module(small_set)

STATIONS, TIMES, FREQ = 5, 4, np.array([140e6, 140.1e6, 140.2e6])
A, B = np.triu_indices(STATIONS, 1)


@pytest.fixture(scope="module")
def layout():
    names = ["CS001HBA0", "CS002HBA1", "CS017HBA0", "RS106HBA", "RS307HBA"]
    return instrument.load("telescopes", "lofar-hba", stations=names).layout()


CENTRE = (2.15, 0.84)


@pytest.fixture
def whole(layout):
    """Times (T,), station UVW (T, A, 3) of an Earth turned by 2.4e-6, and data (T, B, F, 4), float32 exactly."""
    rng = np.random.default_rng(3)
    time = 4861566000.0 + np.array([0, 10, 20, 50.0])  # a gap
    centre = Direction(*CENTRE)
    at = Sampling.build(layout, times_of(time), FREQ, *np.atleast_2d(CENTRE).T, centre)
    uvw = at.uvw_m @ Rotation.from_rotvec([1e-6, -1e-6, 2e-6]).as_matrix()
    data = (rng.standard_normal((TIMES, len(A), len(FREQ), 4, 2)).astype(np.float32) @ [1, 1j]).astype(np.complex64)
    return time, uvw, data.astype(complex)


def rows_of(whole, window=0):
    time, uvw, data = whole
    baseline = uvw[:, B] - uvw[:, A]  # position of antenna 2 minus that of 1
    n = TIMES * len(A)
    there = (np.repeat(time, len(A)), np.tile(A, TIMES), np.tile(B, TIMES), baseline.reshape(n, 3))
    return (*there, np.full(n, window), np.zeros(n, int)), data.reshape(n, len(FREQ), 4)


def read(path, **settings):
    blocks = list(MeasurementSet(path, **settings).blocks())
    assert len(blocks) == 1
    return blocks[0]


def test_rows_in_any_order_with_stations_swapped_are_the_same(tmp_path, layout, whole):
    rows, data = rows_of(whole)
    small_set.write(tmp_path / "a.MS", layout, rows, FREQ, data)
    plain = read(tmp_path / "a.MS")
    assert np.array_equal(np.moveaxis(plain.data, 1, 2).reshape(data.shape), data)
    assert np.abs(plain.uvw_m - (whole[1][:, A] - whole[1][:, B])).max() < 1e-8
    assert plain.at.own_uvw_m is not None and plain.given_uvw_m is None
    rng = np.random.default_rng(4)
    order, swapped = rng.permutation(len(data)), rng.random(len(data)) < 0.5
    time, one, two, uvw, window, field = (x[order] for x in rows)
    one, two = np.where(swapped, two, one), np.where(swapped, one, two)
    uvw, moved = np.where(swapped[:, None], -uvw, uvw), data[order].copy()
    moved[swapped] = moved[swapped][..., [0, 2, 1, 3]].conj()
    back = (slice(None), slice(None, None, -1))
    small_set.write(tmp_path / "b.MS", layout, (time, one, two, uvw, window, field), FREQ[::-1], moved[back])
    other = read(tmp_path / "b.MS")
    assert np.array_equal(other.data, plain.data) and np.array_equal(other.freq_hz, FREQ)
    assert np.abs(other.uvw_m - plain.uvw_m).max() < 1e-8


def test_missing_baselines_are_flagged_and_autocorrelations_are_left_out_and_said(tmp_path, layout, whole):
    rows, data = rows_of(whole)
    keep = np.ones(len(data), bool)
    keep[[3, 17]] = False
    auto = rows[1][:2].copy()
    rows = [np.concatenate([x[keep], x[:2]]) for x in rows]
    rows[2][-2:] = auto  # antenna 2 is antenna 1
    small_set.write(tmp_path / "a.MS", layout, rows, FREQ, np.concatenate([data[keep], data[:2]]))
    with pytest.warns(InstrumentWarning, match="2 rows are autocorrelations"):
        found = read(tmp_path / "a.MS")
    flag = np.broadcast_to(found.flag, found.data.shape[:3])[:, 0]
    assert np.argwhere(flag).tolist() == [[0, 3], [1, 7]]
    assert np.abs(found.uvw_m - (whole[1][:, A] - whole[1][:, B])).max() < 1e-8  # closing tells those that are missing


def test_uvw_that_do_not_close_stay_those_of_baselines(tmp_path, layout, whole):
    rows, data = rows_of(whole)
    rows[3][5] += 0.01
    small_set.write(tmp_path / "a.MS", layout, rows, FREQ, data)
    found = read(tmp_path / "a.MS")
    assert found.at.own_uvw_m is None and np.array_equal(-found.uvw_m.reshape(-1, 3), rows[3])
    with pytest.raises(InputError, match="do not close"):
        MeasurementSet(tmp_path / "a.MS").observation()


def test_circular_feeds_come_as_linear_ones(tmp_path, layout, whole):
    """RR = I + V, RL = Q + iU, LR = Q - iU, LL = I - V, and XX = I + Q, XY = U + iV."""
    rows, data = rows_of(whole)
    i, q, u, v = 3.0, 0.5, 0.25, -0.125
    data[:] = [i + v, q + 1j * u, q - 1j * u, i - v]
    small_set.write(tmp_path / "a.MS", layout, rows, FREQ, data, kinds=(5, 6, 7, 8), telescope="VLA")
    found = read(tmp_path / "a.MS")
    want = np.array([[i + q, u + 1j * v], [u - 1j * v, i - q]])
    assert np.abs(found.data - want).max() < 1e-6
    assert np.abs(TO_CIRCULAR @ TO_CIRCULAR.conj().T - np.eye(2)).max() < 1e-15


def test_two_correlations_leave_the_others_flagged(tmp_path, layout, whole):
    rows, data = rows_of(whole)
    small_set.write(tmp_path / "a.MS", layout, rows, FREQ, data[..., [0, 3]], kinds=(9, 12))
    found = read(tmp_path / "a.MS")
    assert found.flag.shape[3:] == (2, 2) and np.array_equal(found.flag[0, 0, 0], [[False, True], [True, False]])
    assert np.array_equal(found.data[0, :, 0, 0, 0], data[0, :, 0])


def test_weights_and_flags_are_those_of_correlations(tmp_path, layout, whole):
    rows, data = rows_of(whole)
    weight, flag = np.ones(data.shape), np.zeros(data.shape, bool)
    weight[1, 2] = [1, 2, 3, np.nan]
    flag[4, 0, 2] = True
    small_set.write(tmp_path / "a.MS", layout, rows, FREQ, data, flag=flag, weight=weight)
    found = read(tmp_path / "a.MS")
    assert np.array_equal(found.weight[0, 2, 1], [[1, 2], [3, 0]])
    assert np.array_equal(found.flag[0, 0, 4], [[False, False], [True, False]]) and found.flag.sum() == 1
    small_set.write(tmp_path / "b.MS", layout, rows, FREQ, data, weight=np.full(data.shape, 2.5), spectrum=False)
    assert np.all(read(tmp_path / "b.MS").weight == 2.5)


def test_windows_and_fields_are_chosen(tmp_path, layout, whole):
    rows, data = rows_of(whole)
    other = rows_of(whole, window=1)[0]
    rows = [np.concatenate(pair) for pair in zip(rows, other, strict=True)]
    small_set.write(tmp_path / "a.MS", layout, rows, FREQ, np.concatenate([data, 2 * data]), windows=2)
    with pytest.raises(InputError, match=r"holds 2 spectral windows \(0, 1\): choose one, window=0"):
        MeasurementSet(tmp_path / "a.MS")
    found = read(tmp_path / "a.MS", window=1)
    assert np.array_equal(found.freq_hz, FREQ + 1e6) and np.array_equal(found.data[0, :, 0].reshape(3, 4), 2 * data[0])
    with pytest.raises(InputError, match="no field 7: its rows are of 0"):
        MeasurementSet(tmp_path / "a.MS", window=1, field=7)
    one = MeasurementSet(tmp_path / "a.MS", window=1)
    one.write("MODEL_DATA", [found])
    with pytest.raises(InputError, match="choose one"):
        MeasurementSet(tmp_path / "a.MS", column="MODEL_DATA")
    assert np.array_equal(read(tmp_path / "a.MS", window=1, column="MODEL_DATA").data, found.data)
    assert not read(tmp_path / "a.MS", window=0, column="MODEL_DATA").data.any()


def test_columns_come_back_to_the_bit_in_blocks_of_any_size(tmp_path, layout, whole, monkeypatch):
    rows, data = rows_of(whole)
    rng = np.random.default_rng(5)
    order = rng.permutation(len(data))
    small_set.write(tmp_path / "a.MS", layout, [x[order] for x in rows], FREQ, data[order])
    one = MeasurementSet(tmp_path / "a.MS")
    plain = next(one.blocks())
    monkeypatch.setattr(by_rows, "BLOCK_BYTES", 64 * len(A) * len(FREQ) * 2)
    assert [len(b.at.slots_s) for b in one.blocks()] == [2, 2]
    one.write("TWICE", (b.with_data(2 * b.data) for b in one.blocks()))
    twice = list(MeasurementSet(tmp_path / "a.MS", column="TWICE").blocks())
    assert np.array_equal(np.concatenate([b.data for b in twice]), 2 * plain.data)
    parts = [plain.block(slice(0, 4), slice(f, f + 1)) for f in range(3)]  # channel by channel
    one.write("TWICE", parts, overwrite=True)
    assert np.array_equal(next(MeasurementSet(tmp_path / "a.MS", column="TWICE").blocks()).data, plain.data[:2])


def test_a_write_that_fails_leaves_the_set_as_it_was(tmp_path, layout, whole):
    rows, data = rows_of(whole)
    small_set.write(tmp_path / "a.MS", layout, rows, FREQ, data)
    one, plain = MeasurementSet(tmp_path / "a.MS"), read(tmp_path / "a.MS")

    def broken():
        yield plain.block(slice(0, 2), slice(None))
        raise RuntimeError("half-way")

    with pytest.raises(RuntimeError, match="half-way"):
        one.write("MODEL_DATA", broken())
    with pytest.raises(InputError, match="has a column DATA: name another one"):
        one.write("DATA", [plain])
    with pytest.raises(InputError, match="other times"):
        one.write("MODEL_DATA", [plain.block(slice(0, 2), slice(None))])
    with pytest.raises(InputError, match="UVW is no column for visibilities"):
        one.write("UVW", [plain], overwrite=True)
    with pytest.raises(InputError, match="no column MODEL_DATA: it has DATA"):
        MeasurementSet(tmp_path / "a.MS", column="MODEL_DATA")
    assert sorted(p.name for p in tmp_path.iterdir()) == ["a.MS"]


def test_beams_taken_out_are_known_by_the_keywords_of_lofar(tmp_path, layout, whole):
    rows, data = rows_of(whole)
    where = {"type": "direction", "refer": "J2000", "m0": {"value": 2.15, "unit": "rad"},
             "m1": {"value": 0.84, "unit": "rad"}}  # fmt: skip
    words = {"LOFAR_APPLIED_BEAM_MODE": "Full", "LOFAR_APPLIED_BEAM_DIR": where}
    small_set.write(tmp_path / "a.MS", layout, rows, FREQ, data, keywords=words)
    state = MeasurementSet(tmp_path / "a.MS").beam_state
    assert state.removed == "centre" and state.towards == (2.15, 0.84) and not state.other
    small_set.write(tmp_path / "b.MS", layout, rows, FREQ, data, keywords={"LOFAR_APPLIED_BEAM_MODE": "Full"})
    with pytest.raises(FileError, match="does not say towards where"):
        MeasurementSet(tmp_path / "b.MS")


def test_bad_sets_are_one_line(tmp_path, layout, whole):
    rows, data = rows_of(whole)
    with pytest.raises(FileError, match="there is no such Measurement Set"):
        MeasurementSet(tmp_path / "none.MS")
    (tmp_path / "empty.MS").mkdir()
    with pytest.raises(FileError, match="no Measurement Set: it is to be a folder"):
        MeasurementSet(tmp_path / "empty.MS")
    small_set.write(tmp_path / "i.MS", layout, rows, FREQ, data[..., :1], kinds=(1,))
    with pytest.raises(InputError, match="has correlations I: this takes XX, YY"):
        MeasurementSet(tmp_path / "i.MS")
    small_set.write(tmp_path / "twice.MS", layout, [np.concatenate([x, x[:1]]) for x in rows], FREQ,
                    np.concatenate([data, data[:1]]))  # fmt: skip
    with pytest.raises(FileError, match="a baseline has two rows at time 0"):
        list(MeasurementSet(tmp_path / "twice.MS").blocks())
    with pytest.raises(InputError, match="column UVW holds double, not visibilities"):
        MeasurementSet(tmp_path / "twice.MS", column="UVW")
    small_set.write(tmp_path / "cut.MS", layout, rows, FREQ, data)
    (tmp_path / "cut.MS" / "ANTENNA" / "table.dat").unlink()
    with pytest.raises(FileError) as told:
        MeasurementSet(tmp_path / "cut.MS")
    assert "\n" not in str(told.value) and "ANTENNA" in str(told.value)
    for file in (tmp_path / "twice.MS").glob("table.f*"):
        file.write_bytes(file.read_bytes()[: file.stat().st_size // 3])
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        with pytest.raises(FileError) as told:
            list(MeasurementSet(tmp_path / "twice.MS").blocks())
    assert "\n" not in str(told.value)


def test_a_scene_is_predicted_with_the_times_and_uvw_of_the_set(tmp_path, layout, whole):
    from instrument import PointSky, Scene

    lofar = instrument.load("telescopes", "lofar-hba", stations=list(layout.names), beam=None)
    rows, data = rows_of(whole)
    small_set.write(tmp_path / "a.MS", layout, rows, FREQ, data)
    one = MeasurementSet(tmp_path / "a.MS")
    at = (np.array([2.16]), np.array([0.83]))
    sky = PointSky(names=("a",), ra_rad=at[0], dec_rad=at[1], stokes_jy=np.array([[2.0, 0, 0, 0]]))
    predicted = Scene(instrument=lofar, sky=sky, observation=one.observation()).plan().run()
    l, m, n = replace(predicted.at.towards(*at)).lmn[0]
    waves = predicted.uvw_m[:, None] * (FREQ[:, None, None] / 299792458.0)
    want = 2.0 * np.exp(-2j * np.pi * (waves @ np.array([l, m, n])))  # station 1 minus station 2
    assert np.abs(predicted.data[..., 0, 0] - want).max() < 1e-8
    one.write("MODEL_DATA", predicted)
    assert np.abs(read(tmp_path / "a.MS", column="MODEL_DATA").data - predicted.data).max() < 1e-6


def test_uvw_of_another_sign_or_centre_are_said_and_those_that_are_not_numbers_refused(tmp_path, layout, whole):
    rows, data = rows_of(whole)
    time, one, two, uvw, window, field = rows
    for name, other, said in (
        ("sign", -uvw, "UVW are antenna 1 minus 2"),
        ("centre", uvw[:, [1, 2, 0]], "% off those of its"),
    ):
        small_set.write(tmp_path / name, layout, (time, one, two, other, window, field), FREQ, data)
        with pytest.warns(InstrumentWarning, match=said):
            read(tmp_path / name)
    with warnings.catch_warnings():
        warnings.simplefilter("error")  # half an arcsecond is what programs differ by
        small_set.write(tmp_path / "a.MS", layout, rows, FREQ, data)
        read(tmp_path / "a.MS")
    uvw[7, 1] = np.nan
    small_set.write(tmp_path / "nan.MS", layout, rows, FREQ, data)
    with pytest.raises(FileError, match="UVW is not finite"):
        read(tmp_path / "nan.MS")


def test_a_column_says_which_beam_has_been_taken_out_and_is_of_the_phase_centre(tmp_path, layout, whole):
    rows, data = rows_of(whole)
    small_set.write(tmp_path / "a.MS", layout, rows, FREQ, data)
    one, plain = MeasurementSet(tmp_path / "a.MS"), read(tmp_path / "a.MS")
    lofar = instrument.load("telescopes", "lofar-hba", stations=list(layout.names))
    one.write("CORRECTED_DATA", [plain.without_beam(lofar)])
    state = MeasurementSet(tmp_path / "a.MS", column="CORRECTED_DATA").beam_state
    assert state.removed == "centre" and np.allclose(state.towards, CENTRE, atol=1e-12)
    one.write("CORRECTED_DATA", [plain], overwrite=True)
    assert MeasurementSet(tmp_path / "a.MS", column="CORRECTED_DATA").beam_state.removed == "nothing"
    with pytest.raises(InputError, match="about another phase centre"):
        one.write("MODEL_DATA", [plain.shifted_to("8h20m +50d")])


def test_one_time_one_baseline_and_all_flagged_are_read(tmp_path, layout, whole):
    rows, data = rows_of(whole)
    small_set.write(
        tmp_path / "a.MS", layout, [x[:1] for x in rows], FREQ, data[:1], flag=np.ones(data[:1].shape, bool)
    )
    found = read(tmp_path / "a.MS")
    assert found.data.shape == (1, 3, 1, 2, 2) and found.flag.all() and not found.effective_weight.any()
    assert np.abs(found.uvw_m[0, 0] + rows[3][0]).max() < 1e-8
