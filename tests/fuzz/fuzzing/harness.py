"""Cases, the running of them in forked processes, and the verdict on what they said and left."""

from __future__ import annotations

import json
import os
import re
import shutil
import subprocess
import sys
import tomllib
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

from fuzzing.seeds import WHOLE

ZYGOTE = Path(__file__).with_name("zygote.py")
# wall time is generous: that is no hang. Where a case took CPU_S, it gets twice what healthy work takes at that time
CPU_S, WALL_S, MEMORY, MORE = 20, 180, 2e9, 1.6e9
GOOD = ("done", "refused", "long")
ANNOUNCED = re.compile(r"^engine .* about (?:(\d+) s|\d+ min)", re.M)


@dataclass(frozen=True)
class Case:
    """One hostile input: files that `setup` makes in a folder, and the command (or reader) that is given them."""

    name: str
    kind: str
    setup: Callable[[Path], None]
    argv: tuple[str, ...] = ()
    call: str = ""
    path: str = ""
    out: str = "o"  # the folder it may write
    text: str = ""  # what it is, for a person
    extra: dict = field(default_factory=dict)


@dataclass(frozen=True)
class Verdict:
    """What came of a case: done, refused, or a fault and what it said."""

    case: Case
    verdict: str
    said: str
    wall_s: float
    cpu_s: float
    peak: int
    status: int | None = None
    left: tuple[str, ...] = ()

    @property
    def good(self) -> bool:
        """Whether it is right for hostile input: done and whole, or refused in one line with nothing left."""
        return self.verdict in GOOD

    def __str__(self) -> str:
        return f"{self.verdict}: {self.case.name} [{self.case.text or ' '.join(self.case.argv)}] {self.said[-500:]}"


class Zygote:
    """A loaded process that forks one child a case; used in a `with`. `warm`: commands that it runs first."""

    def __init__(self, warm: list[list[str]], folder: Path) -> None:
        self.folder = folder
        folder.mkdir(parents=True, exist_ok=True)
        words = [sys.executable, str(ZYGOTE), json.dumps(warm)]
        self._process = subprocess.Popen(
            words, stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, cwd=folder
        )
        answer = self._process.stdout.readline().strip()
        if answer != "ready":
            raise RuntimeError(f"the process that forks cases did not start: {self._process.stderr.read()[-2000:]}")

    def __enter__(self) -> Zygote:
        return self

    def __exit__(self, *error: object) -> None:
        self._process.stdin.close()
        self._process.wait(30)
        for stream in (self._process.stdout, self._process.stderr):
            stream.close()

    def ask(self, case: Case, folder: Path, cpu_s: float = CPU_S) -> dict:
        """Run a case in a folder; the answer of the process, with what it wrote on its streams."""
        out, err = (folder.with_name(f"{folder.name}.{name}") for name in ("out", "err"))
        asked = {
            "argv": list(case.argv),
            "call": case.call,
            "path": case.path,
            "cwd": str(folder),
            "out": str(out),
            "err": str(err),
            "cpu_s": cpu_s,
            "wall_s": WALL_S,
            "memory": MEMORY,
            "more": MORE,
            **case.extra,
        }
        print(json.dumps(asked), file=self._process.stdin, flush=True)
        answer = json.loads(self._process.stdout.readline())
        for name, path in (("said", err), ("shown", out)):
            answer[name] = path.read_bytes().decode(errors="replace") if path.is_file() else ""
            path.unlink(missing_ok=True)
        return answer

    def judge(self, case: Case) -> Verdict:
        """What comes of a case; a hang is tried twice, for the first may have compiled what the second finds.

        The second time it has twice the processor time of a small scene with all that can be drawn of it, measured
        then: other work on the machine, or a slow one, makes a second do less.
        """
        found = self._judged(case)
        return self._judged(case, max(CPU_S, 2 * self.healthy_s())) if found.verdict == "FAULT hang" else found

    def healthy_s(self) -> float:
        """Processor seconds of the small scene with all figures, now."""
        folder = self.folder / "healthy"
        shutil.rmtree(folder, ignore_errors=True)
        folder.mkdir()
        (folder / "s.toml").write_text(WHOLE)
        answer = self.ask(Case("whole", "healthy", lambda _: None, ("run", "s.toml", "--out", "o")), folder, WALL_S)
        if answer["status"] != 0:
            raise RuntimeError(f"the healthy scene was not done: {answer}")
        return answer["cpu_s"]

    def _judged(self, case: Case, cpu_s: float = CPU_S) -> Verdict:
        """Make the files of a case, run it, and say what came of it; the folder is removed when that is good."""
        folder = self.folder / "case"
        shutil.rmtree(folder, ignore_errors=True)
        folder.mkdir()
        case.setup(folder)
        before = snapshot(folder)
        answer = self.ask(case, folder, cpu_s)
        after = snapshot(folder)
        new = tuple(sorted(after.keys() - before.keys()))
        changed = sorted(k for k in before if after.get(k) != before[k])
        verdict = _verdict(case, answer, folder, new, changed)
        found = Verdict(
            case, verdict, answer["said"], answer["wall_s"], answer["cpu_s"], answer["peak"], answer["status"], new[:5]
        )
        if found.good:
            shutil.rmtree(folder, ignore_errors=True)
        return found


