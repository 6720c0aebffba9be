"""The command `instrument`. Exit status: 0 done, 1 failed, 2 bad input, 3 done but a check fell short."""

from __future__ import annotations

import argparse
import re
import sys
import warnings
from collections.abc import Sequence
from typing import Any

from instrument.errors import InputError, InstrumentError, InstrumentWarning, did_you_mean

DONE, FAILED, BAD_INPUT, FELL_SHORT = 0, 1, 2, 3


class _Parser(argparse.ArgumentParser):
    """An argument parser whose errors are one line, with the nearest right word."""

    def error(self, message: str) -> Any:
        wrong = re.search(r"argument VERB: invalid choice: '([^']*)'", message)
        if wrong:
            message = f"no verb is called '{wrong[1]}': {did_you_mean(wrong[1], VERBS)}"
        raise InputError(f"{message} (see {self.prog} --help)")


def parser() -> argparse.ArgumentParser:
    """The command line."""
    top = _Parser(
        prog="instrument",
        description="A radio interferometer composed of Jones terms, and its errors followed the whole way.",
    )
    verbs = top.add_subparsers(dest="verb", metavar="VERB", required=True, parser_class=_Parser)

    def scene_verb(name: str, text: str) -> argparse.ArgumentParser:
        verb = verbs.add_parser(name, help=text, description=text)
        verb.add_argument("scene", metavar="SCENE", help="a .toml file, or the name of a shipped scene")
        verb.add_argument(
            "--set",
            action="append",
            default=[],
            metavar="KEY=VALUE",
            dest="settings",
            help="change one setting, e.g. sky.brightest=500",
        )
        verb.add_argument(
            "--tolerance", type=float, help="error that may be made, relative to the total flux (default: the scene's)"
        )
        verb.add_argument("--engine", help="engine to use instead of the cheapest")
        verb.add_argument("--memory", metavar="SIZE", help="most memory the prediction may take, e.g. 8GB")
        verb.add_argument("--workers", type=int, help="threads (default: all cores)")
        return verb

    run = scene_verb("run", "Run a scene end to end and write a run folder.")
    run.add_argument("--out", metavar="DIR", help="folder to write (default: runs/NAME); must not exist or be empty")
    run.add_argument("--no-verify", action="store_true", help="leave out the check against the direct sum")
    scene_verb("plan", "Say what would be done, left out, and at what cost; nothing is computed.")
    verbs.add_parser("scenes", help="List the shipped scenes.")
    verbs.add_parser("plugins", help="List the plugins, and what is broken.")
    verbs.add_parser("doctor", help="Check this installation: versions, tables, threads, memory, a self-test.")
    return top


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command line; returns the exit status."""
    warnings.showwarning = _show_warning  # type: ignore[assignment]
    try:
        given = parser().parse_args(argv)
        return int(VERBS[given.verb](given))
    except InputError as error:
        print(f"instrument: {_flat(error)}", file=sys.stderr)
        return BAD_INPUT
    except InstrumentError as error:
        print(f"instrument: {_flat(error)}", file=sys.stderr)
        return FAILED
    except KeyboardInterrupt:
        print("instrument: stopped; nothing was written", file=sys.stderr)
        return FAILED
    except BrokenPipeError:
        return DONE


def _flat(error: Exception) -> str:
    return " ".join(str(error).split())


def _show_warning(message: Any, category: Any, *rest: Any) -> None:
    if issubclass(category, InstrumentWarning):
        print(f"instrument: warning: {_flat(message)}", file=sys.stderr)


def _scene_file(given: argparse.Namespace) -> Any:
    from instrument.scene_file import override, parse, read_tables

    tables = override(read_tables(given.scene), given.settings)
    for key in ("tolerance", "engine"):
        if getattr(given, key) is not None:
            tables[key] = getattr(given, key)
    if given.workers is not None and given.workers < 1:
        raise InputError(f"--workers {given.workers}: at least one thread is needed")
    return tables, parse(tables)


def _run(given: argparse.Namespace) -> int:
    from instrument.run import run

    tables, scene_file = _scene_file(given)
    result = run(
        scene_file,
        tables,
        out=given.out,
        memory=given.memory,
        workers=given.workers,
        verify=not given.no_verify,
        show=print,
    )
    return DONE if result.passed else FELL_SHORT


def _plan(given: argparse.Namespace) -> int:
    _, scene_file = _scene_file(given)
    plan = scene_file.plan(scene_file.scene(), given.memory, given.workers)
    print(plan)
    return DONE


def _scenes(given: argparse.Namespace) -> int:
    from instrument.scene_file import shipped

    for name, title in shipped().items():
        print(f"{name:<20} {title}")
    return DONE


def _plugins(given: argparse.Namespace) -> int:
    from instrument.registry import KINDS, available

    for kind in KINDS:
        found = available(kind)
        print(f"{kind}" if found else f"{kind} (none)")
        for plugin in found.values():
            print(
                f"  {plugin.name:<18} {plugin.package:<14} {plugin.target}"
                + (f"\n    BROKEN: {plugin.broken}" if plugin.broken else "")
            )
    return DONE


def _doctor(given: argparse.Namespace) -> int:
    from instrument.doctor import doctor

    return DONE if doctor(print) else FAILED


VERBS = {"run": _run, "plan": _plan, "scenes": _scenes, "plugins": _plugins, "doctor": _doctor}


if __name__ == "__main__":
    sys.exit(main())
