"""Files that others may have prepared: temporary names, links, declared sizes; solution tables of other programs."""

import os
import tracemalloc
from dataclasses import replace
from typing import ClassVar

import h5py
import numpy as np
import pytest
from astropy import units as u
from astropy.coordinates import SkyCoord

from instrument import DirectionalCal, JonesTable, Layout, Observation, PointSky, Sampling, Scene
from instrument.calibrate.directional import DirectionalSolution
from instrument.errors import FileError, InputError
from instrument.files.solutions import read_h5parm, write_h5parm
from instrument.model import Composed
from instrument.units import Direction
from instrument.whole_file import whole_file, write_ecsv

NAMES = ("CS001HBA0", "CS003HBA1", "RS106HBA")
SLOTS = 4.86e9 + 10.0 * np.arange(4)
FREQS = np.array([149e6, 150e6])


def table(seed=0):
    rng = np.random.default_rng(seed)
    noise = rng.normal(size=(2, len(SLOTS), len(FREQS), len(NAMES), 2, 2))
    return JonesTable(values=np.eye(2) + 0.2 * (noise[0] + 1j * noise[1]), slots_s=SLOTS, freq_hz=FREQS, stations=NAMES)


def at(seconds=0.0, freq_hz=149e6):
    """A sampling at a time after the first slot and some frequencies."""
    enu = np.array([[0, 0, 0], [90, 10, 0], [30, 300, 0]]) * u.m
    layout = Layout.from_enu(NAMES, enu, 6.9 * u.deg, 52.9 * u.deg, 0 * u.m)
    one = Sampling.build(layout, "2012-12-07T20:00:00", freq_hz, 2.0, 0.8, Direction(2.0, 0.8))
    return replace(one, slots_s=np.array([SLOTS[0] + seconds]))


# I10: temporary files -----------------------------------------------------------------------------------------------


def test_i10_a_link_at_a_temporary_name_is_not_followed(tmp_path):
    victim = tmp_path / "victim"
    victim.write_text("precious")
    for name in ("s.h5.part", ".s.h5.part", "s.h5.tmp"):
        (tmp_path / name).symlink_to(victim)
    write_h5parm(tmp_path / "s.h5", table())
    assert victim.read_text() == "precious"
    assert read_h5parm(tmp_path / "s.h5").stations == NAMES


def test_i10_the_place_of_a_temporary_file_is_new_private_and_random(tmp_path):
    seen = []
    for _ in range(2):
        with whole_file(tmp_path / "a.txt", overwrite=True) as partial:
            seen.append(partial)
            assert partial.name == "a.txt"  # the ending tells libraries the format
            assert not partial.exists()
            assert os.stat(partial.parent).st_mode & 0o077 == 0
            partial.write_text("x")
    assert seen[0].parent != seen[1].parent
    assert [p.name for p in tmp_path.iterdir()] == ["a.txt"]


def test_i10_a_link_at_the_name_itself_is_replaced_and_not_followed(tmp_path):
    victim = tmp_path / "victim"
    victim.write_text("precious")
    (tmp_path / "a.txt").symlink_to(victim)
    with whole_file(tmp_path / "a.txt", overwrite=True) as partial:
        partial.write_text("new")
    assert victim.read_text() == "precious"
    assert (tmp_path / "a.txt").read_text() == "new" and not (tmp_path / "a.txt").is_symlink()


@pytest.mark.parametrize("name", ["none/a.txt", "a" * 300, "file/a.txt"])
def test_i7_what_the_system_says_against_writing_is_one_line(tmp_path, name):
    (tmp_path / "file").write_text("x")
    with pytest.raises(FileError, match="cannot be written: ") as error, whole_file(tmp_path / name) as partial:
        partial.write_text("x")
    assert "\n" not in str(error.value)
    assert [p.name for p in tmp_path.iterdir()] == ["file"]


def test_i7_a_full_disk_is_one_line_and_leaves_nothing(tmp_path, monkeypatch):
    class Full:
        meta: ClassVar = {}

        def copy(self, **_):
            return self

        def write(self, name, **_):
            with open(name, "w") as file:
                file.write("half")
            raise OSError(28, "No space left on device")

    with pytest.raises(FileError, match=r"t\.ecsv cannot be written: No space left on device"):
        write_ecsv(Full(), tmp_path / "t.ecsv")
    assert not any(tmp_path.iterdir())


