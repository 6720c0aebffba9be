"""What an experiment works on: shipped scenes run in its folder, figures, its form (quick or full) and its seed."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from matplotlib.axes import Axes
from matplotlib.figure import Figure

from instrument.paper.finding import Finding
from instrument.pipeline.record import Result
from instrument.pipeline.run import computed, run
from instrument.pipeline.scene_file import parse
from instrument.pipeline.scene_text import override, read_tables
from instrument.report.page import FigureEntry
from instrument.report.style import drawer

TEXT: Callable[[str], None] = lambda text: None  # noqa: E731


@dataclass
class Bench:
    """The place of one experiment: `folder` is where its figures, tables and runs go."""

    folder: Path
    quick: bool = False
    seed: int | None = None  # of all that the scenes draw, instead of theirs
    show: Callable[[str], None] = TEXT
    figures: list[FigureEntry] = field(default_factory=list)

    def tables(self, name: str, *settings: str) -> dict[str, Any]:
        """The tables of a shipped scene with settings changed, and with the seed of this bench."""
        own = () if self.seed is None else (f"seed={self.seed}",)
        return override(read_tables(name), [*settings, *own])

    def run(self, name: str, *settings: str, keep: str = "") -> Result:
        """A shipped scene run whole; its folder is written where a name is given to keep it under."""
        tables = self.tables(name, *settings)
        if not keep:
            return computed(parse(tables), verify=not self.quick)
        return run(parse(tables), tables, out=str(self.folder / keep), verify=not self.quick)

    def draw(self, name: str, drawing: Figure | Axes, caption: str, wide: bool = False) -> None:
        """Write a figure NAME.png, and show it in the page."""
        self.figures.append(drawer(self.folder)(name, drawing, caption, wide))

    def choose(self, quick: Any, full: Any) -> Any:
        """The first in the quick form, the second in the full one."""
        return quick if self.quick else full


Experiment = Callable[[Bench], list[Finding]]
