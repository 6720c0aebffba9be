"""The contests of engines without beams, where other programs do the same job: LOFAR's core, and a lattice."""

from __future__ import annotations

from collections.abc import Mapping
from importlib.util import find_spec
from typing import Any

import numpy as np

import instrument.registry as registry
from instrument.model import Composed
from instrument.observe.layout import Layout
from instrument.observe.observation import Observation
from instrument.precision import peers
from instrument.precision.contest import Contest, Entry, Form, Trial
from instrument.precision.engines import FULL, SHORT
from instrument.precision.truth import visibilities
from instrument.scene import Scene

SOURCES, TIMES = ((300,), (300, 3000, 30000)), 4
BASELINES = 60  # of which the truth is worked out
SUPERTERP = tuple(f"CS00{k}" for k in range(2, 8))
SIDE, PITCH = 10, 14.6  # stations along a side of the lattice, m between them: the distance of HERA's dishes


def contests(engines: Mapping[str, Any], form: Form) -> list[Contest]:
    """One for each array: unpolarized sources within 20 deg, four integrations, one channel, one thread each."""
    counts = SOURCES[0] if form.quick else SOURCES[1]
    return [contest(name, layout, count, engines, form) for name, layout in arrays().items() for count in counts]


def arrays() -> dict[str, Layout]:
    """LOFAR's 48 core fields, the 12 of its superterp, 300 m across, and a square lattice at their place."""
    lofar = registry.load("telescopes", "lofar-hba", beam=None).layout()
    core = lofar.select([name for name in lofar.names if name.startswith("CS")])
    superterp = core.select([name for name in core.names if name[:5] in SUPERTERP])
    return {"LOFAR's core": core, "LOFAR's superterp": superterp, f"a lattice of {SIDE} x {SIDE}": lattice(core)}


def lattice(near: Layout) -> Layout:
    """Stations on a square lattice about the centre of another array."""
    from astropy import units as u
    from astropy.coordinates import EarthLocation

    place = EarthLocation.from_geocentric(*near.centre_m, unit="m").to_geodetic()
    steps = PITCH * (np.arange(SIDE) - (SIDE - 1) / 2)
    enu = np.stack([x.ravel() for x in np.meshgrid(steps, steps, 0.0)], -1)
    return Layout.from_enu([f"h{k}" for k in range(SIDE**2)], enu * u.m, place.lon, place.lat, place.height)


def contest(name: str, layout: Layout, count: int, engines: Mapping[str, Any], form: Form) -> Contest:
    """Engines, and with `form.peers` matvis and fftvis, on one array and so many sources."""
    from astropy import units as u

    night = Observation(
        phase_centre="08h13m36.0s +48d13m03s", transit="2012-12-07", duration=TIMES * 10 * u.s, interval=10 * u.s,
        frequencies=[150] * u.MHz, channel_width=0.2 * u.MHz,
    )  # fmt: skip
    sky = registry.load("skies", "random", count=count, radius=20 * u.deg, flux_min=0.1 * u.Jy, seed=3)
    scene = Scene(name=name, instrument=Composed(stations=layout), sky=sky, observation=night)
    plan = scene.plan()
    full, scale = plan.full, plan.scale_jy
    chosen = np.random.default_rng(4).choice(len(full.antenna1), min(BASELINES, len(full.antenna1)), replace=False)
    few = full.between(full.antenna1[chosen], full.antenna2[chosen])
    truth = visibilities(few)
    drifting: Any = peers.drifting_truth(few) if form.peers and find_spec("matvis") is not None else None

    def judge(found: Any, asked: float) -> Trial:
        if isinstance(found, peers.Drifting):
            apart = (found.data[..., chosen] - drifting) / scale
        else:
            apart = (found[:, :, chosen][..., 0, 0] - truth[..., 0, 0]) / scale
        return Trial(float(np.abs(apart).max()), float(np.sqrt(np.mean(np.abs(apart) ** 2))))

    def answer(engine: str) -> Any:
        return lambda tolerance: np.asarray(scene.plan(tolerance=tolerance, engine=engine, workers=1).run().data)

    entries = [Entry(engine, answer(engine)) for engine in engines]
    if form.peers:
        entries += peers.drifting(full)
    return Contest(
        name=f"predict {name}, {count} sources, without beams",
        family=f"predict {name} without beams",
        size=count,
        size_word="sources",
        peers=peers.DRIFTING,
        kind="engines",
        knob="tolerance",
        values=SHORT[::2] if form.quick else FULL[::2],
        entries=tuple(entries),
        judge=judge,
        error=f"largest error of a visibility of {len(chosen)} of {len(full.antenna1)} baselines, over the total flux",
        error_user="rms error of a visibility, over the total flux",
        truth="the direct sum in extended precision; for programs without phase centre towards their directions",
    )
