"""Beam-corrected images: matrices against the operator, leakage of known sources and of a diffuse sky removed."""

import warnings

import numpy as np
import pytest
from astropy import units as u
from astropy.coordinates import SkyCoord
from astropy.io import fits

import instrument
from instrument import BeamImager, CleanImager, ImageGrid, ImageSky, InputError, Observation, Scene, read_cube
from instrument.cli import main
from instrument.errors import InstrumentWarning, RefusedError
from instrument.image.beam_weights import mueller_weights
from instrument.observe.directions import offset
from instrument.predict.base import EVERY

PIXEL = 8 * u.arcmin
LOFAR = instrument.load("telescopes", "lofar-hba")
SOME = LOFAR.layout().names[:16]
UV = (20.0, 200.0)


def plan_of(sky, duration=6 * u.hour, interval=30 * u.min, stations=SOME, tolerance=0.0, uv_range=UV, **more):
    night = Observation(
        phase_centre="08h13m36.0s +48d13m03s", transit="2012-12-07", duration=duration, interval=interval,
        frequencies=[150] * u.MHz,
    )  # fmt: skip
    telescope = instrument.load("telescopes", "lofar-hba", stations=stations, **more)
    return Scene(instrument=telescope, sky=sky, observation=night).plan(tolerance=tolerance, uv_range=uv_range)


