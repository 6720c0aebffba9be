"""Psf: the point spread function of a cube, and the fit of an elliptical Gaussian, the restoring beam, to its lobe."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from instrument.checked import checked
from instrument.errors import InputError, warn
from instrument.shown import short_repr
from instrument.units import Count, Float, to_si


@checked
@dataclass(frozen=True, eq=False)
class Psf:
    """Point spread function (F, Ny, Nx), peak 1 at the centre pixel, and the Gaussian fitted to its main lobe.

    `major_rad`, `minor_rad` are full widths at half maximum, `angle_rad` is the position angle of the major axis, north
    through east, (F,) each; `residual` is the largest difference between lobe and Gaussian above half maximum. `data`
    is None where only the widths are known, as in a FITS file.
    """

    __repr__ = short_repr
    data: Float | None
    major_rad: Float
    minor_rad: Float
    angle_rad: Float
    residual: Float

    @classmethod
    def gaussian(cls, major: Any, minor: Any = None, angle: Any = None) -> Psf:
        """A Gaussian beam known by its widths alone: full widths at half maximum and position angle, one or (F,) each.

        Quantities, NaN where a channel has none; `minor` is `major` unless given, `angle` (of the major axis, north
        through east) is 0.
        """
        widths = (
            to_si(m, "rad", n, nan=True) for m, n in ((major, "major"), (major if minor is None else minor, "minor"))
        )
        turned = 0.0 if angle is None else to_si(angle, "rad", "angle", nan=True)
        a, b, pa = np.broadcast_arrays(*(np.atleast_1d(np.asarray(x, float)) for x in (*widths, turned)))
        return cls(None, a, b, pa, np.zeros(len(a)))

    def of(self, channels: Count) -> Psf:
        """The same for so many channels: one beam becomes that of all; raises `InputError` for any other number."""
        given = {len(x) for x in (self.major_rad, self.minor_rad, self.angle_rad, self.residual)}
        given |= set() if self.data is None else {len(self.data)}
        if given == {channels}:
            return self
        if given != {1}:
            raise InputError(f"the PSF has {' and '.join(map(str, sorted(given)))} channels, the cube {channels}")
        data = None if self.data is None else np.broadcast_to(self.data, (channels, *self.data.shape[1:]))
        four = (self.major_rad, self.minor_rad, self.angle_rad, self.residual)
        return Psf(data, *(np.repeat(x, channels) for x in four))

    @property
    def solid_angle_sr(self) -> Float:
        """Solid angle of the fitted Gaussian, sr (F,)."""
        return np.pi / (4 * np.log(2)) * self.major_rad * self.minor_rad


def fit_psf(data: Float, pixel_rad: float) -> Psf:
    """Restoring beam of every channel of a PSF (F, N, N), by least squares on the main lobe above 0.3.

    Warns where the lobe is narrower than 2.5 pixels, reaches the edge of the image or is no ellipse; its widths are
    then NaN (edge, no ellipse) or not to be trusted. A channel without data is NaN without a warning.
    """
    fits = np.array([_fit(plane) if np.isfinite(plane).all() else (np.nan,) * 5 for plane in data])
    major, minor, angle, residual, edge = fits.T
    broken = (edge > 0) | (np.isfinite(edge) & ~(np.isfinite(major) & np.isfinite(minor)))
    for trouble, what in (
        (minor < 2.5, f"is {np.nanmin(minor, initial=2.5):.2g} pixels wide: take smaller pixels or a smaller uv_range"),
        (broken, "has no main lobe within the image: no beam is fitted; take a larger image or more baselines"),
    ):
        if np.any(trouble):
            warn(f"the PSF {what}")
    major, minor, angle = (np.where(broken, np.nan, x) for x in (major, minor, angle))
    return Psf(data, major * pixel_rad, minor * pixel_rad, angle, residual)


def _fit(plane: Float) -> tuple[float, float, float, float, float]:
    """Full widths in pixels, position angle in rad (north through east), largest residual, 1 where the lobe is cut."""
    from scipy.ndimage import label
    from scipy.optimize import least_squares

    ny, nx = plane.shape
    lobes, _ = label(plane > 0.3)
    y, x = np.nonzero(lobes == lobes[ny // 2, nx // 2])
    values = plane[y, x]
    cut = float(min(x.min(), y.min()) == 0 or x.max() == nx - 1 or y.max() == ny - 1)
    # x runs to the west: east is -x
    east, north = -(x - nx // 2).astype(float), (y - ny // 2).astype(float)

    def model(p: Float) -> Float:
        a, b, c = p
        return np.exp(-(a * north**2 + 2 * b * north * east + c * east**2))

    width = max(1.0, np.sqrt(np.count_nonzero(values > 0.5) / np.pi))
    start = np.log(2) / width**2
    found = least_squares(lambda p: model(p) - values, [start, 0.0, start], x_scale=start).x
    shape = np.array([[found[0], found[1]], [found[1], found[2]]])
    powers, axes = np.linalg.eigh(shape)
    with np.errstate(invalid="ignore", divide="ignore"):
        major, minor = 2 * np.sqrt(np.log(2) / powers)
    angle = np.arctan2(axes[1, 0], axes[0, 0]) % np.pi
    inside = values > 0.5
    return float(major), float(minor), float(angle), float(np.abs(model(found) - values)[inside].max()), cut
