"""Power spectra of a cube of 480 x 480 x 161: this package beside ps_eor, powerbox and tools21cm.

    pip install ".[peers,test]" && python docs/reports/power_spectra.py [--runs 7] [--boxes 2]

Seconds of one float32 cube, in turn, in one process: once as it comes, and once with an allocator that keeps the memory
it has had (large arrays are paged in each time otherwise, which costs the others most). Peak memory of each way in a
process of its own. And what is recovered of fields of known spectrum behind different tapers, by ours and by ps_eor.
Writes power_spectra.md beside this file; needs 5 GB for the larger field that pieces are cut from (--boxes 0: none).
"""

import argparse
import json
import os
import platform
import subprocess
import sys
import time
import warnings
from datetime import date
from importlib.metadata import version
from pathlib import Path

import numpy as np
from astropy import units as u
from astropy.cosmology import Planck15

from instrument import Analyzer, StokesCube

HERE = Path(__file__)
SHAPE, PIXEL = (161, 480, 480), 0.5 * u.arcmin
FREQ = np.linspace(134e6, 166e6, SHAPE[0])
CUT = (20, 900)  # wavelengths
EDGES = np.geomspace(0.02, 0.9, 13)
SHOWN = [3, 6, 9, 11]  # bins about k = 0.06, 0.16, 0.42, 0.79
# glibc: nothing is mapped by itself, nothing is given back
KEPT = {"MALLOC_MMAP_MAX_": "0", "MALLOC_TRIM_THRESHOLD_": "100000000000"}
TAPERS = {"none": (None, None), "BH": ("blackman-harris", None), "BH + Hann": ("blackman-harris", "hann")}


def cube_of(field):
    """All four Stokes parameters are the one field: nothing is copied."""
    return StokesCube(np.broadcast_to(field[:, None], (len(field), 4, *field.shape[1:])), FREQ * u.Hz, PIXEL, "K")


def noise(seed):
    out = np.empty(SHAPE, np.float32)
    return np.random.default_rng(seed).standard_normal(dtype=np.float32, out=out)


# Ways ------------------------------------------------------------------------------------------------------------


def visibilities(field, taper_space=None):
    """ps_eor's cube of (u, v) cells, with its image window where one is asked for."""
    from ps_eor import datacube

    about = datacube.ImageMetaData.from_res(PIXEL.to_value(u.rad), field.shape[1:])
    about.wcs.wcs.cdelt[2] = FREQ[1] - FREQ[0]
    images = datacube.CartImageCube(field, FREQ, about)
    if taper_space:
        images.apply_window_function(datacube.WindowFunction(taper_space, circular=False))
    return images.ft(*CUT)


def ps_eor_of(cube, taper="hann", delays=None):
    from ps_eor import datacube, pspec

    settings = pspec.PowerSpectraConfig(el=2 * np.pi * np.geomspace(*CUT, 16), window_fct=taper)
    settings.umin, settings.umax = CUT
    band = pspec.EorBin(0, cube.freqs, cube.freqs, M=delays)
    return pspec.PowerSpectraCart(band, settings, datacube.NoPrimaryBeam())


def ours_cut(field):
    cells = Analyzer(cube_of(field)).cells(taper="hann", uv_range=CUT)
    return cells.cylindrical(), cells.spherical(bins=EDGES / u.Mpc)


def ps_eor_two(field):
    cube = visibilities(field)
    made = ps_eor_of(cube)
    return made.get_ps2d(cube), made.get_ps3d(EDGES / Planck15.h, cube)


def ps_eor_all(field):
    cube = visibilities(field)
    return ps_eor_of(cube).get_all(EDGES / Planck15.h, cube)


def ps_eor_alone(field):
    """Its own number of FFT threads, 2, costs it up to 3 s where the cores are shared with others."""
    from ps_eor import psutil

    threads, psutil.NUM_POOL = psutil.NUM_POOL, 1
    try:
        return ps_eor_two(field)
    finally:
        psutil.NUM_POOL = threads


def ours_all(field):
    cells = Analyzer(cube_of(field)).cells(taper=None)
    return cells.cylindrical(), cells.spherical(bins=EDGES / u.Mpc)


