"""A set that is created holds what it was given, whole or not there, and keeps what stood there until then."""

from dataclasses import replace

import numpy as np
import pytest
from astropy import units as u

import instrument
from instrument import MeasurementSet, Observation, Visibilities
from instrument.errors import FileError, InputError
from instrument.observe.sampling import Sampling
from instrument.units import Direction

pytest.importorskip("arcae")
STATIONS = ("CS001HBA0", "CS002HBA1", "CS003HBA0", "RS106HBA")
NIGHT = Observation(
    phase_centre="08h13m36.0s +48d13m03s",
    transit="2012-12-07",
    duration=50 * u.s,
    interval=10 * u.s,
    frequencies=[150.0, 150.2, 150.6] * u.MHz,
    channel_width=0.2 * u.MHz,
)


@pytest.fixture(scope="module")
def lofar():
    return instrument.load("telescopes", "lofar-hba", stations=STATIONS, tile_pointing="08h10m00s +48d00m00s")


@pytest.fixture(scope="module")
def given(lofar):
    """Noise that single precision holds, weights and flags of every correlation."""
    rng = np.random.default_rng(3)
    layout, centre = lofar.layout(), NIGHT.phase_centre
    at = Sampling.build(layout, NIGHT.times(layout), NIGHT.freq_hz, centre.ra_rad, centre.dec_rad, centre)
    one, two = layout.baselines
    shape = (5, 3, len(one), 2, 2)
    data = rng.normal(size=(*shape, 2)).astype(np.float32).astype(float) @ [1, 1j]
    weight = rng.integers(0, 4, shape).astype(float)
    return Visibilities(data, at, one, two, 10.0, 0.2e6, weight, rng.random(shape) < 0.2)


def whole(blocks):
    """All blocks as one, of times alone."""
    blocks = list(blocks)
    fields = {n: np.concatenate([getattr(b, n) for b in blocks]) for n in ("data", "weight", "flag", "uvw_m")}
    return fields | {"slots": np.concatenate([b.at.slots_s for b in blocks]), "freq": blocks[0].freq_hz}


def test_a_set_holds_what_it_was_given_to_the_last_bit(tmp_path, lofar, given):
    made = MeasurementSet.create(tmp_path / "a.MS", given, instrument=lofar)
    found, block = whole(made.blocks()), next(made.blocks())
    for name in ("data", "weight", "flag"):
        assert np.array_equal(found[name], getattr(given, name)), name
    assert np.array_equal(found["slots"], given.at.slots_s) and np.array_equal(found["freq"], given.freq_hz)
    assert np.abs(found["uvw_m"] - given.uvw_m).max() < 1e-8  # differences of places 3.8e6 m from the Earth's centre
    assert block.layout.names == STATIONS and np.array_equal(block.layout.positions_m, given.layout.positions_m)
    assert np.array_equal(block.layout.axes, given.layout.axes)
    assert tuple(block.phase_centre) == pytest.approx(tuple(given.phase_centre), abs=1e-15)
    assert np.all(block.interval_s == 10.0) and np.all(block.width_hz == 0.2e6)
    assert made.frame.telescope == "LOFAR" and str(made.beam_state) == str(given.beam_state)


def test_blocks_of_some_times_and_channels_make_the_same_set(tmp_path, given):
    parts = [given.block(t, f) for t in (slice(0, 2), slice(2, 5)) for f in (slice(0, 1), slice(1, 3))]
    found = whole(MeasurementSet.create(tmp_path / "a.MS", parts).blocks())
    assert np.array_equal(found["data"], given.data) and np.array_equal(found["flag"], given.flag)


