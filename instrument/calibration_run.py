"""The calibration stage of a run: corrupt, add noise, solve and correct, block by block; what it leaves in images."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from instrument.analyze.analyzer import Analyzer
from instrument.calibrate.base import Solution
from instrument.calibrate.di_errors import DIComparison, DISums
from instrument.calibrate.selfcal import SelfCal
from instrument.errors import Outcome
from instrument.files.solutions import write_h5parm
from instrument.image.cube import StokesCube
from instrument.image.dirty import Images
from instrument.jones.chain import Chain
from instrument.model import Instrument
from instrument.visibilities import Visibilities
from instrument.whole_file import write_ecsv

IMAGES = ("corrupted", "corrected", "corrupted - corrected", "corrected - model")


@dataclass
class CalibrationStage:
    """Solves every block against the model it was made from, and keeps solutions, errors and difference images."""

    solver: SelfCal
    instrument: Instrument
    images: dict[str, Images]
    parts: list[Solution] = field(default_factory=list)
    errors: DISums | None = None
    power: dict[str, float] = field(default_factory=dict)

    @property
    def _rms(self) -> float:
        """That of the errors put in."""
        return max((t.rms for t in (self.instrument.gain, self.instrument.feed) if t is not None), default=0.0)

    def corrupt(self, model: Visibilities) -> Visibilities:
        """What the receivers make of a block: their gains and feed errors on the model."""
        return model.corrupted(Chain(*self.instrument.receivers()))

    def correct(self, data: Visibilities, model: Visibilities) -> Visibilities:
        """Solve a block and correct it; intervals that failed are flagged in what comes back."""
        solution = self.solver.solve(data, model)
        corrected = data.corrected(solution.term)
        # solutions and sums are all that stays of a block: masks, data and models of a long run are GB
        self.parts.append(replace(solution, suspects=np.zeros((1, 1, 1), bool)))
        if self._rms:
            self.errors = self.errors or DISums(data.antenna1, data.antenna2)
            self.errors.add(solution.truth(Chain(*self.instrument.receivers()), data.at), solution)
        made = (lambda: data, lambda: corrected, lambda: data - corrected, lambda: corrected - model)
        for name, make in zip(IMAGES, made, strict=True):
            block = make()
            self.power[name] = self.power.get(name, 0.0) + float((np.abs(block.data) ** 2).sum())
            if self.images:
                self.images[name].add(block.flagged(corrected.flag))
        self.power["model"] = self.power.get("model", 0.0) + float((np.abs(model.data) ** 2).sum())
        return corrected

    def finish(self) -> CalibrationResult:
        """Everything that the stage found."""
        solution = Solution.joined(self.parts)
        errors = self.errors.finish(self._rms) if self.errors else None
        cubes = {name: images.finish() for name, images in self.images.items()}
        return CalibrationResult(solution, errors, cubes, {k: float(np.sqrt(v)) for k, v in self.power.items()})


@dataclass(frozen=True)
class CalibrationResult:
    """Solutions of a run, how they compare with the truth, images of what they leave, and rms of visibilities."""

    solution: Solution
    errors: DIComparison | None
    cubes: dict[str, StokesCube]
    rms: dict[str, float]

    @property
    def passed(self) -> bool:
        """Whether every interval converged."""
        return bool(self.solution.converged.all())

    def record(self) -> dict[str, Any]:
        """What `run.json` holds of it."""
        out: dict[str, Any] = {
            "summary": str(self.solution),
            "outcomes": {o.name.lower(): int((self.solution.outcome == o).sum()) for o in Outcome},
            "passed": self.passed,
            "iterations_median": float(np.median(self.solution.iterations)),
            "visibility_rms_share": {k: self.rms[k] / self.rms["model"] for k in IMAGES if self.rms["model"]},
        }
        if self.errors is not None:
            out["di_errors_percent"] = {"linear": self.errors.linear, "quadratic": self.errors.quadratic}
        if self.cubes:
            whole = np.nanstd(self.cubes["corrected"].data[0, 0])
            out["image_rms_share"] = {k: float(np.nanstd(c.data[0, 0]) / whole) for k, c in self.cubes.items()}
        return out

    def spectra(self, uv_range: tuple[float, float] | None) -> dict[str, Any]:
        """2D power spectra of the images, Stokes I and Q + iU, by name."""
        out = {}
        for name in IMAGES[1:]:
            cube = self.cubes[name]
            for stokes in ("I", "P"):
                out[f"{name}, {stokes}"] = Analyzer(cube).spectrum_2d(stokes=stokes, uv_range=uv_range, taper="hann")
        return out

    def write(self, folder: Path) -> None:
        """solutions.h5 (h5parm) and di_errors.ecsv."""
        write_h5parm(folder / "solutions.h5", self.solution)
        if self.errors is not None:
            write_ecsv(self.errors.table(), folder / "di_errors.ecsv")

    def summary(self) -> list[str]:
        """Lines for the terminal."""
        lines = [f"calibration   {self.solution}"]
        share = self.record().get("image_rms_share", {})
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