def _verdict(case: Case, answer: dict, folder: Path, new: tuple[str, ...], changed: list[str]) -> str:
    said = answer["said"].strip().splitlines()
    mine = [line for line in said if line.startswith("instrument: ")]
    complaints = [line for line in mine if not line.startswith("instrument: warning: ")]
    announced = ANNOUNCED.search(answer["shown"])
    if answer["killed"] == "hang" and announced and int(announced[1] or 60) >= CPU_S / 2:
        return "long"  # stopped at work whose length the plan had said
    if answer["killed"]:
        return f"FAULT {answer['killed']}"
    if answer["signal"]:
        return f"FAULT signal {answer['signal']}"
    if answer["peak"] > MEMORY:
        return "FAULT memory"
    if "Traceback" in answer["said"]:
        return "FAULT traceback"
    if any(line.startswith("instrument: unexpected ") for line in mine):
        return "FAULT unexpected"
    if any(c in answer["said"] + answer["shown"] for c in "\x1b\x07\x00"):
        return "FAULT control characters"
    if changed:
        return f"FAULT changed {changed[:3]}"
    if answer["status"] in (0, 3):
        outside = [name for name in new if name != case.out and not name.startswith(case.out + "/")]
        if outside:
            return f"FAULT outside {outside[:3]}"
        return _whole(folder / case.out) if case.argv[:1] in (("run",), ("analyze",)) else "done"
    if len(complaints) != 1 or len(mine) != len(said):
        return "FAULT not one line"
    if new:
        return f"FAULT left behind {new[:3]}"
    if answer["status"] == 1:
        return "FAULT status 1"
    return "refused" if answer["status"] == 2 else f"FAULT status {answer['status']}"


def _whole(folder: Path) -> str:
    """Whether a run folder is whole and can be read back."""
    if not (folder.is_dir() or folder.is_symlink()):
        return "done"  # another name was asked for, which the case knows
    for name in ("run.json", "report.html"):
        if not (folder / name).is_file():
            return f"FAULT half-written: no {name}"
    try:
        json.loads((folder / "run.json").read_text(encoding="utf-8"))
        if (folder / "scene.toml").exists():
            tomllib.loads((folder / "scene.toml").read_text(encoding="utf-8"))
    except ValueError as error:
        return f"FAULT unreadable: {error}"
    return "done"


def snapshot(folder: Path) -> dict[str, tuple[int, int]]:
    """Every name below a folder, with time and size of files."""
    found = {}
    for parent, folders, names in os.walk(folder):
        for name in folders + names:
            path = Path(parent) / name
            state = path.lstat()
            key = path.relative_to(folder).as_posix().encode(errors="backslashreplace").decode()
            found[key] = (0, 0) if path.is_dir() else (state.st_mtime_ns, state.st_size)
    return found


def tally(verdicts: list[Verdict]) -> dict[str, dict[str, int]]:
    """Counts of each kind of case: cases, done, long, refused, faults, most CPU milliseconds, most megabytes."""
    table: dict[str, dict[str, int]] = {}
    for found in verdicts:
        row = table.setdefault(found.case.kind, dict.fromkeys(("cases", "done", "long", "refused", "faults"), 0))
        row["cases"] += 1
        row[found.verdict if found.good else "faults"] += 1
        row["most_ms"] = max(row.get("most_ms", 0), round(1e3 * found.cpu_s))
        row["most_mb"] = max(row.get("most_mb", 0), round(found.peak / 1e6))
    return table
