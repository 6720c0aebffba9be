"""Self-calibrations that are hard to be right about: how many converge, are right, or say what is wrong.

    python docs/reports/hard_calibrations.py [--cases 15] [--directional 60]

Cases, and the judge that knows the truth, are those of tests/faults/hard_calibrations.py. Writes hard_calibrations.md
beside this file.
"""

import argparse
import importlib.util
import platform
import time
from datetime import date
from importlib.metadata import version
from pathlib import Path

HERE = Path(__file__).parent


def load_cases():
    """The generators and the judge that the tests use."""
    path = HERE.parents[1] / "tests/faults/hard_calibrations.py"
    spec = importlib.util.spec_from_file_location("hard_calibrations", path)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def rows_of(hard, kinds, cases):
    """Kind, cases, converged and right, converged and wrong but said, wrong and silent, not converged, intervals."""
    rows = []
    for kind in kinds:
        found = [hard.judged(hard.drawn(kind, seed)) for seed in range(cases)]
        wrong = [v for v in found if v.converged and v.worst > hard.WRONG]
        right = [v for v in found if v.converged and v.worst <= hard.WRONG]
        silent = [v for v in wrong if not v.said]
        solved, of = (sum(x) for x in zip(*((v.converged, v.intervals) for v in found), strict=True))
        rows.append((kind, cases, len(right), len(wrong) - len(silent), len(silent), cases - len(right) - len(wrong),
                     f"{solved} of {of}"))  # fmt: skip
        print(rows[-1], flush=True)
    return rows


def table(head, rows):
    """Lines of a Markdown table."""
    lines = [head, *rows]
    lines.insert(1, tuple("---" for _ in head))
    return ["| " + " | ".join(str(x) for x in line) + " |" for line in lines]


def main():
    """Run, print and write."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--cases", type=int, default=15)
    parser.add_argument("--directional", type=int, default=60)
    given = parser.parse_args()
    hard, begin = load_cases(), time.perf_counter()
    difficult, normal = (rows_of(hard, kinds, given.cases) for kinds in (hard.HARD, hard.NORMAL))
    towards = hard.directional_rows(given.directional)
    head = ("kind", "cases", "right", "wrong, said", "wrong, silent", "none converged", "intervals converged")
    silent = sum(r[4] for r in difficult)
    text = [
        "# Hard self-calibrations: right, or said",
        "",
        f"{date.today()}, {platform.machine()}, Python {platform.python_version()}, numpy {version('numpy')}, "
        f"numba {version('numba')}, instrument {version('instrument')}.",
        f"Made by `python docs/reports/hard_calibrations.py --cases {given.cases} "
        f"--directional {given.directional}` in {time.perf_counter() - begin:.0f} s.",
        "",
        f"Wrong: an interval says CONVERGED and a visibility that is not flagged, corrected, is off by more than "
        f"{100 * hard.WRONG:.0f} % of the rms of the model, without noise and outside the interference itself. "
        "Said: the solution prints a sentence about it (`solution.doubts`). An interval that did not converge "
        f"is flagged, and its outcome says why. "
        f"Of {sum(r[1] for r in difficult)} hard cases {silent} are wrong and silent.",
        "",
        *table(head, difficult),
        "",
        "Ordinary cases. Here \"wrong\" is the noise that a solution takes up and what its pattern or model lacks, "
        "which no solver can avoid; what counts is the last column: intervals that do converge.",
        "",
        *table(head, normal),
        "",
        "One visibility times 3 to 10 000 in a directional solve of two clusters, one minute, 10 stations. Wrong: the "
        "prediction differs from that of a solve without it by more than 1 %.",
        "",
        *table(("robust", "noise", "cases", "right", "wrong, silent", "not converged"), towards),
        "",
    ]  # fmt: skip
    (HERE / "hard_calibrations.md").write_text("\n".join(text))
    print("\n".join(text))


if __name__ == "__main__":
    main()
