"""CLEAN against radler, the deconvolution library of WSClean, with the same settings and major cycles."""

import numpy as np
import pytest
from astropy import units as u

import instrument
from instrument import CleanImager, ImageGrid, InputError, Observation, PointSky, Scene

pytestmark = pytest.mark.peer


@pytest.fixture(scope="module")
def crowded():
    """30 points in 128 x 128 pixels seen by LOFAR's 59 stations, with noise."""
    rng, night = np.random.default_rng(7), Observation(
        phase_centre="08h13m36.0s +48d13m03s", transit="2012-12-07", duration=8 * u.hour, interval=32 * u.min,
        frequencies=[150] * u.MHz, channel_width=0.19 * u.MHz,
    )  # fmt: skip
    grid = ImageGrid(pixels=128, pixel=1 * u.arcmin, centre=night.phase_centre)
    y, x = rng.integers(10, 118, (2, 30))
    ra, dec = grid.at(y.astype(float), x.astype(float))
    flux = rng.uniform(0.3, 3, 30)
    stokes = flux[:, None] * [1, 0.2, -0.1, 0]
    sky = PointSky(names=tuple(map(str, range(30))), ra_rad=ra, dec_rad=dec, stokes_jy=stokes)
    array = instrument.load("telescopes", "lofar-hba", beam=None)
    seen = Scene(instrument=array, sky=sky, observation=night).plan(engine="matrix").run()
    return seen.with_noise(300 * u.Jy, seed=1), y, x


@pytest.mark.parametrize("peaks", ["each", "joint", "I"])
def test_residuals_are_within_10_percent_and_fluxes_within_1_percent_of_those_of_radler(crowded, peaks):
    pytest.importorskip("radler")
    seen, y, x = crowded
    settings = {"pixels": 128, "pixel": 1 * u.arcmin, "uv_range": (30, 800), "peaks": peaks, "cycles": 5}
    own, other = (CleanImager(backend=b, **settings).imaged(seen) for b in ("own", "radler"))
    rms = [m.beside["residual"].data[0].std(axis=(1, 2)) for m in (own, other)]
    assert np.abs(rms[0] / rms[1] - 1).max() < 0.1
    fluxes = [m.cube.data[0, 0, y, x] for m in (own, other)]
    assert np.abs(fluxes[0] / fluxes[1] - 1).max() < 0.01


def test_what_radler_cannot_do_is_refused(crowded):
    pytest.importorskip("radler")
    seen, *_ = crowded
    settings = {"pixels": 128, "pixel": 1 * u.arcmin, "uv_range": (30, 800), "backend": "radler"}
    mask = np.arange(128)[:, None] * np.ones(128) > 64
    with pytest.raises(InputError, match="takes no mask"):
        CleanImager(mask=mask, **settings).image(seen)


def test_without_radler_one_line_says_what_to_install(crowded, monkeypatch):
    monkeypatch.setitem(__import__("sys").modules, "radler", None)
    seen, *_ = crowded
    with pytest.raises(InputError, match=r"pip install 'instrument\[radler\]'") as error:
        CleanImager(pixels=128, pixel=1 * u.arcmin, uv_range=(30, 800), backend="radler").image(seen)
    assert "\n" not in str(error.value)
