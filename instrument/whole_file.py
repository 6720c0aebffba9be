"""Files that are whole or not there: written beside their name and moved to it at the end."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any


@contextmanager
def whole_file(path: str | os.PathLike[str]) -> Iterator[Path]:
    """Gives a path to write to; it becomes `path` when what is inside succeeds, and is removed when it does not."""
    target = Path(path)
    partial = target.with_name(target.name + ".part")
    try:
        yield partial
        partial.replace(target)
    finally:
        partial.unlink(missing_ok=True)


def write_ecsv(table: Any, path: str | os.PathLike[str]) -> None:
    """Write an astropy table as ECSV, whole or not at all."""
    with whole_file(path) as partial:
        table.write(str(partial), format="ascii.ecsv", overwrite=True)
