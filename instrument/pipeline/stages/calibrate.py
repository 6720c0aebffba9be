"""The table [calibrate]: blocks solved against the model they were made from, corrected, and what that leaves."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, ClassVar, Literal, NamedTuple, Self

import numpy as np

from instrument.analyze.analyzer import Analyzer
from instrument.calibrate.base import Calibrator, Solution
from instrument.calibrate.by_station import powers_by_station, share_of
from instrument.calibrate.di_errors import NAMES, DIComparison, DISums
from instrument.calibrate.newton import lanes_of, normal_bytes
from instrument.calibrate.selfcal import SelfCal
from instrument.component import KIND, Component
from instrument.errors import InputError, Outcome, did_you_mean
from instrument.files.solutions import write_h5parm
from instrument.image.base import ImageSums
from instrument.image.cube import StokesCube
from instrument.jones.chain import Chain
from instrument.numbers import brief
from instrument.pipeline.stage import Beside, Draw, Running, Stage, StageResult, StageRun
from instrument.pipeline.stages.image import Image, imaging
from instrument.pipeline.work import StageWork
from instrument.registry import load, names
from instrument.report.page import Block, Card, Figures, Mark, Section, Table, Text, number
from instrument.units import Bool, Float
from instrument.visibilities import Visibilities
from instrument.whole_file import write_ecsv

IMAGES = ("corrupted", "corrected", "corrupted - corrected", "corrected - model")

SOLVE = 0.12e-6  # seconds of a visibility for each decade of tolerance
TOGETHER = 5e-3  # seconds of an interval of 59 stations whose normal matrix is worked out
COMPARING, MAKING = 2.1e-6, 0.3e-6  # seconds of a visibility: errors beside the truth; another block to look at
KEPT = 350.0  # bytes of a station and interval: solutions, and what the comparison with the truth makes of them
SOLVING = 600.0  # bytes of a baseline in each vector lane


def solving(tolerance: float, run: Running) -> StageWork:
    """What solving all intervals down to a tolerance, and comparing with the truth, costs."""
    times, channels, baselines = run.plan.problem.shape
    stations = run.plan.problem.at.shape[2]
    lanes = lanes_of(stations)
    each = SOLVING * baselines
    seconds = SOLVE * run.visibilities * max(1.0, -np.log10(tolerance))
    if run.instrument.chain().beams().parts:  # common directions are weak, and all stations are solved at once
        each += normal_bytes(stations)
        seconds += TOGETHER * (stations / 59.0) ** 3 * times * channels
    return StageWork(
        f"solves of {stations} stations",
        seconds=seconds,
        held_bytes=KEPT * stations * times * channels,
        block_bytes=6 * 64.0 * float(np.prod(run.block)) + each * lanes * run.plan.workers,
    )


class Calibrate(Stage):
    """Solves every block against what a perfect instrument sees, and corrects it.

    `kind` is a calibrator; the other settings of the table are its own. Those of "selfcal" are:
    """

    after: ClassVar[tuple[str, ...]] = ("data", "noise")
    perfect: ClassVar[bool] = True
    settings_of: ClassVar[tuple[type[Component], ...]] = (SelfCal,)
    calibrator: Calibrator

    @classmethod
    def from_table(cls, settings: Mapping[str, Any], beside: Beside) -> Self:
        """The stage; the settings are those of the solver."""
        kind = settings.get(KIND)
        if kind not in names("calibrators"):
            said = "needs 'kind'" if kind is None else f"kind = {brief(kind)}"
            laboratories = [name.partition(".")[2] for name in names("stages") if name.startswith("calibrate.")]
            raise InputError(f"{said}: {did_you_mean(str(kind), [*names('calibrators'), *laboratories])}")
        return cls(calibrator=load("calibrators", kind, **{k: v for k, v in settings.items() if k != KIND}))

    def work(self, run: Running) -> StageWork:
        """Solves of all intervals, their comparison with the truth, and four sets of images where there are any."""
        image = run.stage("image", Image)
        drawn = StageWork() if image is None else imaging(image.imager, run, len(IMAGES))
        solved = solving(self.calibrator.tolerance, run)
        made = run.visibilities * (len(IMAGES) * MAKING + (COMPARING if run.instrument.errors() else 0.0))
        return drawn._replace(
            does="; ".join(text for text in (solved.does, drawn.does) if text),
            seconds=drawn.seconds + solved.seconds + made,
            held_bytes=drawn.held_bytes + solved.held_bytes,
            block_bytes=drawn.block_bytes + solved.block_bytes,
            result_bytes=drawn.result_bytes + solved.held_bytes,
            figures=5 + bool(drawn.does) + (run.plan.problem.shape[1] > 1),
        )

    def start(self, run: Running) -> StageRun:
        """The stage at work."""
        image = run.stage("image", Image)
        images = {} if image is None else {name: image.sums(run) for name in IMAGES}
        return _CalibrateRun(self.calibrator, run, images)


@dataclass
class _CalibrateRun(StageRun):
    """Keeps solutions, sums of errors, and difference images."""

    solver: Calibrator
    run: Running
    images: dict[str, ImageSums]
    parts: list[Solution] = field(default_factory=list)
    errors: DISums | None = None
    power: dict[str, float] = field(default_factory=dict)
    # powers of the corrected less the model, and of the model (2, T, A), of the times of blocks
    left: dict[tuple[float, ...], Float] = field(default_factory=dict)
    empty: int = 0  # intervals without a solution all of whose data are flagged
    put_in: Float = field(default_factory=lambda: np.zeros(3))  # |J - 1|^2 on and off the diagonal, and how many

    @property
    def _rms(self) -> float:
        """That of the errors put in: as it was asked of gain and feed, measured where other terms make it."""
        own = [t for t in (self.run.instrument.gain, self.run.instrument.feed) if t is not None]
        asked = max((t.rms for t in own), default=0.0)
        if asked and len(own) == len(self.run.instrument.errors()):
            return asked
        return float(np.sqrt(self.put_in[:2].max() / max(self.put_in[2], 1.0)))

    def take(self, block: Visibilities) -> Visibilities:
        """Solve a block and correct it; intervals that failed are flagged in what comes back."""
        model = self.run.model
        assert model is not None
        with self.run.timed("solve"):
            solution = self.solver.solve(block, model)
        corrected = block.corrected(solution.term)
        # solutions and sums are all that stays of a block: masks, data and models of a long run are GB
        self.parts.append(replace(solution, suspects=np.zeros((1, 1, 1), bool)))
        counts = np.asarray(block.whole_weight > 0)  # without what is flagged
        self.empty += int((~solution.converged & ~_seen(solution, block, counts)).sum())
        counts = np.broadcast_to(counts, block.data.shape[:3])[..., None, None]
        if self.run.instrument.errors():
            with self.run.timed("errors"):
                self.errors = self.errors or DISums(block.antenna1, block.antenna2)
                truth = solution.truth(Chain(*self.run.instrument.receivers()), block.at)
                self.errors.add(truth, solution)
                off = np.abs(truth - np.eye(2)) ** 2
                diagonal = off.trace(axis1=-2, axis2=-1).sum()
                self.put_in += diagonal, off.sum() - diagonal, 2 * off[..., 0, 0].size
        made = (lambda: block, lambda: corrected, lambda: block - corrected, lambda: corrected - model)
        with self.run.timed("images"):
            for name, make in zip(IMAGES, made, strict=True):
                part = make()
                self.power[name] = self.power.get(name, 0.0) + _power(part, counts)
                if name == IMAGES[-1]:
                    times = tuple(block.at.slots_s.tolist())  # of which there are blocks of several channels
                    self.left[times] = self.left.get(times, 0.0) + powers_by_station(part, model)
                if self.images:
                    self.images[name].add(part.flagged(corrected.flag))
        self.power["model"] = self.power.get("model", 0.0) + _power(model, counts)
        return corrected

    def finish(self) -> CalibrationResult:
        """Everything that the stage found."""
        solution = Solution.joined(self.parts)
        errors = self.errors.finish(self._rms) if self.errors and self._rms else None
        with self.run.timed("images"):
            cubes = {name: images.finish() for name, images in self.images.items()}
        image = self.run.stage("image", Image)
        uv_range = None if image is None else image.imager.uv_range
        rms = {k: float(np.sqrt(v)) for k, v in self.power.items()}
        left = LeftByStation(
            share_of(np.concatenate(list(self.left.values()), axis=1)), np.concatenate(list(self.left)),
            self.run.plan.problem.interval_s,
        )  # fmt: skip
        return CalibrationResult(solution, errors, cubes, rms, uv_range, left, self.empty)


def _power(vis: Visibilities, counts: Bool) -> float:
    """The sum of |V|² of what counts (T, F, B, 1, 1)."""
    return float(np.where(counts, vis.data.real**2 + vis.data.imag**2, 0.0).sum())


def _seen(solution: Solution, block: Visibilities, counts: Bool) -> Bool:
    """Intervals (t, f) that have data that count (T, F, B)."""
    term, here = solution.term, np.broadcast_to(counts.any(axis=-1), block.data.shape[:2])
    i, j = (
        np.abs(np.subtract.outer(cells, places)).argmin(axis=1)
        for cells, places in ((block.at.slots_s, term.slots_s), (block.freq_hz, term.freq_hz))
    )
    seen = np.zeros(solution.outcome.shape, bool)
    np.logical_or.at(seen, (i[:, None], j[None, :]), here)
    return seen


class LeftByStation(NamedTuple):
    """Corrected less model over the model, rms on the baselines of each station (T, A), of integrations (T,)."""

    share: Float
    slots_s: Float
    interval_s: float


@dataclass(frozen=True)
class CalibrationResult(StageResult):
    """Solutions of a run, how they compare with the truth, images of what they leave, and rms of visibilities."""

    leading: ClassVar[bool] = True

    solution: Solution
    errors: DIComparison | None
    cubes: dict[str, StokesCube]
    rms: dict[str, float]
    uv_range: tuple[float, float] | None = None  # of the images
    left: LeftByStation | None = None
    empty: int = 0  # intervals all of whose data are flagged

    @property
    def passed(self) -> bool:
        """Whether every interval converged that has data."""
        done = self.solution.converged
        return bool(done.any()) and int(done.sum()) + self.empty == done.size

    def record(self) -> dict[str, Any]:
        """Outcomes, and what is left, under "calibration"."""
        check = {"outcome": [o.value for o in set(self.solution.outcome.ravel())], "passed": self.passed}
        return {"checks": {"calibration": check}, "calibration": self.figures()}

    def figures(self) -> dict[str, Any]:
        """Outcomes, iterations, errors in % of the rms put in, and shares of the rms that are left."""
        out: dict[str, Any] = {
            "summary": str(self.solution),
            "outcomes": {o.name.lower(): int((self.solution.outcome == o).sum()) for o in Outcome},
            "passed": self.passed,
            "intervals_without_data": self.empty,
            "iterations_median": float(np.median(self.solution.iterations)),
            "visibility_rms_share": {k: self.rms[k] / self.rms["model"] for k in IMAGES if self.rms["model"]},
        }
        if self.errors is not None:
            out["di_errors_percent"] = {"linear": self.errors.linear, "quadratic": self.errors.quadratic}
        if self.cubes:
            whole = np.nanstd(self.cubes["corrected"].data[0, 0])
            out["image_rms_share"] = {k: float(np.nanstd(c.data[0, 0]) / whole) for k, c in self.cubes.items()}
        return out

    def spectra(self) -> dict[str, Any]:
        """2D power spectra of the images, Stokes I and Q + iU, by name."""
        stokes: tuple[Literal["I", "P"], ...] = ("I", "P")
        return {
            f"{name}, {s}": Analyzer(self.cubes[name]).spectrum_2d(s, uv_range=self.uv_range, taper="hann")
            for name in IMAGES[1:]
            for s in stokes
        }

    def cards(self) -> list[Card]:
        """How many intervals converged, how far the solutions are from the truth, and what calibration leaves."""
        done = self.solution.converged
        mark: Mark = "good" if self.passed else "bad"
        cards = [Card("Intervals converged", f"{int(done.sum())} of {done.size}", "", mark)]
        if self.errors is not None:
            apart = max(self.errors.linear.get("difference, aligned", {}).values(), default=np.nan)
            if np.isfinite(apart):
                text = "of the rms put in: the worst of the seven parameters, the unitary freedom taken out"
                cards.append(Card("Errors not found", f"{number(float(apart))}\u00a0%", text))
        if self.rms["model"]:
            left = f"{number(100 * self.rms['corrected - model'] / self.rms['model'])}\u00a0%"
            cards.append(Card("Left by calibration", left, "corrected less model, of the visibility rms"))
        return cards

    def sections(self, draw: Draw) -> list[Section]:
        """Errors of the solutions, gains against time, how it converged, and what is left."""
        from instrument.report.calibration_page import solution_figures
        from instrument.report.spectra import spectra_2d
        from instrument.report.stations import left_by_stations

        solution = self.solution
        blocks: list[Block] = [Text(str(solution))]
        if self.errors is not None:
            text = "The seven direction-independent error parameters, in % of the rms put in."
            made = Table.of(self.errors.table(), text)
            heads = [made.columns[0], *(f"{name.upper()} (%)" for name in NAMES)]
            blocks.append(replace(made, columns=heads))
        entries = solution_figures(solution, draw)
        if self.left is not None and np.isfinite(self.left.share).any():
            text = "What calibration leaves on the baselines of each station: corrected less model; grey: no data."
            shown = left_by_stations(*self.left, solution.term.stations)
            entries.append(draw("residual_stations", shown, text))
        if self.cubes:
            text = "2D power spectra of what calibration leaves in the images, Hann taper; the PSF stays."
            entries.append(draw("calibration_spectra", spectra_2d(self.spectra()), text))
        return [Section("Calibration", [*blocks, Figures(entries)])]

    def write(self, folder: Path) -> None:
        """solutions.h5 (h5parm) and di_errors.ecsv."""
        write_h5parm(folder / "solutions.h5", self.solution)
        if self.errors is not None:
            write_ecsv(self.errors.table(), folder / "di_errors.ecsv")

    def lines(self) -> list[str]:
        """Lines for the terminal."""
        lines = ["", f"calibration   {self.solution}"]
        share = self.figures().get("image_rms_share", {})
        for name in IMAGES[2:]:
            text = f"{100 * self.rms[name] / self.rms['model']:.2g} % of the visibility rms"
            text += f", {100 * share[name]:.2g} % of the image rms" if name in share else ""
            lines.append(f"{name:<24} {text}")
        if self.errors is not None:
            names = list(self.errors.linear["input"])
            lines.append("DI errors, % of rms      " + " ".join(f"{n.upper():>9}" for n in names))
            for kind, part in (("linear", self.errors.linear), ("quadratic", self.errors.quadratic)):
                for which, values in part.items():
                    lines.append(f"{kind + ', ' + which:<34}" + " ".join(f"{values[n]:9.2g}" for n in names))
        return lines
