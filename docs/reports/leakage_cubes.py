"""Cubes of the reports on foreground removal: leaked Faraday screens, quiet and under noise."""

from datetime import date
from pathlib import Path

import numpy as np
from astropy import units as u

import instrument
from instrument.image.mocks import leaked, noise_cube, polarized_screens
from instrument.sky.screens import FINE

# 27 screens of which that at 1.2 rad/m^2 stands out; steep, so that 7.1 mK are mostly on scales beyond a degree
SCREENS = FINE.with_fields(width=0.5, floor=0.05, slope=3.5, uv_range=(10.0, 800.0))
RMS = 7.1e-3  # K
CASES = {
    "quiet (0.2 mK)": (0.2e-3, False),
    "60 mK white": (60e-3, False),
    "60 mK PSF-shaped": (60e-3, True),
    "10 mK PSF-shaped": (10e-3, True),
}


def leakage(pixels, seed):
    """Screens and what leaks of them into I, 7.1 mK rms; 161 channels from 134 to 166 MHz, pixels of 0.5'; V = 0."""
    cube = leaked(polarized_screens(pixels=pixels, pixel=0.5 * u.arcmin, screens=SCREENS, seed=seed))
    data = np.array(cube.data)
    data[:, 0] *= np.float32(RMS / cube.data[:, 0].std())
    return cube.with_data(data)


def observed(truth, case, seed):
    """The screens and their leakage with the noise of a case, of its own in every Stokes parameter."""
    noise, shaped = CASES[case]
    data = noise_cube(truth, noise * u.K, shaped, seed).data
    data += truth.data
    return truth.with_data(data)


def load(name, **settings):
    """A remover."""
    return instrument.load("foregrounds", name, **settings)


def removers():
    """Name on the page -> remover; independent components only where scikit-learn is installed."""
    from importlib.util import find_spec

    found = {
        "gmca": load("gmca"),
        'gmca, mode="threshold"': load("gmca", mode="threshold"),
        "gmca, paper=True": load("gmca", paper=True),
        "pca": load("pca"),
        "polynomial": load("polynomial"),
        "faraday-filter": load("faraday-filter"),
        "gpr": load("gpr"),
        "stokes-templates": load("stokes-templates"),
    }
    return found | ({"ica": load("ica")} if find_spec("sklearn") else {})


def asked(only):
    """The removers of a run: all of them, or those that `--only` names, with a comma between."""
    every = removers()
    return {name: every[name] for name in only.split(",")} if only else every


def merged(page, only, rows, table):
    """Rows by remover, with those of the page that is there where only some were asked; `table` is its number on it."""
    if only:
        parts = Path(page).read_text().split("\n|---")[1:]
        lines = parts[table].splitlines()[1:]
        there = {line.split(" | ")[0].removeprefix("| "): line for line in lines if line.startswith("| ")}
        rows = {name: rows.get(name, there.get(name)) for name in removers() if name in rows or name in there}
    return "\n".join(rows.values())


def since(page, only):
    """The date of the page: that of the page that is there, where only some of its rows are made anew."""
    return Path(page).read_text().splitlines()[2].split(",")[0] if only else date.today()


def made(only):
    """A line that says which rows are younger than the others."""
    return f"\nRows of {only}: {date.today()}, by `--only {only}`.\n" if only else ""
