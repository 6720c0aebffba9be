"""Cases of engines: what a visibility is where phases, fluxes and places are extreme.

An engine that approximates, and says by how much, may be wrong by that beside what a case allows.
"""

from __future__ import annotations

import time
from dataclasses import replace

import numpy as np

from instrument import mat2
from instrument.conformance.bench import problems
from instrument.errors import InputError
from instrument.jones.feed import FeedTerm
from instrument.jones.gain import GainTerm
from instrument.observe.grid import ImageGrid
from instrument.predict.base import EVERY, Predictor, Problem
from instrument.sky.image import ImageSky
from instrument.stress.bench import claimed, fringe, operator, points, problem, references, sums
from instrument.stress.case import Answer, both, case, claim, held, not_there
from instrument.units import Complex

JY = (1.0, 0.0, 0.0, 0.0)


def _one(engine: Predictor, uvw_m: object, ra: float, stokes: object = JY, **more: object) -> tuple[Complex, float]:
    """The visibility (2, 2) of stations at `uvw_m` and at the origin, of one source at (ra, 0); its claim in Jy."""
    found, claims = claimed(engine, problem([uvw_m, (0, 0, 0)], points(ra, 0.0, stokes, **more)))
    return found[0, 0, 0], claims


@case("1", "engines", "n - 1 at l = 1e-6, w = 1e7", "-5.00000000000e-6 cycles to 1e-11; plain n - 1 gives -5.00044e-6")
def near(engine: Predictor) -> Answer:
    """Phase of a source close to the centre on a long w."""
    found, claims = _one(engine, (0, 0, 1e7), 1e-6)
    due = references()["near_cycles"]
    return held(-np.angle(found[0, 0]) / (2 * np.pi), due, 1e-11 + claims / (2 * np.pi * abs(due)))


@case("2", "engines", "baseline of 3e8 wavelengths", "within 1e-7 cycle in float64; float32 phases are not offered")
def far(engine: Predictor) -> Answer:
    """9e7 turns."""
    found, claims = _one(engine, (3e8, 0, 0), 0.3)
    off = np.angle(found[0, 0] / references()["far_fringe"])
    return Answer(float(abs(off) / (2 * np.pi)), 1e-7 + claims / (2 * np.pi))


@case("3", "engines", "a sky of one brightness over the whole sphere", "4 pi sin(2 pi b) / (2 pi b), to 1e-12 of 4 pi")
def sphere(engine: Predictor) -> Answer:
    """Gauss-Legendre in declination, even in right ascension: exact for waves of this many turns."""
    x, weight = np.polynomial.legendre.leggauss(64)
    ra = 2 * np.pi * np.arange(128) / 128
    dec, ra = (a.ravel() for a in np.meshgrid(np.arcsin(x), ra, indexing="ij"))
    flux = np.repeat(weight, 128) * 2 * np.pi / 128
    whole = 4 * np.pi
    found, claims = claimed(engine, problem([(3.125, 4.25, 0), (0, 0, 0)], points(ra, dec, flux[:, None] * JY)))
    return held(found[0, 0, 0, 0, 0], references()["sphere"], 1e-12 + claims / whole, scale=whole)


def _beamed() -> Problem:
    return problems()["polarized points, phased stations"]


@case("4", "engines", "antennas swapped, beams and polarization", "V^H, bitwise")
def swapped(engine: Predictor) -> Answer:
    """Baselines (b, a) for (a, b)."""
    given = _beamed()
    one, other = sums(engine, given), sums(engine, given.between(given.antenna2, given.antenna1))
    return both(held(mat2.herm(other), one, 0.0), claim(np.array_equal(mat2.herm(other), one), "not bitwise"))


@case("5", "engines", "closure traces under random Jones matrices", "unchanged, 1e-13 times the condition")
def closure(engine: Predictor) -> Answer:
    """tr(V_01 V_21^-1 V_23 V_03^-1) with gains and feeds of 50 %, and without."""
    uvw = np.random.default_rng(1).uniform(-300, 300, (4, 3))
    sky = points([0.01, -0.02, 0.005], [0.0, 0.01, -0.02], [[3, 0.5, 0.1, 0], [2, 0, 0.6, 0.1], [1, -0.3, 0, 0]])
    traces, worst, claimed_by = [], 0.0, 0.0
    for terms in ((), (GainTerm(rms=0.5, seed=3), FeedTerm(rms=0.5, seed=4))):
        given = problem(uvw, sky, *terms).between(np.array([0, 2, 2, 0]), np.array([1, 1, 3, 3]))
        found, claims = claimed(engine, given)
        v = found[0, 0]
        product = mat2.mul(mat2.mul(v[0], mat2.inverse(v[1])), mat2.mul(v[2], mat2.inverse(v[3])))
        traces.append(product[0, 0] + product[1, 1])
        worst = max(worst, float(np.prod(mat2.condition(v))))
        claimed_by += float((claims / np.linalg.norm(v, axis=(-2, -1))).sum())
    return held(traces[1], traces[0], (1e-13 + claimed_by) * worst, condition=worst)


