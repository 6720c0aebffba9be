"""Beyond the paper: a 21-cm signal through gains, an incomplete model, leakage and removal, to the window."""

from __future__ import annotations

from typing import Any

import numpy as np
from matplotlib.axes import Axes

from instrument.analyze.power.cylinders import Cylindrical
from instrument.analyze.power.recovered import Recovered, recovered_power
from instrument.analyze.power.transform import Transform
from instrument.calibrate.selfcal import SelfCal
from instrument.image.cube import StokesCube
from instrument.image.dirty import Imager
from instrument.image.present import in_kelvin
from instrument.jones.gain import GainTerm
from instrument.paper.bench import Bench
from instrument.paper.finding import Finding
from instrument.pipeline.scene_file import parse
from instrument.registry import load
from instrument.report.spectra import LOOKS
from instrument.report.style import GREY, axes_of, styled
from instrument.scene import Scene
from instrument.sky.base import Sky
from instrument.units import Float
from instrument.visibilities import Visibilities

COMMON = ("analyze.cube={products=['spectrum-2d']}", "tolerance=1e-3", "sky.pixel=3 arcmin", "image.uv_range=[30, 500]")
QUICK = (
    *COMMON,
    "observation.interval=1 h",
    "observation.frequency.channels=32",
    "observation.frequency.channel_width=0.5 MHz",
    "sky.pixels=64",
)
FULL = (*COMMON, "observation.interval=30 min", "observation.frequency.channels=161", "sky.pixels=80")
RMS = 0.02  # of the gains
NIGHT = "8 h"  # over which these gains are constant
CABLE_S = 0.4e-6  # delay of a reflection: 120 m of cable, there and back
HIGH = 0.1  # 1/Mpc: the window above what is smooth
TOLERANCE = 1e-3
REMOVERS: dict[str, dict[str, Any]] = {"polynomial": {}, "stokes-templates": {"order": 4}, "gpr": {}}


def run(bench: Bench) -> list[Finding]:
    """Power of the signal recovered over that injected above k_par of 0.1 /Mpc, by ways to calibrate and to remove."""

    core = [name for name in load("telescopes", "lofar-hba").layout().names if name.endswith("HBA0")]
    stations = f"instrument.stations={core[: bench.choose(16, None)]}"
    tables = bench.tables("galactic", stations, *bench.choose(QUICK, FULL))
    scene = parse(tables).scene()
    stars = [_catalogue(n) for n in (bench.choose(50, 400), 5)]
    model, few = (_seen(scene, sky) for sky in stars)
    galaxy, signal = _seen(scene, scene.sky), _seen(scene, _signal(scene, tables["sky"], bench.seed or 21))
    truth = model + galaxy + signal
    gains = _gains(truth, bench.seed or 1)
    data = truth.corrupted(gains)
    imager = Imager(pixels=tables["sky"]["pixels"], pixel=tables["sky"]["pixel"], uv_range=(30, 500))

    def image(vis: Visibilities) -> StokesCube:
        return in_kelvin(imager.image(vis.without_beam(scene.instrument)))

    injected = image(signal)
    solver = SelfCal(pattern="diagonal", tolerance=1e-9, errors=False)
    solutions = {
        "all sources in the model": solver.solve(data, model),
        "5 sources in the model": solver.solve(data, few),
        "5, one solution for 8 MHz": _wide(solver, data).solve(data, few),
        "5, one solution for the night": solver.with_fields(interval=NIGHT).solve(data, few),
    }
    ways = {"gains known": truth, **{name: data.corrected(one.term) for name, one in solutions.items()}}
    lost = [100 * float(1 - one.converged.mean()) for one in solutions.values()]
    ends: dict[str, Recovered] = {}
    how = Transform("I", "blackman-harris", "hann", (30.0, 500.0))
    found = []
    for name, vis in ways.items():
        cube = image(vis - model)
        for remover in ("", *(REMOVERS if name in ("gains known", "5 sources in the model") else ())):
            left = load("foregrounds", remover, **REMOVERS[remover]).split(cube).residual if remover else cube
            key = f"{name}; {remover}" if remover else name
            ends[key] = recovered_power(left, injected, how=how, bins=6, shape="cylindrical")
            above = float(_ratio(ends[key], _k_par(ends[key]) > HIGH))
            found.append(Finding(f"power recovered over injected, k_par above 0.1 /Mpc: {key}", above))
    found += [Finding(f"solves that failed: {name}", share, "%") for name, share in zip(solutions, lost, strict=True)]
    bench.draw("recovered", _drawn(ends), "Power of I at the end over that of the signal alone.", wide=True)
    return found


