"""The paper's numbers beside ours: the tables of docs/paper.md, out of a full run and of twenty quick ones.

    instrument paper --out FULL                            the full form, once; --out AGAIN, a second time
    python docs/reports/paper.py --seeds 20 --work QUICK   the quick form with seeds 1 to 20: paper/seeds.ecsv
    python docs/reports/paper.py --full FULL [MORE ...] [--again AGAIN]   tables and figures

Runs that QUICK holds already are not run again; of an experiment that several full runs have, the last is taken. The
tables are put between the two marks in docs/paper.md, the figures into docs/reports/paper; AGAIN is compared number by
number, and what differs is told in paper/again.md.
"""

import argparse
import json
import re
from pathlib import Path

import numpy as np
from astropy.table import Table

from instrument.paper.command import paper
from instrument.paper.experiments import EXPERIMENTS
from instrument.report.page import number

HERE = Path(__file__).parent / "paper"
PAGE = Path(__file__).parents[1] / "paper.md"
MARKS = "<!-- tables: python docs/reports/paper.py -->", "<!-- end of tables -->"
FIXED = ("beam", "ixr", "errata")  # nothing in them, or next to nothing, is drawn
SHOWN = {  # figures of docs/paper.md
    "beam": ("mueller", "leakage"), "di-errors": ("spectra",), "mock-grid": ("profile",), "3c196": ("spectra",),
    "incomplete-model": ("errors",), "aw-correction": ("sources",), "galactic": ("faraday_I", "ratio", "window"),
    "gmca": ("gmca",), "whole-way": ("recovered",), "ixr": ("removal",), "errata": ("slips",),
}  # fmt: skip


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=int, default=0)
    parser.add_argument("--work", type=Path, default=Path("runs/paper-seeds"))
    parser.add_argument("--full", type=Path, nargs="+", default=[])
    parser.add_argument("--again", type=Path)
    given = parser.parse_args()
    if given.seeds:
        spread(given.work, given.seeds)
    runs = {name: (folder, run) for folder in given.full for run in [record(folder)] for name in run["numbers"]}
    if runs:
        tables(runs)
        figures(runs)
    if given.again:
        again(given.full[0], given.again)


def record(folder):
    return json.loads((folder / "run.json").read_text())


def spread(work, count):
    """Mean and standard deviation of every number over seeds."""
    work.mkdir(parents=True, exist_ok=True)
    names = [name for name in EXPERIMENTS if name not in FIXED]
    found, missed = {}, {}
    for seed in range(1, count + 1):
        out = work / f"seed-{seed}"
        if not (out / "run.json").exists():
            paper(names, quick=True, seed=seed, out=str(out))
        run = json.loads((out / "run.json").read_text())
        for name, numbers in run["numbers"].items():
            for what, value in numbers.items():
                found.setdefault((name, what), []).append(np.nan if value is None else value)
            table = Table.read(out / f"{name}.ecsv")
            for row in table:
                if row["agreement"] == "NOT REPRODUCED":
                    missed[name, row["what"]] = missed.get((name, row["what"]), 0) + 1
    rows = [
        (
            name,
            what,
            len(v),
            np.nanmean(v),
            np.nanstd(v, ddof=1),
            np.nanmin(v),
            np.nanmax(v),
            missed.get((name, what), 0),
        )
        for (name, what), v in found.items()
    ]
    heads = ("experiment", "what", "seeds", "mean", "std", "least", "most", "not_reproduced")
    out = Table(rows=rows, names=heads)
    out.meta["command"] = f"python docs/reports/paper.py --seeds {count}"
    out.meta["versions"] = json.loads((work / "seed-1" / "run.json").read_text())["versions"]
    out.write(HERE / "seeds.ecsv", format="ascii.ecsv", overwrite=True)


def deviations():
    """Standard deviation by experiment and number, of the quick form over seeds."""
    if not (HERE / "seeds.ecsv").exists():
        return {}
    return {
        (str(r["experiment"]), str(r["what"])): (float(r["std"]), int(r["seeds"]))
        for r in Table.read(HERE / "seeds.ecsv")
    }


