"""A package of somebody else with all kinds of plugins, one file and its entry points, works from a scene file."""

import ast
import json
import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

from instrument.registry import KINDS

PAGE = Path(__file__).resolve().parents[2] / "docs" / "extending.md"
POINTS = {
    "telescopes": {"ring": "Ring"},
    "elements": {"cosine": "Cosine"},
    "terms": {"cable": "Cable"},
    "skies": {"circle": "Circle"},
    "engines": {"products": "Products"},
    "calibrators": {"alternating": "Alternating"},
    "imagers": {"summed": "Summed"},
    "foregrounds": {"flat-leakage": "FlatLeakage"},
    "stages": {"flagged": "Flagged"},
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


@pytest.fixture(scope="module")
def site(tmp_path_factory):
    """The package as it lies after its installation: the classes of the page on extending."""
    text = []
    for block in re.findall(r"```python\n(.*?)```", PAGE.read_text(), re.S):
        for node in ast.parse(block).body:
            if isinstance(node, ast.Import | ast.ImportFrom | ast.ClassDef) or "SITE =" in ast.unparse(node):
                text.append(ast.unparse(node))
    folder = tmp_path_factory.mktemp("site")
    info = folder / "my_package-1.0.dist-info"
    info.mkdir()
    (folder / "my_package.py").write_text("\n\n".join(text))
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: my-package\nVersion: 1.0\n")
    points = [
        f"[instrument.{kind}]\n" + "\n".join(f"{name} = my_package:{cls}" for name, cls in named.items())
        for kind, named in POINTS.items()
    ]
    (info / "entry_points.txt").write_text("\n".join(points) + "\n")
    return folder


def command(site, where, *words):
    return subprocess.run(
        [sys.executable, "-m", "instrument.cli", *words], cwd=where, capture_output=True, text=True, timeout=300,
        env={**os.environ, "PYTHONPATH": str(site)},
    )  # fmt: skip


def test_there_is_a_stranger_of_every_kind():
    assert set(POINTS) == set(KINDS)


def test_one_file_and_entry_points_are_all_it_takes_for_all_kinds_together(site, tmp_path):
    (tmp_path / "strange.toml").write_text(SCENE)
    done = command(site, tmp_path, "run", "strange.toml", "--out", "out")
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


def test_all_of_them_are_listed_with_where_they_come_from(site, tmp_path):
    said = command(site, tmp_path, "plugins").stdout
    for named in POINTS.values():
        for name, cls in named.items():
            assert re.search(rf"^  {name} +my-package +my_package:{cls}$", said, re.M), name
