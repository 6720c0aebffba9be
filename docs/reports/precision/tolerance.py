"""What a tolerance buys: prediction of the mock grid, processor time of an integration at each tolerance, one thread.

    OMP_NUM_THREADS=1 python docs/reports/precision/tolerance.py

All 59 stations, 225 sources, beams, 384 integrations of 10 s; in turn, best of seven. Planning does not count. Writes
tolerance.md.
"""

import os
import platform
import time
from dataclasses import replace
from datetime import date
from importlib.metadata import version
from pathlib import Path

import numpy as np

from instrument.pipeline.scene_file import parse
from instrument.pipeline.scene_text import override, read_tables

TOLERANCES = (0.0, 1e-8, 1e-6, 1e-5, 1e-4, 1e-3)


def said(plan):
    """What is not exact."""
    way = getattr(plan.ready, "way", None)
    single = ", 32 bit" if way and way.single else ""
    return f"array factors at {way.panels.nodes} of {way.panels.size} times{single}" if way else "-"


def main():
    scene = parse(override(read_tables("mock-grid"), ["observation.duration=3840 s"])).scene()
    plans = [(f"{t:g}", scene.plan(tolerance=t, engine="matrix", workers=1)) for t in TOLERANCES]
    for label, plan in plans[-2:]:  # the same times in 64 bit: what 32 bit gains
        plans.append((f"{label}, in 64 bit", replace(plan, name="64 bit")))
        vars(plans[-1][1])["ready"] = replace(plan.ready, way=plan.ready.way._replace(single=False))
    exact = plans[0][1].run().data
    best, error = dict.fromkeys((label for label, _ in plans), np.inf), {}
    for _ in range(7):
        for label, plan in plans:
            begin = time.process_time()
            data = plan.run().data
            best[label] = min(best[label], time.process_time() - begin)
            error[label] = float(np.abs(data - exact).max() / plan.scale_jy)
    rows = [
        f"| {label} | {said(plan)} | {plan.ready.bound:.1e} | {error[label]:.1e} | "
        f"{1e3 * best[label] / len(exact):.2f} | {best['0'] / best[label]:.2f} |"
        for label, plan in plans
    ]
    text = f"""# What a tolerance buys

{date.today()}, {os.cpu_count()} cores ({platform.machine()}), one thread, Python {platform.python_version()},
numpy {version("numpy")}, numba {version("numba")}, instrument {version("instrument")}.
Made by `OMP_NUM_THREADS=1 python docs/reports/precision/tolerance.py`.

Prediction of `mock-grid`, 384 integrations: error against the exact sums, processor time of an integration, best of 7.

| tolerance | not exact | bound | error | ms | times as fast |
|---|---|---|---|---|---|
""" + "\n".join(rows)
    (Path(__file__).parent / "tolerance.md").write_text(text + "\n", encoding="utf-8")
    print(text)


if __name__ == "__main__":
    main()
