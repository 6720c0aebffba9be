"""The verb `analyze`: FITS cubes in, a folder with tables, figures and a page out."""

from __future__ import annotations

import json
import platform
from collections.abc import Callable, Sequence
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np

from instrument.cube_analysis import CubeAnalysis
from instrument.cube_results import CubeResults
from instrument.doctor import package_version
from instrument.errors import InputError
from instrument.files.fits import read_cube
from instrument.image.cube import Psf, StokesCube
from instrument.report.progress import progress_bar
from instrument.run_folder import RunFolder
from instrument.run_record import PACKAGES, json_ready


def analyze_files(
    paths: Sequence[str],
    settings: CubeAnalysis,
    out: str | None = None,
    stokes: str | None = None,
    unit: Any = None,
    beam: str | None = None,
    noise: str | None = None,
    command: str = "",
    show: Callable[[str], None] = lambda text: None,
) -> CubeResults:
    """Read cubes, analyze them and write a folder, whole or not at all; the results.

    `beam` ("3 arcmin", or "4 arcmin, 3 arcmin, 30 deg") is that of all channels where the files name none; `noise` is
    a file of noise alone. Raises `InputError` before anything is computed when files or settings will not do.
    """
    folder = RunFolder(Path(paths[0]).name.split(".fits")[0], out)
    cube = _read(paths, stokes, unit, beam)
    quiet = None if noise is None else _noise(noise, cube, stokes, unit)
    settings.refusals(cube)
    with folder, progress_bar(f"analyze {paths[0]}") as update:
        result = settings.run(cube, quiet, update)
        with result.timed("write"):
            _write(result, paths, command, folder.partial)
        path = folder.finish()
    spent = ", ".join(f"{name} {seconds:.1f}" for name, seconds in sorted(result.seconds.items(), key=lambda s: -s[1]))
    lines = [*result.lines_of_text(), "", f"time          {sum(result.seconds.values()):.1f} s ({spent})"]
    show("\n".join([*lines, f"written       {path}/report.html, run.json, tables and figures"]))
    return result


def _read(paths: Sequence[str], stokes: str | None, unit: Any, beam: str | None) -> StokesCube:
    cube = read_cube(*paths, stokes=stokes, unit=unit)
    if beam is None:
        return cube
    if cube.psf is not None:
        raise InputError(f"--beam {beam}: the files name their beams; leave it out")
    parts = [part.strip() for part in beam.split(",")]
    if not 1 <= len(parts) <= 3:
        raise InputError(f"--beam {beam}: write it like '3 arcmin', or '4 arcmin, 3 arcmin, 30 deg'")
    from astropy import units as u

    psf = Psf.gaussian(*parts).of(len(cube.freq_hz))
    if not 0 < min(psf.major_rad[0], psf.minor_rad[0]) <= max(psf.major_rad[0], psf.minor_rad[0]) < np.pi:
        raise InputError(f"--beam {beam}: widths must be above 0 and finite, such as '3 arcmin'")
    return StokesCube(cube.data, cube.freq_hz * u.Hz, cube.pixel_rad * u.rad, cube.unit, cube.centre, psf)


def _noise(path: str, cube: StokesCube, stokes: str | None, unit: Any) -> StokesCube:
    """A cube of noise; what its file does not say is as for the cubes."""
    try:
        found = _read([path], None, None, None)
    except InputError:
        found = _read([path], stokes, unit, None)
    from astropy import units as u

    psf = cube.psf if found.psf is None and len(found.freq_hz) == len(cube.freq_hz) else found.psf
    return StokesCube(found.data, found.freq_hz * u.Hz, found.pixel_rad * u.rad, found.unit, found.centre, psf)


def _write(result: CubeResults, paths: Sequence[str], command: str, folder: Path) -> None:
    from instrument.report.cube_page import cube_sections
    from instrument.report.page import write_page
    from instrument.report.run_page import page_of_run

    result.write(folder)
    record = {
        "name": Path(paths[0]).name,
        "title": "Analysis of a cube",
        "kind": "file",
        "finished": datetime.now(UTC).isoformat(timespec="seconds"),
        "files": [str(Path(p).name) for p in paths],
        "command": command,
        "versions": {"python": platform.python_version(), **{p: package_version(p) for p in PACKAGES}},
        "machine": {"system": platform.platform()},
        "seconds": {k: round(v, 3) for k, v in result.seconds.items()},
        **result.record(),
    }
    write_page(page_of_run(record, more=cube_sections(result, folder)), folder / "report.html")
    (folder / "run.json").write_text(json.dumps(json_ready(record), indent=2, allow_nan=False), encoding="utf-8")
