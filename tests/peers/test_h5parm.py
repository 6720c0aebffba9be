"""Solutions as h5parm: ours applied by DP3, and those of DP3's gaincal and ddecal applied by us.

Eight stations, six slots, four channels, 25 unpolarized sources. DP3 applies solutions in complex64.
"""

import importlib.util
import subprocess
import sys

import numpy as np
import pytest
from astropy import units as u

import instrument
from instrument import JonesTable, Observation, Scene, SelfCal
from instrument.files.solutions import read_h5parm, write_h5parm

pytestmark = pytest.mark.peer
tables = pytest.importorskip("casacore.tables")
if importlib.util.find_spec("dp3") is None:
    pytest.skip("DP3 is not installed", allow_module_level=True)

PROGRAM = "from dp3 import entrypoint; import sys; sys.exit(entrypoint())"
STATIONS = ["CS001HBA0", "CS001HBA1", "CS002HBA0", "CS003HBA1", "CS302HBA1", "RS106HBA", "RS205HBA", "RS508HBA"]
FULL = {"applycal.correction": "fulljones", "applycal.soltab": "[amplitude000,phase000]"}
BOTH = {"applycal.steps": "[amp,phase]"} | {
    f"applycal.{step}.correction": f"{kind}000" for step, kind in (("amp", "amplitude"), ("phase", "phase"))
}
PHASE = {"applycal.correction": "phase000"}


class Case:
    """A data set on disk: `model`, and `data` corrupted by `truth` (rms 0.1 about 1), as complex64 holds them."""

    def __init__(self, folder, environment, make_ms):
        self.folder, self.environment = folder, environment
        night = Observation(
            phase_centre="08h13m36.0s +48d13m03s",
            transit="2012-12-07",
            duration=60 * u.s,
            interval=10 * u.s,
            frequencies=[149.7, 149.9, 150.1, 150.3] * u.MHz,
            channel_width=0.2 * u.MHz,
        )
        make_ms(
            folder / "s.MS",
            instrument.load("telescopes", "lofar-hba", stations=STATIONS),
            night,
            ("DATA", "MODEL_DATA"),
        )
        bare = instrument.load("telescopes", "lofar-hba", stations=STATIONS, beam=None)
        sky = instrument.load("skies", "grid", shape=(5, 5), spacing=1 * u.deg, flux=5 * u.Jy)
        model = Scene(instrument=bare, sky=sky, observation=night).plan().run()
        rng = np.random.default_rng(1)
        noise = rng.normal(size=(2, 6, 1, 8, 2, 2)) * 0.1 / np.sqrt(2)
        values = np.repeat(np.eye(2) + noise[0] + 1j * noise[1], 4, axis=1)
        self.truth = JonesTable(values=values, slots_s=model.at.slots_s, freq_hz=model.freq_hz, stations=STATIONS)
        self.model = model.with_data(model.data.astype(np.complex64))
        self.data = model.corrupted(self.truth).with_data(model.corrupted(self.truth).data.astype(np.complex64))
        with tables.table(str(folder / "s.MS"), readonly=False, ack=False) as ms:
            for column, vis in (("DATA", self.data), ("MODEL_DATA", self.model)):
                ms.putcol(column, vis.data.swapaxes(1, 2).reshape(-1, 4, 4))

    def dp3(self, step, **settings):
        """Run one step of DP3 on the set."""
        found = {"msin": "s.MS", "msout": "", "steps": f"[{step}]", "numthreads": 2} | settings
        # a process of its own: DP3 waits for ever for tables that are open in this one
        command = [sys.executable, "-c", PROGRAM, *(f"{k}={v}" for k, v in found.items())]
        done = subprocess.run(
            command, env=self.environment, cwd=self.folder, capture_output=True, text=True, timeout=300
        )
        assert done.returncode == 0, done.stdout[-2000:] + done.stderr[-2000:]

    def applied(self, file, how):
        """Data that DP3 corrected with a file, (T, F, B, 2, 2), and its flags (T, F, B)."""
        clear = np.zeros((6 * 28, 4, 4), bool)
        with tables.table(str(self.folder / "s.MS"), readonly=False, ack=False) as ms:
            ms.putcol("FLAG", clear)
        self.dp3("applycal", **{"msout": ".", "msout.datacolumn": "APPLIED", "applycal.parmdb": file} | how)
        with tables.table(str(self.folder / "s.MS"), readonly=False, ack=False) as ms:
            data, flag = (ms.getcol(n).reshape(6, 28, 4, 4).swapaxes(1, 2) for n in ("APPLIED", "FLAG"))
            ms.putcol("FLAG", clear)
        return data.reshape(6, 4, 28, 2, 2), flag.all(axis=-1)


@pytest.fixture(scope="module")
def case(make_ms, peer_environment, tmp_path_factory):
    return Case(tmp_path_factory.mktemp("h5parm"), peer_environment, make_ms)


def error(found, wanted, what, good=...):
    worst = np.sqrt(np.mean(np.abs(found[good] - wanted[good]) ** 2) / np.mean(np.abs(wanted[good]) ** 2))
    print(f"{what}: {worst:.2e} rms")
    return worst


