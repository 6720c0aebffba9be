"""What the reports beside DP3 share: its environment, the maker of Measurement Sets, timing of whole processes."""

import importlib.util
import os
import subprocess
import tempfile
import time
from importlib.metadata import files
from pathlib import Path

DP3 = "from dp3 import entrypoint; import sys; sys.exit(entrypoint())"


def peer_tools(folder):
    """Set the environment that casacore and EveryBeam need, in `folder`; the module that makes Measurement Sets."""
    import casacore

    (folder / "casarc").write_text(f"measures.directory: {Path(casacore.__file__).parent / 'data'}\n")
    os.environ["CASARCFILES"] = str(folder / "casarc")
    os.environ["EVERYBEAM_DATADIR"] = everybeam_data()
    where = Path(__file__).parents[2] / "tests" / "peers" / "lofar_ms.py"
    spec = importlib.util.spec_from_file_location("lofar_ms", where)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def timed(command, environment):
    """Wall seconds and peak memory in MB of a process."""
    begin = time.perf_counter()
    with tempfile.TemporaryFile() as said:
        child = subprocess.Popen(command, env=environment, stdout=said, stderr=subprocess.STDOUT)
        _, status, used = os.wait4(child.pid, 0)
        child.returncode = os.waitstatus_to_exitcode(status)
        said.seek(0)
        assert child.returncode == 0, said.read().decode()[-2000:]
    return time.perf_counter() - begin, used.ru_maxrss / 1e3


def everybeam_data():
    """Folder of the coefficients that the everybeam package carries."""
    found = next(f for f in files("everybeam") if f.name == "HamakerHBACoeff.h5")
    return str(Path(found.locate()).resolve().parent)
