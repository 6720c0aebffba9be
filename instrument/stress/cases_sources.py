"""Cases of sources measured in visibilities: fluxes, positions, leakage; of error parameters; of cross-polarization."""

from __future__ import annotations

from typing import Any

import numpy as np

from instrument.analyze.sources.fluxes import SourceFluxes
from instrument.analyze.sources.leakage import expected_percent, leakage_of
from instrument.analyze.sources.offsets import OffsetSums
from instrument.analyze.sources.photometry import ForcedPhotometry
from instrument.errors import Outcome
from instrument.jones import mueller
from instrument.jones.chain import Chain
from instrument.jones.gain import GainTerm
from instrument.jones.parallactic import Parallactic
from instrument.sky.points import PointSky
from instrument.stress.bench import observed, points, small_array
from instrument.stress.case import Answer, both, case, claim, held
from instrument.stress.cases_exact import Slanted
from instrument.units import Direction, Float
from instrument.visibilities import Visibilities

CENTRE = Direction(2.15, 0.84)
STOKES = np.array([[9, 1, 0, 0.5], [3, 0, -0.5, 0], [1, 0.2, 0.1, 0.1], [-2, 0, 0, 0.3], [0.5, 0, 0, 0]])


def _five(shaped: bool = False) -> PointSky:
    """Five sources; the last two are one patch, the second is a Gaussian where asked."""
    more: dict[str, Any] = {}
    if shaped:
        size = np.array([0, 4e-4, 0, 0, 2e-4])
        more = {"major_rad": size, "minor_rad": 0.5 * size, "angle_rad": np.full(5, 0.4)}
    ra, dec = 2.15 + np.array([0, 0.03, -0.02, 0.01, 0.012]), 0.84 + np.array([0, 0.01, -0.02, 0.02, 0.022])
    return points(ra, dec, STOKES, patches=("", "", "", "p", "p"), **more)


def _noise(data: Visibilities, sigma: float, seed: int = 3) -> Visibilities:
    noise = np.random.default_rng(seed).normal(size=(*data.data.shape, 2)).view(complex)[..., 0]
    return data.with_data(data.data + sigma * noise)


def _weighted(data: Visibilities) -> Visibilities:
    weight = np.random.default_rng(4).uniform(0.5, 2, data.data.shape[:3])
    return data.weighted(weight)


@case(
    "P1",
    "photometry",
    "points, Gaussians and a patch without noise",
    "their fluxes, to 1e-8; of any weights, cuts, times",
)
def exact(_: None) -> Answer:
    """Even weights, uneven weights, every second integration, a cut of baselines, U and V with weights of their own."""
    answers = []
    for shaped in (False, True):
        sky = _five(shaped)
        data = observed(small_array(8), sky, 6, (150.0, 152.0))
        due = np.concatenate([STOKES[:3], STOKES[3:].sum(axis=0)[None]])
        own = np.ones((*data.data.shape[:3], 2, 2))
        own[..., 0, 1] = own[..., 1, 0] = np.random.default_rng(1).uniform(0.5, 2, data.data.shape[:3])
        # the shares of a patch are those of I: its Q, U, V follow only where they have the same
        alike = sky.with_fields(stokes_jy=np.where(np.arange(5)[:, None] > 2, STOKES * [1, 0, 0, 0], STOKES))
        clean = observed(small_array(8), alike, 6, (150.0, 152.0))
        due[3, 1:] = 0
        cut = (20.0, 400.0)
        for vis, how in (
            (clean, {}),
            (_weighted(clean), {}),
            (clean, {"every": 2}),
            (clean, {"uv_range": cut}),
            (clean.weighted(own), {}),
            (_weighted(clean).flagged(np.random.default_rng(2).random(own.shape[:3]) < 0.2), {}),
        ):
            found = ForcedPhotometry(**how).measure(vis, alike)
            answers.append(held(found.stokes_jy, np.broadcast_to(due, found.stokes_jy.shape), 1e-8, scale=1.0))
            done = all(o is Outcome.CONVERGED for o in found.outcome)
            model = held(found.model_jy, np.broadcast_to(due, found.model_jy.shape), 1e-13, scale=1.0)
            answers += [claim(done, f"{found.outcome}"), model]
    return both(*answers)


