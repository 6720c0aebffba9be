"""The command `instrument`. Exit status: 0 done, 1 failed, 2 bad input, 3 done but a check fell short."""

from __future__ import annotations

import argparse
import re
import shlex
import sys
from collections.abc import Sequence
from typing import Any

from instrument.cli_analyze import add_analyze, analyze
from instrument.errors import InputError, did_you_mean, unused_ledger
from instrument.pipeline.on_data import HELP, WRITES, can, tables_on
from instrument.provenance import command, commanded
from instrument.terminal import DONE, FAILED, FELL_SHORT, process, show, status_of


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
    top.add_argument("--version", action="version", version=f"instrument {_version()}", help="print the version")
    verbs = top.add_subparsers(dest="verb", metavar="VERB", required=True, parser_class=_Parser)

    def scene_verb(name: str, text: str) -> argparse.ArgumentParser:
        verb: argparse.ArgumentParser = verbs.add_parser(name, help=text, description=text)
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
    _add_out(run)
    run.add_argument("--no-verify", action="store_true", help="leave out the check against the direct sum")
    plan = scene_verb("plan", "Say what would be done, left out, and at what cost; nothing is computed.")
    _add_data(plan, "plan")
    for name, text in HELP.items():
        _add_data(scene_verb(name, text), name)
    text = "Faraday depth, power spectra, foreground removal and EoR window of FITS cubes."
    verb = verbs.add_parser("analyze", help=text, description=text)
    _add_out(verb)
    add_analyze(verb)
    text = "Say what changed between two run folders: scene, versions, checks, numbers, tables, spectra, costs."
    both = verbs.add_parser("compare", help=text, description=text)
    both.add_argument("first", metavar="RUN", help="a run folder")
    both.add_argument("second", metavar="RUN", help="another, held against the first")
    _add_out(both, "folder to write a page compare.html into, new or empty (default: none is written)")
    _add_contests(verbs)
    _add_paper(verbs)
    verbs.add_parser("scenes", help="List the shipped scenes.")
    plugins = verbs.add_parser("plugins", help="List the plugins, and what is broken; with a NAME its settings.")
    plugins.add_argument("name", metavar="NAME", nargs="?", help="a plugin: its settings, their units and defaults")
    verbs.add_parser(
        "doctor", help="Check this installation: versions, optional parts, tables, memory, a self-test, a known beam."
    )
    return top


def _version() -> str:
    from instrument import __version__

    return __version__


def _add_out(verb: argparse.ArgumentParser, text: str = "", too: str = "") -> None:
    usual = "folder to write, new or empty (default: runs/NAME, or NAME-2, NAME-3, ... where that is taken)"
    verb.add_argument("--out", metavar="DIR", help=f"{text or usual}; nothing that is there is overwritten")
    verb.add_argument("--force", action="store_true", help=f"replace an earlier run in that folder{too}")


def _add_contests(verbs: Any) -> None:
    text = "Error against run time of a scene, a stage, a kind of plugin, or a plugin beside the others of its kind."
    verb = verbs.add_parser("precision", help=text, description=text)
    verb.add_argument("what", metavar="WHAT", help="a scene, a stage, a kind of plugin (engines, ...), or a plugin")
    verb.add_argument("--plugins", metavar="A,B", help="of these plugins alone (default: all that can be had)")
    verb.add_argument("--quick", action="store_true", help="one value a decade, three repeats")
    verb.add_argument("--peers", action="store_true", help="draw in other programs, those that are installed")
    _add_out(verb, "folder to write, new or empty (default: runs/precision-WHAT, or the next free name)")
    text = "Try named extreme cases with right answers: right, refused or WRONG, in digits."
    cases = verbs.add_parser("stress", help=text, description=text)
    cases.add_argument("what", metavar="WHAT", nargs="?", help="a scene, a kind of plugins, a plugin (default: all)")
    cases.add_argument("--set", action="append", default=[], metavar="KEY=VALUE", dest="settings", help="of the plugin")
    _add_out(cases, "folder to write stress.ecsv into, new or empty (default: none is written)")