# C5, item 4: tables of LoSoTo, prefactor, LINC ----------------------------------------------------------------------


def soltab(solset, name, kind, axes, val, weight=None, **along):
    """A soltab as LoSoTo writes it."""
    group = solset.create_group(name)
    group.attrs["TITLE"] = np.bytes_(kind)
    coordinates = {"time": SLOTS, "freq": FREQS, "ant": np.array(NAMES, "S16"), "pol": np.array(["XX", "YY"], "S2")}
    coordinates |= along
    for axis in axes.split(","):
        group[axis] = coordinates[axis]
    shape = [len(coordinates[axis]) for axis in axes.split(",")]
    group["val"] = np.broadcast_to(np.asarray(val, float), shape)
    group["weight"] = np.ones(shape, np.float16) if weight is None else weight
    for array in ("val", "weight"):
        group[array].attrs["AXES"] = np.bytes_(axes)
    return group


@pytest.fixture
def calibrator(tmp_path):
    """A solset as the calibrator pipelines of LOFAR leave it: each effect in a table of its own."""
    path = tmp_path / "cal.h5"
    with h5py.File(path, "w") as store:
        solset = store.create_group("calibrator")
        gain = 1 + np.arange(12.0).reshape(3, 2, 2)  # ant, freq, pol
        soltab(solset, "bandpass", "amplitude", "ant,freq,pol", gain)
        soltab(solset, "polalign", "phase", "ant,freq,pol", 0.1 * gain)
        soltab(solset, "clock", "clock", "time,ant", 1e-9)
        soltab(solset, "faraday", "rotationmeasure", "ant,time", 0.5)
        soltab(solset, "tec000", "tec", "dir,ant,time", 0.1, dir=np.array(["[a]", "[b]"], "S8"))
    return path


def test_c5_a_bandpass_without_a_time_axis_is_constant_in_time(calibrator):
    bandpass = read_h5parm(calibrator, soltabs=["bandpass"])
    for seconds in (0.0, 5e4, 1e8):
        found = bandpass.jones(at(seconds, np.array([149e6, 150e6])))
        assert found.shape == (1, 2, 3, 1, 2, 2)
        assert np.array_equal(found[0, :, :, 0, 0, 0], (1 + np.arange(12.0).reshape(3, 2, 2)[:, :, 0]).T)
        assert np.array_equal(found[0, :, :, 0, 1, 1], (1 + np.arange(12.0).reshape(3, 2, 2)[:, :, 1]).T)
    both = read_h5parm(calibrator, soltabs=["bandpass", "polalign"]).jones(at())
    assert both[0, 0, 1, 0, 1, 1] == pytest.approx(6 * np.exp(0.6j))
    with pytest.raises(InputError, match="frequency"):
        bandpass.jones(at(0.0, 60e6))


def test_c5_phases_without_a_frequency_axis_are_constant_in_frequency(tmp_path):
    path = tmp_path / "s.h5"
    with h5py.File(path, "w") as store:
        phase = np.arange(24.0).reshape(4, 3, 2) / 10
        soltab(store.create_group("sol000"), "phase000", "phase", "time,ant,pol", phase)
    found = read_h5parm(path)
    for freq in (30e6, 149e6, 240e6):
        assert found.jones(at(10.0, freq))[0, 0, 2, 0, 1, 1] == pytest.approx(np.exp(1.1j))
    with pytest.raises(InputError, match="time"):
        found.jones(at(1e5))


def test_c5_an_amplitude_without_time_and_a_phase_with_it_go_together(tmp_path):
    path = tmp_path / "s.h5"
    with h5py.File(path, "w") as store:
        solset = store.create_group("sol000")
        soltab(solset, "amplitude000", "amplitude", "ant,freq,pol", 3.0)
        soltab(solset, "phase000", "scalarphase", "time,ant", np.arange(12.0).reshape(4, 3) / 10)
    found = read_h5parm(path)
    assert found.values.shape == (4, 2, 3, 2, 2)
    assert found.jones(at(20.0))[0, 0, 1, 0] == pytest.approx(3 * np.exp(0.7j) * np.eye(2))


