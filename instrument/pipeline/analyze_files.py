"""The verb `analyze`: FITS cubes in, a folder with tables, figures and a page out."""

from __future__ import annotations

import platform
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np

from instrument.errors import InputError, unused, unused_ledger
from instrument.files.fits import read_cube
from instrument.files.fits_psf import read_psf
from instrument.files.number_list import read_frequencies, read_numbers
from instrument.image.channels import channel_numbers, in_band
from instrument.image.cube import StokesCube
from instrument.image.psf import Psf
from instrument.memory import quick_give_back
from instrument.pipeline.folder import RunFolder
from instrument.pipeline.progress import progress_bar
from instrument.pipeline.record import costs, json_text, spent, versions
from instrument.pipeline.stages.cube import CubeAnalysis
from instrument.pipeline.stages.cube_page import CubeResults
from instrument.provenance import provenance
from instrument.units import Float

OPTIONS = {  # what refusals ask for, as they do in Python and as it is written here
    "frequencies=": "--frequencies FILE", "stokes=": "--stokes", "unit=": "--unit", "psf=": "--psf FILE or --beam",
    "beam=": "--beam", "infill=": "--infill '300 ns'", "redshift=": "--redshift", "uv_range": "--uv-range",
    "weights": "--weights FILE", "depths =": "--depths", "remove =": "--remove", "products =": "--products",
    "channels=": "--flag-channels", "band =": "--band", "taper_space =": "--taper-space", "signal ": "--signal",
}  # fmt: skip


@dataclass(frozen=True)
class Reading:
    """How files become a cube: what their headers do not say, which channels, which beam; words as of the command.

    `frequencies` and `weights` are files of numbers, one a channel of the files, `psf` and `noise` are FITS files.
    """

    stokes: str | None = None
    unit: Any = None
    beam: str | None = None
    frequencies: str | None = None
    psf: str | None = None
    flag_channels: str | None = None
    band: str | None = None
    common_beam: str | None = None
    weights: str | None = None
    noise: str | None = None

    def cube(self, paths: Sequence[str]) -> tuple[StokesCube, Float | None]:
        """The cube of the channels that are left, and their weights (F,)."""
        freq = None if self.frequencies is None else read_frequencies(self.frequencies)
        said: dict[str, Any] = {"stokes": self.stokes, "unit": self.unit, "frequencies": freq}
        try:
            cube = read_cube(*paths, **said)
        except InputError as error:  # a beam of the header that cannot be: another one is given
            if "psf=" not in str(error) or (self.beam is None and self.psf is None):
                raise
            cube = read_cube(*paths, **said, psf=Psf.gaussian("1 arcmin")).with_psf(None)
        count = len(cube.freq_hz)
        if self.psf is not None:
            if self.beam is not None:
                raise InputError(f"--beam {self.beam} and --psf {self.psf}: give one of them")
            cube = cube.with_psf(read_psf(self.psf, cube))
        elif self.beam is not None:
            cube = cube.with_psf(_beam(self.beam, cube))
        weights = None if self.weights is None else read_numbers(self.weights, "weights of the channels")
        if weights is not None and (len(weights) != count or (weights < 0).any()):
            raise InputError(
                f"--weights {self.weights} has {len(weights)} numbers from {weights.min():g} on: needed {count}, one "
                "for each channel of the files, none below 0"
            )
        if self.flag_channels is not None:
            cube = cube.flagged(channel_numbers(self.flag_channels, count, "--flag-channels"))
        if self.band is not None:
            inside = in_band(cube.freq_hz, self.band)
            outside = np.flatnonzero(~inside)
            unused("analyze", [f"channel {k}" for k in outside], f"outside of --band {self.band}")
            cube, weights = cube.channels(inside), None if weights is None else weights[inside]
        if self.common_beam is not None:
            try:
                cube = cube.at_common_beam(None if self.common_beam == "smallest" else self.common_beam)
            except InputError as error:
                raise InputError(f"--common-beam: {error}") from None
        return cube, weights

    def files(self, paths: Sequence[str]) -> list[str]:
        """The files that are read."""
        return [*paths, *(file for file in (self.noise, self.psf, self.weights) if file is not None)]

    def quiet(self, cube: StokesCube) -> StokesCube | None:
        """The cube of noise, where one is named, of the same band; what its file does not say is as for the cube."""
        if self.noise is None:
            return None
        alike = replace(self, beam=None, psf=None, weights=None, common_beam=None, flag_channels=None, noise=None)
        try:
            found, _ = replace(alike, stokes=None, unit=None, frequencies=None).cube([self.noise])
        except InputError:
            found, _ = alike.cube([self.noise])
        return found.with_psf(cube.psf) if found.psf is None and len(found.freq_hz) == len(cube.freq_hz) else found


