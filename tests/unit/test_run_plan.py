"""The plan of a whole run: seconds and bytes of every stage, the peak of the process, memory that binds, the speed."""

import json
import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

from instrument import InputError, machine
from instrument.errors import RefusedError
from instrument.pipeline.planning import plan_run
from instrument.pipeline.record import costs
from instrument.pipeline.run import run
from instrument.pipeline.scene_file import parse
from instrument.pipeline.scene_text import override, read_tables
from instrument.pipeline.stage import Stage
from instrument.pipeline.work import Items, RunPlan, StageWork
from instrument.plan import Item
from instrument.registry import plugin_class

SMALL = ["observation.duration=600 s", "observation.interval=60 s", "sky.shape=[3,3]", "image.pixels=64"]
SMALL += ['instrument.stations=["CS001HBA0","CS003HBA1","CS302HBA1","RS106HBA"]']


@pytest.fixture(autouse=True)
def own_cache(tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    machine.speed.cache_clear()
    yield
    machine.speed.cache_clear()


def planned(scene="mock-grid", *settings, memory=None):
    file = parse(override(read_tables(scene), [*settings]))
    return plan_run(file, file.scene(), memory)


# What is added up ------------------------------------------------------------------------------------------------


def rises(works, base=100.0, before=100.0):
    return RunPlan(None, works, {}, base, before, 1.0)


def test_the_peak_is_that_of_blocks_and_of_all_that_is_held_or_that_of_a_finish():
    works = {
        "predict": StageWork(block_bytes=50),
        "a": StageWork(held_bytes=20, block_bytes=30, result_bytes=5),
        "b": StageWork(held_bytes=7, finish_bytes=200, result_bytes=60),
        "write": StageWork(finish_bytes=40),
    }
    plan = rises(works)
    # blocks: 100 + 50 + 20 + 30, then 7 more held; finish of b: 100 + 5 + 7 + 200
    assert plan.growth == {"predict": 50, "a": 50, "b": 112, "write": 0}
    assert plan.memory == 312
    assert rises(works, before=400.0).memory == 400


def test_seconds_go_with_the_speed_of_the_machine():
    works = {"predict": StageWork(seconds=6), "write": StageWork(finish_seconds=2)}
    plan = RunPlan(None, works, {}, 0.0, 0.0, 2.0)
    assert plan.seconds == {"predict": 3.0, "write": 1.0}
    assert plan.share() == 0.75 and plan.share("write") == 0.25


def test_what_was_measured_stands_beside_what_was_planned():
    plan = rises({"predict": StageWork(seconds=3, block_bytes=10)})
    found = costs({"plan": 0.5, "predict": 4.0}, {"predict": 12.0}, plan)
    assert found["stages"]["predict"] == {
        "seconds": {"planned": 3.0, "measured": 4.0},
        "memory": {"planned_bytes": 10.0, "measured_bytes": 12.0},
    }
    assert found["stages"]["plan"]["seconds"]["planned"] is None
    assert found["seconds"] == {"planned": 3.0, "measured": 4.0}
    assert found["memory"]["planned_bytes"] == 110.0 and found["memory"]["measured_bytes"] > 1e7


# What is said ----------------------------------------------------------------------------------------------------


class Costly(Stage):
    """Costs 40 s and 3 MB, and leaves something out."""

    def work(self, run):
        return StageWork("counts", seconds=40.0, held_bytes=3e6, wrong="1e-3 of the count")

    def items(self, run):
        return Items(left_out=(Item("odd ones", "nobody asks", 2e-3),))

    def start(self, run):
        raise NotImplementedError


def test_a_stage_of_anyone_puts_its_cost_and_what_it_leaves_out_into_the_plan(monkeypatch):
    monkeypatch.setattr(
        "instrument.pipeline.scene_file.plugin_class",
        lambda kind, name, **k: Costly if name == "image" else plugin_class(kind, name, **k),
    )
    tables = {key: v for key, v in override(read_tables("mock-grid"), SMALL).items() if key != "analyze"}
    file = parse({**tables, "image": {}})
    monkeypatch.setattr(machine, "measured", lambda: 2.0)
    text = str(plan_run(file, file.scene()))
    assert re.search(r"left out +image: odd ones +nobody asks +error 0.002", text)
    assert re.search(r"stage +image +counts; about 20 s, 3 MB; 1e-3 of the count", text)


@pytest.mark.parametrize("scene", ["mock-grid", "di-errors", "faraday-leakage", "many-directions"])
def test_the_plan_of_every_shipped_scene_has_a_line_for_every_stage_and_the_sum(scene):
    plan = planned(scene)
    text = str(plan)
    for name in plan.works:
        assert re.search(rf"^stage +{name} .*about .* (s|min), ", text, re.M), name
        assert name in ("write", "verify") or plan.works[name].does, name
    whole = re.search(r"^whole run +about (.+), peak (.+) of memory, (.+) of them the interpreter's$", text, re.M)
    assert whole
    assert plan.memory >= plan.base_bytes + plan.plan.memory * ("predict" in plan.works)


def test_a_check_that_is_not_made_is_not_planned():
    file = parse(override(read_tables("mock-grid"), SMALL))
    assert "verify" not in plan_run(file, file.scene(), verify=False).works


def test_weights_that_need_a_density_cost_another_pass_and_its_plane():
    natural, briggs = (
        planned("mock-grid", *SMALL, f"image.weighting='{w}'").works["image"] for w in ("natural", "briggs")
    )
    assert briggs.held_bytes - natural.held_bytes == 8 * 64**2 and briggs.seconds > natural.seconds


def test_leakage_of_a_sky_that_is_no_list_is_refused_by_the_plan(monkeypatch):
    monkeypatch.setattr("instrument.pipeline.stages.leakage.points_of", lambda sky: None)
    with pytest.raises(InputError, match=r"\[analyze\] products = \['leakage'\] needs a sky that is a list of sources"):
        planned("mock-grid", *SMALL)


def test_items_say_which_visibilities_no_image_takes():
    assert re.search(r"left out +image: visibilities +\d+% outside uv_range", str(planned("mock-grid", *SMALL)))


# Memory binds the whole ------------------------------------------------------------------------------------------


def test_with_less_memory_blocks_are_smaller_and_the_whole_fits():
    free, tight = planned("mock-grid"), None
    limit = free.memory - 60e6
    tight = planned("mock-grid", memory=f"{limit:.0f} byte")
    assert tight.memory <= limit and len(tight.plan.slices) > len(free.plan.slices)


def test_what_can_never_fit_is_refused_by_its_largest_stage_before_anything_is_done(tmp_path):
    with pytest.raises(
        RefusedError, match=r"interpreter's, and may take 100 MB \(--memory '100 MB'\); most is of"
    ) as e:
        planned("mock-grid", *SMALL, memory="100 MB")
    assert "\n" not in str(e.value)
    with pytest.raises(RefusedError, match=r"most is of image, .* 8192 x 8192 .*: lower image.pixels"):
        planned("mock-grid", "image.pixels=8192", "image.pixel=2 arcsec", memory="4 GB")
    with pytest.raises(InputError, match="memory"):
        planned("mock-grid", *SMALL, memory="4 apples")


def test_results_with_less_memory_are_the_same(tmp_path, monkeypatch):
    # this process has had other tests, and the page of so small a run would be the most of it
    monkeypatch.setattr("instrument.pipeline.planning.high_water", lambda: 0.0)
    monkeypatch.setattr("instrument.pipeline.planning.PAGE_BYTES", 0.0)
    monkeypatch.setattr("instrument.pipeline.planning.resident", lambda: 2e8)
    tables = override(read_tables("mock-grid"), [*SMALL, "observation.interval=5 s"])
    free = run(parse(tables), tables, out=str(tmp_path / "a"))
    limit = free.whole.memory - 0.5 * free.whole.plan.memory
    tight = run(parse(tables), tables, out=str(tmp_path / "b"), memory=f"{limit:.0f} byte")
    assert len(tight.plan.slices) > len(free.plan.slices)
    one, other = (r.stages["analyze"].parts[0].fluxes.stokes_jy for r in (free, tight))
    assert other == pytest.approx(one, rel=1e-12, abs=1e-12)


# Real processes --------------------------------------------------------------------------------------------------


# a process that has little: on Linux the peak of a child begins with what its parent has, here that of many tests
LEAN = """
import os, subprocess, sys
child = subprocess.Popen(sys.argv[1:], stdout=subprocess.DEVNULL)
_, status, usage = os.wait4(child.pid, 0)
print(usage.ru_maxrss)
sys.exit(os.waitstatus_to_exitcode(status))
"""


def process(tmp_path, scene, *settings):
    """A run in a process of its own: its record, and the peak that the system tells."""
    words = [sys.executable, "-m", "instrument.cli", "run", scene, "--out", str(tmp_path / "out")]
    words += [word for setting in settings for word in ("--set", setting)]
    done = subprocess.run([sys.executable, "-c", LEAN, *words], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    record = json.loads(Path(tmp_path, "out", "run.json").read_text())
    return record, int(done.stdout) * (1 if sys.platform == "darwin" else 1024)


def test_a_small_run_takes_what_its_plan_says(tmp_path):
    record, peak = process(tmp_path, "mock-grid", *SMALL)
    assert 0.5 <= peak / record["memory"]["planned_bytes"] <= 1.2
    assert record["memory"]["measured_bytes"] == pytest.approx(peak, rel=0.02)
    assert set(record["stages"]) >= {"plan", "predict", "correct", "image", "analyze", "verify", "write"}
    for step in record["stages"].values():
        assert set(step) == {"seconds", "memory"}
        assert set(step["seconds"]) == {"planned", "measured"}
        assert set(step["memory"]) == {"planned_bytes", "measured_bytes"}


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    """Runs of whole shipped scenes, each made once."""
    made = {}

    def of(scene):
        if scene not in made:
            made[scene] = process(tmp_path_factory.mktemp(scene), scene)
        return made[scene]

    return of


SHIPPED = ["mock-grid", "di-errors", "faraday-leakage", "incomplete-model", "many-directions", "3c196"]


@pytest.mark.long
@pytest.mark.parametrize("scene", SHIPPED)
def test_every_shipped_scene_takes_what_its_plan_says_and_at_most_a_gigabyte(whole, scene):
    record, peak = whole(scene)
    assert 0.5 <= peak / record["memory"]["planned_bytes"] <= 1.2

    assert peak <= 1e9


@pytest.mark.long
@pytest.mark.parametrize(("scene", "quarter"), [("faraday-leakage", "80 min")])
def test_a_run_that_is_four_times_longer_takes_no_more_memory(tmp_path, whole, scene, quarter):
    _, short = process(tmp_path, scene, f"observation.interval={quarter}")
    # solutions, and what fluxes keep of every integration, are 2 to 20 MB
    assert whole(scene)[1] <= 1.1 * short


# The machine -----------------------------------------------------------------------------------------------------


def test_the_speed_is_measured_once_and_kept(monkeypatch):
    calls = []
    monkeypatch.setattr(machine, "measured", lambda: calls.append(1) or 1.7)
    assert machine.speed() == 1.7
    machine.speed.cache_clear()
    assert machine.speed() == 1.7 and calls == [1]
    assert json.loads(machine.kept_in().read_text())["speed"] == 1.7


@pytest.mark.parametrize("text", ["", "nonsense", "[]", '{"of": 3}', '{"of": null, "speed": "x"}', "x" * 20_000])
def test_a_damaged_or_foreign_file_of_the_speed_is_measured_again(monkeypatch, text):
    machine.kept_in().parent.mkdir(parents=True)
    machine.kept_in().write_text(text)
    monkeypatch.setattr(machine, "measured", lambda: 0.6)
    assert machine.speed() == 0.6
    assert json.loads(machine.kept_in().read_text())["speed"] == 0.6


def test_without_a_place_to_keep_it_the_speed_is_measured_all_the_same(monkeypatch, tmp_path):
    (tmp_path / "file").write_text("")
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "file"))
    monkeypatch.setattr(machine, "measured", lambda: 0.9)
    assert machine.speed() == 0.9