def tables(runs):
    """Put the tables of full runs, by experiment, into docs/paper.md."""
    known = deviations()
    last = max((run for _, run in runs.values()), key=lambda run: run["finished"])
    versions = ", ".join(f"{name} {last['versions'][name]}" for name in ("instrument", "numpy", "ducc0"))
    total = sum(run["seconds"][name] for name, (_, run) in runs.items()) / 60
    peak = max(max(run["memory"].values()) for _, run in runs.values()) / 1e9
    seeds = max((count for _, count in known.values()), default=0)
    said = (
        f" After ± the standard deviation over {seeds} seeds of the quick form (`--quick --seed N`)." if seeds else ""
    )
    parts = [
        MARKS[0],
        f"`instrument paper`, {last['finished'][:10]}, {versions}: {total:.0f} minutes, {peak:.1f} GB.{said}",
    ]
    for name in (name for name in EXPERIMENTS if name in runs):
        folder, run = runs[name]
        said = run["verdicts"][name]
        seconds = f"{run['seconds'][name]:.0f} s"
        parts.append(f"### `{name}`: {EXPERIMENTS[name][1]}\n\n**{said[0].upper()}{said[1:]}.** {seconds}.")
        lines = ["| | ours | the paper | |", "|---|---|---|---|"]
        for row in Table.read(folder / f"{name}.ecsv"):
            text = {key: "" if row[key] is np.ma.masked else str(row[key]) for key in row.colnames}
            std = known.get((name, text["what"]), (0.0, 0))[0]
            ours = number(float(row["ours"])) + (f" ± {number(std, 2)}" if std > 0 else "")
            why = "; ".join(text[key] for key in ("agreement", "because", "since") if text[key])
            lines.append(f"| {text['what']} | {ours} {text['unit']} | {text['asked']} | {why} |")
        assert len(run["numbers"][name]) == len(lines) - 2
        parts.append("\n".join(lines))
        parts += [f"![{name}: {figure}](reports/paper/{name}_{figure}.png)" for figure in SHOWN[name]]
    parts.append(MARKS[1])
    page = PAGE.read_text()
    new = "\n\n".join(parts)
    found = re.search(re.escape(MARKS[0]) + ".*" + re.escape(MARKS[1]), page, re.S)
    assert found, f"{PAGE} has lost its marks"
    PAGE.write_text(page[: found.start()] + new + page[found.end() :])


def figures(runs):
    """The figures of the page, not wider than 1100 points."""
    from PIL import Image

    for name, (folder, _) in runs.items():
        for figure in SHOWN[name]:
            image = Image.open(folder / name / f"{figure}.png").convert("RGB")
            image.thumbnail((1100, 1100))
            image.quantize(128).save(HERE / f"{name}_{figure}.png", optimize=True)


def again(full, other):
    """Numbers of two runs of the full form that are not the same."""
    one, two = record(full), record(other)
    rows, alone = [], []
    for name, numbers in one["numbers"].items():
        for what, value in numbers.items():
            if what not in two["numbers"].get(name, {}):
                alone.append(f"{name}: {what}")
                continue
            beside = two["numbers"][name][what]
            if beside != value:  # None, which is NaN, is itself
                share = abs(beside - value) / max(abs(value), 1e-300)
                rows.append(f"| {name} | {what} | {number(value, 6)} | {number(beside, 6)} | {share:.1e} |")
    every = sum(len(numbers) for numbers in one["numbers"].values()) - len(alone)
    text = (
        f"# Two runs of the full form\n\n`instrument paper`, {one['finished'][:16]} and {two['finished'][:16]}; "
        f"{sum(one['seconds'].values()) / 60:.0f} and {sum(two['seconds'].values()) / 60:.0f} minutes, "
        f"{max(one['memory'].values()) / 1e9:.2f} and {max(two['memory'].values()) / 1e9:.2f} GB.\n\n"
        f"{every - len(rows)} of {every} numbers are the same to the last bit.\n"
    )
    if alone:
        text += f"\nOf the first run alone, whose program has them since: {'; '.join(alone)}.\n"
    if rows:
        text += "\n| | | first | second | differs by |\n|---|---|---|---|---|\n" + "\n".join(rows) + "\n"
    (HERE / "again.md").write_text(text)


if __name__ == "__main__":
    main()
