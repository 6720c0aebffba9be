"""Very many points: the gridded engine beside sums over all sources, seconds of both and the error of the first.

    python docs/reports/gridded_points.py [--most 1e6] [--out docs/reports]

Unpolarized sources of a power law of fluxes (slope -2.6) within 2 deg, 59 LOFAR stations, 1 hour of 10 s, 2 channels at
150 MHz, 30 to 800 wavelengths, tolerance 1e-4. Sums are timed on the first integrations (all of them for 1000 sources,
two for a million) and scaled, which is more than all of them take: array factors of neighbours are shared. Errors are
of six of these at most, of visibilities within the uv range.
"""

import argparse
import os
import time
from importlib.metadata import version
from pathlib import Path

import numpy as np
from astropy import units as u

import instrument
from instrument.predict.base import EVERY
from instrument.predict.direct import Direct
from instrument.predict.gridded import Gridded
from instrument.predict.matrix import Matrix

TOLERANCE, RANGE, SPREAD_DEG = 1e-4, (30.0, 800.0), 2.0


def sky(count):
    rng = np.random.default_rng(0)
    dec = np.deg2rad(48.2175 + rng.uniform(-1, 1, count) * SPREAD_DEG)
    fluxes = np.zeros((count, 4))
    fluxes[:, 0] = rng.pareto(1.6, count) + 1
    ra = np.deg2rad(123.4 + rng.uniform(-1, 1, count) * SPREAD_DEG / np.cos(dec))
    return instrument.PointSky(names=[f"s{k}" for k in range(count)], ra_rad=ra, dec_rad=dec, stokes_jy=fluxes)


def spent(work):
    """What it gives, with the seconds of wall and of all cores."""
    wall, before = time.perf_counter(), os.times()
    found = work()
    after = os.times()
    return found, time.perf_counter() - wall, after.user + after.system - before.user - before.system


def row(count):
    night = instrument.Observation(
        phase_centre="08h13m36.0s +48d13m03s", transit="2012-12-07", duration=1 * u.hour, interval=10 * u.s,
        frequencies=[150, 150.2] * u.MHz,
    )  # fmt: skip
    scene = instrument.Scene(instrument=instrument.load("telescopes", "lofar-hba"), sky=sky(count), observation=night)
    plan = scene.plan(tolerance=TOLERANCE, engine="matrix", uv_range=RANGE)
    _, decided, _ = spent(lambda: scene.plan(tolerance=TOLERANCE, uv_range=RANGE))
    problem = plan.problem
    times = min(360, max(2, 360_000 // count, 12 * (count < 1_000_000)))
    some, few = problem.block(slice(0, times), EVERY), slice(0, times, max(1, times // 6))
    summed, wall, cpu = spent(lambda: Matrix().prepare(some, TOLERANCE).sums(EVERY, EVERY))
    share = problem.shape[0] / some.shape[0]
    ready, prepared, _ = spent(lambda: Gridded().prepare(problem, TOLERANCE))
    ready.sums(slice(0, 1), EVERY)  # compiled
    seen, gridded, gridded_cpu = spent(lambda: ready.predict(EVERY, EVERY))
    due = Direct().sums(problem.block(few, EVERY)) if count <= 10_000 else summed[few]
    good = ~seen.flag[few]
    wrong = (seen.data[few] - due)[good]
    rms = float(np.sqrt(np.mean(np.abs(due[good]) ** 2)))
    return (
        f"| {count:.0e} | {decided:.1f} "
        f"| {wall * share:.0f} | {cpu * share:.0f} | {Matrix().work(problem).seconds:.0f} "
        f"| {len(ready.nodes)} | {prepared:.1f} | {gridded:.1f} | {gridded_cpu:.1f} | {ready.work().seconds:.1f} "
        f"| {ready.bound:.1e} | {np.abs(wrong).max() / plan.scale_jy:.1e} "
        f"| {np.sqrt(np.mean(np.abs(wrong) ** 2)) / rms:.1e} |"
    )


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, default=Path("docs/reports"))
    parser.add_argument("--most", type=float, default=1e6, help="sources, at most")
    given = parser.parse_args()
    lines = []
    for count in (300, 1000, 10_000, 100_000, 1_000_000):
        if count <= given.most:
            lines.append(row(count))
            print(lines[-1], flush=True)
    versions = f"instrument {version('instrument')}, ducc0 {version('ducc0')}"
    head = [
        "# Very many points: gridded, and summed", "", f"`python docs/reports/gridded_points.py`, "
        f"{time.strftime('%Y-%m-%d')}, {versions}.", *__doc__.strip().splitlines()[4:], "",
        "Seconds to plan (with what the engine chosen needs prepared), and of sums (engine `matrix`): wall, all cores, "
        "and as planned; of `gridded`: to prepare, then wall, all cores and as planned. Errors: the bound and the "
        "largest, of the total flux; rms, of that of the visibilities.",
        "",
        "| sources | to plan | summed | cores"
        " | planned | nodes | prepared | gridded | cores | planned | bound | largest | rms |",
        "|---|---|---|---|---|---|---|---|---|---|---|---|---|",
    ]  # fmt: skip
    (given.out / "gridded_points.md").write_text("\n".join([*head, *lines]) + "\n")


if __name__ == "__main__":
    main()
