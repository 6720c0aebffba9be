"""Generated skies: a regular grid, random polarised sources, and a mock of the 3C196 field at 150 MHz."""

from __future__ import annotations

from abc import abstractmethod
from importlib.resources import files
from typing import Any, Self

import numpy as np
from pydantic import PrivateAttr, model_validator

from instrument.errors import InputError, warn
from instrument.memory import afford
from instrument.numbers import Count, Finite, NotNegative, Seed, Share
from instrument.observe.directions import offset, tangents
from instrument.sky.base import Sky
from instrument.sky.points import PointSky
from instrument.units import Direction, Float, Hertz, Jansky, Radians


class GeneratedSky(Sky):
    """A sky made about a phase centre: `about(centre)` gives its sources; before that it has none to show."""

    _placed: dict[Direction, PointSky] = PrivateAttr(default_factory=dict)

    @abstractmethod
    def place(self, centre: Direction) -> PointSky:
        """The sources about a phase centre."""

    def about(self, centre: Direction) -> PointSky:
        """The sources about a phase centre; the latest centre is remembered."""
        if centre not in self._placed:
            placed = self.place(centre)
            self._placed.clear()
            self._placed[centre] = placed
        return self._placed[centre]


class GridSky(GeneratedSky):
    """Equal sources at l, m = k `spacing` about the phase centre, `shape` = (along l, east; along m, north).

    l and m are direction cosines, with the spacing in rad; k runs over integers for an odd number and over half
    integers for an even one. Sources are called "g+3-2" by their k, and l runs fastest. `centre_flux` is that of the
    source at the phase centre, which only odd shapes have. `polarization` gives Q/I, U/I, V/I. The flux is at
    `frequency`, with one spectral index for all. Raises `InputError` where the grid leaves the sky.
    """

    shape: tuple[Count, Count] = (15, 15)
    spacing: Radians = float(np.deg2rad(0.66))
    flux: Jansky = 0.4
    centre_flux: Jansky | None = None
    spectral_index: Finite = 0.0
    polarization: tuple[Finite, Finite, Finite] = (0.0, 0.0, 0.0)
    frequency: Hertz = 150e6

    @model_validator(mode="after")
    def _possible(self) -> Self:
        if self.spacing <= 0 or self.frequency <= 0:
            raise InputError("spacing and frequency must be positive")
        if not np.sqrt(np.sum(np.square(self.polarization))) <= 1:
            raise InputError(f"polarization = {self.polarization} are fractions of I: together at most 1")
        if min(self.flux, self.centre_flux or 0.0) < 0:
            given = {"flux": self.flux, "centre_flux": self.centre_flux}
            named = [f"{name} = {value:g} Jy" for name, value in given.items() if (value or 0) < 0]
            warn(f"{', '.join(named)}: a negative flux is taken as it stands")
        if self.centre_flux is not None and not (self.shape[0] % 2 and self.shape[1] % 2):
            raise InputError(f"centre_flux needs odd numbers: a grid of {self.shape} has no source at its centre")
        return self

    def place(self, centre: Direction) -> PointSky:
        """The grid about a phase centre."""
        _priced(self.shape[0] * self.shape[1], "shape")
        steps = [np.arange(n) - (n - 1) / 2 for n in self.shape]
        k, j = (a.ravel() for a in np.meshgrid(*steps))
        ra, dec = offset(centre, k * self.spacing, j * self.spacing)
        stokes = self.flux * np.tile([1.0, *self.polarization], (len(k), 1))
        if self.centre_flux is not None:
            stokes[(k == 0) & (j == 0)] = np.multiply(self.centre_flux, [1.0, *self.polarization])
        names = tuple(f"g{a:+g}{b:+g}" for a, b in zip(k, j, strict=True))
        return _power_laws(names, ra, dec, stokes, self.frequency, np.full(len(k), self.spectral_index))


