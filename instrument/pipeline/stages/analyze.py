"""The table [analyze]: leakage of sources, spectra of images, and [analyze.cube]: what is made of the cube."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar, Literal, Self

import numpy as np

from instrument.analyze.analyzer import Analyzer
from instrument.analyze.power.fourier import check_redshift
from instrument.analyze.power.spectra import Spectrum2D
from instrument.analyze.sources.photometry import ForcedPhotometry
from instrument.errors import InputError, unused
from instrument.pipeline.stage import Beside, Draw, Running, Several, Stage, StageResult, StageRun
from instrument.pipeline.stages.analyze_work import cube_products, photometry, together
from instrument.pipeline.stages.cube import CubeAnalysis
from instrument.pipeline.stages.image import Image, ImageResult
from instrument.pipeline.stages.leakage import EXPECTED_JONES, LeakageRun, listed
from instrument.pipeline.stages.leaked import Leaked
from instrument.pipeline.stages.recovered import recovered, recovering, signal_of
from instrument.pipeline.work import Items, StageWork
from instrument.plan import Item
from instrument.report.page import Figures, Section, Text
from instrument.scene import Scene
from instrument.units import Count, UvRange
from instrument.visibilities import Visibilities

STOKES: tuple[Literal["I", "P", "V"], ...] = ("I", "P", "V")


class Analyze(Stage):
    """What is made of sources and images: products, settings of forced photometry, and the analysis of the cube."""

    after: ClassVar[tuple[str, ...]] = ("data", "noise", "calibrate", "correct", "image")
    products: tuple[Literal["leakage", "spectrum-2d", "recovered"], ...] = ("leakage",)
    uv_range: UvRange | None = None
    every: Count = 1
    cube: CubeAnalysis | None = None

    @classmethod
    def from_table(cls, settings: Mapping[str, Any], beside: Beside) -> Self:
        """The stage; raises `InputError` where products need images and there are none."""
        found = cls(**settings)
        if "spectrum-2d" in found.products and "image" not in beside.tables:
            raise InputError("[analyze] products = ['spectrum-2d'] needs images: give a table [image]")
        if found.cube and "image" not in beside.tables:
            raise InputError("[analyze.cube] needs images: give a table [image]")
        if "recovered" in found.products and found.cube is None:
            raise InputError("[analyze] products = ['recovered'] takes its bins and tapers from a table [analyze.cube]")
        if "recovered" in found.products and beside.tables["image"].get("kind") == "clean":
            raise InputError(
                "[analyze] products = ['recovered']: a CLEAN of the signal alone is not that of the signal among "
                "others; take [image] kind = 'dirty' or 'beam'"
            )
        return found

    @property
    def needs_sky(self) -> bool:
        """For what is compared with the sources that are there."""
        return bool({"leakage", "recovered"} & set(self.products))

    def ranges(self) -> tuple[tuple[float, float] | None, ...]:
        """That of the photometry, where there is one."""
        return (self.uv_range,) if "leakage" in self.products else ()

    def check(self, scene: Scene) -> None:
        """Name settings of products that are not made, and a redshift off the band; refuse what one channel lacks."""
        if "leakage" not in self.products:
            given = [key for key in ("uv_range", "every") if key in self.model_fields_set]
            unused("[analyze]", given, "they are of the product 'leakage'")
        else:
            listed(scene.sky.about(scene.observation.phase_centre))
        if "recovered" in self.products:
            signal_of(scene.sky)
        freq = scene.observation.freq_hz
        if self.cube is not None:  # said before the run, not at its end
            check_redshift(self.cube.redshift, float(freq.min()), float(freq.max()))
        asked = [name for name in (self.cube and self.cube.products) or () if name != "spectrum-2d"]
        if asked and freq.size < 2:
            raise InputError(f"[analyze.cube] products = '{asked[0]}': one channel; give more, or take 'spectrum-2d'")
        if "recovered" in self.products and freq.size < 2:
            raise InputError(
                "[analyze] products = ['recovered']: one channel has no spectrum along frequency; give more"
            )

    def work(self, run: Running) -> StageWork:
        """That of its products, one after the other."""
        parts = []
        if "leakage" in self.products:
            parts.append(photometry(self._photometry, run, EXPECTED_JONES))
        if (image := run.stage("image", Image)) is not None:
            pixels, channels = image.imager.pixels**2, run.plan.problem.shape[1]
            if "spectrum-2d" in self.products:
                parts.append(
                    StageWork("2D spectra", finish_seconds=2e-6 * pixels, finish_bytes=200.0 * pixels, figures=1)
                )
            if self.cube is not None:
                parts.append(cube_products(self.cube, channels, pixels))
            if "recovered" in self.products:
                parts.append(recovering(run))
        return together(parts)

    def items(self, run: Running) -> Items:
        """Integrations that fluxes are not measured in."""
        if self.every == 1 or "leakage" not in self.products:
            return Items()
        text = f"fluxes are the mean over each {self.every}th: right for a sky that does not change"
        return Items(left_out=(Item("integrations", text),))

    @property
    def _photometry(self) -> ForcedPhotometry:
        return ForcedPhotometry(uv_range=self.uv_range, every=self.every)

    def start(self, run: Running) -> StageRun:
        """The stage at work."""
        return _AnalyzeRun(self, run)


class _AnalyzeRun(StageRun):
    def __init__(self, settings: Analyze, run: Running) -> None:
        self.settings, self.run = settings, run
        self.leakage = LeakageRun(run, settings._photometry) if "leakage" in settings.products else None

    def take(self, block: Visibilities) -> Visibilities:
        """Measure the sources in a block."""
        return block if self.leakage is None else self.leakage.take(block)

    def finish(self) -> StageResult:
        """Leakage, spectra, and the products of the cube."""
        found: list[StageResult] = [] if self.leakage is None else [self.leakage.finish()]
        if "spectrum-2d" in self.settings.products:
            found.append(self._spectra())
        if self.settings.cube is not None:
            if "noise" not in self.run.stages:  # which is in I and V too
                found.append(Leaked.of(self.run.plan.problem, self._images().cube))
            products = self.settings.cube.run(self._images().cube)
            self.run.parts.setdefault(self.run.now, {}).update(products.seconds)
            found.append(products)
            if "recovered" in self.settings.products:
                with self.run.timed("signal recovered"):
                    name = signal_of(self.run.plan.problem.sky)
                    found.append(recovered(self.run, name, self._images(), products))
        return Several(found)

    def _images(self) -> ImageResult:
        return self.run.result("image", ImageResult)

    def _spectra(self) -> SpectraResult:
        images = self._images()
        analyzer, uv_range = Analyzer(images.cube), images.imager.uv_range
        with self.run.timed("2D spectra"):
            return SpectraResult({s: analyzer.spectrum_2d(s, uv_range=uv_range, taper="hann") for s in STOKES})


@dataclass(frozen=True)
class SpectraResult(StageResult):
    """2D power spectra of the images of a run, by Stokes parameter."""

    spectra: dict[str, Spectrum2D]

    def write(self, folder: Path) -> None:
        """spectrum_2d_I.ecsv, ..."""
        for stokes, spectrum in self.spectra.items():
            spectrum.write(folder / f"spectrum_2d_{stokes}.ecsv")

    def sections(self, draw: Draw) -> list[Section]:
        """The spectra in one figure."""
        from instrument.report.spectra import spectra_2d

        if not any((np.nan_to_num(s.power) > 0).any() for s in self.spectra.values()):
            return [Section("Power spectra of the images", [Text("The images have no power to draw.")])]
        text = "2D power spectra of the images, Hann taper; the PSF stays."
        return [
            Section("Power spectra of the images", [Figures([draw("spectrum_2d", spectra_2d(self.spectra), text)])])
        ]
