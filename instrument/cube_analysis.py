"""What is made of a cube in one go: Faraday depths, power spectra, foreground removal, the EoR window."""

from __future__ import annotations

import time
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any, Literal, Self, get_args

import numpy as np
from pydantic import Field, model_validator

from instrument.analyze.analyzer import Analyzer
from instrument.analyze.cube_checks import CubeCheck, check_cells, check_faraday
from instrument.analyze.cylinders import Cylindrical, Spherical
from instrument.analyze.faraday_cube import FaradayCube
from instrument.analyze.faraday_peaks import FaradayPeaks
from instrument.analyze.fourier import Stokes, Taper
from instrument.analyze.signal import DEFAULT, Signal21cm
from instrument.analyze.spectra import Spectrum2D
from instrument.analyze.window import EoRWindow
from instrument.component import Component
from instrument.errors import InputError, InstrumentWarning, Outcome
from instrument.foreground.base import ForegroundRemover, Split
from instrument.image.cube import StokesCube
from instrument.registry import load
from instrument.units import Float, Radians, Seconds

Product = Literal["faraday", "spectrum-2d", "cylindrical", "spherical", "window"]
PRODUCTS: tuple[Product, ...] = get_args(Product)
Share = Annotated[float, Field(ge=0, lt=1)]
MOST_DEPTHS = 20001