@pytest.mark.parametrize(("pattern", "how"), [("full", FULL), ("diagonal", BOTH), ("scalar", BOTH), ("phase", PHASE)])
def test_dp3_applies_our_file_as_we_do(case, pattern, how):
    values = np.array(case.truth.values)
    if pattern != "full":
        values = values * np.eye(2)
    if pattern == "scalar":
        values = values[..., :1, :1] * np.eye(2)
    if pattern == "phase":
        values = np.exp(1j * np.angle(values)) * np.eye(2)
    term = case.truth.with_fields(values=values)
    write_h5parm(case.folder / "ours.h5", term, pattern, at=case.data.at, overwrite=True)
    data, flag = case.applied("ours.h5", how)
    assert not flag.any()
    assert error(data, case.data.corrected(term).data, f"{pattern}, applied by DP3") < 2e-7  # measured below 1e-7


def test_dp3_flags_what_we_flag(case):
    """NaN, one entry NaN, a gain of zero and a matrix without inverse: DP3 alone would pass the last two on."""
    values = np.array(case.truth.values)
    values[2, :, 3] = np.nan
    values[4, 1, 5, 0, 1] = np.nan
    values[1, :, 2] = 0
    values[3, :, 4] = 1
    term = case.truth.with_fields(values=values)
    write_h5parm(case.folder / "ours.h5", term, at=case.data.at, overwrite=True)
    data, flag = case.applied("ours.h5", FULL)
    wanted = case.data.corrected(term)
    assert np.array_equal(flag, wanted.flag)
    assert flag.sum() == 7 * (4 + 1 + 4 + 4)
    assert error(data, wanted.data, "with flags", ~flag) < 2e-7


def test_dp3_applies_coarse_solutions_to_the_same_slots_and_channels(case):
    """Two solutions in time and two in frequency: both take the nearest."""
    at = case.data.at
    coarse = JonesTable(
        values=np.array(case.truth.values)[:2, :2] * np.array([1.0, 1.2])[:, None, None, None],
        slots_s=at.slots_s.reshape(2, 3).mean(axis=1),
        freq_hz=at.freq_hz.reshape(2, 2).mean(axis=1),
        stations=STATIONS,
    )
    write_h5parm(case.folder / "ours.h5", coarse, at=at, overwrite=True)
    data, _ = case.applied("ours.h5", FULL)
    assert error(data, case.data.corrected(coarse).data, "coarse, applied by DP3") < 2e-7


def test_our_selfcal_solution_corrects_the_data_in_dp3(case):
    solution = SelfCal(tolerance=1e-10).solve(case.data, case.model)
    write_h5parm(case.folder / "ours.h5", solution, at=case.data.at, overwrite=True)
    data, flag = case.applied("ours.h5", FULL)
    assert not flag.any()
    assert error(data, case.model.data, "our solution, applied by DP3, minus the model") < 3e-7


@pytest.mark.parametrize(("tolerance", "bound"), [(1e-5, 1e-4), (1e-8, 2e-7)])
def test_a_full_jones_file_of_gaincal_corrects_as_it_does_in_dp3(case, tolerance, bound):
    settings = {
        "caltype": "fulljones", "usemodelcolumn": "true", "parmdb": "gain.h5", "solint": 1, "nchan": 1,
        "tolerance": tolerance, "maxiter": 500, "detectstalling": "false",
    }  # fmt: skip
    case.dp3("gaincal", **{f"gaincal.{k}": v for k, v in settings.items()})
    corrected = case.data.corrected(read_h5parm(case.folder / "gain.h5", layout=case.data.layout))
    assert not corrected.flag.any()
    data, _ = case.applied("gain.h5", FULL)
    assert error(corrected.data, data, f"gaincal at {tolerance:g}, ours against applycal") < 2e-7
    assert error(corrected.data, case.model.data, "corrected minus model") < bound


@pytest.mark.parametrize(("kind", "how"), [("diagonal", BOTH), ("diagonalphase", PHASE), ("scalarphase", PHASE)])
def test_files_of_gaincal_with_fewer_entries_are_read(case, kind, how):
    settings = {"caltype": kind, "usemodelcolumn": "true", "parmdb": f"{kind}.h5", "solint": 2}
    case.dp3("gaincal", **{f"gaincal.{k}": v for k, v in settings.items()})
    term = read_h5parm(case.folder / f"{kind}.h5", layout=case.data.layout)
    data, _ = case.applied(f"{kind}.h5", how)
    assert error(case.data.corrected(term).data, data, f"{kind}, ours against applycal") < 2e-7


def test_a_file_of_ddecal_with_two_directions_is_read_one_by_one(case):
    (case.folder / "sky.txt").write_text(
        "FORMAT = Name, Type, Patch, Ra, Dec, I, Q, U, V\n"
        ", , east, 124deg, 48deg\n, , west, 122deg, 48deg\n"
        "a, POINT, east, 124deg, 48deg, 50, 0, 0, 0\nb, POINT, west, 122deg, 48deg, 50, 0, 0, 0\n"
    )
    settings = {"mode": "fulljones", "sourcedb": "sky.txt", "h5parm": "two.h5", "solint": 2, "maxiter": 5}
    case.dp3("ddecal", **{f"ddecal.{k}": v for k, v in settings.items()})
    with pytest.raises(instrument.InputError, match=r"2 directions \(\[east\], \[west\]\); choose one"):
        read_h5parm(case.folder / "two.h5")
    for name in ("east", "west"):
        term = read_h5parm(case.folder / "two.h5", layout=case.data.layout, direction=name)
        data, flag = case.applied("two.h5", FULL | {"applycal.direction": f"[{name}]"})
        wanted = case.data.corrected(term)
        assert error(data, wanted.data, f"direction {name}, ours against applycal", ~(flag | wanted.flag)) < 4e-7
