"""Sums of skies, each member by its own engine; the polarized Galaxy at any channel, its peak and its spectrum."""

import pickle
import tracemalloc

import numpy as np
import pytest
from astropy import units as u

import instrument
from instrument import (
    FeedTerm,
    GainTerm,
    ImageGrid,
    ImageSky,
    InputError,
    Observation,
    Scene,
    SumSky,
    conformance,
    polarized_screens,
)
from instrument.pipeline.scene_file import parse
from instrument.predict.choice import Sum
from instrument.sky.galaxy import Galaxy
from instrument.units import Direction

CENTRE = Direction(2.15, 0.84)
NIGHT = Observation(
    phase_centre=CENTRE, transit="2012-12-07", duration=2 * u.hour, interval=1 * u.hour,
    frequencies=[150, 151] * u.MHz, channel_width=0.2 * u.MHz,
)  # fmt: skip
ERRORS = {"gain": GainTerm(rms=0.1, seed=1), "feed": FeedTerm(rms=0.1, seed=2)}
LIGHT = 299792458.0


def lofar(**settings):
    names = ["CS001HBA0", "CS003HBA1", "CS302HBA1", "RS106HBA"]
    return instrument.load("telescopes", "lofar-hba", stations=names, **settings)


def stars(**settings):
    return instrument.load("skies", "random", count=40, radius=3 * u.deg, polarization=0.2, **settings)


def image(pixels=(10, 7), flux=1.0):
    stokes = flux * np.random.default_rng(0).normal(size=(1, 4, *pixels))
    return ImageSky(grid=ImageGrid(pixels=pixels, pixel=20 * u.arcmin), stokes=stokes)


# Sums ------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("tolerance", [0.0, 1e-3])
def test_a_sum_is_the_sum_of_what_its_members_are_alone(tolerance):
    members = {"stars": stars(), "more": stars(seed=4)} | ({} if tolerance else {"image": image()})
    scene = Scene(instrument=lofar(**ERRORS), sky=SumSky(skies=members), observation=NIGHT)
    plan = scene.plan(tolerance=tolerance)
    due = sum(scene.with_fields(sky=sky).plan(engine="direct").run().data for sky in members.values())
    vis = plan.run()
    error = np.abs(vis.data - due).max() / plan.scale_jy
    assert error <= plan.error_bound <= max(tolerance, 1e-9)
    assert plan.verify(vis).passed
    assert plan.engine_name == "sum"
    kept = {item.name: item.reason for item in plan.kept}
    assert kept["stars"].startswith("engine matrix")
    assert kept.get("image", "engine direct").startswith("engine direct")
    whole = scene.plan(engine="direct")
    assert np.abs(whole.run().data - due).max() <= whole.error_bound * whole.scale_jy


def test_every_member_is_within_the_tolerance_of_its_own_flux_and_the_bounds_add_up():
    """A signal of 0.6 Jy beside 700 Jy: what 1e-4 of these are is a tenth of it."""
    bright, faint = stars(flux_min=10 * u.Jy), stars(seed=2, flux_min=0.01 * u.Jy, flux_max=0.02 * u.Jy)
    scene = Scene(instrument=lofar(), sky=SumSky(skies={"bright": bright, "faint": faint}), observation=NIGHT)
    plan = scene.plan(tolerance=1e-4)
    assert not [item for item in plan.left_out if item.name.startswith("faint:") and "faint direction" in item.name]
    assert all(member.ready.bound <= 1e-4 for _, member in plan.ready.ready)
    shares = [member.share for _, member in plan.ready.ready]
    assert sum(shares) == pytest.approx(1, abs=1e-3) and min(shares) < 2e-3
    assert sum(i.bound for i in (*plan.kept, *plan.left_out, *plan.bounds)) == pytest.approx(plan.sum_bound)
    assert plan.sum_bound <= 1e-4
    assert plan.verify().passed
    alone = scene.with_fields(sky=faint).plan(engine="direct")
    rest = scene.with_fields(sky=bright).plan(engine="direct")
    off = plan.run().data - rest.run().data - alone.run().data
    assert np.abs(off).max() <= 1e-4 * rest.scale_jy


