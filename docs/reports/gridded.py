"""What the gridded engine makes of a tolerance: bound, error of all and of the leakage alone, nodes, seconds.

    python docs/reports/gridded.py [--out docs/reports]

A diffuse sky of Q and U (slope -2.7) of 192 x 192 pixels of 1.25 arcmin (4 deg), 59 LOFAR stations, 8 h of 5 minutes,
150 MHz, 30 to 800 wavelengths; held against sums over all pixels (`instrument.check.definition`) at three times.
"""

import argparse
import time
from dataclasses import replace
from importlib.metadata import version
from pathlib import Path

import numpy as np
from astropy import units as u

import instrument
from instrument.check import definition
from instrument.jones.mueller import stokes
from instrument.predict.base import EVERY
from instrument.predict.gridded import Gridded

PIXELS, LOOKED = 192, (3, 40, 77)


def sky():
    k = np.hypot(*np.meshgrid(np.fft.fftfreq(PIXELS), np.fft.fftfreq(PIXELS)))
    k[0, 0] = k[0, 1]
    rng, images = np.random.default_rng(0), np.zeros((1, 4, PIXELS, PIXELS))
    for s in (1, 2):
        images[0, s] = np.fft.ifft2(np.fft.fft2(rng.normal(size=(PIXELS, PIXELS))) * k**-1.35).real
    return instrument.ImageSky(grid=instrument.ImageGrid(pixels=PIXELS, pixel=1.25 * u.arcmin), stokes=images)


def timed(ready):
    """Seconds of a prediction."""
    begin = time.perf_counter()
    ready.predict(EVERY, EVERY)
    return time.perf_counter() - begin


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, default=Path("docs/reports"))
    out = parser.parse_args().out
    night = instrument.Observation(
        phase_centre="08h13m36.0s +48d13m03s", transit="2012-12-07", duration=8 * u.hour, interval=5 * u.min,
        frequencies=[150] * u.MHz,
    )  # fmt: skip
    scene = instrument.Scene(instrument=instrument.load("telescopes", "lofar-hba"), sky=sky(), observation=night)
    problem = scene.plan(tolerance=1e-3, engine="direct", uv_range=(30, 800)).problem
    due = np.array([definition(problem.block(slice(t, t + 1), slice(0, 1))) for t in LOOKED])
    lines = []
    for tolerance in (1e-2, 3e-3, 1e-3, 3e-4, 1e-4, 1e-5, 1e-6, 1e-7, 1e-8):
        begin = time.perf_counter()
        ready = Gridded().prepare(problem, tolerance)
        prepared = time.perf_counter() - begin
        vis = ready.predict(EVERY, EVERY)
        good = ~vis.flag[list(LOOKED), 0]
        wrong, right = (vis.data[list(LOOKED), 0] - due)[good], due[good]
        off = np.linalg.norm(wrong) / np.linalg.norm(right)
        leak = [np.linalg.norm(stokes(wrong)[:, k]) / np.linalg.norm(stokes(right)[:, k]) for k in (0, 3)]
        spent = [min(timed(replace(ready, kernels=k)) for _ in range(2)) for k in (ready.kernels, None)]
        cells = [f"{tolerance:.0e}", str(len(ready.nodes)), f"{ready.bound:.1e}", f"{off:.1e}"]
        lines.append([*cells, f"{leak[0]:.1e}", f"{leak[1]:.1e}", f"{prepared:.1f}", *(f"{s:.1f}" for s in spent)])
        print(*lines[-1], flush=True)
    names = ["tolerance", "nodes", "bound", "all", "I", "V", "prepared", "predicted", "ducc0"]
    head = f"| {' | '.join(names)} |\n"
    head += "|---|---|---|---|---|---|---|---|---|\n"
    table = head + "".join(f"| {' | '.join(line)} |\n" for line in lines)
    text = (
        "# The gridded engine: asked and kept\n\n"
        f"`python docs/reports/gridded.py`, {time.strftime('%Y-%m-%d')}, instrument {version('instrument')}, "
        f"ducc0 {version('ducc0')}.\n{__doc__.split(chr(10), 4)[4]}\n"
        "The bound is of the total flux; errors are relative to the rms of the visibilities, of those of I and of V "
        "alone, which are what leaks. Seconds to prepare and to predict (best of two), and to predict by a w-gridder "
        "of ducc0 for each node and Stokes parameter.\n\n" + table
    )
    (out / "gridded.md").write_text(text, encoding="utf-8")


if __name__ == "__main__":
    main()
