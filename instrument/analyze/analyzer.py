"""Analyzer: the door to the analyses of a cube and of the visibilities it came from."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable
from typing import Any

from instrument.analyze.faraday.cube import FaradayCube
from instrument.analyze.faraday.synthesis import Division, Precision, Synthesis, rm_synthesis
from instrument.analyze.power.cells import Cells, cylindrical, spherical
from instrument.analyze.power.cylinders import Cylindrical, Spherical
from instrument.analyze.power.delay import Delay, delay_cells
from instrument.analyze.power.fourier import Stokes, Taper
from instrument.analyze.power.signal import Signal21cm
from instrument.analyze.power.spectra import Spectrum2D, spectrum_2d
from instrument.analyze.power.transform import Transform, cells_of
from instrument.analyze.power.window import EoRWindow, eor_window
from instrument.analyze.sources.catalogue import SourceCatalogue
from instrument.analyze.sources.finder import SourceFinder
from instrument.analyze.sources.fluxes import SourceFluxes
from instrument.analyze.sources.leakage import Leakage, leakage_of
from instrument.analyze.sources.photometry import ForcedPhotometry
from instrument.checked import checked
from instrument.errors import InputError
from instrument.image.common_beam import say_unequal_beams
from instrument.image.cube import StokesCube
from instrument.sky.base import Sky
from instrument.sky.points import points_of
from instrument.units import Direction, Index
from instrument.visibilities import Visibilities, VisibilitySet


@checked
class Analyzer:
    """What can be learnt from a cube, from visibilities with a known sky, or from both.

    `Analyzer(cube, visibilities=vis, sky=sky).leakage()`. Each analysis says what it needs when it is missing.
    """

    def __init__(
        self,
        cube: StokesCube | None = None,
        visibilities: VisibilitySet | Iterable[Visibilities] | None = None,
        sky: Sky | None = None,
        fluxes: SourceFluxes | None = None,
        centre: Direction | None = None,
    ) -> None:
        self.cube = cube
        self.visibilities = visibilities
        self.sky = sky
        self.fluxes = fluxes
        self.centre = centre

    def leakage(self, photometry: ForcedPhotometry | None = None, channel: Index = 0) -> Leakage:
        """Leakage of every source by forced photometry in the visibilities, in one channel.

        Needs the visibilities (or blocks of them) and the sky they were made from, or fluxes measured before.
        """
        centre, fluxes = self._centre(), self.fluxes
        if fluxes is None:
            if self.visibilities is None or self.sky is None:
                raise InputError("leakage needs visibilities and the sky: Analyzer(cube, visibilities=vis, sky=sky)")
            sky = points_of(self.sky.about(centre))
            if sky is None:
                raise InputError(
                    f"leakage of sources needs a sky that is a list of them, got {type(self.sky).__name__}"
                )
            fluxes = (photometry or ForcedPhotometry()).measure(self.visibilities, sky)
        return leakage_of(fluxes, centre, channel)

    def sources(self, finder: SourceFinder | None = None, channel: Index | None = None) -> SourceCatalogue:
        """Sources in the cube, by islands and Gaussian fits in Stokes I, with their fluxes in all channels and Stokes.

        In the weighted mean of all channels, or in one. `ForcedPhotometry().measure(visibilities, found.sky())`
        measures what was found in the visibilities, together.
        """
        if self.cube is None:
            raise InputError("sources are found in a cube: Analyzer(cube)")
        return (finder or SourceFinder()).find(self.cube, channel)

    def spectrum_2d(
        self,
        stokes: Stokes = "I",
        channel: Index = 0,
        uv_range: tuple[float, float] | None = None,
        taper: Taper | None = None,
        bins: Any = 15,
        log: bool = True,
        redshift: float | None = None,
        cosmology: Any = None,
    ) -> Spectrum2D:
        """Power spectrum of an image, in `cube.unit`² Mpc², over bins of k_perp in 1/Mpc; "P" is Q + iU.

        `uv_range` (wavelengths) keeps the cells of those baselines, its ends are the ends of the bins. `bins` is their
        number, equal in ln k (`log`) or in k, or their edges with a unit. `taper` goes over both axes; the level of
        white noise is kept. The mean is taken off before it. Pixels that are NaN count as zero and their share is made
        up for, as the share of the taper is: the mean of white noise is unchanged, but the rims of holes, like those
        of an image without a taper, scatter power from steep large scales to small ones. The cube's images stay as
        they are: neither the PSF nor the beam is divided out, so compare spectra of one PSF by `spectra.ratio`.
        """
        if self.cube is None:
            raise InputError("spectrum_2d needs a cube: Analyzer(cube)")
        return spectrum_2d(self.cube, stokes, channel, uv_range, taper, bins, log, redshift, cosmology)

    def cells(
        self,
        stokes: Stokes = "I",
        taper: Taper | None = "blackman-harris",
        taper_space: Taper | None = None,
        uv_range: tuple[float, float] | None = None,
        cross: StokesCube | None = None,
        psf_corrected: bool = False,
        infill: Any = None,
        redshift: float | None = None,
        cosmology: Any = None,
    ) -> Cells:
        """Power in every Fourier cell of the cube, to make several spectra from: `.cylindrical()`, `.spherical()`.

        `taper` goes along frequency: without one smooth spectra spill over all k_par (3e-6 of their power at 0.9 /Mpc;
        4e-14 behind "blackman-harris"). `taper_space` goes over both axes of the images: a field that is not periodic
        is 12 to 20 % too high without. The level of white noise is kept. `uv_range` (wavelengths) keeps the cells of
        those baselines. `cross` is a second cube (the other half of the data): the real part of one across the other,
        without the bias of their noise. `psf_corrected` divides by the response of the PSF; cells below 5 % of the
        largest are left out. Channels that are missing or all NaN are refused, or with `infill` (a delay, 300 ns) made
        from the others as if no delay were larger: smooth foregrounds to 1e-6, noise and signal not at all. A line of
        sight that holds NaN counts as zero, its share is made up for, and a warning says so. One redshift, of the
        middle of the band unless given, serves all of it.
        """
        if self.cube is None:
            raise InputError("power spectra need a cube: Analyzer(cube)")
        how = Transform(stokes, taper, taper_space, uv_range, psf_corrected, infill, redshift, cosmology)
        return cells_of(self.cube, how, cross)

    def cylindrical(
        self,
        stokes: Stokes = "I",
        taper: Taper | None = "blackman-harris",
        taper_space: Taper | None = None,
        uv_range: tuple[float, float] | None = None,
        bins: Any = 15,
        bins_par: Any = None,
        log: bool = True,
        paper_axis: bool = False,
        cross: StokesCube | None = None,
        psf_corrected: bool = False,
        infill: Any = None,
        redshift: float | None = None,
        cosmology: Any = None,
    ) -> Cylindrical:
        """Power spectrum of the cube in bins of k_perp and |k_par|, `cube.unit`² Mpc³; "P" is Q + iU.

        `bins` of k_perp and `bins_par` of k_par are their number, equal in ln k (`log`) or in k, or edges with a unit;
        by default every delay is a bin of k_par, up to Nyquist, 1/(2 dnu). `paper_axis` goes on to 1/dnu, where all
        is a mirror image, to redraw published figures. Log bins leave k = 0 out. The rest as in `cells`.
        """
        made = self.cells(stokes, taper, taper_space, uv_range, cross, psf_corrected, infill, redshift, cosmology)
        return cylindrical(made, bins, bins_par, log, paper_axis)

    def spherical(
        self,
        stokes: Stokes = "I",
        taper: Taper | None = "blackman-harris",
        taper_space: Taper | None = None,
        uv_range: tuple[float, float] | None = None,
        bins: Any = 15,
        log: bool = True,
        wedge: Any = None,
        k_par_min: Any = None,
        cross: StokesCube | None = None,
        psf_corrected: bool = False,
        infill: Any = None,
        redshift: float | None = None,
        cosmology: Any = None,
    ) -> Spherical:
        """Power spectrum of the cube in bins of k, `cube.unit`² Mpc³; "P" is Q + iU.

        `wedge` (an angle from the phase centre) and `k_par_min` leave out the cells below them. The rest as in `cells`
        and `cylindrical`.
        """
        made = self.cells(stokes, taper, taper_space, uv_range, cross, psf_corrected, infill, redshift, cosmology)
        return spherical(made, bins, log, wedge, k_par_min)

    def delay_spectrum(
        self,
        solid_angle: Any,
        stokes: Stokes = "I",
        taper: Taper | None = "blackman-harris",
        across_times: bool = False,
        bins: Any = 15,
        redshift: float | None = None,
        cosmology: Any = None,
    ) -> Cylindrical:
        """Power spectrum straight from visibilities in bins of k_perp and |k_par|, K² Mpc³; `.wedge()` as of cubes.

        Each baseline is transformed along frequency at each time, and stands at k_perp of its u and v in the middle of
        the band, in `bins` as those of `cylindrical`. `solid_angle` (sr) is the integral of the squared power beam, 1
        at its peak: pi fwhm² / (8 ln 2) of a Gaussian. `across_times` multiplies every integration by the next: without
        the bias of noise. Integrations of baselines that are not there in all channels are left out, and counted. The
        noise of a Stokes parameter of variance s² is (c² / 2 k nu²)² D² Y dnu s² / Omega. `.cells.spherical()` is the
        same over k.
        """
        if self.visibilities is None:
            raise InputError("delay spectra are made of visibilities: Analyzer(visibilities=vis)")
        how = Delay(solid_angle, stokes, taper, across_times, redshift, cosmology)
        return cylindrical(delay_cells(self.visibilities, how), bins)

    def eor_window(
        self,
        signal: Signal21cm,
        stokes: Stokes = "I",
        noise: StokesCube | None = None,
        wedge: Any = None,
        k_par_min: Any = 0.0,
        taper: Taper | None = "blackman-harris",
        taper_space: Taper | None = "hann",
        uv_range: tuple[float, float] | None = None,
        bins: Any = 10,
        bins_par: Any = 10,
        infill: Any = None,
        redshift: float | None = None,
        cosmology: Any = None,
    ) -> EoRWindow:
        """Where in (k_perp, k_par) the leakage that this cube holds stays below a 21-cm spectrum.

        `noise` is a cube of noise alone, added to the leakage; `wedge` an angle from the phase centre below whose line
        no bin counts, `k_par_min` the same for a line across. The cube must be in K.
        """

        def spectrum(cube: StokesCube) -> Cylindrical:
            made = Analyzer(cube).cells(
                stokes, taper, taper_space, uv_range, infill=infill, redshift=redshift, cosmology=cosmology
            )
            return made.cylindrical(bins, bins_par)

        if self.cube is None:
            raise InputError("eor_window needs a cube: Analyzer(cube)")
        return eor_window(spectrum(self.cube), signal, None if noise is None else spectrum(noise), wedge, k_par_min)

    def rm_synthesis(
        self,
        depths: Any = None,
        stokes: Stokes = "P",
        weights: Any = None,
        lambda2_0: Any = None,
        spectral_index: float | None = None,
        divide_by_i: Division = False,
        precision: Precision | None = None,
        out: str | os.PathLike[str] | None = None,
        noise: Any = None,
        progress: Callable[[float], None] | None = None,
    ) -> FaradayCube:
        """Faraday dispersion function at `depths` in rad/m², bare or a `Quantity`, in any order; see `FaradayCube`.

        Without `depths` the axis is that of the band, `FaradayBand.depths`; a warning says where steps or span of an
        axis do not fit the band.

        "P" is Q + iU; of a real Stokes parameter F(-phi) is the conjugate of F(phi). `weights` (F,) are such as
        1 / sigma²; a channel of weight 0 or without data counts nowhere, lambda²_0 included; a voxel that is NaN is
        left out of the sums of its pixel. `lambda2_0` in m² is the weighted mean of lambda²; with 0 the phases are
        those of the emission. `spectral_index` a divides by (nu/nu0)^a; `divide_by_i` "voxel" divides each voxel by
        Stokes I (I <= 0 or not finite: left out), "fit" by the power law fitted to I of the pixel (none above 0: NaN),
        True by the fit where I is below 10 times its noise a channel; F is multiplied with the power law at nu0, the
        frequency of the mean lambda². `noise`, sigma of Q and of U in the unit of the cube, one number or (F,),
        becomes that of F. `precision` "single" or "double" is that of the cube; single is good to 4e-7 of the largest
        |F|. `out` names a .npy file for F, which is then mapped: memory does not grow with it. `progress` is called
        with the fraction done. Raises `InputError` for infinite values and for a cube without data.
        """
        if self.cube is None:
            raise InputError("rm_synthesis needs a cube: Analyzer(cube)")
        say_unequal_beams(self.cube.psf)
        how = Synthesis(depths, stokes, weights, lambda2_0, spectral_index, divide_by_i, precision, out, noise)
        return rm_synthesis(self.cube, how, progress)

    def _centre(self) -> Direction:
        found = self.centre or (self.cube.centre if self.cube is not None else None)
        if found is None and isinstance(self.visibilities, Visibilities):
            found = self.visibilities.phase_centre
        if found is None:
            raise InputError("the phase centre is not known: give a cube with one, visibilities, or centre=")
        return found
