"""Catalogue: a sky of the sources of a file, or of the brightest of them, or with a model in place of one."""

from __future__ import annotations

from pathlib import Path
from typing import Self

import numpy as np
from pydantic import model_validator

from instrument.errors import InputError
from instrument.numbers import Count
from instrument.sky.forms import check_choices
from instrument.sky.mocks import GeneratedSky
from instrument.sky.points import PointSky
from instrument.sky.table_sky import Incomplete, Sizes
from instrument.units import Direction, Hertz, Radians


class Catalogue(GeneratedSky):
    """The sources of a file, placed about a phase centre.

    `brightest` keeps that many of largest |I| + P at their reference frequencies. `model` names a file whose components
    (one source) replace what the catalogue has within `match` of their mean direction, as one patch, called as in that
    file or else as the file; the model counts as one source. `sizes`, `beam`, `frequency` and `incomplete` say what a
    table leaves open, as in
    `PointSky.read`. Raises `FileError`, and `InputError` when nothing is there
    to be replaced.
    """

    path: str
    brightest: Count | None = None
    model: str | None = None
    match: Radians = float(np.deg2rad(30 / 3600))  # 30 arcsec, well below the beam of the surveys of the field
    sizes: Sizes | None = None
    beam: Radians | None = None
    frequency: Hertz | None = None
    incomplete: Incomplete = "refuse"

    @model_validator(mode="after")
    def _possible(self) -> Self:
        check_choices(self.beam, self.frequency)
        return self

    def place(self, centre: Direction) -> PointSky:
        """The sources; the centre matters to orientations in BBS files that count from it."""
        from astropy import units as u

        beam = None if self.beam is None else self.beam * u.rad
        frequency = None if self.frequency is None else self.frequency * u.Hz
        sky = PointSky.read(self.path, centre, self.sizes, beam, frequency, self.incomplete)
        if self.model is None:
            return sky if self.brightest is None else sky.brightest(self.brightest)
        model = PointSky.read(self.model, centre)
        name = model.patches[0] if len(set(model.patches)) == 1 and model.patches[0] else Path(self.model).stem
        return _with_model(sky, model, name, self.match, self.brightest)


def _with_model(sky: PointSky, model: PointSky, name: str, match_rad: float, brightest: int | None) -> PointSky:
    """A sky in which a model, as the patch `name`, stands for the sources within `match_rad` of its mean direction."""
    apart, width = sky.distance_rad(model.middle), model.distance_rad(model.middle).max()
    arcsec = np.rad2deg(1) * 3600
    if width > match_rad:
        raise InputError(
            f"model '{name}' is not one source: it reaches {width * arcsec:.3g} arcsec from its middle, more than "
            f"match = {match_rad * arcsec:.3g} arcsec"
        )
    replaced = apart <= match_rad
    if not replaced.any():
        raise InputError(
            f"no source within {match_rad * arcsec:.3g} arcsec of model '{name}' to be replaced; the nearest is "
            f"{apart.min() * arcsec:.3g} arcsec away"
        )
    first, rest = int(np.argmax(replaced)), np.flatnonzero(~replaced)
    power = np.append(sky.power_jy[rest], model.power_jy.sum())
    kept = np.sort(np.argsort(-power, kind="stable")[:brightest])
    if kept[-1] < len(rest):  # the model, which stands last, is not among the brightest
        return sky.select(rest[kept])
    rest = rest[kept[:-1]]
    model = model.with_fields(patches=(name,) * len(model))
    parts = [sky.select(rest[rest < first])] if (rest < first).any() else []
    parts.append(model)
    parts += [sky.select(rest[rest > first])] if (rest > first).any() else []
    return PointSky.join(*parts)