@case("7", "engines", "+1e8, -1e8 and 1 Jy in one place", "1 Jy to 1e-8; complex64 is not offered")
def cancelled(engine: Predictor) -> Answer:
    """Sixteen digits, eight of which cancel."""
    sky = points([0.01] * 3, 0.0, np.multiply.outer([1e8, -1e8, 1.0], JY))
    found, claims = claimed(engine, problem([(1000, 0, 0), (0, 0, 0)], sky))
    return held(found[0, 0, 0, 0, 0], references()["cancelled"], 1e-8 + claims, condition=2e8)


@case("8", "engines", "fluxes of 1e-310, and times 2^900 and 2^-900", "scaled exactly (1e-310 to 1e-12: subnormal)")
def scaled(engine: Predictor) -> Answer:
    """A power of two changes no digit."""
    rng = np.random.default_rng(2)
    ra, flux = rng.uniform(-0.1, 0.1, 5), rng.uniform(1, 2, (5, 1)) * [1, 0.3, -0.2, 0.1]
    uvw = [(100, 30, 5), (0, 0, 0)]
    plain = sums(engine, problem(uvw, points(ra, 0.0, flux)))
    answers = []
    for power in (900, -900):
        found = sums(engine, problem(uvw, points(ra, 0.0, flux * 2.0**power)))
        answers.append(held(found * 2.0**-power, plain, 0.0))
    tiny = sums(engine, problem(uvw, points(ra, 0.0, flux * 1e-310)))
    return both(*answers, held(tiny * 1e300 * 1e10, plain, 1e-12))


@case(
    "8b",
    "engines",
    "fluxes whose sum overflows; subnormal fluxes, timed",
    "no finite sum, a plan refuses; less than 3 times as long",
)
def overflowing(engine: Predictor) -> Answer:
    """Four of 1e308 Jy in one place; 300 sources of 1e-310 Jy beside 300 of 1 Jy, the best of seven."""
    from instrument.stress.bench import observed, small_array

    most = np.outer([1e308] * 4, JY)
    with np.errstate(all="ignore"):
        found = sums(engine, problem([(100, 30, 5), (0, 0, 0)], points([0.01] * 4, 0.0, most)))
    try:
        observed(small_array(2), points([2.15] * 4, [0.84] * 4, most), 1)
        refused = False
    except InputError:
        refused = True
    rng = np.random.default_rng(3)
    uvw, ra = rng.uniform(-300, 300, (12, 3)), rng.uniform(-0.1, 0.1, 300)
    spent = []
    for scale in (1.0, 1e-310):
        given = problem(uvw, points(ra, 0.0, np.outer(np.full(300, scale), [1, 0.3, -0.2, 0.1])))
        runs = []
        for _ in range(7):
            begin = time.perf_counter()
            sums(engine, given)
            runs.append(time.perf_counter() - begin)
        spent.append(min(runs))
    whole = not np.isfinite(found[..., 0, 0]).any()
    ratio = spent[1] / spent[0]
    return claim(
        whole and refused and ratio < 3, f"finite {not whole}, planned {not refused}, {ratio:.1f} times as long"
    )


@case("9", "engines", "P > I = 0, and negative Stokes", "B exp(-2 pi i u l), to 1e-13: no root of B")
def no_root(engine: Predictor) -> Answer:
    """I, Q, U, V = 0, 3, -4, 1 and -2, 1, 0, -5."""
    answers = []
    for i, q, u, v in ((0, 3, -4, 1), (-2, 1, 0, -5)):
        due = np.array([[i + q, u + 1j * v], [u - 1j * v, i - q]]) * fringe(7.0 * np.sin(0.3))
        found, claims = _one(engine, (7, 0, 0), 0.3, (i, q, u, v))
        answers.append(held(found, due, 1e-13 + claims / float(np.abs(due).max())))
    return both(*answers)


@case("10", "engines", "Gaussians 0, 1e-300, 1e-3 and 10 rad wide", "1, 1, exp(-(pi theta u)^2/(4 ln 2)), 0")
def widths(engine: Predictor) -> Answer:
    """At 300 wavelengths."""
    answers = []
    for width, due in ((0.0, 1.0), (1e-300, 1.0), (1e-3, references()["gaussian"]), (10.0, 0.0)):
        shape = {"major_rad": [width], "minor_rad": [width], "angle_rad": [0.3]}
        found, claims = _one(engine, (300, 0, 0), 0.0, JY, **shape)
        answers.append(held(abs(found[0, 0]), due, 1e-13 + claims, scale=1.0))
    return both(*answers)


