"""BLAS on one thread inside the workers of plans and solvers, and nowhere else: the workers are the threads."""

from __future__ import annotations

from collections.abc import Callable
from functools import cache
from threading import Lock
from typing import Any, TypeVar

R = TypeVar("R")


class OneThread:
    """A limit that holds while any worker is inside; the last one to leave puts back what was there before.

    BLAS counts its threads per process, so a limit for the whole of a run would also bind whoever takes its blocks.
    """

    def __init__(self) -> None:
        self.lock, self.inside, self.limit = Lock(), 0, None

    def __enter__(self) -> None:
        with self.lock:
            if self.inside == 0:
                _release()
                self.limit = _controller().limit(limits=1)
            self.inside += 1

    def __exit__(self, *_: Any) -> None:
        with self.lock:
            self.inside -= 1
            if self.inside == 0 and self.limit is not None:
                _release()
                self.limit.restore_original_limits()
                _release()
                self.limit = None


@cache
def _controller() -> Any:
    from threadpoolctl import ThreadpoolController

    return ThreadpoolController()  # looks through all loaded libraries: 2 ms


def _release() -> None:
    """Let this thread set the limit: new threadpoolctl listens to the first thread that did, and to no other."""
    for library in _controller().lib_controllers:
        clear = getattr(library, "clear_controlling_thread", None)
        if clear is not None:
            clear(force=True)


def look_again() -> None:
    """Find the libraries anew, before a run: what was loaded since the last one may bring a BLAS of its own."""
    _controller.cache_clear()


ONE_THREAD = OneThread()


def alone(work: Callable[..., R], *given: Any) -> R:
    """What `work` makes of `given`, in a worker."""
    with ONE_THREAD:
        return work(*given)
