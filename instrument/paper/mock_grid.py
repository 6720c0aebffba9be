"""The mock observation: leakage of a grid of unpolarized sources, its width, and calibration on the centre alone."""

from __future__ import annotations

from typing import Any

import numpy as np
from matplotlib.figure import Figure

from instrument.analyze.sources.leakage import Leakage
from instrument.jones.mean_mueller import mean_mueller
from instrument.observe.directions import separation
from instrument.paper.bench import Bench
from instrument.paper.finding import Finding
from instrument.pipeline.record import Result
from instrument.report.figures import bubbles, profile
from instrument.report.style import styled
from instrument.units import Direction, Float, unit_vectors

GRID = '{kind="grid", shape=[15, 15], spacing="0.66 deg", flux="0.4 Jy", centre_flux="100 Jy"}'
SEFD = 2820.0  # Jy, of a station


def run(bench: Bench) -> list[Finding]:
    """The scene `mock-grid`, and its sky in `incomplete-model` with nothing but the centre in the model."""
    times = bench.choose(("observation.interval=600 s", "observation.duration=8 h"), ())
    result = bench.run("mock-grid", *times)
    found: Leakage = result.stages["analyze"].parts[0].leakage  # type: ignore[attr-defined]
    inside = found.inside(4.0)
    deg = np.rad2deg(found.distance_rad)
    others = (deg > 0.1) & (deg <= 4) & found.measured
    linear = np.hypot(*found.leaked_jy[others, :2].T)
    width = _width(deg, found.stokes_jy[:, 0] / found.model_jy[:, 0])
    by_flux = float(100 * linear.sum() / found.stokes_jy[others, 0].sum())
    sweep, (culminating, nightly) = _centre_alone(bench), _by_beam(result)
    away = _from_centre(sweep)
    near = (away > 0.1) & (away <= 3) & sweep.seen
    change = sweep.change_jy[0] / sweep.flux_jy
    shift = sweep.shift_arcsec[0]
    bench.draw("linear", bubbles(found, kind="linear"), "Leakage of I into linear polarization, source by source.")
    bench.draw("profile", profile(found), "Leakage by distance: in the visibilities, and of the beam model.")
    bench.draw("centre-alone", _errors(away, change, shift, sweep.seen), "Calibrated on the centre alone.", True)
    return [
        # about 0.5: to the digit that is printed
        Finding(
            "I to linear within 4 deg, median", inside["linear_median"], "%", "about 0.5", (0.45, 0.55),
            f"the mean by flux, sum of P over sum of I of all but the centre, is {by_flux:.3f} % (their median "
            f"{np.median(found.linear_percent[others]):.3f} %); the paper has not said which", changed=by_flux,
        ),
        Finding("I to circular within 4 deg, largest", inside["circular_max"], "%", "< 0.003", (0.0, 0.003)),
        Finding("I to circular within 4 deg, median", inside["circular_median"], "%"),
        *[
            Finding(f"I to linear, {r['from_deg']:g} to {r['to_deg']:g} deg, median", r["linear_median"], "%")
            for r in found.rings()[1:]
        ],
        # of a Gaussian fitted to what is none: 3 % with what is fitted; LOFAR's own scans gave 3.8
        Finding(
            "width (FWHM) by the fluxes of the grid", width, "deg", "3.8", (3.8 * 0.95, 3.8 * 1.05),
            f"that is the mean of the night, in which the field sinks to lower elevations (the beam of them has "
            f"{nightly:.2f} deg); at transit alone the beam has {culminating:.2f} deg", changed=culminating,
        ),
        Finding("centre alone in the model: flux of others in 3 deg, median", 100 * np.median(change[near]), "%"),
        Finding("centre alone: flux of others, largest change", float(100 * np.abs(change[near]).max()), "%"),
        Finding("centre alone: position of others, median error", float(np.median(shift[near])), "arcsec"),
        Finding("centre alone: position of others, largest error", float(shift[near].max()), "arcsec"),
        Finding("centre alone: flux of the centre, change", float(100 * np.abs(change[np.argmin(away)])), "%"),
    ]  # fmt: skip


def _centre_alone(bench: Bench) -> Any:
    """The sweep of a model of one source.

    With the noise of 10 s: a grid without any is refused as interference, for on a few baselines all of it adds up.
    """
    interval = bench.choose(1200, 300)
    settings = (f"observation.interval={interval} s", f"noise.sefd={SEFD * np.sqrt(interval / 10)} Jy")
    watched = ("calibrate.models=[1]", "calibrate.watched=225", f"calibrate.every={bench.choose(2, 1)}")
    found = bench.run("incomplete-model", f"sky={GRID}", *settings, *watched)
    return found.stages["calibrate"].found  # type: ignore[attr-defined]


def _from_centre(sweep: Any) -> Any:
    middle = int(np.argmax(sweep.model_jy))
    centre = Direction(float(sweep.ra_rad[middle]), float(sweep.dec_rad[middle]))
    return np.rad2deg(separation(unit_vectors(sweep.ra_rad, sweep.dec_rad), centre))


def _by_beam(result: Result) -> tuple[float, float]:
    """The same of mean Mueller matrices over baselines towards the same sources: middle of the night, mean of it."""
    problem = result.plan.problem
    found = result.stages["analyze"].parts[0].leakage  # type: ignore[attr-defined]
    deg, times = np.rad2deg(found.distance_rad), problem.shape[0]
    night = np.unique(np.linspace(0, times - 1, 9).round().astype(int))

    def seen(t: int) -> Float:
        at = problem.at.block(slice(t, t + 1), slice(0, 1)).towards(found.ra_rad, found.dec_rad)
        return np.asarray(mean_mueller(problem.chain.beams(), at, True)[0][:, 0, 0].real)

    return _width(deg, seen(times // 2)), _width(deg, np.mean([seen(int(t)) for t in night], axis=0))


def _width(deg: Any, seen: Any) -> float:
    """FWHM in degrees of a Gaussian with free amplitude fitted to apparent over true fluxes at distances."""
    from scipy.optimize import least_squares

    fitted = least_squares(lambda p: p[0] * np.exp(-4 * np.log(2) * (deg / p[1]) ** 2) - seen, [1.0, 4.0])
    return float(fitted.x[1])


@styled
def _errors(away: Any, change: Any, shift: Any, seen: Any) -> Figure:
    figure = Figure(figsize=(11, 4.5), layout="constrained")
    one, two = figure.subplots(1, 2)
    one.plot(away[seen], 100 * change[seen], ".", color="#0072B2")
    one.axhline(-200 / 59, color="grey", lw=1, label="-2 / 59 stations")
    one.set(xlabel="from the centre (deg)", ylabel="change of the flux (%)", ylim=(-20, 10))
    one.legend(frameon=False)
    two.plot(away[seen], shift[seen], ".", color="#E69F00")
    two.set(xlabel="from the centre (deg)", ylabel="position error (arcsec)", yscale="log")
    return figure