@case(
    "P2",
    "photometry",
    "fluxes with noise of 1 Jy a visibility",
    "errors sigma / sqrt(2 N) of I; scatter / error 1 +- 0.1",
)
def errors(_: None) -> Answer:
    """One source, 28 baselines, 10 times: each of I, Q, U, V has a variance of half that of a correlation."""
    sky = points([2.15], [0.84], [1, 0, 0, 0])
    data = observed(small_array(8), sky, 10)
    pulls, sizes = [], []
    for seed in range(60):
        found = ForcedPhotometry().measure(_noise(data, 1.0, seed), sky)
        pulls.append((found.stokes_jy - found.model_jy)[0, 0] / found.error_jy[0, 0])
        sizes.append(found.error_jy[0, 0])
    # correlations: 1 in the real and 1 in the imaginary part; I = (pp + qq) / 2: 1 / sqrt 2 each
    due = np.sqrt(0.5 / (28 * 10))
    scatter = float(np.sqrt(np.mean(np.square(pulls))))
    near = Answer(abs(float(np.median(sizes)) / due - 1), 0.05)
    return both(near, Answer(abs(scatter - 1), 0.12))


@case(
    "P3",
    "photometry",
    "noise where neighbours are near (D7)",
    "errors of the inverse of the normal matrix: pulls 1 +- 0.12",
)
def neighbours(_: None) -> Answer:
    """Two sources a third of a beam apart: both errors grow; and at 1e-6 deg they are SINGULAR."""
    close = points([2.15, 2.1508], [0.84, 0.84], [[1, 0, 0, 0], [1, 0, 0, 0]])
    data = observed(small_array(8), close, 6)
    pulls = []
    for seed in range(60):
        found = ForcedPhotometry().measure(_noise(_weighted(data) if seed % 2 else data, 0.3, seed), close)
        pulls.append((found.stokes_jy - found.model_jy)[0] / found.error_jy[0])
    same = points([2.15, 2.15 + 1.7e-8], [0.84, 0.84], [[1, 0, 0, 0], [1, 0, 0, 0]])
    twice = [ForcedPhotometry().measure(v, same) for v in (data, _weighted(data))]
    ended = [f.outcome[0] is Outcome.SINGULAR and np.isnan(f.stokes_jy).all() for f in twice]
    scatter = float(np.sqrt(np.mean(np.square(pulls))))
    alone = ForcedPhotometry().measure(_noise(data, 0.3), close.select([0])).error_jy[0, 0, 1]
    two = ForcedPhotometry().measure(_noise(data, 0.3), close).error_jy[0, 0, 1]
    return both(
        Answer(abs(scatter - 1), 0.12),
        claim(all(ended), f"{[f.outcome for f in twice]}"),
        claim(two > 1.5 * alone, f"{two:.3g} beside a neighbour, {alone:.3g} alone"),
    )


@case("P4", "photometry", "sources that the model lacks", "errors 2 to 50 times those of noise: confusion is counted")
def confusion(_: None) -> Answer:
    """12 sources of 0.2 Jy about one of 1 Jy, no noise."""
    rng = np.random.default_rng(8)
    sky = points(
        2.15 + 0.02 * rng.uniform(-1, 1, 13),
        0.84 + 0.02 * rng.uniform(-1, 1, 13),
        np.outer(np.append(1.0, np.full(12, 0.2)), [1, 0, 0, 0]),
    )
    data = observed(small_array(12), sky, 32)
    found = ForcedPhotometry().measure(data, sky.select([0]))
    off = abs(found.stokes_jy[0, 0, 0] - 1)
    plain = np.sqrt(12 * 0.04 / 2 / (66 * 32))
    ratio = found.error_jy[0, 0, 0] / plain
    return claim(
        off < 4 * found.error_jy[0, 0, 0] and 1.5 < ratio < 50, f"off {off:.3f}, {ratio:.2f} times those of noise"
    )


@case("P5", "photometry", "sources moved by 1e-6 rad", "offsets to 1e-3 of them, fluxes to 1e-6, spreads closed")
def moved(_: None) -> Answer:
    """Three, one of them a Gaussian, in l and m: columns V, dV/dl, dV/dm."""
    sky = _five(True).select([0, 1, 2])
    l, m = np.array([1e-6, 0, -5e-7]), np.array([0, 1e-6, 5e-7])
    away = sky.with_fields(ra_rad=sky.ra_rad + l / np.cos(sky.dec_rad), dec_rad=sky.dec_rad + m)
    data = observed(small_array(8), away, 4)
    sums = OffsetSums(sky, np.arange(3))
    stokes = data.stokes()[..., 0]
    sums.add(data, np.stack([stokes, 2 * stokes]))
    flux, offset, spread = sums.finish()
    from instrument.observe.directions import lmn

    step = (lmn(away.vectors, CENTRE) - lmn(sky.vectors, CENTRE))[:, :2]
    one = OffsetSums(sky.select([0]), np.zeros(1, int), (10.0, 250.0))
    one.add(data, stokes[None])
    u_, v = np.moveaxis(data.uvw_m[:, :, :2].reshape(-1, 2) * data.freq_hz[0] / 299792458.0, -1, 0)
    use = (np.hypot(u_, v) >= 10) & (np.hypot(u_, v) <= 250)
    root = 1 / np.sqrt(use.sum())
    return both(
        held(flux, [STOKES[:3, 0], 2 * STOKES[:3, 0]], 1e-6),
        held(offset[0] / STOKES[:3, :1], step, 2e-3),
        held(one.finish()[2][0, 0], root, 1e-3),
        claim((spread > 0).all(), "no spread"),
    )


