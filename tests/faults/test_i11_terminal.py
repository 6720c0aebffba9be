"""What is shown commands no terminal; every error is one line; streams that are closed or full lose text, not work."""

import os
import subprocess
import sys
import warnings

import pytest

from instrument import cli, terminal
from instrument.errors import InputError, InstrumentError
from instrument.terminal import printable, status_of


@pytest.fixture(autouse=True)
def streams(monkeypatch):
    monkeypatch.setattr(warnings, "showwarning", warnings.showwarning)
    monkeypatch.setattr(terminal, "_lost", [])


@pytest.mark.parametrize(
    ("text", "shown"),
    [
        ("\x1b[31mred", "\\x1b[31mred"),
        ("\x1b]0;title\x07", "\\x1b]0;title\\x07"),
        ("a\x7f\x9b2J", "a\\x7f\\x9b2J"),
        ("abc\u202edef", "abc\\u202edef"),
        ("lone \udcff", "lone \\udcff"),
        ("1 µs, 5 Ω·é, α\n\tβ 日本", "1 µs, 5 Ω·é, α\n\tβ 日本"),
    ],
)
def test_i11_control_characters_are_shown_as_escapes(text, shown):
    assert printable(text) == shown


def raiser(error):
    def work():
        raise error

    return work


@pytest.mark.parametrize(
    ("error", "status", "line"),
    [
        (InputError("a = 1\nis wrong"), 2, "a = 1 is wrong"),
        (InstrumentError("it did not work"), 1, "it did not work"),
        (OSError(28, "No space left on device", "o/cube.fits"), 1, "o/cube.fits: No space left on device"),
        (MemoryError("Unable to allocate 3 GiB"), 1, "not enough memory (Unable to allocate 3 GiB)"),
        (SystemExit(3), 1, "a plugin ended the program with exit(3)"),
        (RuntimeError("boom\x1b[31m"), 1, "unexpected RuntimeError: boom\\x1b[31m (test_i11_terminal.py:"),
        (ImportError("libx: failed to map segment"), 1, "a part cannot be loaded"),
        (KeyboardInterrupt(), 1, "stopped; nothing was written"),
    ],
)
def test_i12_every_error_is_one_line_and_a_status(error, status, line, capsys):
    assert status_of(raiser(error)) == status
    said = capsys.readouterr().err
    assert said.startswith(f"instrument: {line}") and said.count("\n") == 1


def test_i12_a_stop_after_the_folder_was_moved_says_that_it_is_written(tmp_path, capsys, monkeypatch):
    from instrument.pipeline.folder import RunFolder

    monkeypatch.chdir(tmp_path)

    def work():
        with RunFolder("s", "o") as folder:
            folder.finish()
            raise KeyboardInterrupt

    assert status_of(work) == 1
    assert capsys.readouterr().err == "instrument: stopped; o is written\n"
    assert (tmp_path / "o").is_dir()


SCENE = """name = "tiny"
instrument = { telescope = "lofar-hba", stations = ["CS001HBA0", "CS002HBA0"], beam = "none" }
sky = { kind = "grid", shape = [1, 1] }
[observation]
phase_centre = "08h13m36.0s +48d13m03s"
start = "2012-12-07T00:00:00"
duration = "20 s"
interval = "10 s"
frequencies = ["150 MHz"]
"""


def test_i12_a_worker_that_raises_anything_is_one_line(tmp_path, capsys, monkeypatch):
    from instrument.predict.matrix import Matrix

    (tmp_path / "s.toml").write_text(SCENE)
    for error, line in ((RuntimeError("boom"), "unexpected RuntimeError: boom"), (SystemExit(3), "exit(3)")):
        monkeypatch.setattr(Matrix, "sums", lambda self, problem, error=error: raiser(error)())
        assert cli.main(["run", str(tmp_path / "s.toml"), "--out", str(tmp_path / "o"), "--workers", "2"]) == 1
        said = capsys.readouterr().err
        assert line in said and said.count("\n") == 1
        assert os.listdir(tmp_path) == ["s.toml"]


LIGHT = [sys.executable, "-m", "instrument.cli", "scenes"]


@pytest.mark.parametrize(
    ("redirect", "status", "said"),
    [
        ("> /dev/full", 1, "instrument: standard output: No space left on device\n"),
        ("2> /dev/full", 0, ""),
        (">&-", 0, ""),
        ("2>&-", 0, ""),
        ("<&- >&- 2>&-", 0, ""),
        ("| true", 0, ""),
    ],
)
def test_i4_streams_that_are_full_or_closed(redirect, status, said):
    command = " ".join(LIGHT)
    done = subprocess.run(
        ["bash", "-c", f"set -o pipefail; {command} {redirect}"], capture_output=True, text=True, timeout=120
    )
    assert (done.returncode, done.stderr) == (status, said)


