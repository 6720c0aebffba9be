"""Visibilities in extended precision (64-bit mantissa), entry by entry: an independent truth for plans and engines.

Written from the formulas of docs/conventions.md, entry by entry. Taken from the package are the inputs alone: positions
and axes of stations, directions, fluxes, coefficients, drawn gains, and of each time the rotation and the velocity of
the Earth. All that follows is `longdouble`, so its own error is 2000 times below that of float64.
"""

from __future__ import annotations

import sys
from typing import Any, NamedTuple

import numpy as np

from instrument.jones.base import ElementBeam
from instrument.jones.station import StationBeam
from instrument.predict.base import Problem

LIGHT = np.longdouble(299792458)
PI = np.longdouble("3.14159265358979323846264338327950288")
I = np.clongdouble(1j)
assert np.finfo(np.longdouble).eps < 1.1e-19, "this platform has no extended precision"


def real(x: Any) -> Any:
    """An array in extended precision."""
    return np.asarray(x, np.longdouble)


def cis(cycles: Any) -> Any:
    """exp(2 pi i cycles)."""
    angle = 2 * PI * (cycles - np.rint(cycles))
    return np.cos(angle) + I * np.sin(angle)


def matrix(a: Any, b: Any, c: Any, d: Any) -> Any:
    """[[a, b], [c, d]] of broadcastable arrays, (..., 2, 2)."""
    a, b, c, d = np.broadcast_arrays(*(np.asarray(x, np.clongdouble) for x in (a, b, c, d)))
    return np.stack([np.stack([a, b], -1), np.stack([c, d], -1)], -2)


def product(a: Any, b: Any) -> Any:
    """Matrix product (..., 2, 2)."""
    return (a[..., :, :, None] * b[..., None, :, :]).sum(-2)  # matmul has no extended precision


def herm(a: Any) -> Any:
    """Conjugate transpose."""
    return np.conj(np.swapaxes(a, -1, -2))


def dot(a: Any, b: Any) -> Any:
    """Scalar product over the last axis."""
    return (a * b).sum(-1)


def unit(x: Any) -> Any:
    """Vectors (..., 3) of length 1."""
    return x / np.sqrt(dot(x, x))[..., None]


def vectors(ra: Any, dec: Any) -> Any:
    """ICRS unit vectors (S, 3) of right ascensions and declinations."""
    ra, dec = real(ra), real(dec)
    return np.stack([np.cos(dec) * np.cos(ra), np.cos(dec) * np.sin(ra), np.sin(dec)], -1)


def east_north(ra: Any, dec: Any) -> Any:
    """Unit vectors (S, 3) to the east and to the north."""
    ra, dec = real(ra), real(dec)
    east = np.stack([-np.sin(ra), np.cos(ra), 0 * ra], -1)
    return east, np.stack([-np.sin(dec) * np.cos(ra), -np.sin(dec) * np.sin(ra), np.cos(dec)], -1)


class Geometry(NamedTuple):
    """Where everything is seen: ITRF directions (T, S, 3) and of the centre (T, 3), and what hangs on them."""

    seen: object
    centre: object
    east: object
    north: object
    lmn: object
    uvw_axes: object
    local: object  # (T, A, S, 3) in the axes of the stations
    azimuth: object  # cosine and sine (T, A, S)
    zenith: object  # zenith angle (T, A, S)


def rotated(at: Any, x: Any) -> Any:
    """ICRS vectors (..., 3) in ITRF, (T, ..., 3)."""
    m = real(at.earth.matrices)
    return dot(m.reshape(len(m), *([1] * (x.ndim - 1)), 3, 3), x[None, ..., None, :])


def apparent(at: Any, x: Any) -> Any:
    """Apparent ITRF unit vectors (T, S, 3) of ICRS vectors (S, 3)."""
    v, m = real(at.earth.velocity), real(at.earth.matrices)
    return unit(dot(m[:, None], (x[None] + v[:, None])[:, :, None]))


