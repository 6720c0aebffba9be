"""G3: visibilities to disk and back, block by block; other files are refused in one line."""

import json
import re
import subprocess
import sys
from dataclasses import replace

import h5py
import numpy as np
import pytest
from astropy import units as u
from astropy.coordinates import SkyCoord

import instrument as ins
from instrument.errors import BeamStateError, FileError, InputError, RefusedError
from instrument.jones.towards import Towards

CENTRE = "08h13m36.0s +48d13m03s"
ARRAYS = ("data", "weight", "flag", "antenna1", "antenna2", "interval_s", "width_hz", "uvw_m", "freq_hz")


def scene(**instrument):
    observation = ins.Observation(
        phase_centre=CENTRE, transit="2012-12-07", duration=60 * u.s, interval=10 * u.s,
        frequencies=[150, 150.2, 150.4] * u.MHz,
    )  # fmt: skip
    lofar = ins.load("telescopes", "lofar-hba", stations=["CS001HBA0", "CS001HBA1", "RS106HBA"], **instrument)
    sky = ins.PointSky.at(SkyCoord([123.4, 124.2], [48.2, 48.9], unit="deg"), [3.0, 1.0])
    return ins.Scene(instrument=lofar, sky=sky, observation=observation)


@pytest.fixture(scope="module")
def plan():
    from dataclasses import replace as change

    return change(scene().plan(), block_shape=(2, 2))  # blocks of times and of channels


@pytest.fixture(scope="module")
def vis(plan):
    rng = np.random.default_rng(1)
    found = plan.run()
    weight, flag = rng.uniform(0.1, 2, (6, 1, 3)), rng.uniform(size=(6, 3, 3)) < 0.2
    return found.weighted(weight).flagged(flag).with_noise(10 * u.Jy, seed=1)


def same(a, b):
    for name in ARRAYS:
        x, y = (np.asarray(getattr(one, name), None if getattr(one, name) is not None else float) for one in (a, b))
        assert x.shape == y.shape and x.dtype == y.dtype and x.tobytes() == y.tobytes(), name
    assert (
        a.layout == b.layout and a.phase_centre == b.phase_centre and (a.given_uvw_m is None) == (b.given_uvw_m is None)
    )
    assert a.beam_state == b.beam_state and a.beam_state.beams == b.beam_state.beams
    for one in ("slots_s", "ra_rad", "dec_rad"):
        assert np.array_equal(getattr(a.at, one), getattr(b.at, one))
    assert np.array_equal(a.at.earth.matrices, b.at.earth.matrices)
    assert np.array_equal(a.at.earth.velocity, b.at.earth.velocity)


def test_everything_comes_back_to_the_last_bit(vis, tmp_path):
    lofar = scene().instrument
    uneven = replace(vis, interval_s=np.arange(1.0, 7), width_hz=[1e5, 2e5, 1e5], given_uvw_m=vis.uvw_m * 1.5)
    broken = vis.with_data(np.where(np.arange(6)[:, None, None, None, None] == 2, np.nan, vis.data))
    for k, one in enumerate((vis, uneven, broken, vis.without_beam(lofar), replace(vis, width_hz=None))):
        one.save(tmp_path / f"{k}.h5")
        same(ins.Visibilities.open(tmp_path / f"{k}.h5"), one)


def test_what_is_known_of_the_beam_comes_back(vis, tmp_path):
    lofar = scene().instrument
    vis.save(tmp_path / "a.h5")
    back = ins.Visibilities.open(tmp_path / "a.h5")
    assert back.without_beam(lofar).beam_state.removed == "centre"
    back.without_beam(lofar).save(tmp_path / "b.h5")
    again = ins.Visibilities.open(tmp_path / "b.h5")
    with pytest.raises(BeamStateError, match="taken out already"):
        again.corrected(Towards(chain=lofar.chain()))


def test_a_plan_is_saved_block_by_block_and_read_in_parts(plan, tmp_path):
    path = tmp_path / "plan.h5"
    plan.save(path)
    whole = plan.run()
    same(ins.Visibilities.open(path), whole)
    same(ins.Visibilities.open(path, times=slice(1, 5), channels=slice(2, 3)), whole.block(slice(1, 5), slice(2, 3)))
    file = ins.VisibilityFile(path)
    assert len(repr(file)) < 200 and "6 times, 3 channels" in repr(file)
    imager = ins.Imager(pixels=32, pixel=4 * u.arcmin, weighting="uniform")
    assert np.array_equal(imager.image(file).data, imager.image(whole).data)
    assert plan.verify(file).passed
    file.save(tmp_path / "copy.h5")
    same(ins.Visibilities.open(tmp_path / "copy.h5"), whole)


