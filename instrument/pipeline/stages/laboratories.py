"""The laboratories of the table [calibrate], kind = "incomplete-model" and "many-directions"."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar, Self

import numpy as np

from instrument.calibrate.directional import DirectionalCal
from instrument.component import KIND, Component
from instrument.errors import InputError
from instrument.experiments.incomplete_model import SOLVED_TOGETHER, IncompleteModel
from instrument.experiments.incomplete_model_result import Sweep
from instrument.experiments.many_directions import ManyDirections
from instrument.experiments.many_directions_result import ManyDirectionsResult
from instrument.image.dirty import Imager
from instrument.numbers import brief
from instrument.pipeline.stage import Beside, Draw, Running, Stage, StageResult, StageRun
from instrument.pipeline.stages.calibrate import solving
from instrument.pipeline.stages.image import imaging
from instrument.pipeline.stages.noise import STEP, Noise
from instrument.pipeline.work import StageWork
from instrument.planner import BLOCK_BYTES
from instrument.report.page import Block, Card, Details, Figures, Section, Table, Text, number
from instrument.visibilities import Visibilities

HARD = 18.0  # times the sweeps of a solve where much of the sky is not in the model
SHELLS = 4.0  # times the seconds of a prediction where it is made in parts
DIRECTIONAL = 3e-6  # seconds of a visibility and a pair of directions, solved for all directions at once, with errors
THROUGH_BEAMS = 4.0  # times that, where only the polarization that beams add shows what is common to all stations


def _common(beside: Beside) -> dict[str, Any]:
    """Seed and noise of a laboratory: those of the scene."""
    common: dict[str, Any] = {"seed": beside.seed_of(STEP)}
    if "noise" in beside.tables:
        common["sefd"] = f"{Noise.from_table(beside.tables['noise'], beside).sefd!r} Jy"
    return common


class IncompleteModelStage(Stage):
    """Calibrates on the n brightest sources, for every n asked for; settings are those of `IncompleteModel`."""

    alone: ClassVar[tuple[str, ...] | None] = ("noise", "image")
    settings_of: ClassVar[tuple[type[Component], ...]] = (IncompleteModel,)
    laboratory: IncompleteModel

    @classmethod
    def from_table(cls, settings: Mapping[str, Any], beside: Beside) -> Self:
        """The stage, with the noise and the images of the scene."""
        table = dict(beside.tables.get("image", {}))
        if (kind := table.pop(KIND, "dirty")) != "dirty":
            raise InputError(
                f"[image] kind = {brief(kind)}: this laboratory adds images up block by block, as 'dirty' does"
            )
        image = {"image": Imager(**table)} if "image" in beside.tables else {}
        return cls(laboratory=IncompleteModel(**{**image, **_common(beside), **settings}))

    def work(self, run: Running) -> StageWork:
        """Predictions of all shells and, for every model, a solve and an image of what it left."""
        lab, count = self.laboratory, len(self.laboratory.models)
        drawn = StageWork() if lab.image is None else imaging(lab.image, run, count + 1)
        solved = solving(lab.selfcal.tolerance, run)
        times, channels, baselines = run.plan.problem.shape
        columns = 3.0 * lab.watched  # flux and position of each source
        moved = channels * times / lab.every * baselines * (8 * columns**2 / 1e11 + 2e-8 * columns)
        block = 64.0 * run.visibilities * min(1.0, SOLVED_TOGETHER * run.plan.workers / times)
        return drawn._replace(
            does=f"calibration on {count} models; {drawn.does}".rstrip("; "),
            seconds=drawn.seconds + HARD * count * solved.seconds + SHELLS * run.plan.seconds + moved,
            finish_seconds=1.0 + 2e-6 * (0 if lab.image is None else count * lab.image.pixels**2),
            block_bytes=drawn.block_bytes + solved.block_bytes + run.plan.memory + (count + 8) * block,
            figures=1 if lab.image is None else 2,
        )

    def start(self, run: Running) -> StageRun:
        """The stage at work."""
        return _Alone(run, lambda progress: SweepResult(self.laboratory.run(run.plan, progress=progress)))


class ManyDirectionsStage(Stage):
    """Solves for clusters of sources at once; settings are those of `ManyDirections` and of its `DirectionalCal`."""

    alone: ClassVar[tuple[str, ...] | None] = ("noise",)
    settings_of: ClassVar[tuple[type[Component], ...]] = (ManyDirections, DirectionalCal)
    laboratory: ManyDirections

    @classmethod
    def from_table(cls, settings: Mapping[str, Any], beside: Beside) -> Self:
        """The stage, with the noise of the scene."""
        own = dict(settings)
        solver = {key: own.pop(key) for key in DirectionalCal.model_fields if key in own}
        if solver:
            own["calibrator"] = DirectionalCal(**solver)
        return cls(laboratory=ManyDirections(**{**_common(beside), **own}))

    def work(self, run: Running) -> StageWork:
        """Predictions, solves in all directions and in one, and what they leave, in blocks of 64 MB of models."""
        lab, problem = self.laboratory, run.plan.problem
        harder = THROUGH_BEAMS if problem.chain.beams().terms else 1.0
        solves = DIRECTIONAL * harder * run.visibilities * lab.clusters**2
        return StageWork(
            f"solves of {problem.at.shape[2]} stations in {lab.clusters} directions",
            seconds=solves + solving(lab.calibrator.tolerance, run).seconds + 1.3 * run.plan.seconds,
            block_bytes=run.plan.memory + 5 * BLOCK_BYTES,
            figures=1,
        )

    def start(self, run: Running) -> StageRun:
        """The stage at work."""
        return _Alone(run, lambda progress: SubtractionResult(self.laboratory.run(run.plan, progress=progress)))


class _Alone(StageRun):
    """A laboratory at work: it predicts its own blocks, and gives none on."""

    def __init__(self, run: Running, work: Callable[[Callable[[float], None]], StageResult]) -> None:
        self.run, self.work = run, work
        self.result: StageResult | None = None

    def blocks(self, progress: Callable[[float], None]) -> Iterator[Visibilities]:
        """None: everything is done here."""
        self.result = self.work(progress)
        yield from ()

    def finish(self) -> StageResult:
        """What the laboratory found."""
        assert self.result is not None
        return self.result


@dataclass(frozen=True)
class _Found(StageResult):
    """What a laboratory has found, told in its own words."""

    leading: ClassVar[bool] = True
    found: Any  # with `passed`, `lines()` and `write(folder)`

    @property
    def passed(self) -> bool:
        """Whether every solve converged."""
        return bool(self.found.passed)

    def record(self) -> dict[str, Any]:
        """Whether every solve converged."""
        text = "all converged" if self.passed else "some intervals did not converge"
        return {"checks": {"solutions": {"outcome": [text], "passed": self.passed}}}

    def lines(self) -> list[str]:
        """Those of what was found."""
        return ["", *self.found.lines()]

    def write(self, folder: Path) -> None:
        """Its tables and images."""
        self.found.write(folder)


@dataclass(frozen=True)
class SweepResult(_Found):
    """What calibrating on incomplete models did."""

    found: Sweep

    def cards(self) -> list[Card]:
        """What the largest model leaves, and what it takes of the sources that are not in it."""
        found, n = self.found, self.found.models[-1]
        last = found.table()[-1]
        known = f"with {n} of {found.sources} sources in the model"
        told = (
            ("Left of the visibilities", last["visibility_rms"].value, "%", f"of their rms, {known}"),
            ("Flux lost, not in the model", 100 * (1 - last["suppression"]), "%", f"of those sources, {known}"),
            ("Flux wrong", last["bright_flux_median"].value, "%", f"median of the {found.bright} brightest, {known}"),
        )
        return [Card(label, f"{number(float(x))}\u00a0{unit}", note) for label, x, unit, note in told if np.isfinite(x)]

    def sections(self, draw: Draw) -> list[Section]:
        """Errors against the size of the model."""
        from instrument.report.laboratory import errors_against_model
        from instrument.report.spectra import spectra_2d

        text = "Errors against the number of sources in the model."
        entries = [draw("errors_against_model", errors_against_model(self.found), text)]
        if self.found.reference is not None:
            made = self.found.spectra(taper="hann").items()
            curves = {f"left with {n} in the model" if n else "true image": curve for n, curve in made}
            text = "2D power spectra of the images, Hann taper; the PSF stays."
            entries.append(draw("spectrum_2d", spectra_2d(curves), text))
        names = ("n", "flux_share", "visibility_rms", "image_rms", "bright_flux_median", "bright_shift_median",
                 "unmodelled_flux_median", "unmodelled_shift_median")  # fmt: skip
        heads = ["sources in the model", "of the flux (%)", "left of visibilities (%)", "left of the image (%)",
                 "flux error, brightest (%)", "position error, brightest (″)", "flux error, others (%)",
                 "position error, others (″)"]  # fmt: skip
        rows = [[getattr(row[name], "value", row[name]) for name in names] for row in self.found.table()]
        text = "Rms left over the rms of data or image; medians of errors. Others: sources not in the model."
        return [Section("Incomplete models", [Table(heads, rows, text, True), Figures(entries)])]

    def tables(self) -> list[Section]:
        """All that was measured, one row a model."""
        rows = Table.of(self.found.table(), "One row a model of the n brightest sources.")
        return [Section("All models", [Details(f"{len(self.found.models)} models, all that was measured", [rows])])]


@dataclass(frozen=True)
class SubtractionResult(_Found):
    """What solving for many directions at once left."""

    found: ManyDirectionsResult

    def cards(self) -> list[Card]:
        """What is left, and how much more one direction for all leaves."""
        of = "of the noise" if self.found.noise_jy else "of the data"
        return [
            Card("Left after subtraction", number(self.found.left, 4), of, "good" if self.passed else "bad"),
            Card("One direction for all", f"{number(self.found.ratio)} ×", "as much is left"),
        ]

    def sections(self, draw: Draw) -> list[Section]:
        """What is left of each cluster, drawn and as a table, and of the whole, in words."""
        from instrument.report.laboratory import left_of_clusters

        found = self.found
        heads = ["cluster", "sources", "flux (Jy)", "error of its matrices", "intervals failed (%)"]
        rows = [
            [name, int(n), float(flux), float(error), 100 * float(failed)]
            for name, n, flux, error, failed in zip(
                found.names, found.sources, found.flux_jy, found.error, found.failed, strict=True
            )
        ]
        blocks: list[Block] = []
        if found.apart_jy is not None and (np.nan_to_num(found.apart_jy) > 0).any():
            rows = [[*row, *map(float, apart)] for row, apart in zip(rows, found.apart_jy.T, strict=True)]
            heads += ["left of it (Jy)", "left with one direction (Jy)"]
            text = "Rms of what is left of each cluster: solved in its own direction, and with one direction for all."
            blocks.append(Figures([draw("many_directions", left_of_clusters(found), text)]))
        said = [" ".join(line.split()) for line in found.lines()[len(found.names) + 1 :]]
        texts = [Text(f"{line[0].upper()}{line[1:]}.") for line in said]
        return [Section("Many directions", [*texts, *blocks, Table(heads, rows, stack=True)])]

    def tables(self) -> list[Section]:
        """The table of clusters with all that was measured."""
        text = "Rms of visibilities; one: with one direction for all. Errors without the gauge."
        rows = Table.of(self.found.table(), text)
        return [Section("All clusters", [Details(f"{len(self.found.names)} clusters, and what holds for all", [rows])])]