def geometry(at: Any) -> Any:
    """Where the directions of a sampling are seen."""
    source = vectors(at.ra_rad, at.dec_rad)
    middle = vectors(at.centre.ra_rad, at.centre.dec_rad)
    seen, centre = apparent(at, source), apparent(at, middle[None])[:, 0]
    east = rotated(at, east_north(at.ra_rad, at.dec_rad)[0])
    east = unit(east - dot(east, seen)[..., None] * seen)
    e0, n0 = east_north(at.centre.ra_rad, at.centre.dec_rad)
    l, m, n = (dot(source, x) for x in (e0, n0, middle))
    less = np.where(n > 0, -(l**2 + m**2) / (1 + np.abs(n)), n - 1)
    turned = rotated(at, np.stack([e0, n0, middle]))
    old = unit(turned[:, 2])
    k = np.cross(old, centre)[:, None]
    axes = turned + np.cross(k, turned) + np.cross(k, np.cross(k, turned)) / (1 + dot(old, centre))[:, None, None]
    if at.seen_east is not None:  # in the frames of another program
        seen, east, centre = real(at.seen), real(at.seen_east), real(at.seen_centre)
    local = dot(real(at.layout.axes)[None, :, None], seen[:, None, :, None])
    p, q, r = np.moveaxis(local, -1, 0)
    rho = np.sqrt(p * p + q * q)
    safe = np.where(rho > 0, rho, 1)
    azimuth = np.where(rho > 0, p / safe, 1), np.where(rho > 0, q / safe, 0)
    lmn = np.stack([l, m, less], -1)
    return Geometry(seen, centre, east, np.cross(seen, east), lmn, axes, local, azimuth, np.arctan2(rho, r))


def jinc(x: Any) -> Any:
    """2 J1(x) / x: by its power series to |x| = 2, beyond by the integral of J1, whose trapezoidal sum converges."""
    out = np.empty(x.shape, np.longdouble)
    for index, value in np.ndenumerate(x):
        if abs(value) < 2:
            term, out[index] = real(1), 1
            for k in range(1, 20):
                term = -term * (value / 2) ** 2 / (k * (k + 1))
                out[index] += term
        else:
            count = int(2 * abs(value)) + 80
            t = 2 * PI * np.arange(count) / count
            out[index] = 2 * np.cos(t - value * np.sin(t)).mean() / value
    return out


# Terms ---------------------------------------------------------------------------------------------------------------


def gain(term: Any, at: Any, g: Any) -> Any:
    """Gains (T, F, A, 1, 2, 2)."""
    t = term.table(at).astype(np.clongdouble)[:, :, :, None]
    return matrix(t[..., 0], 0, 0, t[..., 1])


def feed(term: Any, at: Any, g: Any) -> Any:
    """Feeds (T, F, A, 1, 2, 2)."""
    t = term.table(at).astype(np.clongdouble)[:, :, :, None]
    return matrix(1, t[..., 0], -t[..., 1], 1)


def parallactic(term: Any, at: Any, g: Any) -> Any:
    """Rotation of a direction's north and east into the axes of a station, (T, 1, A, S, 2, 2)."""
    axes = real(at.layout.axes)
    cos, sin = (x[..., None] for x in g.azimuth)
    phi = cos * axes[None, :, 1, None] - sin * axes[None, :, 0, None]
    theta = np.cross(phi, np.broadcast_to(g.seen[:, None], phi.shape))
    north, east = g.north[:, None], g.east[:, None]
    return matrix(dot(theta, north), dot(theta, east), dot(phi, north), dot(phi, east))[:, None]


def crossed_dipole(term: Any, at: Any, g: Any) -> Any:
    """Two crossed dipoles above a ground plane, (T, F, A, S, 2, 2)."""
    cos, sin = g.azimuth
    c, s = np.cos(real(term.x_azimuth)), np.sin(real(term.x_azimuth))
    cos_a, sin_a = cos * c + sin * s, sin * c - cos * s
    up = np.where(g.zenith < PI / 2, np.cos(g.zenith), 0)
    height = 2 * PI * real(term.height) * real(at.freq_hz) / LIGHT
    plane = np.sin(height[None, :, None, None] * up[:, None])
    return plane[..., None, None] * matrix(up * cos_a, -sin_a, up * sin_a, cos_a)[:, None]


def dish(pattern: Any, g: Any) -> Any:
    """A pattern (F, S) of a dish above the horizon, (T, F, A, S, 2, 2)."""
    whole = pattern[None, :, None] * (g.zenith < PI / 2)[:, None]
    return matrix(whole, 0, 0, whole)


