"""Solutions as h5parm: what is written reads back, layouts of others are read, a broken file says what is wrong."""

import h5py
import numpy as np
import pytest
from astropy import units as u
from astropy.coordinates import SkyCoord

import instrument
from instrument import JonesTable, Observation, PointSky, Scene, SelfCal
from instrument.errors import FileError, InputError
from instrument.files.solutions import read_h5parm, write_h5parm

NAMES = ("CS001HBA0", "CS003HBA1", "RS106HBA", "RS508HBA", "a-name-of-17-char")
SLOTS = 4.86e9 + 10.0 * np.arange(3)
FREQS = np.array([149e6, 150e6])


def table(pattern="full", names=NAMES, values=None):
    rng = np.random.default_rng(3)
    if values is None:
        values = np.eye(2) + 0.3 * (rng.normal(size=(3, 2, 5, 2, 2)) + 1j * rng.normal(size=(3, 2, 5, 2, 2)))
        if pattern != "full":
            values = values * np.eye(2)
        if pattern == "scalar":
            values = values[..., :1, :1] * np.eye(2)
        if pattern == "phase":
            values = np.exp(1j * np.angle(values)) * np.eye(2)
    return JonesTable(values=values, slots_s=SLOTS, freq_hz=FREQS, stations=names)


@pytest.fixture(scope="module")
def vis():
    night = Observation(
        phase_centre="08h13m36.0s +48d13m03s", transit="2012-12-07", duration=30 * u.s, interval=10 * u.s,
        frequencies=[149, 150] * u.MHz,
    )  # fmt: skip
    lofar = instrument.load("telescopes", "lofar-hba", stations=list(NAMES[:4]), beam=None)
    sky = PointSky.at(SkyCoord("08h13m36.0s +48d13m03s"), [10.0])
    return Scene(instrument=lofar, sky=sky, observation=night).plan().run()


@pytest.fixture
def path(tmp_path):
    found = tmp_path / "s.h5"
    write_h5parm(found, table())
    return found


def edit(path, change):
    with h5py.File(path, "r+") as store:
        change(store["sol000"])
    return path


def put(group, name, array, axes=None):
    """Replace an array of a soltab, its attributes kept unless `axes` are given."""
    old = dict(group[name].attrs)
    del group[name]
    group[name] = array
    group[name].attrs.update(old if axes is None else {"AXES": np.bytes_(axes)})


# What is written reads back --------------------------------------------------------------------------------------


@pytest.mark.parametrize("pattern", ["full", "diagonal", "scalar", "phase"])
def test_every_pattern_reads_back_as_it_was(tmp_path, pattern):
    wrote = table(pattern)
    write_h5parm(tmp_path / "s.h5", wrote, pattern)
    read = read_h5parm(tmp_path / "s.h5")
    # amplitude and phase in float64
    assert np.abs(read.values - wrote.values).max() < 1e-15 * 4
    assert np.array_equal(read.slots_s, SLOTS)
    assert np.array_equal(read.freq_hz, FREQS)
    assert read.stations == NAMES
    assert list(tmp_path.iterdir()) == [tmp_path / "s.h5"]  # no part of a file is left


def test_the_file_has_the_groups_axes_and_attributes_of_dp3(path):
    with h5py.File(path) as store:
        solset = store["sol000"]
        assert solset.attrs["h5parm_version"] == b"1.0"
        assert set(solset) == {"antenna", "source", "amplitude000", "phase000"}
        assert [x.decode() for x in solset["antenna"]["name"]] == list(NAMES)
        for kind in ("amplitude", "phase"):
            soltab = solset[f"{kind}000"]
            assert soltab.attrs["TITLE"] == kind.encode()
            assert set(soltab) == {"time", "freq", "ant", "pol", "val", "weight"}
            assert soltab["val"].attrs["AXES"] == soltab["weight"].attrs["AXES"] == b"time,freq,ant,pol"
            assert soltab["val"].dtype == np.float64
            assert soltab["weight"].dtype == np.float32
            assert soltab["val"].shape == soltab["weight"].shape == (3, 2, 5, 4)
            assert list(soltab["pol"]) == [b"XX", b"XY", b"YX", b"YY"]
            # DP3 takes the last byte for the end of a name, and would not find 'a-name-of-17-cha'
            assert soltab["ant"].dtype.itemsize == max(map(len, NAMES)) + 1
            assert b"CREATE by instrument" in soltab["val"].attrs["HISTORY000"]