def test_a_speed_is_near_that_of_the_last_measurement():
    assert 0.2 < machine.measured() / machine.measured() < 5


@pytest.mark.parametrize("spoil", [os.mkfifo, lambda path: (path.touch(), os.truncate(path, 1 << 40))])
def test_a_pipe_or_a_file_without_end_in_the_place_of_the_speed_holds_nothing_up(monkeypatch, spoil):
    monkeypatch.setattr(machine, "measured", lambda: 0.6)
    path = machine.kept_in()
    path.parent.mkdir(parents=True)
    spoil(path)
    # whoever opens the pipe to read waits for a writer: never, so this stops the test instead
    monkeypatch.setattr(Path, "read_text", lambda *a, **k: pytest.fail("read whole, without a look at what it is"))
    assert machine.speed() == 0.6
    assert json.loads(path.read_bytes())["speed"] == 0.6


def test_as_many_figures_are_planned_as_a_cube_is_given(tmp_path):
    """Day and night forms count as one; what a page takes is most of the time of a small run."""
    tables = override(read_tables("galactic-quick"), [
        "observation.frequency.channels=4", "observation.duration=20 min", "observation.interval=10 min",
        "instrument.stations=['CS001HBA0', 'CS002HBA0', 'CS003HBA0', 'CS004HBA0']", "sky.pixels=32", "image.pixels=32",
        "analyze.cube={products=['cylindrical', 'spherical', 'faraday', 'spectrum-2d'], depths=[-5, 5, 1], bins=4}",
    ])  # fmt: skip
    result = run(parse(tables), tables, out=str(tmp_path / "r"), verify=False)
    made = [p.name for p in (tmp_path / "r").glob("*.png")]
    assert result.whole.works["write"].does == f"tables, page, {len(made)} figures", made