def test_uvw_of_a_file_and_a_beam_that_was_taken_out_go_with_it(tmp_path, given, lofar):
    from instrument.beam_state import BeamState

    moved = replace(given, at=replace(given.at, own_uvw_m=given.at.uvw_m * 1.001))
    towards = replace(moved, beam_state=BeamState("centre", Direction(2.1, 0.8), None, False))
    made = MeasurementSet.create(tmp_path / "a.MS", towards, instrument=lofar)
    assert made.beam_state.removed == "centre" and made.beam_state.towards == pytest.approx((2.1, 0.8))
    assert np.abs(next(made.blocks()).uvw_m - moved.uvw_m).max() < 1e-8


def test_weights_stand_in_every_column_that_programs_read(tmp_path, given):
    from arcae.lib.arrow_tables import Table

    MeasurementSet.create(tmp_path / "a.MS", given)
    with Table.from_filename(str(tmp_path / "a.MS")) as table:
        weight, sigma, spectrum = (table.getcol(name) for name in ("WEIGHT", "SIGMA", "WEIGHT_SPECTRUM"))
        assert "SIGMA_SPECTRUM" not in table.columns()  # one of ones would undo the weights
        assert np.array_equal(table.getcol("TIME"), table.getcol("TIME_CENTROID"))
        assert np.all(table.getcol("ANTENNA1") < table.getcol("ANTENNA2"))
    assert weight == pytest.approx(spectrum.mean(axis=1)) and (weight == 0).any()
    assert sigma**-2.0 == pytest.approx(weight, rel=1e-6, abs=1e-37) and np.isfinite(sigma).all()


def test_the_tables_of_lofar_are_those_of_its_stations(tmp_path, given, lofar):
    from arcae.lib.arrow_tables import Table

    path = tmp_path / "a.MS"
    MeasurementSet.create(path, given, instrument=lofar)
    tiles = next(term.levels for term in lofar.chain().terms if hasattr(term, "levels"))
    with Table.from_filename(f"{path}::LOFAR_ANTENNA_FIELD") as table:
        assert np.array_equal(table.getcol("ELEMENT_OFFSET"), tiles[0].offsets_m)
        assert list(table.getcol("NAME")) == ["HBA0", "HBA1", "HBA0", "HBA"]
    with Table.from_filename(f"{path}::FIELD") as table:
        ra, dec = table.getcol("LOFAR_TILE_BEAM_DIR")[0, 0]
        assert np.degrees([ra, dec]) == pytest.approx([122.5, 48.0])
        assert table.getcol("DELAY_DIR")[0, 0] == pytest.approx(tuple(given.phase_centre))
    MeasurementSet.create(tmp_path / "b.MS", given)
    assert not (tmp_path / "b.MS" / "LOFAR_ANTENNA_FIELD").exists()


def failing(given):
    yield given.block(slice(0, 2), slice(None))
    raise ValueError("no more")


def test_a_set_that_is_there_stays_until_the_new_one_is_whole(tmp_path, given):
    path = tmp_path / "a.MS"
    MeasurementSet.create(path, given)
    other = replace(given, data=2 * given.data)
    with pytest.raises(InputError, match="exists: give overwrite=True"):
        MeasurementSet.create(path, other)
    with pytest.raises(ValueError, match="no more"):
        MeasurementSet.create(path, failing(other), overwrite=True)
    assert np.array_equal(whole(MeasurementSet(path).blocks())["data"], given.data)
    MeasurementSet.create(path, other, overwrite=True)
    assert np.array_equal(whole(MeasurementSet(path).blocks())["data"], other.data)
    assert sorted(p.name for p in tmp_path.iterdir()) == ["a.MS"]


def test_what_is_no_set_is_never_replaced(tmp_path, given):
    (tmp_path / "thesis").mkdir()
    (tmp_path / "thesis" / "chapter.tex").write_text("words")
    with pytest.raises(InputError, match="thesis exists and is something else"):
        MeasurementSet.create(tmp_path / "thesis", given, overwrite=True)
    with pytest.raises(FileError, match="cannot be written"):
        MeasurementSet.create(tmp_path / "no" / "such" / "folder.MS", given)
    assert (tmp_path / "thesis" / "chapter.tex").read_text() == "words"