class RandomSky(GeneratedSky):
    """Random polarised point sources, uniform over the cap of `radius` about the phase centre.

    Stokes I is drawn from dN/dS ~ S^-`slope` between `flux_min` and `flux_max`; every source is linearly polarised to
    the fraction `polarization` at a random angle, and its V/I is uniform within +-`circular`. Spectral indices are
    Gaussian: mean `spectral_index`, width `scatter`. The same `seed` gives the same sources: numpy's default generator
    draws for all of them distance, position angle and flux, the angle of Q + iU = P exp(2 pi i x), V, and the index.
    """

    count: Count = 100
    radius: Radians = float(np.deg2rad(5))
    flux_min: Jansky = 0.027
    flux_max: Jansky = 83.0
    slope: Finite = 1.9
    polarization: Share = 0.0
    circular: Share = 0.0
    spectral_index: Finite = -0.75
    scatter: NotNegative = 0.0
    frequency: Hertz = 150e6
    seed: Seed = 0

    @model_validator(mode="after")
    def _possible(self) -> Self:
        if not 0 < self.radius <= np.pi:
            raise InputError(f"radius = {np.rad2deg(self.radius):g} deg lies outside 0..180 deg")
        if not 0 < self.flux_min <= self.flux_max:
            raise InputError(
                f"fluxes must rise from above 0: flux_min = {self.flux_min}, flux_max = {self.flux_max} Jy"
            )
        if self.polarization**2 + self.circular**2 > 1:
            raise InputError("polarization and circular together make sources more than 100 % polarised")
        if self.frequency <= 0:
            raise InputError("frequency must be positive")
        return self

    def place(self, centre: Direction) -> PointSky:
        """The sources about a phase centre."""
        _priced(self.count, "count")
        rng = np.random.default_rng(self.seed)
        ra, dec = _cap(centre, self.radius, rng.random(self.count), rng.random(self.count))
        flux = _power_law(rng.random(self.count), self.flux_min, self.flux_max, self.slope)
        linear = self.polarization * np.exp(2j * np.pi * rng.random(self.count))
        circular = self.circular * rng.uniform(-1, 1, self.count)
        index = self.spectral_index + self.scatter * rng.standard_normal(self.count)
        stokes = flux[:, None] * np.stack([np.ones(self.count), linear.real, linear.imag, circular], axis=1)
        names = tuple(f"r{k}" for k in range(self.count))
        return _power_laws(names, ra, dec, stokes, self.frequency, index)


class FaradaySky(GeneratedSky):
    """Linearly polarised points without total intensity, uniform over a cap, each at a Faraday depth of its own.

    What an interferometer sees of polarised Galactic emission: its Stokes I is resolved out, so what is seen in I has
    leaked. P = `flux` at a random angle and a depth (rad/m²) uniform between the two `depths`; P goes as
    (f / `frequency`)^`spectral_index`. The same `seed` gives the same points.
    """

    count: Count = 200
    radius: Radians = float(np.deg2rad(2))
    flux: Jansky = 1.0
    depths: tuple[Finite, Finite] = (-1.5, 5.0)
    spectral_index: Finite = 0.0
    frequency: Hertz = 150e6
    seed: Seed = 0

    @model_validator(mode="after")
    def _possible(self) -> Self:
        if not (0 < self.radius <= np.pi and self.frequency > 0):
            raise InputError(
                f"radius = {np.rad2deg(self.radius):g} deg, frequency = {self.frequency:g} Hz: 0 to 180 deg, above 0 Hz"
            )
        if not (np.isfinite(self.depths).all() and self.depths[0] <= self.depths[1]):
            raise InputError(f"depths = {self.depths}: give the least and the most, in rad/m2")
        if self.flux < 0:
            warn(f"flux = {self.flux:g} Jy: a negative flux is taken as it stands")
        return self

    def place(self, centre: Direction) -> PointSky:
        """The points about a phase centre."""
        _priced(self.count, "count")
        rng = np.random.default_rng(self.seed)
        ra, dec = _cap(centre, self.radius, rng.random(self.count), rng.random(self.count))
        linear = self.flux * np.exp(2j * np.pi * rng.random(self.count))
        stokes = np.stack([0 * linear.real, linear.real, linear.imag, 0 * linear.real], axis=1)
        names, index = tuple(f"p{k}" for k in range(self.count)), np.full(self.count, self.spectral_index)
        found = _power_laws(names, ra, dec, stokes, self.frequency, index)
        return found.with_fields(rotation_measure=rng.uniform(*self.depths, self.count))


