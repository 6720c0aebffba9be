"""The plan: what is left out is provably nothing, its bound holds, its memory is a promise, any executor runs it."""

import re
import tracemalloc
from concurrent.futures import ProcessPoolExecutor
from dataclasses import replace

import numpy as np
import pytest
from astropy import units as u
from astropy.coordinates import SkyCoord
from instrument_plugins.elements.dipole import CrossedDipole

import instrument
from instrument import (
    Chain,
    Composed,
    ElementBeam,
    GainTerm,
    InputError,
    Observation,
    Parallactic,
    PointSky,
    Scene,
)
from instrument.errors import RefusedError
from instrument.predict.direct import Direct

CENTRE = SkyCoord("08h13m36.0s +48d13m03s")
STATIONS = ["CS001HBA0", "CS003HBA1", "CS302HBA1", "RS106HBA", "RS406HBA", "RS508HBA"]


def scene(sky=None, stations=STATIONS, duration=8, interval=30, frequencies=(150,), **settings):
    sky = sky or instrument.load("skies", "random", count=40, radius=4 * u.deg, polarization=0.2, seed=2)
    observation = Observation(
        phase_centre=CENTRE, transit="2012-12-07", duration=duration * u.hour, interval=interval * u.min,
        frequencies=frequencies * u.MHz, channel_width=0.19 * u.MHz,
    )  # fmt: skip
    named = {"stations": stations} if stations else {}  # all 59 without
    lofar = instrument.load("telescopes", "lofar-hba", **named, **settings)
    return Scene(name="test", instrument=lofar, sky=sky, observation=observation)


def names(items):
    return [i.name for i in items]


def everything(plan):
    """The visibilities of the scene as it was given, from the definition."""
    return Direct().sums(plan.full)


def test_terms_that_are_the_identity_are_left_out_and_others_kept():
    plan = scene().plan()
    assert names(plan.left_out)[:2] == ["GainTerm", "FeedTerm"]
    assert all(i.bound == 0 for i in plan.left_out)
    assert names(scene(gain=GainTerm(rms=1e-3, seed=1)).plan().kept)[0] == "GainTerm"
    assert "2x2 algebra" in names(scene(beam=None).plan().left_out)


def test_exact_omissions_change_nothing():
    far = SkyCoord([CENTRE, CENTRE.spherical_offsets_by(2 * u.deg, 0 * u.deg), SkyCoord("12h00m -75d00m"), CENTRE])
    flux = np.array([[2.0, 0, 0, 0], [1, 0, 0, 0], [50, 0, 0, 0], [0, 0, 0, 0]])
    plan = scene(PointSky.at(far, flux)).plan()
    assert "below the antenna planes throughout" in [i.reason for i in plan.left_out]
    assert "no flux" in [i.reason for i in plan.left_out]
    assert "Q, U, V of the sky" in names(plan.left_out)
    assert plan.problem.at.shape[3] == 2
    assert np.abs(plan.run().data - everything(plan)).max() <= plan.error_bound * plan.scale_jy
    # without a beam there is no horizon: the source below it stays
    assert scene(PointSky.at(far, flux), beam=None).plan().problem.at.shape[3] == 3


@pytest.mark.parametrize("tolerance", [1e-1, 1e-2, 1e-3, 1e-4, 1e-6, 1e-9])
def test_tolerance_is_honoured(tolerance):
    rng = np.random.default_rng(5)
    count = 60
    where = CENTRE.spherical_offsets_by(rng.uniform(-3, 3, count) * u.deg, rng.uniform(-3, 3, count) * u.deg)
    flux = np.concatenate([10.0 ** rng.uniform(-9, 0, count)])[:, None] * np.array([1, 0.3, 0.2, 0.1])
    made = scene(PointSky.at(where, flux), gain=GainTerm(rms=0.3, seed=4))
    plan = made.plan(tolerance=tolerance)
    error = np.abs(plan.run().data - everything(plan)).max() / plan.scale_jy
    assert error <= plan.error_bound <= tolerance
    if tolerance > 1e-9:
        assert any("faint" in name for name in names(plan.left_out))
        assert plan.problem.at.shape[3] < count
    check = plan.verify(samples=24, seed=1)
    assert check.passed
    assert check.bound == plan.error_bound


def test_a_tolerance_that_float64_cannot_keep_is_refused_with_the_floor():
    with pytest.raises(RefusedError, match=r"tolerance = 1e-15 is below what float64 can promise here, \S+: give that"):
        scene().plan(tolerance=1e-15)
    floor = scene().plan().error_bound
    assert scene().plan(tolerance=1.01 * floor).error_bound <= 1.01 * floor


def test_a_plan_says_what_a_decade_more_would_cost():
    said = str(scene().plan(tolerance=1e-5))
    assert re.search(r"^a decade more tolerance 1e-06 would take \S+ times as long$", said, re.MULTILINE)
    assert "decade" not in str(scene().plan())
    floor = scene().plan().error_bound
    assert "no decade more: float64 promises" in str(scene().plan(tolerance=2 * floor))


