"""Very many points through the gridded engine: held to sums over all of them."""

import numpy as np
import pytest
from astropy import units as u

import instrument
from instrument import ImageGrid, ImageSky, Observation, PointSky, Scene, SumSky
from instrument.errors import RefusedError
from instrument.jones.mueller import stokes
from instrument.predict import gridded_points
from instrument.predict.base import EVERY
from instrument.predict.direct import Direct
from instrument.predict.gridded import Gridded

NAMES = ["CS001HBA0", "CS002HBA0", "CS003HBA1", "CS026HBA0"]
FIELD = "08h13m36.0s +48d13m03s"


def points(count=300, north_deg=0.0, around_deg=2.0, **more):
    """Sources of P > I over some degrees, with spectra and rotation measures."""
    rng = np.random.default_rng(0)
    fluxes = rng.normal(size=(count, 4)) * [0.1, 1, 1, 0.1]
    return PointSky(
        names=[f"s{k}" for k in range(count)],
        ra_rad=np.deg2rad(123.4 + rng.uniform(-1, 1, count) * around_deg / 0.67),
        dec_rad=np.deg2rad(48.2 + north_deg + rng.uniform(-1, 1, count) * around_deg),
        stokes_jy=fluxes,
        reference_hz=np.full(count, 150e6),
        spectral_terms=rng.normal(size=(count, 1)),
        rotation_measure=3 * rng.normal(size=count),
        **more,
    )


def plan(sky, names=NAMES, engine="direct", tolerance=1e-3, uv_range=None, **more):
    night = Observation(
        phase_centre=FIELD, transit="2012-12-07", duration=2 * u.hour, interval=40 * u.s,
        frequencies=[150, 166] * u.MHz,
    )  # fmt: skip
    lofar = instrument.load("telescopes", "lofar-hba", stations=names, **more)
    return Scene(instrument=lofar, sky=sky, observation=night).plan(
        tolerance=tolerance, engine=engine, uv_range=uv_range
    )


def rms(x):
    return float(np.sqrt(np.mean(np.abs(x) ** 2)))


@pytest.mark.parametrize("north_deg", [0.0, 1.5], ids=["about", "beside"])
def test_errors_stay_below_every_tolerance_and_the_bound(north_deg):
    """Of the rms of the visibilities and, by the bound, of the total flux; leakage of Q, U into I has its own."""
    full = plan(points(north_deg=north_deg), gain=instrument.GainTerm(rms=0.3, seed=3))
    few = slice(None, None, 47)
    due = Direct().sums(full.problem.block(few, EVERY))
    sparse = []
    for tolerance in (1e-2, 1e-3, 1e-4):
        ready = Gridded().prepare(full.problem, tolerance)
        assert 0 < ready.bound <= tolerance
        wrong = ready.sums(EVERY, EVERY)[few] - due
        assert np.abs(wrong).max() <= ready.bound * full.scale_jy
        assert rms(wrong) <= tolerance * rms(due)
        assert rms(stokes(wrong)[..., 0]) <= 10 * tolerance * rms(stokes(due)[..., 0])
        sparse.append(ready.instants.step > 1 and ready._count < 0.9 * np.prod(full.problem.shape[::2]))
    assert any(sparse)
    with pytest.raises(RefusedError, match=r"to this tolerance|too coarse for this tolerance"):
        Gridded().prepare(full.problem, 1e-8)


@pytest.mark.parametrize("beam", ["default", None])
def test_the_adjoint_is_exact(beam):
    """To 1e-13 of the norms, y = A x and noise; with beams at many nodes and at one."""
    more = {} if beam else {"beam": None}
    ready = Gridded().prepare(plan(points(60), uv_range=(30.0, 800.0), **more).problem, 1e-3)
    assert (len(ready.nodes) > 3) is (beam is not None)
    rng = np.random.default_rng(1)
    x = rng.normal(size=(2, 4, 60))
    seen = ready.forward(x, EVERY, EVERY)
    noise = rng.normal(size=(*seen.shape, 2)).view(complex)[..., 0]
    y = seen + rms(seen) / rms(noise) * noise
    back = ready.adjoint(y, EVERY, EVERY)
    assert abs(np.vdot(y, seen).real - np.vdot(x, back)) <= 1e-13 * np.linalg.norm(seen) * np.linalg.norm(y)


