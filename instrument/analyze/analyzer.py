"""Analyzer: the door to the analyses of a cube and of the visibilities it came from."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

from instrument.analyze.leakage import Leakage, leakage_of
from instrument.analyze.photometry import ForcedPhotometry, SourceFluxes
from instrument.analyze.spectra import Spectrum2D, Stokes, Taper, spectrum_2d
from instrument.errors import InputError
from instrument.image.cube import StokesCube
from instrument.sky.base import Sky
from instrument.units import Direction
from instrument.visibilities import Visibilities


class Analyzer:
    """What can be learnt from a cube, from visibilities with a known sky, or from both.

    `Analyzer(cube, visibilities=vis, sky=sky).leakage()`. Each analysis says what it needs when it is missing.
    """

    def __init__(
        self,
        cube: StokesCube | None = None,
        visibilities: Visibilities | Iterable[Visibilities] | None = None,
        sky: Sky | None = None,
        fluxes: SourceFluxes | None = None,
        centre: Direction | None = None,
    ) -> None:
        self.cube = cube
        self.visibilities = visibilities
        self.sky = sky
        self.fluxes = fluxes
        self.centre = centre

    def leakage(self, photometry: ForcedPhotometry | None = None, channel: int = 0) -> Leakage:
        """Leakage of every source by forced photometry in the visibilities, in one channel.

        Needs the visibilities (or blocks of them) and the sky they were made from, or fluxes measured before.
        """
        centre, fluxes = self._centre(), self.fluxes
        if fluxes is None:
            if self.visibilities is None or self.sky is None:
                raise InputError("leakage needs visibilities and the sky: Analyzer(cube, visibilities=vis, sky=sky)")
            sky = self.sky.about(centre).sources()
            if sky is None:
                raise InputError(
                    f"leakage of sources needs a sky that is a list of them, got {type(self.sky).__name__}"
                )
            fluxes = (photometry or ForcedPhotometry()).measure(self.visibilities, sky)
        return leakage_of(fluxes, centre, channel)

    def spectrum_2d(
        self,
        stokes: Stokes = "I",
        channel: int = 0,
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

    def _centre(self) -> Direction:
        found = self.centre or (self.cube.centre if self.cube is not None else None)
        if found is None and isinstance(self.visibilities, Visibilities):
            found = self.visibilities.phase_centre
        if found is None:
            raise InputError("the phase centre is not known: give a cube with one, visibilities, or centre=")
        return found
