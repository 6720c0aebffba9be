"""The unit of a column of visibilities: what is in mJy is read and written as such, what is no flux is one line."""

import importlib.util
import json
import shutil
import warnings
from pathlib import Path

import numpy as np
import pytest

import instrument
from instrument import MeasurementSet
from instrument.cli import main
from instrument.errors import InputError, InstrumentWarning
from instrument.observe.sampling import Sampling, times_of
from instrument.units import Direction

arrow = pytest.importorskip("arcae.lib.arrow_tables")
spec = importlib.util.spec_from_file_location("small_set", Path(__file__).parents[1] / "unit" / "small_set.py")
small_set = importlib.util.module_from_spec(spec)
spec.loader.exec_module(small_set)
NAMES = ["CS001HBA0", "CS002HBA1", "CS017HBA0"]
FREQ = np.array([140e6, 140.1e6])
TIME = 4861566000.0 + np.array([0, 10.0])
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


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    """A set with random data and weights in the unit of the definition, and these."""
    layout = instrument.load("telescopes", "lofar-hba", stations=NAMES).layout()
    at = Sampling.build(layout, times_of(TIME), FREQ, np.array([2.15]), np.array([0.84]), Direction(2.15, 0.84))
    one, two = np.triu_indices(3, 1)
    uvw = (at.uvw_m[:, two] - at.uvw_m[:, one]).reshape(6, 3)
    rows = [np.repeat(TIME, 3), np.tile(one, 2), np.tile(two, 2), uvw, *np.zeros((2, 6), int)]
    rng = np.random.default_rng(3)
    data = (rng.normal(size=(6, 2, 4)) + 1j * rng.normal(size=(6, 2, 4))).astype(np.complex64)
    path = tmp_path_factory.mktemp("made") / "a.MS"
    small_set.write(
        path, layout, rows, FREQ, data, telescope="LOFAR", weight=rng.uniform(1, 2, (6, 2, 1)) + 0 * data.real
    )
    return path


@pytest.fixture
def copied(made, tmp_path):
    shutil.copytree(made, tmp_path / "a.MS")
    (tmp_path / "s.toml").write_text(SCENE)
    return tmp_path / "a.MS"


def named(path, **words):
    with arrow.Table.from_filename(str(path), readonly=False) as table:
        table.putcolkeywords("DATA", words)
    return path


def cells(path, column):
    with arrow.Table.from_filename(str(path)) as table:
        return np.array(table.getcol(column)), dict(table.getcolkeywords(column))


def block(path, column="DATA"):
    return next(MeasurementSet(path, column).blocks())


@pytest.mark.parametrize(
    ("words", "factor"),
    [
        ({"UNIT": "mJy"}, 1e-3),
        ({"QuantumUnits": ["mJy"]}, 1e-3),
        ({"QuantumUnits": ["mJy"] * 4}, 1e-3),
        ({"UNIT": "W/(m^2 Hz)"}, 1e26),
        ({"UNIT": "Jy"}, 1.0),
        ({"UNIT": "JY"}, 1.0),
        ({"UNIT": ""}, 1.0),
    ],
)
def test_data_come_in_jy_with_weights_of_their_own_inverse_squares(made, copied, words, factor):
    plain, found = block(made), block(named(copied, **words))
    np.testing.assert_allclose(found.data, factor * plain.data, rtol=1e-15)
    np.testing.assert_allclose(found.weight, plain.weight / factor**2, rtol=1e-15)
    assert np.array_equal(found.flag, plain.flag)


def test_a_column_that_is_there_keeps_its_unit_and_a_new_one_is_in_jy(copied):
    raw = cells(named(copied, UNIT="mJy"), "DATA")[0]
    one = MeasurementSet(copied)
    one.write("NEW", one)
    values, words = cells(copied, "NEW")
    np.testing.assert_allclose(values, 1e-3 * raw, rtol=1e-6)
    assert words["UNIT"] == "Jy"
    with warnings.catch_warnings(action="error"):
        one.write("DATA", MeasurementSet(copied, "NEW"), overwrite=True)
    values, words = cells(copied, "DATA")
    np.testing.assert_allclose(values, raw, rtol=1e-6)
    assert words["UNIT"] == "mJy"


