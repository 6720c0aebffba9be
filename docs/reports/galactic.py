"""The scene `galactic` whole: seconds of each stage, memory, leakage; and its error against time.

    python docs/reports/galactic.py [--out docs/reports] [--run FOLDER]

The run of all 161 channels of Table 2 (or a FOLDER that has one), then one channel of it predicted to several
tolerances, with 10 s between integrations, and held against sums over all 230,400 pixels at three times.
"""

import argparse
import json
import tempfile
import time
from importlib.metadata import version
from pathlib import Path

import numpy as np

from instrument.check import definition
from instrument.cli import main as instrument
from instrument.jones.mueller import stokes
from instrument.pipeline.scene_file import parse
from instrument.pipeline.scene_text import override, read_tables
from instrument.predict.base import EVERY
from instrument.predict.gridded import Gridded

LOOKED = (100, 1500, 2700)
TO_CUBES = ("plan", "predict", "correct", "image")


def whole(folder):
    if not (folder / "run.json").exists():
        instrument(["run", "galactic", "--out", str(folder)])
    run = json.loads((folder / "run.json").read_text())
    spent = {name: stage["seconds"]["measured"] for name, stage in run["stages"].items()}
    lines = "".join(f"| {name} | {seconds:.0f} |\n" for name, seconds in spent.items())
    leaked = [100 * np.array(run["leaked"][s]) for s in "IV"]
    first = sum(spent[name] for name in TO_CUBES if name in spent)
    return (
        f"Run of {run['finished']}, {len(leaked[0])} channels, two cores.\n\n| stage | s |\n|---|---|\n{lines}\n"
        f"To four Stokes cubes {first / 60:.1f} minutes; {run['memory']['measured_bytes'] / 1e9:.2f} GB of memory at "
        f"most, over the whole run. Within half power, rms of I over that of P {leaked[0].min():.2f} to "
        f"{leaked[0].max():.2f} % in the channels, of V {leaked[1].min():.4f} to {leaked[1].max():.4f} %.\n"
    )


def curve():
    file = parse(
        override(read_tables("galactic"), ["observation.frequency.channels=1", "analyze.cube.products=['spectrum-2d']"])
    )
    problem = file.plan(file.scene()).problem
    due = np.array([definition(problem.block(slice(t, t + 1), slice(0, 1))) for t in LOOKED])
    lines = ""
    for tolerance in (1e-2, 1e-3, 3e-4, 1e-4, 1e-5, 1e-6):
        begin = time.perf_counter()
        ready = Gridded().prepare(problem, tolerance)
        prepared = time.perf_counter() - begin
        vis = ready.predict(EVERY, EVERY)
        seconds = time.perf_counter() - begin - prepared
        good = ~vis.flag[list(LOOKED), 0]
        wrong, right = (vis.data[list(LOOKED), 0] - due)[good], due[good]
        off = np.linalg.norm(wrong) / np.linalg.norm(right)
        leak = np.linalg.norm(stokes(wrong)[:, 0]) / np.linalg.norm(stokes(right)[:, 0])
        lines += (
            f"| {tolerance:.0e} | {len(ready.nodes)} | {ready.bound:.1e} | {off:.1e} | {leak:.1e} | {prepared:.1f} | "
            f"{seconds:.1f} |\n"
        )
        print(lines.splitlines()[-1], flush=True)
    head = "| tolerance | nodes | bound | error of all | of I alone | preparing, s | a channel, s |\n"
    return (
        "## Error against time\n\nThe bound is of the total flux; errors are relative to the rms of the visibilities, "
        "and of I alone, all of which has leaked. One channel on two threads.\n\n"
        f"{head}|---|---|---|---|---|---|---|\n{lines}"
    )


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, default=Path("docs/reports"))
    parser.add_argument("--run", type=Path, default=Path(tempfile.gettempdir()) / "galactic")
    given = parser.parse_args()
    table = whole(given.run)
    text = (
        "# The polarized Galaxy at the size of Table 2\n\n"
        f"`python docs/reports/galactic.py`, {time.strftime('%Y-%m-%d')}, instrument {version('instrument')}, "
        f"numpy {version('numpy')}.\n\n{table}\n{curve()}"
    )
    (given.out / "galactic.md").write_text(text, encoding="utf-8")


if __name__ == "__main__":
    main()
