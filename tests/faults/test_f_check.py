"""The check looks at what was produced: every station and baseline, times and channels evenly, blocks as they pass."""

import json
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from astropy import units as u
from astropy.coordinates import SkyCoord

import instrument
from instrument import Composed, GainTerm, InputError, Layout, Observation, PointSky, Scene
from instrument.check import Checker, definition
from instrument.conformance.bench import problems
from instrument.predict.direct import Direct

REPORTS = Path(__file__).resolve().parents[2] / "docs" / "reports"
CENTRE = SkyCoord("08h13m36.0s +48d13m03s")
STATIONS = ["CS001HBA0", "CS003HBA1", "CS302HBA1", "RS106HBA", "RS406HBA"]


@pytest.fixture(scope="module")
def sabotage():
    sys.path.insert(0, str(REPORTS))
    import sabotage

    yield sabotage
    sys.path.remove(str(REPORTS))


@pytest.fixture(scope="module")
def plan():
    lofar = instrument.load("telescopes", "lofar-hba", stations=STATIONS, gain=GainTerm(rms=0.1, seed=1))
    night = Observation(
        phase_centre=CENTRE, transit="2012-12-07", duration=2 * u.hour, interval=10 * u.min,
        frequencies=[140, 150, 160, 170] * u.MHz, channel_width=0.19 * u.MHz,
    )  # fmt: skip
    sky = instrument.load("skies", "random", count=12, radius=4 * u.deg, polarization=0.2, seed=2)
    return Scene(name="check", instrument=lofar, sky=sky, observation=night).plan(engine="matrix", workers=1)


@pytest.mark.parametrize("name", list(problems()))
def test_the_definition_by_stations_is_that_of_direct(name, monkeypatch):
    problem = problems()[name]
    back = problem.between(problem.antenna2[::2], problem.antenna1[::2])
    for room in (250_000, 20):  # the second cuts sources and baselines into pieces
        monkeypatch.setattr("instrument.check.ROOM", room)
        for whole in (problem, back):
            cell = whole.block(slice(1, 2), slice(2, 3))
            due = Direct().sums(cell)[0, 0]
            assert np.abs(definition(cell) - due).max() <= 1e-11 * np.abs(due).max()


@pytest.mark.parametrize("kind", ["station", "baseline"])
def test_f6_one_flipped_station_or_baseline_is_found_wherever_it_is(plan, sabotage, kind):
    vis = plan.run()
    assert plan.verify(vis).passed
    count = {"station": len(STATIONS), "baseline": plan.problem.shape[2]}[kind]
    for k in range(count):
        check = plan.verify(sabotage.flipped(vis, kind, k, plan), seed=k)
        assert not check.passed
        assert check.stations == (5, 5)
        assert check.baselines == (10, 10)
        assert "ABOVE" in str(check)


@pytest.mark.parametrize("kind", ["time", "channel"])
def test_f6_a_flipped_time_or_channel_is_found_in_proportion_to_the_share_that_is_printed(plan, sabotage, kind):
    vis = plan.run()
    times, channels, _ = plan.problem.shape
    for k in range({"time": times, "channel": channels}[kind]):
        spoilt = sabotage.flipped(vis, kind, k, plan)
        found = 0
        for seed in range(12):
            check = plan.verify(spoilt, samples=30, seed=seed)
            assert check.times.seen == check.channels.seen == 3  # 30 visibilities are 3 cells of 10 baselines
            found += not check.passed
        share = 3 / times if kind == "time" else 3 / channels
        assert abs(found - 12 * share) <= 4 * np.sqrt(12 * share * (1 - share))
    assert "times 3 of 12, channels 3 of 4, all 5 stations, all 10 baselines" in str(plan.verify(vis, samples=30))


def test_f6_times_and_channels_come_once_before_any_comes_twice(plan):
    times, channels, baselines = plan.problem.shape
    for count in (1, 4, 5, 12, 13, 48, 10**9):
        cells = list(plan.watched(samples=count * baselines, seed=3).checker.chosen())
        count = min(count, times * channels)
        assert len(set(cells)) == len(cells) == count
        for axis, size in ((0, times), (1, channels)):
            often = np.bincount([c[axis] for c in cells], minlength=size)
            assert often.max() - often.min() <= 1
    other = list(plan.watched(samples=50, seed=4).checker.chosen())
    assert other != list(plan.watched(samples=50, seed=3).checker.chosen())


