"""Skies of pixels: the same as a list of points, in bounded memory; their adjoint is the dirty image."""

import tracemalloc

import numpy as np
import pytest
from astropy import units as u
from astropy.coordinates import SkyCoord

import instrument
from instrument import (
    FeedTerm,
    GainTerm,
    ImageGrid,
    Imager,
    ImageSky,
    InputError,
    Observation,
    PointSky,
    Scene,
    StokesCube,
    conformance,
)
from instrument.check import definition
from instrument.predict.base import EVERY
from instrument.units import unit_vectors

CENTRE = SkyCoord("08h13m36.0s +48d13m03s")
NIGHT = Observation(
    phase_centre=CENTRE, transit="2012-12-07", duration=2 * u.hour, interval=1 * u.hour,
    frequencies=[150, 151] * u.MHz, channel_width=0.2 * u.MHz,
)  # fmt: skip
ERRORS = {"gain": GainTerm(rms=0.1, seed=1), "feed": FeedTerm(rms=0.1, seed=2)}


def lofar(**settings):
    names = ["CS001HBA0", "CS003HBA1", "CS302HBA1", "RS106HBA"]
    return instrument.load("telescopes", "lofar-hba", stations=names, **settings)


def image(pixels=(10, 7), pixel=20 * u.arcmin, channels=2, seed=0, **settings):
    grid = ImageGrid(pixels=pixels, pixel=pixel, **settings)
    stokes = np.random.default_rng(seed).normal(size=(channels, 4, *grid.pixels))
    return ImageSky(grid=grid, stokes=stokes, frequencies=[150, 151][:channels] * u.MHz)


def test_an_image_is_seen_as_the_list_of_its_pixels():
    sky = image()
    sky = sky.with_fields(stokes=sky.stokes[:1], frequencies=None)
    plan = Scene(instrument=lofar(**ERRORS), sky=sky, observation=NIGHT).plan()
    assert plan.engine_name == "direct"
    assert [i.name for i in plan.refused] == ["gridded", "matrix"]
    ra, dec = plan.problem.sky.directions()
    listed = PointSky.at(SkyCoord(ra * u.rad, dec * u.rad), sky.stokes[0].reshape(4, -1).T)
    points = Scene(instrument=lofar(**ERRORS), sky=listed, observation=NIGHT).plan(engine="matrix")
    assert plan.scale_jy == pytest.approx(points.scale_jy, rel=1e-14)
    vis = plan.run()
    assert np.abs(vis.data - points.run().data).max() <= (plan.error_bound + points.error_bound) * plan.scale_jy
    check = plan.verify(vis)
    assert check.passed
    assert check.bound < 1e-10


def test_pixels_without_flux_and_stokes_parameters_that_are_zero_are_left_out_and_said():
    sky = image()
    stokes = np.array(sky.stokes)
    stokes[:, [0, 3]] = 0
    stokes[..., 2:5, :] = 0
    whole = Scene(instrument=lofar(), sky=sky.with_fields(stokes=stokes), observation=NIGHT).plan()
    assert "10 x 7 pixels" in str(whole).splitlines()[0]
    left = {i.name: i.reason for i in whole.left_out}
    assert left["21 pixels"] == "no flux"
    assert left["I, V of the sky"] == "zero in every direction"
    assert whole.problem.sky.count == 49
    assert whole.verify().passed
    with pytest.raises(InputError, match=r"the sky \(10 x 7 pixels\) has no flux at all"):
        Scene(instrument=lofar(), sky=sky.with_fields(stokes=0 * stokes), observation=NIGHT).plan()


def test_a_channel_that_the_image_lacks_is_refused_in_one_line():
    sky = image(channels=1)
    with pytest.raises(InputError, match=r"no channel at 151 MHz \(1 from 150 to 150 MHz\): observe the channels"):
        Scene(instrument=lofar(), sky=sky, observation=NIGHT).plan()
    with pytest.raises(InputError, match="2 channels but no frequencies"):
        ImageSky(grid=sky.grid, stokes=np.ones((2, 4, 10, 7)))
    with pytest.raises(InputError, match=r"images of \(7, 10\), the grid \(10, 7\)"):
        ImageSky(grid=sky.grid, stokes=np.ones((1, 4, 7, 10)))
    with pytest.raises(InputError, match=r"stokes\[0, 2, 1, 3\] is not finite"):
        hole = np.ones((1, 4, 10, 7))
        hole[0, 2, 1, 3] = np.nan
        ImageSky(grid=sky.grid, stokes=hole)


@pytest.mark.parametrize("centre", [None, "08h13m36.0s +47d13m03s"])
def test_skies_of_pixels_keep_the_contract(centre):
    sky = image(channels=1, centre=centre).with_fields(frequencies=None)
    conformance.check(sky).raise_if_failed()


