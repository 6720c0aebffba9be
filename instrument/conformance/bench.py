"""The bench of `conformance`: small samplings, skies and problems, and how a claim says that it does not hold."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import fields, is_dataclass, replace
from typing import Any

import numpy as np

from instrument import mat2
from instrument.component import Component
from instrument.jones.base import ElementBeam, JonesTerm
from instrument.jones.chain import Chain
from instrument.jones.feed import FeedTerm
from instrument.jones.gain import GainTerm
from instrument.jones.parallactic import Parallactic
from instrument.jones.station import Level, StationBeam
from instrument.observe.directions import EarthFrame, offset
from instrument.observe.grid import ImageGrid
from instrument.observe.layout import Layout, geodetic_axes
from instrument.observe.sampling import Sampling
from instrument.predict.base import Problem
from instrument.sky.base import PlacedSky
from instrument.sky.image import ImageSky
from instrument.sky.points import PointSky
from instrument.sky.sums import SumSky
from instrument.units import Complex, Direction, Float

# Two evaluations of one formula in blocks of different size round differently: 1e-14 for elements, 1e-11 for the
# fringes of stations 40 km apart (1e5 turns). A wrong formula is wrong by far more.
ROUNDING = 1e-10
START = "2012-12-07T00:00:00"
MINUTES = np.array([0.0, 40.0, 100.0])


class Broken(Exception):
    """A claim does not hold."""


def demand(condition: Any, detail: str) -> None:
    """Raise `Broken` unless the condition holds."""
    if not condition:
        raise Broken(detail)


def demand_same(found: Any, expected: Any, what: str) -> str:
    """Demand two arrays equal to rounding, broadcasting; returns how far apart they are."""
    try:
        apart = np.abs(found - expected).max(initial=0.0)
    except ValueError:
        raise Broken(f"{what}: shapes {found.shape} and {expected.shape} do not fit") from None
    scale = np.abs(expected).max(initial=0.0) or 1.0
    demand(apart <= ROUNDING * scale, f"{what}: apart by {apart:.1e} where the largest is {scale:.1e}")
    return f"apart by {apart / scale:.0e}"


def demand_repeatable(call: Callable[[], Any], *inputs: Any) -> str:
    """Demand that a call changes none of its inputs, and that spoiling its result does not spoil the next."""
    before = _bytes(inputs)
    first = np.array(call())
    demand(_bytes(inputs) == before, "a call changes what it was given")
    again = call()
    demand(np.array_equal(first, again, equal_nan=True), "the second call differs from the first")
    if again.flags.writeable:
        again[...] = -7.0
        demand(_bytes(inputs) == before, "the result shares memory with what was given")
        demand(np.array_equal(first, call(), equal_nan=True), "changing the result changes what the next call gives")
    return ""


def _bytes(thing: Any) -> list[bytes]:
    """Every array and component in nested tuples and dataclasses, as bytes."""
    if isinstance(thing, np.ndarray):
        return [thing.tobytes()]
    if isinstance(thing, Component):
        return [thing.to_json().encode()]
    if isinstance(thing, tuple):
        return [b for part in thing for b in _bytes(part)]
    return [b for f in fields(thing) for b in _bytes(getattr(thing, f.name))] if is_dataclass(thing) else []


def fresh(thing: Any) -> Any:
    """A copy of a sampling or problem whose arrays are its own, so that one claim cannot spoil the next."""
    if isinstance(thing, np.ndarray):
        return thing.copy()
    if is_dataclass(thing) and not isinstance(thing, type):
        return replace(thing, **{f.name: fresh(getattr(thing, f.name)) for f in fields(thing)})
    return thing


def cuts(found: Any, at: Sampling, axes: Sequence[int]) -> Iterator[tuple[bool, str, Sampling, Any]]:
    """Every single time (axis 0), channel (1) and direction (3): is the axis constant, its name, where, what is due."""
    names = {0: "time", 1: "channel", 3: "direction"}
    for axis in axes:
        constant = found.shape[axis] == 1
        for k in range(at.shape[axis]):
            one, every = slice(k, k + 1), slice(None)
            where = at.towards(at.ra_rad[one], at.dec_rad[one]) if axis == 3 else None
            where = where or at.block(*((one, every) if axis == 0 else (every, one)))
            yield constant, f"{names[axis]} {k}", where, found if constant else found.take([k], axis)


# Where -----------------------------------------------------------------------------------------------------------


def lofar_like(own_axes: bool = False) -> Layout:
    """Seven stations over 45 km, antenna planes a little off the horizontal; the first three share their axes."""
    positions = np.array(
        [
            [3826923.9, 460915.1, 5064643.2],
            [3826979.4, 460897.6, 5064603.2],
            [3826600.6, 460953.4, 5064881.1],
            [3826471.3, 461000.1, 5064974.2],
            [3829205.6, 469142.5, 5062181.0],
            [3818424.9, 452020.3, 5071817.6],
            [3797136.5, 463114.4, 5086651.3],
        ]
    )
    axes = geodetic_axes(positions) @ _turn(0.02, 0)
    axes = _turn(np.deg2rad(41.3), 2) @ axes
    if not own_axes:
        axes[:3] = axes[0]
    return Layout(names=tuple(f"S{k}" for k in range(len(axes))), positions_m=positions, axes=axes)


def _turn(angle: float, axis: int) -> Float:
    """Rotation matrix about a coordinate axis."""
    out = np.eye(3)
    i, j = (k for k in range(3) if k != axis)
    out[i, i] = out[j, j] = np.cos(angle)
    out[i, j], out[j, i] = -np.sin(angle), np.sin(angle)
    return out


def bench(parts: Sequence[JonesTerm] = (), layout: Layout | None = None) -> Sampling:
    """3 times, 3 channels within the band of the element beams among `parts`, 5 directions, one of them not risen.

    The phase centre stands 25 deg from the zenith of the first station at the first time.
    """
    from astropy import units as u
    from astropy.time import Time

    layout = layout or lofar_like()
    bands = [p.band_hz() for p in parts if isinstance(p, ElementBeam)]
    low = max((band[0] for band in bands), default=0.0)
    high = min((band[1] for band in bands), default=np.inf)
    high = high if np.isfinite(high) else max(2 * low, 250e6)
    freq_hz = low + (high - low) * np.array([0.45, 0.5, 0.7])
    p, q, r = layout.axes[0]
    start = Direction(0.0, 0.0)
    at = Sampling.build(layout, Time(START, scale="utc") + MINUTES * u.min, freq_hz, np.zeros(1), np.zeros(1), start)
    ra, dec = icrs(at.earth, np.stack([np.cos(0.44) * r + np.sin(0.44) * p, 0.6 * q - 0.8 * r]))
    centre = Direction(float(ra[0]), float(dec[0]))
    near = offset(centre, np.array([0.0, 0.03, -0.2, 0.35]), np.array([0.0, -0.02, 0.1, 0.2]))
    return replace(at, ra_rad=np.append(near[0], ra[1]), dec_rad=np.append(near[1], dec[1]), centre=centre)


def hard_places(at: Sampling) -> Sampling:
    """The first time of a sampling, towards zenith, horizon and nadir of two stations and both celestial poles.

    The last station stands at the pole with the axes of the Earth, so that its zenith and horizon are exact in
    floating point.
    """
    axes, positions = np.array(at.layout.axes), np.array(at.layout.positions_m)
    axes[-1], positions[-1] = np.eye(3), [0.0, 0.0, 6356752.0]
    layout = at.layout.with_fields(axes=axes, positions_m=positions)
    places = [[r, p, q, -p, -r, p - 1e-3 * r, r + 1e-9 * p] for p, q, r in (axes[0], axes[-1])]
    seen = np.array(places).reshape(-1, 3)
    seen /= np.linalg.norm(seen, axis=1, keepdims=True)
    ra, dec = icrs(at.earth, seen)
    ra, dec = np.append(ra, [0.0, 1.0]), np.append(dec, [np.pi / 2, -np.pi / 2])
    hard = replace(at.block(slice(0, 1), slice(None)).towards(ra, dec), layout=layout)
    exact = np.array(hard.itrf)
    exact[0, :-2] = seen
    return replace(hard, seen=exact)


def icrs(earth: EarthFrame, itrf: Float) -> tuple[Float, Float]:
    """Right ascension and declination (S,) seen at ITRF unit vectors (S, 3) at the first time: `itrf` inverted."""
    v = earth.velocity[0]
    d = itrf @ earth.matrices[0]
    # |k d - v| = 1 for the vector before aberration
    along = d @ v
    x, y, z = ((along + np.sqrt(1 - v @ v + along**2))[:, None] * d - v).T
    return np.arctan2(y, x) % (2 * np.pi), np.arctan2(z, np.hypot(x, y))


# What ------------------------------------------------------------------------------------------------------------


class _Dipole(ElementBeam):
    """Two short crossed dipoles in free space above the antenna plane; complex: half a turn from zenith to horizon."""

    def jones(self, at: Sampling) -> Complex:
        """The field along p and q, (T, 1, A, S, 2, 2)."""
        cos, sin = at.azimuth_cos_sin
        tilt = np.maximum(at.local[..., 2], 0.0)
        up = ((at.zenith_angle < np.pi / 2) * np.exp(1j * np.pi * tilt))[..., None, None]
        return (up * mat2.pack(tilt * cos, -sin, tilt * sin, cos))[:, None]


class _NotAList(PlacedSky):
    """A sky that does not say that it is a list of sources."""

    inner: PointSky

    def directions(self) -> tuple[Float, Float]:
        """Of the sources."""
        return self.inner.directions()

    def brightness(self, at: Sampling) -> Complex:
        """Of the sources."""
        return self.inner.brightness(at)

    def envelope(self, at: Sampling, uvw_lambda: Float) -> Float | None:
        """Of the sources."""
        return self.inner.envelope(at, uvw_lambda)

    def total_jy(self, freq_hz: Float) -> Float:
        """Of the sources."""
        return self.inner.total_jy(freq_hz)


def random_sky(centre: Direction, polarized: bool, gaussian: bool, seed: int = 0, count: int = 9) -> PointSky:
    """Sources within 12 deg; polarized ones have spectra and rotation measures, and the first has P > I = 0."""
    rng = np.random.default_rng(seed)
    ra, dec = offset(centre, *rng.uniform(-0.15, 0.15, (2, count)))
    stokes = rng.uniform(-1, 1, (count, 4)) * ([1, 0.3, 0.3, 0.1] if polarized else [1, 0, 0, 0])
    more: dict[str, Any] = {}
    if polarized:
        stokes[0, 0] = 0.0
        more = {"reference_hz": np.full(count, 140e6), "rotation_measure": rng.uniform(-5, 5, count)}
        more["spectral_terms"] = rng.uniform(-1, 0, (count, 2))
    if gaussian:
        size = rng.uniform(0, 3e-4, (2, count)) * (np.arange(count) % 2)
        more |= {"major_rad": size[0], "minor_rad": size[1], "angle_rad": rng.uniform(0, np.pi, count)}
    names = tuple(f"s{k}" for k in range(count))
    return PointSky(names=names, ra_rad=ra, dec_rad=dec, stokes_jy=stokes, **more)


def problems() -> dict[str, Problem]:
    """What engines are held to: chains and skies of every structure, a few stations, 3 times, 3 channels."""
    at = bench()
    own = bench(layout=lofar_like(own_axes=True))
    rng = np.random.default_rng(1)
    offsets = rng.uniform(-15, 15, (len(at.layout), 6, 3))
    offsets[:3] = offsets[0]
    receivers = (GainTerm(rms=0.1, seed=1), FeedTerm(rms=0.1, seed=2))
    station = StationBeam(element=_Dipole(), levels=(Level(offsets_m=offsets),))
    plain, points = (random_sky(at.centre, polarized=p, gaussian=False) for p in (False, True))
    shaped = random_sky(at.centre, polarized=True, gaussian=True)
    return {
        "unpolarized points, no Jones term": _problem(at, Chain(), plain),
        "unpolarized points, gains": _problem(at, Chain(receivers[0]), plain),
        "polarized points, gains and feeds": _problem(at, Chain(*receivers), points),
        "one source": _problem(at, Chain(*receivers, station, Parallactic()), points.select([1])),
        "polarized points, phased stations": _problem(at, Chain(*receivers, station, Parallactic()), points),
        "polarized points, every station its own axes": _problem(own, Chain(station, Parallactic()), points),
        "points and Gaussians, phased stations": _problem(at, Chain(*receivers, station, Parallactic()), shaped),
        "a sky that is not a list": _problem(at, Chain(_Dipole(), Parallactic()), _NotAList(inner=points)),
        "an image, no Jones term": _problem(at, Chain(), random_image(at)),
        "a sum of points and an image": _problem(
            at, Chain(*receivers, station, Parallactic()), SumSky(skies={"stars": shaped, "image": random_image(at)})
        ),
        "an image, phased stations": _problem(at, Chain(*receivers, station, Parallactic()), random_image(at)),
    }


def longer(problem: Problem, times: int, channels: int) -> Problem:
    """A problem with so many times, every minute, and channels, within its own; itself where it has as many."""
    from astropy import units as u
    from astropy.time import Time

    at, sky = problem.at, problem.sky
    if times <= at.shape[0] and channels <= at.shape[1]:
        return problem
    freq_hz = np.linspace(at.freq_hz.min(), at.freq_hz.max(), max(channels, at.shape[1]))
    when = Time(START, scale="utc") + np.arange(max(times, at.shape[0])) * u.min
    if isinstance(sky, ImageSky):
        planes = np.resize(sky.stokes, (len(freq_hz), *sky.stokes.shape[1:]))
        sky = sky.with_fields(stokes=planes, frequencies=freq_hz * u.Hz)
    more = Sampling.build(at.layout, when, freq_hz, at.ra_rad, at.dec_rad, at.centre)
    return replace(problem, at=more, sky=sky)


def random_image(at: Sampling) -> ImageSky:
    """6 x 4 pixels of 1 deg in the channels of a sampling, in all Stokes parameters, some of them zero; P > I."""
    stokes = np.random.default_rng(3).uniform(-1, 1, (len(at.freq_hz), 4, 6, 4))
    stokes[..., 1, 2] = 0.0
    grid = ImageGrid.of((6, 4), np.deg2rad(1.0), at.centre)
    return ImageSky(grid=grid, stokes=stokes, frequencies=[f"{f!r} Hz" for f in at.freq_hz.tolist()])


def _problem(at: Sampling, chain: Chain, sky: PlacedSky) -> Problem:
    a, b = at.layout.baselines
    return Problem(at.towards(*sky.outline()), chain, sky, a, b, interval_s=10.0, width_hz=1e5)