def box():
    """Lengths of the cube in Mpc, as ours takes them."""
    from instrument.analyze.power.fourier import comoving, line_of_sight

    z, distance = comoving((FREQ[0] + FREQ[-1]) / 2, None, None)
    depth = line_of_sight(z, None) * (FREQ[1] - FREQ[0]) * len(FREQ)
    return [depth, *(n * PIXEL.to_value(u.rad) * distance for n in SHAPE[1:])]


def powerbox(field):
    import powerbox

    return powerbox.get_power(field, box(), bins=EDGES, dimensionless=False).power


def tools21cm(field):
    import tools21cm

    return tools21cm.power_spectrum_1d(field, kbins=EDGES, box_dims=box())[0]


WAYS = {
    "cut": {
        "ours: cylindrical and spherical": ours_cut,
        "ps_eor: get_ps2d and get_ps3d": ps_eor_two,
        "ps_eor: the same, FFTs on one thread": ps_eor_alone,
        "ps_eor: get_all (these and two more)": ps_eor_all,
    },
    "all": {
        "ours: cylindrical and spherical": ours_all,
        "powerbox: get_power": powerbox,
        "tools21cm: power_spectrum_1d": tools21cm,
    },
}


# Seconds and memory ----------------------------------------------------------------------------------------------


def seconds_here(runs):
    """Seconds by kind and name, in turn; the first round, in which everything is loaded, does not count."""
    field = noise(0)
    spent = {kind: {name: [] for name in ways} for kind, ways in WAYS.items()}
    for run in range(runs + 1):
        for kind, ways in WAYS.items():
            for name, way in ways.items():
                begin = time.perf_counter()
                way(field)
                if run:
                    spent[kind][name].append(time.perf_counter() - begin)
    return spent


def peak_mb():
    """Of this process; ru_maxrss would begin at that of its parent."""
    lines = Path("/proc/self/status").read_text().splitlines()
    return next(float(line.split()[1]) for line in lines if line.startswith("VmHWM")) / 1e3


def memory_here(kind, name):
    """Peak memory in MB above that of the cube and the libraries; a small cube has loaded those."""
    way, field = WAYS[kind][name], noise(0)
    way(field[:, :48, :48].copy())
    before = peak_mb()
    way(field)
    return peak_mb() - before


def child(*options, environment=None):
    """What this script prints last with these options, in a process of its own."""
    command = [sys.executable, str(HERE), *map(str, options)]
    done = subprocess.run(command, check=True, stdout=subprocess.PIPE, text=True, env=os.environ | (environment or {}))
    return json.loads(done.stdout.splitlines()[-1])


def used():
    """Seconds by the clock, of all cores at work, and of the children of this process."""
    ticks = [int(x) for x in Path("/proc/stat").read_text().split()[1:9]]
    busy = (sum(ticks) - ticks[3] - ticks[4]) / os.sysconf("SC_CLK_TCK")  # less idle and waiting for disks
    own = os.times()
    return np.array([time.perf_counter(), busy, own.children_user + own.children_system])


def time_table(kind, spent, kept):
    """Markdown, and how many times as long as ours the others take (best over best), (as it comes, memory kept)."""
    lines = [
        "| | best, s | all, s | times ours | memory kept: best, s | times ours | peak memory above the cube, MB |",
        "|---|---|---|---|---|---|---|",
    ]
    ours = None
    times = []
    for name, runs in spent.items():
        best = np.array([min(runs), min(kept[name])])
        ours = best if ours is None else ours
        times.append(best / ours)
        each = ", ".join(f"{s:.2f}" for s in runs)
        peak = child("--memory", kind, name)
        cells = f"{best[0]:.2f} | {each} | {times[-1][0]:.1f} | {best[1]:.2f} | {times[-1][1]:.1f} | {peak:.0f}"
        lines.append(f"| {name} | {cells} |")
    return "\n".join(lines), times[1:]


# What is recovered -----------------------------------------------------------------------------------------------


def law(k):
    """K² Mpc³, k in 1/Mpc."""
    return (np.maximum(k, 1e-9) / 0.1) ** -3.5


