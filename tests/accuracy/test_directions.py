"""Where a source is seen from the rotating Earth, against astropy's full chain and closed forms, without a network."""

import socket

import numpy as np
import pytest
from astropy import units as u
from astropy.coordinates import AltAz, EarthLocation, SkyCoord, get_sun
from astropy.time import Time
from astropy.utils import iers

import instrument
from instrument import InputError, InstrumentWarning, Layout, Observation, Sampling
from instrument.observe.directions import EARTH_RATE, earth_frame, lmn, offset, transit_time
from instrument.units import Direction, unit_vectors

CENTRE = Direction(*np.deg2rad([123.4, 48.2175]))
CS002 = np.array([3826577.0, 461022.9, 5064892.8])
ARCSEC = np.deg2rad(1 / 3600)
TIMES = Time(["2012-12-06T23:10:00", "2012-12-07T03:07:00", "2013-06-21T12:00:00", "2020-02-29T18:00:00"])


@pytest.fixture(autouse=True)
def no_network(monkeypatch):
    def refuse(*args, **kwargs):
        raise AssertionError("a socket was opened")

    monkeypatch.setattr(socket, "socket", refuse)


def sampling(layout, times, ra, dec, freq=150e6):
    return Sampling.build(layout, times, np.array([freq]), ra, dec, CENTRE)


def site() -> Layout:
    return Layout.geodetic(["a", "b"], np.stack([CS002, CS002 + 10.0]))


@pytest.mark.parametrize("radius_deg", [0, 10, 180])
def test_directions_are_astropy_s_but_for_the_deflection_of_light(radius_deg):
    """The rest is light bent by the Sun, 0.00407 arcsec cot(elongation / 2), which M (s + v) leaves out."""
    rng = np.random.default_rng(1)
    z = 1 - rng.random(100) * (1 - np.cos(np.deg2rad(radius_deg)))
    t = rng.uniform(0, 2 * np.pi, 100)
    centre = SkyCoord(CENTRE.ra_rad, CENTRE.dec_rad, unit="rad")
    where = centre.directional_offset_by(t * u.rad, np.arccos(z) * u.rad)
    at = sampling(site(), TIMES, where.ra.rad, where.dec.rad)
    location = EarthLocation.from_geocentric(*CS002, unit="m")
    with iers.conf.set_temp("auto_download", False), iers.conf.set_temp("auto_max_age", None):
        seen = where[None].transform_to(AltAz(obstime=TIMES[:, None], location=location))
        sun = get_sun(TIMES)
    theta, azimuth = at.zenith_angle[:, 0], at.azimuth[:, 0]
    away = np.hypot(theta - (np.pi / 2 - seen.alt.rad), np.sin(theta) * np.sin(azimuth - seen.az.rad)) / ARCSEC
    elongation = np.array([where.separation(SkyCoord(s.ra, s.dec)).rad for s in sun])
    bent = 0.00407 / np.tan(elongation / 2)
    # astropy damps the bending near the Sun; 2.5e-3 arcsec is (v/c)^2, the second order of aberration
    assert np.all(away[elongation > 0.2] <= 1.05 * bent[elongation > 0.2] + 2.5e-3)
    assert away[0].max() < 0.003 or radius_deg == 180  # the night of the paper, opposite to the Sun


def test_aberration_is_there():
    frame = earth_frame(TIMES, CS002)
    speed = np.linalg.norm(frame.velocity, axis=1)
    assert np.all((speed > 0.96e-4) & (speed < 1.03e-4))  # 29 to 31 km/s
    moved = frame.itrf(CENTRE.vector[None])[:, 0]
    still = np.einsum("tij,j->ti", frame.matrices, CENTRE.vector)
    assert np.linalg.norm(moved - still, axis=1).max() > 10 * ARCSEC