class MockField(GeneratedSky):
    """A mock of the 3C196 field at 150 MHz: 4567 sources within 5 deg, 796.64 Jy, the figures of Asad et al. (2015).

    3C196 (83.1326 Jy), one source of 7.7 Jy, and 4565 from a broken power law down to 0.027 Jy, by stratified uniforms;
    its faint slope is solved for the total. The brightest stand at VLSSr positions in the order of their fluxes at
    74 MHz, the others at random within 5 deg. Sources are called by their rank. `components` puts the four Gaussians
    of 3C196, as the patch "3C196", in place of rank 1; `scatter` is the width of the spectral indices; `pairs` is the
    share of random sources that stand 5 to 40 arcsec beside an earlier one (0.3 is like the sky). Positions are those
    of the field itself, whatever the phase centre. Not a measurement, and twice denser than the sky.
    """

    seed: Seed = 196
    components: bool = False
    spectral_index: Finite = -0.75
    scatter: NotNegative = 0.0
    pairs: Share = 0.0

    def place(self, centre: Direction) -> PointSky:
        """The sources."""
        rng = np.random.default_rng(self.seed)
        flux = np.concatenate([[MODEL_JY, SECOND_JY], mock_fluxes(rng)[1]])
        ra, dec = _vlssr_positions()
        ra[0], dec[0] = FIELD
        left = len(flux) - len(ra)
        far, around = rng.random(left), rng.random(left)
        ra, dec = (np.concatenate(x) for x in zip((ra, dec), _cap(FIELD, RADIUS, far, around), strict=True))
        if self.pairs:
            self._pair(rng, ra, dec, left)
        index = self.spectral_index + self.scatter * rng.standard_normal(len(flux))
        stokes = flux[:, None] * np.array([1.0, 0.0, 0.0, 0.0])
        names = tuple(str(rank) for rank in range(1, len(flux) + 1))
        sky = _power_laws(names, ra, dec, stokes, 150e6, index)
        if not self.components:
            return sky
        return PointSky.join(PointSky.read("3c196_pandey.skymodel", FIELD), sky.select(np.arange(1, len(sky))))

    def _pair(self, rng: Any, ra: Float, dec: Float, left: int) -> None:
        """Moves some of the last `left` sources beside an earlier one, in place."""
        for k in len(ra) - left + np.flatnonzero(rng.random(left) < self.pairs):
            earlier = rng.integers(k)
            angle = np.deg2rad(rng.uniform(5, 40, 1) / 3600)
            moved = _at(Direction(ra[earlier], dec[earlier]), angle, 2 * np.pi * rng.random(1))
            ra[k], dec[k] = moved[0][0], moved[1][0]


FIELD = Direction(float(np.deg2rad(123.4)), float(np.deg2rad(48.2175)))
RADIUS = float(np.deg2rad(5))
MODEL_JY, SECOND_JY, TOTAL_JY, FAINTEST_JY = 83.1326, 7.7, 796.64, 0.027
BREAK_JY, BRIGHT_SLOPE, DRAWN = 1.5, 2.5, 4565


def _priced(count: int, key: str) -> None:
    afford(1e3 * count, f"a sky of {count} sources", f"lower its {key}")


def mock_fluxes(rng: Any) -> tuple[float, Float]:
    """Faint slope g1 and fluxes in Jy (4565,), falling, of the mock field: all but its two brightest sources.

    dN/dS ~ (S/Sb)^-g1 from 0.027 Jy to Sb = 1.5 Jy, (S/Sb)^-2.5 on to 7.7 Jy; one source in each of 4565 equal shares
    of the number, so that the sum hardly depends on the seed; g1 by bisection for a total of 796.64 Jy with the two.
    """
    share = (np.arange(1, DRAWN + 1) - rng.random(DRAWN)) / DRAWN
    share[-1] = 1.0
    wanted = TOTAL_JY - MODEL_JY - SECOND_JY
    low, high = 1.2, 2.9
    while (slope := 0.5 * (low + high)) not in (low, high):
        low, high = (slope, high) if _broken_power_law(share, slope).sum() > wanted else (low, slope)
    flux = _broken_power_law(share, slope)
    flux[-1] = FAINTEST_JY
    return slope, flux


