"""A run that is stopped, or whose disk is full, leaves a whole folder or none, and says so in one line.

Children are forked from a loaded process. The default run takes a few moments of stopping, `long` twenty of each.
"""

import os
import random
import resource
import shutil
import signal
import subprocess
import sys

import pytest
from fuzzing import seeds
from fuzzing.harness import Case, _whole
from fuzzing.settings import written

from instrument.partial_folders import PARTIAL

RUN = ("run", "s.toml", "--out", "o")
SCENE = seeds.IMAGES


def fresh(zygote, text=SCENE):
    folder = zygote.folder / "case"
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir()
    (folder / "s.toml").write_text(text)
    return folder


def case(**extra):
    return Case("run", "machine", written("s.toml", SCENE), RUN, extra={"wall_s": 300, **extra})


def names(folder):
    return sorted(p.name for p in folder.iterdir() if p.name != "s.toml")


def complaints(answer):
    """What was said beside warnings."""
    return [line for line in answer["said"].splitlines() if not line.startswith("instrument: warning: ")]


def stopped(zygote, number, times):
    """Stop runs at random moments; how many were stopped before they were done."""
    whole = zygote.ask(case(), fresh(zygote, seeds.SCENE))
    assert whole["status"] == 0, whole["said"]
    rng, early = random.Random(number), 0
    for _ in range(times):
        folder = fresh(zygote, seeds.SCENE)
        answer = zygote.ask(case(signal=int(number), after_s=rng.uniform(0.02, 1.1) * whole["wall_s"]), folder)
        said = complaints(answer)
        assert "Traceback" not in answer["said"]
        if number == signal.SIGKILL:
            left = [n for n in names(folder) if n != "o"]
            assert all(n.endswith(PARTIAL) or n.startswith(".o.") for n in left)
            early += answer["signal"] == number
            # the next run removes what is left, and says it
            if any(n.endswith(PARTIAL) for n in left):
                again = zygote.ask(Case("again", "machine", written("s.toml", ""), (*RUN[:3], "o2")), folder)
                assert "left by a run that was killed, removed" in again["said"]
                assert again["status"] == 0 and not any(n.endswith(PARTIAL) for n in names(folder))
        elif answer["status"] == 0:
            assert said == [] and names(folder) == ["o"]
        else:
            early += 1
            assert answer["status"] == 1 and len(said) == 1, answer
            assert said[0] in ("instrument: stopped; nothing was written", "instrument: stopped; o is written")
            assert names(folder) == (["o"] if "o is written" in said[0] else [])
        if (folder / "o").exists():
            assert _whole(folder / "o") == "done"
    return early


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGKILL])
def test_g6_a_stopped_run_leaves_a_whole_folder_or_none(zygote, number):
    stopped(zygote, number, 1)


@pytest.mark.long
@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGKILL])
def test_g6_twenty_stopped_runs_leave_whole_folders_or_none(zygote, number):
    assert stopped(zygote, number, 20) >= 10


def disk_errors(zygote, sizes):
    for size in sizes:
        folder = fresh(zygote)
        answer = zygote.ask(case(file_size=size), folder)
        said = complaints(answer)
        assert answer["status"] in (1, 2) and len(said) == 1, f"{size}: {answer}"
        assert said[0].startswith("instrument: ") and "unexpected" not in said[0], said
        assert names(folder) == []


def test_i7_a_limit_on_files_is_one_line_and_leaves_nothing(zygote):
    disk_errors(zygote, [40_000])


