"""What is made of a cube in one go: Faraday depths, power spectra, foreground removal, the EoR window."""

from __future__ import annotations

import warnings
from collections.abc import Callable
from dataclasses import replace
from typing import Annotated, Any, Literal, Self, get_args

import numpy as np
from pydantic import Field, model_validator

from instrument.analyze.analyzer import Analyzer
from instrument.analyze.cube_checks import check_cells, check_faraday
from instrument.analyze.faraday.band import MOST, FaradayBand
from instrument.analyze.power.channel_grid import even_channels
from instrument.analyze.power.fourier import Stokes, Taper
from instrument.analyze.power.signal import DEFAULT, Signal21cm
from instrument.checked import checked
from instrument.component import Component
from instrument.errors import InputError, InstrumentWarning, unused, warn
from instrument.foreground.base import ForegroundRemover
from instrument.image.cube import StokesCube
from instrument.image.present import has_beam, in_kelvin, middle_channel, stokes_of
from instrument.memory import afford, give_back
from instrument.pipeline.stages.cube_page import CubeResults
from instrument.registry import load
from instrument.units import Count, Finite, Float, NotNegative, Positive, PositiveSeconds, Radians, Real, UvRange

Product = Literal["faraday", "spectrum-2d", "cylindrical", "spherical", "window"]
PRODUCTS: tuple[Product, ...] = get_args(Product)
Removed = Annotated[float, Real(at_least=0, below=1)]
MOST_DEPTHS = 20001
DEFAULT_BYTES = 2 << 30  # of a Faraday cube whose depths nobody asked for
CLEAN_SIGMAS = 5.0  # RM-CLEAN goes down to it