def from_centre(at: Any) -> Any:
    """Angle of directions (S,) from the phase centre."""
    s, c = vectors(at.ra_rad, at.dec_rad), vectors(at.centre.ra_rad, at.centre.dec_rad)
    across = np.cross(s, c)
    return np.arctan2(np.sqrt(dot(across, across)), dot(s, c))


def airy(term: Any, at: Any, g: Any) -> Any:
    """An evenly lit dish."""
    reach = np.minimum(from_centre(at), PI / 2)
    x = PI * real(term.diameter) * real(at.freq_hz)[:, None] / LIGHT * np.sin(reach)
    return dish(jinc(x), g)


def gaussian_dish(term: Any, at: Any, g: Any) -> Any:
    """A Gaussian beam."""
    f = real(at.freq_hz)
    width = real(term.fwhm) * (real(term.frequency) / f if term.frequency else 1 + 0 * f)
    return dish(np.exp(-2 * np.log(real(2)) * (from_centre(at) / width[:, None]) ** 2), g)


def hamaker(term: Any, at: Any, g: Any) -> Any:
    """The element of Hamaker's polynomials, (T, F, A, S, 2, 2)."""
    table, middle, half = sys.modules[type(term).__module__].coefficients(term.band)
    table, x = table.astype(np.clongdouble), (real(at.freq_hz) - real(middle)) / real(half)
    c, s = np.cos(PI * 5 / 4), np.sin(PI * 5 / 4)
    cos, sin = g.azimuth
    phi = np.arctan2(sin * c - cos * s, cos * c + sin * s)[:, None]
    theta, out = g.zenith[:, None], 0
    for k in range(2):
        patterns = []
        for d in range(2):
            powers = [sum(table[k, i, j, d] * x**j for j in range(5))[None, :, None, None] for i in range(5)]
            patterns.append(sum(value * theta**i for i, value in enumerate(powers)))
        a = (-1) ** k * (2 * k + 1) * phi
        cos_a, sin_a = np.cos(a), np.sin(a)
        out = out + matrix(cos_a * patterns[0], -sin_a * patterns[1], sin_a * patterns[0], cos_a * patterns[1])
    return out * (g.zenith < PI / 2)[:, None, ..., None, None]


def array_factor(term: Any, at: Any, g: Any) -> Any:
    """Mean phasor of the parts of a station at each level, (T, F, A, S, 2, 2)."""
    sign = -1 if term.phase == "fringe" else 1
    f, out = real(at.freq_hz)[None, :, None, None], np.clongdouble(1)
    for level in term.levels:
        steer = g.centre
        if level.pointing is not None:
            steer = apparent(at, vectors(level.pointing.ra_rad, level.pointing.dec_rad)[None])[:, 0]
        f0 = real(term.reference_frequency) if term.reference_frequency else f
        waves = (f * g.seen[:, None] - f0 * steer[:, None, None]) / LIGHT  # (T, F, S, 3)
        cycles = sum(real(level.offsets_m)[None, None, :, :, None, k] * waves[:, :, None, None, :, k] for k in range(3))
        out = out * cis(sign * cycles).mean(3)
    return matrix(out, 0, 0, out)


def station_beam(term: Any, at: Any, g: Any) -> Any:
    """Array factor times element."""
    element = of_term(term.element, at, g)
    return product(array_factor(term.array, at, g), element.conj() if term.phase == "fringe" else element)


TERMS = {
    "GainTerm": gain,
    "FeedTerm": feed,
    "Parallactic": parallactic,
    "CrossedDipole": crossed_dipole,
    "Airy": airy,
    "Gaussian": gaussian_dish,
    "Hamaker": hamaker,
    "ArrayFactor": array_factor,
    "StationBeam": station_beam,
}


def has_truth(term: Any) -> bool:
    """Whether its formula is known in extended precision: those of this package are, others say so themselves."""
    ours = type(term).__module__.startswith("instrument") and type(term).__name__ in TERMS
    return (ours or hasattr(term, "truth")) and (not isinstance(term, StationBeam) or has_truth(term.element))


def of_term(term: Any, at: Any, g: Any) -> Any:
    """Jones matrices of a term: its own `truth(at, geometry)` where it has one."""
    return term.truth(at, g) if hasattr(term, "truth") else TERMS[type(term).__name__](term, at, g)


