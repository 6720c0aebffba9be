"""Foreground removers on leaked polarization: what is left with and without the truth, and how long it takes.

    pip install ".[test,ica]" && python docs/reports/foregrounds.py [--pixels 480] [--gmca4im FOLDER]

`--gmca4im` is the folder with gmca.py of the published code (github.com/isab3lla/gmca4im, `scripts`), which is not on
PyPI: its GMCA is then run beside ours, in turn, on the same wavelet planes. Writes foregrounds.md beside this file.
"""

import argparse
import os
import platform
import sys
import time
from importlib.metadata import version
from pathlib import Path

import numpy as np
from astropy import units as u
from leakage_cubes import CASES, SCREENS, asked, leakage, load, made, merged, observed, removers, since

from instrument import Analyzer
from instrument.image.mocks import polarized_screens

HERE = Path(__file__).parent


def clock(call):
    begin = time.perf_counter()
    return call(), time.perf_counter() - begin


def bands(split):
    """Power left over power before: k_par below 0.06 (delay 0 included, and not), and above 0.1 /Mpc."""
    ratios = []
    for first in (0.0, 0.005):
        edges = [first, 0.06, 0.1, 0.92] / u.Mpc
        after, before = (
            Analyzer(c).cylindrical(bins=[0.02, 0.5] / u.Mpc, bins_par=edges).power[0]
            for c in (split.residual, split.cube)
        )
        ratios.append(after / before)
    return ratios[0][0], ratios[1][0], ratios[0][2]