def _catalogue(brightest: int) -> Sky:
    made: Sky = load("skies", "catalogue", path="mock_150mhz.csv", brightest=brightest)
    return made


def _signal(scene: Scene, sky: dict[str, Any], seed: int) -> Sky:
    from astropy import units as u

    freq = scene.observation.freq_hz
    made: Sky = load(
        "skies", "signal-21cm", pixels=sky["pixels"], pixel=sky["pixel"], seed=seed, channels=len(freq),
        band=(freq[0] * u.Hz, freq[-1] * u.Hz), redshift=9.5,
    )  # fmt: skip
    return made


def _seen(scene: Scene, sky: Sky) -> Visibilities:
    """Visibilities of a sky through the instrument without errors."""
    return Scene(instrument=scene.instrument, sky=sky, observation=scene.observation).plan(TOLERANCE).run()


def _gains(vis: Visibilities, seed: int) -> GainTerm:
    """Gains with structure in frequency, constant in time: a slope, and a reflection in the cable of each receptor."""
    rng = np.random.default_rng(seed)
    shape = (1, 1, len(vis.layout), 2)
    x = ((vis.freq_hz - vis.freq_hz.mean()) / max(np.ptp(vis.freq_hz), 1.0))[:, None, None]
    slope, turn, ripple = (RMS / np.sqrt(3) * rng.standard_normal((2, *shape[2:])) for _ in range(3))
    delay = CABLE_S * (1 + 0.2 * rng.standard_normal(shape[2:]))
    wave = np.exp(2j * np.pi * vis.freq_hz[:, None, None] * delay)
    values = 1 + x * (slope[0] + 1j * slope[1]) + turn[0] + 1j * turn[1] + (ripple[0] + 1j * ripple[1]) * wave
    return GainTerm(values=values[None], freq_hz=vis.freq_hz)


def _wide(solver: SelfCal, data: Visibilities) -> SelfCal:
    """The solver with one solution for 8 MHz, so that what a model lacks puts less structure into the gains."""
    width = float(np.median(np.diff(data.freq_hz)))
    return solver.with_fields(channels=max(1, min(len(data.freq_hz), round(8e6 / width))))


def _ratio(end: Recovered, rows: Any) -> Any:
    """Power recovered over injected of all k_perp together, in some rows of k_par."""
    ours, due = (np.nansum((one.power * one.count)[:, rows], axis=0) for one in (end.recovered, end.injected))
    return ours / due if np.ndim(rows) == 0 else ours.sum() / due.sum()


def _k_par(end: Recovered) -> Float:
    assert isinstance(end.injected, Cylindrical)
    return end.injected.k_par


@styled
def _drawn(ends: dict[str, Recovered]) -> Axes:
    ax = axes_of(None, (9.5, 5.0))
    ways = list(dict.fromkeys(name.partition("; ")[0] for name in ends))
    for name, end in ends.items():
        way, _, remover = name.partition("; ")
        colour, marker = LOOKS[ways.index(way) % len(LOOKS)]
        ratio = [_ratio(end, k) for k in range(len(_k_par(end)))]
        look: dict[str, Any] = {"ls": ("-", "--", ":", "-.")[["", *REMOVERS].index(remover)], "marker": marker}
        ax.plot(_k_par(end), ratio, color=colour, ms=3, lw=1.2, label=name, **look)
    ax.axhline(1, color=GREY, lw=0.8)
    ax.axvline(HIGH, color=GREY, lw=0.8, ls=":")
    ax.set(yscale="log", xlabel=r"$k_\parallel$ (1/Mpc)", ylabel="power over that injected")
    ax.legend(frameon=False, loc="center left", bbox_to_anchor=(1, 0.5))
    return ax
