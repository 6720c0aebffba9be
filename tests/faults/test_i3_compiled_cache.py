"""Compiled loops work without a place for their cache, throw a damaged one away, and say so once."""

import ctypes
import importlib.util
import os
import subprocess
import sys
import warnings
from pathlib import Path

import pytest

from instrument import compiled_cache

ROOT = Path(__file__).resolve().parents[2]
KERNEL = '''
"""Two compiled loops."""
from instrument.compiled import compiled

@compiled(nogil=True)
def total(values):
    out = 0.0
    for v in values:
        out += v
    return out

@compiled(nogil=True)
def twice(value):
    return 2 * value
'''


def without_overriding_permissions():
    """In a child: root obeys the permission bits like anyone else (drops CAP_DAC_OVERRIDE and CAP_DAC_READ_SEARCH)."""
    for capability in (1, 2):
        ctypes.CDLL(None).prctl(24, capability, 0, 0, 0)  # PR_CAPBSET_DROP


@pytest.fixture
def loops(tmp_path, monkeypatch):
    """A module of two compiled loops; each call is like a new process: results, what was found, what was said."""
    path = tmp_path / "sums.py"
    path.write_text(KERNEL)
    monkeypatch.delenv("NUMBA_CACHE_DIR", raising=False)

    def fresh():
        compiled_cache._said.clear()
        spec = importlib.util.spec_from_file_location("sums", path)
        module = importlib.util.module_from_spec(spec)
        with warnings.catch_warnings(record=True) as said:
            warnings.simplefilter("always")
            spec.loader.exec_module(module)
            values = module.total((1.0, 2.0, 3.0)), module.twice(3)
        assert values == (6.0, 6)
        hits = [sum(loop.stats.cache_hits.values()) for loop in (module.total, module.twice)]
        return hits, [str(w.message) for w in said]

    yield tmp_path / "__pycache__", fresh
    compiled_cache._said.clear()


def test_i3_a_second_process_takes_the_cache(loops):
    _, fresh = loops
    assert fresh() == ([0, 0], [])
    assert fresh() == ([1, 1], [])


@pytest.mark.parametrize(
    ("damage", "suffix"),
    [("empty", ".nbi"), ("swapped", ".nbc"), ("flipped", ".nbc")]
    + [
        pytest.param(damage, suffix, marks=pytest.mark.long)
        for damage, suffix in [("half", ".nbc"), ("text", ".nbc"), ("empty", ".nbc")]
        + [(damage, ".nbi") for damage in ("flipped", "half", "text", "swapped")]
    ],
)
def test_i3_a_damaged_cache_is_thrown_away_and_said_once(loops, damage, suffix):
    folder, fresh = loops
    fresh()
    files = sorted(folder.glob(f"*{suffix}"))
    contents = [path.read_bytes() for path in files]
    assert len(files) == 2
    for path, content, other in zip(files, contents, contents[::-1], strict=True):
        middle = len(content) // 2
        flipped = content[:middle] + bytes([content[middle] ^ 16]) + content[middle + 1 :]
        made = {"empty": b"", "flipped": flipped, "half": content[:middle], "text": b"no\n" * 99, "swapped": other}
        path.write_bytes(made[damage])
    hits, said = fresh()
    assert hits == [0, 0]
    assert len(said) == 1 and said[0].startswith("damaged cache of compiled loops: thrown away and made anew in ")
    assert fresh() == ([1, 1], [])


def test_i3_a_full_disk_keeps_nothing_and_says_so_once(loops, monkeypatch):
    _, fresh = loops

    def full(self, name, data):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(compiled_cache._Checked, "_save_data", full)
    hits, said = fresh()
    assert hits == [0, 0]
    assert len(said) == 1 and "could not be kept" in said[0] and "No space left on device" in said[0]
    monkeypatch.undo()
    assert fresh()[0] == [0, 0]  # the index names data that are not there
    assert fresh() == ([1, 1], [])


def test_i3_a_read_only_install_and_home_work_without_a_cache(tmp_path):
    """In a process of its own that root's rights do not help."""
    for name in ("mod", "home"):
        (tmp_path / name).mkdir()
    (tmp_path / "mod" / "sums.py").write_text(KERNEL)
    for name in ("mod", "home"):
        (tmp_path / name).chmod(0o555)
    done = subprocess.run(
        [sys.executable, "-c", "import sums; print(sums.total((1.0, 2.0)), sums.twice(3))"],
        cwd=tmp_path / "mod",
        env={k: v for k, v in os.environ.items() if k not in ("NUMBA_CACHE_DIR", "XDG_CACHE_HOME")}
        | {"HOME": str(tmp_path / "home"), "PYTHONPATH": f"{tmp_path / 'mod'}:{ROOT}"},
        capture_output=True,
        text=True,
        preexec_fn=without_overriding_permissions,
        timeout=120,
    )
    assert done.stdout.split() == ["3.0", "6"], done.stderr
    assert done.stderr.count("no place to keep compiled loops") == 1
    assert not (tmp_path / "mod" / "__pycache__").exists()


def test_i3_every_compiled_loop_has_the_safe_cache():
    sources = [*(ROOT / "instrument").rglob("*.py"), *(ROOT / "plugins").rglob("*.py")]
    assert [str(p) for p in sources if "cache=True" in p.read_text()] == []