def test_c5_what_is_constant_is_written_without_that_axis_and_reads_back(tmp_path, calibrator):
    bandpass = read_h5parm(calibrator, soltabs=["bandpass", "polalign"])
    write_h5parm(tmp_path / "again.h5", bandpass, "diagonal")
    with h5py.File(tmp_path / "again.h5") as store:
        assert store["sol000/phase000/val"].attrs["AXES"] == b"freq,ant,pol"
    assert np.abs(read_h5parm(tmp_path / "again.h5").values - bandpass.values).max() < 1e-14


@pytest.mark.parametrize(
    "tables, message",
    [
        (
            ["clock"],
            "has bandpass, clock, faraday .rotationmeasure., polalign, tec000; .* clock is a phase of 2 pi freq",
        ),
        (["faraday"], "rotationmeasure is a rotation by RM"),
        (["tec000"], "tec is a phase of -8.4479745e9 tec / freq: make a phase soltab of it"),
        (None, "needs one soltab of amplitudes, one of phases, or both"),
    ],
)
def test_c5_tables_from_which_gains_only_follow_are_refused_by_name(calibrator, tables, message):
    with pytest.raises(FileError, match=message) as error:
        read_h5parm(calibrator, soltabs=tables)
    assert "\n" not in str(error.value) and "cal.h5" in str(error.value)


# C6: directions -----------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def directional():
    enu = np.random.default_rng(0).normal(size=(6, 3)) * [2000, 2000, 1]
    layout = Layout.from_enu(list("abcdef"), enu * u.m, 6.9 * u.deg, 52.9 * u.deg, 0 * u.m)
    night = Observation(
        phase_centre="08h13m36.0s +48d13m03s", transit="2012-12-07", duration=60 * u.s, interval=10 * u.s,
        frequencies=[150] * u.MHz,
    )  # fmt: skip
    centre = SkyCoord("08h13m36.0s +48d13m03s")
    models = {}
    for name, offset in (("east", 3.0), ("west", -4.0)):
        sky = PointSky.at(centre.spherical_offsets_by(offset * u.deg, 1 * u.deg), [10.0])
        models[name] = Scene(instrument=Composed(stations=layout), sky=sky, observation=night).plan().run()
    data = models["east"].with_data(sum(m.data for m in models.values()))
    return data, models, centre


@pytest.mark.parametrize("intervals", [{}, {"west": 30 * u.s}, {"east": 20 * u.s, "west": 30 * u.s}])
def test_c6_a_directional_solution_is_written_with_its_axis_dir_and_reads_back(tmp_path, directional, intervals):
    data, models, centre = directional
    solved = DirectionalCal(intervals=intervals, interval=20 * u.s).solve(data, models)
    drawn = np.random.default_rng(1)
    clusters = {}
    for name, one in solved.clusters.items():  # values that tell every interval and station from every other
        values = np.eye(2) + 0.3 * drawn.normal(size=(*one.jones.shape[:3], 2, 2))
        clusters[name] = type(one)(**{**vars(one), "term": one.term.with_fields(values=values)})
    write_h5parm(tmp_path / "d.h5", DirectionalSolution(clusters), at=data.at, directions={"east": centre})
    with h5py.File(tmp_path / "d.h5") as store:
        assert store["sol000/phase000/val"].attrs["AXES"] == b"time,freq,ant,dir,pol"
        assert list(store["sol000/phase000/dir"]) == [b"[east]", b"[west]"]
        assert [bytes(x) for x in store["sol000/source"]["name"]] == [b"[east]", b"[west]"]
        assert np.allclose(store["sol000/source"]["dir"][0], [centre.ra.rad, centre.dec.rad], rtol=1e-14)
        assert np.isnan(store["sol000/source"]["dir"][1]).all()
    for name, solution in clusters.items():
        read = read_h5parm(tmp_path / "d.h5", data.layout, direction=name)
        # the same at every integration, whatever the grid of times
        assert np.abs(read.jones(data.at) - solution.term.jones(data.at)).max() < 1e-14


# I5, I8, I9: files that anyone may have prepared --------------------------------------------------------------------


def edit(path, change):
    write_h5parm(path, table())
    with h5py.File(path, "r+") as store:
        change(store["sol000/amplitude000"])
    return path


