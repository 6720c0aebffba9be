"""A progress bar with an honest time left; silent when not on a terminal."""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager

Progress = Callable[..., None]  # of the fraction done, and the name of what is at work


@contextmanager
def progress_bar(text: str) -> Iterator[Progress]:
    """Gives a function to call with the fraction done, and the name of what is at work."""
    if not sys.stderr.isatty():
        yield lambda done, name="": None
        return
    from rich.console import Console
    from rich.progress import (
        BarColumn,
        Progress,
        TaskProgressColumn,
        TextColumn,
        TimeElapsedColumn,
        TimeRemainingColumn,
    )

    columns = (
        TextColumn("{task.description}"),
        BarColumn(),
        TaskProgressColumn(),
        TimeElapsedColumn(),
        TimeRemainingColumn(),
    )
    with Progress(*columns, console=Console(stderr=True), transient=True) as bar:
        task = bar.add_task(text, total=1.0)
        yield lambda done, name="": bar.update(task, completed=done, description=f"{text}: {name}" if name else text)
