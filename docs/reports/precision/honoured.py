"""Tolerances asked and kept: 8 a decade, 1e-2 to 1e-12, 20 random scenes, every engine, against extended precision.

    python docs/reports/precision/honoured.py [--scenes 20] [--first 0]

The scenes are those of ../random_scenes.py with tolerances of their own put aside: telescopes of six kinds, chains of
up to nine terms, P > I, 10 MHz to 10 GHz. The truth is `instrument.precision.truth`. Writes honoured.md,
honoured.png.
"""

import argparse
import platform
import sys
import warnings
from datetime import date
from importlib.metadata import version
from pathlib import Path

import matplotlib
import numpy as np

HERE = Path(__file__).parent
sys.path.insert(0, str(HERE.parent))

from random_scenes import scene  # noqa: E402

from instrument import InputError  # noqa: E402
from instrument.errors import RefusedError  # noqa: E402
from instrument.precision.truth import visibilities  # noqa: E402

matplotlib.use("Agg")
TOLERANCES = 10.0 ** (-np.arange(16, 97) / 8)
ENGINES = ("matrix", "direct")


def one(seed):
    """(engine, tolerance, error or NaN where it is refused) of a scene; nothing where its sky never rises."""
    made, _ = scene(seed)
    try:
        exact = made.plan(workers=1)
    except InputError:
        return []
    truth = visibilities(exact.full)
    found = []
    for engine in ENGINES:
        for tolerance in TOLERANCES:
            try:
                plan = made.plan(tolerance=float(tolerance), engine=engine, workers=1)
                error = float(np.abs(plan.run().data - truth).max() / np.longdouble(plan.scale_jy))
                found.append((engine, tolerance, error, bool(plan.ready.omission[0]), len(plan.left_out)))
            except RefusedError as refused:
                assert "below what float64 can promise" in str(refused), refused
                found.append((engine, tolerance, np.nan, False, 0))
    print(seed, made.name, sum(np.isfinite(f[2]) for f in found), flush=True)
    return found


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--scenes", type=int, default=20)
    parser.add_argument("--first", type=int, default=0)
    given = parser.parse_args()
    found, seed, scenes = [], given.first, 0
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        while scenes < given.scenes:
            rows = one(seed)
            scenes += bool(rows)
            found += rows
            seed += 1
    write(found, given)


def write(found, given):
    from matplotlib.figure import Figure

    figure = Figure(figsize=(11, 5), layout="constrained")
    rows = []
    for ax, engine in zip(figure.subplots(1, 2, sharey=True), ENGINES, strict=True):
        own = [f for f in found if f[0] == engine]
        asked, error = (np.array([f[k] for f in own], float) for k in (1, 2))
        kept = error <= asked
        above = np.isfinite(error) & ~kept
        sampled = sum(f[3] for f in own)
        rows.append(
            f"| {engine} | {len(own)} | {kept.sum()} | {above.sum()} | {np.isnan(error).sum()} | {sampled} | "
            f"{np.nanmax(error / asked):.2f} |"
        )
        ax.loglog(asked, np.maximum(error, 1e-19), ".", ms=3, color="#0072B2")
        ax.loglog([1e-12, 1e-2], [1e-12, 1e-2], color="#D55E00", lw=1)
        ax.set(xlabel="tolerance asked", ylabel="largest error over the total flux", title=engine)
        ax.grid(color="#dddddd", lw=0.6)
    figure.savefig(HERE / "honoured.png", dpi=110)
    text = f"""# Tolerances asked and kept

{date.today()}, {platform.machine()}, Python {platform.python_version()}, numpy {version("numpy")},
numba {version("numba")}, instrument {version("instrument")}.
Made by `python docs/reports/precision/honoured.py --scenes {given.scenes} --first {given.first}`.

{given.scenes} random scenes, {len(TOLERANCES)} tolerances from 1e-2 to 1e-12, against sums in extended precision.
Refused: the tolerance is below what float64 promises for that scene, and the message says the floor.

| engine | asked | within the tolerance | above it | refused, with the floor | not exact | largest error / tolerance |
|---|---|---|---|---|---|---|
""" + "\n".join(rows)
    (HERE / "honoured.md").write_text(text + "\n\n![Asked and got](honoured.png)\n", encoding="utf-8")
    print(text)


if __name__ == "__main__":
    main()