def replaced(name, **how):
    def change(group):
        axes = group[name].attrs.get("AXES")
        del group[name]
        made = group.create_dataset(name, **how)
        if axes is not None:
            made.attrs["AXES"] = axes

    return change


def huge(group):
    """Axes and values that agree, never written: 2 x 3.2e9 numbers in a file of 40 kB."""
    for name, shape in (("time", (10**8,)), ("val", (10**8, 2, 3, 4)), ("weight", (10**8, 2, 3, 4))):
        replaced(name, shape=shape, dtype="f8", chunks=(1000, *shape[1:]))(group)


def group_for(name):
    def change(group):
        del group[name]
        group.create_group(name).attrs["AXES"] = "time,freq,ant,pol"

    return change


def elsewhere(link):
    def change(group):
        del group["val"]
        group["val"] = link

    return change


def virtual(group):
    layout = h5py.VirtualLayout(shape=(4, 2, 3, 4), dtype="f8")
    layout[...] = h5py.VirtualSource("secret.h5", "x", shape=(4, 2, 3, 4))
    del group["val"]
    group.create_virtual_dataset("val", layout).attrs["AXES"] = "time,freq,ant,pol"


@pytest.mark.parametrize(
    "change, message",
    [
        (replaced("time", shape=(10**9,), dtype="f8", chunks=(1000,)), r"'val' has shape \(4, 2, 3, 4\), its axes"),
        (huge, "declares .* in a file of .*; it is damaged, or made to fill the memory"),
        (group_for("val"), "'val' is a group, needed an array"),
        (group_for("ant"), "'ant' is a group, needed an array"),
        (replaced("val", data=h5py.Empty("f8")), "'val' holds float64, needed an array of numbers"),
        (replaced("ant", data=np.arange(3)), "holds int64, needed a list of names"),
        (replaced("freq", data=np.array(["a", "b"], "S1")), "holds .*, needed numbers"),
        (replaced("val", data=np.full((4, 2, 3, 4), -0.3)), "an amplitude is -0.3: negative ones belong into a phase"),
        (replaced("weight", data=np.full((4, 2, 3, 4), -1.0)), "a weight is negative"),
        (replaced("time", data=SLOTS * np.nan), "differ in axis 'time'"),
        (replaced("ant", data=["x" * 10**5, "b", "c"]), "a name of 100000 characters"),
        (lambda g: g["val"].attrs.update(AXES=np.arange(3)), "axes 0 of 'val'"),
        (lambda g: g["val"].attrs.update(AXES="\x1b[31m,ant"), r"axes \\x1b\[31m,ant of 'val'"),
        (elsewhere(h5py.ExternalLink("secret.h5", "/x")), "in the file 'secret.h5', which is not opened; copy it in"),
        (elsewhere(h5py.SoftLink("/sol000/phase000/val")), "only points to something elsewhere"),
        (virtual, "'val' lies in other files, which are not opened"),
        (
            replaced("val", shape=(4, 2, 3, 4), dtype="f8", external=[("secret.bin", 0, 768)]),
            "'val' lies in other files, which are not opened",
        ),
    ],
)
def test_i5_i8_i9_a_prepared_h5parm_is_refused_in_a_line_and_names_nothing_that_is_opened(
    tmp_path, monkeypatch, change, message
):
    monkeypatch.chdir(tmp_path)
    with h5py.File("secret.h5", "w") as store:
        store["x"] = np.ones((4, 2, 3, 4))
    (tmp_path / "secret.bin").write_bytes(np.ones(96).tobytes())
    path = edit(tmp_path / "s.h5", change)
    tracemalloc.start()
    with pytest.raises(FileError, match=message) as error:
        read_h5parm(path, soltabs=["amplitude000", "phase000"])
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 20e6
    assert "\n" not in str(error.value) and "\x1b" not in str(error.value) and "s.h5" in str(error.value)


def test_i5_a_pipe_a_folder_and_a_text_are_no_h5parm(tmp_path):
    os.mkfifo(tmp_path / "pipe")
    (tmp_path / "text.h5").write_text("no HDF5")
    cases = {"pipe": "a pipe or a device", ".": "a folder", "none.h5": "does not exist", "text.h5": "not a readable"}
    for name, message in cases.items():
        with pytest.raises(FileError, match=message):
            read_h5parm(tmp_path / name)
