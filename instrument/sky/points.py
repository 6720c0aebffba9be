"""PointSky: point and Gaussian sources with four Stokes parameters, spectra and rotation measures."""

from __future__ import annotations

import os
from typing import Any, Self

import numpy as np

from instrument.checked import checked
from instrument.sky.base import Sky
from instrument.sky.sources import Sources
from instrument.units import Float


@checked
class PointSky(Sources):
    """S sources: Stokes I, Q, U, V (S, 4) in Jy at `reference_hz`, with spectra, rotation measures and Gaussian shapes.

    Stokes I: with logarithmic terms `I0 (f/f0)^(c0 + c1 x + c2 x^2 ...)`, x = log10(f/f0); with linear ones
    `I0 + c0 y + c1 y^2 ...`, y = f/f0 - 1. Stokes Q and U turn with `rotation_measure` (rad/m^2), taken as valid at
    the reference frequency: Q + iU = (Q0 + iU0) exp(2i RM (lambda^2 - lambda0^2)); where `polarization_follows_i`, Q, U
    and V also carry the spectrum of I (as fractional polarization does). Without either, Q, U and V are constant.
    Shapes: elliptical Gaussians, full width at half maximum `major_rad` along `angle_rad` (north through east at the
    source) and `minor_rad` across it, either of them the longer; both zero is a point. `patches` names the group of a
    source ("" for none).
    """

    @classmethod
    def read(
        cls,
        path: str | os.PathLike[str],
        centre: Any = None,
        sizes: Any = None,
        beam: Any = None,
        frequency: Any = None,
        incomplete: Any = "refuse",
    ) -> Self:
        """Sources of a file: BBS/makesourcedb text, or a CSV, ECSV, FITS or VOTable table with named columns.

        `centre` is the phase centre of the model, from which BBS files count orientations; the others say what a table
        leaves open; see `forms.read_as`.
        """
        from instrument.sky.forms import read_as

        return read_as(cls, path, centre, sizes, beam, frequency, incomplete)

    def write(self, path: str | os.PathLike[str], overwrite: bool = False, preset: str | None = None) -> None:
        """Write it by the ending of the name: .skymodel, .bbs, .txt (BBS), .csv, .ecsv, .skyh5, .osm (OSKAR).

        `preset` ("LoTSS", "GLEAM", "PyBDSF", ...) writes the columns and units of that catalogue into a .csv, .ecsv or
        .fits. `read` gives it back; see `writers.write_sky` for the rounding, and for what each form refuses to hold.
        """
        from instrument.sky.writers import write_sky

        write_sky(path, self, overwrite, preset)

    def doubts(self, freq_hz: Float) -> dict[str, str]:
        """What its spectra make of it at some frequencies, and what was not read of its file; for the plan.

        Raises `InputError` where a flux is not finite.
        """
        from instrument.sky.doubts import doubts

        return doubts(self, np.atleast_1d(freq_hz))


def points_of(sky: Sky) -> PointSky | None:
    """A sky as the list of sources that it is; `None` when it is none."""
    return sky if isinstance(sky, PointSky) else None
