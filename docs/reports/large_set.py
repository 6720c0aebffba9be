"""A Measurement Set larger than the memory: read, corrected and imaged; what it took, into large_set.md beside this.

    python docs/reports/large_set.py [--gb 4] [--memory 1GB] [--work FOLDER]

The set is of the 59 stations of LOFAR HBA and 64 channels: noise, with as many integrations as it takes.
"""

import argparse
import json
import platform
import subprocess
import sys
import tempfile
import time
from datetime import date
from importlib.metadata import version
from pathlib import Path

import numpy as np
from astropy import units as u

import instrument
from instrument import MeasurementSet, Observation, Visibilities
from instrument.files.ms_tables import opened
from instrument.observe.sampling import Sampling

CHANNELS, TIMES = 64, 8
SCENE = """name = "large"
[instrument]
telescope = "lofar-hba"
[correct]
[image]
pixels = 256
pixel = "1 arcmin"
uv_range = [0, {most}]
"""


def made(path, most_bytes):
    """A set of so many bytes: integrations of noise, again and again 10 s later, with the UVW of the first."""
    lofar = instrument.load("telescopes", "lofar-hba", beam=None)
    night = Observation(
        phase_centre="08h13m36.0s +48d13m03s", transit="2012-12-07", duration=10 * TIMES * u.s, interval=10 * u.s,
        frequencies=(150 + 0.1 * np.arange(CHANNELS)) * u.MHz, channel_width=0.1 * u.MHz,
    )  # fmt: skip
    layout, centre = lofar.layout(), night.phase_centre
    at = Sampling.build(layout, night.times(layout), night.freq_hz, centre.ra_rad, centre.dec_rad, centre)
    one, two = layout.baselines
    noise = np.random.default_rng(1).normal(size=(TIMES, CHANNELS, len(one), 2, 2, 2)) @ [1, 1j]
    MeasurementSet.create(path, Visibilities(noise, at, one, two, 10.0, 1e5), instrument=lofar)
    with opened(path, writable=True) as table:
        rows = table.nrow()
        columns = {name: np.array(table.getcol(name)) for name in table.columns() if name != "FLAG_CATEGORY"}
        each = sum(values.nbytes for values in columns.values())
        for k in range(1, int(np.ceil(most_bytes / each))):
            table.addrows(rows)
            where = (slice(k * rows, (k + 1) * rows),)
            for name in ("TIME", "TIME_CENTROID"):
                columns[name] = columns[name] + 10.0 * TIMES
            for name, values in columns.items():
                table.putcol(name, values, where)
        return table.nrow(), each * table.nrow() // rows


def imaged(folder, memory, most=1000):
    """Image baselines of up to `most` wavelengths in a process of its own; seconds and what its run says."""
    (folder / "large.toml").write_text(SCENE.format(most=most))
    command = [
        sys.executable,
        "-m",
        "instrument.cli",
        "image",
        str(folder / "large.toml"),
        "--data",
        str(folder / "l.MS"),
    ]
    begin = time.perf_counter()
    subprocess.run([*command, "--memory", memory, "--out", str(folder / "out")], check=True, stdout=subprocess.DEVNULL)
    return time.perf_counter() - begin, json.loads((folder / "out" / "run.json").read_text())


def main():
    """Make it, image it, tell it."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--gb", type=float, default=4.0)
    parser.add_argument("--memory", default="1GB")
    parser.add_argument("--work", type=Path, default=None)
    given = parser.parse_args()
    with tempfile.TemporaryDirectory(dir=given.work) as name:
        folder = Path(name)
        rows, size = made(folder / "l.MS", 1e9 * given.gb)
        seconds, run = imaged(folder, given.memory)
    memory, whole = run["memory"], run["seconds"]["measured"]
    part = {name: step["seconds"]["measured"] / whole for name, step in run["stages"].items()}
    text = f"""# A set larger than the memory

{date.today()}, instrument {version("instrument")}, arcae {version("arcae")}, Python {platform.python_version()}.
`python docs/reports/large_set.py --gb {given.gb:g} --memory {given.memory}`

{rows} rows of {CHANNELS} channels, {size / 1e9:.2f} GB: read, corrected for the beam and imaged (256 pixels, {CHANNELS}
channels) with at most {given.memory}: {memory["planned_bytes"] / 1e9:.2f} GB planned,
{memory["measured_bytes"] / 1e9:.2f} GB taken.
{seconds:.0f} s, {part["image"]:.0%} of them gridding, {part["data"]:.0%} reading.
"""
    (Path(__file__).parent / "large_set.md").write_text(text)
    print(text)


if __name__ == "__main__":
    main()
