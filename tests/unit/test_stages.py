"""Stages: one table of a scene file each, in declared order, ours and a stranger's by the same door."""

import json
import re
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from astropy import units as u
from astropy.table import QTable

from instrument import InputError, Stage, StokesCube
from instrument.analyze.sources.photometry import ForcedPhotometry
from instrument.pipeline.run import run
from instrument.pipeline.scene_file import parse
from instrument.pipeline.scene_text import override, read_tables
from instrument.pipeline.stage import in_order
from instrument.pipeline.stages.leaked import Leaked

PAGE = Path(__file__).parents[2] / "docs" / "extending.md"
SMALL = [
    "instrument.stations=['CS001HBA0', 'CS003HBA1', 'CS302HBA1', 'RS106HBA']",
    "observation.duration='40 min'", "observation.interval='10 min'", "sky.shape=[3, 3]", "image.pixels=64",
]  # fmt: skip


def small(*settings):
    return override(read_tables("mock-grid"), [*SMALL, *settings])


def test_a_stage_of_a_stranger_works_from_a_scene_file_in_the_plan_and_in_the_report(package, command, tmp_path):
    site = package({"stages": {"flagged": "Limited"}})
    words = [w for s in (*SMALL, "flagged.most=0.2") for w in ("--set", s)]
    done = command(site, "run", "mock-grid", *words, "--out", "out")
    assert done.returncode == 0, done.stderr
    assert re.search(r"kept +stages +correct, flagged, image, analyze, in this order", done.stdout)
    assert "flagged       at most 0 % of a station" in done.stdout
    record = json.loads((tmp_path / "out" / "run.json").read_text())
    assert record["flagged"] == dict.fromkeys(["CS001HBA0", "CS003HBA1", "CS302HBA1", "RS106HBA"], 0.0)
    assert record["scene"]["flagged"] == {"most": 0.2} and record["stages"]["flagged"]["seconds"]["measured"] >= 0
    page = (tmp_path / "out" / "report.html").read_text()
    assert "<td>flagged</td>" in re.sub(r"<td[^>]*><span>(.*?)</span></td>", r"<td>\1</td>", page)
    wrong = command(site, "run", "mock-grid", *words, "--set", "flagged.mots=1")
    assert wrong.returncode == 2 and wrong.stderr.count("\n") == 1
    assert "[flagged] Limited has no 'mots': did you mean 'most'" in wrong.stderr
    assert "flagged" in command(site, "plugins").stdout


def test_what_a_run_finds_is_what_the_same_steps_find_by_hand_to_the_last_bit(tmp_path):
    tables = small("noise.sefd='2820 Jy'", "seed=5")
    found = run(parse(tables), tables, out=str(tmp_path / "out"), verify=False)
    file = parse(tables)
    scene = file.scene()
    plan = file.plan(scene)
    sums = ForcedPhotometry().start(plan.problem.sky)
    for block in plan.blocks():
        sums.add(block.with_noise(2820 * u.Jy, seed=5003).without_beam(scene.instrument))
    fluxes = sums.finish()
    assert np.array_equal(found.stages["analyze"].parts[0].fluxes.stokes_jy, fluxes.stokes_jy)
    table = QTable.read(tmp_path / "out" / "leakage.ecsv")
    assert np.array_equal(table["I"].value, fluxes.stokes_jy[0, :, 0])


class Late(Stage):
    after = ("early", "not there")

    def start(self, run):
        raise NotImplementedError


class Early(Late):
    after = ()


class Round(Late):
    after = ("late",)


def test_stages_come_after_those_that_they_name():
    assert list(in_order({"a": Late(), "early": Early(), "late": Late(), "z": Round()})) == ["early", "a", "late", "z"]
    with pytest.raises(InputError, match="each come after another of them"):
        in_order({"early": Round(), "late": Late()})


