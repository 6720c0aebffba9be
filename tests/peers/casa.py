"""CASA as a process of its own: the Python that has casatools, and where its tables are."""

import os
import subprocess
import sys
from pathlib import Path

import pytest


def run(script, folder, *words):
    """Run a script with casatools, or skip; `CASA_PYTHON` may name the Python that has it."""
    python = os.environ.get("CASA_PYTHON", sys.executable)
    ask = "import importlib.util as u; raise SystemExit(u.find_spec('casatools') is None)"
    if subprocess.run([python, "-c", ask]).returncode:
        pytest.skip("casatools is not installed (or name its Python in CASA_PYTHON)")
    data = Path(pytest.importorskip("casacore").__file__).parent / "data"
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
