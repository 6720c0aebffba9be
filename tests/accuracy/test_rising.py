"""How high and low directions come: as when every time and every station is looked at, with few of them looked at."""

from dataclasses import replace

import numpy as np
import pytest
from astropy import units as u
from astropy.time import Time
from scipy.spatial.transform import Rotation

from instrument.observe import rising as module
from instrument.observe.directions import EarthFrame
from instrument.observe.layout import Layout
from instrument.observe.sampling import Sampling
from instrument.units import Direction

CENTRE = Direction(2.15, 0.84)
RNG = np.random.default_rng(4)
TIMES = {
    "a night": np.arange(0, 8 * 3600, 20.0),
    "a day, in steps that do not divide it": np.arange(0, 86400, 77.0),
    "with gaps, one of more than a day": np.concatenate([np.arange(0, 3000, 10.0), 9e4 + np.arange(0, 5000, 10.0)]),
    "at random": np.sort(RNG.uniform(0, 86400, 900)),
    "not in their order": RNG.permutation(np.arange(0, 8 * 3600, 60.0)),
    "one": np.zeros(1),
    "two": np.array([0.0, 10.0]),
}


def sampling(seconds, ra, dec, spread=4e4, stations=9, latitude=0.92):
    """Stations that lie on the round Earth, every one with axes of its own."""
    rng = np.random.default_rng(1)
    enu = np.concatenate([rng.uniform(-spread, spread, (stations, 2)), np.zeros((stations, 1))], axis=1)
    layout = Layout.from_enu([str(k) for k in range(stations)], enu * u.m, 0.12 * u.rad, latitude * u.rad, 50 * u.m)
    tilted = Rotation.from_rotvec(rng.normal(size=(stations, 3)) * 5e-3).as_matrix()
    layout = layout.with_fields(axes=tilted @ layout.axes)
    times = Time("2012-12-07T01:00:00", scale="utc") + seconds * u.s
    return Sampling.build(layout, times, 150e6, ra, dec, CENTRE)


def sky(count=60):
    """All over the sky, poles too, and some that pass near the zenith of 52.7 deg."""
    ra = np.append(RNG.uniform(0, 2 * np.pi, count), RNG.uniform(0, 2 * np.pi, count))
    return ra, np.append(np.arcsin(RNG.uniform(-1, 1, count)), RNG.uniform(0.9, 0.94, count))


@pytest.mark.parametrize("name", TIMES)
def test_the_extremes_are_those_of_every_time_and_station(name):
    at = sampling(TIMES[name], *sky())
    found, up = at.rising, at.local[..., 2]
    np.testing.assert_allclose(found.highest, up.max(axis=(0, 1)), rtol=0, atol=1e-14)
    np.testing.assert_allclose(found.lowest, up.min(axis=(0, 1)), rtol=0, atol=1e-14)
    np.testing.assert_allclose(found.horizon, np.abs(up).min(axis=(0, 1)), rtol=0, atol=1e-14)
    aside = np.hypot(at.local[..., 0], at.local[..., 1]).min(axis=(0, 1))
    np.testing.assert_allclose(found.zenith, aside, rtol=1e-6, atol=1e-14)
    seen = replace(at, seen=at.itrf).rising  # the same of directions that another program has seen, one by one
    for one, other, limit in zip(found, seen, (1e-14, 1e-14, 1e-9, 1e-14), strict=True):
        np.testing.assert_allclose(one, other, rtol=0, atol=limit)


def test_few_times_are_looked_at(monkeypatch):
    """Of 2880 times and 9 stations: 2.3 % of all sines, of 120 directions, where the whole sky is looked at."""
    looked = []
    plain, other = EarthFrame.sines, module._Turned.sines
    monkeypatch.setattr(EarthFrame, "sines", lambda *a: _counted(plain(*a), looked))
    monkeypatch.setattr(module._Turned, "sines", lambda *a: _counted(other(*a), looked))
    at = sampling(np.arange(0, 8 * 3600, 10.0), *sky())
    assert at.rising.highest.shape == (120,)
    assert sum(looked) < 0.06 * 120 * 2880 * 9


def _counted(found, looked):
    looked.append(np.size(found[0] if isinstance(found, tuple) else found))
    return found


def test_at_a_pole_where_heights_never_change_all_times_are_looked_at_once(monkeypatch):
    """Nothing can be left out there: halving would look at every time as well, and take ten times as long."""
    looked, other = [], module._Turned.sines
    monkeypatch.setattr(module._Turned, "sines", lambda *a: _counted(other(*a), looked))
    at = sampling(np.arange(0, 8 * 3600, 20.0), *sky(), spread=0.0, latitude=np.pi / 2)
    upright = np.broadcast_to([[0.0, 1, 0], [-1, 0, 0], [0, 0, 1]], (9, 3, 3))
    at = replace(at, layout=at.layout.with_fields(axes=upright))
    found, up = at.rising, at.local[..., 2]
    np.testing.assert_allclose(found.highest, up.max(axis=(0, 1)), rtol=0, atol=1e-14)
    np.testing.assert_allclose(found.lowest, up.min(axis=(0, 1)), rtol=0, atol=1e-14)
    assert sum(looked) < 0.05 * up.size


def test_some_directions_keep_what_was_found_of_them():
    at, which = sampling(TIMES["a night"], *sky()), np.array([3, 77, 4])
    known = at.rising
    kept = at.of(which)
    assert "rising" in vars(kept) and "rising" not in vars(sampling(TIMES["one"], *sky()).of(which))
    fresh = at.towards(at.ra_rad[which], at.dec_rad[which]).rising
    for one, other, whole in zip(kept.rising, fresh, known, strict=True):
        np.testing.assert_allclose(one, other, rtol=0, atol=1e-9)
        assert np.array_equal(one, whole[which])


def test_blocks_of_times_and_directions_change_nothing(monkeypatch):
    at = sampling(TIMES["a day, in steps that do not divide it"], *sky())
    whole = at.rising
    monkeypatch.setattr(module, "BLOCK", 100)
    monkeypatch.setattr(module, "SINES", 3000)
    for one, other in zip(whole, replace(at).rising, strict=True):
        np.testing.assert_allclose(one, other, rtol=0, atol=1e-9)
