"""Faraday synthesis and RM-CLEAN of a whole cube: this package, RM-Tools, and a loop over depths, side by side.

    pip install ".[peers]" && python docs/reports/rm_synthesis.py [--runs 5]

480 x 480 pixels, 161 channels of 0.2 MHz from 134 MHz, float32 Q and U, 401 depths from -50 to 50 rad/m²: three thin
sources in every pixel and noise of 0.3. Ways are timed in turn and the best of the runs counts. RM-Tools is its
fastest, `do_rmsynth_planes` with nBits=32. Two loops make one plane of F at a time (Brentjens & de Bruyn 2005), timed
on some depths and scaled: one multiplies the whole cube of P with the phases of a depth and adds it up, as the
published program rm-synthesis does; the other adds one channel after the other in complex64, as thrifty as a loop can
be. RM-CLEAN: gain 0.1, cutoff 0.1; RM-Tools' `do_rmclean_hogbom` with window=cutoff on some pixels and scaled. Errors
are against float64 sums of 500 spectra, over the largest |F|. Writes rm_synthesis.md beside this file.
"""

import argparse
import os
import platform
import sys
import time
from datetime import date
from importlib.metadata import version
from pathlib import Path

import numpy as np
from astropy import units as u
from RMutils.util_RM import do_rmclean_hogbom, do_rmsynth_planes

from instrument import Analyzer, StokesCube
from instrument.observe.directions import LIGHT

HERE = Path(__file__).parent
FREQ = 134e6 + 0.2e6 * np.arange(161)
L2 = (LIGHT / FREQ) ** 2
PHI = np.linspace(-50, 50, 401)
# the process keeps what it has freed: on some machines pages new from the kernel cost more than the work (RM-Tools 2.7
# or 60 s), and nobody's program is meant by that
HELD = {"MALLOC_MMAP_MAX_": "0", "MALLOC_TRIM_THRESHOLD_": "99999999999"}
CUTOFF, GAIN = 0.1, 0.1
SOME_DEPTHS, SOME_PIXELS = 6, 1024


def quiet(*text, **more):
    """RM-Tools prints by default."""


def made(side):
    """Data (F, 4, side, side) in float32."""
    rng = np.random.default_rng(196)
    out = np.zeros((len(FREQ), 4, side, side), np.float32)
    depth = rng.uniform(-20, 20, (3, side, side))
    amplitude = rng.uniform(0.1, 1, (3, side, side)) * np.exp(2j * rng.uniform(0, np.pi, (3, side, side)))
    for channel, x in enumerate(L2):
        p = (amplitude * np.exp(2j * depth * x)).sum(axis=0)
        out[channel, 1], out[channel, 2] = p.real, p.imag
        out[channel, 1:3] += rng.normal(scale=0.3, size=(2, side, side))
    return out


def loop(p, depths):
    """F (N, Ny, Nx) of P (F, Ny, Nx), one plane after the other, one channel after the other."""
    out = np.zeros((len(depths), *p.shape[1:]), np.complex64)
    for k, phi in enumerate(depths):
        for channel, x in enumerate(L2 - L2.mean()):
            out[k] += p[channel] * np.complex64(np.exp(-2j * phi * x))
    return out / np.float32(len(L2))


def published_loop(p, depths):
    """The same, the whole cube times the phases of one depth at once; numpy makes them complex128."""
    out = np.zeros((len(depths), *p.shape[1:]), np.complex64)
    for k, phi in enumerate(depths):
        out[k] = np.mean(p * np.exp(-2j * phi * (L2 - L2.mean()))[:, None, None], axis=0)
    return out