def test_transit_is_on_the_meridian_within_the_day():
    for date in ("2012-12-07", "2013-03-01", "2013-09-15"):
        time = transit_time(CENTRE, CS002, date)
        assert time.isot.startswith(date)
        d = earth_frame(time, CS002).itrf(CENTRE.vector[None])[0, 0]
        hour_angle = np.arctan2(CS002[1], CS002[0]) - np.arctan2(d[1], d[0])
        assert abs((hour_angle + np.pi) % (2 * np.pi) - np.pi) < 1e-7  # 1 ms
    with pytest.raises(InputError, match="write it like '2012-12-07'"):
        transit_time(CENTRE, CS002, "7 December")


def test_uvw_are_exact_rotations_with_w_along_the_apparent_centre():
    lofar = instrument.load("telescopes", "lofar-hba")
    layout = lofar.layout()
    at = sampling(layout, TIMES, [CENTRE.ra_rad], [CENTRE.dec_rad])
    axes = at.earth.uvw_axes(CENTRE)
    assert np.abs(axes @ np.swapaxes(axes, 1, 2) - np.eye(3)).max() < 1e-15
    assert np.abs(axes[:, 2] - at.centre_itrf).max() < 1e-15
    relative = layout.positions_m - layout.centre_m
    assert np.abs(at.uvw_m[..., 2] - at.centre_itrf @ relative.T).max() < 1e-9  # the geometric delay, m
    # u and v: the change of that delay when the source moves east and north, but for the scale of aberration, 1e-4
    step = 1e-5
    for axis, (l, m) in enumerate([(step, 0.0), (0.0, step)]):
        ra, dec = offset(CENTRE, np.array([l, -l]), np.array([m, -m]))
        d = at.earth.itrf(unit_vectors(ra, dec))
        slope = (d[:, 0] - d[:, 1]) @ relative.T / (2 * step)
        assert np.abs(slope - at.uvw_m[..., axis]).max() < 2.1e-4 * np.abs(relative).max()


def test_phases_differ_from_true_delays_by_the_differential_aberration_only():
    """What u, v, w leave out: 1e-4 of the offset from the centre, at 10 deg 3 arcsec (docs/conventions.md)."""
    lofar = instrument.load("telescopes", "lofar-hba")
    ra, dec = offset(CENTRE, np.array([0.17]), np.array([0.0]))
    at = sampling(lofar.layout(), TIMES, ra, dec)
    relative = lofar.layout().positions_m - lofar.layout().centre_m
    delay = (at.itrf[:, 0] - at.centre_itrf) @ relative.T
    model = np.einsum("tac,c->ta", at.uvw_m, at.lmn[0])
    assert np.abs(delay - model).max() < 1.1e-4 * 0.17 * np.linalg.norm(relative, axis=1).max()


def test_direction_cosines_keep_their_digits_near_the_centre():
    l = np.array([1e-3, 1e-6, 3e-7, 1e-8])
    ra, dec = offset(CENTRE, l, 0 * l)
    found = lmn(unit_vectors(ra, dec), CENTRE)
    # the vectors carry 1e-16; n - 1 = -l^2/2 keeps the relative error of l, the plain form would keep nothing at 1e-8
    assert np.abs(found[:, 0] - l).max() < 3e-16
    assert np.all(np.abs(found[:, 2] / (-(l**2) / (1 + np.sqrt(1 - l**2))) - 1) < 4 * 1.1e-16 / l + 1e-12)
    back = lmn(-CENTRE.vector[None], CENTRE)
    assert back[0] == pytest.approx([0, 0, -2], abs=1e-15)


def test_offsets_and_direction_cosines_are_inverse_everywhere():
    rng = np.random.default_rng(0)
    for centre in (CENTRE, Direction(0.3, np.pi / 2), Direction(6.2, -1.5), Direction(0.0, 0.0)):
        r, t = np.sqrt(rng.random(50)) * 0.9, rng.uniform(0, 6.3, 50)
        l, m = r * np.cos(t), r * np.sin(t)
        ra, dec = offset(centre, l, m)
        assert np.abs(lmn(unit_vectors(ra, dec), centre)[:, :2] - np.stack([l, m], 1)).max() < 1e-14
    with pytest.raises(InputError, match="not on the sky"):
        offset(CENTRE, np.array([0.8]), np.array([0.8]))


