"""The folder a run writes: chosen before anything is computed, whole or not there."""

from __future__ import annotations

import shutil
import tempfile
from pathlib import Path

from instrument.errors import InputError


class RunFolder:
    """A folder that is written beside itself and moved to its place by `finish`; used in a `with`.

    Inside, `partial` is where to write. Without `finish` nothing is left, not even folders made for it. `out=None`
    takes runs/NAME, or the next free name. Raises `InputError` when the folder is not empty or cannot be made.
    """

    def __init__(self, name: str, out: str | None) -> None:
        self._name, self._out = name, out
        self.path = self._free()
        self._made: list[Path] = []

    def __enter__(self) -> RunFolder:
        self._made = [p for p in self.path.parents if not p.exists()]
        try:
            self.path.parent.mkdir(parents=True, exist_ok=True)
            self.partial = Path(tempfile.mkdtemp(prefix=f".{self.path.name}.", dir=self.path.parent))
            self.partial.chmod(0o755)
        except OSError as error:
            raise InputError(f"--out {self.path}: {error.strerror}; choose another folder") from None
        return self

    def __exit__(self, *error: object) -> None:
        shutil.rmtree(self.partial, ignore_errors=True)
        for folder in self._made:  # made for a run that left nothing in them
            if folder.exists() and not any(folder.iterdir()):
                folder.rmdir()

    def finish(self) -> Path:
        """Move what was written to its place; the path."""
        if self._out is None:
            self.path = self._free()  # another run may have taken the name meanwhile
        if self.path.exists():
            self.path.rmdir()
        self.partial.rename(self.path)
        return self.path

    def _free(self) -> Path:
        """The folder asked for, which must be empty, or the next free one under runs/."""
        if self._out is not None:
            folder = Path(self._out).resolve() if Path(self._out).name in ("", "..") else Path(self._out)
            if folder.exists() and (not folder.is_dir() or any(folder.iterdir())):
                raise InputError(f"--out {self._out}: it exists and is not an empty folder; choose another")
            return folder
        folder = Path("runs") / self._name
        count = 1
        while folder.exists():
            count += 1
            folder = Path("runs") / f"{self._name}-{count}"
        return folder