class CubeAnalysis(Component):
    """Which products of a cube, and their settings; without `products` all that the cube allows.

    `depths` is the first, last and step of Faraday depth in rad/m²; `uv_range` in wavelengths; `taper` along frequency
    and `taper_space` over the images; `remove` is a foreground remover by name with its settings in `remover`; `signal`
    the 21-cm model; `wedge` an angle from the phase centre; `removed` the share of leakage taken away in the figures.
    """

    products: tuple[Product, ...] | None = None
    depths: tuple[float, float, float] = (-50.0, 50.0, 0.25)
    uv_range: tuple[float, float] | None = None
    taper: Taper | None = "blackman-harris"
    taper_space: Taper | None = "hann"
    bins: Annotated[int, Field(ge=1)] = 12
    infill: Seconds | None = None
    redshift: float | None = None
    signal: str = DEFAULT
    wedge: Radians | None = None
    removed: Share = 0.7
    remove: str | None = None
    remover: dict[str, Any] = Field(default_factory=dict)
    cubes: bool = False

    @model_validator(mode="after")
    def _can_be_done(self) -> Self:
        first, last, step = self.depths
        if not (np.isfinite(self.depths).all() and step > 0 and last > first):
            raise InputError(f"depths = {list(self.depths)}: give the first, the last and a step above 0, in rad/m2")
        if (last - first) / step > MOST_DEPTHS:
            raise InputError(
                f"depths = {list(self.depths)} are {(last - first) / step:.0f} steps: at most {MOST_DEPTHS}"
            )
        Signal21cm.table(self.signal)
        self.foreground_remover()
        return self

    def foreground_remover(self) -> ForegroundRemover | None:
        """The remover asked for."""
        if self.remove is None:
            if self.remover:
                raise InputError(f"settings {sorted(self.remover)} of a remover, but none is named: remove = 'gmca'")
            return None
        found: ForegroundRemover = load("foregrounds", self.remove, **self.remover)
        return found

    def depth_axis(self) -> Float:
        """Faraday depths in rad/m² (N,), the last one included."""
        first, last, step = self.depths
        return np.asarray(first + step * np.arange(int(np.floor((last - first) / step * (1 + 1e-12) + 1e-9)) + 1))

    def refusals(self, cube: StokesCube) -> dict[str, str]:
        """Why a cube cannot have some products, by product."""
        there = stokes_of(cube)
        out: dict[str, str] = {}
        if len(cube.freq_hz) < 2:
            out |= dict.fromkeys(("faraday", "cylindrical", "spherical", "window"), "one channel")
        if not {"Q", "U"} <= set(there):
            out.setdefault("faraday", "no Stokes Q and U with data")
        if "I" not in there:
            out.setdefault("window", "no Stokes I with data, whose power is the leakage")
        if cube.unit != "K" and not _has_beam(cube):
            text = f"the cube is in {cube.unit} and its beam is not known: give the beam (--beam), or the cube in K"
            out.setdefault("window", text)
        if self.remove is not None and len(cube.freq_hz) < 2:
            raise InputError(f"remove = '{self.remove}': one channel has no foreground that is smooth along frequency")
        asked = [f"'{name}': {out[name]}" for name in self.products or () if name in out]
        if asked:
            raise InputError(f"products = {'; '.join(asked)}")
        return out

    def run(
        self,
        cube: StokesCube,
        noise: StokesCube | None = None,
        progress: Callable[[float], None] = lambda done: None,
    ) -> CubeResults:
        """All products of a cube; `noise` is a cube of noise alone. Spectra are in K where the beam is known."""
        refused = self.refusals(cube)
        wanted = [p for p in PRODUCTS if p not in refused and (self.products is None or p in self.products)]
        result = CubeResults(self, cube)
        if self.products is None:
            result.left_out |= refused
        for name in "IQUV":
            if name not in stokes_of(cube):
                result.left_out[f"Stokes {name}"] = "no data, or zero everywhere"
        kelvin = cube.to_kelvin() if cube.unit != "K" and _has_beam(cube) else cube
        if noise is not None and noise.unit != kelvin.unit:
            noise = noise.to_kelvin()
        with warnings.catch_warnings(record=True) as said:
            warnings.simplefilter("always", InstrumentWarning)
            if "faraday" in wanted:
                self._faraday(cube, result)
            progress(0.3)
            if self.remove is not None:
                self._split(kelvin, result)
            progress(0.6)
            self._spectra(kelvin, wanted, result)
            progress(0.8)
            if "window" in wanted:
                self._window(kelvin, noise, result)
            progress(1.0)
        for text in dict.fromkeys(str(w.message) for w in said if issubclass(w.category, InstrumentWarning)):
            result.warned.append(text)
            warnings.warn(text, InstrumentWarning, stacklevel=2)
        return result

    def _faraday(self, cube: StokesCube, result: CubeResults) -> None:
        from astropy import units as u

        with result.timed("Faraday depth"):
            found = Analyzer(cube).rm_synthesis(self.depth_axis())
        with result.timed("checks"):
            result.checks["Faraday depth"] = check_faraday(cube, found)
        with result.timed("Faraday depth"):
            result.faraday, result.peaks = found, found.peaks()
            top = np.where(np.isfinite(result.peaks.snr), result.peaks.snr, -1)
            result.brightest = tuple(int(i) for i in np.unravel_index(int(np.argmax(top)), top.shape))
            y, x = result.brightest
            spectrum = cube.data[:, :, y : y + 1, x : x + 1]
            pixel = StokesCube(spectrum, cube.freq_hz * u.Hz, cube.pixel_rad * u.rad, cube.unit)
            alone: tuple[Stokes, ...] = ("I", "P", "V")
            for stokes in alone:
                if stokes == "P" or stokes in stokes_of(cube):
                    result.lines[stokes] = Analyzer(pixel).rm_synthesis(self.depth_axis(), stokes=stokes)

    def _split(self, cube: StokesCube, result: CubeResults) -> None:
        remover = self.foreground_remover()
        assert remover is not None
        with result.timed("foreground removal"):
            result.split = remover.split(cube)
            result.said = str(result.split)

    def _spectra(self, cube: StokesCube, wanted: list[Product], result: CubeResults) -> None:
        there = stokes_of(cube)
        names: list[Any] = [s for s in ("I", "V") if s in there]
        names += ["P"] if {"Q", "U"} <= set(there) else [s for s in ("Q", "U") if s in there]
        cubes = {name: (cube, name) for name in names}
        if result.split is not None and (stokes := result.split.remover.stokes) in names:
            cubes[f"{stokes} after removal"] = result.split.residual, stokes
        for name, (one, stokes) in cubes.items():
            analyzer = Analyzer(one)
            if "spectrum-2d" in wanted:
                with result.timed("2D spectra"):
                    middle = int(np.argsort(cube.freq_hz)[len(cube.freq_hz) // 2])
                    result.planes[name] = analyzer.spectrum_2d(
                        stokes, middle, self.uv_range, self.taper_space, redshift=self.redshift
                    )
            if {"cylindrical", "spherical"} & set(wanted):
                with result.timed("3D spectra"):
                    cells = analyzer.cells(
                        stokes, self.taper, self.taper_space, self.uv_range, None, False, self._infill(), self.redshift
                    )
                with result.timed("checks"):
                    check = check_cells(one, cells)
                    if check is not None:
                        result.checks[f"power spectrum of {name}"] = check
                with result.timed("3D spectra"):
                    if "cylindrical" in wanted:
                        result.cylinders[name] = cells.cylindrical(self.bins)
                    if "spherical" in wanted:
                        result.spheres[name] = cells.spherical(self.bins)

    def _window(self, cube: StokesCube, noise: StokesCube | None, result: CubeResults) -> None:
        from astropy import units as u

        cubes = {"": cube}
        if result.split is not None and result.split.remover.stokes == "I":
            cubes["after removal"] = result.split.residual
        with result.timed("EoR window"):
            for name, one in cubes.items():
                result.windows[name] = Analyzer(one).eor_window(
                    Signal21cm.table(self.signal), "I", noise, None if self.wedge is None else self.wedge * u.rad,
                    taper=self.taper, taper_space=self.taper_space, uv_range=self.uv_range, bins=self.bins,
                    infill=self._infill(), redshift=self.redshift,
                )  # fmt: skip

    def _infill(self) -> Any:
        from astropy import units as u

        return None if self.infill is None else self.infill * u.s


@dataclass
class CubeResults:
    """What was made of a cube: spectra by name, windows, Faraday cube, what was left out and why, seconds."""

    settings: CubeAnalysis
    cube: StokesCube
    faraday: FaradayCube | None = None
    peaks: FaradayPeaks | None = None
    brightest: tuple[int, ...] = ()
    lines: dict[str, FaradayCube] = field(default_factory=dict)
    split: Split | None = None
    said: str = ""
    planes: dict[str, Spectrum2D] = field(default_factory=dict)
    cylinders: dict[str, Cylindrical] = field(default_factory=dict)
    spheres: dict[str, Spherical] = field(default_factory=dict)
    windows: dict[str, EoRWindow] = field(default_factory=dict)
    left_out: dict[str, str] = field(default_factory=dict)
    checks: dict[str, CubeCheck] = field(default_factory=dict)
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
        """Whether every check held, and the removal, if there is one, converged and did not make it worse."""
        checked = all(check.passed for check in self.checks.values())
        return checked and (self.split is None or self.removal_passed)

    @property
    def removal_passed(self) -> bool:
        """Whether the removal converged and, as far as its score is known, did not make it worse."""
        assert self.split is not None
        if self.split.outcome is not Outcome.CONVERGED:
            return False
        try:
            return not self.split.score().worse
        except InputError:  # too few channels or pixels for a score: said in the text
            return True

    def lines_of_text(self) -> list[str]:
        """What matters, for the terminal."""
        shape = self.cube.data.shape
        low, high = self.cube.freq_hz.min() / 1e6, self.cube.freq_hz.max() / 1e6
        out = [f"cube          {shape[0]} channels {low:.6g} to {high:.6g} MHz, {shape[3]} x {shape[2]} pixels, "
               f"{self.cube.unit}"]  # fmt: skip
        out += [f"left out      {name}: {why}" for name, why in self.left_out.items()]
        if self.faraday is not None and self.peaks is not None:
            found = int(self.peaks.significant.sum())
            out.append(f"Faraday       {self.faraday.band}")
            out.append(f"peaks         {found} pixels above {self.peaks.snr_min:g} times the noise")
        out += [f"{'removal' if k == 0 else '':<14}{line}" for k, line in enumerate(self.said.splitlines())]
        out += [f"check         {name}: {check}" for name, check in self.checks.items()]
        for name, window in self.windows.items():
            out += ["", f"{name or 'as it is'}:", *str(window).splitlines()]
        return out

    def record(self) -> dict[str, Any]:
        """What `run.json` holds of it."""
        out: dict[str, Any] = {"settings": self.settings.to_dict(), "left_out": self.left_out, "warnings": self.warned}
        if self.faraday is not None and self.peaks is not None:
            band = self.faraday.band
            names = ("width", "fwhm", "fwhm_nominal", "fwhm_sinc", "phi_max", "max_scale")
            out["faraday"] = {name: float(getattr(band, name)) for name in names}
            out["faraday"] |= {"lambda2_0": self.faraday.lambda2_0, "significant": int(self.peaks.significant.sum())}
        if self.split is not None:
            out["removal"] = {"text": self.said.splitlines(), "outcome": self.split.outcome.name.lower()}
        out["checks"] = {name: {"outcome": [str(c)], "passed": c.passed} for name, c in self.checks.items()}
        if self.split is not None:
            out["checks"]["removal"] = {"outcome": [self.said.splitlines()[-1]], "passed": self.removal_passed}
        out["stage_errors"] = {
            stage: str(max(checks, key=lambda c: c.error))
            for stage, start in (("Faraday depth", "Faraday"), ("3D spectra", "power"))
            if (checks := [c for name, c in self.checks.items() if name.startswith(start)])
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
        if self.split is not None and self.settings.cubes:
            self.split.residual.write(folder / "residual.fits")


def stokes_of(cube: StokesCube) -> list[str]:
    """Stokes parameters that a cube has: with data, and not zero everywhere."""
    return [name for k, name in enumerate("IQUV") if any(np.nan_to_num(plane[k]).any() for plane in cube.data)]


def _has_beam(cube: StokesCube) -> bool:
    return cube.psf is not None and bool(np.isfinite(cube.psf.solid_angle_sr).all())