@case("12", "engines", "a patch across RA 0/360", "the same as about RA 180, to 1e-11")
def across_zero(engine: Predictor) -> Answer:
    """Sources at 359.8, 0 and 0.3 deg; and the array turned by half a turn, with sources about RA 180."""
    from dataclasses import replace

    from instrument.units import Direction

    near_zero = np.array([-0.004, 0.0, 0.006])
    given = problem([(500, 100, 20), (0, 0, 0)], points(near_zero % (2 * np.pi), 0.01, JY))
    at = given.at
    turn = np.diag([-1.0, -1.0, 1.0])
    layout = at.layout.with_fields(positions_m=at.layout.positions_m @ turn, axes=at.layout.axes @ turn)
    sky = points(near_zero + np.pi, 0.01, JY)
    turned = replace(at, layout=layout, centre=Direction(np.pi, 0.0)).towards(*sky.directions())
    one, other = claimed(engine, given), claimed(engine, replace(given, at=turned, sky=sky))
    return held(one[0], other[0], 1e-11 + (one[1] + other[1]) / float(np.abs(other[0]).max()))


@case("16", "engines", "two stations in one place", "the sum of the fluxes, whatever their phases: w = 0")
def one_place(engine: Predictor) -> Answer:
    """No fringe on a baseline of no length."""
    sky = points([0.3, -0.2], [0.1, 0.4], [[2, 1, 0, 0], [1, 0, 0.5, -0.25]])
    found, claims = claimed(engine, problem([(40, 10, 3), (40, 10, 3)], sky))
    return held(found[0, 0, 0], np.array([[4, 0.5 - 0.25j], [0.5 + 0.25j, 2]]), 1e-15 + claims / 4)


@case("50", "engines", "forward and adjoint: an impulse, Nyquist", "<A x, y> = <x, A^H y> to 1e-13 of norms")
def adjoint(engine: Predictor) -> Answer:
    """For the engines that have an adjoint; y is A x and as much noise."""
    given = problems()["an image, phased stations"]
    ready = operator(engine, given)
    shape = (given.shape[1], 4, *ready.sky.grid.pixels)
    impulse, nyquist = np.zeros(shape), np.ones(shape)
    impulse[0, 1, 0, -1] = 1.0
    nyquist[..., 1::2, :] *= -1
    nyquist[..., 1::2] *= -1
    answers = []
    for x in (impulse, nyquist):
        ax = ready.forward(x, EVERY, EVERY)
        noise = np.random.default_rng(0).normal(size=(*ax.shape, 2)).view(complex)[..., 0]
        y = ax + np.linalg.norm(ax) / np.linalg.norm(noise) * noise
        off = abs(float(np.vdot(y, ax).real) - float(np.vdot(x, ready.adjoint(y, EVERY, EVERY))))
        answers.append(Answer(off / float(np.linalg.norm(ax) * np.linalg.norm(y)), 1e-13))
    return both(*answers)


@case("50b", "engines", "forward and adjoint of more pixels than are summed at once", "<A x, y> = <x, A^H y>, 1e-13")
def adjoint_in_pieces(engine: Predictor) -> Answer:
    """4900 pixels in all Stokes parameters, two baselines."""
    from astropy import units as u

    given = problems()["an image, phased stations"]
    shape = (given.shape[1], 4, 70, 70)
    x = np.random.default_rng(5).normal(size=shape)
    grid = ImageGrid.of(shape, 2e-3, given.at.centre)
    sky = ImageSky(grid=grid, stokes=x, frequencies=given.at.freq_hz * u.Hz)
    given = replace(given, sky=sky, antenna1=given.antenna1[:2], antenna2=given.antenna2[:2])
    ready = operator(engine, given)
    ax = ready.forward(x, EVERY, EVERY)
    y = ax + np.random.default_rng(6).normal(size=(*ax.shape, 2)).view(complex)[..., 0]
    off = abs(float(np.vdot(y, ax).real) - float(np.vdot(x, ready.adjoint(y, EVERY, EVERY))))
    return Answer(off / float(np.linalg.norm(ax) * np.linalg.norm(y)), 1e-13)


MISSING = (
    not_there("15", "engines", "smearing over 1 h and 1 MHz", "sinc, with its sign", "smearing is not modelled"),
    not_there("17", "engines", "a satellite at 400 km", "a near-field term, or refused", "skies hold directions only"),
)