def test_what_is_not_finite_or_singular_has_weight_zero_and_flags_the_data(tmp_path, vis):
    values = np.array(table().values)[:, :, :4]
    values[0, 1, 2] = np.nan
    values[1, 0, 1, 0, 1] = np.nan  # one entry
    values[2, :, 3] = 0
    values[2, 0, 0] = [[1, 2], [2, 4]]
    ours = JonesTable(values=values, slots_s=vis.at.slots_s, freq_hz=vis.freq_hz, stations=NAMES[:4])
    write_h5parm(tmp_path / "s.h5", ours, at=vis.at)
    with h5py.File(tmp_path / "s.h5") as store:
        weight = store["sol000/phase000/weight"][()]
    assert int((weight == 0).sum()) == 4 * 5
    read = read_h5parm(tmp_path / "s.h5", layout=vis.layout)
    assert np.array_equal(np.isnan(read.values).all(axis=(-2, -1)), (weight == 0).all(axis=-1))
    wanted, found = vis.corrected(ours), vis.corrected(read)
    assert found.flag.any()
    assert np.array_equal(found.flag, wanted.flag)
    assert np.abs(found.data - wanted.data).max() < 1e-12 * np.abs(wanted.data).max()


def test_a_solution_is_written_with_the_array_and_its_history(tmp_path, vis):
    solution = SelfCal(tolerance=1e-8).solve(vis, vis)
    write_h5parm(tmp_path / "s.h5", solution, at=vis.at)
    assert np.abs(read_h5parm(tmp_path / "s.h5", vis.layout).values - solution.term.values).max() < 1e-14
    with h5py.File(tmp_path / "s.h5") as store:
        assert str(solution) in store["sol000/phase000/val"].attrs["HISTORY000"].decode()
        assert np.allclose(store["sol000/antenna"]["position"], vis.layout.positions_m, rtol=1e-7)
        name, towards = store["sol000/source"][0]
    assert name == b"POINTING"
    assert np.array_equal(towards, [vis.phase_centre.ra_rad, vis.phase_centre.dec_rad])


def test_one_matrix_for_all_stations_is_written_for_each(tmp_path, vis):
    one = JonesTable(values=np.array(table().values)[:, :, :1], slots_s=SLOTS, freq_hz=FREQS)
    write_h5parm(tmp_path / "s.h5", one, at=vis.at)
    read = read_h5parm(tmp_path / "s.h5")
    assert read.stations == NAMES[:4]
    assert np.abs(read.values - one.values).max() < 4e-15


@pytest.mark.parametrize(
    ("pattern", "given", "message"),
    [
        ("diagonal", "full", "pattern 'diagonal' would lose entries of up to .*; use 'full'"),
        ("scalar", "diagonal", "pattern 'scalar' would lose"),
        ("phase", "diagonal", "pattern 'phase' would lose"),
        ("diag", "full", "pattern = 'diag' is not one of .*: did you mean 'diagonal'"),
    ],
)
def test_a_pattern_that_loses_something_is_refused(tmp_path, pattern, given, message):
    with pytest.raises(InputError, match=message):
        write_h5parm(tmp_path / "s.h5", table(given), pattern)
    assert not any(tmp_path.iterdir())


def test_a_table_needs_the_names_of_its_stations(tmp_path, vis):
    with pytest.raises(InputError, match="names no stations"):
        write_h5parm(tmp_path / "s.h5", table(names=()))
    with pytest.raises(InputError, match="holds 5 stations, but `at` 4"):
        write_h5parm(tmp_path / "s.h5", table(names=()), at=vis.at)
    with pytest.raises(InputError, match="of other stations than `at`"):
        write_h5parm(tmp_path / "s.h5", table(), at=vis.at)
    with pytest.raises(FileError, match="cannot be written"):
        write_h5parm(tmp_path / "nowhere" / "s.h5", table())


# Layouts of other programs ---------------------------------------------------------------------------------------


def test_axes_in_any_order_and_with_one_direction_are_read(path):
    def turn(solset):
        for kind in ("amplitude000", "phase000"):
            soltab = solset[kind]
            soltab["dir"] = np.array([b"[POINTING]"])
            for name in ("val", "weight"):
                array = soltab[name][()].transpose(3, 2, 1, 0)[:, None]
                put(soltab, name, array, "pol,dir,ant,freq,time")
            soltab["val"].attrs["AXES"] = "pol,dir,ant,freq,time"  # text that is not bytes, as of PyTables
            soltab["weight"].attrs["AXES"] = "pol,dir,ant,freq,time"

    assert np.abs(read_h5parm(edit(path, turn)).values - table().values).max() < 4e-15


