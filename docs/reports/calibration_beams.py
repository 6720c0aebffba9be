"""Calibration with the LOFAR beams in the model: this package alone, and beside DP3's gaincal and ddecal.

    pip install ".[peers,test]" && python docs/reports/calibration_beams.py [--times 96] [--runs 3]
    python docs/reports/calibration_beams.py --quartical ELSEWHERE/bin/goquartical [--times 96] [--runs 3]
    python docs/reports/calibration_beams.py --directions [--runs 3]
    OMP_NUM_THREADS=1 python docs/reports/calibration_beams.py --night  # all 2874 integrations, 20 minutes
    OMP_NUM_THREADS=1 python docs/reports/calibration_beams.py --alone [--times 96]  # needs no peers

QuartiCal pins its dependencies and has an environment of its own:

    python3.11 -m venv ELSEWHERE && ELSEWHERE/bin/pip install quartical==0.2.7

59 stations, 150 MHz, 25 sources that are not polarized, seen through element, tile and station beams; errors new in
each integration. All are timed as whole processes, in turn, on complex64 data: ours reads data and model from files
and saves an h5parm; DP3 and QuartiCal read them from a Measurement Set, and write one and a zarr store. The error is
that of the data without noise against the model, after correction. Each way of calling rewrites its section of
calibration_beams.md, the first one also calibration_beams.png.
"""

import argparse
import os
import platform
import re
import sys
import tempfile
import time
from datetime import date
from importlib.metadata import version
from pathlib import Path

import numpy as np
from astropy import units as u
from calibration_sets import Sets, version_in
from peers import HEAD, QUIET, measured, process, row_of, told

import instrument
from instrument import Chain, FeedTerm, GainTerm, Observation, PointSky, Scene, SelfCal, read_h5parm

HERE = Path(__file__).parent
SEFD = 2820 * u.Jy
CENTRE = "08h13m36.0s +48d13m03s"
CLUSTERS = {"A": (0, 0, 80), "B": (2, 1, 40), "C": (-1.5, 2, 30)}  # degrees from the centre, Jy
PROGRAMS = ("ours", "gaincal", "QuartiCal")
OURS_TO = ("1e-2", "1e-4", "1e-6", "1e-8", "1e-10")
PEERS_TO = ("1e-4", "1e-5", "1e-6", "1e-7", "1e-8")  # QuartiCal takes none below


def night(times):
    return Observation(
        phase_centre=CENTRE, transit="2012-12-07", duration=10 * times * u.s, interval=10 * u.s,
        frequencies=[150] * u.MHz, channel_width=0.19 * u.MHz,
    )  # fmt: skip


def telescope():
    return instrument.load("telescopes", "lofar-hba", element="hamaker")


def seen(times):
    """The model: visibilities of 25 sources through the beams."""
    sky = instrument.load("skies", "grid", shape=(5, 5), spacing=1 * u.deg, flux=5 * u.Jy)
    return Scene(instrument=telescope(), sky=sky, observation=night(times)).plan().run()


def clusters(times):
    """The models of three clusters of two sources each, by name."""
    from astropy.coordinates import SkyCoord

    found = {}
    for name, (x, y, flux) in CLUSTERS.items():
        at = SkyCoord(CENTRE).spherical_offsets_by([x, x + 0.1] * u.deg, [y, y + 0.05] * u.deg)
        sky = PointSky.at(at, flux * np.array([0.7, 0.3]))
        found[name] = Scene(instrument=telescope(), sky=sky, observation=night(times)).plan().run()
    return found


def errors(rms, seed=1):
    return Chain(GainTerm(rms=rms, seed=seed), FeedTerm(rms=rms, seed=seed + 1))


def size(values):
    return float(np.sqrt(np.nanmean(np.abs(values) ** 2)))


def off(clean, term, model):
    """Rms of corrected clean data less the model, in that of the model."""
    return size(clean.corrected(term).data - model.data) / size(model.data)