def larger(seed):
    """A periodic field of twice the size of the cube along each axis, P = law(k); its largest waves are in no piece."""
    from ducc0 import fft

    shape = tuple(2 * n for n in SHAPE)
    field = np.empty(shape, np.float32)
    np.random.default_rng(seed).standard_normal(dtype=np.float32, out=field)
    lengths = 2 * np.array(box())
    cells = fft.r2c(field, axes=(0, 1, 2), nthreads=0)
    del field
    par, y = (2 * np.pi * n * np.fft.fftfreq(n) / length for n, length in zip(shape[:2], lengths[:2], strict=True))
    x = 2 * np.pi * np.arange(shape[2] // 2 + 1) / lengths[2]
    voxel = np.prod(lengths) / np.prod(shape)
    for k_par, part in zip(par, cells, strict=True):
        k = np.sqrt(k_par**2 + y[:, None] ** 2 + x**2)
        part *= np.sqrt(np.where(k > 0, law(k), 0) / voxel)
    return fft.c2r(cells, axes=(0, 1, 2), lastsize=shape[2], forward=False, inorm=2, nthreads=0)


def pieces(seed):
    whole, (f, y, x) = larger(seed), SHAPE
    for i, j, k in np.ndindex(2, 2, 2):
        yield np.ascontiguousarray(whole[i * f : i * f + f, j * y : j * y + y, k * x : k * x + x])


def ours_over(field, truth, tapers):
    """P over the mean of the true spectrum over the cells of each bin."""
    found = Analyzer(cube_of(field)).spherical(taper=tapers[0], taper_space=tapers[1], uv_range=CUT, bins=EDGES / u.Mpc)
    return found.power / found.average(truth)


def ps_eor_over(field, truth, tapers):
    names = {None: "boxcar", "blackman-harris": "blackmanharris", "hann": "hann"}
    cube = visibilities(field, tapers[1])
    made = ps_eor_of(cube, names[tapers[0]])
    h = Planck15.h
    found = made.get_ps3d(EDGES / h, cube)
    from ps_eor import psutil

    perp, par = psutil.l_to_k(2 * np.pi * cube.ru, made.z) * h, made.k_par * h
    k = np.hypot(perp, par[:, None])
    index = np.digitize(k, EDGES) - 1
    mean = np.array([truth(k[index == i]).mean() for i in range(len(EDGES) - 1)])
    return found.data * 2 * np.pi**2 / (found.k_mean * h) ** 3 / mean


def ratios(fields, truth):
    """Mean ratio and its standard error by taper and program (2, bins), over fields."""
    ways = {"ours": ours_over, "ps_eor": ps_eor_over}
    found = {(taper, who): [] for taper in TAPERS for who in ways}
    number = 0
    for field in fields:
        number += 1
        for taper, who in found:
            found[taper, who].append(ways[who](field, truth, TAPERS[taper]))
        print(f"field {number}", flush=True)
    spread = {key: np.std(rows, axis=0, ddof=1) / np.sqrt(number) for key, rows in found.items()}
    return {key: np.array([np.mean(rows, axis=0), spread[key]]) for key, rows in found.items()}, number


def ratio_table(found):
    k = [f"{np.sqrt(EDGES[i] * EDGES[i + 1]):.2f}" for i in SHOWN]
    lines = [f"| taper | | {' | '.join(f'k = {x} /Mpc' for x in k)} |", "|---|---|" + "---|" * len(SHOWN)]
    for (taper, who), (mean, error) in found.items():
        cells = " | ".join(f"{mean[i]:.3f} ± {error[i]:.3f}" for i in SHOWN)
        lines.append(f"| {taper} | {who} | {cells} |")
    return "\n".join(lines)


def agreement():
    """Largest relative differences on the same cells and bins: of ps_eor, powerbox and tools21cm."""
    field = noise(1)
    cut = Analyzer(cube_of(field)).cells(taper=None, uv_range=CUT)
    ball = cut.spherical(bins=EDGES / u.Mpc, k_par_min=cut.k_par[1] / 2 / u.Mpc)
    cube = visibilities(field)
    theirs = ps_eor_of(cube, "boxcar", len(FREQ)).get_ps3d(EDGES / Planck15.h, cube)
    factor = (len(FREQ) - 1) / len(FREQ)
    off = [np.abs(theirs.data * factor / ball.delta2 - 1).max()]
    found = Analyzer(cube_of(field)).spherical(taper=None, bins=EDGES / u.Mpc).power
    return off + [np.abs(way(field) / found - 1).max() for way in (powerbox, tools21cm)]


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--runs", type=int, default=7)
    parser.add_argument("--boxes", type=int, default=2)
    parser.add_argument("--memory", nargs=2, help=argparse.SUPPRESS)
    parser.add_argument("--seconds", action="store_true", help=argparse.SUPPRESS)
    given = parser.parse_args()
    warnings.simplefilter("ignore")  # of powerbox and astropy, about empty bins and units
    if given.memory or given.seconds:
        print(json.dumps(memory_here(*given.memory) if given.memory else seconds_here(given.runs)))
        return
    begin, asked = used(), ("--seconds", "--runs", given.runs)
    spent, kept = child(*asked), child(*asked, environment=KEPT)
    wall, busy, own = used() - begin
    (cut_table, cut), (all_table, whole) = (time_table(kind, spent[kind], kept[kind]) for kind in WAYS)
    print(f"{cut_table}\n\n{all_table}", flush=True)
    off = agreement()
    volume = np.prod(box()) / np.prod(SHAPE)
    flat, number = ratios((noise(seed) for seed in range(8)), lambda k: np.full(np.shape(k), volume))
    steep = ""
    if given.boxes:
        fields = (piece for seed in range(given.boxes) for piece in pieces(seed))
        found, cut_out = ratios(fields, law)
        steep = f"""
{cut_out} pieces, not periodic, of periodic Gaussian fields of 960 x 960 x 322 with P ~ k^-3.5:

{ratio_table(found)}
"""
    quickest, power, tools = (f"{min(t):.1f} to {max(t):.1f} times" for t in (np.min(cut, axis=0), *whole))
    names = {"numpy": "numpy", "ducc0": "ducc0", "ps_eor": "ps_eor", "pyFFTW": "pyFFTW", "powerbox": "powerbox"}
    names |= {"tools21cm": "tools21cm", "instrument": "instrument"}
    text = f"""# Power spectra of a cube of 480 x 480 x 161: seconds and figures beside ps_eor, powerbox and tools21cm

{date.today()}, {os.cpu_count()} cores ({platform.machine()}), Python {platform.python_version()},
{", ".join(f"{k} {version(v)}" for k, v in names.items())}.
White noise in K, float32, pixels of 0.5', 134 to 166 MHz. Ways in turn in one process, {given.runs} times after one
that does not count: as it comes, and with an allocator that keeps the memory it has had (MALLOC_MMAP_MAX_=0 and no
trimming), since large arrays are paged in each time otherwise. Other programs took {(busy - own) / wall:.1f} of the
{os.cpu_count()} cores meanwhile. Peak memory in a process each. Ours and tools21cm transform images in double
precision, ps_eor and powerbox those of float32 in single.
Made by `python docs/reports/power_spectra.py --runs {given.runs} --boxes {given.boxes}`.

## Baselines of 20 to 900 wavelengths, Hann along frequency

{cut_table}

The quickest way of ps_eor takes {quickest} as long.

## All cells, no taper

{all_table}

powerbox takes {power} as long and tools21cm {tools}; both make the spherical spectrum only.

## Agreement

On the same cells and bins the spherical spectra differ at most by these shares: ps_eor {off[0]:.0e} (given as many
delays as channels, and after its bandwidth (N - 1) dnu), powerbox {off[1]:.0e}, tools21cm {off[2]:.0e}.

## Recovered power over the true one

Spherical bins of ratio 1.37; the truth is the mean of the true spectrum over the cells of the bin that each program
takes. BH is Blackman-Harris along frequency, Hann goes over both axes of the images; the error is that of the mean.
ps_eor as it comes: N - 1 delays, without k_par = 0 (ours has it), and its bandwidth, for which 0.6 % is expected.

{number} cubes of white noise, periodic by nature:

{ratio_table(flat)}
{steep}"""
    HERE.with_suffix(".md").write_text(text)
    print(text)


if __name__ == "__main__":
    main()
