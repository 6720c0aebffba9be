"""Calibration with the LOFAR beams in the model: this package alone, and beside DP3's gaincal and ddecal.

    pip install ".[peers,test]" && python docs/reports/calibration_beams.py [--times 96] [--runs 3]
    python docs/reports/calibration_beams.py --directions [--runs 3]
    OMP_NUM_THREADS=1 python docs/reports/calibration_beams.py --alone [--times 96]  # needs no peers

59 stations, 150 MHz, 25 sources that are not polarized, seen through element, tile and station beams; errors new in
each integration. Beside DP3, both are timed as whole processes, in turn, on complex64 data: ours reads data and model
from files and saves an h5parm; DP3 reads them from a Measurement Set and writes one. The error is that of the data
without noise against the model, after correction. Each way of calling rewrites its section of calibration_beams.md,
the first also calibration_beams.png.
"""

import argparse
import os
import pickle
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
from peers import DP3, HEAD, measured, peer_tools, process, row_of

import instrument
from instrument import Chain, FeedTerm, GainTerm, Observation, PointSky, Scene, SelfCal, read_h5parm

HERE = Path(__file__).parent
SEFD = 2820 * u.Jy
COMMON = {"maxiter": 1000, "detectstalling": "false"}
CENTRE = "08h13m36.0s +48d13m03s"
CLUSTERS = {"A": (0, 0, 80), "B": (2, 1, 40), "C": (-1.5, 2, 30)}  # degrees from the centre, Jy
OURS_TO = ("1e-2", "1e-4", "1e-6", "1e-8", "1e-10")
GAINCAL_TO = ("1e-4", "1e-5", "1e-6", "1e-7", "1e-8")
OURS = """
import pickle, sys
import numpy as np
from instrument import SelfCal, DirectionalCal, Visibilities, write_h5parm
folder, tolerance, first, *columns = sys.argv[1:]
of = pickle.load(open(f"{folder}/of.pickle", "rb"))
cut = slice(0, int(first) or None), slice(None)
load = lambda name: Visibilities(np.load(f"{folder}/{name}.npy").astype(complex), *of).block(*cut)
data = load("DATA")
if columns:
    minute = DirectionalCal(tolerance=float(tolerance), interval="60 s")
    parts = minute.solve(data, {name: load(name) for name in columns})
    for name in columns:
        write_h5parm(f"{folder}/ours_{name}.h5", parts[name], at=data.at, overwrite=True)
    found = parts[columns[0]]
else:
    found = SelfCal(tolerance=float(tolerance)).solve(data, load("MODEL_DATA"))
    write_h5parm(f"{folder}/ours.h5", found, at=data.at, overwrite=True)
print("Converged:", int(found.converged.sum()))
"""


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


class Files:
    """Data and models in a folder, as arrays for us and in a Measurement Set for DP3; commands that solve them."""

    def __init__(self, folder, model, columns):
        self.folder = folder
        make_ms = peer_tools(folder).make_ms
        make_ms(folder / "cal.MS", telescope().with_fields(beam_kind="full"), night(len(model.data)), columns)
        with open(folder / "of.pickle", "wb") as file:
            pickle.dump((model.at, model.antenna1, model.antenna2, model.interval_s), file)

    def put(self, **values):
        """Write columns as complex64."""
        import casacore.tables as tables

        with tables.table(str(self.folder / "cal.MS"), readonly=False, ack=False) as ms:
            for name, vis in values.items():
                stored = vis.data.astype(np.complex64)
                np.save(self.folder / f"{name}.npy", stored)
                ms.putcol(name, stored.swapaxes(1, 2).reshape(-1, 1, 4))

    def ours(self, tolerance, columns=()):
        """Commands for all integrations, and for the first six or first one."""
        command = [sys.executable, "-c", OURS, str(self.folder), tolerance]
        return [[*command, n, *columns] for n in ("0", "6" if columns else "1")]

    def dp3(self, step, first, **settings):
        """The same two for a step of DP3."""
        command = [sys.executable, "-c", DP3, f"msin={self.folder}/cal.MS", "msout=", f"steps=[{step}]", "numthreads=2"]
        command += [f"{step}.{key}={value}" for key, value in (COMMON | settings).items()]
        return [command, [*command, f"msin.ntimes={first}"]]

    def gaincal(self, tolerance):
        file = f"{self.folder}/gaincal.h5"
        return self.dp3(
            "gaincal", 1, caltype="fulljones", usemodelcolumn="true", parmdb=file, tolerance=tolerance, maxiter=300
        )

    def ddecal(self, tolerance):
        columns, file = f"[{','.join(CLUSTERS)}]", f"{self.folder}/ddecal.h5"
        own = {"mode": "fulljones", "modeldatacolumns": columns, "h5parm": file, "solint": 6}
        return self.dp3("ddecal", 6, tolerance=tolerance, **own)


