"""Lists of point and Gaussian sources: what a `PointSky` holds, their fluxes, spectra and shapes."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from functools import cached_property
from typing import Annotated, Any, ClassVar, Literal, Self

import numpy as np
from pydantic import model_validator

from instrument.checked import checked
from instrument.errors import InputError
from instrument.jones.mueller import brightness
from instrument.numbers import Whole
from instrument.observe.directions import LIGHT, separation, tangents
from instrument.observe.sampling import Sampling
from instrument.sky.base import PlacedSky, power
from instrument.units import ArrayOf, Complex, Direction, Float, Int, unit_vectors

Column = Annotated[Any, ArrayOf(float, (None,))]
Flags = Annotated[Any, ArrayOf(bool, (None,))]
Rows = Annotated[Any, ArrayOf(float, (None, None))]

FWHM_TO_SIGMA = 1.0 / (2.0 * np.sqrt(2.0 * np.log(2.0)))
OPTIONAL = (
    "reference_hz", "spectral_terms", "logarithmic", "rotation_measure", "polarization_follows_i", "major_rad",
    "minor_rad", "angle_rad",
)  # fmt: skip
FLUX_CELLS = 2e6  # entries (T, F, S) worked out at once
MOST_RM = 1e15  # rad/m2; 2 RM lambda^2 has lost all its digits long before
PER_SOURCE = ("ra_rad", "dec_rad", "stokes_jy", *OPTIONAL)


@checked
class Sources(PlacedSky):
    """The sources of a `PointSky`, which says what its fields mean, and what they are at some frequencies."""

    kind: ClassVar[Literal["points", "image", "sum", "other"]] = "points"
    names: tuple[str, ...]
    patches: tuple[str, ...] = ()
    ra_rad: Column
    dec_rad: Column
    stokes_jy: Rows
    reference_hz: Column | None = None
    spectral_terms: Rows | None = None
    logarithmic: Flags | None = None
    rotation_measure: Column | None = None
    polarization_follows_i: Flags | None = None
    major_rad: Column | None = None
    minor_rad: Column | None = None
    angle_rad: Column | None = None
    not_read: tuple[str, ...] = ()

    @model_validator(mode="after")
    def _consistent(self) -> Self:
        count = len(self.names)
        if count == 0:
            raise InputError("the sky is empty: it needs at least one source")
        if self.patches and len(self.patches) != count:
            raise InputError(f"{count} sources but {len(self.patches)} patches")
        for field in PER_SOURCE:
            value = getattr(self, field)
            if value is None:
                continue
            if len(value) != count:
                raise InputError(f"{count} sources but {len(value)} entries of {field}")
            bad = ~np.isfinite(value).reshape(count, -1).all(axis=1)
            if bad.any():
                raise InputError(f"{field} of source '{self.names[int(np.argmax(bad))]}' is not finite")
        if self.stokes_jy.shape[1] != 4:
            raise InputError(f"stokes_jy has shape {self.stokes_jy.shape}, needed (sources, 4)")
        if np.any(np.abs(self.dec_rad) > np.pi / 2 + 1e-12):
            raise InputError("a declination lies beyond the pole: right ascensions and declinations are in rad")
        if self.reference_hz is None and (self.spectral_terms is not None or self.rotation_measure is not None):
            raise InputError("spectral terms and rotation measures need reference_hz")
        if self.rotation_measure is not None and np.any(far := np.abs(self.rotation_measure) > MOST_RM):
            worst = int(np.argmax(far))
            raise InputError(
                f"rotation_measure of source '{self.names[worst]}' is {self.rotation_measure[worst]:.3g} rad/m2: "
                f"beyond {MOST_RM:g} float64 knows no angle"
            )
        if self.reference_hz is not None and np.any(self.reference_hz <= 0):
            raise InputError("reference_hz must be positive")
        for field in ("major_rad", "minor_rad"):
            value = getattr(self, field)
            if value is not None and np.any(value < 0):
                raise InputError(f"{field} of source '{self.names[int(np.argmin(value))]}' is negative")
        if (self.major_rad is None) != (self.minor_rad is None):
            raise InputError("major_rad and minor_rad come together: one of them is missing")
        if self.angle_rad is None and self.major_rad is not None and np.any(self.major_rad != self.minor_rad):
            raise InputError("angle_rad is missing: an ellipse needs the position angle of its first axis")
        return self

    @classmethod
    def join(cls, *skies: Self) -> Self:
        """The sources of several skies, one after the other; what one of them lacks is filled with 'no effect'."""
        known = [s.reference_hz for s in skies if s.reference_hz is not None]
        width = max(0 if s.spectral_terms is None else s.spectral_terms.shape[1] for s in skies)
        # a sky without reference_hz is constant in frequency: any reference does for it
        neutral = {"reference_hz": known[0][0] if known else None, "logarithmic": True}
        fields: dict[str, Any] = {"names": sum((s.names for s in skies), ())}
        if any(s.patches for s in skies):
            fields["patches"] = sum((s.patches or ("",) * len(s) for s in skies), ())
        for field in OPTIONAL:
            given = [getattr(s, field) for s in skies]
            if all(g is None for g in given):
                continue
            if field == "spectral_terms":
                none = [np.zeros((len(s), 0)) if g is None else g for s, g in zip(skies, given, strict=True)]
                fields[field] = np.concatenate([np.pad(g, ((0, 0), (0, width - g.shape[1]))) for g in none])
                continue
            fill = neutral.get(field, 0)
            fields[field] = np.concatenate(
                [np.full(len(s), fill) if g is None else g for s, g in zip(skies, given, strict=True)]
            )
        fields["not_read"] = tuple(dict.fromkeys(text for s in skies for text in s.not_read))
        for field in ("ra_rad", "dec_rad", "stokes_jy"):
            fields[field] = np.concatenate([getattr(s, field) for s in skies])
        return cls(**fields)

    @classmethod
    def at(
        cls, directions: Any, stokes_jy: Any, frequency: Any = None, names: Sequence[str] | None = None, **fields: Any
    ) -> Self:
        """Sources at a SkyCoord (S,) with Stokes parameters (S, 4), or Stokes I alone (S,); plain numbers are Jy."""
        from instrument.units import icrs_of, plain, to_si

        icrs = icrs_of(directions)
        ra, dec = np.atleast_1d(icrs.ra.rad).ravel(), np.atleast_1d(icrs.dec.rad).ravel()
        given_unit = hasattr(stokes_jy, "unit")
        flux = np.asarray(to_si(stokes_jy, "Jy", "stokes_jy") if given_unit else plain(stokes_jy, float, "stokes_jy"))
        if flux.ndim < 2 and not (flux.ndim == 1 and len(ra) == 1 and flux.size == 4):
            flux = np.atleast_1d(flux)[:, None] * np.array([1.0, 0.0, 0.0, 0.0])
        flux = np.atleast_2d(flux)
        if flux.shape not in ((len(ra), 4), (1, 4)):
            raise InputError(
                f"{len(ra)} directions need Stokes I ({len(ra)},) or I, Q, U, V ({len(ra)}, 4), not {flux.shape}"
            )
        flux = np.broadcast_to(flux, (len(ra), 4))
        reference = None if frequency is None else np.full(len(ra), to_si(frequency, "Hz", "frequency"))
        given = tuple(names) if names is not None else tuple(f"s{i}" for i in range(len(ra)))
        return cls(names=given, ra_rad=ra, dec_rad=dec, stokes_jy=flux, reference_hz=reference, **fields)

    def __len__(self) -> int:
        return len(self.names)

    def about(self, centre: Direction) -> Self:
        """Itself."""
        return self

    def parts(self, most: int, freq_hz: Float) -> Iterator[Self]:
        """The sources in pieces of at most so many, in their order."""
        for first in range(0, len(self), most):
            yield self if most >= len(self) else self.select(np.arange(first, min(first + most, len(self))))

    def select(self, rows: Int | Sequence[int]) -> Self:
        """The sources of some rows, in that order."""
        rows = np.asarray(rows, int)
        changed: dict[str, Any] = {"names": tuple(self.names[i] for i in rows)}
        if self.patches:
            changed["patches"] = tuple(self.patches[i] for i in rows)
        for field in PER_SOURCE:
            value = getattr(self, field)
            if value is not None:
                changed[field] = value[rows]
        return self.with_fields(**changed)

    def brightest(self, count: int) -> Self:
        """The `count` sources of largest |I| + P, in their own order."""
        count = Whole().check(count, "brightest")
        if count < 1:
            raise InputError(f"brightest = {count} sources: at least one is needed")
        return self.select(np.sort(np.argsort(-self.power_jy, kind="stable")[:count]))

    @property
    def power_jy(self) -> Float:
        """|I| + P at the reference frequencies, P = sqrt(Q^2 + U^2 + V^2), Jy (S,)."""
        q, u, v = self.stokes_jy[:, 1:].T
        return np.asarray(np.abs(self.stokes_jy[:, 0]) + np.hypot(np.hypot(q, u), v))  # no square overflows

    def directions(self) -> tuple[Float, Float]:
        """ICRS right ascension and declination, rad (S,)."""
        return self.ra_rad, self.dec_rad

    @cached_property
    def vectors(self) -> Float:
        """ICRS unit vectors (S, 3)."""
        return unit_vectors(self.ra_rad, self.dec_rad)

    @property
    def middle(self) -> Direction:
        """Mean direction of the sources, weighted with |I| (evenly where all I are 0)."""
        weight = np.abs(self.stokes_jy[:, 0])
        x, y, z = (weight if weight.any() else weight + 1) @ self.vectors
        return Direction(float(np.arctan2(y, x) % (2 * np.pi)), float(np.arctan2(z, np.hypot(x, y))))

    def distance_rad(self, centre: Direction) -> Float:
        """Angle from a direction, rad (S,)."""
        return separation(self.vectors, centre)

    @cached_property
    def gaussian(self) -> Any:
        """Which sources have a shape, bool (S,)."""
        if self.major_rad is None or self.minor_rad is None:
            return np.zeros(len(self), bool)
        return (self.major_rad > 0) | (self.minor_rad > 0)

    def stokes(self, freq_hz: Float) -> Float:
        """Stokes parameters in Jy at some frequencies, (F, S, 4)."""
        freq_hz = np.atleast_1d(freq_hz)
        out = np.repeat(self.stokes_jy[None], len(freq_hz), axis=0)
        if self.reference_hz is None:
            return out
        ratio = freq_hz[:, None] / self.reference_hz
        if self.spectral_terms is not None:
            factor, added = self._spectrum(ratio)
            out[..., 0] = out[..., 0] * factor + added
            if self.polarization_follows_i is not None:
                with np.errstate(divide="ignore", invalid="ignore"):
                    relative = np.where(self.stokes_jy[:, 0] != 0, out[..., 0] / self.stokes_jy[:, 0], factor)
                out[..., 1:] *= np.where(self.polarization_follows_i, relative, 1.0)[..., None]
        if self.rotation_measure is not None:
            turn = 2 * self.rotation_measure * ((LIGHT / freq_hz[:, None]) ** 2 - (LIGHT / self.reference_hz) ** 2)
            linear = (out[..., 1] + 1j * out[..., 2]) * np.exp(1j * turn)
            out[..., 1], out[..., 2] = linear.real, linear.imag
        return out

    def _spectrum(self, ratio: Float) -> tuple[Float, Float]:
        """Factor and summand of Stokes I, (F, S), of its logarithmic and linear spectral terms."""
        terms = np.asarray(self.spectral_terms)
        log = np.ones(len(self), bool) if self.logarithmic is None else self.logarithmic
        x, y = np.log10(ratio), ratio - 1.0
        exponent, added = np.zeros_like(ratio), np.zeros_like(ratio)
        for k in range(terms.shape[1]):
            exponent += terms[:, k] * x**k
            added += terms[:, k] * y ** (k + 1)
        return np.where(log, ratio**exponent, 1.0), np.where(log, 0.0, added)

    def brightness(self, at: Sampling) -> Complex:
        """Brightness matrices (1, F, S, 2, 2)."""
        return brightness(self.stokes(at.freq_hz))[None]

    def envelope(self, at: Sampling, uvw_lambda: Float) -> Float | None:
        """exp(-2 pi^2 (sigma_a^2 u'^2 + sigma_b^2 v'^2)) of each Gaussian, (T, F, B, S); `None` when all are points.

        u', v' are the baseline along and across the major axis on the tangent plane at the source, so the position
        angle counts from the source's own north.
        """
        if not self.gaussian.any():
            return None
        planes = self.shape_axes(at.centre)
        along = np.einsum("tfbc,skc->ktfbs", uvw_lambda, planes)
        return np.asarray(np.exp(-2 * np.pi**2 * (along[0] ** 2 + along[1] ** 2)))

    def shape_axes(self, centre: Direction) -> Float:
        """Major and minor sigma in rad times their unit vectors, in the u, v, w axes of a centre, (S, 2, 3)."""
        out = np.zeros((len(self), 2, 3))
        if not self.gaussian.any():
            return out
        angle = np.zeros(len(self)) if self.angle_rad is None else self.angle_rad
        east, north = tangents(self.ra_rad, self.dec_rad)
        major = np.cos(angle)[:, None] * north + np.sin(angle)[:, None] * east
        minor = -np.sin(angle)[:, None] * north + np.cos(angle)[:, None] * east
        e0, n0 = tangents(np.array([centre.ra_rad]), np.array([centre.dec_rad]))
        axes = np.stack([e0[0], n0[0], centre.vector])
        out[:, 0] = FWHM_TO_SIGMA * np.asarray(self.major_rad)[:, None] * (major @ axes.T)
        out[:, 1] = FWHM_TO_SIGMA * np.asarray(self.minor_rad)[:, None] * (minor @ axes.T)
        return out

    def total_jy(self, freq_hz: Float) -> Float:
        """Sum of |I| + P of all sources, Jy (F,)."""
        freq_hz = np.atleast_1d(freq_hz)
        step = max(1, int(FLUX_CELLS / len(self)))
        pieces = [freq_hz[f : f + step] for f in range(0, len(freq_hz), step)]
        return np.concatenate([power(self.stokes(piece)).sum(axis=-1) for piece in pieces])

    def nonzero(self, freq_hz: Float) -> tuple[bool, bool, bool, bool]:
        """Which of I, Q, U, V differ from zero in any source and channel."""
        found = np.any(self.stokes(freq_hz) != 0, axis=(0, 1))
        return tuple(bool(x) for x in found)  # type: ignore[return-value]
