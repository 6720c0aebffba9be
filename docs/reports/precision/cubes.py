"""What is made of cubes, and images, beside programs of others, at several sizes: one page and figure a job.

    pip install . rm-tools rm-lite ps_eor && python docs/reports/precision/cubes.py [JOB ...]

JOB is imagers, rm-synthesis, rm-clean or spectra. Writes JOB.md, JOB.png and JOB.ecsv beside this file. Everybody has
one thread of one core; seconds are those of the processor, the median of three, taken in turn.
"""

import sys
import time
from datetime import UTC, datetime
from pathlib import Path

from instrument.threads import one_thread

one_thread()

from instrument.pipeline.record import versions  # noqa: E402
from instrument.precision import Form, faraday, imagers, spectra  # noqa: E402
from instrument.precision.advice import ERRORS, crossovers, peers_ahead  # noqa: E402
from instrument.precision.command import table  # noqa: E402
from instrument.precision.conditions import machine, peers  # noqa: E402
from instrument.precision.contest import choice, front, measured  # noqa: E402
from instrument.registry import plugin_class  # noqa: E402
from instrument.report.precision import precision_figure  # noqa: E402
from instrument.report.style import save  # noqa: E402
from instrument.whole_file import write_ecsv  # noqa: E402

HERE = Path(__file__).parent
FORM = Form(quick=True, peers=True)
DIRTY = {"dirty": plugin_class("imagers", "dirty")}
JOBS = {
    "imagers": lambda: [imagers.contest(DIRTY, *size, FORM) for size in imagers.SIZES],
    "rm-synthesis": lambda: [faraday._synthesis(side, FORM) for side in (8, 48, 160)],
    "rm-clean": lambda: [faraday._clean(side, FORM) for side in (2, 8)],
    "spectra": lambda: [
        make(FORM, *size) for make in (spectra._floor, spectra._known) for size in ((64, 32), (96, 64))
    ],
}
WHY = {
    "imagers": "ducc0 alone makes the images that are not zero, and no more. Ours calls it with half of what is asked "
    "for, so that no pixel is off by more, and makes and fits the PSF besides: a call more for each image.",
    "rm-synthesis": "Both peers are transforms of finufft, whose cost hardly depends on the accuracy. Ours begins with "
    "18 ms: a quarter for the RMSF, a sixth for the noise of the channels, a fifth for the tables of its product; that "
    "noise, from 4096 spectra at most, is half of its time at 64 x 64 pixels. No other measures it.",
    "rm-clean": "Both peers loop in Python, over pixels and over components; ours is compiled.",
    "spectra": "ps_eor turns images into visibilities, these into delays, and keeps both; ours makes the cells that "
    "are kept. Its power is N / (N - 1) too high by its bandwidth, which stands in its errors.",
}


def main():
    for job in sys.argv[1:] or JOBS:
        contests = JOBS[job]()
        found = []
        for contest in contests:
            rows = measured(contest, quick=True, clock=time.process_time)
            found.append((contest, rows))
            print(contest.name, *(f"{r.plugin} {r.asked:g}: {r.error:.1e} {r.seconds:.3g}" for r in rows), sep="\n  ")
        drawn = [(c, rows, front(rows)) for c, rows in found]
        save(precision_figure(drawn, "processor seconds"), HERE / f"{job}.png", overwrite=True)
        known = versions() | peers(contests)[0]
        every = [row for _, rows in found for row in rows]
        write_ecsv(table(every, f"cubes.py {job}", machine(), known), HERE / f"{job}.ecsv", overwrite=True)
        (HERE / f"{job}.md").write_text(page(job, found, known), encoding="utf-8")


def page(job, found, known):
    facts = "; ".join(f"{name}: {text}" for name, text in machine().items())
    lines = [f"# {job} beside programs of others", "", f"{datetime.now(UTC):%Y-%m-%d}. {facts}.", ""]
    lines += [", ".join(f"{name} {number}" for name, number in known.items()) + ".", ""]
    lines += [
        f"![error against seconds]({job}.png)",
        "",
        f"Processor seconds, one thread. Truth: {found[0][0].truth}.",
        "",
    ]
    lines += ["| job | error at most | ours | s | peer | s | ours over peer |", "|---|---|---|---|---|---|---|"]
    for contest, rows in found:
        levels = [e for e in ERRORS if any(r.error <= e for r in rows)] or [max(r.error for r in rows)]
        for error in levels:
            pair = [choice([r for r in rows if r.peer is peer], error) for peer in (False, True)]
            cells = [f"{r.plugin}, {r.asked:.2g} | {r.seconds:.2g}" if r else "none | – " for r in pair]
            ratio = f"{pair[0].seconds / pair[1].seconds:.2g}" if all(pair) else "–"
            lines.append(f"| {contest.name} | {error:.0e} | {' | '.join(cells)} | {ratio} |".replace(", nan |", " |"))
    lines += ["", *(f"* {text}" for text in crossovers(found) + peers_ahead(found)), "", WHY[job], ""]
    return "\n".join(
        [*lines, f"Made by `python docs/reports/precision/cubes.py {job}`; all answers are in {job}.ecsv.", ""]
    )


if __name__ == "__main__":
    main()
