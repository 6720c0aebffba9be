"""A package of somebody else with all kinds of plugins, one file and its entry points, works from a scene file."""

import json
import re

from instrument.registry import KINDS

POINTS = {
    "telescopes": {"ring": "Ring"},
    "elements": {"cosine": "Cosine"},
    "terms": {"cable": "Cable"},
    "skies": {"circle": "Circle"},
    "engines": {"products": "Products"},
    "calibrators": {"alternating": "Alternating"},
    "imagers": {"summed": "Summed"},
    "foregrounds": {"flat-leakage": "FlatLeakage"},
    "stages": {"flagged": "Limited"},
}
SCENE = """
name = "strange"
engine = "products"

[instrument]
telescope = "ring"
radius = "150 m"
element = { kind = "cosine", power = 2.0 }
[instrument.terms.long]
kind = "cable"
step = "2 cm"

[observation]
phase_centre = "12h00m00.0s -30d00m00s"
transit = "2026-05-01"
duration = "40 min"
interval = "10 min"
frequency = { centre = "150 MHz", channel_width = "1 MHz", channels = 4 }

[sky]
kind = "circle"
radius = "2 deg"

[calibrate]
kind = "alternating"
tolerance = 1e-9

[flagged]
most = 0.2

[image]
kind = "summed"
pixels = 32
pixel = "12 arcmin"

[analyze]
products = []
[analyze.cube]
products = ["spectrum-2d"]
remove = "flat-leakage"
remover = { weighted = false }
"""


def test_there_is_a_stranger_of_every_kind():
    assert set(POINTS) == set(KINDS)


def test_one_file_and_entry_points_are_all_it_takes_for_all_kinds_together(package, command, tmp_path):
    (tmp_path / "strange.toml").write_text(SCENE)
    done = command(package(POINTS), "run", "strange.toml", "--out", "out")
    assert done.returncode == 0, done.stdout + done.stderr
    assert re.search(r"^engine +products ", done.stdout, re.M)
    assert re.search(r"^stage +image .* by Summed, ", done.stdout, re.M)
    assert re.search(r"^kept +receivers +cable: put into the perfect blocks", done.stdout, re.M), done.stdout
    record = json.loads((tmp_path / "out" / "run.json").read_text())
    assert record["plan"]["engine"] == "products" and record["checks"]["prediction"]["passed"]
    assert record["checks"]["calibration"]["passed"]
    assert set(record["flagged"]) == {f"tile{k}" for k in range(8)}
    # 2 cm more from station to station are up to 0.44 rad at 150 MHz, all of which one gain a station takes out
    assert record["calibration"]["visibility_rms_share"]["corrected - model"] < 1e-7
    assert record["calibration"]["visibility_rms_share"]["corrupted - corrected"] > 0.05
    assert (tmp_path / "out" / "cube.fits").exists() and (tmp_path / "out" / "report.html").exists()


def test_all_of_them_are_listed_with_where_they_come_from(package, command):
    said = command(package(POINTS), "plugins").stdout
    for named in POINTS.values():
        for name, cls in named.items():
            assert re.search(rf"^  {name} +my-package +my_package:{cls}$", said, re.M), name
