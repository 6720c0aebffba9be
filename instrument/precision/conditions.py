"""On what contests were run: processor, clock, cores, threads, memory; which programs of others are there."""

from __future__ import annotations

import os
import platform
from collections.abc import Sequence
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

from instrument.precision.contest import Contest
from instrument.threads import THREADS


def machine() -> dict[str, str]:
    """Processor, clock, cores, threads, memory and load, in words."""
    import numba

    about = Path("/proc/cpuinfo")
    told = about.read_text(encoding="utf-8", errors="replace") if about.is_file() else ""
    parts = (line.partition(":") for line in told.splitlines())
    facts = {name.strip(): text.strip() for name, _, text in parts}
    use = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count()
    threads = ", ".join(f"{name}={os.environ[name]}" for name in THREADS if name in os.environ)
    out = {
        "processor": f"{platform.machine()}, {facts.get('model name', 'not known')}",
        "clock": f"{float(facts['cpu MHz']):.0f} MHz" if "cpu MHz" in facts else "not known",
        "cores": f"{use} of {os.cpu_count()} used, {numba.get_num_threads()} threads of compiled loops",
        "threads": threads or "as the libraries choose",
    }
    if hasattr(os, "getloadavg"):
        out["load before"] = f"{os.getloadavg()[0]:.1f}"
    if hasattr(os, "sysconf") and "SC_PHYS_PAGES" in os.sysconf_names:
        out["memory"] = f"{os.sysconf('SC_PHYS_PAGES') * os.sysconf('SC_PAGE_SIZE') / 1e9:.0f} GB"
    return out


def peers(contests: Sequence[Contest]) -> tuple[dict[str, str], list[str]]:
    """Of the programs of others that may stand in contests: versions of those installed, and those that are not."""
    there, missing = {}, []
    for name in dict.fromkeys(name for contest in contests for name in contest.peers):
        try:
            there[name] = version(name)
        except PackageNotFoundError:
            missing.append(name)
    return there, missing


def told(contests: Sequence[Contest]) -> str:
    """One line about the programs of others."""
    there, missing = peers(contests)
    parts = [f"peers: {', '.join(f'{name} {number}' for name, number in there.items()) or 'none installed'}"]
    return "; ".join(parts + ([f"not installed: {', '.join(missing)}"] if missing else []))