def test_i4_an_error_that_cannot_be_said_keeps_its_status():
    done = subprocess.run(["bash", "-c", f"{' '.join(LIGHT[:-1])} no-such-verb 2> /dev/full"], timeout=120)
    assert done.returncode == 2


def test_i4_a_terminal_of_ascii_is_no_error():
    env = os.environ | {"PYTHONIOENCODING": "ascii", "PYTHONUTF8": "0"}
    done = subprocess.run(
        [sys.executable, "-m", "instrument.cli", "plan", "\xe9\x1b[31m"], capture_output=True, env=env, timeout=120
    )
    assert done.returncode == 2 and done.stdout == b""
    assert done.stderr.startswith(b"instrument: no scene is called '\\xe9\\x1b[31m'")


def test_i12_too_low_a_limit_on_addresses_is_one_line():
    done = subprocess.run(
        ["bash", "-c", f"ulimit -v 400000; exec {' '.join(LIGHT)}"], capture_output=True, text=True, timeout=120
    )
    assert done.returncode == 1
    assert done.stderr.startswith("instrument: the limit on addresses of this shell (ulimit -v 400000) is too low")


def test_i2_no_module_of_the_working_directory_is_imported(tmp_path):
    """Under `python -m`, which puts the working directory first: neither by name nor through a package's metadata."""
    for name in ("numpy", "yaml", "this_one"):
        (tmp_path / f"{name}.py").write_text("open('ran', 'w')")
    info = tmp_path / "evil-1.0.dist-info"
    info.mkdir()
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: evil\nVersion: 1.0\n")
    (info / "entry_points.txt").write_text("[instrument.elements]\nevil = this_one:X\n")
    done = subprocess.run(
        [sys.executable, "-m", "instrument.cli", "plugins"], cwd=tmp_path, capture_output=True, text=True, timeout=120
    )
    assert done.returncode == 0 and "hamaker" in done.stdout and "evil" not in done.stdout
    assert not (tmp_path / "ran").exists()


STOPPED = """
import os, signal, sys
from instrument import terminal
from instrument.pipeline.folder import RunFolder

def stop():
    os.kill(os.getpid(), signal.SIGTERM)

def work():
    with RunFolder("x", "o") as folder:
        (folder.partial / "run.json").write_text("{}")
        if WHEN == "within":
            stop()
        folder.finish()
    if WHEN == "after":
        stop()
    return 0

WHEN = sys.argv[1]
if WHEN == "ended":  # as its last line is being taken back
    ended = terminal.status_of
    terminal.status_of = lambda work: (ended(work), stop())[0]
sys.exit(terminal.process(work))
"""


@pytest.mark.parametrize(
    ("when", "line"),
    [
        ("within", "stopped; nothing was written"),
        ("after", "stopped; o is written"),
        ("ended", "stopped; o is written"),
    ],
)
def test_g6_a_run_stopped_once_its_folder_is_there_says_that_it_is_written(tmp_path, when, line):
    done = subprocess.run([sys.executable, "-c", STOPPED, when], cwd=tmp_path, capture_output=True, text=True)
    assert done.stderr == f"instrument: {line}\n" and done.returncode == 1
    assert (tmp_path / "o").exists() == (when != "within")


LOST = """
import os, signal, sys, time
from instrument import terminal

terminal.CLEANING_S = 0.2
signal.signal(signal.SIGINT, signal.default_int_handler)  # what runs in the background may ignore it

class Odd:
    def __del__(self):
        os.kill(os.getpid(), signal.SIGINT)
        for _ in range(100):
            pass

def work():
    odd = Odd()
    del odd  # the interrupt is raised where nothing can catch it
    time.sleep(0.3)
    os.kill(os.getpid(), signal.SIGTERM)
    time.sleep(5)
    return 0

sys.exit(terminal.process(work))
"""


def test_an_interrupt_that_was_lost_does_not_make_a_run_that_nothing_stops(tmp_path):
    done = subprocess.run([sys.executable, "-c", LOST], cwd=tmp_path, capture_output=True, text=True, timeout=60)
    assert done.returncode == 1 and "Exception ignored" in done.stderr
    assert done.stderr.endswith("instrument: stopped; nothing was written\n")
