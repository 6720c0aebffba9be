"""Direction-independent errors and self-calibration: the seven parameters and what is left, and the gauge in them."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from instrument import mat2
from instrument.calibrate.base import Solution
from instrument.calibrate.di_errors import NAMES, compare
from instrument.jones.chain import Chain
from instrument.paper.bench import Bench
from instrument.paper.finding import Finding
from instrument.pipeline.record import Result
from instrument.report.spectra import spectra_2d
from instrument.report.style import styled
from instrument.units import Complex

SIZES = (1e-3, 1e-2, 1e-1)
HIGHEST = 0.002  # % of the rms put in
INNER = 5.0  # deg
PAPER = 2874  # integrations
PARTS = 8  # of the intervals, for how well so many gauges are known


def run(bench: Bench) -> list[Finding]:
    """Errors of rms 1e-3, 1e-2, 1e-1 in gains and feeds, solved on the 25 sources of the scene `di-errors`."""
    first, *larger = (_solved(bench, rms) for rms in SIZES)
    calibrated: list[Any] = [one.stages["calibrate"] for one in (first, *larger)]
    raw = [one.errors.quadratic["difference, raw"] for one in calibrated]
    aligned = max(calibrated[0].errors.quadratic["difference, aligned"].values())
    times = len(calibrated[0].solution.jones)
    phase, carried = (_seven(first, turned) for turned in (_phased, _carried))
    parts = [_seven(first, part=np.arange(k, times, PARTS)) for k in range(PARTS)]

    def reason(name: str) -> str:
        if raw[0][name] <= HIGHEST:
            return ""
        scatter = float(np.std([part[name] for part in parts], ddof=1) / np.sqrt(PARTS))
        return (
            f"it is the unitary matrix that an unpolarized model leaves free, one for each of {times} intervals "
            f"(known to {scatter:.1g} %): {aligned:.0e} % with it removed, {phase[name]:.2g} % with its common phase "
            f"removed, {carried[name]:.2g} % where it is carried from one interval to the next; the paper's is unknown"
        )

    share = [one.figures()["image_rms_share"] for one in calibrated]
    left, inside = 100 * share[0]["corrupted - corrected"], _inner(calibrated[0].cubes)
    both = inside * np.sqrt(times / PAPER)
    because = f"it takes two changes: in the inner {INNER:g} deg of the same images it is {inside:.4f} %; "
    because += f"{_fewer(bench, times)}, and so "
    because += f"{both:.4f} % in the inner part with the {PAPER} of the paper"
    largest = [max(seven.values()) for seven in raw]
    of_image = [one["corrupted - corrected"] for one in share]
    curves = {"corrected": calibrated[0].spectra()["corrected, I"]}
    for rms, one in zip(SIZES, calibrated, strict=True):
        curves[f"corrupted - corrected, {rms:g}"] = one.spectra()["corrupted - corrected, I"]
    bench.draw("parameters", _bars(calibrated), "The seven parameters of what was put in less what was solved.", True)
    bench.draw("spectra", spectra_2d(curves), "Spectra of I: corrected, and what calibration corrects by rms put in.")
    return [
        *[
            Finding(
                f"{n.upper()} as in the paper, rms 1e-3", raw[0][n], "%", "< 0.002", (0.0, HIGHEST), reason(n),
                changed=phase[n],
            )
            for n in NAMES
        ],
        # one power of ten for one of the rms; the second order of gains of 10 % makes 0.01 of it
        Finding("power of the rms that they grow with, 1e-2 to 1e-1", _power(largest), "", "1 (linear)", (0.95, 1.05)),
        Finding("the largest, rms 1e-2", largest[1], "%"),
        Finding("the largest, rms 1e-1", largest[2], "%"),
        Finding("the largest, rms 1e-3, by definition (linear)", _most(calibrated[0], "difference, raw"), "%"),
        Finding("the same, the unitary matrix removed", _most(calibrated[0], "difference, aligned"), "%"),
        Finding(
            "image, corrupted less corrected, rms 1e-3", left, "%", "< 0.005", (0.0, 0.005),
            because if left > 0.005 else "",  # by two changes, of which one is reckoned: no reason by the rule
        ),
        Finding("power of the rms that the image grows with", _power(of_image), "", "1 (linear)", (0.95, 1.05)),
        Finding("image, corrected less model, rms 1e-3", 100 * share[0]["corrected - model"], "%"),
    ]  # fmt: skip


def _solved(bench: Bench, rms: float) -> Result:
    interval = bench.choose(*((480, 30) if rms == SIZES[0] else (1200, 120)))
    errors = (f"instrument.gain.rms={rms}", f"instrument.feed.rms={rms}")
    return bench.run("di-errors", f"observation.interval={interval} s", "observation.duration=8 h", *errors)


def _fewer(bench: Bench, times: int) -> str:
    """What a quarter of the integrations leaves in the image, in words."""
    interval = 4 * 28800 / times
    settings = ("instrument.gain.rms=1e-3", "instrument.feed.rms=1e-3", f"observation.interval={interval:g} s")
    found: Any = bench.run("di-errors", "observation.duration=8 h", *settings).stages["calibrate"]
    left = 100 * found.figures()["image_rms_share"]["corrupted - corrected"]
    return f"it falls with the root of the integrations: {left:.4f} % with {times // 4} of the {times}"


def _seven(result: Result, turned: Callable[..., Complex] | None = None, part: Any = slice(None)) -> dict[str, float]:
    """The seven parameters by the paper's recipe, in %, with the gauge turned, of some of the intervals."""
    solution: Solution = result.stages["calibrate"].solution  # type: ignore[attr-defined]
    problem = result.plan.problem
    truth = solution.truth(Chain(*result.instrument.receivers()), problem.at.at_centre())[part]
    values = solution.jones[part] if turned is None else turned(solution, truth)
    term = solution.term.with_fields(values=values, slots_s=solution.term.slots_s[part])
    chosen = replace(solution, term=term)
    return compare(truth, chosen, problem.antenna1, problem.antenna2, SIZES[0]).quadratic["difference, raw"]


