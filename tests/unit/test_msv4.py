"""MSv4 through xarray and Zarr: what comes back to the last bit, the phase of a source, sets of others, bad input."""

import sys
from dataclasses import replace

import numpy as np
import pytest
from astropy import units as u

import instrument
from instrument import Direction, InputError, Msv4File, Observation, PointSky, Scene, msv4, write_msv4
from instrument.beam_state import BeamState
from instrument.errors import FileError, InstrumentWarning
from instrument.files import by_rows
from instrument.files.ms_frame import TO_CIRCULAR

xarray = pytest.importorskip("xarray", reason="the extra 'xarray'")
zarr = pytest.importorskip("zarr", reason="the extra 'xarray'")
STATIONS = ["CS001HBA0", "CS002HBA1", "CS017HBA0", "RS106HBA"]
CENTRE, OFF = Direction(2.15, 0.84), (2.162, 0.846)


@pytest.fixture(scope="module")
def made():
    """Visibilities of one polarized source off the centre, with weights and flags of correlations, -0.0 and NaN."""
    lofar = instrument.load("telescopes", "lofar-hba", stations=STATIONS, beam=None)
    night = Observation(
        phase_centre=CENTRE, start="2014-03-01T20:00:03.7", duration=50 * u.s, interval=10 * u.s,
        frequencies=[150, 150.1, 150.2] * u.MHz, channel_width=0.1 * u.MHz,
    )  # fmt: skip
    sky = PointSky(names=("a",), ra_rad=[OFF[0]], dec_rad=[OFF[1]], stokes_jy=np.array([[4.0, 1.0, -0.5, 0.25]]))
    vis = Scene(instrument=lofar, sky=sky, observation=night).plan().run()
    rng = np.random.default_rng(2)
    data = vis.data.copy()
    data[0, 0, 0], data[1, 1, 1] = -0.0, np.nan
    flag = rng.random(vis.data.shape) < 0.1
    return replace(vis, data=data, weight=rng.uniform(0.1, 9, vis.data.shape), flag=flag, interval_s=np.arange(8.0, 13))


def whole(path, **settings):
    (block,) = Msv4File(path, **settings).blocks()
    return block


def test_a_set_comes_back_to_the_last_bit_but_for_uvw_that_are_solved_for(tmp_path, made):
    write_msv4(tmp_path / "a.zarr", replace(made, beam_state=BeamState("centre", CENTRE)))
    found = whole(tmp_path / "a.zarr")
    for name in ("data", "weight", "flag", "antenna1", "antenna2", "interval_s", "freq_hz"):
        one, two = np.asarray(getattr(found, name)), np.asarray(getattr(made, name))
        assert one.dtype == two.dtype and one.tobytes() == two.tobytes(), name
    assert found.at.slots_s.tobytes() == made.at.slots_s.tobytes() and np.all(found.width_hz == made.width_hz)
    assert found.layout.names == made.layout.names
    assert found.layout.positions_m.tobytes() == made.layout.positions_m.tobytes()
    assert found.phase_centre == made.phase_centre and np.abs(found.uvw_m - made.uvw_m).max() < 1e-8
    assert found.beam_state.removed == "centre" and found.beam_state.towards == CENTRE
    write_msv4(tmp_path / "b.zarr", Msv4File(tmp_path / "a.zarr"))
    assert whole(tmp_path / "b.zarr").data.tobytes() == made.data.tobytes()
    stored = xarray.open_datatree(tmp_path / "b.zarr", engine="zarr", consolidated=False)["set"]
    assert np.abs(stored["UVW"].values + made.uvw_m).max() < 1e-8


def test_the_tree_has_uvw_of_antenna_2_minus_1_with_the_phase_of_the_source(made):
    tree = made.to_xarray()
    assert np.array_equal(tree["UVW"].values, -made.uvw_m)
    names = tree["antenna_xds"]["antenna_name"].values.tolist()
    one, two = ([names.index(n) for n in tree[f"baseline_antenna{k}_name"].values] for k in (1, 2))
    assert np.array_equal(one, made.antenna1) and np.array_equal(two, made.antenna2)
    l, m, less = made.at.towards(*np.atleast_2d(OFF).T).lmn[0]
    waves = np.einsum("tbc,c,f->tbf", tree["UVW"].values, [l, m, less], tree["frequency"].values) / 299792458.0
    i = tree["VISIBILITY"].sel(polarization=["XX", "YY"]).mean("polarization").values
    good = np.isfinite(i) & (i != 0)
    assert good.sum() == i.size - 2
    assert np.abs(i - 4.0 * np.exp(2j * np.pi * waves))[good].max() < 1e-9


def changed(tmp_path, made, change):
    """A set of others: ours, changed as a tree."""
    tree = change(made.to_xarray())
    tree.to_zarr(tmp_path / "b.zarr", mode="w", consolidated=False, zarr_format=2)
    return tmp_path / "b.zarr"


