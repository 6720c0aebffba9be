"""Sets that DP3 writes: averaged, and compressed with Dysco; read as DP3 has them, predicted into with their UVW."""

import importlib.util
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from astropy import units as u

import instrument
from instrument import MeasurementSet, Observation, Scene
from instrument.errors import FileError, InstrumentWarning

pytestmark = pytest.mark.peer
tables = pytest.importorskip("casacore.tables")
pytest.importorskip("arcae")
if importlib.util.find_spec("dp3") is None:
    pytest.skip("DP3 is not installed", allow_module_level=True)
spec = importlib.util.spec_from_file_location("with_dp3", Path(__file__).with_name("test_dp3.py"))
with_dp3 = importlib.util.module_from_spec(spec)
spec.loader.exec_module(with_dp3)
BY = f"written by instrument {instrument.__version__}"
STATIONS = ["CS001HBA0", "CS002HBA1", "CS003HBA0", "CS302HBA1", "RS106HBA"]
NIGHT = Observation(
    phase_centre="08h13m36.0s +48d13m03s", transit="2012-12-07", duration=40 * u.s, interval=10 * u.s,
    frequencies=(150 + 0.1 * np.arange(4)) * u.MHz, channel_width=0.1 * u.MHz,
)  # fmt: skip


def dp3(folder, environment, **words):
    (folder / "p.parset").write_text("".join(f"{name} = {value}\n" for name, value in words.items()))
    program = "from dp3 import entrypoint; import sys; sys.exit(entrypoint())"
    done = subprocess.run(
        [sys.executable, "-c", program, str(folder / "p.parset")], capture_output=True, text=True, env=environment,
        timeout=300,
    )  # fmt: skip
    assert done.returncode == 0, done.stdout[-2000:] + done.stderr[-2000:]


@pytest.fixture(scope="module")
def ours(tmp_path_factory):
    """A set of ours with data of a sky, two channels and integrations each of which DP3 will average; the sky."""
    folder = tmp_path_factory.mktemp("ours")
    lofar = instrument.load("telescopes", "lofar-hba", stations=STATIONS, beam=None)
    sky = instrument.load("skies", "grid", shape=(3, 3), spacing=1 * u.deg, flux=5 * u.Jy).about(NIGHT.phase_centre)
    vis = Scene(instrument=lofar, sky=sky, observation=NIGHT).plan().run()
    whole = instrument.load("telescopes", "lofar-hba", stations=STATIONS)
    MeasurementSet.create(folder / "a.MS", vis, instrument=whole)
    return folder, vis, sky


def test_an_averaged_set_of_dp3_is_read_predicted_into_and_corrected(ours, peer_environment):
    folder, vis, sky = ours
    dp3(folder, peer_environment, msin=folder / "a.MS", msout=folder / "b.MS", steps="[average]",
        **{"average.timestep": 2, "average.freqstep": 2, "msout.overwrite": True})  # fmt: skip
    found = next(MeasurementSet(folder / "b.MS").blocks())
    mean = vis.data.reshape(2, 2, 2, 2, -1, 2, 2).mean(axis=(1, 3))
    assert found.layout.names == tuple(STATIONS) and np.allclose(found.interval_s, 20)
    assert with_dp3.error(found.data, mean, "averaged by DP3") < 2e-7
    where = with_dp3.sky_file(folder, sky)
    dp3(folder, peer_environment, msin=folder / "b.MS", msout=".", steps="[predict]",
        **{"predict.sourcedb": where, "msout.datacolumn": "PREDICTED"})  # fmt: skip
    one = MeasurementSet(folder / "b.MS", "PREDICTED")
    theirs = np.concatenate([block.data for block in one.blocks()])
    lofar = instrument.load("telescopes", "lofar-hba", stations=STATIONS, beam=None)
    made = Scene(instrument=lofar, sky=sky, observation=one.observation()).plan(engine="matrix").run()
    assert with_dp3.error(made.data, theirs, "predicted into the set of DP3") < 5e-8
    one.write("MODEL_DATA", made)
    with tables.table(str(folder / "b.MS"), ack=False) as ms:
        assert ms.getcol("MODEL_DATA").shape == ms.getcol("DATA").shape
    dp3(folder, peer_environment, msin=folder / "b.MS", msout=folder / "c.MS", steps="[]",
        **{"msin.datacolumn": "MODEL_DATA", "msout.overwrite": True})  # fmt: skip
    again = np.concatenate([block.data for block in MeasurementSet(folder / "c.MS").blocks()])
    assert np.array_equal(again, made.data.astype(np.complex64))
    with tables.table(str(folder / "c.MS::HISTORY"), ack=False) as history:  # of DP3, with our rows and its own
        said, by = history.getcol("MESSAGE"), history.getcol("APPLICATION")
        assert history.getcell("CLI_COMMAND", said.index(f"column MODEL_DATA {BY}")) == ["-"]
    assert said[0] == f"set {BY}" and "DP3" in {name.strip() for name in by}


def test_a_compressed_set_is_read_or_its_manager_named(ours, peer_environment):
    folder, vis, _ = ours
    dp3(folder, peer_environment, msin=folder / "a.MS", msout=folder / "d.MS", steps="[]",
        **{"msout.storagemanager": "dysco", "msout.overwrite": True})  # fmt: skip
    try:
        found = next(MeasurementSet(folder / "d.MS").blocks())
    except FileError as error:
        assert "ysco" in str(error) and "storage manager" in str(error) and len(str(error).splitlines()) == 1
    else:
        assert with_dp3.error(found.data, vis.data, "compressed by Dysco") < 0.01
        with pytest.warns(InstrumentWarning, match="keeps visibilities to .* of their rms only"):
            MeasurementSet(folder / "d.MS").write("DATA", vis, overwrite=True)
