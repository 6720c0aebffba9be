"""The curves on which the pages of runs draw their own point, from a contest of engines.

    instrument precision engines --out runs/engines && python docs/reports/precision/curves.py runs/engines

Writes instrument/data/precision_engines.ecsv: error and seconds a visibility of each scene, engine and tolerance.
"""

import sys
from math import prod
from pathlib import Path

import numpy as np
from astropy import units as u
from astropy.table import QTable

from instrument.pipeline.scene_file import parse
from instrument.pipeline.scene_text import read_tables, shipped
from instrument.precision.engines import _few_times
from instrument.whole_file import write_ecsv

OUT = Path(__file__).parents[3] / "instrument" / "data" / "precision_engines.ecsv"


def main():
    table = QTable.read(Path(sys.argv[1]) / "precision.ecsv")
    rows = []
    for scene in shipped():
        own = table[table["contest"] == f"predict {scene}"]
        if len(own):
            count = prod(_few_times(parse(read_tables(scene)).scene()).plan().full.shape)
            for row in own[np.isfinite(own["error"])]:
                each = float(f"{row['seconds'].value / count:.3g}")
                rows.append((scene, row["plugin"], float(f"{row['asked']:.3g}"), each, float(f"{row['error']:.2g}")))
    found = QTable(rows=rows, names=("scene", "engine", "asked", "seconds_each", "error"))
    found["seconds_each"] = found["seconds_each"] * u.s
    found.meta = {key: table.meta[key] for key in ("made", "versions")}
    found.meta["machine"] = table.meta["machine"]["processor"]
    found.meta["command"] = "instrument precision engines" + " --quick" * ("--quick" in table.meta["command"])
    OUT.unlink(missing_ok=True)
    write_ecsv(found, OUT)


if __name__ == "__main__":
    main()
