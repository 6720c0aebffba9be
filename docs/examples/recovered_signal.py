"""A 21-cm signal through gains, calibration and foreground removal: what of its power is there at the end."""

import warnings
from pathlib import Path
from tempfile import TemporaryDirectory

from astropy.table import QTable

from instrument.pipeline.run import run
from instrument.pipeline.scene_file import parse
from instrument.pipeline.scene_text import read_tables

SCENE = """
name = "recovered"
seed = 3
tolerance = 1e-5

[instrument]
telescope = "lofar-hba"
beam = "none"
stations = ["CS001HBA0", "CS001HBA1", "CS002HBA0", "CS003HBA0", "CS003HBA1", "CS004HBA0", "CS005HBA0", "CS005HBA1"]
gain = { rms = 1e-2 }

[observation]
phase_centre = "08h13m36.0s +48d13m03s"
transit = "2012-12-07"
duration = "8 h"
interval = "2 h"
frequency = { centre = "146 MHz", channel_width = "0.8 MHz", channels = 16 }

[sky]
kind = "sum"

[sky.galaxy]
kind = "synchrotron"
pixels = 32
pixel = "20 arcmin"
rms = "50 mK"
uv_range = [7, 85]

[sky.hydrogen]
kind = "signal-21cm"
pixels = 32
pixel = "20 arcmin"
band = ["140 MHz", "152 MHz"]
channels = 16

[calibrate]
kind = "selfcal"

[image]
pixels = 32
pixel = "20 arcmin"
uv_range = [10, 80]

[analyze]
products = ["recovered"]

[analyze.cube]
products = []
bins = 4
uv_range = [10, 80]
remove = "pca"
remover = { components = 3 }
"""

warnings.simplefilter(
    "ignore"
)  # few stations have no beam that a Gaussian fits; the table of the signal ends at small k
with TemporaryDirectory() as folder:
    scene = Path(folder, "recovered.toml")
    scene.write_text(SCENE)
    tables = read_tables(str(scene))
    out = run(parse(tables), tables, out=str(Path(folder, "out"))).folder
    print("k (/Mpc)   power over that injected, what came through of the signal")
    for name in ("recovered_with_foregrounds", "recovered"):
        print(name.replace("_", " "))
        for row in QTable.read(out / f"{name}.ecsv"):
            print(f"{row['k'].value:8.3f}   {row['ratio']:9.3g} ± {row['ratio_sigma']:.2g}"
                  f"   {row['transfer']:6.3f} ± {row['transfer_sigma']:.2g}")  # fmt: skip
