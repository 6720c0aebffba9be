"""CLEAN: what it finds, where it looks, and how it ends."""

import json
from dataclasses import replace

import numpy as np
import pytest
from astropy import units as u

from instrument import CleanImager, ImageGrid, Imager, InputError, PointSky, read_cube
from instrument.conformance.imagers import _seen
from instrument.errors import InstrumentWarning
from instrument.image.minor import Lobes, Search, minor_cycle, spectral_fit
from instrument.pipeline.run import run
from instrument.pipeline.scene_file import parse
from instrument.pipeline.scene_text import override, read_tables
from instrument.stress.bench import observed, small_array
from instrument.units import Direction

PIXEL = 6 * u.arcmin
SIZE = {"pixels": 32, "pixel": PIXEL}
RAD = float(PIXEL.to_value("rad"))


def hogbom(dirty, psf, gain, count):
    """The loop of Hogbom (1974) as it is written: the twin of the compiled one."""
    dirty, model, half = dirty.copy(), np.zeros_like(dirty), psf.shape[0] // 2
    for _ in range(count):
        y, x = np.unravel_index(np.argmax(np.abs(dirty)), dirty.shape)
        flux = gain * dirty[y, x]
        model[y, x] += flux
        size = len(dirty)
        wide = np.pad(psf, size)[half + size - y :, half + size - x :]
        dirty -= flux * wide[:size, :size]
    return model, dirty


def plain(gain=0.1, size=32):
    one = np.ones((1, 1))
    return Search(one, one[None], gain, np.ones((size, size), bool))