def test_polarizations_in_another_order_are_read(path):
    def turn(solset):
        for soltab in (solset["amplitude000"], solset["phase000"]):
            put(soltab, "pol", soltab["pol"][()][::-1])
            put(soltab, "val", soltab["val"][()][..., ::-1])

    assert np.abs(read_h5parm(edit(path, turn)).values - table().values).max() < 4e-15


def test_amplitudes_alone_and_a_scalar_phase_with_them_are_read(tmp_path):
    path = tmp_path / "s.h5"
    write_h5parm(path, table("diagonal"), "diagonal")
    wanted = np.array(table("diagonal").values)
    found = read_h5parm(path, soltabs=["amplitude000"])
    assert np.abs(found.values - np.abs(wanted)).max() < 1e-15

    def scalar(solset):
        phase = solset["phase000"]
        for name in ("val", "weight"):
            put(phase, name, phase[name][..., 0], "time,freq,ant")

    found = read_h5parm(edit(path, scalar)).values
    common = np.exp(1j * np.angle(wanted[..., 0, 0]))[..., None, None]
    assert np.abs(found - np.abs(wanted) * common).max() < 4e-15


def with_directions(solset, names=(b"[east]", b"[west]")):
    for soltab in (solset["amplitude000"], solset["phase000"]):
        soltab["dir"] = np.array(names, "S16")
        for name in ("val", "weight"):
            array = soltab[name][()][:, :, :, None] * np.arange(1.0, len(names) + 1)[:, None]
            put(soltab, name, array, "time,freq,ant,dir,pol")


def test_one_of_several_directions_is_chosen_by_name(path):
    edit(path, with_directions)
    with pytest.raises(FileError, match=r"of 2 directions \(\[east\], \[west\]\); choose one with direction="):
        read_h5parm(path)
    with pytest.raises(FileError, match=r"2 directions \(\[east\], \[west\]\); 'north' is not one of them"):
        read_h5parm(path, direction="north")
    assert np.abs(read_h5parm(path, direction="east").values - table().values).max() < 4e-15
    west = read_h5parm(path, direction="[west]").values
    assert np.abs(np.abs(west) - 2 * np.abs(table().values)).max() < 1e-14


def test_a_layout_orders_the_stations_and_misses_none_silently(path, vis):
    turned = vis.layout.select(NAMES[3::-1])
    found = read_h5parm(path, layout=turned)
    assert found.stations == turned.names
    assert np.abs(found.values - np.array(table().values)[:, :, 3::-1]).max() < 4e-15
    other = instrument.load("telescopes", "lofar-hba", stations=["RS508HBA", "RS509HBA", "CS001HBA0"]).layout()
    with pytest.raises(FileError, match=r"s.h5, /sol000: no station 'RS509HBA': did you mean 'RS508HBA'\?"):
        read_h5parm(path, layout=other)
    found = read_h5parm(path, layout=other, missing="flag")
    assert np.array_equal(np.isnan(found.values).all(axis=(0, 1, 3, 4)), [False, True, False])
    assert np.abs(found.values[:, :, 0] - table().values[:, :, 3]).max() < 4e-15
    strangers = instrument.load("telescopes", "lofar-hba", stations=["RS509HBA", "RS205HBA"]).layout()
    with pytest.raises(FileError, match="no station 'RS509HBA' and 1 more"):
        read_h5parm(path, layout=strangers, missing="flag")
    with pytest.raises(InputError, match="missing = 'skip' is not one of 'error', 'flag'"):
        read_h5parm(path, missing="skip")


def test_a_solset_or_a_soltab_among_several_is_chosen_by_name(path):
    def more(solset):
        solset.copy("phase000", "phase001")
        solset.file.copy("sol000", "sol001")

    edit(path, more)
    with pytest.raises(FileError, match=r"more than one solset; choose with solset= \(sol000, sol001\)"):
        read_h5parm(path)
    with pytest.raises(FileError, match="no solset 'sol002'"):
        read_h5parm(path, solset="sol002")
    with pytest.raises(FileError, match=r"/sol001: needs one soltab .* has amplitude000, phase000, phase001"):
        read_h5parm(path, solset="sol001")
    with pytest.raises(FileError, match="no soltab 'phase007'"):
        read_h5parm(path, solset="sol001", soltabs=["phase007"])
    found = read_h5parm(path, solset="sol001", soltabs=("amplitude000", "phase001"))
    assert np.abs(found.values - table().values).max() < 4e-15


# Broken files ----------------------------------------------------------------------------------------------------


def soltab(name, change):
    return lambda solset: change(solset[name])