def test_the_outline_covers_the_image_and_holds_its_flux():
    sky = image(pixels=(70, 45), pixel=6 * u.arcmin, centre=CENTRE)
    pixels, cells = unit_vectors(*sky.directions()), unit_vectors(*sky.outline())
    assert len(cells) == 32 * 32
    nearest = np.array([2 * np.arcsin(np.linalg.norm(cells - p, axis=1).min() / 2) for p in pixels])
    assert 0.5 * sky.reach_rad < nearest.max() <= sky.reach_rad
    both = sky.total_jy(np.array([150e6, 151e6]))
    q, v = np.hypot(sky.stokes[:, 1], sky.stokes[:, 2]), sky.stokes[:, 3]
    np.testing.assert_allclose(both, (np.abs(sky.stokes[:, 0]) + np.hypot(q, v)).sum(axis=(1, 2)), rtol=1e-13)


@pytest.mark.parametrize("dec", ["+48d13m03s", "+52d54m55s", "-20d00m00s"], ids=["field", "zenith", "horizon"])
def test_the_bound_of_an_image_is_that_of_its_pixels(dec):
    """Cells with a zenith or a horizon are looked at pixel by pixel; as a whole they gave bounds of 7e-4 and 0.8."""
    sky = image(pixels=(70, 45), pixel=6 * u.arcmin, channels=1).with_fields(frequencies=None)
    night = NIGHT.with_fields(phase_centre=f"08h13m36.0s {dec}", frequencies=[150] * u.MHz)
    plan = Scene(instrument=lofar(), sky=sky, observation=night).plan()
    ra, dec_rad = plan.problem.sky.directions()
    listed = PointSky.at(SkyCoord(ra * u.rad, dec_rad * u.rad), sky.stokes[0].reshape(4, -1).T)
    due = Scene(instrument=lofar(), sky=listed, observation=night).plan(engine="direct")
    # a cell weighs as its worst pixel; the sum of 3150 pixels is one chunk
    assert 0.99 * due.error_bound < plan.error_bound < 1.3 * due.error_bound


def test_the_adjoint_of_an_image_is_the_dirty_image():
    """Without Jones matrices: by another program, ducc0's w-gridder at 1e-12."""
    sky = image(pixels=(16, 16), pixel=30 * u.arcmin)
    plan = Scene(instrument=lofar(beam=None), sky=sky, observation=NIGHT).plan()
    rng = np.random.default_rng(1)
    data = rng.normal(size=(*plan.problem.shape, 2, 2, 2)).view(complex)[..., 0]
    cube = Imager(pixels=16, pixel=30 * u.arcmin, accuracy=1e-12).image(plan.run().with_data(data))
    times, _, baselines = plan.problem.shape
    # I = (V00 + V11) / 2: half the adjoint, over the sum of weights
    found = plan.ready.adjoint(data, EVERY, EVERY) / (2 * times * baselines)
    assert np.abs(found - cube.data).max() <= 1e-10 * np.abs(cube.data).max()


def test_a_cube_in_kelvin_or_jansky_is_a_sky():
    data = np.random.default_rng(0).normal(size=(2, 4, 5, 6))
    cube = StokesCube(data, [150, 151] * u.MHz, 1 * u.arcmin, "K")
    jansky = StokesCube(data, [150, 151] * u.MHz, 1 * u.arcmin, "Jy/pixel").sky()
    assert np.array_equal(jansky.stokes, data)
    due = (1 * u.K).to_value(u.Jy / u.sr, u.brightness_temperature(151 * u.MHz)) * (1 * u.arcmin).to_value(u.rad) ** 2
    np.testing.assert_allclose(cube.sky().stokes[1], data[1] * due, rtol=1e-9)
    assert cube.sky().grid == cube.grid
    with pytest.raises(InputError, match="a cube in Jy/beam is no sky"):
        StokesCube(data, [150, 151] * u.MHz, 1 * u.arcmin).sky()


def traced(call):
    tracemalloc.start()
    try:
        made = call()
        return made, tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()


def test_a_large_image_is_planned_and_summed_in_bounded_memory():
    """1024 x 1024 pixels: no array of all directions times stations, and what is held is what was planned."""
    stokes = np.zeros((1, 4, 1024, 1024))
    stokes[:, 1:3, 300:400, 300:400] = 1.0  # 10 000 pixels are summed, in three chunks
    sky = ImageSky(grid=ImageGrid(pixels=1024, pixel=0.5 * u.arcmin), stokes=stokes)
    scene = Scene(instrument=lofar(), sky=sky, observation=NIGHT)
    plan, peak = traced(scene.plan)
    assert peak < 1e8  # a copy of the images with their centre is 34 MB
    plan.ready.sums(slice(0, 1), slice(0, 1))  # compiled and imported
    (t, f), *_ = plan.slices
    found, peak = traced(lambda: plan.ready.sums(t, f))
    assert 0.25 * plan.work.slot_bytes < peak <= 1.2 * plan.work.slot_bytes
    cell = plan.problem.block(slice(0, 1), slice(0, 1))
    assert np.abs(found[0, 0] - definition(cell)).max() <= plan.error_bound * plan.scale_jy