@pytest.mark.long
def test_i7_every_limit_on_files_is_one_line_and_leaves_nothing(zygote):
    whole = zygote.ask(case(), folder := fresh(zygote))
    assert whole["status"] == 0
    sizes = sorted({p.stat().st_size for p in (folder / "o").iterdir()})
    disk_errors(zygote, [9 * size // 10 for size in sizes if size > 3000])  # what is shown takes 2 kB of a file too


def without_permissions():
    """In a child: root obeys the permission bits like anyone else."""
    import ctypes

    for capability in (1, 2):  # CAP_DAC_OVERRIDE, CAP_DAC_READ_SEARCH
        ctypes.CDLL(None).prctl(24, capability, 0, 0, 0)  # PR_CAPBSET_DROP


def process(words, folder, preexec=None, **env):
    return subprocess.run(
        [sys.executable, "-m", "instrument.cli", *words], cwd=folder, capture_output=True, text=True, timeout=300,
        preexec_fn=preexec, env=os.environ | env,
    )  # fmt: skip


def mounted(folder, size):
    """Whether a small disk of memory could be put at a folder; only root may."""
    folder.mkdir()
    return not subprocess.run(
        ["mount", "-t", "tmpfs", "-o", f"size={size}", "tmpfs", folder], capture_output=True
    ).returncode


@pytest.mark.long
@pytest.mark.parametrize("size", ["4k", "64k", "200k", "400k"])
def test_i7_a_full_disk_is_one_line_and_leaves_nothing(zygote, tmp_path, size):
    disk = tmp_path / "disk"
    if not mounted(disk, size):
        pytest.skip("a disk of one's own needs root")
    try:
        (tmp_path / "s.toml").write_text(SCENE)
        answer = zygote.ask(Case("full", "machine", written("s.toml", ""), (*RUN[:3], "disk/o")), tmp_path)
        assert answer["status"] in (1, 2) and len(complaints(answer)) == 1
        assert "No space left" in answer["said"] or "not enough space" in answer["said"].lower()
        assert list(disk.iterdir()) == []
    finally:
        subprocess.run(["umount", disk], check=True)


@pytest.mark.long
def test_i3_i7_a_home_and_a_folder_that_cannot_be_written(tmp_path):
    home, locked = tmp_path / "home", tmp_path / "locked"
    for folder in (home, locked):
        folder.mkdir()
        folder.chmod(0o555)
    (tmp_path / "s.toml").write_text(seeds.SCENE)
    env = {"HOME": str(home), "XDG_CACHE_HOME": str(home), "MPLCONFIGDIR": str(home / "mpl"), "NUMBA_CACHE_DIR": ""}
    done = process(["run", "s.toml", "--out", "o"], tmp_path, without_permissions, **env)
    assert done.returncode == 0 and "Traceback" not in done.stderr, done.stderr
    assert (tmp_path / "o" / "report.html").is_file()
    done = process(["run", "s.toml", "--out", "locked/o"], tmp_path, without_permissions, **env)
    assert done.returncode == 2 and "Permission denied" in done.stderr
    assert [line for line in done.stderr.splitlines() if line.startswith("instrument: --out")]


@pytest.mark.long
@pytest.mark.parametrize("redirect", ["| head -0", "> /dev/full", "2>&-", ">&- 2>&-"])
def test_i4_a_run_whose_streams_are_closed_or_full_writes_its_folder(tmp_path, redirect):
    (tmp_path / "s.toml").write_text(seeds.SCENE)
    command = f"{sys.executable} -u -m instrument.cli run s.toml --out o {redirect}; exit ${{PIPESTATUS[0]}}"
    done = subprocess.run(["bash", "-c", command], cwd=tmp_path, capture_output=True, text=True, timeout=300)
    assert "Traceback" not in done.stderr and "Exception" not in done.stderr
    assert done.returncode == (1 if "full" in redirect else 0), done.stderr
    assert ("standard output: No space left on device" in done.stderr) == ("full" in redirect)
    assert _whole(tmp_path / "o") == "done" and (tmp_path / "o").is_dir()


@pytest.mark.long
@pytest.mark.parametrize("megabytes", [200, 700, 1200, 2000])
def test_i12_a_limit_on_addresses_is_one_line_or_enough(tmp_path, megabytes):
    def limit():
        resource.setrlimit(resource.RLIMIT_AS, (megabytes * 10**6,) * 2)

    (tmp_path / "s.toml").write_text(seeds.SCENE)
    done = process(["run", "s.toml", "--out", "o", "--workers", "1"], tmp_path, limit)
    assert "Traceback" not in done.stderr
    if done.returncode:
        assert done.returncode == 1 and len(complaints({"said": done.stderr})) == 1, done.stderr
        assert names(tmp_path) == []
