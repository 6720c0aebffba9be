"""What is left in Stokes I of the leakage of a diffuse polarized sky, after correction for the beam by each way.

    python docs/reports/diffuse_leakage.py [--out docs/reports] [--iterations 16,40]

The sky and the observation of the scene `galactic-quick`, one channel at 150 MHz: Faraday screens with I = V = 0, 128 x
128 pixels of 2 arcmin, 59 LOFAR stations, 8 h of 2 minutes, 30 to 800 wavelengths. Rms of I over that of P within 1.9
deg, half power; "before" are dirty images without the beam towards the centre.
"""

import argparse
import time
from importlib.metadata import version
from pathlib import Path

import numpy as np

from instrument import BeamImager, Imager
from instrument.pipeline.scene_file import parse
from instrument.pipeline.scene_text import override, read_tables


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, default=Path("docs/reports"))
    parser.add_argument("--iterations", default="16,40")
    given = parser.parse_args()
    changes = ["observation.frequency.channels=1", "analyze.cube.products=['spectrum-2d']"]
    file = parse(override(read_tables("galactic-quick"), changes))
    scene = file.scene()
    plan = file.plan(scene)
    vis = plan.run()
    settings = {"pixels": 128, "pixel": "2 arcmin", "uv_range": (30, 800)}
    y, x = np.mgrid[:128, :128] - 64
    inside = np.hypot(x, y) * 2 / 60 < 1.9

    def ratios(data):
        p = np.hypot(*(np.std(data[0, s][inside]) for s in (1, 2)))
        return [float(np.std(data[0, s][inside]) / p) for s in (0, 3)]

    lines = [["before", *ratios(Imager(**settings).image(vis.without_beam(scene.instrument)).data), 0.0]]
    operator = plan.operator(BeamImager(**settings).grid(), 1e-5)
    ways = [("normalised", 1), *(("predict", int(n)) for n in given.iterations.split(","))]
    for way, iterations in ways:
        begin = time.perf_counter()
        cube = BeamImager(way=way, iterations=iterations, tolerance=1e-9, **settings).image(vis, operator)
        name = way if way == "normalised" else f"{way}, {iterations} iterations"
        lines.append([name, *ratios(cube.data), time.perf_counter() - begin])
        print(*lines[-1], flush=True)
    first = lines[0][1]
    table = "| way | I/P | of that before | V/P | s |\n|---|---|---|---|---|\n" + "".join(
        f"| {name} | {i:.2e} | {i / first:.1%} | {v:.1e} | {s:.0f} |\n" for name, i, v, s in lines
    )
    text = (
        "# Leakage of a diffuse sky after correction\n\n"
        f"`python docs/reports/diffuse_leakage.py`, {time.strftime('%Y-%m-%d')}, instrument {version('instrument')}, "
        f"ducc0 {version('ducc0')}; operator of {len(operator.nodes)} nodes, 1e-5.\n"
        f"{__doc__.split(chr(10), 4)[4]}\n{table}"
    )
    (given.out / "diffuse_leakage.md").write_text(text, encoding="utf-8")


if __name__ == "__main__":
    main()
