"""Array factors between time nodes: within their bound, and the same however blocks are cut."""

from dataclasses import replace

import numpy as np
import pytest
from astropy import units as u
from astropy.coordinates import SkyCoord

import instrument
from instrument import ArrayFactor, Chain, Composed, GainTerm, Level, Observation, PointSky, ScalarTerm, Scene
from instrument.predict.time_nodes import EXACT, Panels, spread, weights
from instrument.predict.within import Within

CENTRE = SkyCoord("08h13m36.0s +48d13m03s")
STATIONS = ["CS001HBA0", "CS302HBA1", "RS106HBA", "RS508HBA"]


def scene(count=100, start="2012-12-07T23:50:00", reach=8.0, seed=1, sources=60, whole=False, **settings):
    """Sources to some degrees from the centre, seen for minutes about midnight, where tables have their kink."""
    rng = np.random.default_rng(seed)
    where = CENTRE.spherical_offsets_by(*(rng.uniform(-reach, reach, (2, sources)) * u.deg))
    night = Observation(
        phase_centre="08h13m36.0s +48d13m03s", start=start, duration=10 * count * u.s, interval=10 * u.s,
        frequencies=[120, 150] * u.MHz, channel_width=0.2 * u.MHz,
    )  # fmt: skip
    if not whole:
        settings["stations"] = STATIONS
    lofar = instrument.load("telescopes", "lofar-hba", **settings)
    return Scene(instrument=lofar, sky=PointSky.at(where, 10.0 ** rng.uniform(-1, 0, sources)), observation=night)


@pytest.mark.parametrize("tolerance", [1e-2, 1e-3, 1e-4, 1e-5, 1e-6, 1e-7, 1e-8])
def test_array_factors_between_nodes_are_within_their_bound(tolerance):
    made = scene()
    plan, exact = made.plan(tolerance=tolerance, engine="matrix"), made.plan()
    assert isinstance(plan.ready, Within) and plan.sum_bound <= tolerance
    assert plan.seconds < exact.seconds
    error = np.abs(plan.run().data - exact.run().data).max() / exact.scale_jy
    assert plan.ready.bound / 1e5 < error < plan.ready.bound + 2 * exact.sum_bound
    assert f"ArrayFactor at {plan.ready.way.panels.nodes} of" in str(plan)
    assert plan.verify(samples=16).passed


def test_blocks_give_the_same_bits_however_they_are_cut():
    plan = scene().plan(tolerance=1e-5)
    size = plan.ready.atom[0]
    first = plan.run().data
    for times, channels in ((size, 1), (2 * size, 2), (100, 1)):
        assert np.array_equal(replace(plan, block_shape=(times, channels)).run().data, first)


@pytest.mark.parametrize("panels", [Panels(8, 3), Panels(16, 5), Panels(64, 7), Panels(64, 12), Panels(100, 4)])
def test_the_bound_holds_for_every_direction(panels):
    """Also where levels are steered elsewhere, and where the phases are those of another frequency."""
    at = scene(count=97, reach=25.0).plan().full.at
    (beam,) = (t for t in scene().plan().full.chain.parts if isinstance(t, ArrayFactor))
    elsewhere = CENTRE.directional_offset_by(40 * u.deg, 3 * u.deg)
    levels = (beam.levels[0], Level(offsets_m=beam.levels[1].offsets_m, pointing=elsewhere))
    for term in (beam, ArrayFactor(levels=levels), ArrayFactor(levels=levels, reference_frequency=140 * u.MHz)):
        whole = term.scalar(at)
        found = np.ones(whole.shape, complex)
        panels.multiply(found, at, [term])
        apart = np.abs(found - whole).max(axis=(0, 1, 2))
        bound = panels.error(at, [term.motion(at, panels.nodes)])
        assert np.all(apart <= bound)
        assert np.median(bound / np.maximum(apart, 1e-15)) < 300


def test_nodes_are_integrations_and_their_weights_are_lagrange():
    times = np.sort(np.random.default_rng(1).uniform(0, 600, 40))
    for which, nodes in Panels(16, 5).cut(40):
        share = weights(times[which], nodes - which.start)
        assert np.allclose(share.sum(axis=1), 1, atol=1e-12)
        assert np.array_equal(share[nodes - which.start], np.eye(len(nodes)))
        assert np.allclose(share @ times[nodes] ** 4, times[which] ** 4, rtol=1e-10)
    assert spread(times, Panels(16, 15)) > 0 and spread(np.arange(10.0), Panels(5, 5)) == 0


