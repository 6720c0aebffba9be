"""Every fast engine gives what `direct`, the definition, gives: for random chains, skies and arrays."""

import numpy as np
import pytest
from astropy import units as u
from instrument_plugins.elements.dipole import CrossedDipole
from instrument_plugins.elements.dish import Airy

import instrument
from instrument import (
    Chain,
    Composed,
    FeedTerm,
    GainTerm,
    Layout,
    Observation,
    Parallactic,
    PointSky,
    ScalarTerm,
    Scene,
)
from instrument.observe.directions import offset
from instrument.units import Direction

CENTRE = Direction(2.15, 0.84)
STATIONS = ["CS001HBA0", "CS002HBA1", "CS302HBA0", "RS106HBA", "RS406HBA", "RS508HBA"]
# phases of 40 km baselines over 5 deg are 1600 turns: one rounding of them is 1.6e3 * 2.2e-16 * 2 pi = 2e-12 of one
# source; over many sources and relative to the total this stays below
LIMIT = 1e-12

SKIES = {
    "I": (1, 0, 0, 0),
    "IQUV": (1, 0.2, -0.3, 0.1),
    "Q and U only": (0, 1, 1, 0),
    "P above I": (0.5, 0.8, 0.6, 0),
    "negative I": (-1, 0, 0, 0),
    "I and Q": (1, 0.5, 0, 0),
    "V only": (0, 0, 0, 1),
}


def sky(kind: str, seed: int, count: int = 40, shapes: bool = False) -> PointSky:
    rng = np.random.default_rng(seed)
    r, t = 0.087 * np.sqrt(rng.random(count)), 2 * np.pi * rng.random(count)
    ra, dec = offset(CENTRE, r * np.cos(t), r * np.sin(t))
    stokes = (
        rng.uniform(0.1, 1, (count, 1)) * np.array(SKIES[kind]) * rng.choice([-1, 1], (count, 4) if "U" in kind else 1)
    )
    shape = {}
    if shapes:
        some = rng.random(count) < 0.5
        shape = {
            "major_rad": np.where(some, 5e-5 * rng.random(count), 0.0),
            "minor_rad": np.where(some, 2e-5 * rng.random(count), 0.0),
            "angle_rad": 3 * rng.random(count),
        }
    return PointSky(names=tuple(map(str, range(count))), ra_rad=ra, dec_rad=dec, stokes_jy=stokes, **shape)


def own_elements_chain(stations: int, seed: int) -> Composed:
    """Every station with its own axes, so that nothing is shared."""
    rng = np.random.default_rng(seed)
    lofar = instrument.load("telescopes", "lofar-hba", stations=STATIONS).layout()
    rows = np.arange(stations) % len(lofar)
    positions = lofar.positions_m[rows] + rng.normal(0, 300, (stations, 3))
    axes = np.linalg.qr(lofar.axes[rows].transpose(0, 2, 1) + 0.02 * rng.normal(size=(stations, 3, 3)))[0].transpose(
        0, 2, 1
    )
    axes *= np.sign(np.einsum("aij,aij->ai", axes, lofar.axes[rows]))[..., None]
    layout = Layout(names=tuple(map(str, range(stations))), positions_m=positions, axes=axes)
    return Composed(stations=layout, terms=Chain(CrossedDipole(height=0.5 * u.m), Parallactic()))


class Screen(ScalarTerm):
    """A phase that grows over the sky and from station to station, (1, 1, A, S)."""

    maps = ("feed", "feed")

    def scalar(self, at):
        slope = np.arange(len(at.layout))[None, None, :, None]
        return np.exp(30j * slope * at.lmn[:, 0])


def instruments() -> dict:
    gain, feed = GainTerm(rms=0.1, seed=1), FeedTerm(rms=0.1, seed=2)
    lofar = {"stations": STATIONS}
    return {
        "bare": instrument.load("telescopes", "lofar-hba", beam=None, **lofar),
        "errors only": instrument.load("telescopes", "lofar-hba", beam=None, gain=gain, feed=feed, **lofar),
        "full": instrument.load("telescopes", "lofar-hba", **lofar),
        "full with errors": instrument.load("telescopes", "lofar-hba", gain=gain, feed=feed, **lofar),
        "array factor": instrument.load("telescopes", "lofar-hba", beam="array-factor", **lofar),
        "one group": instrument.load("telescopes", "lofar-hba", stations=STATIONS[:4]),
        "dish": Composed(
            stations=instrument.load("telescopes", "lofar-hba", **lofar).layout(),
            terms=Chain(Airy(diameter=20 * u.m), Parallactic()),
        ),
        "the same gain of all behind a screen": Composed(
            stations=instrument.load("telescopes", "lofar-hba", **lofar).layout(),
            terms=Chain(gain, Screen(), GainTerm(values=[[[[0.6 + 0.9j, 0.4 - 0.3j]]]])),
        ),
        "own axes, many": own_elements_chain(9, 3),
        "own axes, few": own_elements_chain(4, 4),
    }


