"""Thousands of hostile inputs through every reader and command; writes the table of fuzz.md beside this file.

    python docs/reports/fuzz.py [COUNT] [SEED] [--dry]

Every case is a forked process with limits (20 s of CPU, or twice those of a healthy scene with all figures; 2 GB). It
must be done and whole, or refused in one line with nothing left behind. `--dry` prints the faults alone and writes
nothing.
"""

import platform
import shutil
import sys
import tempfile
import time
from datetime import date
from importlib import import_module
from importlib.metadata import version
from pathlib import Path
from typing import Any

HERE = Path(__file__).resolve().parent
sys.path.insert(0, str(HERE.parents[1] / "tests" / "fuzz"))

seeds, choose, harness = (import_module(f"fuzzing.{name}") for name in ("seeds", "choose", "harness"))

WARM = [["run", "s.toml", "--no-verify", "--out", "warm"], ["run", "i.toml", "--out", "warm2"]]


def run(count: int, seed: int) -> list[Any]:
    """The verdicts; faults are printed as they come."""
    folder = Path(tempfile.mkdtemp(prefix="fuzz"))
    (folder / "s.toml").write_text(seeds.SCENE)
    (folder / "i.toml").write_text(seeds.IMAGES)
    found = []
    with harness.Zygote(WARM, folder) as zygote:
        for number, case in enumerate(choose.cases(count, seed, folder / "seeds")):
            found.append(zygote.judge(case))
            if not found[-1].good:
                print(f"{number}: {found[-1]}\n", flush=True)
            if number % 100 == 99:
                print(f"{number + 1} cases", flush=True)
    shutil.rmtree(folder, ignore_errors=True)
    return found


def report(found: list[Any], seed: int, seconds: float) -> str:
    """The page."""
    rows = harness.tally(found)
    total = {key: sum(row[key] for row in rows.values()) for key in ("cases", "done", "long", "refused", "faults")}
    total |= {key: max(row[key] for row in rows.values()) for key in ("most_ms", "most_mb")}
    lines = [
        "# Hostile input",
        "",
        f"{total['cases']} mutated inputs (seed {seed}), each in a forked process with at most 20 s of CPU and 2 GB.",
        "A case is right when it is done and its folder is whole and can be read back, or when it is refused in one",
        "line with status 2 and nothing left behind. Anything else is a fault: a traceback, the line of an unexpected",
        "error, a hang, too much memory, a file outside of its folder, a changed input, control characters. Long:",
        "stopped after 20 s at work of which the plan had said that it takes as long.",
        "",
        "| kind | cases | done | long | refused | faults | most CPU, s | most memory, MB |",
        "|---|---|---|---|---|---|---|---|",
        *(
            f"| {name} | {row['cases']} | {row['done']} | {row['long']} | {row['refused']} | {row['faults']} | "
            f"{row['most_ms'] / 1e3:.1f} | {row['most_mb']} |"
            for name, row in [*sorted(rows.items()), ("all", total)]
        ),
        "",
        f"{date.today()}, {seconds:.0f} s; Python {platform.python_version()}, "
        + ", ".join(f"{name} {version(name)}" for name in ("instrument", "numpy", "astropy", "h5py", "pydantic")),
        f"`python docs/reports/fuzz.py {total['cases']} {seed}`",
    ]
    return "\n".join(lines) + "\n"


if __name__ == "__main__":
    words = [word for word in sys.argv[1:] if word != "--dry"]
    count, seed = (int(word) for word in [*words, *("3000", "1")[len(words) :]])
    begin = time.perf_counter()
    verdicts = run(count, seed)
    text = report(verdicts, seed, time.perf_counter() - begin)
    print(text)
    if "--dry" not in sys.argv:
        (HERE / "fuzz.md").write_text(text, encoding="utf-8")
    sys.exit(any(not verdict.good for verdict in verdicts))
