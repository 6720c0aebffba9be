"""The folder a run writes: tried before anything is computed, whole or not there; and what dead runs have left."""

from __future__ import annotations

import contextlib
import errno
import itertools
import json
import os
import shutil
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from instrument.errors import InputError, warn
from instrument.partial_folders import clean, inside_data, locked_folder
from instrument.terminal import finished

MOST_BYTES = 200e6  # of a record
OURS = ("run.json", "compare.json", "precision.ecsv")  # files that only a folder written here holds
TAKEN = (errno.ENOTEMPTY, errno.EEXIST, errno.ENOTDIR)  # what moving a folder onto something else answers


class RunFolder:
    """A folder that is written beside itself and moved to its place by `finish`; used in a `with`.

    Inside, `partial` is where to write. Without `finish` nothing is left, not even folders made for it; what runs that
    were killed have left beside it is removed and named. `out=None` takes runs/NAME, or the next free name. Raises
    `InputError` when the folder is not empty or cannot be made, or lies in a folder of data. With `force` a folder that
    a run wrote is replaced, once everything is written; no other folder is, nor one that holds a file of `reads`, files
    that are read or written beside it.
    """

    def __init__(
        self, name: str, out: str | None, force: bool = False, reads: Sequence[str | os.PathLike[str]] = ()
    ) -> None:
        self._name, self._out, self._force = name.strip(".") or "run", out, force
        with self._one_line():
            self.path = self._free()
            self._keeps(reads)
        self._made: list[Path] = []

    def __enter__(self) -> RunFolder:
        with self._one_line():
            self._made = [p for p in self.path.parents if not p.exists()]
            for removed in clean(self.path.parent):
                warn(removed)
            self.path.parent.mkdir(parents=True, exist_ok=True)
            self.partial, self._lock = locked_folder(self.path)
            self.partial.chmod(0o755)
        return self

    def __exit__(self, kind: object, error: BaseException | None, trace: object) -> None:
        if error is not None and not self.partial.exists() and self.path.exists():
            self._is_written()  # stopped after the move
        shutil.rmtree(self.partial, ignore_errors=True)
        for folder in self._made:  # made for a run that left nothing in them
            with contextlib.suppress(OSError):
                folder.rmdir()
        if self._lock is not None:
            os.close(self._lock)

    def beside(self) -> None:
        """Leave what stands in the place, which `force` would replace: the name gets "-stopped", and is a free one."""
        if self.path.exists():
            names = (f"{self.path.name}-stopped{f'-{k}' if k else ''}" for k in itertools.count())
            self.path = next(p for p in map(self.path.with_name, names) if not p.exists())

    def finish(self) -> Path:
        """Move what was written to its place; the path, which is the next free one where another run took the name."""
        asked = self.path
        if self._replaces(asked):
            old = asked.rename(self.partial.with_name(f".old{self.partial.name}"))
            try:
                os.rename(self.partial, asked)
            except OSError:
                old.rename(asked)
                raise
            self._is_written()
            shutil.rmtree(old, ignore_errors=True)
            return asked
        while True:
            try:
                os.rename(self.partial, self.path)  # onto an empty folder, or where nothing is: in one step
                break
            except OSError as error:
                if error.errno not in TAKEN:
                    raise
                self.path = _next_free(asked)
        self._is_written()
        if self.path != asked:
            warn(f"{asked} was taken meanwhile: the results are in {self.path}")
        return self.path

    def _is_written(self) -> None:
        """From here on a stopped program says so."""
        if (said := f"{self.path} is written") not in finished:
            finished.append(said)

    def _replaces(self, folder: Path) -> bool:
        """Whether an earlier run folder is there that may go."""
        return self._force and _written_here(folder)

    def _free(self) -> Path:
        """The folder asked for, which must be empty, or the next free one under runs/."""
        if self._out is None:
            usual = Path("runs") / self._name
            return usual if self._replaces(usual) and not usual.is_symlink() else _next_free(usual)
        # a link is followed: its target is what is written
        folder = Path(os.path.realpath(Path(self._out).expanduser()))
        if folder.is_symlink():
            raise InputError(f"--out {self._out}: its links lead to one another; choose another")
        if folder.exists() and not self._replaces(folder) and (not folder.is_dir() or any(folder.iterdir())):
            if not self._force and _written_here(folder):
                raise InputError(f"--out {self._out}: there is a run in it; choose another, or replace it with --force")
            raise InputError(f"--out {self._out}: it exists and is not an empty folder; choose another")
        if folder.is_dir() and os.path.ismount(folder):
            raise InputError(
                f"--out {self._out}: it is a mount point, which cannot be moved to; name a folder inside it"
            )
        if Path(self._out).is_absolute() or folder.is_symlink() or folder == Path.cwd():
            return folder  # nothing can be moved onto "."
        return Path(os.path.relpath(folder))

    def _keeps(self, reads: Sequence[str | os.PathLike[str]]) -> None:
        """Raises `InputError` for a folder within data, and where one would go in which a file lies that is read."""
        place, there = self._out if self._out is not None else self.path, self.path.resolve()
        if within := inside_data(there):
            raise InputError(f"--out {place}: {within}; choose another")
        for file in reads:
            lies = Path(file).expanduser().resolve()
            if self._replaces(self.path) and there in lies.parents:
                raise InputError(f"--out {place}: what is read lies in it ({file}); choose another")
            if lies in (there, *there.parents) and not lies.is_dir():
                raise InputError(f"--out {place}: it lies in {file}, which is written; choose another")

    @contextlib.contextmanager
    def _one_line(self):  # type: ignore[no-untyped-def]
        """Says of an error of the disk which folder it is."""
        where = f"--out {self._out}" if self._out is not None else f"runs/{self._name}"
        try:
            yield
        except InputError:
            raise
        except (OSError, ValueError, RuntimeError) as error:  # a name with a NUL; a home that is not known
            raise InputError(f"{where}: {getattr(error, 'strerror', None) or error}; choose another folder") from None


def _written_here(folder: Path) -> bool:
    """Whether a folder was written by a run or a comparison: a record in it says what versions made it."""
    for name in OURS:
        try:
            file = folder / name
            if file.is_file() and file.stat().st_size < MOST_BYTES and "versions" in _record(file):
                return True
        except (OSError, ValueError, TypeError, RecursionError):
            continue
    return False


def _record(file: Path) -> Any:
    """What a file records: that of JSON, or the keys of what stands before an ECSV table."""
    if file.suffix == ".json":
        return json.loads(file.read_bytes())
    first, *lines = file.read_text(encoding="utf-8").splitlines()
    if not first.startswith("# %ECSV"):
        return {}
    return {line.lstrip("# -").partition(":")[0] for line in lines if line.startswith("#")}


def _next_free(path: Path) -> Path:
    """The path, or with the first number from 2 that is free."""
    found, count = path, 1
    while os.path.lexists(found):
        count += 1
        found = path.with_name(f"{path.name}-{count}")
    return found