@pytest.mark.long
def test_memory_does_not_grow_with_what_is_saved_or_read(tmp_path, monkeypatch):
    import tracemalloc

    rng = np.random.default_rng(0)
    enu = np.c_[rng.uniform(-300, 300, (24, 2)), np.zeros(24)] * u.m
    layout = ins.Layout.from_enu([f"s{k}" for k in range(24)], enu, 6.9 * u.deg, 52.9 * u.deg, 10 * u.m)
    observation = ins.Observation(
        phase_centre=CENTRE, transit="2012-12-07", duration=160 * u.s, interval=1 * u.s, frequencies=[150] * u.MHz
    )
    sky = ins.PointSky.at(SkyCoord([123.4], [48.2], unit="deg"), [3.0])
    made = ins.Scene(instrument=ins.Composed(stations=layout), sky=sky, observation=observation).plan(workers=1)
    made = replace(made, block_shape=(8, 1))
    whole = 64 * 160 * len(layout.baselines[0])  # 2.8 MB
    monkeypatch.setattr("instrument.visibility_sets.BLOCK_BYTES", whole / 20)
    assert len([*made.blocks()]) == 20  # and what is made once is made: coordinates, compiled code
    peaks = []
    for work in (
        lambda: made.save(tmp_path / "x.h5"),
        lambda: [*map(repr, ins.VisibilityFile(tmp_path / "x.h5").blocks())],
    ):
        tracemalloc.start()
        work()
        peaks.append(tracemalloc.get_traced_memory()[1])
        tracemalloc.stop()
    assert (tmp_path / "x.h5").stat().st_size > whole
    assert max(peaks) < whole / 3, [peak / whole for peak in peaks]


def test_a_file_is_read_in_blocks_of_bounded_size(plan, tmp_path, monkeypatch):
    plan.save(tmp_path / "x.h5")
    monkeypatch.setattr("instrument.visibility_sets.BLOCK_BYTES", 64 * 3 * 2)  # three baselines, two channels
    shapes = [block.data.shape[:3] for block in ins.VisibilityFile(tmp_path / "x.h5").blocks()]
    assert shapes == [(1, 2, 3), (1, 1, 3)] * 6


def test_blocks_with_weights_of_their_own_become_one(vis, tmp_path):
    """Length 1 while it is constant, whole where blocks differ, whichever block differs first."""
    one = replace(vis, weight=np.ones((1, 1, 1)), flag=np.zeros((1, 1, 1), bool))
    for odd in range(3):
        blocks = [one.block(slice(k, k + 2), slice(None)) for k in (0, 2, 4)]
        blocks[odd] = replace(blocks[odd].weighted(np.full((1, 1, 3), 2.0)), interval_s=[5.0, 7.0])
        path = tmp_path / f"{odd}.h5"
        ins.visibilities.store.write(path, blocks)
        back = ins.Visibilities.open(path)
        assert back.weight.shape == (6, 3, 3) and back.flag.shape == (1, 1, 1) and back.width_hz.shape == (1,)
        want = np.ones((6, 3, 3))
        want[2 * odd : 2 * odd + 2] = 2
        assert np.array_equal(back.weight, want)
        assert (
            back.interval_s[2 * odd : 2 * odd + 2].tolist() == [5, 7]
            and (np.delete(back.interval_s, [2 * odd, 2 * odd + 1]) == 10).all()
        )


def test_blocks_that_clash_are_refused_and_leave_nothing(vis, tmp_path):
    half, rest = vis.block(slice(0, 3), slice(None)), vis.block(slice(3, 6), slice(None))
    lofar = scene().instrument
    for blocks, text in (
        ([half, half], "time 0 and channel 0 are in two blocks"),
        ([half, rest.block(slice(None), slice(0, 2))], "no block holds channel 2 at time 3"),
        ([half, rest.without_beam(lofar)], "the blocks differ in beam_state"),
        ([half, replace(rest, given_uvw_m=rest.uvw_m)], "some blocks have given_uvw_m and others have not"),
        ([half, replace(rest, width_hz=None)], "some blocks have width_hz and others have not"),
        ([], "the set has no block"),
    ):
        with pytest.raises(InputError, match=text):
            ins.visibilities.store.write(tmp_path / "x.h5", iter(blocks))
        assert [*tmp_path.iterdir()] == []


def test_nothing_is_overwritten_unless_asked(vis, tmp_path):
    path = tmp_path / "v.h5"
    vis.save(path)
    before = path.read_bytes()
    with pytest.raises(InputError, match=r"v.h5 exists: give overwrite=True, or another name"):
        vis.save(path)
    assert path.read_bytes() == before
    vis.with_data(2 * vis.data).save(path, overwrite=True)
    assert np.array_equal(ins.Visibilities.open(path).data, 2 * vis.data)
    with pytest.raises(FileError, match=r"none/v.h5 cannot be written: No such file"):
        vis.save(tmp_path / "none" / "v.h5")


