"""Mutants of the numerical code, one at a time in a copy of the package: does `instrument stress` find each?

    python docs/reports/mutants.py [--seeds 1,2] [--count 40] [--out docs/reports] [--first N]

Places are drawn by a seed (mutant_sites.py). The cases run on the copy in an order that begins with those that enter
the mutated function, as a run without mutants has shown; the first that finds the mutant ends the run. Found is: a case
comes out WRONG that was not, or is no longer right; or the program breaks or does not end. All cases that enter any
function of the file are tried before a mutant is said to have survived. Compiled loops are compiled anew where the
mutant may be in them. Writes mutants.md.
"""

import argparse
import hashlib
import importlib
import json
import os
import platform
import shutil
import subprocess
import sys
import tempfile
import threading
import time
from collections import Counter
from datetime import date
from importlib.metadata import version
from pathlib import Path
from typing import NamedTuple

from mutant_sites import GROUPS, ROOT, Site, drawn, sites

HERE = Path(__file__).parent
JUDGED = HERE / "mutants_judged.json"  # of survivors, by what they change: why
PLACES = {"instrument": "instrument", "plugins": "instrument_plugins"}


class Found(NamedTuple):
    """What became of a mutant: the case that found it and how, or nothing; how many cases enter its function."""

    site: Site
    case: str
    how: str
    entering: int
    seconds: float


# In the copy ---------------------------------------------------------------------------------------------------------


def place(file: str) -> str:
    """A file of the copy, relative to it."""
    return file.split("/tree/")[-1]


def child(order: str) -> None:
    """Try cases in an order (JSON: key and subject of each), a line of JSON for each; "watched", with what they enter.

    Without an order: one line of the cases that there are, and of the module of each.
    """
    from instrument.stress import MODULES
    from instrument.stress.case import cases_of, judged
    from instrument.stress.subjects import subjects
    from instrument.stress.suite import all_cases, trials

    todo = {(c.key, s.name): (c, s) for c, s in trials(subjects(None), all_cases()) if c.tried and not s.trouble}
    given = json.loads(order)
    if not given:
        home = {c.key: m for m in MODULES for c in cases_of(importlib.import_module(f"instrument.stress.{m}"))}
        print(json.dumps([[*name, home[name[0]]] for name in todo]), flush=True)
        return
    watched = given[0] == "watched"
    wanted = [tuple(x) for x in given[watched:]]
    entered: set[tuple[str, str]] = set()

    def note(frame, event, _):
        if event == "call":
            entered.add((frame.f_code.co_filename, frame.f_code.co_qualname))

    for name in wanted:
        entered.clear()
        begin = time.perf_counter()
        if watched:
            threading.setprofile(note)
            sys.setprofile(note)
        given, subject = todo[name]
        row = judged(given, subject.plugin)
        sys.setprofile(None)
        threading.setprofile(None)
        calls = sorted({f"{place(f)}:{q.replace('<locals>.', '')}" for f, q in entered if "/tree/" in f})
        seconds = time.perf_counter() - begin
        print(json.dumps([*name, row.verdict, row.remark, seconds, calls if watched else []]), flush=True)


