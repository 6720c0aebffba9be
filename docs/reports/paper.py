"""The paper's numbers beside ours: the tables of docs/paper.md, out of a full run and of twenty quick ones.

    instrument paper --out FULL                            the full form, once; --out AGAIN, a second time
    python docs/reports/paper.py --seeds 20 --work QUICK   the quick form with seeds 1 to 20: paper/seeds.ecsv
    python docs/reports/paper.py --full FULL [MORE ...] [--again AGAIN]   tables and figures

Runs that QUICK holds already are not run again; of an experiment that several full runs have, the last is taken. The
tally, the tables and the list of columns are put between their marks in docs/paper.md, the figures into
docs/reports/paper; AGAIN is compared number by number, and what differs is told in paper/again.md.
"""

import argparse
import json
import re
from pathlib import Path

import numpy as np
from astropy.table import Table

from instrument.paper.command import COLUMNS, paper, row
from instrument.paper.experiments import EXPERIMENTS, WORDS
from instrument.paper.finding import NOT, Finding, tally, verdict
from instrument.report.page import number

HERE = Path(__file__).parent / "paper"
PAGE = Path(__file__).parents[1] / "paper.md"
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
    found, lacking = {}, {}
    for seed in range(1, count + 1):
        out = work / f"seed-{seed}"
        if not (out / "run.json").exists():
            paper(names, quick=True, seed=seed, out=str(out))
        run = json.loads((out / "run.json").read_text())
        for name, numbers in run["numbers"].items():
            for what, value in numbers.items():
                found.setdefault((name, what), []).append(np.nan if value is None else value)
            table = Table.read(out / f"{name}.ecsv")
            for line in table:
                if line["agreement"] == NOT:
                    lacking[name, line["what"]] = lacking.get((name, line["what"]), 0) + 1
    rows = [
        (
            name,
            what,
            len(v),
            np.nanmean(v),
            np.nanstd(v, ddof=1),
            np.nanmin(v),
            np.nanmax(v),
            lacking.get((name, what), 0),
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


def findings(folder, name):
    """The findings of an experiment in the folder of a run."""
    table = Table.read(folder / f"{name}.ecsv")
    found = []
    for line in table.filled("") if table.has_masked_columns else table:
        low, high = float(line["low"]), float(line["high"])
        given = {key: str(line[key]) for key in ("what", "unit", "paper", "because", "since", "end", "kept")}
        given |= {"within": None if np.isnan(low) else (low, high), "slip": bool(line["slip"])}
        found.append(Finding(**given, ours=float(line["ours"]), changed=float(line["changed"])))
    return found


MEANS = {  # what is not reproduced, by the beginning of its name
    "length of the baseline": "The stations are where they were surveyed; where the paper has its length from is not "
    "known.",
    "S as in the paper": "A matter of the gauge, not of what calibration loses: an unpolarized model leaves a unitary "
    "matrix free in each interval, and with it removed nothing is left. How the paper's solver leaves it is not known.",
    "image, corrupted less corrected": "Of the same order. It is less in the inner part of the image, and falls with "
    "more integrations; both together, reckoned, would lead into the range, and two changes are no reason.",
    "V below Q and U": "V is what the element's patterns make; as powers it would be twice as many orders. The paper's "
    "number lies between the two, and its own grid of sources has less than ours.",
    "leakage removed, the best source": "We remove more than the paper, not less: what stays is sidelobes of the other "
    "sources, and a source that is alone is corrected entirely. How much of them the paper's images hold is not known.",
    "k up to which the spherical leakage": "Leakage stays below the signal at every k that is measured: our number is "
    'the end of the axis. "Lower at k < 0.3" holds here too; it is read as a crossing at 0.3, for else it would say '
    "nothing. More noise in Q and U would make one: how much stands in the row.",
}


def missed(found):
    """The numbers that are not reproduced, and what that means."""
    lines = ["| not reproduced | ours | the paper | what it means |", "|---|---|---|---|"]
    for name, f in ((name, f) for name, every in found.items() for f in every if f.agreement == NOT):
        (means,) = (text for start, text in MEANS.items() if f.what.startswith(start))
        lines.append(f"| `{name}`: {f.what} | {f.value} | {f.asked} | {means} |")
    return "\n".join(lines)


def columns():
    """The columns of the tables of a run."""
    lines = [f"| `{key}` | {text} |" for key, text in COLUMNS.items()]
    return "\n".join(["| column of NAME.ecsv | |", "|---|---|", *lines])


def by_luck():
    """Numbers of which some seeds agree with the paper and others do not."""
    if not (HERE / "seeds.ecsv").exists():
        return ""
    return "; ".join(
        f"`{r['experiment']}`, {r['what']} (not in {r['not_reproduced']} of {r['seeds']})"
        for r in Table.read(HERE / "seeds.ecsv")
        if 0 < r["not_reproduced"] < r["seeds"]
    )


def tables(runs):
    """Put the tables of full runs, by experiment, into docs/paper.md; the tally, what is missed and columns, too."""
    known = deviations()
    main = max((run for _, run in runs.values()), key=lambda run: len(run["numbers"]))
    versions = told(main) + "".join(
        f" (`{name}` later: {told(run)})" for name, (_, run) in runs.items() if told(run) != told(main)
    )
    total = sum(run["seconds"][name] for name, (_, run) in runs.items()) / 60
    peak = max(max(run["memory"].values()) for _, run in runs.values()) / 1e9
    seeds = max((count for _, count in known.values()), default=0)
    said = (
        f" After ± the standard deviation over {seeds} seeds of the quick form (`--quick --seed N`)." if seeds else ""
    )
    parts = [f"`instrument paper`, {versions}: {total:.0f} minutes, {peak:.1f} GB.{said}"]
    if luck := by_luck():
        parts.append(f"By the seed the quick form agrees with the paper or does not in these: {luck}.")
    found = {name: findings(runs[name][0], name) for name in EXPERIMENTS if name in runs}
    for name, every in found.items():
        _, run = runs[name]
        assert len(run["numbers"][name]) == len(every)
        said = verdict(every)
        seconds = f"{run['seconds'][name]:.0f} s"
        parts.append(f"### `{name}`: {EXPERIMENTS[name][1]}\n\n**{said[0].upper()}{said[1:]}.** {seconds}.")
        if name in WORDS:
            parts.append(WORDS[name].replace("docs/calibrating.md", "[calibrating](calibrating.md#the-gauge)"))
        lines = ["| | ours | the paper | |\n", "|---|---|---|---|\n"]
        for f in every:
            std = known.get((name, f.what), (0.0, 0))[0]
            lines.append(
                row(f).replace(f"| {f.value} |", f"| {f.value} ± {number(std, 2)} |", 1)
                if std > 1e-9 * abs(f.ours)
                else row(f)
            )
        parts.append("".join(lines).rstrip())
        parts += [f"![{name}: {figure}](reports/paper/{name}_{figure}.png)" for figure in SHOWN[name]]
    put("tables", "\n\n".join(parts))
    put("tally", f"{tally([f for every in found.values() for f in every])}.\n\n{missed(found)}")
    put("columns", columns())


def told(run):
    """When and with what a run was made."""
    versions = (f"{name} {run['versions'][name]}" for name in ("instrument", "numpy", "ducc0"))
    return ", ".join((run["finished"][:10], *versions))


def put(part, text):
    """Put a text between the two marks of a part of the page."""
    start, end = f"<!-- {part}: python docs/reports/paper.py -->", f"<!-- end of {part} -->"
    page = PAGE.read_text()
    found = re.search(re.escape(start) + ".*" + re.escape(end), page, re.S)
    assert found, f"{PAGE} has lost its marks of {part}"
    PAGE.write_text(page[: found.start()] + f"{start}\n\n{text}\n\n{end}" + page[found.end() :])


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