def test_parallactic_angle_is_the_closed_form():
    """tan q = sin H / (tan lat cos dec - sin dec cos H), for the apparent place and the geodetic vertical."""
    hours = np.linspace(-4, 4, 9)
    times = transit_time(CENTRE, CS002, "2012-12-07") + hours * 0.99727 * u.hour
    at = sampling(site(), times, [CENTRE.ra_rad], [CENTRE.dec_rad])
    # in the frame of the pole of date: rotate ITRF so that the meridian of the site is at longitude 0
    d, up = at.itrf[:, 0], site().axes[0, 2]
    latitude = np.arcsin(up[2])
    hour_angle = np.arctan2(up[1], up[0]) - np.arctan2(d[:, 1], d[:, 0])
    dec = np.arcsin(d[:, 2])
    q = np.arctan2(np.sin(hour_angle), np.tan(latitude) * np.cos(dec) - np.sin(dec) * np.cos(hour_angle))
    # ours counts from the ICRS north, that form from the pole of date: they turn by the precession of 13 years and
    # aberration, 0.1 deg at most, slowly
    turn = (at.parallactic_angle[:, 0, 0] - q + np.pi) % (2 * np.pi) - np.pi
    assert np.abs(turn).max() < np.deg2rad(0.1)
    assert np.ptp(turn) < 1e-5


def test_north_is_carried_with_the_source_at_the_pole_and_zenith_too():
    at = sampling(site(), TIMES, [0.0, 1.0, 2.0], [np.pi / 2, -np.pi / 2, np.pi / 2 - 1e-12])
    assert np.isfinite(at.east_itrf).all()
    assert np.abs(np.linalg.norm(at.east_itrf, axis=-1) - 1).max() < 1e-15
    assert np.abs(np.einsum("tsc,tsc->ts", at.east_itrf, at.itrf)).max() < 1e-15
    up = site().axes[0, 2]
    frame = earth_frame(TIMES[:1], CS002)
    # the ICRS direction that is seen at the zenith: against aberration, by iteration
    s = frame.matrices[0].T @ up
    for _ in range(5):
        s = s + frame.matrices[0].T @ (up - frame.itrf(s[None])[0, 0])
        s /= np.linalg.norm(s)
    ra, dec = np.arctan2(s[1], s[0]), np.arcsin(s[2])
    zenith = sampling(site(), TIMES[:1], [ra], [dec])
    assert zenith.zenith_angle[0, 0, 0] < 1e-9
    assert np.isfinite(instrument.Parallactic().jones(zenith)).all()


def test_earth_turns_at_its_rate():
    frame = earth_frame(TIMES[0] + np.array([0.0, 1.0]) * u.s, CS002)
    turn = frame.matrices[1] @ frame.matrices[0].T
    assert np.arccos((np.trace(turn) - 1) / 2) == pytest.approx(EARTH_RATE, rel=1e-6)


def test_times_outside_the_earth_table_warn_with_the_size_of_the_error():
    with pytest.warns(InstrumentWarning, match=r"0\.9 s \(13\.5 arcsec\)"):
        earth_frame(Time("2060-01-01T00:00:00"), CS002)


def test_observation_counts_and_centres_its_integrations():
    night = Observation(
        phase_centre="08h13m36.0s +48d13m03s", start="2012-12-07T00:00:00", duration=8 * u.hour, interval=10 * u.s,
        frequencies=[150] * u.MHz,
    )  # fmt: skip
    times = night.times(site())
    assert len(times) == 2880
    assert abs((times[0] - Time("2012-12-07T00:00:05")).to_value("s")) < 1e-6
    assert abs((times[-1] - times[0]).to_value("s") - 28790) < 1e-6
    around = night.with_fields(start=None, transit="2012-12-07")
    middle = around.times(site())[[0, -1]].mean()
    assert abs((middle - transit_time(CENTRE, site().centre_m, "2012-12-07")).to_value("s")) < 1e-3