def a_psf(size=32, seed=1):
    rng = np.random.default_rng(seed)
    uv = rng.uniform(-0.25, 0.25, (40, 2))
    y, x = np.meshgrid(*[np.arange(size) - size // 2] * 2, indexing="ij")
    return np.cos(2 * np.pi * (uv[:, :1, None] * y + uv[:, 1:, None] * x)).mean(axis=0)


@pytest.mark.parametrize("size", [32, 31])
def test_the_minor_cycle_is_the_loop_of_hogbom(size):
    psf, rng = a_psf(size), np.random.default_rng(2)
    dirty = np.zeros((size, size))
    for y, x, flux in zip(*rng.integers(4, size - 4, (2, 6)), [5, -3, 2, 1, 0.7, -0.5], strict=True):
        dirty += flux * np.roll(psf, (y - size // 2, x - size // 2), (0, 1))
    model, left = hogbom(dirty, psf, 0.1, 60)
    residual = dirty[None, None].copy()
    found, done, sound = minor_cycle(residual, Lobes(psf[None]), plain(size=size), 0.0, 60)
    assert sound and done == 60
    assert np.abs(found[0, 0] - model).max() < 1e-12
    assert np.abs(residual[0, 0] - left).max() < 1e-12


def test_pixels_above_the_floor_are_cleaned_as_the_whole_image_is():
    psf = a_psf()
    dirty = 2 * np.roll(psf, (3, 5), (0, 1)) + np.roll(psf, (-6, -2), (0, 1))
    floor = 0.4
    count = next(n for n in range(200) if np.abs(hogbom(dirty, psf, 0.1, n)[1]).max() <= floor)
    model, left = hogbom(dirty, psf, 0.1, count)
    residual = dirty[None, None].copy()
    found, done, _ = minor_cycle(residual, Lobes(psf[None]), plain(), floor, 1000)
    assert done == count and np.abs(found[0, 0] - model).max() < 1e-12 and np.abs(residual[0, 0] - left).max() < 1e-12


def seen(stokes=(1.0, 0.5, -0.25, 0.125), east=5, north=3):
    return _seen(stokes, east, north, RAD)


def flux_at(cube, east=5, north=3):
    half = cube.data.shape[-1] // 2
    return cube.data[..., half + north, half - east]


@pytest.mark.parametrize(
    "settings",
    [
        {},
        {"terms": 2, "peaks": "joint"},
        *(pytest.param(s, marks=pytest.mark.long) for s in ({"peaks": "joint"}, {"peaks": "I"}, {"terms": 1})),
        pytest.param({"weighting": "uniform"}, marks=pytest.mark.long),
    ],
    ids=str,
)
def test_model_and_restored_image_have_the_fluxes_and_the_residual_has_none(settings):
    made = CleanImager(**SIZE, cycles=6, **settings).imaged(seen())
    due = np.array([1.0, 0.5, -0.25, 0.125])
    for cube in (made.cube, made.beside["model"]):
        assert np.abs(flux_at(cube) - due).max() < 1e-4
    assert made.beside["model"].unit == "Jy/pixel"
    assert np.abs(made.beside["residual"].data).max() < 1e-4
    # the restored image is the Gaussian of the PSF and nothing else
    assert np.abs(made.cube.data[0, 0, 0]).max() < 1e-4


def test_polarization_without_stokes_i_is_found():
    made = CleanImager(**SIZE, cycles=6, peaks="joint").imaged(seen((0.0, 0.5, -0.25, 0.0)))
    assert np.abs(flux_at(made.cube) - [0, 0.5, -0.25, 0]).max() < 1e-4
    each = CleanImager(**SIZE, cycles=6).imaged(seen((0.0, 0.5, -0.25, 0.0)))
    assert np.abs(flux_at(each.cube) - [0, 0.5, -0.25, 0]).max() < 1e-4
    nothing = CleanImager(**SIZE, peaks="I").imaged(seen((0.0, 0.5, -0.25, 0.0)))
    assert not nothing.beside["model"].data.any()


def test_components_stay_in_the_mask():
    mask = np.zeros((32, 32), bool)
    mask[:16] = True  # the source is in the other half
    made = CleanImager(**SIZE, mask=mask).imaged(seen())
    assert not made.beside["model"].data[..., 16:, :].any()


@pytest.mark.parametrize(
    ("settings", "ended"),
    [
        ({"threshold": 0.05 * u.Jy}, "threshold"),
        ({"iterations": 7}, "iterations"),
        ({"cycles": 1, "sigma": 0}, "cycles"),
        ({"sigma": 4}, "noise"),
    ],
    ids=str,
)
def test_each_stopping_rule_stops_and_is_said(settings, ended):
    data = seen((1.0, 0.0, 0.0, 0.0))
    data = data.with_noise(2e5 * u.Jy, seed=1) if "sigma" in settings else data
    made = CleanImager(**SIZE, **settings).imaged(data)
    (first, *_) = [e for e in made.record["clean"] if e["stokes"] == "I"]
    assert first["ended"] == ended
    if ended == "iterations":
        assert first["components"] == 7
        flux = made.beside["model"].data[0, 0].sum()
        assert abs(flux - (1 - 0.9**7)) < 1e-6  # all on one pixel, where the PSF is 1
    if ended == "threshold":
        assert first["peak_jy"] <= 0.05


def test_a_gain_above_1_is_refused_and_so_are_masks_and_scales_that_do_not_fit():
    for settings, said in (
        ({"gain": 2}, "a gain of 2 must be above 0 and at most 1"),
        ({"mask": np.ones((4, 4), bool)}, "mask has shape"),
        ({"mask": np.zeros((32, 32), bool)}, "false everywhere"),
        ({"scales": (0 * u.deg, 1 * u.deg)}, "multiscale"),
        ({"scales": (50 * u.deg,), "algorithm": "multiscale"}, "wider than the images"),
    ):
        with pytest.raises(InputError, match=said) as error:
            CleanImager(**SIZE, **settings)
        assert "\n" not in str(error.value)


def test_an_all_negative_sky_ends_with_a_reason():
    data = seen((1.0, 0.0, 0.0, 0.0))
    negative = data.with_data(-data.data)
    made = CleanImager(**SIZE, cycles=6).imaged(negative)
    assert np.abs(flux_at(made.cube)[:, 0] + 1).max() < 1e-4
    mask = np.zeros((32, 32), bool)
    mask[19, 11] = True
    none = CleanImager(**SIZE, negative=False, mask=mask).imaged(negative)
    assert not none.beside["model"].data.any()
    assert none.record["clean"][0]["ended"] == "nothing above 0"


def test_one_visibility_is_left_dirty_and_said():
    data = seen()
    flag = np.ones(data.data.shape[:3], bool)
    flag[0, :, 5] = False
    with pytest.warns(InstrumentWarning, match="nothing is cleaned there"):
        made = CleanImager(**SIZE).imaged(data.flagged(flag))
    assert np.array_equal(made.cube.data, Imager(**SIZE).image(data.flagged(flag)).data)
    assert made.record["clean"] == []


def test_a_stokes_parameter_or_channel_without_weight_is_nan_and_spoils_no_other():
    data = seen()
    flag = np.zeros(data.data.shape, bool)
    flag[:, 1, ..., 0, 1] = True  # U and V of the second channel
    found = CleanImager(**SIZE, cycles=6).imaged(data.with_data(np.where(flag, np.nan, data.data)).flagged(flag))
    whole = CleanImager(**SIZE, cycles=6).imaged(data)
    assert np.isnan(found.cube.data[1, 2:]).all() and np.isfinite(found.cube.data[1, :2]).all()
    assert np.abs(found.cube.data[0] - whole.cube.data[0]).max() < 1e-6
    assert np.abs(found.cube.data[1, :2] - whole.cube.data[1, :2]).max() < 1e-6
    for settings in ({}, {"terms": 1}):
        gone = CleanImager(**SIZE, cycles=6, **settings).imaged(data.flagged(np.array([False, True])[None, :, None]))
        assert np.isnan(gone.cube.data[1]).all()
        assert np.abs(flux_at(gone.cube)[0] - [1, 0.5, -0.25, 0.125]).max() < 1e-4


def test_a_spectral_fit_is_the_weighted_least_squares_polynomial():
    freq, weight = np.array([1.0, 2.0, 4.0, 5.0]) * 1e8, np.array([1.0, 0.0, 2.0, 3.0])
    values = 3 - 0.5 * freq / 1e8
    values[1] = 77  # without weight
    assert np.abs(spectral_fit(freq, weight, 2) @ values - (3 - 0.5 * freq / 1e8)).max() < 1e-12
    noisy = np.array([1.0, 9.0, 2.0, 5.0])
    due = np.polynomial.Polynomial.fit(freq, noisy, 1, w=np.sqrt(weight))(freq)
    assert np.abs(spectral_fit(freq, weight, 2) @ noisy - due).max() < 1e-12


def test_dynamic_range_of_1e8_is_reached_where_accuracy_is_asked_for():
    bright, faint = seen((1e8, 0.0, 0.0, 0.0)), seen((1.0, 0.0, 0.0, 0.0), -6, -4)
    both = replace(bright, data=bright.data + faint.data)
    made = CleanImager(**SIZE, accuracy=1e-12, cycles=20, threshold=1e-3 * u.Jy).imaged(both)
    assert np.abs(flux_at(made.cube, -6, -4)[:, 0] - 1).max() < 1e-3
    assert np.abs(flux_at(made.cube)[:, 0] - 1e8).max() < 1e-3


def test_what_holds_nothing_is_refused_and_one_time_or_baseline_is_said():
    data = seen()
    with pytest.raises(InputError, match="no visibility lies within"):
        CleanImager(**SIZE).image(data.flagged(np.ones((1, 1, 1), bool)))
    with pytest.raises(InputError, match="no visibility lies within"):
        CleanImager(**SIZE, uv_range=(1e5, 2e5)).image(data)
    with pytest.raises(InputError, match="must be even"):
        CleanImager(pixels=31, pixel=PIXEL)
    with pytest.raises(InputError, match="go over the visibilities twice"):
        CleanImager(**SIZE).image(iter([data]))
    flag = np.ones(data.data.shape[:3], bool)
    flag[:, :, 5] = False
    with pytest.warns(InstrumentWarning, match="nothing is cleaned there"):
        assert np.isfinite(CleanImager(**SIZE).image(data.flagged(flag)).data).all()


@pytest.mark.parametrize("terms", [2, pytest.param(4, marks=pytest.mark.long)])
def test_joined_channels_find_a_spectrum_that_is_a_polynomial_in_frequency(terms):
    """Four channels whose PSFs differ by a third, fluxes on a line: two terms are enough."""
    layout = small_array(16, spread=90.0)
    freq = (120.0, 135.0, 150.0, 160.0)
    grid = ImageGrid.of((64, 64), 4e-3, Direction(2.15, 0.84))
    ra, dec = grid.at(np.array([40.0, 20.0]), np.array([25.0, 44.0]))
    sky = PointSky(
        names=("a", "b"), ra_rad=ra, dec_rad=dec, stokes_jy=[[2, 0.2, 0, 0], [1, 0, 0, 0]],
        reference_hz=[150e6, 150e6], spectral_terms=[[-1.5], [0.5]], logarithmic=[False, False],
    )  # fmt: skip
    data = observed(layout, sky, 8, freq, interval=3000.0)
    due = sky.stokes(np.array(freq) * 1e6)
    imager = CleanImager(pixels=64, pixel=4e-3 * u.rad, terms=terms, cycles=8)
    found = imager.imaged(data).beside["model"].data[:, :, [40, 20], [25, 44]]
    assert np.abs(np.moveaxis(found, 1, 2) - due).max() < 2e-3
    one = imager.with_fields(terms=1).imaged(data)
    spread = np.ptp(one.beside["model"].data[:, 0, 40, 25])
    # the peak of a PSF is 1 to the accuracy of the gridding
    assert spread < 1e-6 and np.abs(one.beside["residual"].data[0, 0]).max() > 0.1


@pytest.mark.long
def test_a_scene_that_cleans_writes_model_and_residual_and_says_how_it_ended(tmp_path):
    stations = [f"CS{k:03d}HBA0" for k in range(2, 8)] + ["CS302HBA1"]
    words = [
        f"instrument.stations={stations}", "observation.duration='60 min'", "observation.interval='20 min'",
        "sky.shape=[3, 3]", "image.kind='clean'", "image.pixels=64", "image.pixel='1 arcmin'",
        "image.uv_range=[1, 900]", "image.threshold='0.5 Jy'", "image.cycles=3",
    ]  # fmt: skip
    tables = override(read_tables("mock-grid"), words)
    run(parse(tables), tables, out=str(tmp_path / "out"), verify=False)
    cube, model, residual = (read_cube(tmp_path / "out" / f"{n}.fits") for n in ("cube", "model", "residual"))
    assert model.unit == "Jy/pixel" and residual.unit == cube.unit == "Jy/beam"
    # the restored image is the residual and the model under the beam: elsewhere nothing
    at = np.unravel_index(np.argmax(model.data[0, 0]), (64, 64))
    assert cube.data[0, 0][at] - residual.data[0, 0][at] >= 0.999 * model.data[0, 0][at] > 0
    said = json.loads((tmp_path / "out" / "run.json").read_text())["image"]
    assert {end["stokes"] for end in said["clean"]} == {"I", "QU", "V"}
    assert all(end["ended"] for end in said["clean"]) and set(said["solid_angle_sr"]) == {"fit", "sum"}
    with pytest.raises(InputError, match=r"\[image\] .*gain of 3"):
        parse(override(tables, ["image.gain=3.0"]))


def test_a_mask_of_its_own_grows_with_the_cycles_and_keeps_noise_out_of_the_model():
    """A source that is at first below 5 sigma of the sidelobes of another is in the mask later; noise never is."""
    both = seen((1.0, 0.0, 0.0, 0.0))
    both = both.with_data(both.data + 0.1 * seen((1.0, 0.0, 0.0, 0.0), -6, -4).data).with_noise(1e4 * u.Jy, seed=1)
    made = CleanImager(**SIZE, cycles=8, auto_mask=5, sigma=1).imaged(both)
    said = made.record["clean"][0]
    model = made.beside["model"].data[0, 0]
    assert flux_at(made.cube)[0, 0] == pytest.approx(1, abs=6 * said["noise_jy"])
    assert flux_at(made.cube, -6, -4)[0, 0] == pytest.approx(0.1, abs=6 * said["noise_jy"])
    first = CleanImager(**SIZE, threshold=10 * u.Jy, auto_mask=5, sigma=1).imaged(both).record["clean"][0]
    assert 0 < first["mask"] < said["mask"] < 0.15
    assert np.mean(model != 0) <= said["mask"]
    everywhere = CleanImager(**SIZE, cycles=8, sigma=1).imaged(both).beside["model"].data[0, 0]
    assert np.mean(everywhere != 0) > 2 * np.mean(model != 0)
    with pytest.raises(InputError, match="auto_mask = 3 is not above sigma = 3"):
        CleanImager(**SIZE, auto_mask=3)
