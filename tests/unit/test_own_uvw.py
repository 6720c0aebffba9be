"""UVW of a file in place of those worked out: in sampling, averages, other phase centres, files, and prediction."""

from dataclasses import replace

import numpy as np
import pytest
from astropy import units as u

import instrument
from instrument import ImageGrid, ImageSky, Observation, PointSky, Scene, Visibilities
from instrument.observe.directions import offset

TURN = 2.4e-6  # rad: the Earth of casacore and ours


@pytest.fixture(scope="module")
def scene():
    lofar = instrument.load("telescopes", "lofar-hba", stations=["CS002HBA0", "CS017HBA1", "RS106HBA", "RS307HBA"])
    night = Observation(
        phase_centre="08h13m36.0s +48d13m03s", transit="2012-12-07", duration=20 * u.min, interval=1 * u.min,
        frequencies=[140, 141] * u.MHz,
    )  # fmt: skip
    ra, dec = offset(night.phase_centre, np.array([0.0, 0.05, -0.06]), np.array([0.03, -0.05, 0.02]))
    stokes = np.array([[3.0, 0, 0, 0], [2.0, 0.1, 0, 0], [1.0, 0, 0.2, 0]])
    return Scene(instrument=lofar, sky=PointSky(names=("a", "b", "c"), ra_rad=ra, dec_rad=dec, stokes_jy=stokes),
                 observation=night)  # fmt: skip


def turned(uvw):
    angle = np.array([[1, TURN, 0], [-TURN, 1, 0], [0, 0, 1.0]])
    return uvw @ np.linalg.qr(angle.T)[0] @ np.diag(np.sign(np.diag(np.linalg.qr(angle.T)[1])))


@pytest.fixture(scope="module")
def at(scene):
    ours = scene.plan().problem.at
    return replace(ours, own_uvw_m=turned(ours.uvw_m))


def test_blocks_and_other_times_have_the_own_ones(at):
    apart = np.abs(at.uvw_m - replace(at, own_uvw_m=None).uvw_m).max()
    assert 0.01 < apart < 1  # 25 km by 2.4e-6
    assert np.array_equal(at.block(slice(3, 5), slice(0, 1)).uvw_m, at.uvw_m[3:5])
    # times that are not its own, told from those that are
    few = at.block(slice(0, 10), slice(None))
    later = few.every(60.0, np.arange(12, 20)).uvw_m
    assert np.abs(later - at.uvw_m[12:20]).max() < 1e-4 * apart


@pytest.mark.parametrize("engine", ["matrix", "gridded"])
def test_every_engine_takes_them(scene, at, engine):
    """Held to the definition with the same UVW: a list of points for one, pixels for the other."""
    stokes = np.zeros((1, 4, 32, 32))
    stokes[0, 0, 5, 7], stokes[0, 0, 20, 28], stokes[0, :2, 16, 15] = 3.0, 2.0, (1.0, 0.2)
    image = ImageSky(grid=ImageGrid(pixels=32, pixel=20 * u.arcmin), stokes=stokes)
    sky = image if engine == "gridded" else scene.sky
    plan = Scene(instrument=scene.instrument.with_fields(beam=None), sky=sky, observation=scene.observation).plan()
    own = replace(plan.problem, at=at.towards(plan.problem.at.ra_rad, plan.problem.at.dec_rad))
    everything = slice(0, 20), slice(0, 2)

    def data(name, problem):
        return instrument.load("engines", name).prepare(problem, 1e-7).predict(*everything).data

    known = data("direct", own)
    assert np.abs(known - data("direct", plan.problem)).max() > 1e-3  # the turn is seen
    assert np.abs(data(engine, own) - known).max() < 1e-6  # of 6 Jy


def test_files_averages_and_other_centres_keep_them(scene, at, tmp_path):
    vis = replace(scene.plan().run(), at=at)
    vis.save(tmp_path / "v.h5")
    again = Visibilities.open(tmp_path / "v.h5")
    assert np.array_equal(again.uvw_m, vis.uvw_m) and again.at.own_uvw_m is not None
    mean = vis.averaged(time=2 * u.min)
    ours = replace(mean, at=replace(mean.at, own_uvw_m=None)).uvw_m  # at the middles of the new integrations
    assert np.abs(mean.uvw_m - turned(ours)).max() < 1e-3 and np.abs(mean.uvw_m - ours).max() > 1e-2
    there = vis.shifted_to("08h20m00s +50d00m00s")
    assert np.abs(there.shifted_to(vis.phase_centre).data - vis.data).max() < 1e-9
    assert np.abs(np.linalg.norm(there.uvw_m, axis=-1) - np.linalg.norm(vis.uvw_m, axis=-1)).max() < 1e-6


def test_own_ones_that_do_not_fit_or_are_not_numbers_are_refused(scene, at, tmp_path):
    from instrument import InputError

    vis = scene.plan().run()
    for wrong in (at.own_uvw_m[:, :2], np.full_like(at.own_uvw_m, np.nan)):
        with pytest.raises(InputError, match="own_uvw_m has shape"):
            replace(vis, at=replace(at, own_uvw_m=wrong))


def test_a_check_of_other_uvw_is_refused(scene, at):
    from instrument import InputError

    plan = scene.plan()
    with pytest.raises(InputError, match="UVW of their own"):
        plan.verify(replace(plan.run(), at=at))
