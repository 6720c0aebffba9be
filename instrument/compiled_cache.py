"""How loops are compiled: by numba, with a cache on disk that can only save time.

Without a place for it, or with a damaged one, they work.
"""

from __future__ import annotations

import hashlib
import os
import pickle
from collections.abc import Callable
from typing import Any

import numba
from numba.core.caching import FunctionCache, IndexDataCacheFile

from instrument.errors import warn

DIGEST = hashlib.sha256().digest_size
_said: set[str] = set()


def dispatcher(function: Callable[..., Any], options: dict[str, Any]) -> Any:
    """`numba.njit(**options)` with a cache that is checked when it is read, and done without where it cannot be.

    What is to be inlined has none: its code is in that of others.
    """
    made = numba.njit(**options)(function)
    if options.get("inline") == "always":
        return made
    try:
        made._cache = _Cache(function)
    except (RuntimeError, OSError):
        _say("no place to keep compiled loops", "they are compiled anew each time; NUMBA_CACHE_DIR may name a folder")
    return made


def _say(what: str, then: str) -> None:
    """Warn, once in a process for each kind of trouble."""
    if what not in _said:
        _said.add(what)
        warn(f"{what}: {then}")


class _Checked(IndexDataCacheFile):
    """Index and data files that end in a digest: numba takes a flipped bit in machine code for code."""

    def _save_data(self, name: str, data: Any) -> None:
        self._write(self._data_path(name), name, b"", data)

    def _load_data(self, name: str) -> Any:
        with open(self._data_path(name), "rb") as file:
            return pickle.loads(_sound(name, file.read()))

    def _save_index(self, overloads: Any) -> None:
        self._write(self._index_path, self._index_name, pickle.dumps(self._version), (self._source_stamp, overloads))

    def _load_index(self) -> Any:
        try:
            with open(self._index_path, "rb") as file:
                version = pickle.load(file)
                content = _sound(self._index_name, file.read())
        except FileNotFoundError:
            return {}
        if version != self._version:
            return {}
        stamp, overloads = pickle.loads(content)
        return overloads if stamp == self._source_stamp else {}

    def _write(self, path: str, name: str, head: bytes, data: Any) -> None:
        content = self._dump(data)
        with self._open_for_write(path) as file:
            file.write(head + content + _digest(name, content))

    def remove(self) -> None:
        """Throw the index away: what it names is not found any more, and is written over."""
        os.unlink(self._index_path)


def _digest(name: str, content: bytes) -> bytes:
    return hashlib.sha256(name.encode() + content).digest()


def _sound(name: str, content: bytes) -> bytes:
    """The content without its digest, which is that of this content under this name."""
    content, digest = content[:-DIGEST], content[-DIGEST:]
    if _digest(name, content) != digest:
        raise ValueError(f"{name} is not what was written")
    return content


class _Cache(FunctionCache):
    """A cache of one function that never stops it."""

    def __init__(self, function: Callable[..., Any]) -> None:
        super().__init__(function)
        files = self._cache_file
        base = f"{self._impl.filename_base}.checked"  # beside files that plain numba has written
        self._cache_file = _Checked(files._cache_path, base, files._source_stamp)

    def load_overload(self, sig: Any, target_context: Any) -> Any:
        try:
            return super().load_overload(sig, target_context)
        except Exception:  # a damaged pickle may raise anything
            _say("damaged cache of compiled loops", f"thrown away and made anew in {self._cache_path}")
            try:
                self._cache_file.remove()
            except OSError:
                self.disable()
            return None

    def save_overload(self, sig: Any, data: Any) -> None:
        try:
            super().save_overload(sig, data)
        except OSError as error:
            _say("compiled loops could not be kept", f"{self._cache_path}: {error.strerror}; they work all the same")
            self.disable()