def chain_jones(terms: Any, at: Any, g: Any) -> Any:
    """Product of terms of a chain, receiver to sky, broadcastable to (T, F, A, S, 2, 2)."""
    jones = matrix(1, 0, 0, 1)
    for term in terms:
        found = of_term(term, at, g)
        # an element is given for exp(+i omega t), the fringe is of exp(-i omega t)
        jones = product(jones, found.conj() if isinstance(term, ElementBeam) else found)
    return jones


# Sky and sums --------------------------------------------------------------------------------------------------------


def stokes(sky: Any, freq_hz: Any) -> Any:
    """Stokes parameters (F, S, 4)."""
    f = real(freq_hz)[:, None]
    out = np.repeat(real(sky.stokes_jy)[None], len(freq_hz), 0)
    if sky.reference_hz is None:
        return out
    f0 = real(sky.reference_hz)
    if sky.spectral_terms is not None:
        terms, flux = real(sky.spectral_terms), real(sky.stokes_jy)[:, 0]
        log = np.ones(len(sky), bool) if sky.logarithmic is None else sky.logarithmic
        x, y = np.log10(f / f0), f / f0 - 1
        index = sum(terms[:, k] * x**k for k in range(terms.shape[1]))
        added = sum(terms[:, k] * y ** (k + 1) for k in range(terms.shape[1]))
        seen = np.where(log, flux * (f / f0) ** index, flux + added)
        if sky.polarization_follows_i is not None:
            safe = np.where(flux != 0, flux, 1)
            relative = np.where(flux != 0, seen / safe, np.where(log, (f / f0) ** index, 1))
            out[..., 1:] *= np.where(sky.polarization_follows_i, relative, 1)[..., None]
        out[..., 0] = seen
    if sky.rotation_measure is not None:
        turn = 2 * real(sky.rotation_measure) * ((LIGHT / f) ** 2 - (LIGHT / f0) ** 2)
        q, u = out[..., 1].copy(), out[..., 2].copy()
        out[..., 1], out[..., 2] = q * np.cos(turn) - u * np.sin(turn), q * np.sin(turn) + u * np.cos(turn)
    return out


def envelope(sky: Any, at: Any, waves: Any) -> Any:
    """What Gaussian shapes take off baselines (T, F, B, 3) in wavelengths, (T, F, B, S)."""
    angle = real(np.zeros(len(sky))) if sky.angle_rad is None else real(sky.angle_rad)
    cos, sin = np.cos(angle)[:, None], np.sin(angle)[:, None]
    east, north = east_north(sky.ra_rad, sky.dec_rad)
    e0, n0 = east_north(at.centre.ra_rad, at.centre.dec_rad)
    axes = np.stack([e0, n0, vectors(at.centre.ra_rad, at.centre.dec_rad)])
    sigma, exponent = 1 / (2 * np.sqrt(2 * np.log(real(2)))), 0
    for direction, size in ((cos * north + sin * east, sky.major_rad), (cos * east - sin * north, sky.minor_rad)):
        along = sigma * real(size)[:, None] * dot(direction[:, None], axes[None])
        exponent = exponent + dot(waves[..., None, :], along) ** 2
    return np.exp(-2 * PI**2 * exponent)


def visibilities(problem: Problem) -> Any:
    """Visibilities in Jy, clongdouble (T, F, B, 2, 2), of a problem whose sky is a list."""
    at = problem.at
    sky: Any = problem.sky
    g = geometry(at)
    jones = np.broadcast_to(chain_jones(problem.chain.terms, at, g), (*at.shape, 2, 2))
    i, q, u, v = np.moveaxis(stokes(sky, at.freq_hz), -1, 0)
    bright = matrix(i + q, u + I * v, u - I * v, i - q)[None]
    a, b = problem.antenna1, problem.antenna2
    apart = real(at.layout.positions_m)[a] - real(at.layout.positions_m)[b]
    waves = dot(g.uvw_axes[:, None], apart[None, :, None])[:, None] * (real(at.freq_hz) / LIGHT)[:, None, None]
    fringe = cis(-dot(waves[..., None, :], g.lmn))
    if sky.gaussian.any():
        fringe = fringe * envelope(sky, at, waves)
    out = np.empty((*problem.shape, 2, 2), np.clongdouble)
    for n, (x, y) in enumerate(zip(a, b, strict=True)):
        each = product(product(jones[:, :, x], bright), herm(jones[:, :, y]))
        out[:, :, n] = (each * fringe[:, :, n, :, None, None]).sum(2)
    return out
