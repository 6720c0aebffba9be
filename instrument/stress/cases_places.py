"""Cases of where things are: directions, layouts, grids, times, intervals; held to astropy or closed forms."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from instrument.errors import InputError
from instrument.jones.parallactic import Parallactic
from instrument.observe.closure import stations_of
from instrument.observe.directions import lmn, offset, separation, transit_time
from instrument.observe.grid import ImageGrid
from instrument.observe.intervals import intervals
from instrument.observe.layout import Layout
from instrument.observe.observation import Observation
from instrument.observe.sampling import Sampling, mjd_seconds, times_of
from instrument.stress.bench import GROUND, small_array
from instrument.stress.case import Answer, both, case, claim, held
from instrument.units import Direction, Float, unit_vectors

CENTRE = Direction(2.15, 0.84)
ARCSEC = np.pi / 180 / 3600


def _refused(made: Callable[[], Any], words: str) -> Answer:
    """That something impossible is refused in a line that has these words."""
    try:
        made()
    except InputError as said:
        return claim(words in str(said), f"refused without '{words}': {said}")
    return claim(False, f"taken, where '{words}' is due")


def _sampling(ra: Any, dec: Any, layout: Layout | None = None) -> Sampling:
    from astropy.time import Time

    times = Time(["2012-12-07T01:00:00", "2018-06-01T17:30:00"], scale="utc")
    return Sampling.build(layout or small_array(), times, 150e6, ra, dec, CENTRE)


@case(
    "G1",
    "geometry",
    "directions over the whole sky",
    "those of astropy's AltAz, to 0.03 arcsec; parallactic angles to 2e-5",
)
def apparent(_: None) -> Answer:
    """Azimuth, elevation and parallactic angle in 2012 and 2018; what is left is the bending of light by the Sun."""
    from astropy import units as u
    from astropy.coordinates import AltAz, EarthLocation, SkyCoord
    from astropy.utils import iers

    rng = np.random.default_rng(2)
    ra, dec = rng.uniform(0, 2 * np.pi, 12), np.arcsin(rng.uniform(-0.95, 0.95, 12))
    at = _sampling(ra, dec, small_array(1, spread=0.0))
    site = EarthLocation.from_geocentric(*at.layout.centre_m, unit="m")
    local = np.swapaxes(at.local, 1, 2)[:, :, 0]
    apart, turned = 0.0, 0.0
    with iers.conf.set_temp("auto_download", False), iers.conf.set_temp("auto_max_age", None):
        for t, when in enumerate(times_of(at.slots_s)):
            frame = AltAz(obstime=when, location=site, pressure=0 * u.Pa)
            seen = SkyCoord(ra * u.rad, dec * u.rad).transform_to(frame)
            az, alt = seen.az.rad, seen.alt.rad
            due = np.stack([np.cos(alt) * np.sin(az), np.cos(alt) * np.cos(az), np.sin(alt)], axis=1)
            apart = max(apart, float(np.abs(local[t] - due).max()))
            astro = np.cos(at.azimuth[t, 0] - seen.az.rad)
            apart = max(apart, float((1 - astro[np.abs(seen.alt.deg) < 80]).max()))
            # north on the sky by a step of 10 arcsec, the zenith by the frame
            north = SkyCoord(ra * u.rad, (dec + 10 * ARCSEC) * u.rad).transform_to(frame)
            angle = seen.position_angle(north).rad  # of the pole from the zenith, towards growing azimuth: to the right
            off = at.parallactic_angle[t, 0] - angle
            turned = max(turned, float(np.abs(np.angle(np.exp(1j * off)))[np.abs(seen.alt.deg) < 80].max()))
    return both(Answer(apart, 0.03 * ARCSEC), Answer(turned, 2e-5))


@case("G2", "geometry", "l, m, n - 1 and back, angles of 1e-9 and of pi - 1e-9", "exact to rounding: 1e-15")
def cosines(_: None) -> Answer:
    """About the equator l = cos d sin a, m = sin d; the way back; separations along the equator."""
    ra, dec = np.array([1e-9, 0.3, -1.2, 2.0, 3.1]), np.array([2e-9, -0.4, 0.9, 0.3, 0.01])
    found = lmn(unit_vectors(ra, dec), Direction(0.0, 0.0))
    l, m, n = np.cos(dec) * np.sin(ra), np.sin(dec), np.cos(dec) * np.cos(ra)
    due = np.stack([l, m, np.where(n > -0.5, -(l**2 + m**2) / (1 + n), n - 1)], axis=1)
    back = np.array(offset(CENTRE, l[:3], m[:3]))
    there = lmn(unit_vectors(*back), CENTRE)[:, :2]
    angles = separation(unit_vectors(np.array([1e-9, 0.5, np.pi - 1e-9]), np.zeros(3)), Direction(0.0, 0.0))
    near = held(found[0] / due[0], np.ones(3), 1e-14)
    return both(
        held(found, due, 2e-16 * 4),
        near,
        held(there, np.stack([l, m], axis=1)[:3], 1e-15, scale=1.0),
        held(angles, np.array([1e-9, 0.5, np.pi - 1e-9]), 1e-15),
        held(angles[0], 1e-9, 1e-14),
    )


@case(
    "G3", "geometry", "pixels of even and odd images", "the world coordinates that astropy has for their WCS, to 1e-12"
)
def world(_: None) -> Answer:
    """8 x 7 pixels of half a degree; the centre is pixel (4, 3); x runs to the west."""
    from astropy import units as u

    grid = ImageGrid(pixels=(8, 7), pixel=0.5 * u.deg, centre=CENTRE)
    y, x = (a.ravel() for a in np.mgrid[0:8, 0:7])
    sky = grid.wcs.pixel_to_world(x, y)
    ra, dec = grid.directions()
    step = np.deg2rad(0.5)
    l, m = -step * (x - 3), step * (y - 4)
    due = np.stack([l, m, np.sqrt(1 - l**2 - m**2) - 1], axis=1)
    places = unit_vectors(ra, dec)
    some = np.stack(grid.at(np.array([2.5, 7.0]), np.array([0.0, 4.5])))
    return both(
        held(places, unit_vectors(sky.ra.rad, sky.dec.rad), 1e-12),
        held(grid.lmn, due, 1e-15, scale=1.0),
        held(lmn(places, CENTRE), due, 1e-14, scale=1.0),
        held(lmn(unit_vectors(*some), CENTRE)[:, :2], step * np.array([[3, -1.5], [-1.5, 3]]), 1e-14, scale=1.0),
        held(grid.east, -step * (np.arange(7) - 3), 1e-16, scale=1.0),
        held(grid.north, step * (np.arange(8) - 4), 1e-16, scale=1.0),
        _refused(lambda: ImageGrid(pixels=100, pixel=2 * u.deg, centre=CENTRE).lmn, "beyond the sky"),
    )


@case("G4", "geometry", "stations by east, north and up", "astropy's geodetic positions to 1e-6 m; nonsense refused")
def stations(_: None) -> Answer:
    """B1, B2 of the faults: plane coordinates as ITRF, axes in another order or left-handed; distances, frames."""
    from astropy import units as u
    from astropy.coordinates import EarthLocation

    enu = np.array([[0, 0, 0], [100, 0, 3], [0, 300, 0], [-2000, 500, -5.0]])
    place = {"longitude": 0.12 * u.rad, "latitude": 0.92 * u.rad, "height": 50 * u.m}
    made = Layout.from_enu(("a", "b", "c", "d"), enu * u.m, **place)
    site = EarthLocation.from_geodetic(place["longitude"], place["latitude"], place["height"])
    origin = np.array([site.x.to_value("m"), site.y.to_value("m"), site.z.to_value("m")])
    lon, lat = 0.12, 0.92
    up = np.array([np.cos(lat) * np.cos(lon), np.cos(lat) * np.sin(lon), np.sin(lat)])
    east = np.array([-np.sin(lon), np.cos(lon), 0])
    due = origin + enu @ np.stack([east, np.cross(up, east), up])
    own = Layout.geodetic(made.names, made.positions_m)
    back = EarthLocation.from_geocentric(*made.positions_m[3], unit="m").to_geodetic()
    pole = np.array(
        [np.cos(back.lat.rad) * np.cos(back.lon.rad), np.cos(back.lat.rad) * np.sin(back.lon.rad), np.sin(back.lat.rad)]
    )
    axes = made.axes.copy()
    axes[2:] = own.axes[2:]
    mixed = made.with_fields(axes=axes)
    first, which = mixed.frames
    pairs = list(zip(*(x.tolist() for x in made.baselines), strict=True))
    longest = np.sqrt(2100.0**2 + 500**2 + 8**2)
    return both(
        held(made.positions_m, due, 1e-6, scale=1.0),
        held(own.axes[3, 2], pole, 1e-12),
        held(made.axes[0], np.stack([east, np.cross(up, east), up]), 1e-12),
        held(made.longest_m, longest, 1e-9),
        held(made.centre_m, due.mean(axis=0), 1e-12),
        claim(pairs == [(0, 1), (0, 2), (0, 3), (1, 2), (1, 3), (2, 3)], f"baselines {pairs}"),
        claim(first.tolist() == [0, 2, 3] and which.tolist() == [0, 0, 1, 2], f"frames {first}, {which}"),
        _refused(lambda: Layout.geodetic(("a", "b"), np.array([[0, 0, 0], [100, 0, 0.0]])), "from_enu"),
        _refused(lambda: made.with_fields(axes=made.axes[:, [1, 0, 2]]), "left-handed"),
        _refused(lambda: made.with_fields(axes=made.axes[:, [1, 2, 0]]), "from the vertical"),
        _refused(lambda: made.with_fields(axes=_tilted(made.axes)), "station 'c' is 30 deg"),
        _refused(lambda: made.with_fields(axes=1.01 * made.axes), "orthonormal"),
        _refused(lambda: made.with_fields(positions_m=made.positions_m * 1e-3), "centre of the Earth"),
        _refused(lambda: Layout.geodetic(made.names, made.positions_m * 1.01), "centre of the Earth"),
        claim(np.linalg.norm(made.positions_m, axis=1).max() < GROUND, "no station on the ground"),
    )


def _tilted(axes: Float) -> Float:
    """Those of the third station turned by 30 deg about its first axis."""
    out, (cos, sin) = axes.copy(), (np.cos(np.pi / 6), np.sin(np.pi / 6))
    out[2] = np.array([[1, 0, 0], [0, cos, sin], [0, -sin, cos]]) @ axes[2]
    return np.asarray(out)


@case(
    "G4b",
    "geometry",
    "an array of 4000 km in one plane",
    "taken to 10 deg and its length over 6340 km from the vertical",
)
def wide(_: None) -> Answer:
    """Two stations with the axes of the first, of which the second leans: 0.1 deg within the limit and beyond it."""
    ends = Layout.geodetic(("a", "b"), np.array([[3.8e6, 0.4e6, 5.07e6], [3.8e6, 4.1e6, 3.0e6]])).positions_m
    up = Layout.geodetic(("a", "b"), ends).axes[:, 2]
    most = np.deg2rad(10) + np.linalg.norm(ends[0] - ends[1]) / 6.34e6
    across = np.cross(up[1], up[0])
    across /= np.linalg.norm(across)

    def leaning(angle: float) -> Layout:
        r = np.cos(angle) * up[1] + np.sin(angle) * np.cross(across, up[1])
        axes = np.stack([Layout.geodetic(("a",), ends[:1]).axes[0], np.stack([np.cross(across, r), across, r])])
        return Layout(names=("a", "b"), positions_m=ends, axes=axes)

    taken = leaning(most - np.deg2rad(0.1))
    return both(
        claim(len(taken) == 2, "refused"),
        _refused(lambda: leaning(most + np.deg2rad(0.1)), "from the vertical"),
    )


@case("G5", "geometry", "the time of transit", "azimuth 0 or 180 deg for astropy, to 5 arcsec, within that day")
def culmination(_: None) -> Answer:
    """A source north of the zenith, one south of it, and one that culminates just after midnight."""
    from astropy import units as u
    from astropy.coordinates import AltAz, EarthLocation
    from astropy.utils import iers

    site = small_array().centre_m
    place, answers = EarthLocation.from_geocentric(*site, unit="m"), []
    for centre in (CENTRE, Direction(4.0, 1.2), Direction(1.2, -0.2)):
        when = transit_time(centre, site, "2012-12-07")
        with iers.conf.set_temp("auto_download", False), iers.conf.set_temp("auto_max_age", None):
            seen = centre.skycoord.transform_to(AltAz(obstime=when, location=place, pressure=0 * u.Pa))
        answers.append(Answer(float(abs(np.sin(seen.az.rad) * np.cos(seen.alt.rad))), 5 * ARCSEC))
        upper = np.cos(seen.zen.rad) > np.sin(np.arcsin(site[2] / np.linalg.norm(site))) * np.sin(centre.dec_rad)
        answers.append(claim(upper and when.isot.startswith("2012-12-07"), f"lower, or another day: {when.isot}"))
    return both(*answers)


@case("G6", "geometry", "an interval of 20 s on integrations with a gap", "by their times: 0 10 / 20 / 90 / 100 110 s")
def gap(_: None) -> Answer:
    """C2 of the faults. Intervals begin at 5 s before the first integration: 80 to 100 s is one of them."""
    slots = 4.86e9 + np.array([0, 10, 20, 90, 100, 110.0])
    found = intervals(slots, 20.0, 10.0)
    whole = intervals(slots, None, 10.0)
    later = intervals(slots[2:], 20.0, 10.0, start_s=float(slots[0]))
    odd = intervals(slots[:3], 26.0, 10.0)
    centres = slots[0] - 5 + np.array([10, 30, 90, 110])
    return both(
        claim(found.group.tolist() == [0, 0, 1, 2, 3, 3], f"groups {found.group.tolist()}"),
        claim([(s.start, s.stop) for s in found.slices] == [(0, 2), (2, 3), (3, 4), (4, 6)], f"{found.slices}"),
        held(found.centres_s - slots[0], centres - slots[0], 1e-9),
        claim(whole.group.tolist() == list(range(6)) and np.array_equal(whole.centres_s, slots), "one each is not"),
        claim(later.group.tolist() == [0, 1, 2, 2], f"of a block of them: {later.group.tolist()}"),
        held(later.centres_s - slots[0], centres[1:] - slots[0], 1e-9),
        claim((found.step, found.length_s, odd.step, odd.length_s) == (2, 20.0, 3, 30.0), f"{found}, {odd}"),
        _refused(lambda: intervals(slots[::-1], 20.0, 10.0), "ascending"),
    )


@case("G7", "geometry", "integrations, their times, channels and widths", "centres to 1e-6 s; parts of one refused")
def schedule(_: None) -> Answer:
    """B4, B5 of the faults: 25 s in steps of 10 s; channels at 120 and 180 MHz are not 60 MHz wide."""
    from astropy import units as u
    from astropy.time import Time

    known = {"phase_centre": CENTRE.skycoord, "interval": 10 * u.s}
    one = Observation(start="2012-12-07T01:00:00", duration=40 * u.s, frequencies=[150, 151, 153] * u.MHz, **known)
    due = mjd_seconds(Time("2012-12-07T01:00:00", scale="utc"))[0] + np.array([5, 15, 25, 35.0])
    middle = Observation(transit="2012-12-07", duration=60 * u.s, frequencies=[150] * u.MHz, **known)
    around = mjd_seconds(middle.times(small_array())) - mjd_seconds(
        transit_time(CENTRE, small_array().centre_m, "2012-12-07")
    )
    far = Observation(start="2012-12-07", duration=10 * u.s, frequencies=[120, 180] * u.MHz, **known)
    return both(
        held(mjd_seconds(one.times(small_array())) - due, np.zeros(4), 2e-6, scale=1.0),
        held(around, np.array([-25, -15, -5, 5, 15, 25]), 1e-4, scale=1.0),
        claim(one.width_hz == 1e6 and far.width_hz is None and one.count == 4, f"{one.width_hz}, {far.width_hz}"),
        _refused(
            lambda: Observation(start="2012-12-07", duration=25 * u.s, frequencies=[150] * u.MHz, **known),
            "20 s or 30 s",
        ),
        held(times_of(np.array([4.86e9 + 0.25])).mjd, (4.86e9 + 0.25) / 86400, 1e-15),
    )


@case("G8", "geometry", "stations from the coordinates of their baselines", "differences to 1e-9 m, where they close")
def closed(_: None) -> Answer:
    """Six stations; one baseline off by 1 mm is refused."""
    rng = np.random.default_rng(3)
    where = rng.normal(size=(2, 6, 3)) * 1e3
    a, b = np.triu_indices(6, 1)
    uvw = where[:, a] - where[:, b]
    found = stations_of(uvw, a, b, 6)
    broken = uvw.copy()
    broken[0, 3, 1] += 1e-3
    return both(
        held(found[:, a] - found[:, b], uvw, 1e-12),
        _refused(lambda: stations_of(broken, a, b, 6), "do not close"),
    )


@case("G9", "geometry", "how high and low directions come", "the extremes of all times and stations, to 1e-12")
def rising(_: None) -> Answer:
    """A direction 1e-9 rad beside a zenith has that distance, not 1 - up^2, which is 0."""
    at = _sampling([0.5, 2.0, 4.0], [0.2, 0.9, -0.3], small_array(3))
    up = at.local[..., 2]
    zenith = at.earth.matrices[0].T @ at.layout.axes[0, 2] - at.earth.velocity[0]
    zenith /= np.linalg.norm(zenith)
    ra, dec = np.arctan2(zenith[1], zenith[0]), np.arcsin(zenith[2])
    near = at.block(slice(0, 1), slice(0, 1)).towards(np.array([ra]), np.array([dec]))
    p, q = np.moveaxis(near.local, -1, 0)[:2]
    return both(
        held(at.rising.highest, up.max(axis=(0, 1)), 1e-12),
        held(at.rising.lowest, up.min(axis=(0, 1)), 1e-12),
        held(at.rising.horizon, np.abs(up).min(axis=(0, 1)), 1e-12),
        held(at.rising.zenith, np.sqrt(1 - (up**2)).min(axis=(0, 1)), 1e-9),
        held(near.rising.zenith, np.hypot(p, q).min(), 1e-6),
    )


@case("G10", "geometry", "the parallactic term", "a rotation and a change of hands by the angle: to 1e-9")
def parallactic(_: None) -> Answer:
    """e_theta points away from the zenith: the angle of the zenith from north, turned by half a turn."""
    at = _sampling([0.5, 2.0, 2.6], [0.2, 0.9, 1.1])
    found = Parallactic().jones(at)[:, 0]
    cos, sin = np.cos(at.parallactic_angle), np.sin(at.parallactic_angle)
    due = np.stack([np.stack([-cos, -sin], -1), np.stack([-sin, cos], -1)], -2)
    return held(found, due, 1e-9)
