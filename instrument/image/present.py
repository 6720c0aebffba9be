"""What of a cube is there: Stokes parameters, beams, the middle channel that has data."""

from __future__ import annotations

import numpy as np

from instrument.image.cube import StokesCube


def stokes_of(cube: StokesCube) -> list[str]:
    """Stokes parameters that a cube has: with data, and not zero everywhere."""
    return [name for k, name in enumerate("IQUV") if any(np.nan_to_num(plane[k]).any() for plane in cube.data)]


def has_beam(cube: StokesCube) -> bool:
    """Whether every channel with data has a beam."""
    if cube.psf is None:
        return False
    known = np.isfinite(cube.psf.solid_angle_sr)
    return all(has or not np.isfinite(planes).any() for has, planes in zip(known, cube.data, strict=True))


def in_kelvin(cube: StokesCube) -> StokesCube:
    """The cube in K where the beam is known, or none is needed; as it is elsewhere."""
    return cube.to_kelvin() if cube.unit == "Jy/pixel" or has_beam(cube) else cube


def middle_channel(cube: StokesCube, stokes: str) -> int:
    """The middle one of the channels that have data."""
    plane = cube.data[:, "IQUV".index(stokes)]
    there = [k for k in np.argsort(cube.freq_hz, kind="stable") if np.isfinite(plane[k]).any()]
    return int(there[len(there) // 2])