def _phased(solution: Solution, truth: Complex) -> Complex:
    """Solutions with the best common phase of every interval removed."""
    turn = np.einsum("tfaij,tfaij->tf", solution.jones.conj(), truth)
    return np.asarray(solution.jones * (turn / np.abs(turn))[..., None, None, None])


def _carried(solution: Solution, truth: Complex) -> Complex:
    """Each turned as near as can be to the one before: a solver that starts there stays there."""
    out = solution.jones.copy()
    for k in range(1, len(out)):
        out[k] = mat2.mul(out[k], solution.gauge.nearest(out[k], out[k - 1])[..., None, :, :])
    return out


def _inner(cubes: Any) -> float:
    """Corrupted less corrected over the image, rms in %, within the inner degrees."""
    whole = cubes["corrected"]
    half = int(np.deg2rad(INNER / 2) / whole.pixel_rad)
    middle = slice(whole.data.shape[-1] // 2 - half, whole.data.shape[-1] // 2 + half)
    planes = [cubes[name].data[0, 0, middle, middle] for name in ("corrupted - corrected", "corrected")]
    return float(100 * planes[0].std() / planes[1].std())


def _power(values: list[float]) -> float:
    return float(np.log10(values[2] / values[1]))


def _most(calibrated: Any, which: str) -> float:
    return float(max(calibrated.errors.linear[which].values()))


@styled
def _bars(calibrated: list[Any]) -> Figure:
    figure = Figure(figsize=(11, 4.5), layout="constrained")
    for ax, kind in zip(figure.subplots(1, 2), ("linear", "quadratic"), strict=True):
        for rms, one, colour in zip(SIZES, calibrated, ("#0072B2", "#E69F00", "#009E73"), strict=True):
            for which, marker in (("raw", "o"), ("aligned", "^")):
                values = getattr(one.errors, kind)[f"difference, {which}"]
                ax.plot(range(7), list(values.values()), marker, color=colour, label=f"{rms:g}, {which}")
        if kind == "quadratic":
            ax.axhline(HIGHEST, color="grey", lw=1, label="the paper, 1e-3: below")
        ax.set(yscale="log", title=kind, ylabel="% of the rms put in")
        ax.set_xticks(range(7), [name.upper() for name in NAMES])
        ax.legend(frameon=False, fontsize=9, loc="upper left", bbox_to_anchor=(0, -0.1), ncols=3)
    return figure
