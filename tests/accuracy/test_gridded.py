"""Images through the gridded engine: held to sums over all pixels, and its adjoint to itself."""

import numpy as np
import pytest
from astropy import units as u

import instrument
from instrument import ImageGrid, Imager, ImageSky, Observation, Scene
from instrument.check import definition
from instrument.errors import InputError, RefusedError
from instrument.jones.mueller import stokes
from instrument.predict.base import EVERY
from instrument.predict.direct import Direct
from instrument.predict.gridded import Gridded
from instrument.predict.time_samples import STEPS, kernels, time_samples

NAMES = ["CS001HBA0", "CS002HBA0", "CS003HBA1", "RS106HBA"]
FIELD = "08h13m36.0s +48d13m03s"


def problem(pixels=(24, 19), duration=2 * u.hour, interval=40 * u.s, centre=None, names=NAMES, uv_range=None, **more):
    """A diffuse polarized sky, P > I = 0 in most pixels, about or beside the phase centre."""
    night = Observation(
        phase_centre=FIELD, transit="2012-12-07", duration=duration, interval=interval,
        frequencies=more.pop("frequencies", [150, 166] * u.MHz),
    )  # fmt: skip
    lofar = instrument.load("telescopes", "lofar-hba", stations=names, **more)
    sky = np.random.default_rng(0).normal(size=(1, 4, *pixels)) * [[[[0.1]], [[1]], [[1]], [[0.1]]]]
    image = ImageSky(grid=ImageGrid(pixels=pixels, pixel=7 * u.arcmin, centre=centre), stokes=sky)
    scene = Scene(instrument=lofar, sky=image, observation=night)
    return scene.plan(tolerance=1e-3, engine="direct", uv_range=uv_range)


def rms(x):
    return float(np.sqrt(np.mean(np.abs(x) ** 2)))


@pytest.mark.parametrize("centre", [None, "08h13m36.0s +47d33m03s"], ids=["about", "beside"])
def test_errors_stay_below_every_tolerance_and_the_bound(centre):
    """Of the rms of the visibilities and, by the bound, of the total flux; leakage of Q, U into I has its own."""
    plan = problem(centre=centre)
    few = slice(None, None, 47)
    due = Direct().sums(plan.problem.block(few, EVERY))
    sparse = []
    for tolerance in 10.0 ** -np.arange(3, 9):
        ready = Gridded().prepare(plan.problem, tolerance)
        assert 0 < ready.bound <= tolerance
        wrong = ready.sums(EVERY, EVERY)[few] - due
        assert np.abs(wrong).max() <= ready.bound * plan.scale_jy
        assert rms(wrong) <= tolerance * rms(due)
        # ten times that of the total is what a leakage of some per cent allows
        assert rms(stokes(wrong)[..., 0]) <= 10 * tolerance * rms(stokes(due)[..., 0])
        sparse.append(ready.instants.step > 1 and ready._count < 0.9 * np.prod(plan.problem.shape[::2]))
    assert any(sparse)  # beams between instants, and visibilities between samples


@pytest.mark.parametrize("pixels", [(24, 19), (33, 34), (6, 1)])
@pytest.mark.parametrize("uv_range", [None, (30.0, 800.0)])
def test_the_adjoint_is_exact(pixels, uv_range):
    """To 1e-13 of the norms, y = A x and noise, however coarse A is; baselines in any order, and twice."""
    plan = problem(pixels, uv_range=uv_range, gain=instrument.GainTerm(rms=0.3, seed=3))
    ready = Gridded().prepare(plan.problem, 1e-3)
    rng = np.random.default_rng(1)
    x = rng.normal(size=(2, 4, *pixels))
    for pairs in (None, (np.array([2, 1, 1, 1]), np.array([0, 2, 2, 0]))):
        if pairs is not None and uv_range is not None:
            continue  # baselines of the range only
        seen = ready.forward(x, EVERY, EVERY, pairs)
        noise = rng.normal(size=(*seen.shape, 2)).view(complex)[..., 0]
        y = seen + rms(seen) / rms(noise) * noise
        back = ready.adjoint(y, EVERY, EVERY, pairs)
        off = abs(np.vdot(y, seen).real - np.vdot(x, back))
        assert off <= 1e-13 * np.linalg.norm(seen) * np.linalg.norm(y)


def test_baselines_that_are_not_there_are_refused_in_one_line():
    ready = Gridded().prepare(problem((6, 4), duration=1 * u.hour).problem, 1e-3)
    with pytest.raises(InputError, match="has no baseline between CS001HBA0 and CS001HBA0"):
        ready.forward(np.ones((2, 4, 6, 4)), EVERY, EVERY, (np.array([0]), np.array([0])))


def test_what_lies_outside_the_uv_range_is_flagged_and_images_are_the_same():
    whole = problem()
    uvw = whole.problem.visibilities(np.zeros((*whole.problem.shape, 2, 2))).uvw_m
    limits = tuple(np.quantile(np.hypot(uvw[..., 0], uvw[..., 1]), [0.2, 0.7]) / 1.9)
    part = problem(uv_range=limits)
    images = []
    for plan in (whole, part):
        ready = Gridded().prepare(plan.problem, 1e-6)
        vis = ready.predict(EVERY, EVERY)
        images.append(Imager(pixels=64, pixel=10 * u.arcsec, uv_range=limits, accuracy=1e-9).image(vis).data)
    assert 0.01 < vis.flag.mean() < 0.9
    assert not vis.data[vis.flag].any()
    assert np.abs(images[1] - images[0]).max() <= 2e-6 * np.abs(images[0]).max()


