"""calfits: gains that pyuvdata reads back, and divides the same data by with the same result."""

import numpy as np
import pytest
from astropy import units as u

import instrument
from instrument import Direction, InputError, JonesTable, Observation, PointSky, Scene, UVFile, write_calfits, write_uv

pyuvdata = pytest.importorskip("pyuvdata", reason="the extra 'uv'")
STATIONS = ["CS001HBA0", "CS002HBA1", "CS017HBA0", "RS106HBA"]


@pytest.fixture(scope="module")
def vis():
    lofar = instrument.load("telescopes", "lofar-hba", stations=STATIONS, beam=None)
    night = Observation(
        phase_centre=Direction(2.15, 0.84), start="2014-03-01T20:00:00", duration=50 * u.s, interval=10 * u.s,
        frequencies=[150, 150.1, 150.2] * u.MHz, channel_width=0.1 * u.MHz,
    )  # fmt: skip
    sky = PointSky(names=("a",), ra_rad=[2.162], dec_rad=[0.846], stokes_jy=np.array([[4.0, 1.0, 0, 0]]))
    return Scene(instrument=lofar, sky=sky, observation=night).plan().run()


@pytest.fixture
def term(vis):
    rng = np.random.default_rng(5)
    values = np.zeros((5, 3, 4, 2, 2), complex)
    values[..., [0, 1], [0, 1]] = 1 + 0.3 * (rng.standard_normal((5, 3, 4, 2, 2)) @ [1, 1j])
    return JonesTable(values=values, slots_s=vis.at.slots_s, freq_hz=vis.freq_hz, stations=tuple(STATIONS))


def test_gains_are_read_back_and_correct_the_same_data_alike(tmp_path, vis, term):
    write_calfits(tmp_path / "g.calfits", term, vis.at)
    cal = pyuvdata.UVCal.from_file(str(tmp_path / "g.calfits"))
    gains = np.moveaxis(term.values[..., [0, 1], [0, 1]], 2, 0).swapaxes(1, 2)
    assert np.array_equal(cal.gain_array, gains) and not cal.flag_array.any()
    assert list(cal.telescope.antenna_names) == STATIONS and cal.gain_convention == "divide"
    corrupted = vis.corrupted(term)
    write_uv(tmp_path / "v.uvh5", corrupted)
    uv = pyuvdata.UVData.from_file(str(tmp_path / "v.uvh5"))
    pyuvdata.utils.uvcalibrate(uv, cal)
    uv.write_uvh5(str(tmp_path / "c.uvh5"))
    (theirs,) = UVFile(tmp_path / "c.uvh5").blocks()
    assert np.abs(theirs.data - corrupted.corrected(term).data).max() < 1e-12
    assert np.abs(theirs.data - vis.data).max() < 1e-12 < 0.1 < np.abs(corrupted.data - vis.data).max()


def test_constant_gains_stand_at_all_times_and_channels_and_lost_ones_are_flagged(tmp_path, vis, term):
    values = term.values[:1, :1].copy()
    values[0, 0, 2] = np.nan
    one = JonesTable(values=values, slots_s=[0.0], freq_hz=[0.0], stations=tuple(STATIONS))
    write_calfits(tmp_path / "g.calfits", one, vis.at)
    cal = pyuvdata.UVCal.from_file(str(tmp_path / "g.calfits"))
    assert cal.gain_array.shape == (4, 3, 5, 2) and np.ptp(cal.gain_array[0, :, :, 0]) == 0
    assert cal.flag_array.all(axis=(1, 2, 3)).tolist() == [False, False, True, False] and cal.flag_array.sum() == 30


def test_what_calfits_cannot_hold_is_refused_and_nothing_is_left(tmp_path, vis, term):
    off = term.values.copy()
    off[..., 0, 1] = 0.01
    with pytest.raises(InputError, match="would lose entries"):
        write_calfits(tmp_path / "g.calfits", term.with_fields(values=off), vis.at)
    uneven = term.with_fields(slots_s=vis.at.slots_s + np.array([0, 0, 0, 0, 5.0]))
    with pytest.raises(InputError, match="evenly spaced times"):
        write_calfits(tmp_path / "g.calfits", uneven, vis.at)
    narrow = term.with_fields(values=term.values[:, :1], freq_hz=term.freq_hz[:1])
    with pytest.raises(InputError, match="give channel_width="):
        write_calfits(tmp_path / "g.calfits", narrow, vis.at)
    assert not list(tmp_path.iterdir())
    write_calfits(tmp_path / "g.calfits", narrow, vis.at, channel_width=1e5 * u.Hz)
    with pytest.raises(InputError, match="exists: give overwrite=True"):
        write_calfits(tmp_path / "g.calfits", term, vis.at)
