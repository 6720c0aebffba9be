"""What a process has had in memory: its own, and not that of the one that started it."""

import subprocess
import sys

import numpy as np
import pytest

from instrument.memory import high_water


@pytest.mark.skipif(sys.platform != "linux", reason="elsewhere getrusage tells of the process alone")
def test_the_peak_of_a_process_is_not_that_of_its_parent():
    """A notebook of 600 MB that starts a run: what that plans and measures begins with an interpreter."""
    held = np.ones(75_000_000)
    assert high_water() > held.nbytes
    words = [sys.executable, "-c", "from instrument.memory import high_water; print(high_water())"]
    done = subprocess.run(words, capture_output=True, text=True, check=True)
    assert 5e6 < float(done.stdout) < 3e8