def analyze_files(
    paths: Sequence[str],
    settings: CubeAnalysis,
    reading: Reading | None = None,
    out: str | None = None,
    command: str = "",
    show: Callable[[str], None] = lambda text: None,
    force: bool = False,
) -> CubeResults:
    """Read cubes, analyze them and write a folder, whole or not at all; the results.

    Raises `InputError` before anything is computed when files or settings will not do, with the option that helps.
    """
    reading = reading or Reading()
    folder = RunFolder(Path(paths[0]).name.split(".fits")[0], out, force, reading.files(paths))
    with unused_ledger() as ledger, _options():
        cube, weights = reading.cube(paths)
        quiet = reading.quiet(cube)
        if weights is not None:
            settings = settings.model_copy(update={"weights": tuple(float(w) for w in weights)})
        settings.refusals(cube)
        with folder, progress_bar(f"analyze {paths[0]}") as update:
            result = settings.run(cube, quiet, update)
            with result.timed("write"), provenance(object=Path(paths[0]).name):
                _write(result, paths, command, folder.partial, ledger)
            path = folder.finish()
    lines = [*result.lines(), *spent(result.seconds)]
    show("\n".join([*lines, f"written       {path}/report.html, run.json, tables and figures"]))
    return result


@contextmanager
def _options() -> Iterator[None]:
    """Names the option of the command beside what a refusal asks for in the words of Python."""
    try:
        yield
    except InputError as error:
        text = str(error)
        named = [option for word, option in OPTIONS.items() if word in text and option.split()[0] not in text]
        if not named:
            raise
        raise type(error)(f"{text} ({', '.join(named)})") from None


def _beam(text: str, cube: StokesCube) -> Psf:
    """The beam of `--beam`, of all channels; raises `InputError` where the files name theirs."""
    if cube.psf is not None:
        raise InputError(f"--beam {text}: the files name their beams; leave it out")
    parts = [part.strip() for part in text.split(",")]
    if not 1 <= len(parts) <= 3:
        raise InputError(f"--beam {text}: write it like '3 arcmin', or '4 arcmin, 3 arcmin, 30 deg'")
    try:
        psf = Psf.gaussian(*parts).of(len(cube.freq_hz))
    except InputError as error:
        raise InputError(f"--beam {text}: {error}") from None
    if not 0 < min(psf.major_rad[0], psf.minor_rad[0]) <= max(psf.major_rad[0], psf.minor_rad[0]) < np.pi:
        raise InputError(f"--beam {text}: widths must be above 0 and finite, such as '3 arcmin'")
    return psf


@quick_give_back()
def _write(result: CubeResults, paths: Sequence[str], command: str, folder: Path, ledger: dict[str, list[str]]) -> None:
    from instrument.report.page import write_page
    from instrument.report.run_page import page_of_run
    from instrument.report.style import drawer

    result.write(folder)
    record = {
        "name": Path(paths[0]).name,
        "title": "Analysis of a cube",
        "kind": "file",
        "finished": datetime.now(UTC).isoformat(timespec="seconds"),
        "files": [str(Path(p).name) for p in paths],
        "command": command,
        "versions": versions(),
        "machine": {"system": platform.platform()},
        "unused": ledger,
        **costs(result.seconds, {}),
        **result.figures(),
    }
    write_page(page_of_run(record, result.cards(), sections=result.sections(drawer(folder))), folder / "report.html")
    (folder / "run.json").write_text(json_text(record), encoding="utf-8")
