"""Elements and station beams of LOFAR beside EveryBeam: error against seconds, at the same directions.

    pip install ".[peers]" && python docs/reports/precision/beams.py [--full]

Writes beams.md, beams.ecsv and beams.png beside this file. All in one process, one call in turn with the other.
"""

import argparse
import platform
from datetime import UTC, datetime
from importlib.metadata import version
from pathlib import Path

from instrument.pipeline.record import versions
from instrument.precision import Form, contests_of
from instrument.precision.command import table
from instrument.precision.conditions import machine
from instrument.precision.contest import front, measured
from instrument.report.precision import precision_figure
from instrument.report.style import save
from instrument.whole_file import write_ecsv

HERE = Path(__file__).parent


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--full", action="store_true", help="all values, repeats until the median is known")
    form = Form(quick=not parser.parse_args().full, peers=True)
    facts, known = machine(), versions()
    used = ("instrument", "everybeam", "numpy", "numba", "scipy", "python-casacore")
    known |= {name: version(name) for name in used}
    contests = [contests_of("elements", ("hamaker",), form)[0], *contests_of("telescopes", form=form)]
    found = [(contest, rows := measured(contest, form.quick), front(rows)) for contest in contests]
    every = [row for _, rows, _ in found for row in rows]
    command = "python docs/reports/precision/beams.py" + " --full" * (not form.quick)
    (HERE / "beams.ecsv").unlink(missing_ok=True)
    write_ecsv(table(every, command, facts, known), HERE / "beams.ecsv")
    save(precision_figure(found), HERE / "beams.png", overwrite=True)
    lines = [
        "# Beams of LOFAR beside EveryBeam",
        "",
        f"{datetime.now(UTC):%Y-%m-%d %H:%M} UTC, {facts['processor']}, load before {facts['load before']},",
        f"Python {platform.python_version()}, {', '.join(f'{name} {known[name]}' for name in used)}.",
        f"Made by `{command}`.",
        "",
        "Errors are against the formulas in extended precision, EveryBeam's towards the same ITRF vectors and in the",
        "basis of the antennas: its frames, 0.7 arcsec from ours, are no part of it. Ours turns ICRS directions into",
        "these vectors, and matrices into north and east, in the time given; EveryBeam is given the vectors, a call",
        "for each time and direction that answers for all stations; its element is one call for all directions.",
        "",
        "| contest | | asked | largest error | leakage, rms error | µs a matrix | spread |",
        "|---|---|---|---|---|---|---|",
    ]
    for contest, rows, _ in found:
        count = int(next(word for word in contest.name.split() if word.isdigit()))
        for row in rows:
            each = f"{1e6 * row.seconds / count:.2g} | {100 * row.seconds_spread:.0f} %"
            lines.append(
                f"| {contest.name.split(',')[0]} | {row.plugin} | {contest.knob} {row.asked:g} | {row.error:.1e} | "
                f"{row.error_user:.1e} | {each} |"
            )
    (HERE / "beams.md").write_text("\n".join(lines) + "\n")
    print("\n".join(lines))


if __name__ == "__main__":
    main()
