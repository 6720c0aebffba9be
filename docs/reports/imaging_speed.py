"""Dirty images of I, Q, U, V and the PSF of one channel: this package, ducc0 on all visibilities, and WSClean.

    pip install ".[peers,test]" && apt install wsclean && python docs/reports/imaging_speed.py [--runs 3]

59 stations of LOFAR, 8 h of 10 s, 30-800 wavelengths, 480 x 480 pixels of 0.5 arcmin, random visibilities. One thread
each, in turn, the best of several. WSClean is timed as a process, from a Measurement Set of the same stations and to
four images without a PSF; without WSClean or casacore the table says so. Writes imaging_speed.md beside this file.
"""

import argparse
import os
import platform
import shutil
import sys
import tempfile
import time
from datetime import date
from importlib.metadata import version
from pathlib import Path

import numpy as np
from astropy import units as u
from ducc0.wgridder.experimental import vis2dirty
from peers import peer_tools, process

import instrument
from instrument.image.clock import Clock
from instrument.image.sparse import Comb
from instrument.observe.directions import LIGHT
from instrument.observe.sampling import Sampling
from instrument.predict.gridding import Gridder
from instrument.threads import THREADS

HERE = Path(__file__).parent
CENTRE, PIXELS, ACCURACY, FREQ, UV = "08h13m36.0s +48d13m03s", 480, 1e-4, 150e6, (30, 800)


def observed():
    """Random visibilities of all baselines, the observation and the stations."""
    observation = instrument.Observation(
        phase_centre=CENTRE, transit="2012-12-07", duration=28740 * u.s, interval=10 * u.s,
        frequencies=[FREQ / 1e6] * u.MHz, channel_width=0.2 * u.MHz,
    )  # fmt: skip
    lofar = instrument.load("telescopes", "lofar-hba")
    layout, centre = lofar.layout(), observation.phase_centre
    at = Sampling.build(layout, observation.times(layout), FREQ, centre.ra_rad, centre.dec_rad, centre)
    one, other = layout.baselines
    data = np.random.default_rng(0).standard_normal((at.shape[0], 1, len(one), 2, 2, 2)).view(complex)[..., 0]
    vis = instrument.Visibilities(data=data, at=at, antenna1=one, antenna2=other, interval_s=10.0, width_hz=2e5)
    return vis, observation, lofar


def ducc0_images(uvw, stokes, accuracy):
    """Five calls of ducc0 on all visibilities within the uv range: uvw (N, 3) in wavelengths, Stokes (N, 4)."""
    kwargs = {
        "freq": np.array([LIGHT]), "npix_x": PIXELS, "npix_y": PIXELS, "pixsize_x": pixel(), "pixsize_y": pixel(),
        "epsilon": accuracy, "do_wgridding": True, "divide_by_n": False, "flip_u": True, "flip_w": True, "nthreads": 1,
    }  # fmt: skip
    return [vis2dirty(uvw=uvw, vis=column[:, None], **kwargs).T / len(uvw) for column in stokes]


def pixel():
    """rad."""
    return float((0.5 * u.arcmin).to_value(u.rad))


def of_arrays(imager, vis):
    """The same from the array of correlations, without all that `Imager` does before and after it."""
    comb = Comb.of(Clock(vis), FREQ, imager)
    comb.clock.count(vis)
    shape = vis.data.shape[0], vis.data.shape[2]
    uv = vis.at.uvw_m[..., :2] * (FREQ / LIGHT)
    span = comb.span(0, 400_000)
    numbers = np.arange(shape[0])
    span.add(vis.data[:, 0], np.broadcast_to(1.0, (*shape, 1)), np.broadcast_to(False, shape), numbers, uv, UV)
    uvw, columns, accuracy = span.gridded()
    gridder = Gridder(uvw, (PIXELS, PIXELS), imager.pixel, accuracy)
    return [gridder.image(column) / span.weight[0] for column in columns[:5]], len(uvw)


def wsclean(folder, vis, observation, lofar):
    """The command of WSClean for a Measurement Set that it makes; `None` without WSClean or casacore."""
    if not shutil.which("wsclean"):
        return None
    try:
        lofar_ms = peer_tools(folder)
    except ImportError:
        return None
    import casacore.tables as tables

    lofar_ms.make_ms(folder / "all.MS", lofar, observation)
    with tables.table(str(folder / "all.MS"), readonly=False, ack=False) as ms:
        ms.putcol("DATA", vis.data.reshape(-1, 1, 4).astype(np.complex64))
    return [
        "wsclean", "-j", "1", "-no-update-model-required", "-name", str(folder / "wsc"), "-size", str(PIXELS),
        str(PIXELS), "-scale", "0.5amin", "-pol", "IQUV", "-niter", "0", "-weight", "natural", "-minuv-l",
        str(UV[0]), "-maxuv-l", str(UV[1]), "-data-column", "DATA", str(folder / "all.MS"),
    ]  # fmt: skip


