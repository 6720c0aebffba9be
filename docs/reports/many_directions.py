"""Five clusters of directions, each with its own slowly varying Jones matrices: solved at once, and subtracted.

    python docs/reports/many_directions.py

Writes many_directions.md beside this file. The observation is that of tests/accuracy/test_directional.py: 24 stations
of LOFAR without beams, clusters of two sources, 10 to 80 Jy, 2.2 to 2.7 deg from the brightest.
"""

import importlib.util
import os
import platform
import time
from datetime import date
from functools import partial
from pathlib import Path

import numpy as np
from astropy import units as u

from instrument import PointSky, Scene, SelfCal
from instrument.calibrate.directional import DirectionalCal
from instrument.experiments.many_directions import ManyDirections
from instrument.pipeline.scene_file import parse
from instrument.pipeline.scene_text import override, read_tables

HERE = Path(__file__).parent
STATIONS, SLOTS = 24, 360


def load_laboratory():
    """The sky, the true matrices and the measures of error that the tests use."""
    spec = importlib.util.spec_from_file_location("laboratory", HERE.parents[1] / "tests/accuracy/test_directional.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


lab = load_laboratory()


def solved(settings, data, sky):
    """The solution and the seconds it took."""
    begin = time.perf_counter()
    solution = settings.solve(data, sky)
    return solution, time.perf_counter() - begin


def without_noise():
    """Rows: interval, rest after subtraction when the matrices turn on and on, and when they wait for the interval."""
    for count in (1, 3, 6, 12):
        row = []
        for hold in (1, count):
            data, sky, _ = lab.laboratory(slots=12, stations=STATIONS, hold=hold)
            solution, _ = solved(DirectionalCal(interval=10 * count * u.s), data, sky)
            solution.check()
            row.append(lab.rms(solution.subtracted(data, sky)) / lab.rms(data))
        yield f"| {10 * count} s | {row[0]:.1e} | {row[1]:.1e} |"


def bias(solution, jones, count):
    """Mean t^2 of all elements, and its expectation and standard error if there is no bias."""
    t2 = []
    for name, value in jones.items():
        want = lab.held(value, count)
        error = (solution[name].aligned(want).jones - want).reshape(len(want), -1).view(float)
        t2.append(len(error) * error.mean(axis=0) ** 2 / error.var(axis=0, ddof=1))
    n, t2 = len(error), np.concatenate(t2)
    mean = (n - 1) / (n - 3)
    return t2.mean(), mean, mean * np.sqrt(2 * (n - 2) / (n - 5) / t2.size)


def with_noise():
    """Rows: interval, rest over noise and what it should be, the same for SelfCal, errors of the matrices, bias."""
    data, sky, jones = lab.laboratory(slots=SLOTS, stations=STATIONS)
    noisy = data.with_noise(lab.SEFD, seed=11)
    noise = lab.rms(noisy - data)
    model = data.with_data(sum(m.data for m in sky.values()))
    for count in (3, 6, 12, 30):
        solution, seconds = solved(DirectionalCal(interval=10 * count * u.s, tolerance=1e-6), noisy, sky)
        solution.check()
        one = SelfCal(interval=10 * count * u.s, tolerance=1e-6).solve(noisy, model)
        single = model.corrupted(one.term)
        steady = {name: np.repeat(lab.held(value, count), count, axis=0) for name, value in jones.items()}
        turning = lab.rms(data - lab.total(sky, steady)) / noise
        taken = 5 * (8 * STATIONS - 4) / (count * len(noisy.antenna1) * 8)
        left = lab.rms(solution.subtracted(noisy, sky)) / noise
        wrong = [lab.rms(p - data) / noise for p in (solution.predicted(sky), single)]
        errors = [lab.error_of(solution[name], jones[name], count) for name in ("80 Jy", "10 Jy")]
        found, mean, spread = bias(solution, jones, count)
        due = np.sqrt(1 - taken + turning**2)
        yield (
            f"| {10 * count} s | {left:.3f} | {due:.3f} | {lab.rms(noisy - single) / noise:.2f} "
            f"| {wrong[0]:.3f} | {wrong[1]:.2f} | {wrong[1] / wrong[0]:.1f} | {errors[0]:.4f}, {errors[1]:.4f} "
            f"| {found:.3f} ({mean:.3f} ± {spread:.3f}) | {np.median(solution['80 Jy'].iterations):.0f} "
            f"| {1e3 * seconds * count / SLOTS:.0f} |"
        )


def struck(vis):
    """1 % of the visibilities with interference of 100 Jy."""
    rng = np.random.default_rng(5)
    hit = rng.random(vis.data.shape[:3])[..., None, None] < 0.01
    return vis.with_data(vis.data + 100 * hit * rng.normal(size=(*vis.data.shape, 2)).view(complex)[..., 0])


def with_source(vis, flux, width):
    """With a source that no model has, 3.1 deg away."""
    night = lab.Observation(
        phase_centre=lab.CENTRE, transit="2012-12-07", duration=len(vis.data) * 10 * u.s, interval=10 * u.s,
        frequencies=[150] * u.MHz, channel_width=0.19 * u.MHz,
    )  # fmt: skip
    array = lab.instrument.load("telescopes", "lofar-hba", beam=None, stations=list(vis.layout.names))
    shape = np.full(1, width.to_value(u.rad))
    place = lab.CENTRE.spherical_offsets_by(3 * u.deg, 0.7 * u.deg)
    sky = PointSky.at(place, [flux], major_rad=shape, minor_rad=shape)
    return vis.with_data(vis.data + Scene(instrument=array, sky=sky, observation=night).plan().run().data)


def outliers():
    """Rows: what is wrong with the data, errors of the matrices of the brightest and faintest cluster, by weights."""
    data, sky, jones = lab.laboratory(slots=120, stations=STATIONS)
    noisy = data.with_noise(lab.SEFD, seed=11)
    cases = {
        "nothing": noisy,
        "100 Jy of interference in 1 % of the visibilities": struck(noisy),
        "a source of 100 Jy, 1 deg wide (FWHM)": with_source(noisy, 100, 1 * u.deg),
        "a point of 1 Jy": with_source(noisy, 1, 0 * u.deg),
        "a point of 10 Jy": with_source(noisy, 10, 0 * u.deg),
    }
    for what, vis in cases.items():
        row = []
        for freedom in (None, 5):
            solution, _ = solved(DirectionalCal(interval=60 * u.s, tolerance=1e-5, robust=freedom), vis, sky)
            good = solution["80 Jy"].converged
            row += [lab.error_of(solution[name], jones[name], 6) for name in ("80 Jy", "10 Jy")]
            row.append(f"{good.sum()} of {good.size}")
        yield "| " + what + " | " + " | ".join(x if isinstance(x, str) else f"{x:.4f}" for x in row) + " |"


def laboratory(beam, minutes=5):
    """The plan of the scene many-directions with STATIONS stations and some beam."""
    names = lab.instrument.load("telescopes", "lofar-hba", beam=None).layout().names
    chosen = [names[i] for i in np.linspace(0, len(names) - 1, STATIONS).astype(int)]
    sets = [f"instrument.beam='{beam}'", f"observation.duration='{minutes} min'", f"instrument.stations={chosen!r}"]
    scene = parse(override(read_tables("many-directions"), sets))
    return scene.plan(scene.scene())


def through_beams(seeds=20):
    """The section on beams: means over seeds and their standard errors; matrices stand still."""
    settings = DirectionalCal(interval=60 * u.s, tolerance=1e-6)
    rows = []
    for beam in ("none", "full"):
        plan = laboratory(beam)
        for sefd in (None, 2820 * u.Jy):
            runs = [
                ManyDirections(calibrator=settings, period=1e9 * u.s, sefd=sefd, seed=seed).run(plan)
                for seed in range(seeds if sefd is not None else 3)
            ]
            scaled = [(r.left, r.wrong_jy / r.scale_jy, r.one_wrong_jy / r.wrong_jy) for r in runs]
            made = [[*row, *r.error, np.mean(r.failed)] for row, r in zip(scaled, runs, strict=True)]
            mean, error = np.mean(made, axis=0), np.std(made, axis=0, ddof=1) / np.sqrt(len(made))
            form = ".4f" if sefd is not None else ".1e"
            parts = [f"{m:{form}} ± {e:.1g}" for m, e in zip(mean[:2], error[:2], strict=True)]
            parts += [f"{mean[2]:.3g} ± {error[2]:.1g}"]
            parts += [f"{m:.2g} ± {e:.1g}" for m, e in zip(mean[3:-1], error[3:-1], strict=True)]
            rows.append(f"| {beam} | {'none' if sefd is None else sefd} | {' | '.join(parts)} | {100 * mean[-1]:.0f} |")
    taken = np.sqrt(5 * 8 * STATIONS / (8 * 6 * STATIONS * (STATIONS - 1) / 2))
    table = "\n".join(rows)
    return f"""## Through beams

The scene `many-directions`, {STATIONS} stations, 5 min, matrices that stand still: means over {seeds} seeds of
errors and noise (3 without noise), and their standard errors. *Left* and *wrong* as above, over the noise, or over the
data where there is none; the unknowns take {taken:.4f} of the noise. *Ratio*: how many times more wrong one direction
for all is. Matrices: rms error per element of the clusters, common directions that are free or weak taken out (cluster
5 is too faint through the beam, and the solution says so).

| beam | SEFD | left | wrong | ratio | 3C196 | 2 | 3 | 4 | 5 | failed % |
|---|---|---|---|---|---|---|---|---|---|---|
{table}

All 59 stations for 10 min, matrices that turn over once in an hour, 2820 Jy (2026-11-26,
`instrument run many-directions --set instrument.beam=full --set "observation.duration=10 min"`, 72 s on a busy
machine, 42 s of processor time): all 10 intervals of the five clusters converge, 0.999 of the noise is left (0.999 is
due), 0.238 is wrong (one direction for all: 0.696).
"""


def main():
    begin = time.perf_counter()
    data, sky, _ = lab.laboratory(slots=6, stations=59)
    once = partial(DirectionalCal(interval=60 * u.s, tolerance=1e-6).solve, data.with_noise(lab.SEFD, seed=1), sky)
    once()
    start = time.perf_counter()
    once()
    large = time.perf_counter() - start
    lines = [[*rows()] for rows in (without_noise, with_noise, outliers)]
    tables = ["\n".join(rows) for rows in lines]
    text = f"""# Many directions: five clusters solved at once

{date.today()}, {os.cpu_count()} cores ({platform.machine()}), Python {platform.python_version()},
numpy {np.__version__}. {STATIONS} LOFAR stations, 150 MHz, integrations of 10 s; clusters of 80, 40, 30, 20 and 10 Jy
within 2.7 deg of the brightest. Each has its own full Jones matrices per station, 1 + errors of rms 0.1 that turn over
once in an hour. Made by `python docs/reports/many_directions.py` in {time.perf_counter() - begin:.0f} s.

## Without noise

Rms that is left over rms of the data, 2 min.

| interval | matrices turn on and on | matrices are constant within intervals |
|---|---|---|
{tables[0]}

The solver leaves rounding, even of single integrations, whose equations have a condition number of 1e6 here. What is
left where the matrices turn within an interval is their turning, which no constant follows: 3 % of an error a minute.

## With noise (2820 Jy, 0.19 MHz, 10 s: 2.0 Jy rms in a complex correlation), 1 h

*Left*: rms after subtraction over that of the noise; *due*: what the noise, less the degrees of freedom of the
solution, and the turning within intervals leave. *Wrong*: rms of what was subtracted less the noiseless data, over the
noise. *One*: the same two for `SelfCal`, one direction, on the same data; *ratio*: how many times more it is wrong.
*Errors*: rms per element of the matrices, gauge removed, brightest and faintest cluster. *Bias*: mean over all
stations, elements and clusters of (mean error / its standard error)^2, and in parentheses what it is without bias.

| interval | left | due | one: left | wrong | one: wrong | ratio | errors | bias | rounds | ms each |
|---|---|---|---|---|---|---|---|---|---|---|
{tables[1]}

In 300 s the turning is part of the scatter of the errors and cancels in their mean over the whole turn of an hour: the
last figure of bias falls below what independent errors give.

59 stations, an interval of 60 s: {large:.1f} s on one core.

{through_beams()}
## Outliers, 60 s, 20 min

Errors of the matrices of the brightest and the faintest cluster over the intervals that converged, and how many did:
with plain weights, and with Student's t of 5 degrees of freedom.

| what no model has | plain, 80 Jy | 10 Jy | converged | robust, 80 Jy | 10 Jy | converged |
|---|---|---|---|---|---|---|
{tables[2]}

Robust weights help where few visibilities are wrong: interference, or extended emission, which short baselines alone
see. A point that no model has is in all visibilities alike: weights do not help, they make it worse, and it must be
added to the model.
"""
    (HERE / "many_directions.md").write_text(text)
    print(text)


if __name__ == "__main__":
    main()