def _add_data(verb: argparse.ArgumentParser, name: str) -> None:
    plan = name == "plan"
    verb.add_argument("--data", metavar="SET.MS", required=not plan, help="a Measurement Set, UVFITS, UVH5 or Zarr")
    if plan:
        usual = "with --data: the plan of this verb (default: of each that the scene has tables for)"
        verb.add_argument("--for", dest="of", metavar="VERB", choices=list(HELP), help=f"{', '.join(HELP)}; {usual}")
    verb.add_argument("--column", metavar="COLUMN", help="of the visibilities (default: DATA)")
    if plan or name in WRITES:
        usual = WRITES[name][1] if name in WRITES else ", ".join(column for _, column in WRITES.values())
        verb.add_argument("--into", metavar="COLUMN", help=f"to write (default: {usual}), or a new file")
    verb.add_argument("--window", type=int, metavar="N", help="spectral window, where the set has several")
    verb.add_argument("--field", type=int, metavar="N", help="field, where the set has several")
    verb.add_argument("--no-verify", action="store_true", help="leave out the check against the direct sum")
    if plan:
        verb.add_argument("--force", action="store_true", help="as if the column or file that is named may be replaced")
    else:
        _add_out(verb, too=", and the column or file that is named" if name in WRITES else "")


def _add_paper(verbs: Any) -> None:
    from instrument.paper.experiments import described

    text = "Run what Asad et al. (2015) did: the paper's numbers, ours, and why they differ."
    layout: Any = {"epilog": f"experiments:\n{described()}", "formatter_class": argparse.RawDescriptionHelpFormatter}
    verb = verbs.add_parser("paper", help=text, description=text, **layout)
    verb.add_argument("experiments", metavar="EXPERIMENT", nargs="*", help="one or more of those below (default: all)")
    verb.add_argument("--quick", action="store_true", help="a smaller form of each, minutes for all")
    verb.add_argument("--seed", metavar="N", help="of all that is drawn (default: those of the scenes)")
    _add_out(verb, "folder to write, new or empty (default: runs/paper, or the next free name)")


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command line; returns the exit status. Without `argv` it is this process's, whose signals it takes."""
    given = sys.argv[1:] if argv is None else argv
    return (process if argv is None else status_of)(lambda: _verb(_parsed(given)))


def _parsed(words: Sequence[str]) -> argparse.Namespace | int:
    words = _joined(words)
    try:
        given = parser().parse_args(words)
    except SystemExit as done:  # --help
        return int(done.code or 0)
    given.words = words
    return given


def _verb(given: argparse.Namespace | int) -> int:
    if isinstance(given, int):
        return given
    with commanded(shlex.join(["instrument", *given.words])):
        return int(VERBS[given.verb](given))


def _joined(words: Sequence[str]) -> list[str]:
    """The words with `--depths -50,50,1` as `--depths=-50,50,1`: a value that begins with a minus is no option."""
    out: list[str] = []
    for word in words:
        if re.match(r"-[\d.]", word) and out and re.fullmatch(r"--[a-z-]+", out[-1]):
            out[-1] += f"={word}"
        else:
            out.append(word)
    return out


def _scene_file(given: argparse.Namespace, verb: str = "") -> Any:
    """The tables of a scene with what the command line says, made to work on --data by a verb of data; and parsed."""
    from instrument.pipeline.scene_file import parse
    from instrument.pipeline.scene_text import override, read_tables

    tables = read_tables(given.scene)
    if verb in HELP:
        if not given.data.strip():
            raise InputError("--data is empty: name a Measurement Set, UVFITS, UVH5 or Zarr")
        names = {"set": given.data, **{name: getattr(given, name) for name in ("column", "window", "field")}}
        tables = tables_on(verb, tables, names, getattr(given, "into", None), given.force)
    tables = override(tables, given.settings)
    for key in ("tolerance", "engine"):
        if getattr(given, key) is not None:
            tables[key] = getattr(given, key)
    if given.workers is not None and given.workers < 1:
        raise InputError(f"--workers {given.workers}: at least one thread is needed")
    return tables, parse(tables)


def _run(given: argparse.Namespace) -> int:
    from instrument.pipeline.run import run

    with unused_ledger():
        tables, scene_file = _scene_file(given, given.verb)
        result = run(
            scene_file,
            tables,
            out=given.out,
            memory=given.memory,
            workers=given.workers,
            verify=not given.no_verify,
            show=show,
            force=given.force,
        )
    return DONE if result.passed else FELL_SHORT