@pytest.mark.parametrize(
    ("settings", "line"),
    [
        (["imgae={}"], r"a scene has no 'imgae': did you mean 'image'"),
        (["noise=3"], r"'noise' must be a table, \[noise\]"),
        (["calibrate.kind='selfcla'"], r"\[calibrate\] kind = 'selfcla': did you mean 'selfcal'"),
        (["calibrate={}"], r"\[calibrate\] needs 'kind': .*incomplete-model.*many-directions"),
        (["analyze.products='leakage'"], r"\[analyze\] products = 'leakage' must be a list"),
        (["observation.frequency='150 MHz'"], r"observation: frequency = '150 MHz' must be a table"),
        (["image.pixles=3"], r"\[image\] Imager has no 'pixles': did you mean 'pixels'"),
        (["analyze.products=['spectrum-2d']", "image=0"], r"'image' must be a table"),
    ],
)
def test_a_wrong_table_is_one_line_that_names_it(settings, line):
    with pytest.raises(InputError, match=line) as error:
        parse(small(*settings))
    assert "\n" not in str(error.value)


def test_products_of_images_ask_for_the_table_image():
    tables = small("analyze.products=['spectrum-2d']")
    del tables["image"]
    with pytest.raises(InputError, match=r"\[analyze\] products = \['spectrum-2d'\] needs images"):
        parse(tables)


def test_a_scene_without_one_of_its_first_tables_is_told_which():
    tables = small()
    del tables["sky"]
    with pytest.raises(InputError, match=r"a scene needs a table \[sky\]"):
        parse(tables)


def test_products_of_many_channels_are_refused_by_the_plan_of_one():
    file = parse(small("analyze.cube.products=['spectrum-2d', 'faraday']"))
    with pytest.raises(InputError, match=r"\[analyze.cube\] products = 'faraday': one channel"):
        file.plan(file.scene())


def test_a_plan_says_that_errors_of_receivers_are_put_in_later():
    file = parse(small("calibrate.kind='selfcal'", "instrument.gain={rms=1e-3}"))
    plan = file.plan(file.scene())
    assert ("receivers", "gain: put into the perfect blocks as they pass") in [item[:2] for item in plan.kept]
    assert "GainTerm" not in [item.name for item in plan.left_out]


def test_a_record_never_takes_the_place_of_what_is_there():
    from instrument.pipeline.stage import merge

    record = {"seconds": {"predict": 1.0}, "checks": {"prediction": {"passed": False}}}
    merge(record, {"seconds": 3, "mine": 1, "checks": {"prediction": {"passed": True}}}, "flagged")
    assert record["seconds"] == {"predict": 1.0} and record["flagged.seconds"] == 3 and record["mine"] == 1
    assert record["checks"] == {"prediction": {"passed": False}, "flagged.prediction": {"passed": True}}


def test_what_a_sky_does_not_have_and_images_show_has_leaked():
    """Shares by hand, NaN left out, a channel without data NaN; nothing of a sky that has I, V or no polarization."""
    rng = np.random.default_rng(1)
    data = rng.normal(size=(3, 4, 16, 16)) * np.array([3e-3, 1, 2, 5e-5])[:, None, None]
    data[0, :, 4], data[2] = np.nan, np.nan
    cube = StokesCube(data, [150, 151, 152] * u.MHz, 1 * u.arcmin)

    def of(*there):
        sky = SimpleNamespace(nonzero=lambda freq_hz: there)
        return Leaked.of(SimpleNamespace(sky=sky, at=SimpleNamespace(freq_hz=cube.freq_hz)), cube)

    found = of(False, True, True, False)
    i, q, p, v = np.moveaxis(np.delete(data[0], 4, axis=1), 0, 0)
    due = np.array([i.std(), v.std()]) / np.hypot(q.std(), p.std())
    np.testing.assert_allclose([found.shares["I"][0], found.shares["V"][0]], due, rtol=1e-12)
    assert np.isnan(found.shares["I"][2])
    assert found.cards()[0].value.startswith("0.1") and "of P in V" in found.lines()[0]
    assert set(of(True, True, True, False).shares) == {"V"} and not of(True, True, True, False).cards()
    assert of(False, False, False, False).record() == {} and of(True, True, False, True).lines() == []