def _broken_power_law(share: Float, slope: float) -> Float:
    """Flux above which a share (0..1) of the sources lies, Jy."""
    a, b = 1 - slope, 1 - BRIGHT_SLOPE
    faint = BREAK_JY / a * (1 - (FAINTEST_JY / BREAK_JY) ** a)
    bright = BREAK_JY / b * ((SECOND_JY / BREAK_JY) ** b - 1)
    number = share * (faint + bright)
    out = np.empty_like(share)
    top = number < bright
    out[top] = BREAK_JY * ((SECOND_JY / BREAK_JY) ** b - number[top] * b / BREAK_JY) ** (1 / b)
    out[~top] = BREAK_JY * (1 - (number[~top] - bright) * a / BREAK_JY) ** (1 / a)
    return out


def _power_law(share: Float, low: float, high: float, slope: float) -> Float:
    """Values between low and high of dN/dS ~ S^-slope at shares (0..1) of the number above."""
    a = 1 - slope
    if abs(a) < 1e-9:  # the limit of the power law below
        return np.asarray(high * (low / high) ** share)
    with np.errstate(all="ignore"):
        least, most = np.float64(low) ** a, np.float64(high) ** a
        found = np.asarray((most + share * (least - most)) ** (1 / a))
    if not (np.isfinite(found).all() and np.all(found > 0)):
        raise InputError(f"slope = {slope:g} between {low:g} and {high:g} Jy cannot be drawn: take a flatter one")
    return found


def _vlssr_positions() -> tuple[Float, Float]:
    """Right ascension and declination (336,) of the VLSSr sources of the field, brightest first: 3C196, then others."""
    with (files("instrument.data") / "vlssr_74mhz.csv").open(encoding="utf-8") as text:
        ra, dec = np.deg2rad(np.loadtxt(text, delimiter=",", skiprows=4, usecols=(0, 1))).T
    return ra, dec


def _cap(centre: Direction, radius: float, far: Float, around: Float) -> tuple[Float, Float]:
    """Right ascension and declination (S,), uniform over a cap for uniform `far` and `around`."""
    # 1 - cos = 2 sin^2 keeps the digits of small caps
    angle = 2 * np.arcsin(np.sqrt(far) * np.sin(radius / 2))
    return _at(centre, angle, 2 * np.pi * around)


def _at(centre: Direction, angle: Float, position_angle: Float) -> tuple[Float, Float]:
    """Right ascension and declination (S,) at angles from a centre, at position angles north through east."""
    (east,), (north,) = tangents(np.array([centre.ra_rad]), np.array([centre.dec_rad]))
    across = np.cos(position_angle)[:, None] * north + np.sin(position_angle)[:, None] * east
    x, y, z = (np.cos(angle)[:, None] * centre.vector + np.sin(angle)[:, None] * across).T
    return np.arctan2(y, x) % (2 * np.pi), np.arctan2(z, np.hypot(x, y))


def _power_laws(
    names: tuple[str, ...], ra: Float, dec: Float, stokes_jy: Float, freq_hz: float, index: Float
) -> PointSky:
    """Point sources with spectral indices; their polarised fractions are the same at every frequency."""
    polarised = bool(np.any(stokes_jy[:, 1:]))
    return PointSky(
        names=names,
        ra_rad=ra,
        dec_rad=dec,
        stokes_jy=stokes_jy,
        reference_hz=np.full(len(names), freq_hz),
        spectral_terms=index[:, None] if np.any(index) else None,
        polarization_follows_i=np.ones(len(names), bool) if polarised else None,
    )
