"""CLEAN through an operator: the sky before the beams of the array, and its leakage gone."""

from dataclasses import replace

import numpy as np
import pytest
from astropy import units as u

import instrument
from instrument import CleanImager, ImageGrid, ImageSky, InputError, Observation, Scene, read_cube
from instrument.pipeline.run import run
from instrument.pipeline.scene_file import parse
from instrument.pipeline.scene_text import override, read_tables

PIXELS, PIXEL = 24, 8 * u.arcmin
SOURCES = {(15, 6): (10, 0, 0, 0), (5, 17): (5, 0, 0, 0), (18, 18): (3, 0.5, -0.2, 0.1)}
IMAGER = CleanImager(pixels=PIXELS, pixel=PIXEL, cycles=12, sigma=1, peaks="joint")


@pytest.fixture(scope="module")
def plan():
    """12 stations of LOFAR's core, their beams as they are, and three sources on pixels."""
    stokes = np.zeros((1, 4, PIXELS, PIXELS))
    for (y, x), flux in SOURCES.items():
        stokes[0, :, y, x] = flux
    names = [f"CS{k:03d}HBA{ear}" for k in range(2, 8) for ear in (0, 1)]
    night = Observation(
        phase_centre="08h13m36.0s +48d13m03s", transit="2012-12-07", duration=6 * u.hour, interval=20 * u.min,
        frequencies=[150] * u.MHz, channel_width=0.2 * u.MHz,
    )  # fmt: skip
    sky = ImageSky(grid=ImageGrid(pixels=PIXELS, pixel=PIXEL), stokes=stokes, frequencies=[150] * u.MHz)
    array = instrument.load("telescopes", "lofar-hba", stations=names)
    return Scene(instrument=array, sky=sky, observation=night).plan(engine="direct")


def test_model_and_restored_image_are_the_sky_before_the_beams(plan):
    vis = plan.run()
    made = IMAGER.imaged(vis, plan.ready)
    without = IMAGER.imaged(vis)
    for (y, x), flux in SOURCES.items():
        assert np.abs(made.beside["model"].data[0, :, y, x] - flux).max() < 1e-6
        assert np.abs(made.cube.data[0, :, y, x] - flux).max() < 1e-6
    # of unpolarized sources 3 % is seen as U without, and 1e-7 of I is left with the operator
    assert abs(without.cube.data[0, 2, 15, 6]) > 0.02 * without.cube.data[0, 0, 15, 6]
    assert np.abs(made.cube.data[0, 1:, 15, 6]).max() < 1e-6
    blocks = [vis.block(slice(t, t + 6), slice(None)) for t in range(0, 18, 6)]
    assert np.abs(IMAGER.image(blocks, plan.ready).data - made.cube.data)[np.isfinite(made.cube.data)].max() < 1e-6


def test_an_operator_of_other_images_times_or_stations_is_refused_in_one_line(plan):
    vis = plan.run()
    with pytest.raises(InputError, match="give both the same"):
        IMAGER.with_fields(pixels=32).image(vis, plan.ready)
    moved = replace(vis, at=replace(vis.at, freq_hz=vis.at.freq_hz + 1e6))
    with pytest.raises(InputError, match="has not the channels") as error:
        IMAGER.image(moved, plan.ready)
    assert "\n" not in str(error.value)


SCENE = [
    f"instrument.stations={[f'CS{k:03d}HBA{ear}' for k in range(2, 8) for ear in (0, 1)]}",
    "observation.interval='40 min'", "sky.shape=[3,1]", "sky.spacing='48 arcmin'",
]  # fmt: skip
CLEANED = {
    "kind": "clean", "beams": True, "tolerance": 1e-3, "pixels": 24, "pixel": "8 arcmin", "uv_range": [20, 200],
    "peaks": "joint", "cycles": 10, "threshold": "1 mJy", "sigma": 0,
}  # fmt: skip


def test_a_scene_file_cleans_through_the_beams(tmp_path):
    """Three unpolarized sources on pixels: 10 Jy before the beams in each, and 1e-4 of I left of 1 % that leaks."""
    at = np.ix_((12,), (6, 12, 18))
    polarized = {}
    for beams in (True, False):
        tables = override(read_tables("aw-correction"), SCENE)
        tables["image"] = {k: v for k, v in CLEANED.items() if beams or k not in ("beams", "tolerance")}
        result = run(parse(tables), tables, out=str(tmp_path / str(beams)))
        images = read_cube(tmp_path / str(beams) / "model.fits").data[0]
        polarized[beams] = np.abs(images[1:][(slice(None), *at)]).max()
        if beams:
            assert np.abs(images[0][at] - 10).max() < 2e-3
            assert "operator 1e-03 of |V|" in str(result.whole)
    assert polarized[False] > 0.05
    assert polarized[True] < 1e-3


def test_clean_through_beams_refuses_visibilities_without_one_of_them():
    tables = override(read_tables("aw-correction"), SCENE)
    with pytest.raises(InputError, match=r"\[image\] beams = true takes visibilities as they were: leave the table"):
        parse(tables | {"image": CLEANED, "correct": {"beam": "centre"}})