def title(text):
    return soltab("phase000", lambda t: t.attrs.update(TITLE=np.bytes_(text)))


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda s: s.file.pop("sol000"), "s.h5: there is no solset in it"),
        (lambda s: (s.pop("amplitude000"), s.pop("phase000")), "/sol000: needs one soltab .* but has none"),
        (title("tec"), "needs one soltab of amplitudes, one of phases"),
        (title("amplitude"), "needs one soltab of amplitudes"),
        (soltab("phase000", lambda t: t.pop("val")), "s.h5, /sol000/phase000: there is no 'val'"),
        (soltab("phase000", lambda t: t.pop("weight")), "/sol000/phase000: there is no 'weight'"),
        (soltab("phase000", lambda t: t["val"].attrs.pop("AXES")), "'val' has no attribute AXES"),
        (soltab("phase000", lambda t: t.pop("freq")), "there is no array 'freq', an axis of 'val'"),
        (
            soltab("phase000", lambda t: t["val"].attrs.update(AXES=np.bytes_("time,frequency,ant,pol"))),
            "axes time,frequency,ant,pol of 'val'; time, freq and ant must be there",
        ),
        (
            soltab("phase000", lambda t: t["val"].attrs.update(AXES=np.bytes_("time,time,ant,pol"))),
            "axes time,time,ant,pol of 'val'",
        ),
        (
            soltab("phase000", lambda t: put(t, "val", t["val"][:2])),
            r"'val' has shape \(2, 2, 5, 4\), its axes time,freq,ant,pol need \(3, 2, 5, 4\)",
        ),
        (
            soltab("phase000", lambda t: put(t, "weight", t["weight"][:2])),
            r"'weight' has shape \(2, 2, 5, 4\) along time,freq,ant,pol, unlike 'val'",
        ),
        (
            soltab("phase000", lambda t: put(t, "pol", np.array([b"RR", b"RL", b"LR", b"LL"]))),
            "axis 'pol' holds RR, RL, LR, LL, which is neither",
        ),
        (
            soltab("phase000", lambda t: put(t, "ant", np.array([b"a", b"b", b"c", b"a", b"d"]))),
            "station 'a' is there twice",
        ),
        (
            soltab("phase000", lambda t: put(t, "time", t["time"][()] + 1)),
            "/sol000/amplitude000 and /sol000/phase000 differ in axis 'time'",
        ),
        (lambda s: s.pop("amplitude000"), "full Jones needs XX, XY, YX and YY of both an amplitude and a phase"),
        (
            lambda s: [put(s[k], "time", s[k]["time"][()][::-1]) for k in ("amplitude000", "phase000")],
            "s.h5, /sol000: slots_s must be finite and ascending",
        ),
        (soltab("phase000", lambda t: put(t, "val", np.full((3, 2, 5, 4), b"x"))), "is not a readable h5parm"),
        (lambda s: with_directions(s, ()), r"solutions of 0 directions \(\); choose one"),
    ],
)
def test_a_broken_file_names_group_and_fault(path, change, message):
    with pytest.raises(FileError, match=message) as error:
        read_h5parm(edit(path, change))
    assert "\n" not in str(error.value)
    assert "s.h5" in str(error.value)


def test_a_direction_that_the_file_has_not_is_refused(path):
    with pytest.raises(FileError, match="solutions of 0 directions"):
        read_h5parm(path, direction="east")


def test_truncated_missing_and_foreign_files_are_refused(path, tmp_path):
    whole = path.read_bytes()
    for keep in (0, 4, 100, len(whole) // 2, len(whole) - 1):
        path.write_bytes(whole[:keep])
        with pytest.raises(FileError, match=r"s.h5 is not a readable h5parm: ") as error:
            read_h5parm(path)
        assert "\n" not in str(error.value)
    path.write_text("time,freq,ant,pol\n")
    with pytest.raises(FileError, match="is not a readable h5parm"):
        read_h5parm(path)
    with pytest.raises(FileError, match="does not exist"):
        read_h5parm(tmp_path / "none.h5")
    with pytest.raises(FileError, match="is not a readable h5parm"):
        read_h5parm(tmp_path)


def test_bytes_changed_anywhere_never_give_another_kind_of_error(path):
    """Of 150 files with 16 bytes overwritten, each is read or refused in one line."""
    whole = path.read_bytes()
    rng = np.random.default_rng(7)
    for _ in range(150):
        broken, place = bytearray(whole), int(rng.integers(len(whole) - 16))
        broken[place : place + 16] = rng.bytes(16)
        path.write_bytes(broken)
        try:
            read_h5parm(path)
        except FileError as error:
            assert "\n" not in str(error)