def timed(work):
    begin = time.perf_counter()
    found = work()
    return time.perf_counter() - begin, found


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--runs", type=int, default=5)
    parser.add_argument("--side", type=int, default=480)
    given = parser.parse_args()
    if HELD.items() - os.environ.items():
        os.execve(sys.executable, [sys.executable, *sys.argv], os.environ | HELD)
    data = made(given.side)
    q, v = np.ascontiguousarray(data[:, 1]), np.ascontiguousarray(data[:, 2])
    whole, pixels = q + 1j * v, given.side**2
    sky = Analyzer(StokesCube(data, FREQ * u.Hz, 0.5 * u.arcmin, "K"))
    some = np.linspace(0, 400, SOME_DEPTHS).astype(int)
    spots = np.linspace(0, pixels - 1, 500).astype(int)
    p = (data[:, 1].astype(float) + 1j * data[:, 2]).reshape(len(L2), -1)[:, spots]
    truth = np.exp(-2j * np.outer(PHI, L2 - L2.mean())) @ p / len(L2)

    def ours():
        return sky.rm_synthesis(PHI).data

    def ours_double():
        return sky.rm_synthesis(PHI, precision="double").data

    def peer():
        return do_rmsynth_planes(q, v, L2, PHI, nBits=32, log=quiet).FDFcube

    def planes():
        return loop(whole, PHI[some])

    def published():
        return published_loop(whole, PHI[some])

    # scaled to all 401 depths
    ways = {
        "ours, complex64": (ours, 1.0),
        "ours, complex128": (ours_double, 1.0),
        "RM-Tools, nBits=32": (peer, 1.0),
        f"published loop over depths ({SOME_DEPTHS} of 401, scaled)": (published, len(PHI) / SOME_DEPTHS),
        f"thrifty loop over depths ({SOME_DEPTHS} of 401, scaled)": (planes, len(PHI) / SOME_DEPTHS),
    }
    spent, error = {name: [] for name in ways}, {}
    for work, _ in ways.values():  # compiled, loaded, planned, memory held
        work()
    for _ in range(given.runs):
        for name, (work, scale) in ways.items():
            seconds, found = timed(work)
            spent[name].append(seconds * scale)
            rows = some if work in (planes, published) else slice(None)
            error[name] = np.abs(found.reshape(len(found), -1)[:, spots] - truth[rows]).max() / np.abs(truth).max()
            del found
            print(f"{name}: {spent[name][-1]:.2f} s, error {error[name]:.1e}", flush=True)
    first = next(iter(ways))
    rows = [row(name, spent[name], spent[first], f"{error[name]:.1e}") for name in ways]

    cube = sky.rm_synthesis(PHI)
    cube.clean(cutoff=CUTOFF)
    pick = np.linspace(0, pixels - 1, SOME_PIXELS).astype(int)
    dirty = np.ascontiguousarray(cube.data.reshape(len(PHI), 1, -1)[:, :, pick])
    step = 0.25 * np.arange(-401, 402)
    rmsf = np.repeat(cube.rmsf_at(step).astype(np.complex64)[:, None, None], SOME_PIXELS, axis=2)
    fwhm = np.full((1, SOME_PIXELS), cube.fwhm)

    def peer_clean():
        return do_rmclean_hogbom(dirty, PHI, rmsf, step, fwhm, CUTOFF, 1000, GAIN, window=CUTOFF, log=quiet)

    names = "ours, whole cube", f"RM-Tools ({SOME_PIXELS} spectra, scaled)"
    cleaning = {name: [] for name in names}
    for _ in range(given.runs):
        seconds, mine = timed(lambda: cube.clean(cutoff=CUTOFF, gain=GAIN))
        cleaning[names[0]].append(seconds)
        if len(cleaning[names[1]]) < 3:
            seconds, theirs = timed(peer_clean)
        cleaning[names[1]].append(seconds * pixels / SOME_PIXELS)
        print(*(f"{n}: {x[-1]:.1f} s" for n, x in cleaning.items()), flush=True)
    apart = np.abs(mine.restored.reshape(len(PHI), -1)[:, pick] - theirs.cleanFDF.reshape(len(PHI), -1))
    counts = mine.iterations.ravel()[pick], theirs.iterCountArr.ravel()
    same = apart[:, counts[0] == counts[1]].max() / np.abs(theirs.cleanFDF).max()
    extra = {
        names[0]: f"{mine.iterations.mean():.0f} iterations a spectrum",
        names[1]: f"{counts[1].mean():.0f}; restored within {same:.0e} of ours where the counts agree "
        f"({100 * np.mean(counts[0] == counts[1]):.0f} %)",
    }
    more = [row(name, cleaning[name], cleaning[names[0]], extra[name]) for name in names]

    used = {
        "numpy": "numpy",
        "numba": "numba",
        "RM-Tools": "rm-tools",
        "finufft": "finufft",
        "instrument": "instrument",
    }
    lines = [
        "# Faraday synthesis and RM-CLEAN beside RM-Tools and a loop over depths",
        "",
        f"{given.side} x {given.side} pixels, 161 channels (134 to 166 MHz), float32 Q and U, 401 depths (-50 to 50 "
        f"rad/m²); three thin sources in every pixel, noise of 0.3. {os.cpu_count()} cores, {platform.machine()}, "
        f"{date.today().isoformat()}. {', '.join(f'{name} {version(key)}' for name, key in used.items())}.",
        "",
        "| synthesis | best, s (all runs) | times ours | error against float64 sums |",
        "|---|---|---|---|",
        *rows,
        "",
        f"| RM-CLEAN, gain {GAIN}, cutoff {CUTOFF} | best, s (all runs) | times ours | |",
        "|---|---|---|---|",
        *more,
        "",
        "Ways were timed in turn. The loops make one plane of F at a time: the published one as the program "
        "rm-synthesis does, the whole cube times the phases of a depth, added up; the thrifty one adds one channel "
        "after the other in complex64. Both were run for the depths said; RM-CLEAN of RM-Tools in one process, for the "
        "spectra said, with window=cutoff (its default, window=0, goes on to the limit of 1000 iterations). "
        "The process kept the memory that it freed, so no run waits for the kernel. Written by `rm_synthesis.py`.",
        "",
    ]
    (HERE / "rm_synthesis.md").write_text("\n".join(lines), encoding="utf-8")
    print("\n".join(lines))


def row(name, seconds, reference, note):
    runs = ", ".join(f"{s:.3g}" for s in seconds)
    return f"| {name} | {min(seconds):.3g} ({runs}) | {min(seconds) / min(reference):.3g} | {note} |"


if __name__ == "__main__":
    main()
