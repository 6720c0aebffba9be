"""Prediction of the mock grid with the LOFAR beam, whole: this package and DP3, side by side.

    pip install ".[peers,test]" && python docs/reports/predict_speed.py [--times 2874] [--runs 3]

Both are timed as whole processes, in turn: ours plans, predicts 225 sources through the beams of 59 stations and saves
the visibilities; DP3 predicts the same sources into a column of a Measurement Set made from the same stations. Writes
predict_speed.md beside this file.
"""

import argparse
import os
import platform
import sys
import tempfile
from datetime import date
from importlib.metadata import version
from pathlib import Path

import numpy as np
from peers import DP3, peer_tools, timed

HERE = Path(__file__).parent
OURS = """
import sys, numpy as np
from instrument.pipeline.scene_file import parse
from instrument.pipeline.scene_text import override, read_tables
asked = [f"observation.duration={sys.argv[1]}", "instrument.phase=everybeam"]
plan = parse(override(read_tables("mock-grid"), asked)).scene().plan()
np.save(sys.argv[2], plan.run().data)
"""


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--times", type=int, default=2874)
    parser.add_argument("--runs", type=int, default=3)
    given = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        folder = Path(folder)
        lofar_ms = peer_tools(folder)
        import casacore.tables as tables

        from instrument.pipeline.scene_file import parse
        from instrument.pipeline.scene_text import override, read_tables
        from instrument.sky.bbs import write_bbs

        file = parse(override(read_tables("mock-grid"), [f"observation.duration={10 * given.times} s"]))
        scene = file.scene()
        lofar_ms.make_ms(folder / "mock.MS", scene.instrument, scene.observation)
        write_bbs(folder / "sky.txt", scene.sky.about(scene.observation.phase_centre))
        environment = os.environ | {"OPENBLAS_NUM_THREADS": "1"}
        dp3 = [sys.executable, "-c", DP3, f"msin={folder}/mock.MS", "msout=.", "msout.datacolumn=PREDICTED"]
        dp3 += [
            "steps=[predict]",
            f"predict.sourcedb={folder}/sky.txt",
            "predict.usebeammodel=true",
            "predict.elementmodel=hamaker",
            "numthreads=2",
        ]
        ours = [sys.executable, "-c", OURS, f"{10 * given.times} s", str(folder / "ours.npy")]
        timed(ours, dict(os.environ))  # compiled once
        pairs = []
        for _ in range(given.runs):
            pairs.append((timed(ours, dict(os.environ)), timed(dp3, environment)))
            print(f"ours {pairs[-1][0][0]:.1f} s, DP3 {pairs[-1][1][0]:.1f} s", flush=True)
        data = np.load(folder / "ours.npy", mmap_mode="r")[:, 0]
        with tables.table(str(folder / "mock.MS"), ack=False) as ms:
            rows = len(ms) // len(data)
            error = power = 0.0
            for t in np.linspace(0, len(data) - 1, 24).astype(int):
                theirs = ms.getcol("PREDICTED", int(t) * rows, rows).reshape(rows, 2, 2)
                error += np.sum(np.abs(theirs - data[t]) ** 2)
                power += np.sum(np.abs(theirs) ** 2)
    (ours_s, ours_mb), (dp3_s, dp3_mb) = (
        [list(x) for x in zip(*side, strict=True)] for side in zip(*pairs, strict=True)
    )
    ratios = [d / o for o, d in zip(ours_s, dp3_s, strict=True)]
    used = {"numpy": "numpy", "numba": "numba", "DP3": "dp3", "everybeam": "everybeam", "instrument": "instrument"}
    text = f"""# Prediction of the mock grid, beam included: seconds beside DP3

{date.today()}, {os.cpu_count()} cores ({platform.machine()}), Python {platform.python_version()},
{", ".join(f"{k} {version(v)}" for k, v in used.items())}.
59 stations, {given.times} integrations, 225 sources, 150 MHz, absolute beams; whole processes in turn,
{given.runs} times. Made by `python docs/reports/predict_speed.py --times {given.times} --runs {given.runs}`.

| | this package | DP3 predict |
|---|---|---|
| best wall time | {min(ours_s):.1f} s | {min(dp3_s):.1f} s |
| all | {", ".join(f"{x:.1f}" for x in ours_s)} | {", ".join(f"{x:.1f}" for x in dp3_s)} |
| peak memory | {max(ours_mb):.0f} MB | {max(dp3_mb):.0f} MB |
| precision of the result | float64 | complex64 |

DP3 takes {np.median(ratios):.1f} times as long (median of the pairs; {min(ratios):.1f} to {max(ratios):.1f}).
Difference of the visibilities: {np.sqrt(error / power):.1e} rms relative, which is that of the positions on
Earth that DP3 works with (see ../conventions.md).
"""
    (HERE / "predict_speed.md").write_text(text)
    print(text)


if __name__ == "__main__":
    main()