def test_gaps_make_the_bound_larger_and_do_not_break_it():
    whole = scene(count=400, start="2012-12-07T18:00:00").plan().full.at  # no midnight
    (beam,) = (t for t in scene().plan().full.chain.parts if isinstance(t, ArrayFactor))
    panels, bounds = Panels(32, 6), []
    for at in (whole.some(np.arange(64)), whole.some(np.r_[:16, 116:132, 300:332])):
        found = np.ones(at.shape, complex)
        panels.multiply(found, at, [beam])
        apart = np.abs(found - beam.scalar(at)).max(axis=(0, 1, 2))
        bounds.append(panels.error(at, [beam.motion(at, 6)]))
        assert np.all(apart <= bounds[-1])
    assert np.median(bounds[1]) > 100 * np.median(bounds[0])


def test_what_moves_otherwise_is_not_held():
    """Gains differ from integration to integration, and directions of another program's frames have no motion."""
    made = scene(gain=GainTerm(rms=0.3, seed=1))
    plan = made.plan(tolerance=1e-4, engine="matrix")
    assert isinstance(plan.ready, Within)
    assert np.abs(plan.run().data - made.plan().run().data).max() <= plan.sum_bound * plan.scale_jy
    at = plan.full.at
    (beam,) = (t for t in plan.full.chain.parts if isinstance(t, ArrayFactor))
    assert beam.motion(replace(at, seen=at.itrf), 2) is None
    assert not Chain(beam).moving(replace(at, seen_centre=at.centre_itrf), 2)


def test_exact_is_exact():
    assert not isinstance(scene().plan().ready, Within)
    assert scene().plan().sum_bound < 1e-9


@pytest.mark.parametrize(("sources", "tolerance"), [(60, 1e-4), (60, 1e-3), (400, 1e-3)])
def test_products_of_32_bit_are_within_their_bound(sources, tolerance):
    made = scene(count=3, sources=sources, whole=True)
    plan, exact = made.plan(tolerance=tolerance, engine="matrix"), made.plan(engine="matrix")
    assert plan.ready.way == (EXACT, True) and "32-bit products" in str(plan)
    error = np.abs(plan.run().data - exact.run().data).max() / exact.scale_jy
    assert 1e-10 < error <= plan.ready.bound <= tolerance


@pytest.mark.parametrize("size", [1e-60, 1e60])
def test_no_flux_is_too_large_or_too_small_for_32_bit(size):
    made = scene(count=3, whole=True)
    made = made.with_fields(sky=made.sky.with_fields(stokes_jy=size * np.asarray(made.sky.stokes_jy)))
    plan, exact = made.plan(tolerance=1e-3, engine="matrix"), made.plan(engine="matrix")
    assert plan.ready.way.single
    assert np.abs(plan.run().data - exact.run().data).max() <= plan.sum_bound * plan.scale_jy


class Loud(ScalarTerm):
    """A number that 32 bit hold once and not squared, times what takes it away again, (1, 1, 1, 1)."""

    maps = ("feed", "feed")
    size: float = 1.0

    def peak(self, at):
        return self.size

    def scalar(self, at):
        return np.full((1, 1, 1, 1), self.size)


@pytest.mark.parametrize("size", [1e-30, 1e30])
def test_numbers_that_32_bit_do_not_hold_stay_in_64(size):
    """Also where a gain at the left end hides them from the peak of the chain."""
    made = scene(count=3, whole=True)
    quiet = GainTerm(values=np.full((1, 1, 1, 2), 1 / size))
    chain = Chain(quiet, Loud(size=size), *made.plan().full.chain.terms)
    lofar = Composed(stations=made.instrument.layout(), terms=chain)
    loud = made.with_fields(instrument=lofar)
    plan, exact = loud.plan(tolerance=1e-3, engine="matrix"), loud.plan(engine="matrix")
    assert np.abs(plan.run().data - exact.run().data).max() <= plan.sum_bound * plan.scale_jy <= 1e-3 * plan.scale_jy
    assert "32-bit" not in str(plan) and "32-bit" in str(made.plan(tolerance=1e-3, engine="matrix"))


def test_two_integrations_at_one_time_have_no_bound():
    at = scene().plan().full.at
    (beam,) = (t for t in scene().plan().full.chain.parts if isinstance(t, ArrayFactor))
    twice, panels = at.some(np.array([0, 0, 1, 2, 3, 4, 5, 6])), Panels(8, 4)
    assert not np.any(panels.error(twice.some(np.array([0, 1, 1, 1, 4, 5, 6, 7])), [beam.motion(at, 4)]) <= 1.0)