class Copy:
    """A copy of the package in a temporary folder, and its caches of compiled loops."""

    def __init__(self, folder: Path) -> None:
        self.tree, self.base, self.fresh = folder / "tree", folder / "cache", folder / "fresh"
        for old in (self.tree, folder / "clean"):
            shutil.rmtree(old, ignore_errors=True)
        for source, name in PLACES.items():
            shutil.copytree(ROOT / source, self.tree / name, ignore=shutil.ignore_patterns("__pycache__"))
        shutil.copytree(self.tree, folder / "clean")
        self.clean = folder / "clean"
        self.compiled = {p for p in self.tree.rglob("*.py") if "compiled(" in p.read_text() or "njit" in p.read_text()}

    def path(self, site: Site) -> Path:
        first, _, rest = site.path.partition("/")
        return self.tree / PLACES[first] / rest

    def run(self, order: list, cache: Path, most: float):
        """Lines of the child, parsed, as they come; a process that is silent for `most` seconds is ended."""
        code = f"import sys; sys.path.insert(0, {str(HERE)!r}); import mutants; mutants.child(sys.stdin.read())"
        env = dict(os.environ, PYTHONPATH=str(self.tree), NUMBA_CACHE_DIR=str(cache), OMP_NUM_THREADS="1")
        env |= {"OPENBLAS_NUM_THREADS": "1"} | ({} if order[:1] == ["watched"] else {"PYTHONDONTWRITEBYTECODE": "1"})
        with tempfile.TemporaryDirectory() as here:
            process = subprocess.Popen(
                [sys.executable, "-c", code], stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.PIPE,
                text=True, env=env, cwd=here, start_new_session=True,
            )  # fmt: skip
            errors: list[str] = []
            threading.Thread(target=lambda: errors.append(process.stderr.read()), daemon=True).start()
            process.stdin.write(json.dumps(order))
            process.stdin.close()
            late = threading.Timer(most, process.kill)
            try:
                late.start()
                for line in process.stdout:
                    late.cancel()
                    if line.startswith("["):
                        yield json.loads(line)
                    late = threading.Timer(most, process.kill)
                    late.start()
            finally:
                late.cancel()
                process.kill() if process.poll() is None and sys.exc_info()[0] else None
                status = process.wait()
        if status:
            said = "".join(errors).strip().splitlines()
            yield ["", "", "ended", said[-1] if said else f"status {status}: it did not end", 0.0, []]

    def entered(self, path: Path, function: str, calls: list[str]) -> bool:
        """Whether calls enter a function; of a file with compiled loops, which are not seen, a file that uses it."""
        if f"{place(str(path))}:{function}" in calls:
            return True
        if path not in self.compiled:
            return False
        module = ".".join(path.relative_to(self.tree).with_suffix("").parts)
        users = {place(str(p)) for p in self.tree.rglob("*.py") if f"from {module} import" in p.read_text()}
        return any(call.split(":")[0] in users for call in calls)

    @staticmethod
    def same_file(path: Path, calls: list[str]) -> bool:
        """Whether calls enter any function of a file: others cannot see a mutant in it."""
        return any(call.startswith(f"{place(str(path))}:") for call in calls)

    def tried(self, site: Site, usual: dict, most: float) -> Found:
        """A mutant put in, tried, and taken out again."""
        path, begin = self.path(site), time.perf_counter()
        spoilt = site.applied((self.clean / path.relative_to(self.tree)).read_bytes())
        entering = [k for k, (_, _, calls) in usual.items() if self.entered(path, site.function, calls)]
        near = [
            k for k, (_, _, calls) in usual.items() if k in entering or self.same_file(path, calls) or not site.function
        ]
        order = sorted(near, key=lambda k: (k not in entering, usual[k][1]))
        cache = self.base
        if not site.function or path in self.compiled:  # a constant may be in compiled loops elsewhere
            shutil.rmtree(self.fresh, ignore_errors=True)
            cache = self.fresh
        path.write_bytes(spoilt)
        for old in (path.parent / "__pycache__").glob(f"{path.stem}.*"):
            old.unlink()
        try:
            found = self.first(order, usual, cache, most)
        finally:
            shutil.copy2(self.clean / path.relative_to(self.tree), path)
        return Found(site, *found, len(entering), time.perf_counter() - begin)

    def first(self, order: list, usual: dict, cache: Path, most: float) -> tuple[str, str]:
        """The first case that finds the mutant, and how."""
        lines = self.run(order, cache, most)
        try:
            for key, name, verdict, remark, _, _ in lines:
                before = usual[key, name][0] if key else ""
                if verdict == "ended":
                    return "the program", remark
                if verdict != before and (verdict == "WRONG" or before == "right"):
                    return f"{key} ({name})" if name else key, f"{before} -> {verdict}: {remark}"
        finally:
            lines.close()
        return "", ""


def digest(paths: list[Path]) -> str:
    """Of the contents of files."""
    return hashlib.sha256(b"".join(p.read_bytes() for p in sorted(paths))).hexdigest()


def usual(copy: Copy) -> dict:
    """Verdict, seconds and functions entered of each case without a mutant; of a folder that is kept, what is known."""
    kept, stress = copy.tree.parent / "usual.json", copy.clean / "instrument" / "stress"
    own = set(stress.glob("cases_*.py"))
    package = digest([p for p in copy.clean.rglob("*.py") if p not in own])
    ((*cases,),) = list(copy.run([], copy.base, 600))
    marks = {m: package + digest([stress / f"{m}.py"]) for m in {m for _, _, m in cases}}
    known = json.loads(kept.read_text()) if kept.exists() else []
    found = {(k, n): (v, s, c) for k, n, m, mark, v, s, c in known if marks.get(m) == mark and [k, n, m] in cases}
    todo = ["watched", *((k, n) for k, n, _ in cases if (k, n) not in found)]
    if len(todo) > 1:
        for _ in copy.run(todo, copy.base, 600):  # compiles, and fills caches that would hide who enters what
            pass
        found |= {(k, n): (v, s, c) for k, n, v, _, s, c in copy.run(todo, copy.base, 600)}
    if wrong := [k for k, (verdict, _, _) in found.items() if verdict in ("WRONG", "ended")]:
        print(f"WRONG without a mutant, and so of no use: {wrong}")
    home = {(k, n): m for k, n, m in cases}
    kept.write_text(json.dumps([[*key, home[key], marks[home[key]], *found[key]] for key in found if key in home]))
    return found


# The page ------------------------------------------------------------------------------------------------------------


def key(site: Site) -> str:
    return f"{site.path}:{site.function}: {site.before} -> {site.after}"


def flat(text: str, most: int = 90) -> str:
    short = " ".join(text.split()).replace("|", "/")
    return short if len(short) <= most else short[: most - 1] + "…"


