"""What is made of a cube in one go: Faraday depths, power spectra, foreground removal, the EoR window."""

from __future__ import annotations

import warnings
from collections.abc import Callable
from typing import Annotated, Any, Literal, Self, get_args

import numpy as np
from pydantic import Field, model_validator

from instrument.analyze.analyzer import Analyzer
from instrument.analyze.channel_grid import even_channels
from instrument.analyze.cube_checks import check_cells, check_faraday
from instrument.analyze.fourier import Stokes, Taper
from instrument.analyze.signal import DEFAULT, Signal21cm
from instrument.checked import checked
from instrument.component import Component
from instrument.cube_results import CubeResults
from instrument.errors import InputError, InstrumentWarning
from instrument.foreground.base import ForegroundRemover
from instrument.image.cube import StokesCube
from instrument.registry import load
from instrument.units import Float, Radians, Seconds

Product = Literal["faraday", "spectrum-2d", "cylindrical", "spherical", "window"]
PRODUCTS: tuple[Product, ...] = get_args(Product)
Share = Annotated[float, Field(ge=0, lt=1)]
MOST_DEPTHS = 20001


@checked
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
        missing = self._missing(cube, there)
        if missing is not None:
            out = dict.fromkeys(("cylindrical", "spherical", "window"), missing) | out
        if cube.unit == "Jy/beam" and not _has_beam(cube):
            text = f"the cube is in {cube.unit} and its beam is not known: give the beam (--beam), or the cube in K"
            out.setdefault("window", text)
        if self.remove is not None and len(cube.freq_hz) < 2:
            raise InputError(f"remove = '{self.remove}': one channel has no foreground that is smooth along frequency")
        if not there:
            raise InputError("the cube has no data: every voxel is NaN or zero")
        if self.remove is not None and (remover := self.foreground_remover()) and remover.stokes not in there:
            raise InputError(f"remove = '{self.remove}': Stokes {remover.stokes} of the cube has no data")
        asked = [f"'{name}': {out[name]}" for name in self.products or () if name in out]
        if asked:
            raise InputError(f"products = {'; '.join(asked)}")
        return out

    def _missing(self, cube: StokesCube, there: list[str]) -> str | None:
        """Why the channels of a cube have no delays, if so."""
        if len(cube.freq_hz) < 2:
            return None
        try:
            even_channels(cube, self.infill is not None)
        except InputError as error:
            return str(error)
        planes = [cube.data[:, "IQUV".index(name)] for name in there]
        holes = sum(any(np.isnan(plane[k]).all() for plane in planes) for k in range(len(cube.freq_hz)))
        if holes and self.infill is None:
            return f"{holes} channels are all NaN: fill them in with infill (--infill '300 ns')"
        return None

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
        kelvin = cube.to_kelvin() if cube.unit == "Jy/pixel" or _has_beam(cube) else cube
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
            top = np.nan_to_num(np.abs(found.data[0]))
            for plane in found.data[1:]:
                np.maximum(top, np.nan_to_num(np.abs(plane)), out=top)
            result.brightest = tuple(int(i) for i in np.unravel_index(int(np.argmax(top)), top.shape))
            y, x = result.brightest
            spectrum = cube.data[:, :, y : y + 1, x : x + 1]
            pixel = StokesCube(spectrum, cube.freq_hz * u.Hz, cube.pixel_rad * u.rad, cube.unit)
            alone: tuple[Stokes, ...] = ("I", "P", "V")
            for stokes in alone:
                if stokes == "P" or np.nan_to_num(spectrum[:, "IQUV".index(stokes)]).any():
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
                    middle = _middle(one, "Q" if stokes == "P" else stokes)
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
                    bins_par=10 if len(one.freq_hz) >= 8 else None, infill=self._infill(), redshift=self.redshift,
                )  # fmt: skip

    def _infill(self) -> Any:
        from astropy import units as u

        return None if self.infill is None else self.infill * u.s


def stokes_of(cube: StokesCube) -> list[str]:
    """Stokes parameters that a cube has: with data, and not zero everywhere."""
    return [name for k, name in enumerate("IQUV") if any(np.nan_to_num(plane[k]).any() for plane in cube.data)]


def _has_beam(cube: StokesCube) -> bool:
    """Whether every channel with data has a beam."""
    if cube.psf is None:
        return False
    known = np.isfinite(cube.psf.solid_angle_sr)
    return all(has or not np.isfinite(planes).any() for has, planes in zip(known, cube.data, strict=True))


def _middle(cube: StokesCube, stokes: str) -> int:
    """The middle one of the channels that have data."""
    plane = cube.data[:, "IQUV".index(stokes)]
    there = [k for k in np.argsort(cube.freq_hz, kind="stable") if np.isfinite(plane[k]).any()]
    return int(there[len(there) // 2])