def test_f6_as_many_cells_as_four_per_cent_of_the_planned_time_buys(plan):
    slow = replace(plan, seconds=3600.0)
    assert len(list(slow.watched().checker.chosen())) == 48
    from instrument.check import cell_seconds

    middle = replace(plan, seconds=20.5 * cell_seconds(plan.full) / 0.04)
    assert len(list(middle.watched().checker.chosen())) == 20


def test_f6_a_run_checks_its_blocks_as_they_pass(plan):
    """The engine is not run again, and what is looked at is what the stages get."""
    small = replace(plan, block_shape=(5, 3))
    watched = small.watched(samples=10**6)
    total = sum(block.data.sum() for block in watched.blocks())
    assert total == pytest.approx(plan.run().data.sum(), rel=1e-12)
    assert watched.check.passed
    assert watched.check.samples == plan.problem.shape[0] * plan.problem.shape[1] * plan.problem.shape[2]
    assert "all 12 times, all 4 channels" in str(watched.check)
    vis = plan.run()
    spoilt = vis.data.copy()
    spoilt[7, 2, 4, 1, 0] += 1e-6
    check = plan.verify(vis.with_data(spoilt), samples=10**6)
    assert not check.passed
    assert "CS003HBA1-CS302HBA1, time 7 and channel 2" in str(check)
    assert check.error == pytest.approx(1e-6 / plan.scale_jy, rel=1e-6)


def test_f6_blocks_of_any_order_and_half_the_baselines_are_checked(plan):
    vis = plan.run()
    turned = replace(
        vis, data=vis.data[::-1, ::-1, ::2], at=replace(
            vis.at, earth=vis.at.earth[::-1], slots_s=vis.at.slots_s[::-1], freq_hz=vis.at.freq_hz[::-1]
        ), antenna1=vis.antenna1[::2], antenna2=vis.antenna2[::2],
    )  # fmt: skip
    check = plan.verify([turned], samples=10**6)
    assert check.passed
    assert check.baselines == (5, 10)
    assert "baselines 5 of 10" in str(check)


def test_f6_a_nan_is_the_worst_error_of_all(plan):
    vis = plan.run()
    data = vis.data.copy()
    data[3, 1, 2, 0, 0] = np.nan
    assert not plan.verify(vis.with_data(data), samples=10**6).passed
    flag = np.zeros(vis.data.shape[:3], bool)
    flag[3, 1, 2] = True
    assert plan.verify(vis.with_data(data).flagged(flag), samples=10**6).passed


@pytest.mark.parametrize("samples", [np.inf, np.nan, 0, -1, "2", 2.5, True, None])
def test_f6_samples_are_counted(plan, samples):
    with pytest.raises(InputError, match=r"^samples = .* must be (a whole number|at least 1)"):
        plan.verify(samples=samples)


@pytest.mark.parametrize("seed", [np.inf, np.nan, -1, "2", True, None])
def test_f6_a_seed_is_a_seed(plan, seed):
    with pytest.raises(InputError, match=r"^seed = .* must be (a whole number|at least 0)"):
        plan.verify(seed=seed)


def test_f6_data_of_another_scene_are_refused_in_one_line(plan):
    vis = plan.run()
    later = replace(vis, at=replace(vis.at, slots_s=vis.at.slots_s + 86400))
    with pytest.raises(InputError, match="is not in the plan"):
        plan.verify(later)
    with pytest.raises(InputError, match="other stations"):
        plan.verify(replace(vis, at=replace(vis.at, layout=vis.layout.select(vis.layout.names[::-1]))))
    with pytest.raises(InputError, match="had a beam taken out"):
        plan.verify(vis.without_beam(instrument.load("telescopes", "lofar-hba", stations=STATIONS)))
    with pytest.raises(InputError, match="give Visibilities"):
        plan.verify([vis.data])
    assert str(plan.verify([])).startswith("not checked: ")
    assert not plan.verify([]).passed