def beside_gaincal(given):
    """Rows of all ways, those of times at the same error, and what the figure shows, by case."""
    rows, ratios, shown, count = [], [], {}, given.times
    with tempfile.TemporaryDirectory() as folder:
        folder, model = Path(folder), seen(count)
        files = Files(folder, model, ("DATA", "MODEL_DATA"))
        for rms in (1e-2, 1e-1):
            clean = model.corrupted(errors(rms))
            for noisy in (False, True):
                files.put(DATA=clean.with_noise(SEFD, seed=3) if noisy else clean, MODEL_DATA=model)
                ways = {f"ours, {t}": files.ours(t) for t in OURS_TO}
                ways |= {f"gaincal, {t}": files.gaincal(t) for t in GAINCAL_TO[: 3 if noisy else None]}
                process(ways["ours, 1e-4"][0], dict(os.environ))  # compiled once

                def error(name, clean=clean):
                    file = folder / ("ours.h5" if "ours" in name else "gaincal.h5")
                    return off(clean, read_h5parm(file, layout=model.layout), model)

                case = f"errors of {rms:g}, {f'SEFD {SEFD:.0f}' if noisy else 'no noise'}"
                shown[case] = found = measured(ways, given.runs, error, count)
                rows += [row_of(case, name, value, count) for name, value in found.items()]
                least = min(value for _, value, _ in found.values())
                for most in (1.01 * least,) if noisy else (1e-4, 1e-5, 1e-6, 1e-7):
                    ratios.append(at_error(case, most, found))
    return rows, ratios, shown


def at_error(case, most, found):
    """Row: the quickest of each program whose error is no more than some."""
    quick = {}
    for name, ((_, _, one), value, _) in found.items():
        if value <= most:
            quick.setdefault(name.split(",")[0], []).append(one)
    ours, theirs = (min(quick.get(which, [np.nan])) for which in ("ours", "gaincal"))
    cells = ["not reached" if np.isnan(x) else f"{x:.1f}" for x in (ours, theirs)]
    ratio = "" if np.isnan(ours + theirs) else f"{theirs / ours:.2f}"
    return f"| {case} | {most:.3g} | {cells[0]} | {cells[1]} | {ratio} |"


def figure(shown):
    """Error against time of a solution, a panel for each case."""
    import matplotlib.pyplot as plt

    from instrument.report.style import BLUE, ORANGE, STYLE

    with plt.rc_context(STYLE):
        drawing, panels = plt.subplots(2, 2, figsize=(8.5, 7), layout="constrained")
        for ax, (case, found) in zip(panels.flat, shown.items(), strict=True):
            for which, colour, mark in (("ours", BLUE, "o"), ("gaincal", ORANGE, "s")):
                points = {name: v for name, v in found.items() if name.startswith(which)}
                x, y = zip(*((best[2], value) for best, value, _ in points.values()), strict=True)
                ax.loglog(x, y, color=colour, marker=mark, label=which)
                for name, *place in zip(points, x, y, strict=True):
                    if "no noise" in case:
                        ax.annotate(name.split(", ")[1], place, (4, 4), textcoords="offset points", fontsize=9)
            ax.set_title(case)
            ax.grid(alpha=0.3)
        panels[0, 0].legend()
        drawing.supxlabel("processor time a solution, ms")
        drawing.supylabel("corrected clean data less model, relative")
    return drawing


def beside_ddecal(given, times=24):
    """Rows of DirectionalCal and ddecal: three clusters, an interval of 60 s, errors of 0.1 that stay."""
    from instrument import JonesTable

    rows, count = [], times // 6
    with tempfile.TemporaryDirectory() as folder:
        folder, sky = Path(folder), clusters(times)
        model = next(iter(sky.values()))
        files, true = Files(folder, model, ("DATA", *sky)), {}
        for k, name in enumerate(sky):
            drawn = np.random.default_rng(k).normal(size=(len(model.layout), 2, 2, 2)).view(complex)[..., 0]
            values = (np.eye(2) + 0.1 / np.sqrt(2) * drawn)[None, None]
            true[name] = JonesTable(values=values, slots_s=[0.0], freq_hz=[1.5e8])

        def total(terms):
            return sum(sky[name].corrupted(term).data for name, term in terms.items())

        clean = model.with_data(total(true))

        def error(way):
            at = {"layout": model.layout}
            if "ours" in way:
                terms = {name: read_h5parm(folder / f"ours_{name}.h5", **at) for name in sky}
            else:
                terms = {name: read_h5parm(folder / "ddecal.h5", direction=name, **at) for name in sky}
            return size(total(terms) - clean.data) / size(clean.data)

        for noisy in (False, True):
            files.put(DATA=clean.with_noise(SEFD, seed=3) if noisy else clean, **sky)
            ways = {f"ours, {t}": files.ours(t, tuple(sky)) for t in ("1e-3", "1e-6")}
            ways |= {f"ddecal, {t}": files.ddecal(t) for t in ("1e-3", "1e-4", "1e-6")}
            process(ways["ours, 1e-3"][1], dict(os.environ))
            case = f"SEFD {SEFD:.0f}" if noisy else "no noise"
            rows += [row_of(case, *item, count) for item in measured(ways, given.runs, error, count).items()]
    return rows


