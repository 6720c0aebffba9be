"""Write tests/slow.txt: the tests that take longest, so many that the others end within a budget.

    pytest -m "" -p no:cacheprovider --durations=0 --durations-min=0.1 > times.txt
    python tests/slow.py times.txt [--minutes 5]

Minutes are those of two workers, at the speed of the run that was timed. What is marked `long` where it stands, what
compares with other programs and what is in KEPT is not listed; neither are files of which WHOLE gives the name, which
stand there whole: a fixture is all that they take.
"""

import argparse
import re
import time
from collections import Counter
from pathlib import Path

KEPT = ("tests/peers/", "tests/unit/test_architecture.py", "tests/unit/test_paper.py::test_the_experiment_ixr_whole")
WHOLE = ("tests/physics/test_mock_grid.py",)
LINE = re.compile(r"\s*([\d.]+)s (?:call|setup|teardown)\s+(\S+?)::(.*\S)")
HEAD = """# Tests that the default run leaves to `pytest -m long`. Written by tests/slow.py, {date}:
# {count} tests that took {spent:.0f} s of {total:.0f}, each {least:.1f} s or more.
"""


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("times", type=Path)
    parser.add_argument("--minutes", type=float, default=5.0)
    given = parser.parse_args()
    took = Counter()
    for found in filter(None, map(LINE.match, given.times.read_text().splitlines())):
        file, name = found[2], found[3]
        took[file if file in WHOLE else f"{file}::{name}"] += float(found[1])
    left = total = sum(took.values())
    slow = []
    for name, seconds in took.most_common():
        if left <= 2 * 60 * given.minutes:
            break
        if not name.startswith(KEPT):
            slow.append(name)
            left -= seconds
    least = took[slow[-1]] if slow else 0.0
    head = HEAD.format(date=time.strftime("%Y-%m-%d"), count=len(slow), spent=total - left, total=total, least=least)
    Path(__file__).with_name("slow.txt").write_text(head + "".join(f"{name}\n" for name in sorted(slow)))


if __name__ == "__main__":
    main()
