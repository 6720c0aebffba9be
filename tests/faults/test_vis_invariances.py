"""Invariances of what an array sees, over random scenes: whatever the seed, these are equal to rounding.

Rotation of the array with the Earth, permutation and exchange of stations, a shift of the start, a cut in channels,
feeds turned with the polarization of the sky. Three scenes a test; more on request (`INSTRUMENT_SCENES=300`).
"""

import os
from dataclasses import replace

import numpy as np
import pytest
from astropy import units as u
from astropy.coordinates import SkyCoord
from instrument_plugins.elements.dipole import CrossedDipole

from instrument import Chain, Composed, FeedTerm, GainTerm, JonesTerm, Layout, Observation, PointSky, Scene, mat2
from instrument.jones.parallactic import Parallactic
from instrument.jones.station import Level, StationBeam
from instrument.observe.directions import earth_frame
from instrument.predict.base import Problem
from instrument.predict.direct import Direct

SEEDS = range(int(os.environ.get("INSTRUMENT_SCENES", 3)))
STEP = 3000 * u.s


def scene(seed, drawn=True):
    """A random array at a random place, with some chain, looking at a sky within 20 deg of where it points."""
    r = np.random.default_rng([seed, 8])
    count = int(r.integers(2, 6))
    enu = r.normal(size=(count, 3)) * 10 ** r.uniform(0.5, 5) * [1, 1, 0.05]
    site = r.uniform(-180, 180) * u.deg, r.uniform(-70, 70) * u.deg, r.uniform(0, 3000) * u.m
    layout = Layout.from_enu([f"s{k}" for k in range(count)], enu * u.m, *site)
    terms: list[JonesTerm] = []
    if drawn and r.random() < 0.7:
        terms.append(GainTerm(rms=10 ** r.uniform(-2, 0), seed=int(r.integers(99))))
    if drawn and r.random() < 0.5:
        terms.append(FeedTerm(rms=10 ** r.uniform(-3, -1), seed=int(r.integers(99))))
    beam = r.integers(3)
    dipole = CrossedDipole(height=10 ** r.uniform(-1, 0.3) * u.m, x_azimuth=r.uniform(0, 360) * u.deg)
    if beam == 1:
        terms += [dipole, Parallactic()]
    if beam == 2:
        terms += [
            StationBeam(element=dipole, levels=(Level(offsets_m=r.normal(size=(count, 5, 3)) * 5),)),
            Parallactic(),
        ]
    start = f"2015-{r.integers(1, 13):02d}-10T{r.integers(24):02d}:17:31"
    observation = Observation(
        phase_centre=SkyCoord(0 * u.deg, 50 * u.deg), start=start, duration=3 * STEP, interval=STEP,
        frequencies=np.sort(10 ** r.uniform(7.5, 8.3, 3)) * u.Hz,
    )  # fmt: skip
    # near the zenith half-way
    earth = earth_frame(observation.times(layout)[1:2], layout.centre_m)
    up = layout.axes[0, 2] @ earth.matrices[0]
    centre = SkyCoord(np.arctan2(up[1], up[0]) * u.rad, np.arcsin(up[2]) * u.rad)
    centre = centre.directional_offset_by(r.uniform(0, 360) * u.deg, r.uniform(1, 30) * u.deg)
    sources = int(r.integers(1, 5))
    where = centre.directional_offset_by(r.uniform(0, 360, sources) * u.deg, r.uniform(0, 20, sources) * u.deg)
    stokes = r.normal(size=(sources, 4)) * 10 ** r.uniform(-2, 2, (sources, 1))
    return Scene(
        instrument=Composed(stations=layout, terms=Chain(*terms)), sky=PointSky.at(where, stokes),
        observation=observation.with_fields(phase_centre=centre),
    )  # fmt: skip


def seen(made):
    return made.plan(workers=1).run()


def same(found, due, scale, tolerance=1e-9):
    """1e-9 of the total flux: fringes of 1e5 m at 200 MHz are 7e4 turns, whose rounding is 1e-11."""
    assert np.abs(found - due).max() <= tolerance * scale


@pytest.fixture(params=SEEDS)
def made(request):
    one = scene(request.param)
    plan = one.plan(workers=1)
    return one, plan.run(), max(plan.scale_jy, np.abs(plan.run().data).max())


def test_the_order_of_stations_is_a_matter_of_names(made):
    """Reversed: every baseline is the conjugate transpose. Drawn errors belong to places in the list: left out here."""
    one, _, _ = made
    still = one.with_fields(instrument=one.instrument.with_fields(
        terms=Chain(*(t for t in one.instrument.terms if isinstance(t, CrossedDipole | Parallactic)))
    ))  # fmt: skip
    vis = seen(still)
    layout = still.instrument.stations
    back = seen(still.with_fields(instrument=still.instrument.with_fields(stations=layout.select(layout.names[::-1]))))
    last = len(layout) - 1
    where = {pair: k for k, pair in enumerate(zip(vis.antenna1.tolist(), vis.antenna2.tolist(), strict=True))}
    order = [where[last - b, last - a] for a, b in zip(back.antenna1.tolist(), back.antenna2.tolist(), strict=True)]
    same(back.data, mat2.herm(vis.data[:, :, order]), np.abs(vis.data).max())