def _plan(given: argparse.Namespace) -> int:
    if given.data is None:
        for option in ("of", "column", "into", "window", "field", "force"):
            if getattr(given, option) is not None and getattr(given, option) is not False:
                raise InputError(f"--{'for' if option == 'of' else option} goes with --data, the visibilities")
    if given.into is not None and given.of is not None and given.of not in WRITES:
        raise InputError(f"--into goes with {', '.join(WRITES)}: '{given.of}' writes no visibilities")
    verbs = [given.of or ""] if given.of or given.data is None else _verbs_for(given)
    refused: dict[str, InputError] = {}
    for number, verb in enumerate(verbs):
        try:
            _plan_of(given, verb, "\n" if number else "")
        except InputError as error:
            refused[verb] = error
    reasons = set(map(str, refused.values()))
    if len(refused) == len(verbs) and len(reasons) == 1:
        raise next(iter(refused.values()))
    for verb, why in refused.items():
        show(f"refused       {verb}: {why}")
    if len(refused) == len(verbs):
        raise next(iter(refused.values()))
    return DONE


def _plan_of(given: argparse.Namespace, verb: str, before: str = "") -> None:
    from instrument.pipeline.planning import plan_run

    _, scene_file = _scene_file(given, verb)
    made = plan_run(scene_file, scene_file.scene(), given.memory, given.workers, not given.no_verify)
    show(f"{before}{made}")


def _verbs_for(given: argparse.Namespace) -> list[str]:
    from instrument.pipeline.scene_text import read_tables

    tables = read_tables(given.scene)
    return [verb for verb in HELP if can(verb, tables)]


def _compare(given: argparse.Namespace) -> int:
    from instrument.pipeline.compare import compare_runs

    compare_runs(given.first, given.second, given.out, show, given.force)
    return DONE


def _precision(given: argparse.Namespace) -> int:
    if given.peers:
        from instrument.threads import one_thread

        one_thread()
    from instrument.precision.command import Form, precision

    plugins = [name.strip() for name in given.plugins.split(",")] if given.plugins else []
    kept = precision(given.what, plugins, Form(given.quick, given.peers), given.out, show, given.force, command())
    return DONE if kept else FELL_SHORT


def _stress(given: argparse.Namespace) -> int:
    from instrument.pipeline.scene_text import override
    from instrument.stress.suite import stress

    right = stress(given.what, given.out, show, override({}, given.settings), given.force)
    return DONE if right else FELL_SHORT


def _paper(given: argparse.Namespace) -> int:
    from instrument.paper.experiments import announced, chosen, seed_of

    given.seed = seed_of(given.seed)
    show(announced(chosen(given.experiments), given.quick))  # before what takes seconds to load
    from instrument.paper.command import paper

    right = paper(given.experiments, given.quick, given.seed, given.out, show, given.force, command())
    return DONE if right else FELL_SHORT


def _scenes(given: argparse.Namespace) -> int:
    from instrument.pipeline.scene_text import shipped

    for name, title in shipped().items():
        show(f"{name:<20} {title}")
    return DONE


def _plugins(given: argparse.Namespace) -> int:
    from instrument.registry import KINDS, available

    if given.name is not None:
        from instrument.plugin_settings import describe

        show("\n".join(describe(given.name)))
        return DONE
    for kind in KINDS:
        found = available(kind)
        show(f"{kind}" if found else f"{kind} (none)")
        for plugin in found.values():
            show(
                f"  {plugin.name:<27} {plugin.package:<14} {plugin.target}"
                + (f"\n    BROKEN: {plugin.broken}" if plugin.broken else "")
                + (f"\n    lacks {plugin.lacks}" if plugin.lacks else "")
            )
    return DONE


def _doctor(given: argparse.Namespace) -> int:
    from instrument.doctor import doctor

    return DONE if doctor(show) else FAILED


VERBS = {
    "run": _run,
    **dict.fromkeys(HELP, _run),
    "plan": _plan,
    "analyze": analyze,
    "compare": _compare,
    "precision": _precision,
    "stress": _stress,
    "paper": _paper,
    "scenes": _scenes,
    "plugins": _plugins,
    "doctor": _doctor,
}


if __name__ == "__main__":
    sys.exit(main())