def beside_gaincal(given):
    """Rows of all ways, those of times at the same error, what the figure shows, by case; what complex64 rounds."""
    rows, ratios, shown, count = [], [], {}, given.times
    with tempfile.TemporaryDirectory() as folder:
        folder, model = Path(folder), seen(count)
        files = Sets(folder, telescope(), night(count), model, ("DATA", "MODEL_DATA"), given.quartical)
        for rms in (1e-2, 1e-1):
            clean = model.corrupted(errors(rms))
            for noisy in (False, True):
                files.put(DATA=clean.with_noise(SEFD, seed=3) if noisy else clean, MODEL_DATA=model)
                ways = {f"ours, {t}": files.ours(t) for t in OURS_TO}
                others = PEERS_TO[: 3 if noisy else None]
                ways |= {f"gaincal, {t}": files.gaincal(t) for t in others}
                if given.quartical:
                    ways |= {f"QuartiCal, {t}": files.complex_term(t) for t in others}
                for name in {way.partition(",")[0]: way for way in ways}.values():
                    process(ways[name][1], QUIET | os.environ)  # compiled once

                def error(name, said, clean=clean):
                    term, converged = files.solution(name, said)
                    return off(clean, term, model), converged

                case = f"errors of {rms:g}, {f'SEFD {SEFD:.0f}' if noisy else 'no noise'}"
                shown[case] = found = measured(ways, given.runs, error, count)
                rows += [row_of(case, name, value) for name, value in found.items()]
                least = min(value for _, value, _ in found.values())
                for most in (1.01 * least,) if noisy else (1e-4, 1e-5, 1e-6, 1e-7):
                    ratios.append(at_error(case, most, found))
    rounding = size(model.data.astype(np.complex64) - model.data) / size(model.data)
    return rows, ratios, shown, rounding


def at_error(case, most, found):
    """Row: the quickest of each program whose error is no more than some."""
    quick, ran = {}, {name.partition(",")[0] for name in found}
    for name, ((_, _, one), value, _) in found.items():
        if value <= most:
            quick.setdefault(name.split(",")[0], []).append(one)
    ours, *theirs = (min(quick.get(which, [np.nan])) for which in PROGRAMS)
    cells = [
        ("not reached" if which in ran else "not run") if np.isnan(x) else f"{x:.1f}"
        for which, x in zip(PROGRAMS, (ours, *theirs), strict=True)
    ]
    cells += ["" if np.isnan(ours + x) else f"{x / ours:.2f}" for x in theirs]
    return f"| {case} | {most:.3g} | {' | '.join(cells)} |"


def figure(shown, rounding):
    """Error against time of a solution, a panel for each case; with noise, how far it is above the least of all."""
    import matplotlib.pyplot as plt

    from instrument.report.style import BLUE, GREY, ORANGE, STYLE

    looks = dict(zip(PROGRAMS, ((BLUE, "o", -17), (ORANGE, "s", 8), ("#009E73", "^", 8)), strict=True))
    with plt.rc_context(STYLE):
        drawing, panels = plt.subplots(2, 2, figsize=(10, 8), sharex=True, layout="constrained")
        for ax, (case, found) in zip(panels.flat, shown.items(), strict=True):
            quiet, least = "no noise" in case, min(value for _, value, _ in found.values())
            for which, (colour, mark, above) in looks.items():
                points = {name: v for name, v in found.items() if name.startswith(which)}
                if points:
                    x = [best[2] if best[2] > 0 else np.nan for best, _, _ in points.values()]  # lost in the start
                    y = [value if quiet else 100 * (value / least - 1) for _, value, _ in points.values()]
                    ax.plot(x, y, color=colour, marker=mark, label=which)
                    look = {"textcoords": "offset points", "fontsize": 10, "color": colour}
                    first, *_, last = (name.split(", ")[1] for name in points)  # tolerances
                    ax.annotate(first, (x[0], y[0]), (-7, -4), ha="right", **look)
                    ax.annotate(last, (x[-1], y[-1]), (0, above), ha="center", **look)
            if quiet:
                ax.set_yscale("log")
                ax.axhspan(rounding / 100, rounding, color=GREY, alpha=0.2, lw=0, label="rounding of complex64")
                ax.set_ylim(rounding / 4, 2e-3)
            else:
                ax.set_ylim(-0.08, max(0.3, 1.3 * ax.get_ylim()[1]))
            ax.set_title(case, loc="left")
            ax.grid(alpha=0.3)
        ax.set_xscale("log")
        ax.set_xlim(0.6 * ax.get_xlim()[0], 2 * ax.get_xlim()[1])
        ax.xaxis.set_major_locator(plt.LogLocator(subs=(1, 3)))
        ax.xaxis.set_major_formatter("{x:g}")
        ax.xaxis.set_minor_formatter("")
        drawing.legend(*panels[0, 0].get_legend_handles_labels(), loc="outside upper center", ncols=4)
        for row in panels:
            row[0].set_ylabel("error (corrected data less model)")
            row[1].set_ylabel("error above the least, %")
        drawing.supxlabel("processor time a solution, ms", fontsize=13)
    return drawing


