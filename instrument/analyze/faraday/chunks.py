"""Work on chunks of pixels: on all cores, into an array in memory or into a file that is mapped."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from typing import Any

import numpy as np

from instrument.predict.threads import alone, look_again
from instrument.units import Complex
from instrument.whole_file import whole_file


def in_threads(
    work: Callable[[int], Any],
    firsts: range,
    progress: Callable[[float], None] | None = None,
    release: Callable[[], None] = lambda: None,
    every: int = 1,
) -> list[Any]:
    """Results of `work` for every start of a chunk, in order, on all cores with one BLAS thread each.

    `release` is called after `every` chunks; the first error stops what has not begun.
    """
    found = []
    look_again()
    with ThreadPoolExecutor(os.cpu_count() or 1) as pool:
        jobs = [pool.submit(alone, work, first) for first in firsts]
        try:
            for done, job in enumerate(jobs, 1):
                found.append(job.result())
                if done % every == 0:
                    release()
                if progress is not None:
                    progress(done / len(jobs))
        finally:
            pool.shutdown(cancel_futures=True)
    return found


@contextmanager
def allocated(
    shape: tuple[int, int], dtype: Any, out: str | os.PathLike[str] | None
) -> Iterator[tuple[Complex, Callable[[], None]]]:
    """An array to fill, in memory or in a .npy file that is whole or not there, and what lets go of written pages."""
    if out is None:
        yield np.empty(shape, dtype), lambda: None
        return
    import mmap
    import sys

    with whole_file(out) as partial:
        held = np.lib.format.open_memmap(partial, mode="w+", dtype=dtype, shape=shape)
        pages: Any = held.base  # the mmap
        release = (lambda: None) if sys.platform == "win32" else lambda: pages.madvise(mmap.MADV_DONTNEED)
        yield held.view(np.ndarray), release
        held.flush()
