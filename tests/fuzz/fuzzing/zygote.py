"""A process that has everything loaded and forks a child for every case it reads from its standard input.

One JSON object a line: `argv` (of the command) or `call` (a name in CALLS) with `path`, `cwd`, `out` and `err` (files
for the streams), `cpu_s`, `wall_s`, `memory` (most that it holds), `more` (addresses beyond those it has),
and where asked `signal` and `after_s`, `file_size`. It answers with
`status`, `signal`, `wall_s`, `cpu_s`, `peak`. Started with the path of a scene that is run once to load what is lazy.
"""

import ctypes
import json
import os
import resource
import signal
import sys
import time
import traceback

POLL_S = 0.01


def command(argv):
    """The command, as a process of its own has it."""
    from instrument.cli import main

    sys.argv = ["instrument", *argv]
    return main()


def read_solutions(path):
    """An h5parm as Python reads it."""
    from instrument import read_h5parm

    read_h5parm(path)


CALLS = {"read_h5parm": read_solutions}


def called(name, path):
    """A reader, with the exit status and the one line that the command would give."""
    from instrument.terminal import process

    return process(lambda: CALLS[name](path) or 0)


def child(case):
    """Runs a case and never returns."""
    status = 99
    try:
        ctypes.CDLL(None).prctl(1, signal.SIGKILL, 0, 0, 0)  # PR_SET_PDEATHSIG: it does not outlive its watcher
        os.chdir(case["cwd"])
        for number, name, flags in (
            (0, os.devnull, os.O_RDONLY),
            (1, case["out"], os.O_WRONLY | os.O_CREAT | os.O_TRUNC),
            (2, case["err"], os.O_WRONLY | os.O_CREAT | os.O_TRUNC),
        ):
            opened = os.open(name, flags)
            os.dup2(opened, number)
            os.close(opened)
        sys.stdin, sys.stdout, sys.stderr = (os.fdopen(n, m) for n, m in ((0, "r"), (1, "w"), (2, "w")))
        resource.setrlimit(resource.RLIMIT_CPU, (int(case["cpu_s"]), int(case["cpu_s"]) + 2))
        with open("/proc/self/statm") as text:
            taken = int(text.read().split()[0]) * resource.getpagesize()
        resource.setrlimit(resource.RLIMIT_AS, (taken + int(case["more"]),) * 2)
        if case.get("file_size") is not None:
            resource.setrlimit(resource.RLIMIT_FSIZE, (case["file_size"],) * 2)
        status = called(case["call"], case["path"]) if case.get("call") else command(case["argv"])
        sys.stdout.flush()
        sys.stderr.flush()
    except BaseException:  # the harness looks for it in what was written
        traceback.print_exc()
        status = 98
    finally:
        os._exit(status)


def resident(pid):
    """Bytes of memory that a process holds now."""
    try:
        with open(f"/proc/{pid}/statm") as text:
            return int(text.read().split()[1]) * resource.getpagesize()
    except OSError:
        return 0


def run(case):
    """Fork a child for a case and wait for it; what became of it."""
    begin = time.monotonic()
    pid = os.fork()
    if pid == 0:
        child(case)
    killed = ""
    while True:
        done, state, used = os.wait4(pid, os.WNOHANG)
        if done:
            break
        time.sleep(POLL_S)
        spent = time.monotonic() - begin
        if case.get("signal") and spent > case["after_s"]:
            os.kill(pid, case.pop("signal"))
        if resident(pid) > case["memory"]:
            killed = "memory"
        elif spent > case["wall_s"]:
            killed = "hang"
        if killed:
            os.kill(pid, signal.SIGKILL)
            _, state, used = os.wait4(pid, 0)
            break
    number = os.WTERMSIG(state) if os.WIFSIGNALED(state) else 0
    return {
        "status": os.WEXITSTATUS(state) if os.WIFEXITED(state) else None,
        "signal": number,
        "killed": "hang" if number == signal.SIGXCPU else killed,
        "wall_s": time.monotonic() - begin,
        "cpu_s": used.ru_utime + used.ru_stime,
        "peak": used.ru_maxrss * 1024,
    }


def main():
    """Load everything, then serve."""
    answers = os.fdopen(os.dup(1), "w")
    os.dup2(2, 1)
    import astropy.io.votable
    import h5py
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot
    import yaml

    import instrument.pipeline.analyze_files
    import instrument.pipeline.run
    from instrument import cli

    assert all((astropy.io.votable, h5py, yaml, matplotlib.pyplot, instrument.pipeline.run))
    for words in json.loads(sys.argv[1]):
        status = cli.main(words)
        assert status in (0, 3), (words, status)
    print("ready", file=answers, flush=True)
    for line in sys.stdin:
        print(json.dumps(run(json.loads(line))), file=answers, flush=True)


if __name__ == "__main__":
    main()