def test_f8_who_takes_blocks_keeps_the_threads_of_blas(plan):
    """The limit of one thread holds inside the workers only: with one worker nothing is in flight at a yield."""
    import scipy.linalg  # brings a BLAS of its own, which is to be there from the start
    from threadpoolctl import threadpool_info, threadpool_limits

    assert scipy.linalg

    inside = []

    class Looks(type(plan.engine)):
        def sums(self, problem):
            inside.append(blas())
            return super().sums(problem)

    def blas():
        return [i["num_threads"] for i in threadpool_info() if i["user_api"] == "blas"]

    with threadpool_limits(2, user_api="blas"):
        before = blas()
        seen = [blas() for _ in replace(plan, block_shape=(3, 4), engine=Looks()).blocks()]
        assert seen == [before] * 4
        assert blas() == before
    assert {n for each in inside for n in each} == {1}


def test_f14_direct_is_not_checked_against_itself_and_says_so(plan):
    whole = replace(plan, problem=plan.full, engine=Direct(), engine_name="direct")
    check = whole.verify()
    assert "the engine is direct, the definition itself" in str(check)
    assert check.error > 0  # another order of sums
    assert check.passed
    assert "itself" not in str(plan.verify())


def test_f14_a_check_that_was_not_made_is_not_held(tmp_path):
    from instrument.check import not_checked
    from instrument.report.run_page import page_of_run

    check = not_checked("nobody looked", 1e-12, 1.0)
    assert not check.passed
    assert not check.made
    record = {"name": "x", "checks": {"prediction": {
        "error": None, "bound": 1e-12, "samples": 0, "relative_to_jy": 1.0, "passed": None, "text": str(check),
    }}}  # fmt: skip
    page = str(page_of_run(record))
    assert "held" not in page
    assert "not checked" in page


def test_f6_a_run_writes_what_share_was_seen(tmp_path, monkeypatch):
    from instrument.cli import main

    monkeypatch.chdir(tmp_path)
    (tmp_path / "tiny.toml").write_text(
        """
name = "tiny"
[instrument]
telescope = "lofar-hba"
stations = ["CS001HBA0", "CS003HBA1", "CS302HBA1"]
[observation]
phase_centre = "08h13m36.0s +48d13m03s"
transit = "2012-12-07"
duration = "1 h"
interval = "10 min"
frequency = { centre = "150 MHz", width = "0.19 MHz", channels = 2 }
[sky]
kind = "grid"
shape = [2, 2]
spacing = "1 deg"
flux = "1 Jy"
""",
        encoding="utf-8",
    )
    assert main(["run", "tiny.toml", "--out", "out"]) == 0
    found = json.loads((tmp_path / "out" / "run.json").read_text())["checks"]["prediction"]
    assert found["passed"] is True
    assert found["seen"] == {"times": [6, 6], "channels": [2, 2], "stations": [3, 3], "baselines": [3, 3]}
    assert "all 3 baselines" in found["text"]
    assert "verify" in json.loads((tmp_path / "out" / "run.json").read_text())["stages"]


def test_f6_any_time_is_looked_at_as_often_as_the_share_that_is_printed(plan):
    times = plan.problem.shape[0]
    share = len(plan.watched(samples=1, seed=0).checker.cells) / times
    assert 0 < share < 0.7
    rng, cases = np.random.default_rng(3), 1000
    hits = sum(int(rng.integers(times)) in plan.watched(samples=1, seed=s).checker.cells for s in range(cases))
    assert abs(hits - cases * share) <= 4 * np.sqrt(cases * share * (1 - share))


@pytest.mark.long
def test_f6_sabotage_of_59_stations(sabotage):
    plan = sabotage.scene(48, 16).plan(memory="8 GB")
    found, looked, check, _, _ = sabotage.hunt(plan, 20, np.random.default_rng(1))
    assert found == looked  # what was looked at is found, always
    assert found["station"] == found["baseline"] == 20
    for kind, seen in (("time", check.times), ("channel", check.channels)):
        share, cases = seen.seen / seen.of, 20 * sabotage.TIMES[kind]
        assert abs(found[kind] - cases * share) <= 4 * np.sqrt(cases * share * (1 - share)) + 0.5


# A6, A7: what is not modelled ---------------------------------------------------------------------------------------