def test_a_member_that_gives_nothing_is_left_out_and_a_sum_of_such_refused():
    dark = ImageSky(grid=ImageGrid(pixels=4, pixel=1 * u.deg), stokes=np.zeros((1, 4, 4, 4)))
    scene = Scene(instrument=lofar(), sky=SumSky(skies={"stars": stars(), "dark": dark}), observation=NIGHT)
    plan = scene.plan()
    assert {i.name: i.reason for i in plan.left_out}["dark"] == "no flux, or never above the antenna planes"
    alone = scene.with_fields(sky=stars()).plan()
    assert np.array_equal(plan.run().data, alone.run().data)
    with pytest.raises(InputError, match="nothing of the sky is ever above"):
        scene.with_fields(sky=SumSky(skies={"dark": dark})).plan()


def test_a_sum_is_written_in_a_scene_file_as_tables_and_read_back():
    tables = {
        "name": "sums",
        "instrument": {"telescope": "lofar-hba"},
        "observation": {"phase_centre": "08h13m36.0s +48d13m03s", "transit": "2012-12-07", "duration": "1 h",
                        "interval": "30 min", "frequencies": ["150 MHz"]},
        "sky": {"kind": "sum", "stars": {"kind": "grid", "shape": [3, 3]}, "galaxy": {"kind": "galaxy", "pixels": 64}},
    }  # fmt: skip
    sky = parse(tables).sky_model()
    assert list(sky.skies) == ["stars", "galaxy"] and sky.skies["galaxy"].pixels == 64
    assert SumSky.from_json(sky.to_json()) == sky
    for wrong, said in (
        ({"kind": "sum", "seed": 3}, r"\[sky\] seed = 3: a sum of skies takes tables, \[sky.seed\]"),
        ({"kind": "sum"}, "skies"),
        ({"kind": "sum", "a": {"kind": "gird"}}, "gird.*did you mean 'grid'"),
        ({"kind": "sum", "a": {"shape": [3, 3]}}, "abstract"),
    ):
        with pytest.raises(InputError, match=said) as error:
            parse({**tables, "sky": wrong}).sky_model()
        assert "\n" not in str(error.value)


@pytest.mark.long
def test_the_engine_of_sums_keeps_the_contract_of_engines():
    report = conformance.check(Sum())
    assert report.passed, str(report)


# The Galaxy ------------------------------------------------------------------------------------------------------

SMALL = {"pixels": 96, "pixel": 2 * u.arcmin}


def test_the_galaxy_is_the_cube_of_its_recipe_at_every_channel_alone_and_among_others():
    band = np.linspace(134, 166, 161) * u.MHz
    due = polarized_screens(**SMALL, frequencies=band).sky()
    sky = Galaxy(**SMALL).about(CENTRE)
    some = np.array([134e6, 150.2e6, 166e6])
    found, rows = sky.planes(some), [0, 81, 160]
    assert np.abs(found - due.stokes[rows]).max() < 3e-7 * np.abs(due.stokes).max()
    assert np.array_equal(sky.planes(some[1:2])[0], found[1])
    assert np.array_equal(pickle.loads(pickle.dumps(sky)).planes(some), found)
    assert not found[:, [0, 3]].any() and sky.nonzero(some) == (False, True, True, False)
    between = sky.planes(np.array([150.1e6]))  # a channel that no cube has
    assert 0.5 < np.abs(between).std() / np.abs(found[1]).std() < 2


def test_the_peak_of_the_galaxy_is_5_k_at_1_2():
    """F(phi) by the plain sum over 161 channels, in steps of 0.01 rad/m2 around the peak; Jy are of these K."""
    freq = np.linspace(134e6, 166e6, 161)
    sky = Galaxy(**SMALL, seed=3).about(CENTRE)
    kelvin = np.stack([sky.maker.kelvin(f) for f in freq]).astype(float)
    p, l2 = kelvin[:, 1] + 1j * kelvin[:, 2], (LIGHT / freq) ** 2
    depths = np.concatenate([np.arange(-4, 7, 0.1), np.arange(1.15, 1.25, 0.01)])
    peaks = [np.abs(np.tensordot(np.exp(-2j * d * (l2 - l2.mean())) / 161, p, 1)).max() for d in depths]
    assert depths[np.argmax(peaks)] == pytest.approx(1.2, abs=0.0051)
    assert max(peaks) == pytest.approx(5.0, rel=1e-3)
    jansky = sky.planes(freq[:1])[0] / (2 * 1.380649e-23 * freq[0] ** 2 / LIGHT**2 * np.deg2rad(2 / 60) ** 2 * 1e26)
    np.testing.assert_allclose(jansky, kelvin[0], rtol=1e-6)


