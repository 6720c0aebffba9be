"""The bound of a plan against a sum in extended precision, on random scenes.

    python docs/reports/bounds.py [--scenes 500] [--first 0]

Telescopes (LOFAR of both bands, dishes, dipoles, phased stations, none), chains of up to nine terms, skies with P > I
and rotation measures to 1e5 rad/m2, 10 MHz to 10 GHz, baselines of 1 m to 1e7 m, tolerances of 0 to 0.1;
every second scene by `matrix`, the others by the engine that the plan takes. The truth is
`instrument.precision.truth`, which takes the rotation of the Earth from the package and works out the rest on its own.
Writes
bounds.md beside this file.
"""

import argparse
import platform
import warnings
from collections import Counter
from datetime import date
from importlib.metadata import version
from pathlib import Path

import numpy as np
from random_scenes import scene

from instrument import InputError
from instrument.errors import RefusedError
from instrument.precision.truth import visibilities

HERE = Path(__file__).parent


def one(seed):
    """What one random scene gives: its error and bound, relative to the total flux; a word where it is refused."""
    made, tolerance = scene(seed)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        try:
            plan = made.plan(tolerance=tolerance, engine=(None, "matrix")[seed % 2], workers=1)
        except RefusedError as error:
            return "the floor" if "below what float64 can promise" in str(error) else str(error)
        except InputError:
            return "nothing rises"
    data = plan.run().data
    truth = visibilities(plan.full)
    error = float(np.abs(data - truth).max() / np.longdouble(plan.scale_jy))
    return {
        "seed": seed,
        "kind": made.name,
        "error": error,
        "bound": plan.sum_bound,
        "exceeded": 0 < tolerance < plan.sum_bound,
        "omitted": any(item.bound for item in plan.left_out),
        "sampled": bool(plan.ready.omission[0]),
        "verified": plan.verify(samples=16, seed=seed).passed,
    }


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--scenes", type=int, default=500)
    parser.add_argument("--first", type=int, default=0)
    given = parser.parse_args()
    found, refused, seed = [], Counter(), given.first
    while len(found) < given.scenes:
        result = one(seed)
        seed += 1
        if isinstance(result, str):
            refused[result] += 1
            continue
        found.append(result)
        if result["error"] > result["bound"] or not result["verified"]:
            print(result)
    write(found, refused, given)


def write(found, refused, given):
    tight = np.array([r["error"] / r["bound"] for r in found])
    rows = []
    for kind, count in sorted(Counter(r["kind"] for r in found).items()):
        pick = np.array([r["kind"] == kind for r in found])
        bounds = np.array([r["bound"] for r in found])[pick]
        rows.append(
            f"| {kind} | {count} | {np.median(bounds):.1e} | {bounds.max():.1e} | "
            f"{np.median(tight[pick]):.1e} | {tight[pick].max():.2f} |"
        )
    omitted = np.array([r["omitted"] for r in found])
    sampled = np.array([r["sampled"] for r in found])
    above = sum(r["error"] > r["bound"] for r in found)
    text = f"""# Bounds of a plan against extended precision

{date.today()}, {platform.machine()}, Python {platform.python_version()}, numpy {version("numpy")},
numba {version("numba")}, scipy {version("scipy")}, instrument {version("instrument")}.
Made by `python docs/reports/bounds.py --scenes {given.scenes} --first {given.first}`;
{refused.pop("nothing rises", 0)} scenes more were refused, for nothing of their sky rises;
{refused.pop("the floor", 0)} more, for their tolerance is below what float64 can promise;
for other reasons {sum(refused.values())}.

Errors are the largest over all visibilities, relative to the total flux of the sky; the truth is a sum in extended
precision from the formulas of ../conventions.md.

| | |
|---|---|
| scenes with an error above the bound | {above} of {len(found)} |
| error / bound, median | {np.median(tight):.1e} |
| error / bound, largest | {tight.max():.2f} |
| the same where rounding is the only error, median | {np.median(tight[~omitted]):.1e} |
| the same where a tolerance let something be left out ({omitted.sum()}), median | {np.median(tight[omitted]):.1e} |
| of these, where array factors lie between time nodes ({sampled.sum()}), median | {np.median(tight[sampled]):.1e} |
| a tolerance that the bound exceeds | {sum(r["exceeded"] for r in found)} |
| `verify` (16 visibilities) | passed in {sum(r["verified"] for r in found)} |

| telescope | scenes | bound, median | largest | error / bound, median | largest |
|---|---|---|---|---|---|
""" + "\n".join(rows)
    (HERE / "bounds.md").write_text(text + "\n", encoding="utf-8")
    print(text)


if __name__ == "__main__":
    main()
