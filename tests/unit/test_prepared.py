"""Prepared engines: whole atoms in blocks and in the check, shared memory counted once, refusals of a tolerance."""

from dataclasses import replace
from functools import cached_property

import numpy as np
import pytest
from astropy import units as u

import instrument
from instrument import InputError, Observation, Predictor, Prepared, Scene, Work
from instrument.errors import RefusedError
from instrument.predict import choice
from instrument.predict.direct import Direct

ASKED: list[tuple[int, int, int, int]] = []


class Held(Predictor):
    """`direct` at the first of every three times, held for the other two: an atom of (3, 2), 1 GB that all share."""

    finest: float = 0.0

    def prepare(self, problem, tolerance):
        if tolerance < self.finest:
            raise RefusedError(f"needs a tolerance of {self.finest:g}")
        return _Held(self, problem, bound=0.5 * tolerance, atom=(3, 2))

    def work(self, problem):
        return Direct().work(problem)._replace(shared_bytes=1e9)


class _Held(Prepared):
    @cached_property
    def table(self):
        return Direct().prepare(self.problem, 0.0)

    def sums(self, times, channels, pairs=None):
        t, f = range(self.problem.shape[0])[times], range(self.problem.shape[1])[channels]
        ASKED.append((t.start, t.stop, f.start, f.stop))
        found = self.table.sums(times, channels, pairs)
        return np.repeat(found[::3], 3, axis=0)[: len(t)]


class Stateless(Predictor):
    """One file: `work` and `sums`."""

    def work(self, problem):
        return Work(1.0, 0.0, 64.0 * np.prod(problem.shape), 1e-9)

    def sums(self, problem):
        return Direct().sums(problem)


@pytest.fixture
def engines(monkeypatch):
    def use(**found):
        monkeypatch.setattr(choice, "available", lambda kind: dict.fromkeys(found, registered))
        monkeypatch.setattr(choice, "load", lambda kind, name: found[name])

    registered = instrument.available("engines")["direct"]
    ASKED.clear()
    return use


def plan(interval=60, count=8, **settings):
    lofar = instrument.load("telescopes", "lofar-hba", stations=["CS001HBA0", "CS003HBA1", "RS106HBA"])
    night = Observation(
        phase_centre="08h13m36.0s +48d13m03s", transit="2012-12-07", duration=count * interval * u.s,
        interval=interval * u.s, frequencies=[150, 151, 152] * u.MHz, channel_width=0.2 * u.MHz,
    )  # fmt: skip
    sky = instrument.load("skies", "grid", shape=(2, 2), spacing=1 * u.deg)
    return Scene(instrument=lofar, sky=sky, observation=night).plan(**settings)


def at_atoms(asked, times=8, channels=3):
    return all(
        t0 % 3 == 0 and f0 % 2 == 0 and (t1 % 3 == 0 or t1 == times) and (f1 % 2 == 0 or f1 == channels)
        for t0, t1, f0, f1 in asked
    )


def test_blocks_are_whole_atoms(engines):
    engines(held=Held())
    made = plan()
    small = replace(made, block_shape=(3, 2))
    assert len(list(small.blocks())) == 3 * 2
    assert at_atoms(ASKED)
    assert sorted(ASKED)[:2] == [(0, 3, 0, 2), (0, 3, 2, 3)]
    with pytest.raises(InputError, match=r"block_shape = \(2, 2\): held takes multiples of \(3, 2\)"):
        replace(made, block_shape=(2, 2)).slices  # noqa: B018


def test_the_check_asks_for_whole_atoms_and_finds_what_is_held_over_them(engines):
    """Cell by cell the engine would be exact: every time would be the first of its atom."""
    engines(held=Held())
    made = plan()
    check = made.verify()
    assert at_atoms(ASKED)
    assert not check.passed
    assert check.error > 1e-6  # a minute turns the fringes of 50 km baselines
    assert plan(interval=1e-5, tolerance=1e-3).verify().passed  # and within its bound it passes


def test_what_is_shared_is_counted_once_and_leaves_room_for_large_blocks(engines):
    engines(held=Held())
    made = plan(workers=3, memory="2 GB")
    result = 64.0 * 3 * np.prod(made.block_shape)
    assert made.block_shape == (8, 3)
    assert made.memory == 1e9 + 3 * (made.work.slot_bytes + result)
    with pytest.raises(RefusedError, match=r"one block needs 1 GB and the limit is 900 MB: give more memory"):
        plan(memory="0.9 GB")
    with pytest.raises(RefusedError, match=r"give fewer threads than 100000 \(--workers\), more memory \(--memory\)"):
        plan(workers=100_000, memory="1.001 GB")


def test_an_engine_may_refuse_a_tolerance_and_the_next_one_is_taken(engines):
    engines(held=Held(finest=1e-4), stateless=Stateless())
    coarse = plan(tolerance=1e-3)
    assert coarse.engine_name == "stateless"
    made = plan(tolerance=1e-3, engine="held")
    assert 0 < made.ready.bound <= 0.5e-3
    assert f"held {made.ready.bound:.1e}" in str(made)
    with pytest.raises(RefusedError, match=r"no engine serves this scene \(held: needs a tolerance of 0.0001\)"):
        plan(tolerance=1e-6, engine="held")
    engines(cheap=Costly(finest=1e-4), stateless=Stateless())
    made = plan()
    assert made.engine_name == "stateless"
    assert ("cheap", "needs a tolerance of 0.0001") in [(i.name, i.reason) for i in made.refused]


class Costly(Held):
    """Refuses, and would be the cheapest."""

    def work(self, problem):
        return Work(1.0, 0.0, 1.0, 1e-12)


def test_an_engine_of_work_and_sums_alone_runs(engines):
    engines(stateless=Stateless())
    made = plan()
    vis = made.run()
    assert made.verify(vis).passed
    assert np.array_equal(vis.data, Direct().sums(made.problem))


def test_an_engine_that_gives_nothing_says_so():
    class Empty(Predictor):
        def work(self, problem):
            return Work(1.0, 0.0, 1.0, 1.0)

    with pytest.raises(NotImplementedError, match="Empty has neither sums nor a prepare of its own"):
        Empty().sums(plan().problem)


def test_another_problem_is_prepared_anew_and_the_same_one_only_once(engines):
    engines(held=Held())
    made = plan()
    assert made.ready is made.ready
    fewer = replace(made, problem=made.problem.block(slice(0, 3), slice(None)))
    assert fewer.ready.problem is fewer.problem
    assert made.ready.problem is made.problem