def seconds(function):
    """Seconds of a call."""
    start = time.perf_counter()
    function()
    return time.perf_counter() - start


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--runs", type=int, default=3)
    runs = parser.parse_args().runs
    vis, observation, lofar = observed()
    imager = instrument.Imager(pixels=PIXELS, pixel=0.5 * u.arcmin, uv_range=UV, accuracy=ACCURACY)
    uvw, _, use = imager.chosen(vis, 0)
    stokes = [*np.ascontiguousarray(vis.stokes()[:, 0][use].T), np.ones(len(uvw), complex)]
    cube, (images, samples) = imager.image(vis), of_arrays(imager, vis)  # and compiled
    exact = ducc0_images(uvw, stokes, 1e-9)
    size = np.abs(np.stack(stokes[:4])).mean()
    errors = [
        max(np.abs(a - b).max() for a, b in zip(found, exact[:4], strict=False)) / size
        for found in (images, cube.data[0], ducc0_images(uvw, stokes, ACCURACY))
    ]
    ways = {
        "arrays": lambda: of_arrays(imager, vis),
        "image": lambda: imager.image(vis),
        "ducc0": lambda: ducc0_images(uvw, stokes, ACCURACY),
    }
    with tempfile.TemporaryDirectory() as folder:
        command = wsclean(Path(folder), vis, observation, lofar)
        if command:
            ways["wsclean"] = lambda: process(command, dict(os.environ))
        found = {name: [] for name in ways}
        for _ in range(runs):
            for name, way in ways.items():
                found[name].append(seconds(way))
                print(f"{name} {found[name][-1]:.2f} s", flush=True)
    best = {name: min(each) for name, each in found.items()}
    write(runs, best, found, errors, (len(uvw), samples))


def write(runs, best, found, errors, counts):
    """The table."""
    names = {
        "arrays": "this package, from arrays", "image": "this package, `Imager.image(vis)`",
        "ducc0": "ducc0 on all visibilities", "wsclean": "WSClean 3.1 (four images, no PSF)",
    }  # fmt: skip
    used = ", ".join(f"{name} {version(name)}" for name in ("numpy", "numba", "ducc0", "instrument"))
    wrong = dict(zip(("arrays", "image", "ducc0"), errors, strict=True))
    rows = [
        f"| {names[name]} | {best[name]:.2f} s | {', '.join(f'{x:.2f}' for x in found[name])} | "
        + " | ".join(f"{best[name] / best[way]:.1f}" for way in ("arrays", "image"))
        + f" | {f'{wrong[name]:.1e}' if name in wrong else '-'} |"
        for name in best
    ]
    without = "" if "wsclean" in best else "\nWSClean or casacore was not there.\n"
    text = f"""# Dirty images of one channel: I, Q, U, V and the PSF

{date.today()}, one thread of {os.cpu_count()} cores ({platform.machine()}), Python {platform.python_version()},
{used}.
59 stations, 8 h of 10 s, 30-800 wavelengths, {PIXELS} x {PIXELS} of 0.5', natural weights, accuracy {ACCURACY:g},
random visibilities. In turn, {runs} times, with load from other work on the machine: ratios are what to read.
Made by `python docs/reports/imaging_speed.py --runs {runs}`.

{counts[0]} visibilities within the uv range, {counts[1]} samples gridded in their place.

| | best | all, s | over arrays | over `Imager` | largest error of a pixel, over mean abs V |
|---|---|---|---|---|---|
{chr(10).join(rows)}
{without}
Errors are against ducc0 at 1e-9 on all visibilities. ducc0 is given uvw and Stokes visibilities within the range, ready
made; this package starts from correlations of all baselines, and works out which are within it.
"""
    (HERE / "imaging_speed.md").write_text(text)
    print(text)


if __name__ == "__main__":
    if os.environ.get(THREADS[0]) != "1":  # libraries read it when they are loaded: begin again with one thread
        os.execve(sys.executable, [sys.executable, *sys.argv], {**os.environ, **dict.fromkeys(THREADS, "1")})
    main()
