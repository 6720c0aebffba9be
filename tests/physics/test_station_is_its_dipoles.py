"""A station is the mean of its dipoles: phased stations against arrays whose antennas are the dipoles of the station.

Each array holds a station, its dipoles as stations of one part, and a single dipole 45 km away that all are correlated
with. Errors are the largest of all correlations and times, relative to the visibility at the pointing.
"""

from dataclasses import replace
from typing import NamedTuple

import numpy as np
import pytest
from astropy import units as u
from instrument_plugins.elements.dipole import CrossedDipole

import instrument
from instrument import Chain, ElementBeam, Layout, Level, Observation, Parallactic, PointSky, Sampling, StationBeam
from instrument.observe.directions import LIGHT, offset
from instrument.predict.base import Problem
from instrument.predict.direct import Direct
from instrument.predict.matrix import Matrix

NIGHT = Observation(
    phase_centre="08h13m36.0s +48d13m03s",
    transit="2012-12-07",
    duration=6 * u.hour,
    interval=2 * u.hour,
    frequencies=[60] * u.MHz,
)
DEG = np.array([0.0, 2, 4, 8, 15, 30])  # from the pointing
STOKES = [1.0, 0.2, 0.1, 0.3]


class Raised(ElementBeam):
    """A dipole whose phase centre is `height` above its place: for fields exp(+i omega t) its phase is early."""

    height: float = 1.0  # m

    def jones(self, at):
        """exp(+2 pi i f h cos(theta) / c) times a crossed dipole, (T, F, A, S, 2, 2)."""
        turns = at.freq_hz[:, None, None] * self.height / LIGHT * at.local[..., 2][:, None]
        return np.exp(2j * np.pi * turns)[..., None, None] * CrossedDipole(height=0.6 * u.m).jones(at)


class Case(NamedTuple):
    """`levels` of one station (each (1, M, 3)), its element, frequency in MHz."""

    levels: list
    element: ElementBeam
    mhz: float
    layout: Layout

    @property
    def dipoles(self):
        """Offsets of all dipoles from the centre of the station (M, 3)."""
        out = np.zeros((1, 3))
        for level in self.levels:
            out = (out[:, None] + level).reshape(-1, 3)
        return out

    def problem(self, phase):
        """Station 0, its dipoles, and the reference: every one with the last, towards sources at `DEG`."""
        dipoles, (here, away) = self.dipoles, self.layout.positions_m
        count = len(dipoles)
        layout = Layout(
            names=tuple(f"s{k}" for k in range(count + 2)),
            positions_m=np.vstack([here, here + dipoles, away]),
            axes=np.concatenate([np.repeat(self.layout.axes[:1], count + 1, axis=0), self.layout.axes[1:]]),
        )
        levels = []
        for level in self.levels:
            offsets = np.zeros((count + 2, level.shape[1], 3))
            offsets[0] = level[0]
            levels.append(Level(offsets_m=offsets))
        station = StationBeam(element=self.element, levels=tuple(levels), phase=phase)
        centre = NIGHT.phase_centre
        turns = np.deg2rad([0, 40, 120, 200, 300, 75])
        ra, dec = offset(centre, np.sin(np.deg2rad(DEG)) * np.sin(turns), np.sin(np.deg2rad(DEG)) * np.cos(turns))
        sky = PointSky(names=tuple("abcdef"), ra_rad=ra, dec_rad=dec, stokes_jy=np.tile(STOKES, (len(DEG), 1)))
        at = Sampling.build(layout, NIGHT.times(layout), np.array([self.mhz * 1e6]), ra, dec, centre)
        first = np.arange(count + 1)
        return Problem(at, Chain(station, Parallactic()), sky, first, np.full_like(first, count + 1), 1.0)


def lofar(kind, name, mhz):
    """A station of LOFAR, and another one."""
    both = instrument.load("telescopes", f"lofar-{kind}", stations=[name, f"RS106{kind.upper()}"])
    station = next(t for t in both.chain().terms if isinstance(t, StationBeam))
    return Case([level.offsets_m[:1] for level in station.levels], both.element, mhz, both.layout())


def scattered():
    """256 dipoles at random within 17.5 m, such as a station of SKA-Low, whose patterns are complex."""
    layout = lofar("lba", "CS302LBA", 110).layout
    rng = np.random.default_rng(3)
    r, turn = 17.5 * np.sqrt(rng.random(256)), rng.uniform(0, 2 * np.pi, 256)
    offsets = np.stack([r * np.cos(turn), r * np.sin(turn)], axis=1) @ layout.axes[0, :2]
    return Case([offsets[None]], Raised(), 110, layout)


