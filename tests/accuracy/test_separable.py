"""Kernels for all nodes at once: held to a w-gridder for each node, to their bound, and their adjoint to itself."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from astropy import units as u

import instrument
from instrument import ImageGrid, ImageSky, Observation, Scene
from instrument.predict import separable
from instrument.predict.base import EVERY
from instrument.predict.grid_atom import Atom
from instrument.predict.gridded import Gridded
from instrument.predict.gridded_work import cells_of
from instrument.predict.separable import WIDTHS, kernel, kernels_for
from instrument.predict.separable_atom import SeparableAtom

FIELD = "08h13m36.0s +48d13m03s"
CORE = ("CS001HBA0", "CS002HBA0", "CS003HBA1", "CS004HBA0")


@cache
def made(pixels=(70, 61), tolerance=1e-5, centre=None, kinds=(1, 2), names=CORE):
    """Images of 4 deg on a few stations of the core, made ready: all cells fit."""
    lofar = instrument.load("telescopes", "lofar-hba", stations=list(names))
    sky = np.random.default_rng(0).normal(size=(1, 4, *pixels))
    sky[:, [s for s in range(4) if s not in kinds]] = 0
    image = ImageSky(grid=ImageGrid(pixels=pixels, pixel=4 * u.arcmin, centre=centre), stokes=sky)
    night = Observation(
        phase_centre=FIELD, transit="2012-12-07", duration=1 * u.hour, interval=60 * u.s, frequencies=[150] * u.MHz
    )
    plan = Scene(instrument=lofar, sky=image, observation=night).plan(tolerance=1e-2, engine="direct")
    return Gridded().prepare(plan.problem, tolerance), sky[0]


def atoms(ready):
    """The atom of all integrations, with kernels and with gridders."""
    (one,) = (atom for _, _, atom in ready._atoms(EVERY, EVERY))
    (other,) = (atom for _, _, atom in replace(ready, kernels=None)._atoms(EVERY, EVERY))
    assert isinstance(one, SeparableAtom)
    assert isinstance(other, Atom)
    return one, other


@pytest.mark.parametrize("kinds", [(1, 2), (0,), (0, 1, 2, 3)])
@pytest.mark.parametrize("centre", [None, "08h13m36.0s +47d53m03s"], ids=["about", "beside"])
@pytest.mark.parametrize("tolerance", [1e-3, 1e-6])
def test_samples_are_those_of_a_gridder_for_each_node(kinds, centre, tolerance):
    ready, images = made(tolerance=tolerance, centre=centre, kinds=kinds)
    one, other = atoms(ready)
    # the bound of kernels, and that of ducc0, each of the sum of all pixels
    most = 2 * ready.nodes.peak * (ready.kernels.error + ready.nodes.growth * ready.accuracy) * np.abs(images).sum()
    due = other.forward(images)
    off = np.abs(one.forward(images) - due).max()
    assert 0 < off <= most
    assert off <= tolerance * np.abs(due).max()  # the pixels are random: the bound is 1e3 times what comes out


@pytest.mark.parametrize("pixels", [(70, 61), (64, 90), (5, 6)], ids=["odd", "oblong", "wrapped around"])
@pytest.mark.parametrize("threads", [1, 3])
def test_the_adjoint_is_exact_and_that_of_each_thread(pixels, threads):
    """Also where baselines need more cells than the transform has, and it comes again."""
    ready, images = made(pixels, 1e-4, centre="08h13m36.0s +47d53m03s")
    assert (atoms(ready)[0].window[1][0] > 2 * pixels[1]) == (pixels == (5, 6))
    due = atoms(ready)[1].forward(images)
    assert np.abs(atoms(ready)[0].forward(images) - due).max() <= 1e-4 * np.abs(due).max()
    one = replace(atoms(ready)[0], threads=threads)
    rng = np.random.default_rng(1)
    for kinds in ((1, 2), (0, 1, 2, 3), (3,)):
        x = np.zeros((4, *pixels))
        x[list(kinds)] = rng.normal(size=(len(kinds), *pixels))
        seen = one.forward(x)
        y = seen + np.abs(seen).mean() * rng.normal(size=(*seen.shape, 2)).view(complex)[..., 0]
        back = one.adjoint(y, kinds)
        off = abs(np.vdot(y, seen).real - np.vdot(x, back))
        assert off <= 1e-13 * np.linalg.norm(seen) * np.linalg.norm(y)
        assert not back[[s for s in range(4) if s not in kinds]].any()
        assert np.allclose(one.forward(x), atoms(ready)[0].forward(x), rtol=0, atol=1e-13 * np.abs(seen).max())


@pytest.mark.parametrize("width", WIDTHS[1:])
def test_kernels_make_the_series_within_their_band(width):
    """A digit for each cell, degree 0 ahead of the others by four; between rows of the table too."""
    rng = np.random.default_rng(2)
    x, off = rng.uniform(-0.25, 0.25, 500), rng.uniform(-0.5, 0.5, 500)
    one = kernel(width, 0)
    assert np.abs(one.made(x, off)[:, 0] - 1).max() < 10 ** (1.5 - 0.95 * width) + 2e-12
    many = kernel(width, 4)
    due = np.polynomial.chebyshev.chebvander(4 * x, 4)
    errors = np.abs(many.made(x, off) - due).max(axis=0)
    assert errors.max() < 10 ** (5.4 - 0.93 * width) + 4e-12


def test_the_narrowest_kernels_that_will_do_are_taken():
    ready, _ = made(tolerance=1e-4)
    widths = [kernels_for(ready.nodes, wanted).across.width for wanted in (1e-2, 1e-4, 1e-6)]
    assert widths == sorted(set(widths))
    for wanted in (1e-2, 1e-4, 1e-6):
        assert kernels_for(ready.nodes, wanted).error <= wanted
    assert kernels_for(ready.nodes, 1e-15) is None  # and a gridder for each node serves


def test_what_would_fill_memory_goes_through_gridders(monkeypatch):
    """A plan knows how many cells there are at most, and an atom looks again."""
    ready, images = made((30, 30), 1e-4)
    atom = next(atom for *_, atom in ready._atoms(EVERY, EVERY))
    assert isinstance(atom, SeparableAtom)
    assert np.all(atom.window[1] <= cells_of(ready, ready.kernels))
    monkeypatch.setattr(separable, "LARGEST", 1e4)
    assert Gridded().prepare(ready.problem, 1e-4).kernels is None
    atom = next(atom for *_, atom in replace(ready)._atoms(EVERY, EVERY))
    assert isinstance(atom, Atom)
    assert atom.forward(images).any()