def test_verify_finds_a_wrong_engine():
    plan = scene().plan()
    wrong = replace(
        plan, problem=replace(plan.problem, at=replace(plan.problem.at, freq_hz=plan.problem.at.freq_hz * 1.0000001))
    )
    assert plan.verify().passed
    assert not wrong.verify().passed
    assert "ABOVE" in str(wrong.verify())


def test_baselines_outside_the_uv_range_are_left_out():
    made = scene(stations=["CS001HBA0", "CS003HBA1", "CS302HBA1", "RS508HBA"])
    whole, cut = made.plan(), made.plan(uv_range=(30, 800))
    assert 0 < len(cut.problem.antenna1) < len(whole.problem.antenna1)
    kept = list(zip(cut.problem.antenna1, cut.problem.antenna2, strict=True))
    pick = [k for k, ab in enumerate(zip(whole.problem.antenna1, whole.problem.antenna2, strict=True)) if ab in kept]
    assert np.abs(cut.run().data - whole.run().data[:, :, pick]).max() < 1e-12 * whole.scale_jy
    assert cut.verify(samples=4).passed
    with pytest.raises(InputError, match="no baseline ever lies within"):
        made.plan(uv_range=(1e7, 2e7))


@pytest.mark.parametrize(
    ("stations", "count", "settings", "frequencies"),
    [
        ((), 225, {}, (150,)),
        ((), 60, {"beam": None}, (150, 151)),
        (STATIONS, 2000, {"gain": GainTerm(rms=0.1, seed=1)}, (120, 150)),
        ((), 40, {"tiles": "ideal"}, tuple(range(120, 150))),
    ],
)
def test_peak_memory_is_below_1_2_times_the_plan(stations, count, settings, frequencies):
    """All numpy memory while the blocks stream by; what is planned must also not be idle talk (above a quarter)."""
    sky = instrument.load("skies", "random", count=count, radius=4 * u.deg, seed=2)
    plan = scene(sky, stations=stations, interval=0.5, duration=6, frequencies=frequencies, **settings).plan()
    assert len(plan.slices) > 4
    for _ in plan.engine.sums(plan.problem.block(slice(0, 1), slice(0, 1))):
        pass  # compiled and imported
    few = replace(plan, problem=plan.problem.block(slice(0, 6 * plan.block_shape[0]), slice(None)))
    tracemalloc.start()
    for _ in few.blocks():
        pass
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert peak <= 1.2 * plan.memory
    assert peak >= 0.25 * plan.memory


def test_memory_does_not_grow_with_the_length_of_the_observation():
    short, long = (scene(stations=(), duration=d, interval=0.25, frequencies=(150,)).plan() for d in (2, 8))
    assert long.memory == short.memory
    assert len(long.slices) == pytest.approx(4 * len(short.slices), rel=0.1)


def test_too_little_memory_is_refused_with_the_ways_out():
    made = scene(stations=())
    with pytest.raises(RefusedError, match="fewer sources"):
        made.plan(memory="100 kB")
    small = made.plan(memory="8 MB")
    assert small.memory <= 8e6
    with pytest.raises(RefusedError, match=r"plan\.blocks\(\)"):
        small.run()
    assert sum(block.data.shape[0] for block in small.blocks()) == 16


def test_any_executor_gives_the_same_blocks():
    plan = scene(frequencies=(140, 150)).plan()
    small = replace(plan, block_shape=(4, 1))
    done = []
    with ProcessPoolExecutor(2) as pool:
        elsewhere = small.run(executor=pool, progress=done.append)
    assert np.abs(elsewhere.data - plan.run().data).max() <= 1e-15 * plan.scale_jy
    assert done == sorted(done)
    assert done[-1] == 1.0


def test_the_cheapest_engine_is_chosen_and_can_be_named():
    made = scene()
    assert made.plan().engine_name == "matrix"
    assert made.plan(engine="direct").engine_name == "direct"
    with pytest.raises(InputError, match="no engine is called 'matrx': did you mean 'matrix'"):
        made.plan(engine="matrx")


def test_work_counts_the_products_that_structure_and_sky_need():
    """8 A^2 S operations per product: 1 for scalars, 2 for diagonals, 3 with a Hermitian sky and one shared beam."""
    at = CENTRE.spherical_offsets_by(np.arange(3) * u.deg, 0 * u.deg)
    unit = 8 * 36 * 3 * 16
    beams = 40 * 6 * 3 * 16  # phases of the stations
    plain = PointSky.at(at, [1.0, 1, 1])
    assert scene(plain, beam=None).plan().work.flops == pytest.approx(unit + beams + 600 * 48)
    q = PointSky.at(at, np.array([[1, 0.5, 0, 0.0]] * 3))
    assert scene(q, beam=None).plan().work.flops == pytest.approx(2 * unit + beams + 600 * 48)
    u_too = PointSky.at(at, np.array([[1, 0.5, 0.1, 0.0]] * 3))
    assert scene(u_too, beam=None).plan().work.flops == pytest.approx(3 * unit + beams + 600 * 48)