CASES = {
    "lba": lambda: lofar("lba", "CS302LBA", 60),
    "hba": lambda: lofar("hba", "CS401HBA1", 150),
    "random": scattered,
}


def mean_error(problem, engine):
    """|station - mean of dipoles| for each source by itself, relative to the visibility at the pointing, (S,)."""
    out = []
    for s in range(len(DEG)):
        ra, dec = problem.at.ra_rad[s : s + 1], problem.at.dec_rad[s : s + 1]
        vis = engine.sums(replace(problem, at=problem.at.towards(ra, dec), sky=problem.sky.select([s])))
        out.append((np.abs(vis[:, :, 0] - vis[:, :, 1:].mean(axis=2)).max(), np.abs(vis[:, :, 0]).max()))
    wrong, size = np.array(out).T
    return wrong / size[0]


@pytest.mark.parametrize(("name", "engine"), [*((name, Matrix()) for name in CASES), ("random", Direct())], ids=str)
def test_a_station_is_the_mean_of_its_dipoles(name, engine):
    """What is left is differential aberration, a change of scale of 1e-4: u, v, w leave it out and beams do not."""
    worst = mean_error(CASES[name]().problem("fringe"), engine)
    print(name, worst)
    assert worst.max() <= 2e-4


@pytest.mark.parametrize("name", CASES)
def test_with_directions_as_they_are_seen_it_is_that_to_1e_9(name):
    """Fringes exp(-2 pi i f (d - d0) . r / c) of apparent directions, written out here, for the dipoles."""
    problem = CASES[name]().problem("fringe")
    at = problem.at
    jones = problem.chain.jones(at)
    places = at.layout.positions_m[:-1] - at.layout.positions_m[0]
    cycles = np.einsum("tsc,ac->tas", at.itrf - at.centre_itrf[:, None], places) * at.freq_hz[0] / LIGHT
    seen = jones[:, 0, :-1] * np.exp(-2j * np.pi * cycles)[..., None, None]
    worst = np.abs(seen[:, 0] - seen[:, 1:].mean(axis=1)).max() / np.abs(seen[:, 0]).max()
    print(name, worst)
    assert worst <= 1e-9


def test_with_the_sign_of_everybeam_a_station_is_not_the_mean_of_its_dipoles():
    worst = mean_error(CASES["lba"]().problem("everybeam"), Matrix())
    print(worst)
    assert worst[1] >= 0.04  # of the peak, 2 deg from the pointing
    assert worst.max() > 0.1
    assert mean_error(CASES["random"]().problem("everybeam"), Matrix()).max() > 0.01


def test_a_dipole_whose_phase_centre_is_raised_is_a_dipole_that_stands_higher():
    """The sign of elements: a metre up is the same in a pattern, by itself or in a station, as in an offset."""
    case = scattered()
    at, up = case.problem("fringe").at, case.layout.axes[0, 2]
    zero, higher = (StationBeam(element=e, levels=(Level(offsets_m=o),)) for e, o in (
        (Raised(height=1.3), np.zeros((1, 1, 3))), (Raised(height=0.0), 1.3 * up[None, None])))  # fmt: skip
    alone, within, moved = (Chain(t, Parallactic()).jones(at) for t in (Raised(height=1.3), zero, higher))
    np.testing.assert_array_equal(alone, within)
    # the array factor is 1 at the pointing, the pattern is not
    turned = (
        moved
        * np.exp(-2j * np.pi * 1.3 * at.freq_hz[0] / LIGHT * (at.centre_itrf @ up))[:, None, None, None, None, None]
    )
    assert np.abs(alone - turned).max() <= 1e-12
    assert np.abs(alone - turned.conj()).max() > 0.1


def test_the_two_signs_are_each_others_conjugate():
    """Of array factors and elements; the rotation to the sky is real."""
    at = CASES["hba"]().problem("fringe").at
    for beam in ("full", "element", "array-factor"):
        one, other = (
            instrument.load("telescopes", "lofar-lba", stations=["CS302LBA", "RS508LBA"], beam=beam, phase=phase)
            for phase in ("fringe", "everybeam")
        )
        here = replace(at, layout=one.layout())
        np.testing.assert_array_equal(one.chain().jones(here), other.chain().jones(here).conj())
        assert np.abs(one.chain().jones(here).imag).max() > 0.01
        back = [instrument.Instrument.from_json(x.to_json()) for x in (one, other)]
        assert back == [one, other] and one != other