def beside_ddecal(given, times=24):
    """Rows of DirectionalCal and ddecal: three clusters, an interval of 60 s, errors of 0.1 that stay."""
    from instrument import JonesTable

    rows, count = [], times // 6
    with tempfile.TemporaryDirectory() as folder:
        folder, sky = Path(folder), clusters(times)
        model = next(iter(sky.values()))
        files, true = Sets(folder, telescope(), night(times), model, ("DATA", *sky)), {}
        for k, name in enumerate(sky):
            drawn = np.random.default_rng(k).normal(size=(len(model.layout), 2, 2, 2)).view(complex)[..., 0]
            values = (np.eye(2) + 0.1 / np.sqrt(2) * drawn)[None, None]
            true[name] = JonesTable(values=values, slots_s=[0.0], freq_hz=[1.5e8])

        def total(terms):
            return sum(sky[name].corrupted(term).data for name, term in terms.items())

        clean = model.with_data(total(true))

        def error(way, said):
            at = {"layout": model.layout}
            if "ours" in way:
                terms = {name: read_h5parm(folder / f"ours_{name}.h5", **at) for name in sky}
            else:
                terms = {name: read_h5parm(folder / "ddecal.h5", direction=name, **at) for name in sky}
            return size(total(terms) - clean.data) / size(clean.data), told(said, count)

        for noisy in (False, True):
            files.put(DATA=clean.with_noise(SEFD, seed=3) if noisy else clean, **sky)
            ways = {f"ours, {t}": files.ours(t, tuple(sky)) for t in ("1e-3", "1e-6")}
            ways |= {f"ddecal, {t}": files.ddecal(t, tuple(sky)) for t in ("1e-3", "1e-4", "1e-6")}
            process(ways["ours, 1e-3"][1], QUIET | os.environ)
            case = f"SEFD {SEFD:.0f}" if noisy else "no noise"
            rows += [row_of(case, *item) for item in measured(ways, given.runs, error, count).items()]
    return rows


def alone(model, rms, sefd, tolerance, runs):
    """Row: how many converge, worst iterations, error, scatter over Cramer-Rao, pulls, ms of processor."""
    term = errors(rms)
    clean, spent = model.corrupted(term), []
    data = clean if sefd is None else clean.with_noise(sefd * u.Jy, seed=3)
    for _ in range(max(runs, 1)):
        begin = time.process_time()
        solution = SelfCal(tolerance=tolerance).solve(data, model)
        spent.append(1e3 * (time.process_time() - begin) / len(model.data))
    cells = ["", ""]
    if sefd is not None:
        wrong = size(model.corrupted(solution.term).data - clean.data) / size(data.data - clean.data)
        unknowns = 8 * len(model.layout) - solution.gauge.loose
        truth = solution.truth(term, model.at)
        apart = solution.aligned(truth).jones - truth
        pull = size(np.stack([apart.real, apart.imag]) / solution.error)
        cells = [f"{wrong / np.sqrt(unknowns / (8 * len(model.antenna1))):.4f}", f"{pull:.3f}"]
    counted = f"{solution.converged.sum()} of {solution.converged.size}"
    cells = [counted, solution.iterations.max(), f"{off(clean, solution.term, model):.1e}", *cells]
    cells += [f"{min(spent):.1f}"] if runs else []
    text = f"| {rms:g} | {sefd or 'none'} | {tolerance:g} | " + " | ".join(str(c) for c in cells) + " |"
    print(text, flush=True)
    return text


def write(title, text, given):
    """Put a section into the report, in the place of the one of that title."""
    file = HERE / "calibration_beams.md"
    old = re.split(r"^## ", file.read_text(), flags=re.M)[1:] if file.exists() else []
    parts = {part.partition("\n")[0]: part.partition("\n")[2].strip() for part in old}
    packages = {name: version(name) for name in ("numpy", "numba", "instrument") + (() if given.alone else ("dp3",))}
    if given.quartical:
        packages["quartical"] = version_in(given.quartical)
    said = " ".join("ELSEWHERE/bin/goquartical" if a == str(given.quartical) else a for a in sys.argv[1:])
    made = f"""{date.today()}, {os.cpu_count()} cores ({platform.machine()}), Python {platform.python_version()},
{", ".join(map(" ".join, packages.items()))}.
Made by `python docs/reports/calibration_beams.py {said}`.""".replace(" `.", "`.")
    parts[title] = f"{made}\n\n{text.strip()}"
    order = [t for t in TITLES if t in parts]
    head = """# Calibration with beams in the model

59 LOFAR stations, 150 MHz, 0.19 MHz, integrations of 10 s; models of sources that are not polarized, seen through
element, tile and station beams; errors of station gains and feeds that are new in each integration. *Error*: rms of
the corrected data *without noise* less the model, relative to the model: what noise makes of the solutions counts,
noise does not."""
    body = "".join(f"\n\n## {t}\n\n{parts[t]}" for t in order)
    file.write_text(head + body + "\n")