@pytest.mark.parametrize(("faint", "stays"), [(1, True), (3, False)])
def test_a_few_faint_sources_stay_for_they_cost_nothing(faint, stays):
    """One of 201 is all of the error where it is left out, and half a percent of the time where it is not."""
    rng = np.random.default_rng(5)
    count = 200 + faint
    where = CENTRE.spherical_offsets_by(rng.uniform(-3, 3, count) * u.deg, rng.uniform(-3, 3, count) * u.deg)
    flux = np.where(np.arange(count) < faint, 1e-5, 1.0)[:, None] * np.array([1, 0, 0, 0])
    plan = scene(PointSky.at(where, flux)).plan(tolerance=1e-4)
    assert any("faint" in name for name in names(plan.left_out)) != stays
    assert plan.problem.at.shape[3] == (count if stays else 200)


def test_smearing_is_that_of_the_baselines_in_the_uv_range():
    made = scene(PointSky.at(CENTRE, [[1.0, 0, 0, 0]]))
    whole, inner = (str(made.plan(uv_range=limits)) for limits in (None, (0, 5000)))
    assert "on the longest baseline; a prediction loses none" in whole
    assert "on the longest of these baselines; a prediction loses none" in inner


def test_plan_prints_what_a_user_must_know():
    text = str(scene(gain=GainTerm(rms=1e-3, seed=1)).plan(tolerance=1e-5))
    for word in ("6 stations", "15 baselines", "16 times", "1 channel", "40 directions", "tolerance 1e-05",
                 "kept          GainTerm", "Hamaker shared by 4+1+1 stations", "left out      FeedTerm", "identity",
                 "not modelled  smearing", "engine        matrix", "peak", "bound"):  # fmt: skip
        assert word in text


def test_impossible_scenes_are_refused_before_anything_runs():
    with pytest.raises(InputError, match="never rises"):
        Scene(
            instrument=instrument.load("telescopes", "lofar-hba", stations=STATIONS),
            sky=PointSky.at(CENTRE, [1.0]),
            observation=Observation(
                phase_centre=SkyCoord("00h -80d"),
                start="2012-12-07T00:00:00",
                duration=1 * u.hour,
                interval=10 * u.min,
                frequencies=[150] * u.MHz,
            ),
        ).plan()
    with pytest.raises(InputError, match="empty"):
        PointSky(names=(), ra_rad=[], dec_rad=[], stokes_jy=np.zeros((0, 4)))
    with pytest.raises(InputError, match="no flux"):
        scene(PointSky.at(CENTRE, [0.0])).plan()
    with pytest.raises(InputError, match="source 's0' is not finite"):
        PointSky.at(CENTRE, [np.nan])


def test_a_beam_without_a_known_peak_is_named_in_the_bound_and_its_faint_sources_stay():
    class Own(ElementBeam):
        def jones(self, at):
            return 3.0 * CrossedDipole(height=0.5 * u.m).jones(at)

    lofar = instrument.load("telescopes", "lofar-hba", stations=STATIONS)
    own = Composed(stations=lofar.layout(), terms=Chain(Own(), Parallactic()))
    plan = scene().with_fields(instrument=own).plan(tolerance=1e-2)
    assert "float64 sums where Own stays below 1" in str(plan)
    assert not any("faint" in name for name in names(plan.left_out))
    known = Composed(stations=lofar.layout(), terms=Chain(GainTerm(rms=0.1, seed=1), CrossedDipole(height=0.5 * u.m)))
    assert names(scene().with_fields(instrument=known).plan().bounds) == ["float64 sums"]


def test_the_seam_at_the_zenith_that_a_plan_prints_is_the_same_at_any_small_distance():
    """Axes of stations are orthogonal to 1e-10: at 1e-9 rad from the zenith 0.06 was printed for 0.004."""
    at = scene().plan().full.at
    x, y, z = at.earth.matrices[0].T @ at.layout.axes[3, 2]
    overhead = SkyCoord(np.arctan2(y, x) * u.rad, np.arcsin(z) * u.rad)
    plan = scene(PointSky.at(SkyCoord([CENTRE, overhead]), [1.0, 1.0])).plan()
    (text,) = (i.reason for i in plan.not_modelled if i.name == "zenith")
    said = float(re.search(r"by (\S+),", text)[1])
    element = next(t for t in plan.full.chain.parts if isinstance(t, ElementBeam))
    at, angle = plan.full.at.block(slice(0, 1), slice(None)), 2 * np.pi * np.arange(24) / 24
    turn = np.moveaxis(np.array([[np.cos(angle), np.sin(angle)], [-np.sin(angle), np.cos(angle)]]), -1, 0)
    for beside in (1e-3, 1e-4, 1e-5):
        local = np.stack([beside * np.cos(angle), beside * np.sin(angle), np.ones(24)], axis=1)
        around = replace(at.towards(np.zeros(24), np.zeros(24)), seen=(local @ at.layout.axes[3])[None])
        ground = element.jones(around)[0, 0, 3] @ turn
        found = np.abs(ground - ground[:1]).max() / np.abs(ground[0]).max()
        assert said == pytest.approx(found, rel=0.05) and found < element.zenith_seam