def sources(shape=(3, 3)):
    """Unpolarized sources of 10 Jy, 32 arcmin apart, and where they are among 24 x 24 pixels."""
    at = (np.arange(shape[0]) - shape[0] // 2) * 4 + 12
    mask = np.zeros((24, 24), bool)
    mask[np.ix_(at, at)] = True
    return instrument.load("skies", "grid", shape=shape, spacing=32 * u.arcmin, flux=10 * u.Jy), mask


def polarized(planes):
    return np.hypot(planes[1], planes[2]) / np.abs(planes[0])


def test_matrices_are_those_of_the_operator_and_its_adjoint():
    """To 1e-9: every column of A^H A at a pixel of the image of a point there, in each Stokes parameter."""
    plan = plan_of(sources()[0], stations=SOME[:5])
    grid = ImageGrid(pixels=24, pixel=8 * u.arcmin, centre=plan.problem.at.centre)
    operator = plan.operator(grid, 1e-9)
    weight = np.ones((plan.problem.shape[0], plan.problem.shape[2]))
    found = mueller_weights(operator.problem, grid, weight, 10.0)
    for y, x in ((12, 12), (2, 20)):
        for s in range(4):
            point = np.zeros((1, 4, 24, 24))
            point[0, s, y, x] = 1
            back = operator.adjoint(operator.forward(point, EVERY, EVERY), EVERY, EVERY)[0, :, y, x]
            assert np.abs(back - found.matrices[y, x][:, s]).max() <= 1e-9 * found.matrices.max()
    assert found.usable.all()
    assert 1 <= found.condition.min() < found.condition.max() < 3


def test_the_joint_solution_removes_the_leakage_of_known_sources():
    """99.99 % at every source by an operator of 3e-7 and I to 1e-6, where dividing pixel by pixel leaves a tenth."""
    sky, mask = sources()
    plan = plan_of(sky, stations=SOME[:12], interval=1 * u.hour)
    vis = plan.run()
    operator = plan.operator(ImageGrid(pixels=24, pixel=PIXEL), 3e-7)
    settings = {"pixels": 24, "pixel": PIXEL, "uv_range": UV, "mask": mask, "tolerance": 1e-9}
    before = instrument.Imager(pixels=24, pixel=PIXEL, uv_range=UV).image(vis.without_beam(lofar_of(plan))).data[0]
    found = BeamImager(way="joint", iterations=12, **settings).imaged(vis, operator)
    whole = (found.beside["residual"].data + found.beside["model"].data)[0]
    assert polarized(found.cube.data[0][:, mask]).max() < 1e-4 * np.median(polarized(before[:, mask]))
    assert np.abs(found.beside["residual"].data).max() < 1e-6
    assert polarized(whole[:, mask]).max() < 1e-4 * np.median(polarized(before[:, mask]))
    assert np.abs(whole[0, mask] / 10 - 1).max() < 1e-6
    assert found.record["beam"][0]["left_of_data"] < 1e-6
    # data without the beam towards the centre are the same data
    again = BeamImager(way="joint", iterations=12, **settings).imaged(vis.without_beam(lofar_of(plan)), operator)
    np.testing.assert_allclose(again.cube.data, found.cube.data, atol=1e-9)


def lofar_of(plan):
    return instrument.load("telescopes", "lofar-hba", stations=plan.problem.at.layout.names)


def test_leakage_of_a_diffuse_sky_is_predicted_and_taken_out():
    """A tenth of it is left after 16 iterations; the division by matrices takes away less than half."""
    rng = np.random.default_rng(1)
    k = np.hypot(*np.meshgrid(np.fft.fftfreq(24), np.fft.fftfreq(24)))
    k[0, 0] = k[0, 1]
    images = np.zeros((1, 4, 24, 24))
    for s in (1, 2):
        images[0, s] = np.fft.ifft2(np.fft.fft2(rng.normal(size=(24, 24))) * k**-1.35).real
    plan = plan_of(ImageSky(grid=ImageGrid(pixels=24, pixel=PIXEL), stokes=images), tolerance=1e-6)
    vis, operator = plan.run(), plan.operator(ImageGrid(pixels=24, pixel=PIXEL), 1e-5)
    left = {}
    for way in ("normalised", "predict"):
        data = BeamImager(pixels=24, pixel=PIXEL, uv_range=UV, way=way).image(vis, operator).data[0]
        left[way] = data[0, 6:18, 6:18].std() / np.hypot(data[1], data[2])[6:18, 6:18].std()
    data = instrument.Imager(pixels=24, pixel=PIXEL, uv_range=UV).image(vis.without_beam(lofar_of(plan))).data[0]
    before = data[0, 6:18, 6:18].std() / np.hypot(data[1], data[2])[6:18, 6:18].std()
    assert left["predict"] < 0.1 * before
    assert left["normalised"] > 0.5 * before


def test_what_cannot_be_undone_is_masked_or_refused():
    sky, _ = sources()
    plan = plan_of(sky, stations=SOME[:6], interval=2 * u.hour)
    vis, operator = plan.run(), plan.operator(ImageGrid(pixels=24, pixel=PIXEL), 1e-4)
    imager = BeamImager(pixels=24, pixel=PIXEL, uv_range=UV)
    strict = imager.with_fields(amplification=1.5).image(vis, operator)
    assert np.isnan(strict.data[0, :, 0, 0]).all()
    assert np.isfinite(strict.data[0, :, 12, 12]).all()
    with pytest.raises(RefusedError, match="has all four correlations with a weight above 0"):
        imager.image(vis.flagged(np.ones(vis.data.shape[:3], bool)), operator)
    with pytest.raises(InputError, match="needs mask"):
        imager.with_fields(way="joint").image(vis, operator)
    with pytest.raises(InputError, match="the operator is of images of 24 x 24 pixels"):
        imager.with_fields(pixels=32).image(vis, operator)
    with pytest.raises(InputError, match="not the times and channels"):
        imager.image(vis.block(slice(0, 2), slice(0, 1)), operator)


def test_maps_of_noise_and_condition_are_those_of_the_matrices_and_say_where_data_end(tmp_path):
    """Noise is the root of the diagonal of the inverse of differential matrices; NaN is what is above the limit."""
    plan = plan_of(sources()[0], stations=SOME[:6], interval=2 * u.hour)
    vis, operator = plan.run(), plan.operator(ImageGrid(pixels=24, pixel=PIXEL), 1e-4)
    made = BeamImager(pixels=24, pixel=PIXEL, uv_range=UV, amplification=1.5).imaged(vis, operator)
    noise, condition = made.maps["amplification"].data, made.maps["condition"].data
    assert (noise.shape, condition.shape) == ((1, 4, 24, 24), (1, 1, 24, 24))
    beyond = (noise > 1.5).any(axis=1)
    assert 0 < beyond.mean() < 1
    assert np.array_equal(beyond, np.isnan(made.cube.data).any(axis=1))
    y, x = np.array([12, 3]), np.array([12, 18])
    length = np.hypot(vis.uvw_m[..., 0], vis.uvw_m[..., 1]) * vis.freq_hz[0] / 299792458
    weight = (length > UV[0]) & (length < UV[1])
    lofar, names, due = lofar_of(plan), plan.problem.at.layout.names, np.zeros((2, 4, 4))
    at = SkyCoord(*offset(made.cube.centre, made.cube.grid.east[x], made.cube.grid.north[y]), unit="rad")
    for b, pair in enumerate(zip(vis.antenna1, vis.antenna2, strict=True)):
        seen = lofar.mueller(
            at, vis.times, [150] * u.MHz, made.cube.centre.skycoord, tuple(names[p] for p in pair), "differential"
        )
        due += np.einsum("t,tfsji,tfsjk->sik", weight[:, b], seen.conj(), seen).real
    np.testing.assert_allclose(condition[0, 0, y, x], np.linalg.cond(due), rtol=1e-4)
    here, there = np.sqrt(np.diagonal(np.linalg.inv(due), axis1=1, axis2=2))
    np.testing.assert_allclose(noise[0, :, 3, 18] / noise[0, :, 12, 12], there / here, rtol=1e-4)
    made.maps["amplification"].write(tmp_path / "amplification.fits")
    with fits.open(tmp_path / "amplification.fits") as found:
        assert np.array_equal(found[0].data, noise) and found[0].header["BUNIT"] == ""
        assert found[0].header["CRVAL1"] == pytest.approx(np.rad2deg(made.cube.centre.ra_rad))


def test_a_run_writes_the_maps_and_shows_them(tmp_path):
    settings = ["instrument.stations=['CS001HBA0','CS002HBA0','CS003HBA1','CS004HBA0','CS005HBA1','CS006HBA0']"]
    settings += ["observation.interval='2 h'", "sky.shape=[3,3]", "image.pixels=24", "image.pixel='10 arcmin'"]
    settings += ["image.tolerance=1e-3", "image.amplification=1.5", "image.way='normalised'", "image.uv_range=[20,200]"]
    words = [w for one in settings for w in ("--set", one)]
    assert main(["run", "aw-correction", "--out", str(tmp_path / "out"), *words]) == 0
    for name in ("amplification", "condition"):
        with fits.open(tmp_path / "out" / f"{name}.fits") as found:
            assert np.isfinite(found[0].data).all()
    page = (tmp_path / "out" / "report.html").read_text()
    blank = np.isnan(read_cube(tmp_path / "out" / "cube.fits").data[0, 0]).mean()
    assert f"{blank:.0%} of the pixels have none" in page
    assert (tmp_path / "out" / "maps.png").is_file()
    assert ">How each channel ended (beam)<" in page and ">without data<" in page


def test_sources_between_pixels_are_said():
    sky = instrument.load("skies", "grid", shape=(2, 2), spacing=32 * u.arcmin, flux=10 * u.Jy)
    centre = plan_of(sky, stations=SOME[:3], interval=2 * u.hour).problem.at.centre
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert BeamImager(pixels=24, pixel=8 * u.arcmin, way="joint").for_sky(sky.about(centre), centre).mask.sum() == 4
    with pytest.warns(
        InstrumentWarning, match="4 of 4 sources lie beside the centre of their pixel, by up to 0.57 pix"
    ):
        BeamImager(pixels=24, pixel=10 * u.arcmin, way="joint").for_sky(sky.about(centre), centre)


def test_a_wrong_beam_leaves_leakage_in_proportion():
    """The operator knows the beam without its error: nothing is left without one, 10 times as much of 10 times it."""
    sky, mask = sources()
    imager = BeamImager(
        way="joint", pixels=24, pixel=8 * u.arcmin, uv_range=UV, mask=mask, tolerance=1e-7, iterations=20
    )
    plans = {
        rms: plan_of(sky, stations=SOME[:6], interval=2 * u.hour, terms=[instrument.BeamError(rms=rms, seed=1)])
        for rms in (0.1, 0.01, 0.0)
    }
    operator = plans[0.1].operator(ImageGrid(pixels=24, pixel=8 * u.arcmin), 1e-5)
    left = {}
    for rms, plan in plans.items():
        planes = imager.imaged(plan.run(), operator).beside["model"].data[0]
        left[rms] = np.sqrt((polarized(planes[:, mask]) ** 2).mean())
    assert left[0.1] > 3e-5
    assert left[0.0] < 1e-6
    assert left[0.1] == pytest.approx(10 * left[0.01], rel=0.01)


def test_an_operator_of_fewer_visibilities_than_the_imager_takes_is_refused():
    """They would be 0 in it, and all of them taken for a sky that the model lacks."""
    sky, mask = sources()
    plan = plan_of(sky, stations=SOME[:6], interval=2 * u.hour)
    vis, operator = plan.run(), plan.operator(ImageGrid(pixels=24, pixel=PIXEL), 1e-4)
    for imager in (BeamImager(pixels=24, pixel=PIXEL), CleanImager(pixels=24, pixel=PIXEL)):
        with pytest.raises(InputError, match="the operator is of 20 to 200 wavelengths, and the imager takes all base"):
            imager.image(vis, operator)
    corrected = vis.without_beam(lofar_of(plan))
    with pytest.raises(InputError, match="have had a beam taken out"):
        CleanImager(pixels=24, pixel=PIXEL, uv_range=UV).image(corrected, operator)
    with pytest.raises(InputError, match="somewhere within the beam"):
        BeamImager(pixels=24, pixel=PIXEL, uv_range=UV, way="joint", mask=~mask & mask).image(vis, operator)


def test_an_operator_of_all_baselines_does_no_more_than_the_imager_takes():
    """The images of an operator prepared for the range, to both tolerances; it works on fewer samples."""
    sky, _ = sources()
    whole = plan_of(sky)
    free = plan_of(sky, uv_range=None)
    grid = ImageGrid(pixels=24, pixel=PIXEL)
    every, some = free.operator(grid, 1e-5), whole.operator(grid, 1e-5)
    assert every.within(None) is every
    assert some.within(UV) is some
    assert every.within(UV).problem.uv_range == UV
    assert every.within(UV).work().flops < every.work().flops
    one, other = (
        BeamImager(pixels=24, pixel=PIXEL, uv_range=UV).image(plan.run(), operator).data
        for plan, operator in ((free, every), (whole, some))
    )
    assert np.abs(one - other).max() <= 2e-5 * np.abs(other).max()


def test_a_channel_without_visibilities_is_nan_and_the_others_are_not_lost():
    night = Observation(
        phase_centre="08h13m36.0s +48d13m03s", transit="2012-12-07", duration=4 * u.hour, interval=2 * u.hour,
        frequencies=[150, 151] * u.MHz,
    )  # fmt: skip
    telescope = instrument.load("telescopes", "lofar-hba", stations=SOME[:6])
    plan = Scene(instrument=telescope, sky=sources()[0], observation=night).plan()
    vis, operator = plan.run(), plan.operator(ImageGrid(pixels=24, pixel=PIXEL), 1e-4)
    flag = np.zeros(vis.data.shape[:3], bool)
    flag[:, 1] = True
    found = BeamImager(pixels=24, pixel=PIXEL, way="predict", iterations=2).image(vis.flagged(flag), operator).data
    assert np.isnan(found[1]).all()
    assert np.isfinite(found[0]).all()