def test_a_file_says_what_made_it(vis, tmp_path):
    from instrument.provenance import provenance

    with provenance(object="night", seed=196, scene="0123456789abcdef"):
        vis.save(tmp_path / "v.h5")
    with h5py.File(tmp_path / "v.h5") as file:
        said = dict(file.attrs)
    assert said["object"] == "night" and said["seed"] == 196 and said["scene"] == "0123456789abcdef"
    assert said["software"] == f"instrument {ins.__version__}" and said["written"].startswith("20")


def spoil(path, name, change):
    with h5py.File(path, "r+") as file:
        new = change(file[name][()]) if callable(change) else change
        del file[name]
        if new is not None:
            file[name] = new


@pytest.mark.parametrize(
    ("name", "change", "text"),
    [
        ("data", None, "there is no 'data'"),
        ("weight", None, "there is no 'weight'"),
        ("data", lambda x: x[:, :, :, 0], "'antenna1' has shape|'data' has shape"),
        ("slots_s", lambda x: x[:-1], r"'slots_s' has shape \(5,\), needed \(6,\)"),
        ("freq_hz", lambda x: -x, "not above 0"),
        ("slots_s", lambda x: x * np.nan, "are not finite"),
        ("weight", lambda x: -x, "weight must be finite and not negative"),
        ("antenna1", lambda x: x + 7, "antenna1 must hold numbers of stations"),
        ("flag", lambda x: x.astype(float), "'flag' holds float64"),
        ("layout", lambda x: x[:-9], "layout or beam state"),
        ("beam_state", lambda x: np.frombuffer(b'{"removed": 1}', np.uint8), "layout or beam state"),
    ],
)  # fmt: skip
def test_a_damaged_file_is_one_line(vis, tmp_path, name, change, text):
    path = tmp_path / "v.h5"
    vis.save(path)
    spoil(path, name, change)
    with pytest.raises(FileError, match=text) as found:
        ins.Visibilities.open(path)
    assert "\n" not in str(found.value) and "v.h5" in str(found.value)


def test_other_files_are_named(vis, tmp_path):
    solution = ins.JonesTable(
        values=np.ones((1, 1, 3, 2, 2)) * np.eye(2), slots_s=[0.0], freq_hz=[0.0], stations=vis.layout.names
    )
    ins.write_h5parm(tmp_path / "s.h5", solution)
    (tmp_path / "t.h5").write_text("no HDF5")
    (tmp_path / "x.ms").mkdir()
    vis.save(tmp_path / "v.h5")
    (tmp_path / "cut.h5").write_bytes((tmp_path / "v.h5").read_bytes()[:4000])
    for name, text in (
        ("s.h5", "is no file of visibilities .* an h5parm, which read_h5parm reads"),
        ("t.h5", "is not a readable file of visibilities"),
        ("cut.h5", "is not a readable file of visibilities"),
        ("x.ms", "is a Measurement Set"),
        ("none.h5", "does not exist"),
    ):
        with pytest.raises(FileError, match=text) as found:
            ins.Visibilities.open(tmp_path / name)
        assert "\n" not in str(found.value)


def test_declared_sizes_are_looked_at_before_anything_is_read(vis, tmp_path, monkeypatch):
    path = tmp_path / "v.h5"
    vis.save(path)
    with h5py.File(path, "r+") as file:
        huge = {"data": (10**9, 3, 3, 2, 2), "slots_s": (10**9,), "earth_matrices": (10**9, 3, 3)}
        for name, shape in (huge | {"earth_velocity": (10**9, 3)}).items():
            dtype = file[name].dtype
            del file[name]
            file.create_dataset(name, shape=shape, dtype=dtype, chunks=(1, *shape[1:]) if len(shape) > 1 else (1000,))
        for name in ("weight", "flag"):
            one = file[name].dtype.type(1)
            del file[name]
            file[name] = np.full((1, 1, 1), one)
    with pytest.raises(FileError, match=r"declares .* in a file of"):
        ins.Visibilities.open(path)
    vis.save(tmp_path / "w.h5")
    monkeypatch.setattr("instrument.memory.machine_memory", lambda: 1e3)
    with pytest.raises(RefusedError, match="choose times= or channels="):
        ins.Visibilities.open(tmp_path / "w.h5")