def alone(model, rms, sefd, tolerance, runs):
    """Row: how many converge, worst iterations, error, scatter over Cramer-Rao, pulls, ms of processor a solution."""
    term = errors(rms)
    clean, spent = model.corrupted(term), []
    data = clean if sefd is None else clean.with_noise(sefd * u.Jy, seed=3)
    for _ in range(runs):
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
    cells = [counted, solution.iterations.max(), f"{off(clean, solution.term, model):.1e}", *cells, f"{min(spent):.1f}"]
    text = f"| {rms:g} | {sefd or 'none'} | {tolerance:g} | " + " | ".join(str(c) for c in cells) + " |"
    print(text, flush=True)
    return text


def write(title, text, given):
    """Put a section into the report, in the place of the one of that title."""
    file = HERE / "calibration_beams.md"
    old = re.split(r"^## ", file.read_text(), flags=re.M)[1:] if file.exists() else []
    parts = {part.partition("\n")[0]: part.partition("\n")[2].strip() for part in old}
    packages = ["numpy", "numba", "instrument"] + ([] if given.alone else ["dp3"])
    made = f"""{date.today()}, {os.cpu_count()} cores ({platform.machine()}), Python {platform.python_version()},
{", ".join(f"{name} {version(name)}" for name in packages)}.
Made by `python docs/reports/calibration_beams.py {" ".join(sys.argv[1:])}`.""".replace(" `.", "`.")
    parts[title] = f"{made}\n\n{text.strip()}"
    order = [t for t in TITLES if t in parts]
    head = """# Calibration with beams in the model

59 LOFAR stations, 150 MHz, 0.19 MHz, integrations of 10 s; models of sources that are not polarized, seen through
element, tile and station beams; errors of station gains and feeds that are new in each integration. *Error*: rms of
the corrected data *without noise* less the model, relative to the model: what noise makes of the solutions counts,
noise does not."""
    body = "".join(f"\n\n## {t}\n\n{parts[t]}" for t in order)
    file.write_text(head + body + "\n")


TITLES = ("Beside gaincal", "Directions, beside ddecal", "This package alone")


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--times", type=int, default=96)
    parser.add_argument("--runs", type=int, default=3)
    parser.add_argument("--directions", action="store_true")
    parser.add_argument("--alone", action="store_true")
    given = parser.parse_args()
    if given.alone:
        model = seen(given.times)
        cases = [(rms, None, t) for rms in (1e-3, 1e-2, 1e-1) for t in (1e-4, 1e-6, 1e-8, 1e-10)]
        cases += [(rms, sefd, 1e-8) for rms in (1e-3, 1e-2, 1e-1) for sefd in (2820, 282, 28)]
        rows = [alone(model, *case, given.runs) for case in cases]
        write(TITLES[2], ALONE + "\n".join(rows), given)
    elif given.directions:
        write(TITLES[1], DIRECTIONS + "\n".join([HEAD, *beside_ddecal(given)]), given)
    else:
        from instrument.report.style import save

        rows, ratios, shown = beside_gaincal(given)
        save(figure(shown), HERE / "calibration_beams.png")
        lines = [BESIDE, *ratios, "", HEAD, *rows, "", "![Error against time](calibration_beams.png)"]
        write(TITLES[0], "\n".join(lines), given)


BESIDE = """25 sources of 5 Jy. Data, model and columns are complex64, which DP3 needs: what that rounds is 2.5e-8 of
the data, below which no error means anything here. Both are timed as whole processes in turn; *ms a solution* is
processor time over that of a set of one integration, so that starting Python, or DP3, does not count; *processor* and
*wall* have it all; best of the runs (what takes more than 10 s is run once). gaincal: fulljones, solint 1, at most
300 iterations, no detection of stalling; with noise down to 1e-6, below which nothing is gained. Times at an error
are those of the quickest tolerance that has no more; with noise, no more than 1.01 times the least error of any.

| case | error at most | ours, ms a solution | gaincal, ms a solution | gaincal / ours |
|---|---|---|---|---|"""
DIRECTIONS = """Three clusters of 80, 40 and 30 Jy, two sources each, 60 s; full Jones errors of rms 0.1 for each
cluster, that stay. `DirectionalCal`, and ddecal (fulljones, a model column for each cluster, at most 1000 iterations,
no detection of stalling). *Error*: the sum of what the solutions predict less the data without noise, relative to
those.

"""
ALONE = """25 sources of 5 Jy, complex128. *Scatter*: rms of what the solution predicts less the data without noise,
over that of the noise, over sqrt(p / N): p unknowns (8 a station, less the directions that are free or weak), N real
data. *Pulls*: rms of gains less true ones over `solution.error`, after `solution.aligned`. Processor time of `solve`,
one thread, best of the runs.

| errors | SEFD, Jy | tolerance | converged | most iterations | error | scatter / Cramer-Rao | pulls | ms a solution |
|---|---|---|---|---|---|---|---|---|
"""


if __name__ == "__main__":
    main()
