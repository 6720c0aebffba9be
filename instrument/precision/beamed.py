"""The contest of engines through the beams of LOFAR, beside DP3, which writes what it predicts into a data set."""

from __future__ import annotations

import os
import subprocess
import sys
import tempfile
from collections.abc import Mapping
from dataclasses import replace
from functools import cache
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np

import instrument.registry as registry
from instrument.observe.observation import Observation
from instrument.precision import peers
from instrument.precision.contest import UNSET, Contest, Entry, Form, Trial
from instrument.precision.engines import SHORT
from instrument.precision.truth import visibilities
from instrument.scene import Scene
from instrument.units import Complex

SOURCES, TIMES, STATIONS = ((30,), (30, 300)), 64, 12  # the truth is that of the stations' baselines at FEW times
FEW = (0, 21, 42, 63)
DP3 = ("dp3", "everybeam", "python-casacore")
RUN = "from dp3 import entrypoint; import sys; sys.exit(entrypoint())"


def contests(engines: Mapping[str, Any], form: Form) -> list[Contest]:
    """Where DP3 is there, one for each number of sources."""
    return [contest(count, engines, form) for count in SOURCES[0 if form.quick else 1]] if found() else []


def found() -> bool:
    """Whether DP3 and what it is given a data set with are installed."""
    return all(find_spec(name) is not None for name in ("dp3", "everybeam", "casacore"))


def scene_of(count: int) -> Scene:
    """So many polarized sources within 5 deg of 3C196, the 59 stations, integrations of 10 s about its transit."""
    from astropy import units as u

    night = Observation(
        phase_centre="08h13m36.0s +48d13m03s", transit="2012-12-07", duration=TIMES * 10 * u.s, interval=10 * u.s,
        frequencies=[150] * u.MHz, channel_width=0.2 * u.MHz,
    )  # fmt: skip
    sky = registry.load(
        "skies",
        "random",
        count=count,
        radius=5 * u.deg,
        polarization=0.1,
        flux_min=0.1 * u.Jy,
        spectral_index=0.0,
        seed=3,
    )
    # the signs of time that EveryBeam has, so that it is one job
    lofar = registry.load("telescopes", "lofar-hba", phase="everybeam")
    return Scene(name="beamed", instrument=lofar, sky=sky, observation=night)


class Written(tuple[Complex, ...]):
    """Visibilities (T, F, B, 2, 2) in the frames of DP3."""


def contest(count: int, engines: Mapping[str, Any], form: Form) -> Contest:
    """Engines, and DP3 as a process of one thread, through the same beams."""
    scene = scene_of(count)
    plan = scene.plan()
    full, scale = plan.full, plan.scale_jy
    chosen = np.flatnonzero((full.antenna1 < STATIONS) & (full.antenna2 < STATIONS))
    few = full.between(full.antenna1[chosen], full.antenna2[chosen])
    few = replace(few, at=few.at.some(np.array(FEW)))
    truth = visibilities(few)

    @cache
    def theirs() -> Any:
        from instrument.precision.casacore_frames import as_dp3

        return visibilities(replace(few, at=as_dp3(few.at)))

    def judge(answer: Any, asked: float) -> Trial:
        due, data = (theirs(), answer[0]) if isinstance(answer, Written) else (truth, answer)
        apart = (data[list(FEW)][:, :, chosen] - due) / scale
        return Trial(float(np.abs(apart).max()), float(np.sqrt(np.mean(np.abs(apart) ** 2))))

    def answer(engine: str) -> Any:
        return lambda tolerance: np.asarray(scene.plan(tolerance=tolerance, engine=engine, workers=1).run().data)

    entries = [Entry(engine, answer(engine)) for engine in engines]
    if form.peers:
        entries.append(Entry("DP3 (a process)", _dp3(scene), (UNSET,), peer=True))
    return Contest(
        name=f"predict through beams of LOFAR, {count} sources, {TIMES} integrations",
        family="predict through beams of LOFAR",
        size=count,
        size_word="sources",
        peers=DP3,
        kind="engines",
        knob="tolerance",
        values=SHORT[::2],
        entries=tuple(entries),
        judge=judge,
        error=f"largest error of a visibility of {len(chosen)} of {len(full.antenna1)} baselines, over the total flux",
        error_user="rms error of a visibility, over the total flux",
        truth="the direct sum in extended precision; for DP3 towards its own directions, which are 0.1 arcsec off",
        honoured=True,
    )


def _dp3(scene: Scene) -> Any:
    """DP3's prediction of a scene: its start and the writing are in its time, the making of the set is not."""
    from instrument.precision.lofar_ms import make_ms
    from instrument.sky.bbs import write_bbs

    peers._everybeam()  # data of casacore and EveryBeam, by their variables
    folder = tempfile.TemporaryDirectory()
    where = Path(folder.name)
    night: Any = scene.observation
    make_ms(where / "night.MS", scene.instrument, night)
    sky: Any = scene.sky.about(night.phase_centre)
    write_bbs(where / "sky.txt", sky)
    settings = {
        "msin": where / "night.MS", "msout": ".", "msout.datacolumn": "PREDICTED", "steps": "[predict]",
        "predict.sourcedb": where / "sky.txt", "predict.usebeammodel": "true", "predict.elementmodel": "hamaker",
        "numthreads": 1,
    }  # fmt: skip
    # a process of its own: DP3 waits for ever for tables that are open in this one
    command = [sys.executable, "-c", RUN, *(f"{k}={v}" for k, v in settings.items())]

    def answer(asked: float) -> Written:
        from casacore import tables

        environment = os.environ | {"OPENBLAS_NUM_THREADS": "1"}  # it refuses to start with more
        done = subprocess.run(command, env=environment, cwd=where, capture_output=True, text=True, timeout=900)
        if done.returncode:
            raise RuntimeError((done.stdout + done.stderr)[-500:])
        with tables.table(str(where / "night.MS"), ack=False) as ms:
            data = ms.getcol("PREDICTED")
        return Written((data.reshape(night.count, -1, len(night.freq_hz), 2, 2).swapaxes(1, 2),))

    answer.folder = folder  # type: ignore[attr-defined]  # which is removed when nobody asks any more
    return answer