def test_the_plan_takes_it_for_very_many_and_leaves_few_to_sums(monkeypatch):
    many = points(8000)
    assert plan(many, engine=None).engine_name == "matrix"
    monkeypatch.setattr(gridded_points, "PRODUCTS", 1e5)
    assert plan(points(), engine=None).engine_name == "matrix"  # of four stations 300 sources are summed soon
    found = plan(many, engine=None)
    assert found.engine_name == "gridded"
    assert "leakage alone" in str(found)
    check = found.verify(samples=64)
    assert check.passed
    assert check.error < 1e-4  # of the total flux, where 1e-3 was asked
    assert plan(many, engine=None, tolerance=0).engine_name == "matrix"
    assert plan(points(), engine="gridded").engine_name == "gridded"  # whoever names it has it


def test_a_sum_of_an_image_and_very_many_points_takes_it_for_both(monkeypatch):
    monkeypatch.setattr(gridded_points, "PRODUCTS", 1e5)
    image = ImageSky(
        grid=ImageGrid(pixels=(24, 24), pixel=7 * u.arcmin), stokes=np.random.default_rng(0).normal(size=(1, 4, 24, 24))
    )
    found = plan(SumSky(skies={"stars": points(8000), "galaxy": image}), engine=None)
    lines = {name: text for name, text, _ in found.ready.lines if name in ("stars", "galaxy")}
    assert all(text.startswith("engine gridded") for text in lines.values())
    assert found.verify(samples=64).passed


def test_what_one_member_leaves_out_is_flagged_in_the_sum(monkeypatch):
    """A star that is summed on all baselines beside many that are known within the uv range alone."""
    monkeypatch.setattr(gridded_points, "PRODUCTS", 1e5)
    star = PointSky(
        names=["far"], ra_rad=np.array([2.2]), dec_rad=np.array([0.84]), stokes_jy=np.array([[100.0, 0, 0, 0]])
    )
    sky = SumSky(skies={"stars": points(8000), "far": star})
    found = plan(sky, engine=None, uv_range=(50.0, 400.0))
    assert [member.label == "gridded" for _, member in found.ready.ready] == [True, False]
    vis = found.run()
    uv = np.hypot(vis.uvw_m[..., 0], vis.uvw_m[..., 1])[:, None] * vis.freq_hz[:, None] / 299792458.0
    assert 0.1 < vis.flag.mean() < 0.9
    flag = vis.flag.reshape(*uv.shape, -1).all(axis=-1)  # of each visibility as a whole
    assert np.all(flag | ((uv > 50) & (uv < 400)))
    assert not vis.data[flag].any() and np.abs(vis.data[~flag]).min() > 0
    assert found.verify(samples=64).passed


@pytest.mark.parametrize("flux", [1e-160, 1e-300, 1e300])
def test_fluxes_of_any_size_are_seen_alike(flux):
    """What transforms square would be 0, or infinite."""
    few = slice(None, None, 60)
    seen = []
    for size in (1.0, flux):
        sky = points(60)
        full = plan(sky.with_fields(stokes_jy=sky.stokes_jy * size), uv_range=(30.0, 800.0), beam=None)
        seen.append(Gridded().prepare(full.problem, 1e-3).sums(few, EVERY) / size)
    assert np.abs(seen[1] - seen[0]).max() <= 1e-12 * np.abs(seen[0]).max()


def test_what_it_does_not_do_is_refused_in_one_line():
    with pytest.raises(RefusedError, match="a source is a Gaussian"):
        plan(points(major_rad=np.full(300, 1e-4), minor_rad=np.zeros(300), angle_rad=np.zeros(300)), engine="gridded")
    with pytest.raises(RefusedError, match="sources lie all over the sky"):
        plan(points(around_deg=40.0), engine="gridded", beam=None)
    with pytest.raises(RefusedError, match=r"grid of \d+ x \d+ x \d+ cells is too large: give a smaller uv range"):
        plan(points(), names=[*NAMES, "RS509HBA"], engine="gridded")