def extended(width, **settings):
    """A Gaussian 1.5 deg off the pointing of a gaussian dish of 3.8 deg."""
    from instrument_plugins.elements.dish import Gaussian

    from instrument import Chain, Parallactic

    layout = Layout.from_enu(
        ["a", "b", "c"], np.array([[0, 0, 0], [0.5, 0, 0], [0, 40, 0]]) * u.m, longitude=6.9 * u.deg,
        latitude=52.9 * u.deg, height=0 * u.m,
    )  # fmt: skip
    where = CENTRE.directional_offset_by(30 * u.deg, 1.5 * u.deg).reshape(1)
    shape = {k: np.deg2rad([width]) for k in ("major_rad", "minor_rad")} if width else {}
    night = Observation(
        phase_centre=CENTRE, transit="2012-12-07", duration=20 * u.s, interval=10 * u.s, frequencies=[150] * u.MHz,
    )  # fmt: skip
    beam = Chain(Gaussian(fwhm=3.8 * u.deg), Parallactic())
    made = Scene(
        instrument=Composed(stations=layout, terms=beam), sky=PointSky.at(where, [1.0], **shape), observation=night
    )
    return made.plan(**settings)


def sampled(width):
    """The same source as 61 x 61 points: the truth, on all baselines."""
    plan = extended(width)
    sky = plan.full.sky
    from instrument.observe.directions import offset
    from instrument.units import Direction

    grid = np.linspace(-4, 4, 61) * np.deg2rad(width) / np.sqrt(8 * np.log(2))
    x, y = (a.ravel() for a in np.meshgrid(grid, grid))
    weight = np.exp(-4 * np.log(2) * (x**2 + y**2) / np.deg2rad(width) ** 2)
    ra, dec = offset(Direction(sky.ra_rad[0], sky.dec_rad[0]), x, y)
    many = PointSky.at(SkyCoord(ra * u.rad, dec * u.rad), weight / weight.sum())
    return Direct().sums(replace(plan.full, sky=many, at=plan.full.at.towards(*many.directions())))


def test_a6_the_beam_across_an_extended_source_is_in_the_bound_with_its_size():
    plan = extended(0.5)
    error = np.abs(plan.run().data - sampled(0.5)).max()
    assert 1e-3 < error <= plan.error_bound <= 10 * error
    assert plan.verify().bound == plan.sum_bound < 1e-9  # the sums are held to their own bound
    assert "not modelled  1 extended source" in str(plan)
    assert f"{plan.error_bound:.1e} of the total flux" in str(plan)
    small = extended(0.005)
    assert small.error_bound == pytest.approx(plan.error_bound / 100, rel=0.3)
    assert extended(0).not_modelled == extended(0).not_modelled[:1]


def test_a6_a_tolerance_that_an_extended_source_breaks_is_said():
    with pytest.warns(instrument.InstrumentWarning, match="not kept by what is not modelled .*extended source"):
        plan = extended(0.5, tolerance=1e-3)
    assert "ABOVE the tolerance" in str(plan)


@pytest.mark.parametrize("beam", [None, "array-factor"])
def test_a7_a_source_below_a_horizon_that_no_term_knows_is_a_line_of_the_plan(beam):
    below = SkyCoord("20h13m36s -10d00m00s")  # 20 deg below the horizon and lower, all the time
    sky = PointSky.at(SkyCoord([CENTRE, below]), [1.0, 50.0])
    night = Observation(
        phase_centre=CENTRE, transit="2012-12-07", duration=1 * u.hour, interval=10 * u.min, frequencies=[150] * u.MHz
    )
    lofar = instrument.load("telescopes", "lofar-hba", stations=STATIONS, beam=beam)
    text = str(Scene(instrument=lofar, sky=sky, observation=night).plan())
    assert "not modelled  horizon" in text
    assert "1 direction (50 Jy) below it, 1 throughout, seen in full" in text
    full = instrument.load("telescopes", "lofar-hba", stations=STATIONS)
    assert "horizon " not in str(Scene(instrument=full, sky=sky, observation=night).plan())
    up = sky.select([0])
    assert "horizon" not in str(Scene(instrument=lofar, sky=up, observation=night).plan())


def test_checker_is_a_plain_object(plan):
    assert isinstance(plan.watched().checker, Checker)
    assert plan.checker is None
    assert "nobody looked" in str(plan.check)