def table(results: list[Found]) -> str:
    rows = ["| | where | kind | instead of | stands | found by | how |", "|---|---|---|---|---|---|---|"]
    for k, r in enumerate(results, 1):
        s = r.site
        place = f"{s.path.removeprefix('instrument/')}:{s.line} {s.function.rpartition('.')[2]}"
        by = r.case or f"**survived** ({r.entering} cases enter it)"
        rows.append(
            f"| {k} | {place} | {s.kind} | `{flat(s.before, 50)}` | `{flat(s.after, 60)}` | {by} | {flat(r.how)} |"
        )
    return "\n".join(rows)


def section(seed: int, results: list[Found], why: dict[str, str]) -> str:
    dead = sum(bool(r.case) for r in results)
    kinds = Counter((r.site.kind, bool(r.case)) for r in results)
    by_kind = ", ".join(
        f"{k} {kinds[k, True]} of {kinds[k, True] + kinds[k, False]}" for k in sorted({k for k, _ in kinds})
    )
    text = f"## Seed {seed}: {dead} of {len(results)} found\n\nBy kind: {by_kind}.\n\n{table(results)}\n"
    lines = [f"- `{flat(key(r.site), 200)}`: {why.get(key(r.site), 'not judged')}" for r in results if not r.case]
    return text + ("\nSurvivors:\n\n" + "\n".join(lines) + "\n" if lines else "")


def page(every: list[Site], results: dict[int, list[Found]], command: str) -> str:
    counts = Counter(s.group for s in every)
    why = json.loads(JUDGED.read_text()) if JUDGED.exists() else {}
    told = ", ".join(f"{g} {counts[g]}" for g in GROUPS)
    head = f"""# Mutants: what `instrument stress` finds

{date.today()}, {platform.machine()}, Python {platform.python_version()}, numpy {version("numpy")},
numba {version("numba")}, instrument {version("instrument")}. Made by `{command}`.

One place of the numerical code is made wrong in a copy of the package, and the stress cases are run on the copy, those
that enter the mutated function first, until one finds it; a mutant has survived where none of the cases that enter any
function of its file does. Places: {len(every)} ({told}). What is drawn and what is left out by construction stands in
`mutant_sites.py`. Seed 1 was chosen before anything was looked at; holes that it showed were closed with new cases, and
its survivors tried again. Seed 2 was run whole before it was used: 28 of 40 were found. Four of its survivors were
holes, closed by C0c, C0d, 50b and A1c, and tried again. A mutant that cannot change an answer counts as a survivor all
the same.
"""
    return "\n".join([head, *(section(seed, found, why) for seed, found in results.items())])


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", default="1,2")
    parser.add_argument("--count", type=int, default=40)
    parser.add_argument("--first", type=int, default=None, help="only so many of them")
    parser.add_argument("--only", default="", help="numbers of the table, with commas")
    parser.add_argument("--out", type=Path, default=HERE)
    parser.add_argument("--folder", type=Path, default=None, help="kept, so that the next call need not begin anew")
    parser.add_argument("--known", action="store_true", help="take survivors of the folder as they are, too")
    given = parser.parse_args()
    every, results = sites(), {}
    with tempfile.TemporaryDirectory() as folder:
        copy = Copy(given.folder or Path(folder))
        begin = time.perf_counter()
        before = usual(copy)
        print(f"{len(before)} cases, twice in {time.perf_counter() - begin:.0f} s", flush=True)
        kept = given.folder / "found.json" if given.folder else None
        done = json.loads(kept.read_text()) if kept and kept.exists() else {}
        most = 60 + 10 * max(seconds for _, seconds, _ in before.values())
        for seed in map(int, given.seeds.split(",")):
            results[seed] = []
            chosen = list(enumerate(drawn(seed, given.count, every), 1))[: given.first]
            for k, site in chosen:
                if given.only and k not in map(int, given.only.split(",")):
                    continue
                found = done.get(f"{seed}|{key(site)}|{site.nth}|{digest([copy.path(site)])}")
                known = found and (found[0] or given.known)
                found = Found(site, *found) if known else copy.tried(site, before, most)
                results[seed].append(found)
                done[f"{seed}|{key(site)}|{site.nth}|{digest([copy.path(site)])}"] = found[1:]
                if given.folder:
                    (given.folder / "found.json").write_text(json.dumps(done))
                print(f"{seed}/{k} {found.seconds:.0f} s {site.path}:{site.line} {site.function} [{site.kind}] "
                      f"{flat(site.before, 40)} -> {flat(site.after, 40)} | {found.case or 'SURVIVED'} | "
                      f"{found.entering} enter | {flat(found.how)}", flush=True)  # fmt: skip
    given.out.mkdir(parents=True, exist_ok=True)
    command = f"python docs/reports/mutants.py --seeds {given.seeds} --count {given.count}"
    (given.out / "mutants.md").write_text(page(every, results, command), encoding="utf-8")


if __name__ == "__main__":
    main()