def test_a_prediction_into_a_column_in_mjy_is_read_as_the_flux_it_is(copied, tmp_path):
    named(copied, UNIT="mJy")
    words = [str(tmp_path / "s.toml"), "--data", str(copied), "--out", str(tmp_path / "o")]
    assert main(["predict", *words]) == 0
    assert main(["predict", *words, "--into", "DATA", "--force"]) == 0
    np.testing.assert_allclose(block(copied).data, block(copied, "MODEL_DATA").data, rtol=1e-6)
    np.testing.assert_allclose(cells(copied, "DATA")[0], 1e3 * cells(copied, "MODEL_DATA")[0], rtol=1e-6)
    assert main(["subtract", *words, "--force"]) == 0
    assert np.abs(block(copied, "SUBTRACTED_DATA").data).max() < 1e-5


@pytest.mark.parametrize(
    ("words", "line"),
    [
        ({"UNIT": "K"}, "DATA is in 'K', which is no unit of Jy: convert the set"),
        ({"UNIT": "counts"}, "DATA is in 'counts', which is no unit of Jy"),
        ({"UNIT": "nonsense"}, "DATA is in 'nonsense', which is no unit of Jy"),
        ({"UNIT": "10**99999999 Jy"}, "which is no unit of Jy"),
        ({"QuantumUnits": ["Jy", "mJy", "mJy", "Jy"]}, "DATA has units of its correlations, Jy, mJy: write Jy"),
        ({"VariableUnits": "UNITS"}, "DATA has a unit of its own in each row: write it in Jy"),
    ],
)
def test_what_is_no_flux_is_one_line_when_read_and_when_written_into(copied, tmp_path, capsys, words, line):
    one = MeasurementSet(copied)
    one.write("NEW", one)
    raw = cells(named(copied, **words), "DATA")[0]
    with pytest.raises(InputError) as caught:
        MeasurementSet(copied)
    assert line in str(caught.value) and "\n" not in str(caught.value)
    with pytest.raises(InputError, match="DATA"):
        MeasurementSet(copied, "NEW").write("DATA", MeasurementSet(copied, "NEW"), overwrite=True)
    for more in ([], ["--column", "NEW", "--into", "DATA", "--force"]):
        verb = [str(tmp_path / "s.toml"), "--data", str(copied), "--out", str(tmp_path / "o"), *more]
        assert main(["subtract", *verb]) == 2
        said = capsys.readouterr().err.strip().splitlines()
        assert len(said) == 1 and line in said[0]
    assert np.array_equal(cells(copied, "DATA")[0], raw) and not (tmp_path / "o").exists()


def test_what_is_not_calibrated_is_taken_as_jy_and_said(made, copied):
    with pytest.warns(InstrumentWarning, match="DATA: its visibilities are not calibrated: they are taken as Jy"):
        assert np.array_equal(block(named(copied, UNIT="uncalib")).data, block(made).data)


def test_a_set_of_version_4_has_the_unit_that_its_attributes_say(made, tmp_path):
    pytest.importorskip("xarray")
    pytest.importorskip("zarr")
    instrument.write_msv4(tmp_path / "a.zarr", MeasurementSet(made))
    plain = next(instrument.Msv4File(tmp_path / "a.zarr").blocks())
    for unit, factor in (("mJy", 1e-3), (["mJy"], 1e-3), ("K", None)):
        for file in (tmp_path / "a.zarr" / "set" / "VISIBILITY" / ".zattrs", tmp_path / "a.zarr" / ".zmetadata"):
            told = json.loads(file.read_text())
            found = told["metadata"]["set/VISIBILITY/.zattrs"] if "metadata" in told else told
            found["units"] = unit
            file.write_text(json.dumps(told))
        if factor is None:
            with pytest.raises(InputError, match="VISIBILITY is in 'K', which is no unit of Jy"):
                instrument.Msv4File(tmp_path / "a.zarr")
        else:
            block = next(instrument.Msv4File(tmp_path / "a.zarr").blocks())
            np.testing.assert_allclose(block.data, factor * plain.data, rtol=1e-15)