TITLES = (
    *("Beside gaincal", "Beside gaincal and QuartiCal", "Directions, beside ddecal", "This package alone"),
    "All integrations of a night",
)


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--times", type=int, default=96)
    parser.add_argument("--runs", type=int, default=3)
    parser.add_argument("--quartical", type=Path, help="goquartical of an environment that has QuartiCal")
    parser.add_argument("--directions", action="store_true")
    parser.add_argument("--alone", action="store_true")
    parser.add_argument("--night", action="store_true", help="alone, 2874 integrations, without times")
    given = parser.parse_args()
    given.alone |= given.night
    if given.alone:
        model = seen(2874 if given.night else given.times)
        cases = [(rms, None, t) for rms in (1e-3, 1e-2, 1e-1) for t in (1e-4, 1e-6, 1e-8, 1e-10)]
        cases += [(rms, sefd, 1e-8) for rms in (1e-3, 1e-2, 1e-1) for sefd in (2820, 282, 28)]
        runs = 0 if given.night else given.runs
        rows = [alone(model, *case, runs) for case in cases]
        times = (
            ["Processor time of `solve`,\none thread, best of the runs.", " ms a solution |", "---|"]
            if runs
            else [""] * 3
        )
        write(TITLES[4 if given.night else 3], ALONE.format(*times) + "\n".join(rows), given)
    elif given.directions:
        write(TITLES[2], DIRECTIONS + "\n".join([HEAD, *beside_ddecal(given)]), given)
    else:
        from instrument.report.style import save

        rows, ratios, shown, rounding = beside_gaincal(given)
        lines = [BESIDE, *ratios, "", HEAD, *rows]
        if not given.quartical:
            save(figure(shown, rounding), HERE / "calibration_beams.png", overwrite=True)
            lines += ["", "![Error against time](calibration_beams.png)"]
        write(TITLES[1 if given.quartical else 0], "\n".join(lines), given)


BESIDE = """25 sources of 5 Jy. Data, model and columns are complex64, which DP3 needs: what that rounds is 2.5e-8 of
the data, below which no error means much here. All are timed as whole processes in turn; *ms a solution* is
processor time over that of a set of one integration, so that starting Python, DP3 or QuartiCal does not count;
*processor* and *wall* have it all; best of the runs (what takes more than 10 s beyond its start is run once). gaincal:
fulljones, solint 1, at most 300 iterations, no detection of stalling. QuartiCal: one term, "complex", time_interval 1,
one thread, all times in one chunk (the quickest), at most 300 iterations, convergence_fraction 1 (all gains). It takes
no convergence_criteria below 1e-8, and stops all integrations at once: where not all gains converged, their share is
told. With noise down to 1e-6, below which nothing is gained. Times at an error are those of the quickest tolerance
that has no more; with noise, no more than 1.01 times the least error of any.

| case | error at most | ours, ms a solution | gaincal, ms | QuartiCal, ms | gaincal / ours | QuartiCal / ours |
|---|---|---|---|---|---|---|"""
DIRECTIONS = """Three clusters of 80, 40 and 30 Jy, two sources each, 60 s; full Jones errors of rms 0.1 for each
cluster, that stay. `DirectionalCal`, and ddecal (fulljones, a model column for each cluster, at most 1000 iterations,
no detection of stalling). *Error*: the sum of what the solutions predict less the data without noise, relative to
those.

"""
ALONE = """25 sources of 5 Jy, complex128. *Scatter*: rms of what the solution predicts less the data without noise,
over that of the noise, over sqrt(p / N): p unknowns (8 a station, less the directions that are free or weak), N real
data. *Pulls*: rms of gains less true ones over `solution.error`, after `solution.aligned`. {}

| errors | SEFD, Jy | tolerance | converged | most iterations | error | scatter / Cramer-Rao | pulls |{}
|---|---|---|---|---|---|---|---|{}
"""


if __name__ == "__main__":
    main()