def test_a_link_to_another_file_is_not_followed(vis, tmp_path):
    path = tmp_path / "v.h5"
    vis.save(path)
    vis.save(tmp_path / "other.h5")
    with h5py.File(path, "r+") as file:
        del file["data"]
        file["data"] = h5py.ExternalLink("other.h5", "/data")
    with pytest.raises(FileError, match="only points to something in the file"):
        ins.Visibilities.open(path)


def test_a_choice_of_nothing_is_refused(vis, tmp_path):
    vis.save(tmp_path / "v.h5")
    for chosen in (slice(9, 12), slice(None, None, -1)):
        with pytest.raises(InputError, match="give a forward slice"):
            ins.Visibilities.open(tmp_path / "v.h5", times=chosen)


def test_a_beam_of_terms_that_are_not_known_here_is_said(vis, tmp_path):
    path = tmp_path / "v.h5"
    vis.save(path)
    spoil(
        path, "beam_state", lambda x: np.frombuffer(x.tobytes().replace(b'"StationBeam"', b'"StrangersBeam"'), np.uint8)
    )
    with pytest.warns(ins.InstrumentWarning, match="which beam is in the data is not known here.*StrangersBeam"):
        assert ins.Visibilities.open(path).beam_state.beams is None


@pytest.mark.parametrize("beam", ["full", "array-factor", "element"])
def test_data_of_before_there_was_a_phase_hold_the_beam_of_everybeam(tmp_path, beam):
    """Version 1 of the format: no `phase`, and elements by themselves multiplied as their makers give them."""
    stations = ["CS001LBA", "CS302LBA", "RS508LBA"]
    now, before = (
        ins.load("telescopes", "lofar-lba", stations=stations, beam=beam, phase=phase)
        for phase in ("fringe", "everybeam")
    )
    path = tmp_path / "v.h5"
    night = ins.Observation(
        phase_centre="08h13m36.0s +48d13m03s", start="2012-12-07T22:00:00", duration=20 * u.s, interval=10 * u.s,
        frequencies=[60] * u.MHz,
    )  # fmt: skip
    sky = ins.PointSky.at(night.phase_centre.skycoord, [[1.0, 0, 0, 0]])
    ins.Scene(instrument=before, sky=sky, observation=night).plan().run().save(path)
    assert ins.Visibilities.open(path).beam_state.beams == before.chain().beams()
    terms = now.chain().to_dict() if beam == "element" else before.chain().to_dict()
    for term in terms["terms"]:
        term.pop("phase", None)
    told = {"removed": "nothing", "towards": None, "beams": {**terms, "terms": terms["terms"][2:]}, "other": False}
    spoil(path, "beam_state", lambda x: np.frombuffer(json.dumps(told).encode(), np.uint8))
    with h5py.File(path, "r+") as file:
        file.attrs["version"] = 1
    old = ins.Visibilities.open(path)
    assert old.beam_state.beams == before.chain().beams() != now.chain().beams()
    with pytest.raises(BeamStateError, match="is not the beam in the data"):
        old.without_beam(now)
    assert old.without_beam(before).beam_state.removed == "centre"


FULL = """
import resource, sys
import numpy as np
from astropy import units as u
import instrument as ins
from instrument.conformance import imagers
from instrument.errors import FileError
from instrument.image.base import Kept

class Any(ins.AnyImager):
    def image(self, visibilities, operator=None):
        raise NotImplementedError

vis = imagers._seen((1.0, 0.0, 0.0, 0.0))
term = ins.JonesTable(values=np.ones((500, 2, 24, 2, 2), complex), slots_s=vis.at.slots_s[0] + np.arange(500.0),
                      freq_hz=vis.freq_hz, stations=vis.layout.names)
resource.setrlimit(resource.RLIMIT_FSIZE, (8000, 8000))
kept = Kept(Any(pixels=32, pixel=1 * u.arcmin))
saves = lambda: vis.save("x.h5"), lambda: ins.write_h5parm("s.h5", term, "full", at=vis.at), lambda: kept.add(vis)
for save in saves:
    try:
        save()
        print("saved")
    except FileError as error:
        print(error)
"""


def test_a_disk_that_is_full_is_one_line_and_no_crash_of_hdf5(tmp_path):
    done = subprocess.run([sys.executable, "-c", FULL], cwd=tmp_path, capture_output=True, text=True, timeout=100)
    assert done.returncode == 0, done.stderr  # HDF5 ended by a segmentation fault
    assert done.stderr == ""
    lines = done.stdout.splitlines()
    assert lines[:2] == ["x.h5 cannot be written: File too large", "s.h5 cannot be written: File too large"]
    assert re.fullmatch(r"blocks for Any cannot be kept in .*: File too large; TMPDIR names .* room", lines[2])
    assert not any(tmp_path.iterdir())
