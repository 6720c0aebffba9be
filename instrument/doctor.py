"""Doctor: versions, optional parts, tables, memory, a self-test and a known beam, in a few seconds."""

from __future__ import annotations

import os
import platform
from collections.abc import Callable
from pathlib import Path

import numpy as np

from instrument.doctor_checks import BEAM_AGREES, coexistence, extras, known_beams
from instrument.machine import kept_in, measured_and_kept
from instrument.partial_folders import leftovers
from instrument.pipeline.record import package_version

NEEDED = (
    "numpy",
    "scipy",
    "astropy",
    "astropy-iers-data",
    "pyerfa",
    "pydantic",
    "numba",
    "ducc0",
    "h5py",
    "threadpoolctl",
    "matplotlib",
    "jinja2",
    "rich",
)


def doctor(show: Callable[[str], None]) -> bool:
    """Print what works; true when the self-test passes and no plugin is broken."""
    show(f"python        {platform.python_version()} on {platform.platform()}")
    for name in NEEDED:
        show(f"{name:<20} {package_version(name)}")
    for line in extras():
        show(f"extra  {line}")
    for line in coexistence():
        show(f"together      {line}")
    show(f"cores         {os.cpu_count()}")
    show(f"memory        {_memory_gb():.1f} GB")
    show(f"speed         {measured_and_kept():.2f} of the machine on which costs were measured (kept in {kept_in()})")
    show(f"Earth table   measured and predicted to {_table_end()}")
    fine = True
    from instrument.registry import KINDS, available

    for kind in KINDS:
        for plugin in available(kind).values():
            if plugin.broken:
                fine = False
                show(f"BROKEN        {plugin.broken}")
            if plugin.lacks:
                show(f"optional      {plugin.name} lacks {plugin.lacks}")
    for left in (left for folder in (".", "runs") for left in leftovers(Path(folder))):
        show(f"left over     {left}: of a run that was killed; the next run there removes it")
    error = self_test()
    good = error < 1e-10
    verdict = "right" if good else "WRONG"
    show(f"self-test     matrix against direct, 7 stations, 9 sources: {error:.1e} ({verdict})")
    return fine and good and _beams(show)


def _beams(show: Callable[[str], None]) -> bool:
    """Whether beams are those of EveryBeam; said for each telescope that is there."""
    found = known_beams()
    for name, apart in found.items():
        verdict = "right" if apart < BEAM_AGREES else "WRONG"
        show(
            f"beam          {name} against EveryBeam's matrices, from coordinates: {apart:.1e} of the peak ({verdict})"
        )
    if not found:
        show("beam          not checked: no telescope whose beam is known is installed")
    return all(apart < BEAM_AGREES for apart in found.values())


def self_test() -> float:
    """Largest difference of the fast engine and the definition on problems of the contract, relative to the flux."""
    from instrument.conformance.bench import problems
    from instrument.predict.direct import Direct
    from instrument.predict.matrix import Matrix

    fast, slow, worst = Matrix(), Direct(), 0.0
    for problem in problems().values():
        if fast.refuses(problem) is None:
            flux = np.abs(problem.sky.brightness(problem.at)).sum(axis=2).max()
            worst = float(np.maximum(worst, np.abs(fast.sums(problem) - slow.sums(problem)).max() / flux))
    return worst


def _memory_gb() -> float:
    from instrument.memory import machine_memory

    return machine_memory() / 1e9


def _table_end() -> str:
    from astropy.time import Time
    from astropy.utils import iers

    with iers.conf.set_temp("auto_download", False), iers.conf.set_temp("auto_max_age", None):
        table = iers.earth_orientation_table.get()
        return str(Time(table["MJD"][-1].to_value("d"), format="mjd").isot[:10])
