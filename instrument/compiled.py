"""Loops that are compiled when they are first called: numba, a third of a second to load, is loaded then."""

from __future__ import annotations

import functools
import threading
from collections.abc import Callable
from functools import cached_property
from typing import Any

_one = threading.RLock()


class Loop:
    """A function that numba compiles when it is first called; what else is asked of it, its dispatcher answers."""

    def __init__(self, function: Callable[..., Any], options: dict[str, Any]) -> None:
        self._function, self._options = function, options
        functools.update_wrapper(self, function)

    @cached_property
    def dispatcher(self) -> Any:
        """Numba's, made with those of all loops that this one calls."""
        from instrument.compiled_cache import dispatcher

        with _one:
            known = self._function.__globals__
            for name in self._function.__code__.co_names:
                if isinstance(known.get(name), Loop):  # numba must find its own there
                    known[name] = known[name].dispatcher
            return vars(self).get("dispatcher") or dispatcher(self._function, self._options)

    def __call__(self, *values: Any) -> Any:
        """Call it."""
        return self.dispatcher(*values)

    def __getattr__(self, name: str) -> Any:
        if name.startswith("__"):  # copies and pickles ask before there is anything
            raise AttributeError(name)
        return getattr(self.dispatcher, name)


def compiled(**options: Any) -> Callable[[Callable[..., Any]], Any]:
    """`numba.njit(**options)`, when first called, with a cache of its own."""
    return lambda function: Loop(function, options)


inlined = compiled(inline="always")