def published(folder, planes, maps):
    """Maps less A A^+ maps, A by the published GMCA on wavelet planes (its defaults), and its seconds."""
    sys.path.insert(0, str(folder))
    vars(np).setdefault("int", int)  # it was written for numpy before 1.24
    import gmca

    def run():
        a = np.real(gmca.GMCA(planes.reshape(len(planes), -1), n=4, mints=3, nmax=100, L0=0)["mixmat"])
        return a @ (np.linalg.pinv(a) @ maps.reshape(len(maps), -1))

    return clock(run)


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--pixels", type=int, default=480)
    parser.add_argument("--gmca4im", type=Path)
    parser.add_argument("--only", default="", help="removers, a comma between: their rows in the page that is there")
    parser.add_argument("--runs", type=int, default=3)
    given = parser.parse_args()
    truth = leakage(given.pixels, seed=196)
    page = HERE / "foregrounds.md"
    rows, spent, quiet = {}, {}, {}
    for name, remover in asked(given.only).items():
        remover.split(truth)  # compiled once
        cells = []
        for case in CASES:
            cube = observed(truth, case, seed=1)
            split, seconds = clock(lambda remover=remover, cube=cube: remover.split(cube))
            spent.setdefault(name, []).append(seconds)
            true, estimate = split.score(foreground=truth), split.score()
            cells.append(f"{true.value:.2g} ({estimate.value:.2g} +- {estimate.sigma:.1g})")
            print(f"{name:25s} {case:17s} {seconds:6.2f} s  true {true.value:.3g}  {split}\n", flush=True)
            if case.startswith("quiet"):
                quiet[name] = "{:.2g} | {:.2g} | {:.4f}".format(*bands(split))
        rows[name] = f"| {name} | " + " | ".join(cells) + " |"
    times = {name: f"| {name} | {min(s):.2f} | {quiet[name]} |" for name, s in spent.items()}
    text = f"""# Foreground removers on leaked polarization

{since(page, given.only)}, {os.cpu_count()} cores ({platform.machine()}), Python {platform.python_version()},
numpy {version("numpy")}, numba {version("numba")}, instrument {version("instrument")}.
Made by `python docs/reports/foregrounds.py --pixels {given.pixels}{" --gmca4im FOLDER" if given.gmca4im else ""}`.
{made(given.only)}
27 Faraday screens from -1.5 to 5 rad/m^2 leak into Stokes I: 7.1 mK rms, 161 channels of 0.2 MHz from 134 MHz,
{given.pixels} x {given.pixels} pixels of 0.5', beam 3' at 150 MHz. Four components where there is a number of them.

## Score: power of the error over power of the foreground, k_par < 0.06 /Mpc, 0.02 < k_perp < 0.5 /Mpc

1 = nothing gained, > 1 = worse than not cleaning. First against the truth, in brackets estimated from the cube alone.

| remover | {" | ".join(CASES)} |
|---|{"---|" * len(CASES)}
{merged(page, given.only, rows, 0)}

## Seconds, and what happens to the power of the quiet cube

Power left over power before at k_par < 0.06 /Mpc, the same without delay 0, and at k_par > 0.1 /Mpc.

| remover | best of {len(CASES)}, s | < 0.06 | 0 < k_par < 0.06 | > 0.1 |
|---|---|---|---|---|
{merged(page, given.only, times, 1)}
"""
    text += through_lofar(given.pixels // 4)
    if given.gmca4im:
        text += beside(given, truth)
    page.write_text(text)
    print(text)


def through_lofar(pixels):
    """The score on what the beam of two stations of LOFAR makes of screens, pixels of 2'."""
    import instrument
    from instrument.image.beam_leakage import leaked_through

    cube = polarized_screens(
        pixels=pixels, pixel=2 * u.arcmin, screens=SCREENS, seed=196, centre="08h13m36.0s +48d13m03s"
    )
    lofar = instrument.load("telescopes", "lofar-hba", stations=["CS001HBA0", "CS103HBA1"])
    truth = leaked_through(cube, lofar, ["2012-12-07T02:00:00"])
    templates = {f"stokes-templates, order={k}": load("stokes-templates", order=k) for k in (2, 4, 6)}
    rows = []
    some = {name: removers()[name] for name in ('gmca, mode="threshold"', "pca", "faraday-filter", "gpr")}
    for name, remover in {**some, **templates}.items():
        cells = []
        for case in CASES:
            score = remover.split(observed(truth, case, seed=1)).score(foreground=truth)
            cells.append(f"{score.value:.2g}")
            print(f"LOFAR {name:25s} {case:17s} {score.value:.3g}", flush=True)
        rows.append(f"| {name} | " + " | ".join(cells) + " |")
    rms = f"{1e3 * truth.data[:, 0].std():.1f}"
    return f"""
## The same through the beam of LOFAR

Screens as above through the differential beam of CS001HBA0 and CS103HBA1 at 2012-12-07 02:00: {rms} mK rms in Stokes I,
{pixels} x {pixels} pixels of 2'. Score against the truth.

| remover | {" | ".join(CASES)} |
|---|{"---|" * len(CASES)}
{chr(10).join(rows)}
"""


def beside(given, truth):
    from instrument_plugins.foregrounds.starlet import starlet

    cube = observed(truth, "quiet (0.2 mK)", seed=1)
    maps = np.ascontiguousarray(cube.data[:, 0])
    ours, theirs = [], []
    remover = removers()["gmca"]
    for _ in range(given.runs):
        (planes, _), wavelets = clock(lambda: starlet(maps, 4))
        found, seconds = published(given.gmca4im, planes, maps)
        del planes
        theirs.append((wavelets + seconds, wavelets))
        split, seconds = clock(lambda: remover.split(cube))
        ours.append(seconds)
        print(f"gmca4im {theirs[-1][0]:.1f} s, ours {seconds:.2f} s", flush=True)
    left = found.reshape(maps.shape) - truth.data[:, 0]
    ratio = np.median([t[0] / o for t, o in zip(theirs, ours, strict=True)])
    return f"""
## Beside gmca4im, 4 components, quiet cube, in turn {given.runs} times

| | s (all) | error of the foreground, rms |
|---|---|---|
| gmca | {min(ours):.2f} ({", ".join(f"{s:.2f}" for s in ours)}) | {rms(split, truth)} |
| gmca4im, 100 iterations on our wavelet planes (in which {min(t[1] for t in theirs):.1f} s) | \
{min(t[0] for t in theirs):.1f} ({", ".join(f"{t[0]:.1f}" for t in theirs)}) | {1e3 * left.std():.3f} mK |

gmca4im takes {ratio:.1f} times as long (median of the pairs).
"""


def rms(split, truth):
    return f"{1e3 * (split.foreground.data[:, 0] - truth.data[:, 0]).std():.3f} mK"


if __name__ == "__main__":
    main()
