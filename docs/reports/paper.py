"""The paper's numbers beside ours: the tables of docs/paper.md, out of a full run and of twenty quick ones.

    instrument paper --out FULL                            the full form, once; --out AGAIN, a second time
    python docs/reports/paper.py --seeds 20 --work QUICK   the quick form with seeds 1 to 20: paper/seeds.ecsv
    python docs/reports/paper.py --full FULL [--again AGAIN]   tables and figures

Runs that QUICK holds already are not run again. The tables are put between the two marks in docs/paper.md, the figures
into docs/reports/paper; AGAIN is compared number by number, and what differs is told in paper/again.md.
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
    parser.add_argument("--full", type=Path)
    parser.add_argument("--again", type=Path)
    given = parser.parse_args()
    if given.seeds:
        spread(given.work, given.seeds)
    if given.full:
        tables(given.full)
        figures(given.full)
    if given.again:
        again(given.full, given.again)


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


def tables(full):
    """Put the tables of a full run into docs/paper.md."""
    run, known = json.loads((full / "run.json").read_text()), deviations()
    versions = ", ".join(
        f"{name} {text}" for name, text in run["versions"].items() if name in ("instrument", "numpy", "ducc0")
    )
    total, peak = sum(run["seconds"].values()) / 60, max(run["memory"].values()) / 1e9
    seeds = max((count for _, count in known.values()), default=0)
    parts = [
        MARKS[0],
        f"`instrument paper`, {run['finished'][:10]}, {versions}: {total:.0f} minutes on two cores, {peak:.1f} GB. "
        f"After ± the standard deviation of the number over {seeds} seeds of the quick form (`--quick --seed N`).",
    ]
    for name, numbers in run["numbers"].items():
        title = EXPERIMENTS[name][1]
        said = run["verdicts"][name]
        parts.append(f"### `{name}`: {title}\n\n**{said[0].upper()}{said[1:]}.** {run['seconds'][name]:.0f} s.\n")
        lines = ["| | ours | the paper | |", "|---|---|---|---|"]
        for row in Table.read(full / f"{name}.ecsv"):
            std = known.get((name, str(row["what"])), (0.0, 0))[0]
            error = f" ± {number(std, 2)}" if std > 0 else ""
            text = [
                str(row[key])
                for key in ("agreement", "because", "since")
                if row[key] is not np.ma.masked and str(row[key])
            ]
            unit = "" if row["unit"] is np.ma.masked else str(row["unit"])
            paper_said = "" if row["paper"] is np.ma.masked else str(row["paper"])
            lines.append(
                f"| {row['what']} | {number(float(row['ours']))}{error} {unit} | {paper_said} | {'; '.join(text)} |"
            )
        assert len(numbers) == len(lines) - 2
        parts.append("\n".join(lines))
        parts.append("\n".join(f"![{name}: {figure}](reports/paper/{name}_{figure}.png)" for figure in SHOWN[name]))
    parts.append(MARKS[1])
    page = PAGE.read_text()
    new = "\n\n".join(parts)
    found = re.search(re.escape(MARKS[0]) + ".*" + re.escape(MARKS[1]), page, re.S)
    assert found, f"{PAGE} has lost its marks"
    PAGE.write_text(page[: found.start()] + new + page[found.end() :])


def figures(full):
    """The figures of the page, not wider than 1100 points."""
    from PIL import Image

    for name, names in SHOWN.items():
        for figure in names:
            image = Image.open(full / name / f"{figure}.png").convert("RGB")
            image.thumbnail((1100, 1100))
            image.quantize(128).save(HERE / f"{name}_{figure}.png", optimize=True)


def again(full, other):
    """Numbers of two runs of the full form that are not the same."""
    one, two = (json.loads((folder / "run.json").read_text()) for folder in (full, other))
    rows = []
    for name, numbers in one["numbers"].items():
        for what, value in numbers.items():
            beside = two["numbers"][name][what]
            if beside != value:
                share = abs(beside - value) / max(abs(value), 1e-300)
                rows.append(f"| {name} | {what} | {number(value, 6)} | {number(beside, 6)} | {share:.1e} |")
    every = sum(len(numbers) for numbers in one["numbers"].values())
    text = (
        f"# Two runs of the full form\n\n`instrument paper`, {one['finished'][:16]} and {two['finished'][:16]}; "
        f"{sum(one['seconds'].values()) / 60:.0f} and {sum(two['seconds'].values()) / 60:.0f} minutes, "
        f"{max(one['memory'].values()) / 1e9:.2f} and {max(two['memory'].values()) / 1e9:.2f} GB.\n\n"
        f"{every - len(rows)} of {every} numbers are the same to the last bit.\n"
    )
    if rows:
        text += "\n| | | first | second | differs by |\n|---|---|---|---|---|\n" + "\n".join(rows) + "\n"
    (HERE / "again.md").write_text(text)


if __name__ == "__main__":
    main()
