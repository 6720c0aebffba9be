"""The plan of every shipped scene against its run: memory and seconds, planned and measured, stage by stage.

    python docs/reports/plan_against_run.py [--scenes mock-grid,3c196] [--set KEY=VALUE ...] [--flat] [--show]

Every scene is run by the command `instrument run` in a process of its own, whose peak memory the system tells; what was
planned is in its run.json. Then the largest three with four times as many integrations (`--flat` makes these alone):
memory must not grow with the length of a run. Writes plan_against_run.md beside this file (not with --show).
"""

import argparse
import json
import os
import platform
import sys
import tempfile
from datetime import date
from importlib.metadata import version
from pathlib import Path

HERE = Path(__file__).parent
LENGTHS = {"di-errors": ("20 s", "5 s"), "faraday-leakage": ("80 min", "20 min"), "3c196": ("60 s", "15 s")}


def one(scene, settings):
    """Planned and measured of one scene, and the peak that the system tells."""
    from instrument.machine import kept_in, speed

    with tempfile.TemporaryDirectory() as folder:
        words = [sys.executable, "-m", "instrument.cli", "run", scene, "--out", f"{folder}/out"]
        words += [word for setting in settings for word in ("--set", setting)]
        speed()  # kept, as on a machine that has planned before
        assert kept_in()
        child = os.posix_spawn(words[0], words, os.environ, file_actions=[(os.POSIX_SPAWN_OPEN, 1, os.devnull, 1, 0)])
        _, status, usage = os.wait4(child, 0)
        assert os.waitstatus_to_exitcode(status) in (0, 3), f"{scene}: status {status}"
        record = json.loads(Path(folder, "out", "run.json").read_text())
    peak = usage.ru_maxrss * (1 if sys.platform == "darwin" else 1024)
    return record, float(peak), usage.ru_utime + usage.ru_stime


def rows(scene, record, peak, processor):
    """Lines of the table: the whole, then each stage."""
    seconds, memory = record["seconds"], record["memory"]
    yield [
        f"**{scene}**",
        f"{seconds['planned']:.1f}",
        f"{seconds['measured']:.1f}",
        f"{seconds['measured'] / seconds['planned']:.2f}",
        f"{memory['planned_bytes'] / 1e6:.0f}",
        f"{peak / 1e6:.0f}",
        f"{peak / memory['planned_bytes']:.2f}",
        f"{processor:.0f}",
    ]
    for name, step in record["stages"].items():
        s, m = step["seconds"], step["memory"]
        if s["planned"] is not None:
            ratio = f"{s['measured'] / s['planned']:.2f}" if s["measured"] > 0.5 else ""
            grown = [f"{m[key] / 1e6:.0f}" for key in ("planned_bytes", "measured_bytes")]
            yield [name, f"{s['planned']:.1f}", f"{s['measured']:.1f}", ratio, *grown, "", ""]


def main():
    from instrument.pipeline.scene_text import shipped

    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--scenes", default=",".join(shipped()))
    parser.add_argument("--set", action="append", default=[], dest="settings")
    parser.add_argument("--flat", action="store_true")
    parser.add_argument("--show", action="store_true")
    given = parser.parse_args()
    lines = [] if given.flat else planned(given)
    lines += ["", "| scene | interval | MB | interval | MB | ratio |", "|---|---|---|---|---|---|"]
    for scene, intervals in LENGTHS.items():
        if scene in given.scenes.split(","):
            peaks = [one(scene, [*given.settings, f"observation.interval={step}"])[1] / 1e6 for step in intervals]
            cells = [f"{step} | {peak:.0f}" for step, peak in zip(intervals, peaks, strict=True)]
            lines.append(f"| {scene} | {' | '.join(cells)} | {peaks[1] / peaks[0]:.2f} |")
            print(lines[-1], flush=True)
    if given.show or given.flat:
        return
    (HERE / "plan_against_run.md").write_text(HEAD.format(**about()) + "\n".join(lines) + "\n")


def planned(given):
    """The table of plans against runs."""
    heads = ["scene, stage", "s planned", "s measured", "ratio", "MB planned", "MB measured", "ratio", "CPU s"]
    lines = ["| " + " | ".join(heads) + " |", "|---" * len(heads) + "|"]
    print(lines[0], flush=True)
    for scene in given.scenes.split(","):
        for row in rows(scene, *one(scene, given.settings)):
            lines.append("| " + " | ".join(row) + " |")
            print(lines[-1], flush=True)
    return lines


HEAD = """# The plans of shipped scenes against their runs

{date}, {cores} cores ({machine}), speed {speed:.2f} of the machine of the costs, Python {python}, numpy {numpy},
instrument {instrument}. Made by `python docs/reports/plan_against_run.py`: whole processes, one after the other. Memory
of a scene is the peak of its process; of a stage, by how much it raised what the process had had before (stages share
what is free). Below: the peak of runs with four times as many integrations.

"""


def about():
    """What the report was made with."""
    from instrument.machine import speed

    return {
        "date": date.today(), "cores": os.cpu_count(), "machine": platform.machine(), "speed": speed(),
        "python": platform.python_version(), "numpy": version("numpy"), "instrument": version("instrument"),
    }  # fmt: skip


if __name__ == "__main__":
    main()
