"""What is made of cubes, and images, beside programs of others, at several sizes: one page and figure a job.

    pip install . rm-tools rm-lite ps_eor && python docs/reports/precision/cubes.py [JOB ...]

JOB is imagers, rm-synthesis, rm-clean, spectra, photometry or gridded (the engine, on diffuse skies), which have no
peer, or predict-beams (with the packages dp3, everybeam and python-casacore). Writes JOB.md, JOB.png and JOB.ecsv
beside this file. Everybody has one thread of one core; seconds are those of the processor, children too, the median of
three, taken in turn.
"""

import resource
import sys
import time
from datetime import UTC, datetime
from pathlib import Path

from instrument.threads import one_thread

one_thread()

import numpy as np  # noqa: E402

from instrument.pipeline.record import versions  # noqa: E402
from instrument.precision import Form, beamed, diffuse, faraday, imagers, photometry, spectra  # noqa: E402
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
MATRIX = {"matrix": plugin_class("engines", "matrix")}
JOBS = {
    "imagers": lambda: [imagers.contest(DIRTY, *size, FORM) for size in imagers.SIZES],
    "rm-synthesis": lambda: [faraday._synthesis(side, FORM) for side in (8, 48, 160)],
    "rm-clean": lambda: [faraday._clean(side, FORM) for side in (2, 8)],
    "spectra": lambda: [
        make(FORM, *size) for make in (spectra._floor, spectra._known) for size in ((64, 32), (96, 64))
    ],
    "predict-beams": lambda: [beamed.contest(count, MATRIX, FORM) for count in beamed.SOURCES[1]],
    "gridded": lambda: diffuse.contests(("direct", "gridded"), Form()),
    "photometry": lambda: [contest for size in photometry.SIZES for contest in photometry._pair(FORM, *size)],
}
WHY = {
    "imagers": "ducc0 alone makes the images that are not zero, and no more. Ours calls it with half of what is asked "
    "for, so that no pixel is off by more, and makes and fits the PSF besides: a call more for each image. radiomesh "
    "0.1.2 comes to 2.2e-4 and stays there whatever its kernel; its expressions are compiled once here, at every call "
    "by itself.",
    "rm-synthesis": "Both peers are transforms of finufft, whose cost hardly depends on the accuracy. Ours begins with "
    "18 ms: a quarter for the RMSF, a sixth for the noise of the channels, a fifth for the tables of its product; that "
    "noise, from 4096 spectra at most, is half of its time at 64 x 64 pixels. No other measures it.",
    "rm-clean": "Both peers loop in Python, over pixels and over components; ours is compiled.",
    "spectra": "ps_eor turns images into visibilities, these into delays, and keeps both; ours makes the cells that "
    "are kept. Its power is N / (N - 1) too high by its bandwidth, which stands in its errors.",
    "predict-beams": "DP3 is a process of its own: its start, the reading and the writing of its data set are in its "
    "time, and cost more than the rest where sources are few. It works in 32 bit and sees sources and beam former from "
    "two places on Earth, 0.1 arcsec apart: its error is against the sum in its own frames; against ours it is 2e-6.",
    "gridded": "What is asked for bounds the largest error over the total flux, whatever the sky and the baseline; "
    "what comes is far smaller. The error of the leakage alone, that of I of a sky of Q and U over the rms of that I, "
    "stands beside it. Of what it leaves in P(k) nearly all is coherent along frequency, as beams between nodes are "
    "wrong in the same way in all channels: it stays at the lowest delays, and the rest is far below the signal.",
    "photometry": "Of n times more integrations the error is sqrt(n) smaller, and the seconds n times as many; what "
    "pixels have beside noise is side lobes of the others, which no integration takes away. By iterations an answer is "
    "said to be converged where it is within ten times of what was asked for, times the condition of the sources.",
}


def spent():
    """Seconds of the processor, of this process and of those it has started."""
    children = resource.getrusage(resource.RUSAGE_CHILDREN)
    return time.process_time() + children.ru_utime + children.ru_stime


def main():
    for job in sys.argv[1:] or JOBS:
        contests = JOBS[job]()
        found = []
        for contest in contests:
            rows = measured(contest, quick=True, clock=spent)
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
    alone = not any(row.peer for _, rows in found for row in rows)
    title = f"# {job}" if alone else f"# {job} beside programs of others"
    lines = [title, "", f"{datetime.now(UTC):%Y-%m-%d}. {facts}.", ""]
    lines += [", ".join(f"{name} {number}" for name, number in known.items()) + ".", ""]
    lines += [
        f"![error against seconds]({job}.png)",
        "",
        f"Processor seconds, one thread. Truth: {found[0][0].truth}.",
        "",
    ]
    lines += answers(found) if alone else beside(found)
    lines += ["", *(f"* {text}" for text in crossovers(found) + peers_ahead(found)), "", WHY[job], ""]
    return "\n".join(
        [*lines, f"Made by `python docs/reports/precision/cubes.py {job}`; all answers are in {job}.ecsv.", ""]
    )


def beside(found):
    """At each error the quickest of ours and of theirs."""
    lines = ["| job | error at most | ours | s | peer | s | ours over peer |", "|---|---|---|---|---|---|---|"]
    for contest, rows in found:
        levels = [e for e in ERRORS if any(r.error <= e for r in rows)] or [max(r.error for r in rows)]
        for error in levels:
            pair = [choice([r for r in rows if r.peer is peer], error) for peer in (False, True)]
            cells = [f"{r.plugin}, {r.asked:.2g} | {r.seconds:.2g}" if r else "none | – " for r in pair]
            ratio = f"{pair[0].seconds / pair[1].seconds:.2g}" if all(pair) else "–"
            lines.append(f"| {contest.name} | {error:.0e} | {' | '.join(cells)} | {ratio} |".replace(", nan |", " |"))
    return lines


def answers(found):
    """All that was asked, and what came."""
    yield "| job | | asked | error | in the user's quantity | s | |"
    yield "|---|---|---|---|---|---|---|"
    for contest, rows in found:
        for row in rows:
            asked = f"{contest.knob} {row.asked:g}" if np.isfinite(row.asked) else "–"
            numbers = f"{row.error:.1e} | {row.error_user:.1e} | {row.seconds:.2g}"
            yield f"| {contest.name} | {row.plugin} | {asked} | {numbers} | {row.outcome} |"


if __name__ == "__main__":
    main()
