"""Directions: ICRS vectors seen from the rotating Earth, with aberration, without any download.

`d_itrf = M (s + v) / |s + v|` with M the GCRS-to-ITRS matrix (IAU 2000A/2006, UT1 and polar motion from the bundled
IERS table) and v the velocity of the site over c. Against the full astropy chain what is left is the
bending of light by the Sun, 0.0041 arcsec cot(elongation/2), and (v/c)^2, 0.002 arcsec; see docs/conventions.md.
One direction serves all stations of an array.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from instrument.errors import InputError, warn
from instrument.observe.clock import later, terrestrial
from instrument.observe.orientation import orientation
from instrument.units import Direction, Float, Int

LIGHT = 299792458.0
EARTH_RATE = 7.292115855306589e-5  # rad/s, IAU
AU_PER_DAY = 149597870700.0 / 86400.0  # m/s


@dataclass(frozen=True)
class EarthFrame:
    """The Earth at some times: matrices ICRS to ITRF (T, 3, 3) and velocity of the site over c, ICRS (T, 3)."""

    matrices: Float
    velocity: Float

    def __getitem__(self, times: slice | Int) -> EarthFrame:
        return EarthFrame(self.matrices[times], self.velocity[times])

    def __len__(self) -> int:
        return len(self.matrices)

    def itrf(self, vectors: Float) -> Float:
        """Apparent ITRF unit vectors (T, S, 3) of ICRS unit vectors (S, 3), aberration included."""
        moved = vectors[None] + self.velocity[:, None]
        seen = moved @ np.swapaxes(self.matrices, 1, 2)
        seen /= np.sqrt(np.einsum("tsc,tsc->ts", seen, seen))[..., None]
        return seen

    def sines(self, vectors: Float, normals: Float) -> Float:
        """Products (S, T, G) of apparent directions, of ICRS unit vectors (S, 3), with ITRF unit vectors (G, 3)."""
        turned = normals @ self.matrices  # (T, G, 3): one product with all directions, and none of them in ITRF
        found = (vectors @ turned.reshape(-1, 3).T).reshape(len(vectors), *turned.shape[:2])
        found += np.einsum("tgc,tc->tg", turned, self.velocity)
        lengths = 1.0 + 2.0 * (vectors @ self.velocity.T) + np.einsum("tc,tc->t", self.velocity, self.velocity)
        found /= np.sqrt(lengths)[..., None]
        return found

    def carried(self, tangents: Float, seen: Float) -> Float:
        """ICRS tangent vectors (S, 3) at some directions carried to where those are `seen` (T, S, 3), unit length.

        Aberration is a conformal map, so it carries polarization with it; to first order in v/c that is the
        projection onto the plane across the line of sight.
        """
        moved = tangents[None] @ np.swapaxes(self.matrices, 1, 2)
        moved -= np.einsum("tsc,tsc->ts", moved, seen)[..., None] * seen
        moved /= np.sqrt(np.einsum("tsc,tsc->ts", moved, moved))[..., None]
        return moved

    def uvw_axes(self, centre: Direction) -> Float:
        """ITRF unit vectors of u (east), v (north), w (to the centre), (T, 3, 3), rows u, v, w.

        The rotation M with the aberration of the centre folded in, so that w is the geometric delay of the phase
        centre to first order in v/c exactly, and u, v are orthonormal to it (as casacore has them). What this leaves
        out is the differential aberration of the field, 3 arcsec at 10 deg from the centre: a change of scale of 1e-4
        that every imager leaves out as well.
        """
        east, north = tangents(np.array([centre.ra_rad]), np.array([centre.dec_rad]))
        rows = np.concatenate([east, north, centre.vector[None]])
        turned = rows[None] @ np.swapaxes(self.matrices, 1, 2)
        old = turned[:, 2]
        new = self.itrf(centre.vector[None])[:, 0]
        k = np.cross(old, new)[:, None]
        scale = 1.0 / (1.0 + np.einsum("tc,tc->t", old, new))[:, None, None]
        return turned + np.cross(k, turned) + scale * np.cross(k, np.cross(k, turned))


def earth_frame(times: Any, site_m: Float) -> EarthFrame:
    """The Earth at `times` (astropy `Time`, (T,)) for a site at ITRF `site_m` (3,).

    Warns when a time lies outside the bundled IERS table; UT1 - UTC is then taken as 0 (at most 0.9 s, 13.5 arcsec).
    """
    import erfa

    times = times.utc
    jd1, jd2 = np.atleast_1d(times.jd1), np.atleast_1d(times.jd2)
    ut1_utc, xp, yp, outside = orientation(jd1, jd2)
    if outside.any():
        warn(
            f"{outside.sum()} of {outside.size} times lie outside the Earth orientation table: UT1-UTC is taken as 0 "
            "there, an error of up to 0.9 s (13.5 arcsec)"
        )
    ut1_utc, xp, yp = (np.where(outside, 0.0, found) for found in (ut1_utc, xp, yp))
    ut1 = erfa.utcut1(jd1, jd2, ut1_utc)
    tt = terrestrial(times)
    matrices = erfa.c2t06a(*tt, *ut1, xp, yp)
    _, barycentric = erfa.epv00(*tt)
    spin = np.cross([0.0, 0.0, EARTH_RATE], site_m)
    velocity = barycentric["v"] * AU_PER_DAY + spin @ matrices
    return EarthFrame(np.ascontiguousarray(matrices), np.ascontiguousarray(velocity / LIGHT))


def tangents(ra_rad: Float, dec_rad: Float) -> tuple[Float, Float]:
    """Unit vectors east and north (S, 3) at ICRS coordinates (S,); defined at the poles too, by the right ascension."""
    sin_ra, cos_ra, sin_dec, cos_dec = np.sin(ra_rad), np.cos(ra_rad), np.sin(dec_rad), np.cos(dec_rad)
    east = np.stack([-sin_ra, cos_ra, np.zeros_like(ra_rad)], axis=-1)
    north = np.stack([-sin_dec * cos_ra, -sin_dec * sin_ra, cos_dec], axis=-1)
    return east, north


def lmn(vectors: Float, centre: Direction) -> Float:
    """Direction cosines l, m and n - 1 about the phase centre, (S, 3), of ICRS unit vectors (S, 3)."""
    east, north = tangents(np.array([centre.ra_rad]), np.array([centre.dec_rad]))
    l, m = vectors @ east[0], vectors @ north[0]
    n = vectors @ centre.vector
    # -(l2+m2)/(1+n): the plain n-1 keeps 3 digits at l2+m2 = 1e-13; behind the antipode only the plain form is finite
    with np.errstate(divide="ignore", invalid="ignore"):
        exact = -(l**2 + m**2) / (1.0 + n)
    return np.stack([l, m, np.where(n > -0.5, exact, n - 1.0)], axis=-1)


def offset(centre: Direction, l: Float, m: Float) -> tuple[Float, Float]:
    """Right ascension and declination (S,) of direction cosines l, m about a centre; inverse of `lmn`."""
    r2 = l**2 + m**2
    if np.any(r2 > 1):
        raise InputError(f"direction cosines with l2 + m2 = {r2.max():.3g} > 1 are not on the sky")
    east, north = tangents(np.array([centre.ra_rad]), np.array([centre.dec_rad]))
    vectors = l[:, None] * east + m[:, None] * north + np.sqrt(1 - r2)[:, None] * centre.vector
    return np.arctan2(vectors[:, 1], vectors[:, 0]) % (2 * np.pi), np.arctan2(
        vectors[:, 2], np.hypot(*vectors[:, :2].T)
    )


def separation(vectors: Float, centre: Direction) -> Float:
    """Angle in rad (S,) between unit vectors (S, 3) and a direction, accurate at small and large angles."""
    c = centre.vector
    return np.arctan2(np.linalg.norm(np.cross(vectors, c), axis=-1), vectors @ c)


def transit_time(centre: Direction, site_m: Float, date: str) -> Any:
    """Time of upper culmination at a site within the UTC day `date` ("2012-12-07"), to 1 ms."""
    from astropy import units as u
    from astropy.time import Time

    try:
        day = Time(date, scale="utc", format="iso", out_subfmt="date")
        if len(date) != 10:
            raise ValueError
    except ValueError:
        raise InputError(f"transit = '{date}' is not a day; write it like '2012-12-07'") from None
    longitude = np.arctan2(site_m[1], site_m[0])
    sidereal = 86164.0905
    time = later(day, 12 * u.hour)

    def hour_angle(t: Any) -> float:
        d = earth_frame(t, site_m).itrf(centre.vector[None])[0, 0]
        return float((longitude - np.arctan2(d[1], d[0]) + np.pi) % (2 * np.pi) - np.pi)

    for _ in range(5):
        time = later(time, -hour_angle(time) / (2 * np.pi) * sidereal * u.s)
    while _days(time, day) < 0:
        time = later(time, sidereal * u.s)
    while _days(time, day) >= 1:
        time = later(time, -sidereal * u.s)
    return later(time, -hour_angle(time) / (2 * np.pi) * sidereal * u.s)


def _days(time: Any, day: Any) -> float:
    """Days of UTC from one time to another."""
    return float((time.jd1 - day.jd1) + (time.jd2 - day.jd2))