def test_noise_of_the_galaxy_is_independent_per_channel_and_masks_hold_nothing_but_it():
    plain = {**SMALL, "discs": 30, "disc": 10 * u.arcmin}
    f = 150e6
    dark, lit = Galaxy(**plain), Galaxy(**plain, noise=0.52 * u.K)
    mask = dark.masked()
    assert 0.05 < mask.mean() < 0.4
    assert not dark.kelvin(f)[:, mask].any() and dark.kelvin(f)[1:3][:, ~mask].all()
    first, second = (lit.kelvin(x) - dark.kelvin(x) for x in (f, 150.2e6))
    assert not first[[0, 3]].any()
    scatter = 1 / np.sqrt(2 * first[1:3].size)
    assert first[1:3].std() == pytest.approx(0.52, rel=5 * scatter)
    assert first[1][mask].std() == pytest.approx(0.52, rel=5 / np.sqrt(2 * mask.sum()))
    flat = [first[1].ravel(), first[2].ravel(), second[1].ravel()]
    assert np.abs(np.corrcoef(flat) - np.eye(3)).max() < 5 / np.sqrt(first[1].size)
    assert np.array_equal(lit.kelvin(f), Galaxy(**plain, noise=0.52 * u.K).kelvin(f))


def test_the_galaxy_is_planned_predicted_and_checked():
    sky = Galaxy(pixels=24, pixel=10 * u.arcmin, screens={"uv_range": (20, 800)})
    plan = Scene(instrument=lofar(), sky=sky, observation=NIGHT).plan()
    vis = plan.run()
    assert plan.verify(vis).passed
    listed = plan.full.sky.planes(NIGHT.freq_hz)
    fixed = ImageSky(grid=plan.full.sky.grid, stokes=listed, frequencies=NIGHT.freq_hz * u.Hz)
    same = Scene(instrument=lofar(), sky=fixed, observation=NIGHT).plan()
    assert np.array_equal(same.run().data, vis.data) and same.scale_jy == pytest.approx(plan.scale_jy, rel=1e-12)
    assert {i.name for i in plan.left_out} >= {"I, V of the sky"}


@pytest.mark.long
def test_the_galaxy_beside_stars_goes_through_the_gridded_engine_within_the_tolerance():
    sky = SumSky(skies={"stars": stars(), "galaxy": Galaxy(**SMALL)})
    scene = Scene(instrument=lofar(), sky=sky, observation=NIGHT.with_fields(interval=2 * u.min))
    plan = scene.plan(tolerance=1e-5)
    assert {i.name: i.reason for i in plan.kept}["galaxy"].startswith("engine gridded")
    check = plan.verify(samples=12)
    assert check.passed and check.bound <= 1e-5


@pytest.mark.long
def test_what_the_galaxy_takes_while_it_is_summed_was_planned():
    """64 x 64 pixels, two channels: no images of all channels, and the fields of ten screens are counted."""
    sky = Galaxy(pixels=64, pixel=3 * u.arcmin, seed=11)
    plan = Scene(instrument=lofar(), sky=sky, observation=NIGHT).plan()
    plan.ready.sums(slice(0, 1), slice(0, 1))  # compiled and imported
    again = Scene(instrument=lofar(), sky=Galaxy(pixels=64, pixel=3 * u.arcmin, seed=12), observation=NIGHT)
    tracemalloc.start()
    try:
        fresh = again.plan()
        (t, f), *_ = fresh.slices
        fresh.ready.sums(t, f)
        peak = tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()
    assert 0.2 * fresh.work.slot_bytes < peak <= 1.2 * fresh.work.slot_bytes


@pytest.mark.parametrize(
    ("given", "said"),
    [
        ({"pixels": 2}, "pixels = 2 must be a whole number of at least 4"),
        ({"pixels": 16, "screens": {"uv_range": (30, 200)}}, "16 pixels have no cell within uv_range"),
        ({"band": (166 * u.MHz, 134 * u.MHz)}, "give the first channel and the last"),
        ({"noise": -1 * u.K}, "noise = -1 K must be at least 0 K"),
        ({"noise": 3}, "noise needs a unit convertible to K"),
        ({"pixels": 32768}, "lower its pixels"),
    ],
)
def test_an_impossible_galaxy_is_refused(given, said):
    with pytest.raises(instrument.InstrumentError, match=said) as error:
        Galaxy(**given)
    assert "\n" not in str(error.value)