@checked
class CubeAnalysis(Component):
    """Which products of a cube, and their settings; without `products` all that the cube allows.

    `depths` is the first, last and step of Faraday depth in rad/m²; without the step, or without all, it is that of the
    band (FWHM / 8, out to its largest depth). `weights` (F,) are those of the channels in Faraday depth; `clean` takes
    peaks from spectra after RM-CLEAN. `uv_range` in wavelengths; `taper` along frequency
    and `taper_space` over the images; `remove` is a foreground remover by name with its settings in `remover`; `signal`
    the 21-cm model; `wedge` an angle from the phase centre; `removed` the share of leakage taken away in the figures.
    """

    products: tuple[Product, ...] | None = None
    depths: tuple[Finite, ...] | None = None
    weights: tuple[NotNegative, ...] | None = None
    clean: bool = False
    uv_range: UvRange | None = None
    taper: Taper | None = "blackman-harris"
    taper_space: Taper | None = "hann"
    bins: Count = 12
    infill: PositiveSeconds | None = None
    redshift: Positive | None = None
    signal: str = DEFAULT
    wedge: Radians | None = None
    removed: Removed = 0.7
    remove: str | None = None
    remover: dict[str, Any] = Field(default_factory=dict)
    cubes: bool = False

    @model_validator(mode="after")
    def _can_be_done(self) -> Self:
        if self.depths is not None:
            given = list(self.depths)
            if len(given) not in (2, 3) or given[1] <= given[0] or min(given[2:], default=1.0) <= 0:
                raise InputError(f"depths = {given}: give the first, the last and a step above 0, in rad/m2")
            if len(given) == 3 and (given[1] - given[0]) / given[2] > MOST_DEPTHS:
                steps = (given[1] - given[0]) / given[2]
                raise InputError(f"depths = {given} are {steps:.0f} steps: at most {MOST_DEPTHS}")
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

    def band(self, cube: StokesCube) -> FaradayBand:
        """The band in which Q + iU of a cube has data and weight."""
        from astropy import units as u

        has = [bool(np.isfinite(planes[1] + planes[2]).any()) for planes in cube.data]
        weights = np.ones(len(has)) if self.weights is None else np.asarray(self.weights)
        if weights.shape != (len(has),):
            raise InputError(f"weights are {len(weights)}, the cube has {len(has)} channels: give one for each")
        return FaradayBand.of(cube.freq_hz * u.Hz, weights * has)

    def depth_axis(self, cube: StokesCube) -> Float:
        """Faraday depths in rad/m² (N,), the last one included: those asked for, or those of the band of a cube.

        Raises `InputError` for steps between which peaks are missed; warns where the band reaches further.
        """
        band = self.band(cube)
        if self.depths is not None and len(self.depths) == 3:
            first, last, step = self.depths
            if step > band.fwhm / 4 * (1 + 1e-6):
                raise InputError(
                    f"depths = {list(self.depths)}: in steps of {step:g} rad/m2 peaks are missed, the RMSF of this "
                    f"band is {band.fwhm:.4g} wide (FWHM); give a step of {band.fwhm / 8:.3g}, or leave it out"
                )
            return np.asarray(first + step * np.arange(int(np.floor((last - first) / step * (1 + 1e-12) + 1e-9)) + 1))
        if self.depths is not None:
            first, last = self.depths
            if (last - first) / (band.fwhm / 8) > MOST_DEPTHS:
                raise InputError(
                    f"depths = {list(self.depths)} are more than {MOST_DEPTHS} steps of {band.fwhm / 8:.3g}"
                )
            return band.depths(first, last)
        each = cube.data[0, 0].size * (16 if cube.data.dtype.itemsize > 4 else 8)
        most = int(np.clip(DEFAULT_BYTES // each, 65, MOST))
        axis = band.depths(most=most)
        if axis[-1] < band.phi_max - band.fwhm:
            text = f"Faraday depths end at +-{axis[-1]:.4g} rad/m2 ({len(axis)} of them), this band sees sources out to"
            warn(f"{text} {band.phi_max:.4g}: ask for them with depths (--depths FIRST,LAST)")
        return axis

    def refusals(self, cube: StokesCube) -> dict[str, str]:
        """Why a cube cannot have some products, by product."""
        there = stokes_of(cube)
        out: dict[str, str] = {}
        if self.weights is not None and len(self.weights) != len(cube.freq_hz):
            raise InputError(
                f"weights are {len(self.weights)}, the cube has {len(cube.freq_hz)} channels: one for each"
            )
        if len(cube.freq_hz) < 2:
            out |= dict.fromkeys(("faraday", "cylindrical", "spherical", "window"), "one channel")
        if not {"Q", "U"} <= set(there):
            out.setdefault("faraday", "no Stokes Q and U with data")
        if "faraday" not in out and self.wants("faraday"):
            out |= self._no_depths(cube)
        if "I" not in there:
            out.setdefault("window", "no Stokes I with data, whose power is the leakage")
        missing = self._missing(cube, there)
        if missing is not None:
            out = dict.fromkeys(("cylindrical", "spherical", "window"), missing) | out
        if cube.unit == "Jy/beam" and not has_beam(cube):
            text = f"the cube is in {cube.unit} and its beam is not known: give the beam (--beam), or the cube in K"
            out.setdefault("window", text)
        if self.remove is not None and len(cube.freq_hz) < 2:
            raise InputError(f"remove = '{self.remove}': one channel has no foreground that is smooth along frequency")
        if not there:
            raise InputError("the cube has no data: every voxel is NaN or zero")
        remover = self.foreground_remover()
        for plane in () if remover is None else (remover.stokes, *remover.planes):
            if plane not in there:
                raise InputError(f"remove = '{self.remove}': Stokes {plane} of the cube has no data")
        asked = [f"'{name}': {out[name]}" for name in self.products or () if name in out]
        if asked:
            raise InputError(f"products = {'; '.join(asked)}")
        return out

    def wants(self, product: Product) -> bool:
        """Whether a product is asked for, or all are."""
        return self.products is None or product in self.products

    def _no_depths(self, cube: StokesCube) -> dict[str, str]:
        """Why a cube has no Faraday depths, if so; raises `InputError` for depths asked for that will not do."""
        band = self.band(cube)
        if len(band.lambda2) < 2 or not np.isfinite(band.fwhm):
            return {"faraday": f"{len(band.lambda2)} channel(s) with data and weight in Q and U"}
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", InstrumentWarning)  # said when it runs
            axis = self.depth_axis(cube)
        size = len(axis) * cube.data[0, 0].size * (16 if cube.data.dtype.itemsize > 4 else 8)
        what = f"a Faraday cube of {len(axis)} depths and {cube.data[0, 0].size} pixels"
        afford(size * (4 if self.clean else 1), what, "give fewer depths (--depths FIRST,LAST,STEP)")
        if self.clean and len(band.lambda2) < 3:
            raise InputError("clean: RM-CLEAN goes down to a multiple of the noise, which two channels do not tell")
        return {}

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
        self._unused(wanted, noise)
        with warnings.catch_warnings(record=True) as said:
            warnings.simplefilter("always", InstrumentWarning)
            self._in_kelvin(cube, noise, wanted, result, progress)
            if "faraday" in wanted:  # the largest comes last, when what the spectra took is free again
                give_back()
                self._faraday(cube, result)
            progress(1.0)
        for text in dict.fromkeys(str(w.message) for w in said if issubclass(w.category, InstrumentWarning)):
            result.warned.append(text)
            warn(text)
        return result

    def _in_kelvin(
        self,
        cube: StokesCube,
        noise: StokesCube | None,
        wanted: list[Product],
        result: CubeResults,
        progress: Callable[[float], None],
    ) -> None:
        """What is made of temperatures: removal, spectra and the window."""
        kelvin = in_kelvin(cube)
        if noise is not None and noise.unit != kelvin.unit:
            noise = noise.to_kelvin()
        if self.remove is not None:
            self._split(kelvin, result)
        progress(0.3)
        self._spectra(kelvin, wanted, result)
        progress(0.5)
        if "window" in wanted:
            self._window(kelvin, noise, result)
        progress(0.7)

    def _unused(self, wanted: list[Product], noise: StokesCube | None) -> None:
        """Name the settings that no product uses."""
        of: dict[str, tuple[Product, ...]] = {
            "depths": ("faraday",), "weights": ("faraday",), "clean": ("faraday",), "signal": ("spherical", "window"),
            "wedge": ("window",), "removed": ("window",), "bins": ("cylindrical", "spherical", "window"),
            "infill": ("cylindrical", "spherical", "window"), "taper": ("cylindrical", "spherical", "window"),
            "taper_space": ("spectrum-2d", "cylindrical", "spherical", "window"),
            "uv_range": ("spectrum-2d", "cylindrical", "spherical", "window"),
            "redshift": ("spectrum-2d", "cylindrical", "spherical", "window"),
        }  # fmt: skip
        given = [name for name in of if getattr(self, name) != type(self).model_fields[name].default]
        idle = [name for name in given if not set(of[name]) & set(wanted)]
        unused("analyze", idle, "no product that is made takes it")
        if noise is not None and "window" not in wanted:
            unused("analyze", ["noise"], "it is added to the leakage in the window, which is not made")

    def _faraday(self, cube: StokesCube, result: CubeResults) -> None:
        from astropy import units as u

        axis = self.depth_axis(cube)
        with result.timed("Faraday depth"):
            found = Analyzer(cube).rm_synthesis(axis, weights=self.weights)
        with result.timed("checks"):
            result.checks["Faraday depth"] = check_faraday(cube, found)
        with result.timed("Faraday depth"):
            if self.clean:
                result.cleaned = found.clean(sigmas=CLEAN_SIGMAS)
            result.faraday = found
            result.peaks = (found if result.cleaned is None else result.cleaned.cube).peaks()
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
                    result.sights[stokes] = Analyzer(pixel).rm_synthesis(axis, stokes=stokes, weights=self.weights)
            if result.cleaned is not None:
                result.sights["P cleaned"] = replace(
                    result.sights["P"], data=result.cleaned.restored[:, y : y + 1, x : x + 1]
                )

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
                    middle = middle_channel(one, "Q" if stokes == "P" else stokes)
                    result.planes[name] = analyzer.spectrum_2d(
                        stokes, middle, self.uv_range, self.taper_space, redshift=self.redshift
                    )
            if {"cylindrical", "spherical"} & set(wanted):
                with result.timed("3D spectra"):
                    cells = analyzer.cells(
                        stokes,
                        self.taper,
                        self.taper_space,
                        self.uv_range,
                        None,
                        False,
                        self.infill_time(),
                        self.redshift,
                    )
                with result.timed("checks"):
                    check = check_cells(one, cells)
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
                    bins_par=10 if len(one.freq_hz) >= 8 else None, infill=self.infill_time(), redshift=self.redshift,
                )  # fmt: skip

    def infill_time(self) -> Any:
        """`infill` as a time."""
        from astropy import units as u

        return None if self.infill is None else self.infill * u.s
