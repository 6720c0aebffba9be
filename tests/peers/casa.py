"""CASA as a process of its own: the Python that has casatools, and where its tables are."""

import os
import subprocess
import sys
from pathlib import Path

import pytest


def run(script, folder, *words):
    """Run a script with casatools, or skip; `CASA_PYTHON` may name the Python that has it."""
    python = os.environ.get("CASA_PYTHON", sys.executable)
    ask = "import importlib.util as u; assert u.find_spec('casatools'); print(u.find_spec('casacore').origin)"
    told = subprocess.run([python, "-c", ask], capture_output=True, text=True)
    if told.returncode:
        pytest.skip("casatools and casacore's data are not installed (or name their Python in CASA_PYTHON)")
    data = Path(told.stdout.strip()).parent / "data"
    site = folder / "casasite.py"
    site.write_text(
        f"measurespath = '{data}'\ndatapath = ['{data}']\nmeasures_auto_update = data_auto_update = False\n"
        "nologger = True\nlogfile = '/dev/null'\n"
    )
    environment = os.environ | {"CASASITECONFIG": str(site), "CASARCFILES": os.devnull}
    done = subprocess.run(
        [python, "-c", script, *map(str, words)], capture_output=True, text=True, cwd=folder, env=environment
    )
    assert done.returncode == 0, done.stderr[-2000:]
