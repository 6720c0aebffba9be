"""Terminal: what a process shows and how it ends: one-line errors, exit statuses, signals, streams closed or full."""

from __future__ import annotations

import contextlib
import os
import signal
import sys
import time
import traceback
import unicodedata
import warnings
from collections.abc import Callable
from types import FrameType
from typing import Any

from instrument.errors import InputError, InstrumentError, InstrumentWarning

DONE, FAILED, BAD_INPUT, FELL_SHORT = 0, 1, 2, 3
CLEANING_S = 5.0  # in which a second signal is not taken for a second wish
_stopped_at = float("-inf")  # when a signal came
LEAST_ADDRESSES = 1.5e9  # bytes of `ulimit -v` below which LLVM and BLAS abort while they are loaded
finished: list[str] = []  # what this process has done that stays, also where it is stopped after it
_lost: list[OSError] = []  # why standard output takes nothing more


def show(text: str) -> None:
    """Print to standard output; where that is closed or full the work goes on, and the exit status says it."""
    if not _lost:
        try:
            print(printable(text), flush=True)
        except OSError as error:
            _lost.append(error)


def say(text: str) -> None:
    """One line on standard error; nothing where it is closed or full."""
    with contextlib.suppress(OSError, AttributeError):
        print(f"instrument: {printable(' '.join(text.split()))}", file=sys.stderr, flush=True)


def printable(text: str) -> str:
    """Text whose control characters, which would command the terminal, are written as escapes."""
    text = str(text)
    if text.isprintable():
        return text
    return "".join(
        c.encode("unicode_escape").decode() if unicodedata.category(c)[0] == "C" and c not in "\n\t" else c
        for c in text
    )


def status_of(work: Callable[[], int]) -> int:
    """The exit status of what `work` does; every error is one line."""
    warnings.showwarning = _show_warning  # type: ignore[assignment]
    finished.clear()
    try:
        return work()
    except InputError as error:
        say(str(error))
        return BAD_INPUT
    except InstrumentError as error:
        say(str(error))
    except KeyboardInterrupt:
        _say_stopped()
    except MemoryError as error:
        say(
            f"not enough memory ({error or 'refused by the system'}): ask for fewer sources, depths, channels or pixels"
        )
    except ImportError as error:
        say(f"a part cannot be loaded (damaged installation, or too little memory): {error}")
    except OSError as error:
        say(f"{error.filename}: {error.strerror or error}" if error.filename else str(error.strerror or error))
    except SystemExit as error:
        say(f"a plugin ended the program with exit({error.code!r}); nothing was written")
    except Exception as error:  # a fault of the program or of a plugin: one line here, the rest on request
        if os.environ.get("INSTRUMENT_TRACEBACK"):
            traceback.print_exc()
        where = traceback.extract_tb(error.__traceback__)[-1]
        say(
            f"unexpected {type(error).__name__}: {error} ({os.path.basename(where.filename)}:{where.lineno}; "
            "INSTRUMENT_TRACEBACK=1 shows how it came there)"
        )
    return FAILED


def process(work: Callable[[], int]) -> int:
    """The same for a whole process: signals stop it cleanly, and closed or full streams do not."""
    global _stopped_at
    _open_streams()
    _forget_the_working_directory()
    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        if signal.getsignal(number) is not signal.SIG_IGN:  # nohup
            signal.signal(number, _stop)
    _stopped_at = float("-inf")
    try:
        status = status_of(lambda: _within_limits(work))
        _from_now_on_nothing_stops_it()
    except KeyboardInterrupt:  # as the work had ended
        _from_now_on_nothing_stops_it()
        _say_stopped()
        status = FAILED
    try:
        if not _lost:
            sys.stdout.flush()
    except OSError as error:
        _lost.append(error)
    if _lost:
        os.dup2(os.open(os.devnull, os.O_WRONLY), 1)  # or Python flushes into it once more as it ends
        if not isinstance(_lost[0], BrokenPipeError):  # whoever reads a pipe may leave; a full disk loses text
            say(f"standard output: {_lost[0].strerror}")
            status = status or FAILED
    try:
        sys.stderr.flush()
    except OSError:  # the same: Python would end with a status of its own
        os.dup2(os.open(os.devnull, os.O_WRONLY), 2)
    return status


def _within_limits(work: Callable[[], int]) -> int:
    import resource

    limit, _ = resource.getrlimit(resource.RLIMIT_AS)
    if 0 < limit < LEAST_ADDRESSES:
        raise InstrumentError(
            f"the limit on addresses of this shell (ulimit -v {limit // 1024}) is too low to load the libraries: "
            f"at least {LEAST_ADDRESSES / 1e9:g} GB are needed"
        )
    return work()


def _stop(number: int, frame: FrameType | None) -> None:
    """Ends the work; what comes while it is being cleaned up changes nothing.

    One that comes later ends it again: an interrupt that is raised where Python cannot pass it on (`__del__`) is lost.
    """
    global _stopped_at
    if time.monotonic() - _stopped_at > CLEANING_S:
        _stopped_at = time.monotonic()
        raise KeyboardInterrupt


def _from_now_on_nothing_stops_it() -> None:
    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        signal.signal(number, signal.SIG_IGN)


def _say_stopped() -> None:
    say("stopped; " + ("; ".join(finished) or "nothing was written"))


def _open_streams() -> None:
    """Streams that were closed become /dev/null, or the next file would be opened in their place and written to."""
    while (descriptor := os.open(os.devnull, os.O_RDWR)) <= 2:
        pass
    os.close(descriptor)
    for name in ("stdin", "stdout", "stderr"):
        stream: Any = getattr(sys, name)
        if stream is None:
            setattr(sys, name, open(os.devnull, "r" if name == "stdin" else "w"))  # noqa: SIM115
        elif name != "stdin":
            stream.reconfigure(errors="backslashreplace")  # a terminal of ASCII


def _forget_the_working_directory() -> None:
    """`python -m` looks for modules and plugins in the working directory, which may hold anything."""
    if not sys.flags.safe_path and sys.path and sys.path[0] in ("", os.getcwd()):
        del sys.path[0]


def _show_warning(message: Any, category: Any, *rest: Any) -> None:
    if issubclass(category, InstrumentWarning):
        say(f"warning: {message}")
