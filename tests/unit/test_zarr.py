"""Visibilities in Zarr: the same as in HDF5 to the last bit, whole or not at all."""

import sys
from dataclasses import replace

import numpy as np
import pytest
from astropy import units as u

import instrument
from instrument import InputError, Observation, PointSky, Scene, Visibilities, VisibilityFile, store, zarr_tree
from instrument.errors import FileError

zarr = pytest.importorskip("zarr", reason="the extra 'zarr'")
STATIONS = ["CS001HBA0", "CS001HBA1", "RS106HBA"]


@pytest.fixture(scope="module")
def plan():
    night = Observation(
        phase_centre="08h13m36.0s +48d13m03s", transit="2012-12-07", duration=60 * u.s, interval=10 * u.s,
        frequencies=[150, 150.2, 150.4] * u.MHz,
    )  # fmt: skip
    sky = PointSky(names=("a",), ra_rad=[2.15], dec_rad=[0.845], stokes_jy=np.array([[3.0, 1.0, 0.5, 0.0]]))
    lofar = instrument.load("telescopes", "lofar-hba", stations=STATIONS)
    return replace(Scene(instrument=lofar, sky=sky, observation=night).plan(), block_shape=(2, 2))


def state(vis):
    """All of it, as bytes."""
    at = vis.at
    arrays = [vis.data, vis.weight, vis.flag, vis.antenna1, vis.antenna2, vis.interval_s, vis.width_hz, vis.given_uvw_m,
              at.slots_s, at.freq_hz, at.ra_rad, at.dec_rad, at.earth.matrices, at.earth.velocity, at.own_uvw_m,
              vis.uvw_m]  # fmt: skip
    texts = vis.layout.to_json(), repr(vis.beam_state), repr(vis.beam_state.beams), repr(at.centre), repr(at.steered)
    return [None if x is None else (x.shape, str(x.dtype), x.tobytes()) for x in arrays], texts


def test_zarr_and_hdf5_are_the_same_to_the_last_bit(plan, tmp_path):
    vis = plan.run()
    rng = np.random.default_rng(1)
    odd = vis.data.copy()
    odd[0], odd[1], odd[2, 0, 0, 0, 0] = -0.0, np.nan, complex(np.inf, -0.0)
    weight, flag = rng.uniform(0.1, 2, (6, 1, 3)), rng.uniform(size=(6, 3, 3, 2, 2)) < 0.2
    uneven = replace(vis, interval_s=np.arange(1.0, 7), width_hz=[1e5, 2e5, 1e5], given_uvw_m=vis.uvw_m * 1.5)
    own = replace(vis, at=replace(vis.at, own_uvw_m=vis.at.uvw_m * 1.001))
    for k, one in enumerate((vis, vis.with_data(odd), uneven, vis.weighted(weight).flagged(flag), own)):
        for name in (f"{k}.h5", f"{k}.zarr"):
            one.save(tmp_path / name)
            assert state(Visibilities.open(tmp_path / name)) == state(one)


def test_blocks_are_written_one_by_one_and_read_in_parts(plan, tmp_path, monkeypatch):
    plan.save(tmp_path / "a.zarr")
    whole = plan.run()
    assert state(Visibilities.open(tmp_path / "a.zarr")) == state(whole)
    part = Visibilities.open(tmp_path / "a.zarr", times=slice(1, 5, 2), channels=slice(2, 3))
    assert part.data.tobytes() == whole.data[1:5:2, 2:3].tobytes() and part.at.slots_s.tolist() == whole.at.slots_s[
        1:5:2
    ].tolist()  # fmt: skip
    monkeypatch.setattr("instrument.visibility_sets.BLOCK_BYTES", 64 * 3 * 2)
    file = VisibilityFile(tmp_path / "a.zarr")
    assert [b.data.shape[:3] for b in file.blocks()] == [(1, 2, 3), (1, 1, 3)] * 6 and "a.zarr: 6 times" in repr(file)
    file.save(tmp_path / "b.h5")
    assert state(Visibilities.open(tmp_path / "b.h5")) == state(whole)


def test_weights_that_differ_from_block_to_block_become_whole(plan, tmp_path):
    one = plan.run()
    for odd in range(3):
        blocks = [one.block(slice(k, k + 2), slice(None)) for k in (0, 2, 4)]
        blocks[odd] = replace(blocks[odd].weighted(np.full((1, 1, 3), 2.0)), interval_s=[5.0, 7.0])
        for name in (f"{odd}.h5", f"{odd}.zarr"):
            store.write(tmp_path / name, blocks)
        both = [state(Visibilities.open(tmp_path / f"{odd}{suffix}")) for suffix in (".h5", ".zarr")]
        assert both[0] == both[1]


def test_nothing_is_left_of_what_fails_and_nothing_is_overwritten_unasked(plan, tmp_path):
    vis = plan.run()
    half = vis.block(slice(0, 3), slice(None))
    with pytest.raises(InputError, match="time 0 and channel 0 are in two blocks"):
        store.write(tmp_path / "a.zarr", [half, half])
    assert not list(tmp_path.iterdir())
    vis.save(tmp_path / "a.zarr")
    with pytest.raises(InputError, match=r"a\.zarr exists"):
        half.save(tmp_path / "a.zarr")
    with pytest.raises(InputError, match="in two blocks"):
        store.write(tmp_path / "a.zarr", [half, half], overwrite=True)
    assert state(Visibilities.open(tmp_path / "a.zarr")) == state(vis)
    half.save(tmp_path / "a.zarr", overwrite=True)
    assert state(Visibilities.open(tmp_path / "a.zarr")) == state(half)
    (tmp_path / "mine.zarr").mkdir()
    (tmp_path / "mine.zarr" / "thesis.tex").write_text("")
    with pytest.raises(InputError, match=r"mine\.zarr exists"):
        vis.save(tmp_path / "mine.zarr", overwrite=True)


def test_other_folders_and_broken_ones_are_one_line(plan, tmp_path, monkeypatch):
    vis = plan.run()
    vis.save(tmp_path / "a.zarr")
    zarr.open_group(tmp_path / "other.zarr", mode="w").create_array("x", data=np.zeros(3))
    (tmp_path / "empty.zarr").mkdir()
    (tmp_path / "file.zarr").write_text("text")
    group = zarr.open_group(tmp_path / "a.zarr")
    del group["data"]
    group.create_array("data", shape=(6, 3, 3, 2, 1 << 40), chunks=(1, 1, 1, 1, 1), dtype=complex)
    for name, said in (
        ("other", "is no file of visibilities .*: it is another Zarr folder"),
        ("empty", "is not a readable file of visibilities"),
        ("file", "is no folder"),
        ("none", "does not exist"),
        ("a", "'data' has shape"),
    ):
        with pytest.raises(FileError, match=said) as error:
            Visibilities.open(tmp_path / f"{name}.zarr")
        assert "\n" not in str(error.value)
    monkeypatch.setitem(sys.modules, "zarr", None)
    for call in (lambda: vis.save(tmp_path / "b.zarr"), lambda: Visibilities.open(tmp_path / "a.zarr")):
        with pytest.raises(InputError) as error:
            call()
        assert str(error.value) == zarr_tree.MISSING and "pip install 'instrument[zarr]'" in zarr_tree.MISSING