def scene(array, of: PointSky) -> Scene:
    observation = Observation(
        phase_centre=CENTRE.skycoord,
        transit="2012-12-07",
        duration=6 * u.hour,
        interval=3 * u.hour,
        frequencies=[120, 180] * u.MHz,
    )
    return Scene(instrument=array, sky=of, observation=observation)


@pytest.mark.parametrize("name", list(instruments()))
@pytest.mark.parametrize("kind", list(SKIES))
def test_matrix_is_direct_for_every_chain_and_sky(name, kind):
    made = scene(instruments()[name], sky(kind, seed=len(name) + len(kind)))
    fast, slow = (made.plan(engine=e).run().data for e in ("matrix", "direct"))
    scale = np.abs(sky(kind, seed=len(name) + len(kind)).stokes_jy).sum()
    assert np.abs(fast - slow).max() <= LIMIT * scale
    assert np.abs(slow).max() > 1e-4 * scale  # there is something to compare


@pytest.mark.parametrize("name", ["bare", "full with errors", "own axes, many"])
def test_matrix_is_direct_for_gaussian_sources_beside_points(name):
    of = sky("IQUV", seed=5, shapes=True)
    made = scene(instruments()[name], of)
    fast, slow = (made.plan(engine=e).run().data for e in ("matrix", "direct"))
    points = scene(instruments()[name], sky("IQUV", seed=5)).plan(engine="direct").run().data
    scale = np.abs(of.stokes_jy).sum()
    assert np.abs(fast - slow).max() <= LIMIT * scale
    assert np.abs(points - slow).max() > 1e-3 * scale  # the shapes matter


@pytest.mark.parametrize("name", list(instruments()))
def test_factors_of_a_chain_multiply_to_its_jones_matrices(name):
    array = instruments()[name]
    at = scene(array, sky("I", seed=1)).plan().full.at
    chain = array.chain()
    factors = chain.factors(at)
    shape = (*at.shape, 2, 2)
    product = np.broadcast_to(np.eye(2, dtype=complex), shape).copy()
    if factors.shared is not None:
        product = np.broadcast_to(factors.shared[:, :, factors.group], shape).copy()
    if factors.scalar is not None:
        product = product * factors.scalar[..., None, None]
    if factors.outer is not None:
        product = np.broadcast_to(factors.outer, shape) @ product
    want = np.broadcast_to(chain.jones(at), shape)
    assert np.abs(product - want).max() < 1e-14 * np.abs(want).max()  # a few roundings


def test_a_subset_of_baselines_in_any_order_is_the_same_visibilities():
    plan = scene(instruments()["full with errors"], sky("IQUV", seed=9)).plan()
    whole = plan.run()
    a, b = whole.antenna1, whole.antenna2
    order = np.random.default_rng(0).permutation(len(a))[:9]
    swapped = plan.engine.sums(plan.problem.between(b[order], a[order]))
    assert np.abs(swapped - np.conj(np.swapaxes(whole.data[:, :, order], -1, -2))).max() < LIMIT * plan.scale_jy


def test_blocks_do_not_change_the_visibilities():
    made = scene(instruments()["full with errors"], sky("IQUV", seed=7))
    plan = made.plan()
    assert len(plan.slices) == 1
    from dataclasses import replace

    small = replace(plan, block_shape=(1, 1))
    assert len(small.slices) == 4
    assert np.array_equal(plan.run().data, small.run().data)


@pytest.mark.parametrize("engine", ["direct", "matrix"])
def test_a_baseline_the_other_way_round_is_the_hermitian_conjugate_to_the_last_bit(engine):
    from instrument import mat2
    from instrument.conformance.bench import problems
    from instrument.predict.base import EVERY

    problem = problems()["polarized points, phased stations"]
    turned = problem.between(problem.antenna2, problem.antenna1)
    one, other = (instrument.load("engines", engine).prepare(p, 0.0).sums(EVERY, EVERY) for p in (problem, turned))
    assert np.array_equal(mat2.herm(other), one)