def test_a_baseline_the_other_way_round_is_the_conjugate_transpose(made):
    one, vis, scale = made
    problem = one.plan(workers=1).full
    other = Direct().sums(problem.between(problem.antenna2, problem.antenna1))
    same(other, mat2.herm(vis.data), scale)


def test_an_observation_that_starts_later_sees_the_rest(made):
    """Drawn gains and feeds included: they belong to the time and not to the count of the integration."""
    one, vis, scale = made
    begin = one.observation.start
    first = seen(one.with_fields(observation=one.observation.with_fields(duration=STEP)))
    rest = one.observation.with_fields(start=(begin + STEP).isot, duration=2 * STEP)
    same(first.data, vis.data[:1], scale)
    same(seen(one.with_fields(observation=rest)).data, vis.data[1:], scale)


def test_a_channel_alone_is_what_it_is_among_others(made):
    one, vis, scale = made
    for k in range(3):
        alone = one.observation.with_fields(frequencies=one.observation.freq_hz[k : k + 1] * u.Hz)
        same(seen(one.with_fields(observation=alone)).data, vis.data[:, k : k + 1], scale)


def test_an_array_that_turns_with_the_earth_sees_the_same(made):
    """Positions, axes, dipoles and the Earth's matrices turned about its axis: nothing else knows where ITRF points."""
    one, vis, scale = made
    problem = one.plan(workers=1).full
    angle = np.random.default_rng(len(vis.antenna1)).uniform(0, 2 * np.pi)
    turn = np.array([[np.cos(angle), -np.sin(angle), 0], [np.sin(angle), np.cos(angle), 0], [0, 0, 1]])
    old = problem.at
    layout = Layout(names=old.layout.names, positions_m=old.layout.positions_m @ turn.T, axes=old.layout.axes @ turn.T)
    terms = [
        t.with_fields(levels=tuple(Level(offsets_m=x.offsets_m @ turn.T) for x in t.levels))
        if isinstance(t, StationBeam) else t for t in problem.chain.terms
    ]  # fmt: skip
    at = replace(old, layout=layout, earth=replace(old.earth, matrices=turn @ old.earth.matrices))
    turned = Problem(at, Chain(*terms), problem.sky, problem.antenna1, problem.antenna2, problem.interval_s)
    same(Direct().sums(turned), vis.data, scale)


class Turn(JonesTerm):
    """Feeds turned by an angle from north through east."""

    maps = ("sky", "sky")
    per_station = "shared"
    directional = False
    angle: float

    def jones(self, at):
        """The rotation."""
        c, s = np.cos(self.angle), np.sin(self.angle)
        return mat2.pack(c, s, -s, c).reshape(1, 1, 1, 1, 2, 2)


@pytest.mark.parametrize("seed", SEEDS)
def test_feeds_turned_against_the_sky_see_its_polarization_turned_back(seed):
    one = scene(seed, drawn=False)
    angle = np.random.default_rng(seed).uniform(-np.pi, np.pi)
    stokes = np.array(one.sky.stokes_jy)
    linear = (stokes[:, 1] + 1j * stokes[:, 2]) * np.exp(2j * angle)
    turned = one.sky.with_fields(stokes_jy=np.stack([stokes[:, 0], linear.real, linear.imag, stokes[:, 3]], axis=1))
    bare = one.with_fields(instrument=one.instrument.with_fields(terms=Chain()))
    feeds = bare.instrument.with_fields(terms=Chain(Turn(angle=angle)))
    vis = seen(bare)
    same(seen(bare.with_fields(instrument=feeds, sky=turned)).data, vis.data, np.abs(vis.data).max() + 1e-3)


@pytest.mark.parametrize("seed", SEEDS)
def test_dipoles_turned_by_an_angle_turn_their_visibilities(seed):
    one, r = scene(seed, drawn=False), np.random.default_rng(seed)
    angle, height = r.uniform(0, 2 * np.pi), 0.5 * u.m
    at = [
        seen(one.with_fields(instrument=one.instrument.with_fields(
            terms=Chain(CrossedDipole(height=height, x_azimuth=azimuth * u.rad), Parallactic())
        ))).data for azimuth in (0.0, angle)
    ]  # fmt: skip
    rotation = np.array([[np.cos(angle), np.sin(angle)], [-np.sin(angle), np.cos(angle)]])
    same(at[1], rotation @ at[0] @ rotation.T, np.abs(at[0]).max())


def test_a_common_phase_of_all_stations_is_not_seen(made):
    _, vis, scale = made
    phase = np.exp(1j * np.random.default_rng(3).uniform(0, 6))
    turned = vis.corrupted(GainTerm(values=np.full((1, 1, len(vis.layout), 2), phase)))
    same(turned.data, vis.data, scale, 1e-14)
