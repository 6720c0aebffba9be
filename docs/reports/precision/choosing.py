"""The table of docs/choosing.md, from contests that have been measured.

    instrument precision all --quick --out runs/all && python docs/reports/precision/choosing.py runs/all [MORE ...]

Of each contest what to take at which error, and what it took here. Rewrites what stands below the heading "Measured".
"""

import re
import sys
from pathlib import Path

import numpy as np
from astropy.table import QTable

from instrument.precision.advice import ERRORS
from instrument.precision.contest import Row, choice

PAGE = Path(__file__).parents[2] / "choosing.md"
MARK = "## Measured\n"


def main():
    lines, made = [], []
    for folder in sys.argv[1:]:
        table = QTable.read(Path(folder) / "precision.ecsv")
        versions = ", ".join(f"{name} {version}" for name, version in table.meta["versions"].items())
        command = re.sub(r"--out \S+", "--out runs/all", table.meta["command"])
        machine = ", ".join(f"{name} {value}" for name, value in table.meta["machine"].items())
        made.append(f"{table.meta['made'][:10]}: `{command}`; {machine}; {versions}.")
        for name in dict.fromkeys(table["contest"]):
            lines += rows_of(name, table[table["contest"] == name])
    text = (
        "\n".join(made)
        + "\n\nSeconds are what one answer took on that machine, for the size of the contest: compare them with each "
        "other only.\n\n| contest | error at most | take | seconds | error that came |\n|---|---|---|---|---|\n"
        + "\n".join(lines)
    )
    page = PAGE.read_text(encoding="utf-8")
    PAGE.write_text(page[: page.index(MARK) + len(MARK)] + "\n" + text + "\n", encoding="utf-8")
    print(text)


def rows_of(name, table):
    """Lines of one contest: a choice for each error that is reached, those that are the same together."""
    rows = [Row(**{key: plain(row[key]) for key in table.colnames}) for row in table]
    picks = {}
    for error in ERRORS:
        if (row := choice(rows, error)) is not None:
            picks.setdefault(row, []).append(error)
    if not picks:
        good = [row for row in rows if np.isfinite(row.error)]
        picks = {min(good, key=lambda row: row.error): []} if good else {}
    out = []
    for row, errors in picks.items():
        said = " to ".join(dict.fromkeys(f"{e:.0e}" for e in (errors[0], errors[-1]))) if errors else "least of all"
        asked = f", {row.knob} {row.asked:.2g}" if np.isfinite(row.asked) else ""
        out.append(f"| {name} | {said} | `{row.plugin}`{asked} | {row.seconds:.2g} | {row.error:.1e} |")
    return out


def plain(value):
    """A number or a string without its unit."""
    return value.value if hasattr(value, "unit") else value.item() if hasattr(value, "item") else value


if __name__ == "__main__":
    main()