def test_a_plan_with_a_tolerance_takes_the_engine_and_says_what_it_does():
    full = problem()
    scene = Scene(instrument=instrument.load("telescopes", "lofar-hba", stations=NAMES), sky=full.full.sky,
                  observation=Observation(phase_centre=FIELD, transit="2012-12-07", duration=2 * u.hour,
                                          interval=30 * u.s, frequencies=[150] * u.MHz))  # fmt: skip
    plan = scene.plan(tolerance=1e-4)
    assert plan.engine_name == "gridded"
    assert "nodes" in str(plan)
    assert "leakage alone" in str(plan)
    check = plan.verify(samples=64)
    assert check.passed
    assert check.error < 1e-6  # the bound is of the worst case; of the total flux this is a thousandth of it
    assert scene.plan(tolerance=0).engine_name == "direct"


def test_beams_that_are_not_smooth_are_refused_with_what_can_be_had():
    sky = ImageSky(grid=ImageGrid(pixels=(40, 40), pixel=4 * u.arcmin), stokes=np.ones((1, 4, 40, 40)))
    night = Observation(
        phase_centre="08h13m36.0s -36d00m00s", transit="2012-12-07", duration=1 * u.hour, interval=30 * u.s,
        frequencies=[150] * u.MHz,
    )  # fmt: skip
    scene = Scene(instrument=instrument.load("telescopes", "lofar-hba", stations=NAMES), sky=sky, observation=night)
    with pytest.raises(RefusedError, match="beams are not smooth there"):
        scene.plan(tolerance=1e-4, engine="gridded")
    with pytest.raises(RefusedError, match="give a tolerance above 0"):
        scene.plan(engine="gridded")


def test_a_windowed_sinc_keeps_its_error_and_the_adjoint():
    """Signals of the largest rate that is allowed, at every step; the adjoint to rounding."""
    times, rng = 400, np.random.default_rng(0)
    for tolerance in (1e-3, 1e-6, 1e-9):
        for step in STEPS[1:8]:
            turns = 1 / (4 * step * 10.0)
            found = time_samples(np.array([turns]), np.array([7]), np.array([times - 5]), 10.0, tolerance)
            _, slots = found.listed()
            assert found.step[0] == step
            for share in (0.3, 1.0):
                signal = np.exp(2j * np.pi * turns * share * slots * 10.0)[:, None]
                out = np.zeros((times, 1, 1), complex)
                found.spread(signal, out)
                t = np.arange(7, times - 5)
                assert np.abs(out[t, 0, 0] - np.exp(2j * np.pi * turns * share * t * 10.0)).max() <= tolerance
                assert not out[:7].any()
            y = rng.normal(size=(times, 1, 2)) + 0j
            x, out = rng.normal(size=(found.count, 2)) + 0j, np.zeros((times, 1, 2), complex)
            found.spread(x, out)
            assert np.vdot(y, out).real == pytest.approx(np.vdot(found.gather(y), x).real, rel=1e-12, abs=1e-11)
    assert kernels(8).shape[2] == 8


@pytest.mark.parametrize(("dec", "crosses"), [("-20d13m03s", True), ("+20d13m03s", False), ("+30d13m03s", False)])
def test_an_image_that_rises_or_sets_is_refused_and_one_that_stands_low_is_right(dec, crosses):
    """A horizon between the instants at which nodes are chosen was not seen: 1e-3 of the flux at a bound of 3e-5."""
    night = Observation(
        phase_centre=f"08h13m36.0s {dec}", start="2012-12-07T20:00:00", duration=8 * u.hour, interval=2 * u.min,
        frequencies=[150] * u.MHz,
    )  # fmt: skip
    sky = ImageSky(
        grid=ImageGrid(pixels=12, pixel=10 * u.arcmin), stokes=np.random.default_rng(0).normal(size=(1, 4, 12, 12))
    )
    scene = Scene(instrument=instrument.load("telescopes", "lofar-hba", stations=NAMES), sky=sky, observation=night)
    plan = scene.plan(tolerance=1e-3, engine="direct")
    if crosses:
        with pytest.raises(RefusedError, match=r"12 x 12 pixels rise or set while observed \(at \d+ of 240 times"):
            Gridded().prepare(plan.problem, 1e-4)
        return
    ready = Gridded().prepare(plan.problem, 1e-4)
    few = np.arange(0, 240, 40)
    due = np.array([definition(plan.problem.block(slice(t, t + 1), EVERY)) for t in few])
    assert np.abs(ready.sums(EVERY, EVERY)[few, 0] - due).max() <= ready.bound * plan.scale_jy


def test_a_zenith_within_the_image_is_seen_for_what_it_is():
    """Hamaker's element depends there on the azimuth: 7e-5 of the flux was wrong at a bound of 4e-6."""
    night = Observation(
        phase_centre="08h13m36.0s +52d54m55s", transit="2012-12-07", duration=3 * u.hour, interval=3 * u.min,
        frequencies=[150] * u.MHz,
    )  # fmt: skip
    sky = ImageSky(
        grid=ImageGrid(pixels=20, pixel=6 * u.arcmin), stokes=np.random.default_rng(0).normal(size=(1, 4, 20, 20))
    )
    scene = Scene(instrument=instrument.load("telescopes", "lofar-hba", stations=NAMES), sky=sky, observation=night)
    plan = scene.plan(tolerance=1e-2, engine="direct")
    with pytest.raises(RefusedError, match="a zenith or a celestial pole"):
        Gridded().prepare(plan.problem, 1e-5)
    ready = Gridded().prepare(plan.problem, 0.3)
    due = np.array([definition(plan.problem.block(slice(t, t + 1), EVERY)) for t in range(24, 36)])
    assert np.abs(ready.sums(EVERY, EVERY)[24:36, 0] - due).max() <= ready.bound * plan.scale_jy
