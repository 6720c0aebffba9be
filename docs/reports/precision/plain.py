"""Prediction without beams beside matvis and fftvis: seconds at two errors against the number of sources.

    pip install . matvis fftvis && python docs/reports/precision/plain.py [--sources 300,3000,30000]

Writes plain.md and plain.png beside this file. All in one process, on one thread each, in turn, best of four; every
answer is held against the direct sum in extended precision, towards the directions that its program works with.
"""

import argparse
import os
import platform
import time
from datetime import UTC, datetime
from importlib.metadata import version
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

from instrument.errors import RefusedError
from instrument.precision import Form, plain
from instrument.precision.conditions import machine
from instrument.registry import plugin_class
from instrument.report.precision import COLOURS, MARKS
from instrument.report.style import save, styled

HERE = Path(__file__).parent
ASKED, ERRORS = (1e-4, 1e-8), (1e-3, 1e-7)  # a peer may exceed what it was asked for a little
WHY = (
    "Why, as far as it was looked into: matvis does the same product of matrices, for one receptor and without phase",
    "centre, and plans nothing; ours plans anew every time, and 30 sources take it 0.09 s. Beside other work on the",
    "machine (load above 1) differences below 20 % are none. On a lattice fftvis needs one transform in two dimensions",
    "of the grid of baselines, whatever their number; where stations lie in no plane it takes one in three, and falls",
    "far behind.",
)
PROGRAMS = ("matrix", "matvis", "fftvis")


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--sources", default="300,3000,30000")
    sizes = [int(x) for x in parser.parse_args().sources.split(",")]
    engines = {"matrix": plugin_class("engines", "matrix")}
    found, refused, counts = {}, {}, {}
    for name, layout in plain.arrays().items():
        counts[name] = len(layout.baselines[0]) * plain.TIMES
        for size in sizes:
            contest = plain.contest(name, layout, size, engines, Form(quick=True, peers=True))
            for entry in contest.entries:
                trials = []
                for asked in entry.values or ASKED:
                    try:
                        trials.append(timed(contest, entry, asked))
                    except RefusedError as why:
                        refused[name, entry.plugin] = str(why)
                print(name, size, entry.plugin, trials, flush=True)
                for error in ERRORS:
                    good = [trial for trial in trials if trial[1] <= error]
                    found[name, size, entry.plugin, error] = min(good, default=None)
    save(figure(found, sizes, counts), HERE / "plain.png", overwrite=True)
    (HERE / "plain.md").write_text(text(found, sizes, counts, refused))


def timed(contest, entry, asked):
    """Best seconds of four answers, of two where it takes more than 5 s, and its error."""
    start = time.perf_counter()
    error = contest.judge(entry.answer(asked), asked).error
    spent = [time.perf_counter() - start]
    while len(spent) < 4 and (len(spent) == 1 or min(spent) < 5):
        start = time.perf_counter()
        entry.answer(asked)
        spent.append(time.perf_counter() - start)
    return min(spent), error


@styled
def figure(found, sizes, counts):
    drawing = Figure(figsize=(5.2 * len(counts), 4.8), layout="constrained")
    panels = drawing.subplots(1, len(counts), sharey=True)
    for ax, (name, count) in zip(panels, counts.items(), strict=True):
        ax.set(xscale="log", yscale="log", xlabel="sources", title=name)
        ax.set_xticks(sizes, [f"{size}" for size in sizes])
        ax.minorticks_off()
        for k, program in enumerate(PROGRAMS):
            for error, style in zip(ERRORS, ("-", "--"), strict=True):
                rows = [(size, found[name, size, program, error]) for size in sizes]
                good = [(size, 1e6 * row[0] / count) for size, row in rows if row is not None]
                if good:
                    label = f"{program}, error below {error:.0e}"
                    ax.plot(*zip(*good, strict=True), style, color=COLOURS[k], marker=MARKS[k], ms=7, label=label)
        ax.grid(color="#dddddd", lw=0.6)
    panels[0].set_ylabel("microseconds a visibility")
    panels[-1].legend(fontsize=10, frameon=False)
    return drawing


def text(found, sizes, counts, refused):
    used = ("instrument", "matvis", "fftvis", "pyuvdata", "finufft", "numpy", "numba")
    lines = [
        "# Prediction without beams, beside matvis and fftvis",
        "",
        f"{datetime.now(UTC):%Y-%m-%d %H:%M} UTC, {machine()['processor']}, load {os.getloadavg()[0]:.1f}, Python "
        f"{platform.python_version()}, {', '.join(f'{name} {version(name)}' for name in used)}.",
        f"{plain.TIMES} integrations, one channel, unpolarized sources within 20 deg; one thread each, in one process",
        "in turn, the best of four (of two above 5 s); ours plans anew in the time given.",
        f"Made by `python docs/reports/precision/plain.py --sources {','.join(map(str, sizes))}`.",
        "",
        "| array | baselines | sources | error below | "
        + " | ".join(f"{p}, s (error)" for p in PROGRAMS)
        + " | quickest |",
        "|---|---|---|---|" + "---|" * (len(PROGRAMS) + 1),
    ]
    for name, count in counts.items():
        for size in sizes:
            for error in ERRORS:
                rows = [found[name, size, program, error] for program in PROGRAMS]
                cells = ["–" if row is None else f"{row[0]:.3g} ({row[1]:.0e})" for row in rows]
                best = PROGRAMS[int(np.argmin([np.inf if row is None else row[0] for row in rows]))]
                lines.append(
                    f"| {name} | {count // plain.TIMES} | {size} | {error:.0e} | {' | '.join(cells)} | {best} |"
                )
    lines += ["", *(f"{name}, {program}: refused, {why}." for (name, program), why in refused.items())]
    lines += ["", *ahead(found, sizes, counts), "", *WHY]
    return "\n".join(lines) + "\n"


def ahead(found, sizes, counts):
    """Where a peer is quicker than ours, from which size on."""
    for name in counts:
        for program in PROGRAMS[1:]:
            for error in ERRORS:
                both = [(found[name, size, "matrix", error], found[name, size, program, error]) for size in sizes]
                first = [
                    f"{size} sources ({ours[0] / other[0]:.2f} times as quick)"
                    for size, (ours, other) in zip(sizes, both, strict=True)
                    if other is not None and other[0] < ours[0]
                ]
                if first:
                    yield f"- {name}, error below {error:.0e}: {program} is ahead at {', '.join(first)}."


if __name__ == "__main__":
    main()
