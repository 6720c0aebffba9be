"""What the reports beside DP3 share: its environment, the maker of Measurement Sets, timing of whole processes."""

import os
import re
import subprocess
import tempfile
import time
from importlib.metadata import files
from pathlib import Path

QUIET = {"OPENBLAS_NUM_THREADS": "1"}
DP3 = "from dp3 import entrypoint; import sys; sys.exit(entrypoint())"


def peer_tools(folder):
    """Set the environment that casacore and EveryBeam need, in `folder`; the module that makes Measurement Sets."""
    import casacore

    (folder / "casarc").write_text(f"measures.directory: {Path(casacore.__file__).parent / 'data'}\n")
    os.environ["CASARCFILES"] = str(folder / "casarc")
    os.environ["EVERYBEAM_DATADIR"] = everybeam_data()
    from instrument.precision import lofar_ms

    return lofar_ms


def process(command, environment):
    """Wall seconds, peak memory in MB, processor seconds and all that was said by a process."""
    begin = time.perf_counter()
    with tempfile.TemporaryFile() as said:
        child = subprocess.Popen(command, env=environment, stdout=said, stderr=subprocess.STDOUT)
        _, status, used = os.wait4(child.pid, 0)
        wall = time.perf_counter() - begin
        child.returncode = os.waitstatus_to_exitcode(status)
        said.seek(0)
        text = said.read().decode(errors="replace")
    assert child.returncode == 0, text[-2000:]
    return wall, used.ru_maxrss / 1e3, used.ru_utime + used.ru_stime, text


def timed(command, environment):
    """Wall seconds and peak memory in MB of a process."""
    return process(command, environment)[:2]


def everybeam_data():
    """Folder of the coefficients that the everybeam package carries."""
    found = next(f for f in files("everybeam") if f.name == "HamakerHBACoeff.h5")
    return str(Path(found.locate()).resolve().parent)


def measured(ways, runs, error, count):
    """Best wall s, best processor s, that of the first solution; what `error(way, said)` gives; by way, in turn.

    What takes more than 10 s beyond the first solution is run once.
    """
    found = {}
    for run in range(runs):
        for name, (whole, first) in ways.items():
            best, result = found.get(name, ((float("inf"),) * 3, None))
            if run and best[1] - best[2] > 10:
                continue
            begun = process(first, QUIET | os.environ)[2]
            wall, _, spent, said = process(whole, QUIET | os.environ)
            best = tuple(map(min, best, (wall, spent, begun)))
            found[name] = best, result or error(name, said)
            print(name, *found[name], flush=True)
    return {
        name: ((wall, spent, 1e3 * (spent - begun) / (count - 1)), *result)
        for name, ((wall, spent, begun), result) in found.items()
    }


def told(said, count):
    """How many integrations converged, as ours and gaincal print it."""
    found = re.search(r"[Cc]onverged: *(\d+)", said)
    return f"{found.group(1)} of {count}" if found else "not told"


def row_of(case, name, found):
    (wall, spent, one), value, converged = found
    return f"| {case} | {name} | {value:.1e} | {converged} | {one:.1f} | {spent:.1f} | {wall:.1f} |"


HEAD = """| case | solver, tolerance | error | converged | ms a solution | processor s | wall s |
|---|---|---|---|---|---|---|"""
