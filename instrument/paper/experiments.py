"""The experiments by name, in the order of the paper; a new one is a line here and a file with a function `run`."""

from __future__ import annotations

from collections.abc import Sequence
from importlib import import_module
from typing import TYPE_CHECKING

from instrument.errors import InputError, did_you_mean

if TYPE_CHECKING:  # the command line reads the names: nothing heavy is loaded for them
    from instrument.paper.bench import Experiment

# name: module in this package, title, where in the paper
EXPERIMENTS = {
    "beam": ("beam", "Mueller matrices of a baseline over the sky, their width and their leakage", "beam"),
    "di-errors": ("di_errors", "Gain and feed errors solved on 25 sources: seven parameters", "self-calibration"),
    "mock-grid": ("mock_grid", "Leakage of a grid of unpolarized sources; its centre alone", "mock observation"),
    "3c196": ("field_3c196", "Leakage of the 3C196 field: its brightest sources, its spectra", "field of 3C196"),
    "incomplete-model": ("incomplete_model", "Calibration on 1 to 1000 of 4567 sources", "incomplete models"),
    "aw-correction": ("aw_correction", "Leakage taken out by beam-corrected imaging", "A-projection"),
    "galactic": ("galactic", "The polarized Galaxy leaked into I, and the window on the signal", "Galactic emission"),
    "gmca": ("gmca", "Leaked polarization removed, and the signal that goes with it", "foreground removal"),
    "whole-way": ("whole_way", "Beyond: a signal through gains, an incomplete model, leakage, removal", "outlook"),
    "ixr": ("ixr", "Leakage in dB, what must be removed, and the IXR of telescopes over their fields", "discussion"),
    "errata": ("errata", "Slips of the paper: the printed form beside the right one", "formulae and tables"),
}
# seconds of the quick and of the full form on two quiet cores: what is announced, and the steps of the bar
SECONDS = {
    "beam": (8, 9), "di-errors": (12, 106), "mock-grid": (20, 57), "3c196": (8, 247), "incomplete-model": (18, 66),
    "aw-correction": (44, 632), "galactic": (25, 709), "gmca": (20, 64), "whole-way": (24, 131), "ixr": (5, 7),
    "errata": (6, 5),
}  # fmt: skip
# what one must know to read the rows
WORDS = {
    "di-errors": (
        "S, IQ, UV, IU, QU, IV and QV are the seven sums of gain and feed errors of a baseline that fill its Mueller "
        "matrix to first order: S scales all four Stokes parameters, IQ mixes I and Q, UV mixes U and V, and so on; "
        "each is the rms over baselines and intervals of what calibration left of it, in % of the rms of the errors "
        'put in. "As in the paper" reads them off the Mueller matrix of the differences of Jones matrices, true less '
        'solved, of two stations, and is of second order in them; "by definition (linear)" forms them of the '
        "differences themselves: docs/calibrating.md."
    ),
}
NEW = 10  # of one that nobody has timed


def seconds(name: str, quick: bool) -> float:
    """About how long an experiment takes on two cores."""
    return SECONDS.get(name, (NEW, NEW))[0 if quick else 1]


def chosen(names: Sequence[str]) -> list[str]:
    """The names asked for, or all; raises `InputError` for one that is none."""
    for name in names:
        parts = [part.strip().lower() for part in name.split(",")]
        if len(parts) > 1 and set(parts) <= {*EXPERIMENTS, ""}:
            raise InputError(f"'{name}': separate experiments by spaces: {' '.join(part for part in parts if part)}")
        if name not in EXPERIMENTS:
            raise InputError(f"no experiment is called '{name}': {did_you_mean(name, EXPERIMENTS)}")
    return list(dict.fromkeys(names)) or list(EXPERIMENTS)


def seed_of(given: str | int | None) -> int | None:
    """The seed asked for, which may be None; raises `InputError` for one that is none."""
    if given is None:
        return None
    try:
        seed = int(given)
    except ValueError:
        seed = 0
    if not 1 <= seed < 2**31:
        from instrument.numbers import brief

        shown = given if isinstance(given, str) and given.isdigit() else brief(given)
        raise InputError(f"--seed {shown}: give 1 to 2147483647, or leave it out for the seeds of the scenes")
    return seed


def announced(names: Sequence[str], quick: bool) -> str:
    """What will be done, and in about what time."""
    from instrument.report.page import duration

    due = {name: seconds(name, quick) for name in names}
    longest = max(due, key=lambda name: due[name])
    what = f"{len(due)} experiments, '{longest}' {duration(due[longest])} of it" if len(due) > 1 else f"'{longest}'"
    form = "quick" if quick else "full"
    return f"paper         {form} form, about {duration(sum(due.values()))} on two cores: {what}"


def described() -> str:
    """The experiments, a line each."""
    wide = max(map(len, EXPERIMENTS))
    return "\n".join(f"  {name:<{wide}}  {title}" for name, (_, title, _) in EXPERIMENTS.items())


def experiment(name: str) -> Experiment:
    """The function that runs an experiment."""
    run: Experiment = import_module(f"instrument.paper.{EXPERIMENTS[name][0]}").run
    return run
