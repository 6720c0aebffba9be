"""One core and one thread for all that this process will load, so that no program gains by threads."""

import os
import sys

# the libraries take their number of threads from the environment when they are loaded
THREADS = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "NUMBA_NUM_THREADS", "DUCC0_NUM_THREADS")


def one_thread() -> None:
    """Take one core of those that are there, and one thread; nothing changes once numpy is loaded."""
    if "numpy" in sys.modules:
        return
    os.environ.update(dict.fromkeys(THREADS, "1"))
    if hasattr(os, "sched_setaffinity"):
        os.sched_setaffinity(0, [min(os.sched_getaffinity(0))])