def test_sets_of_others_circular_padded_backwards_with_autocorrelations_and_several(tmp_path, made, monkeypatch):
    good = replace(made, data=np.nan_to_num(made.data), flag=np.zeros((1, 1, 1), bool), weight=np.ones((1, 1, 1)))

    def main(tree, dataset):
        parts = {"/": dataset} | {f"/{name}": child.to_dataset(inherit=False) for name, child in tree.children.items()}
        return xarray.DataTree.from_dict(parts)

    def circular(tree):
        data = TO_CIRCULAR @ np.moveaxis(good.data, 1, 2) @ TO_CIRCULAR.conj().T
        top = tree.to_dataset(inherit=False)
        top["VISIBILITY"][:] = data.reshape(top["VISIBILITY"].shape)
        return main(tree, top.assign_coords(polarization=["RR", "RL", "LR", "LL"]))

    assert np.abs(whole(changed(tmp_path, good, circular)).data - good.data).max() < 1e-12

    def backwards(tree):
        return main(tree, tree.to_dataset(inherit=False).isel(frequency=slice(None, None, -1)))

    assert np.array_equal(whole(changed(tmp_path, good, backwards)).data, good.data)

    def padded(tree):
        top = tree.to_dataset(inherit=False)
        top["UVW"][1, 2] = np.nan
        names = top["baseline_antenna2_name"].values.copy()
        names[5] = top["baseline_antenna1_name"].values[5]
        top["baseline_antenna2_name"] = ("baseline_id", names)
        return main(tree, top)

    with pytest.warns(InstrumentWarning, match="5 rows are autocorrelations"):
        found = whole(changed(tmp_path, good, padded))
    assert np.array_equal(found.data[0], good.data[0, :, :5]) and len(found.antenna1) == 5
    assert np.argwhere(np.broadcast_to(found.flag, found.data.shape[:3])[:, 0]).tolist() == [[1, 2]]
    monkeypatch.setattr(by_rows, "BLOCK_BYTES", 2 * 64 * 6 * 3)
    write_msv4(tmp_path / "a.zarr", good)
    blocks = list(Msv4File(tmp_path / "a.zarr").blocks())
    assert [len(b.at.slots_s) for b in blocks] == [2, 2, 1]
    assert np.array_equal(np.concatenate([b.data for b in blocks]), good.data)
    both = xarray.DataTree.from_dict({"/": xarray.Dataset()})
    both["one"], both["two"] = good.to_xarray(), good.block(slice(0, 2), slice(None)).to_xarray()
    both.to_zarr(tmp_path / "two.zarr", consolidated=False, zarr_format=2)
    with pytest.raises(InputError, match="holds 2 sets: choose one by name=, one, two"):
        Msv4File(tmp_path / "two.zarr")
    assert Msv4File(tmp_path / "two.zarr", name="two").shape == (2, 3, 6)
    with pytest.raises(InputError, match="has no group of data 'model': it has base"):
        Msv4File(tmp_path / "two.zarr", name="one", group="model")


def test_the_observation_of_a_set_is_that_of_its_times_and_uvw(tmp_path, made):
    write_msv4(tmp_path / "a.zarr", replace(made, interval_s=10.0))
    found = Msv4File(tmp_path / "a.zarr").observation()
    assert np.array_equal(found.slots_s, made.at.slots_s) and found.names == made.layout.names
    write_msv4(tmp_path / "b.zarr", made)
    with pytest.warns(InstrumentWarning, match="integrations of 8 to 12 s"):
        assert Msv4File(tmp_path / "b.zarr").observation().interval == 12.0


def test_bad_input_is_one_line_and_leaves_nothing(tmp_path, made, monkeypatch):
    with pytest.raises(InputError, match=r"is to end in \.zarr"):
        write_msv4(tmp_path / "a.ms", made)
    for width in (None, [1e5, 2e5, 1e5]):
        with pytest.raises(InputError, match="one width of all channels"):
            write_msv4(tmp_path / "a.zarr", replace(made, width_hz=width))
    assert not list(tmp_path.iterdir())
    write_msv4(tmp_path / "a.zarr", made)
    with pytest.raises(InputError, match="exists: give overwrite=True"):
        write_msv4(tmp_path / "a.zarr", made)
    write_msv4(tmp_path / "a.zarr", made.block(slice(0, 2), slice(None)), overwrite=True)
    assert Msv4File(tmp_path / "a.zarr").shape[0] == 2
    made.save(tmp_path / "ours.zarr")
    with pytest.raises(FileError, match="is a file of visibilities of our own"):
        Msv4File(tmp_path / "ours.zarr")
    with pytest.raises(FileError, match="does not exist"):
        Msv4File(tmp_path / "none.zarr")
    for change, said in (
        (lambda t: t["time"].attrs.update(scale="tai"), "times are tai as unix"),
        (lambda t: t["field_and_source_base_xds/FIELD_PHASE_CENTER_DIRECTION"].attrs.update(frame="galactic"),
         "phase centre is in galactic"),
    ):  # fmt: skip
        with pytest.raises(InputError, match=said):
            Msv4File(changed(tmp_path, made, lambda tree, change=change: (change(tree), tree)[1]))
    (tmp_path / "a.zarr" / "set" / "VISIBILITY" / ".zarray").write_text("{")
    (tmp_path / "a.zarr" / ".zmetadata").unlink()
    xarray.DataTree.from_dict({"/": xarray.Dataset({"x": 1.0})}).to_zarr(tmp_path / "image.zarr", zarr_format=2)
    with pytest.raises(FileError, match="holds no interferometric set of version 4"):
        Msv4File(tmp_path / "image.zarr")
    with pytest.raises(FileError) as error:
        Msv4File(tmp_path / "a.zarr")
    assert "\n" not in str(error.value)
    monkeypatch.setitem(sys.modules, "xarray", None)
    for call in (made.to_xarray, lambda: Msv4File(tmp_path / "image.zarr")):
        with pytest.raises(InputError) as error:
            call()
        assert str(error.value) == msv4.MISSING and "pip install 'instrument[xarray]'" in msv4.MISSING
