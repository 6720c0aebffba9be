"""What was made of a cube: spectra, Faraday cube, windows, checks, and what is written of them."""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from instrument.analyze.cube_checks import CubeCheck
from instrument.analyze.faraday.clean import FaradayClean
from instrument.analyze.faraday.cube import FaradayCube
from instrument.analyze.faraday.peaks import FaradayPeaks
from instrument.analyze.power.cylinders import Cylindrical, Spherical
from instrument.analyze.power.spectra import Spectrum2D
from instrument.analyze.power.window import EoRWindow
from instrument.errors import InputError, Outcome
from instrument.foreground.base import Split
from instrument.image.cube import StokesCube
from instrument.pipeline.stage import StageResult
from instrument.report.page import Card, number


@dataclass
class CubeProducts(StageResult):
    """What was made of a cube: spectra by name, windows, Faraday cube, what was left out and why, seconds."""

    settings: Any  # the `CubeAnalysis` that made it
    cube: StokesCube
    faraday: FaradayCube | None = None
    cleaned: FaradayClean | None = None
    peaks: FaradayPeaks | None = None
    brightest: tuple[int, ...] = ()
    sights: dict[str, FaradayCube] = field(default_factory=dict)
    split: Split | None = None
    said: str = ""
    planes: dict[str, Spectrum2D] = field(default_factory=dict)
    cylinders: dict[str, Cylindrical] = field(default_factory=dict)
    spheres: dict[str, Spherical] = field(default_factory=dict)
    windows: dict[str, EoRWindow] = field(default_factory=dict)
    left_out: dict[str, str] = field(default_factory=dict)
    checks: dict[str, CubeCheck | None] = field(default_factory=dict)
    warned: list[str] = field(default_factory=list)
    seconds: dict[str, float] = field(default_factory=dict)

    @contextmanager
    def timed(self, stage: str) -> Iterator[None]:
        """Adds the wall time of what is inside to a stage."""
        begin = time.perf_counter()
        yield
        self.seconds[stage] = self.seconds.get(stage, 0.0) + time.perf_counter() - begin

    @property
    def passed(self) -> bool:
        """Whether no check fell short; the page and `run.json` say which could not be made."""
        return all(passed is not False for passed in self.verdicts.values())

    @property
    def verdicts(self) -> dict[str, bool | None]:
        """Of each check whether it held; None where it could not be made."""
        out = {name: None if check is None else check.passed for name, check in self.checks.items()}
        if self.cleaned is not None:
            out["RM-CLEAN"] = not (self.cleaned.codes == 1).any()
        if self.split is not None:
            out["removal"] = self.removal_passed
        return out

    @property
    def removal_passed(self) -> bool | None:
        """Whether the removal converged, left something and did not make it worse; None where no score tells."""
        assert self.split is not None
        if self.split.outcome is not Outcome.CONVERGED or self.split.mixing.shape[1] >= len(self.split.channels):
            return False
        try:
            return not self.split.score().worse
        except InputError:  # too few channels or pixels for a score: said in the text
            return None

    def lines(self) -> list[str]:
        """What matters, for the terminal."""
        return ["", *self._text(), ""]

    def _text(self) -> list[str]:
        shape = self.cube.data.shape
        low, high = self.cube.freq_hz.min() / 1e6, self.cube.freq_hz.max() / 1e6
        out = [f"cube          {shape[0]} channels {low:.6g} to {high:.6g} MHz, {shape[3]} x {shape[2]} pixels, "
               f"{self.cube.unit}"]  # fmt: skip
        out += [f"left out      {name}: {why}" for name, why in self.left_out.items()]
        if self.faraday is not None and self.peaks is not None:
            found = int(self.peaks.significant.sum())
            out.append(f"Faraday       {self.faraday.band}")
            out.append(f"peaks         {found} pixels above {self.peaks.snr_min:g} times the noise{self._noise_text()}")
            out += [f"{'':<14}{text}" for text in self.alias_text()]
        if self.cleaned is not None:
            mean, missed = float(self.cleaned.iterations.mean()), int((self.cleaned.codes == 1).sum())
            out.append(
                f"RM-CLEAN      {mean:.3g} iterations a pixel" + (f", {missed} not down to it" if missed else "")
            )
        out += [f"{'removal' if k == 0 else '':<14}{line}" for k, line in enumerate(self.said.splitlines())]
        out += [f"check         {name}: {check or 'not made'}" for name, check in self.checks.items()]
        out += [f"check         {name}: not made" for name, held in self.verdicts.items()
                if held is None and name not in self.checks]  # fmt: skip
        for name, window in self.windows.items():
            out += ["", f"{name or 'as it is'}:", *str(window).splitlines()]
        return out

    def _noise_text(self) -> str:
        assert self.faraday is not None
        level = self.faraday.measured_noise
        if not level > 0:
            return ", which fewer than three channels do not tell" if len(self.faraday.band.lambda2) < 3 else ""
        return f", {level:.3g} {self.cube.unit} from differences of channels"

    def alias_text(self) -> list[str]:
        """The depths at which a source of this band might lie as well, and how many peaks are left out for that."""
        assert self.peaks is not None
        unclear, aliases = int(self.peaks.ambiguous.sum()), self.peaks.aliases
        out = []
        if unclear:
            out.append(f"{unclear} pixels are ambiguous: their peak and an alias of it cannot be told apart")
        if aliases:
            shown = ", ".join(f"{depth:.4g} ({height:.3g})" for depth, height in aliases[:4])
            more = f" and {len(aliases) - 4} more" if len(aliases) > 4 else ""
            out.append(f"aliases       so many rad/m2 apart (and so high, of the main peak): {shown}{more}")
        return out

    def record(self) -> dict[str, Any]:
        """Its checks, and what was found, under "cube"."""
        found = self.figures()
        return {"checks": found.pop("checks"), "stage_errors": found.pop("stage_errors"), "cube": found}

    def cards(self) -> list[Card]:
        """How far each window is open, and in how many pixels there is a significant Faraday peak."""
        cards = [
            Card(f"EoR window open, {name or 'as it is'}", f"{number(share)}\u00a0%", "of the area of the bins")
            for name, window in self.windows.items()
            if np.isfinite(share := 100 * window.area()[1])
        ]
        if self.peaks is not None:
            share = 100 * float(np.mean(self.peaks.significant))
            text = f"of the pixels, above {self.peaks.snr_min:g} times the noise"
            cards.append(Card("Faraday depth found", f"{number(share)}\u00a0%", text))
        return cards

    def figures(self) -> dict[str, Any]:
        """Settings, what was left out, checks, and the numbers of every product."""
        out: dict[str, Any] = {"settings": self.settings.to_dict(), "left_out": self.left_out, "warnings": self.warned}
        if self.faraday is not None and self.peaks is not None:
            band = self.faraday.band
            names = ("width", "fwhm", "fwhm_nominal", "fwhm_sinc", "phi_max", "max_scale")
            out["faraday"] = {name: float(getattr(band, name)) for name in names}
            out["faraday"] |= {
                "lambda2_0": self.faraday.lambda2_0, "significant": int(self.peaks.significant.sum()),
                "ambiguous": int(self.peaks.ambiguous.sum()), "aliases": self.peaks.aliases,
                "noise": self.faraday.measured_noise, "depths": [float(f(self.faraday.depths)) for f in (min, max)],
                "step": float(np.ptp(self.faraday.depths)) / max(1, len(self.faraday.depths) - 1),
            }  # fmt: skip
        if self.split is not None:
            out["removal"] = {"text": self.said.splitlines(), "outcome": self.split.outcome.name.lower()}
        told = {name: str(check) for name, check in self.checks.items() if check is not None}
        if self.cleaned is not None:
            told["RM-CLEAN"] = f"{int((self.cleaned.codes == 1).sum())} of {self.cleaned.codes.size} spectra not done"
        if self.split is not None:
            told["removal"] = self.said.splitlines()[-1]
        out["checks"] = {
            name: {"outcome": [told.get(name, "not made")], "passed": passed} for name, passed in self.verdicts.items()
        }
        out["stage_errors"] = {
            stage: str(max(checks, key=lambda c: c.error))
            for stage, start in (("Faraday depth", "Faraday"), ("3D spectra", "power"))
            if (checks := [c for name, c in self.checks.items() if c is not None and name.startswith(start)])
        }
        for name, window in self.windows.items():
            out.setdefault("windows", {})[name or "as it is"] = {
                "text": str(window).splitlines(),
                "area": window.area(), "area_removed": window.area(self.settings.removed),
                "reach": window.reach(), "reach_removed": window.reach(self.settings.removed),
            }  # fmt: skip
        return out

    def write(self, folder: Path) -> None:
        """Tables (ECSV) of every spectrum and window, maps of Faraday peaks; the cubes made, where asked for."""
        for kind, spectra in (("2d", self.planes), ("cylindrical", self.cylinders), ("spherical", self.spheres)):
            for name, spectrum in spectra.items():
                spectrum.write(folder / f"spectrum_{kind}_{name.replace(' ', '_')}.ecsv")
        for name, window in self.windows.items():
            window.write(folder / f"window{'_' if name else ''}{name.replace(' ', '_')}.ecsv")
        if self.peaks is not None and self.faraday is not None:
            self.peaks.write(folder / "faraday_peaks.fits", self.faraday)
            if self.settings.cubes:
                self.faraday.write(folder / "faraday.fits")
                if self.cleaned is not None:
                    self.cleaned.cube.write(folder / "faraday_cleaned.fits")
        if self.split is not None and self.settings.cubes:
            self.split.residual.write(folder / "residual.fits")