def _fluxes(stokes: Float, model: Float, error: float = 0.01) -> SourceFluxes:
    n = len(stokes)
    return SourceFluxes(
        names=tuple(map(str, range(n))),
        ra_rad=np.full(n, 2.15),
        dec_rad=np.asarray(0.84 + 0.01 * np.arange(n), float),
        model_jy=model[None],
        stokes_jy=stokes[None],
        error_jy=np.full((1, n, 4), error),
        freq_hz=np.array([150e6]),
        outcome=(Outcome.CONVERGED,),
        iterations=1,
    )


@case(
    "L1",
    "photometry",
    "leakage of sources with polarization of their own",
    "sqrt(Q^2 + U^2) / I beyond it, in %, to 1e-13",
)
def leakage(_: None) -> Answer:
    """By hand; errors by 20000 draws; rings; a null; and one of 0.001 Jy that is not measured."""
    model = np.array([[10, 1, 0, 0], [-4, 0, 0, 0.4], [2, 0, 0, 0], [1, 0, 0, 0.0]])
    seen = np.array([[8, 1.2, 0.3, -0.4], [-5, 0.3, 0.4, 0.6], [0.01, 0.5, 0, 0], [0.9, 0, 0.03, 0.02]])
    found = leakage_of(_fluxes(seen, model, 0.003), CENTRE)
    own = model[:, 1:] / model[:, :1] * seen[:, :1]
    extra = seen[:, 1:] - own
    linear = 100 * np.hypot(extra[:, 0], extra[:, 1]) / np.abs(seen[:, 0])
    circular = 100 * np.abs(extra[:, 2]) / np.abs(seen[:, 0])
    rng = np.random.default_rng(1)
    drawn = seen[0] + 0.003 * rng.normal(size=(20000, 4))
    left = drawn[:, 1:] / drawn[:, :1] - model[0, 1:] / model[0, 0]
    scatter = 100 * np.array([np.hypot(left[:, 0], left[:, 1]).std(), np.abs(left[:, 2]).std()])
    rings = found.rings((0.1, 1, 2))
    within = found.inside(0.7)
    return both(
        held(found.linear_percent, linear, 1e-13),
        held(found.circular_percent, circular, 1e-13),
        held(found.distance_rad, 0.01 * np.arange(4), 1e-12, scale=1.0),
        Answer(float(np.abs(found.error_percent[0] / scatter - 1).max()), 0.03),
        claim(found.near_null.tolist() == [False, False, True, False], f"{found.near_null}"),
        claim(found.measured.tolist() == [True, True, False, False], f"{found.measured}, {found.error_percent[:, 0]}"),
        claim([r["sources"] for r in rings] == [1, 1] and within["sources"] == 2, f"{rings}, {within}"),
        held([rings[0]["linear_max"], within["circular_median"]], [linear[0], circular[:2].mean()], 1e-12),
    )


@case("L2", "photometry", "leakage that a beam must give", "that of the mean Mueller matrix over baselines, to 1e-12")
def expected(_: None) -> Answer:
    """Stations without symmetry, their differential beam, two times; by a plain loop over pairs in either order."""
    from instrument.observe.sampling import times_of

    sky = _five()
    stations = Chain(GainTerm(rms=0.2, seed=1), Slanted(), Parallactic())
    at = observed(small_array(4), sky, 2).at.towards(*sky.directions())
    assert len(times_of(at.slots_s)) == 2
    jones = np.broadcast_to(stations.jones(at), (*at.shape, 2, 2))
    centre = np.broadcast_to(stations.jones(at.at_centre()), (*at.shape[:3], 1, 2, 2))
    nominal = np.linalg.inv(centre) @ jones
    total, count = np.zeros((5, 4, 4), complex), 0
    for t in range(2):
        for a in range(4):
            for b in range(4):
                if a != b:
                    total += mueller.mueller(nominal[t, 0, a], nominal[t, 0, b])
                    count += 1
    mean = (total / count).real
    seen = np.einsum("sij,sj->si", mean, STOKES)
    extra = seen[:, 1:] - STOKES[:, 1:] / STOKES[:, :1] * seen[:, :1]
    due = 100 * np.stack([np.hypot(extra[:, 0], extra[:, 1]), np.abs(extra[:, 2])], 1) / np.abs(seen[:, :1])
    return held(expected_percent(stations, at, STOKES), due, 1e-11)
