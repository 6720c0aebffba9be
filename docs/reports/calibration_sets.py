"""Sets of data and models for calibration beside other programs, and the commands that solve them.

What calibration_beams.py runs: `Sets` holds the columns as arrays for this package and in a Measurement Set for DP3 and
QuartiCal, all complex64.
"""

import json
import pickle
import shutil
import subprocess
import sys

import numpy as np
from peers import DP3, peer_tools, told

from instrument import JonesTable, read_h5parm

COMMON = {"maxiter": 1000, "detectstalling": "false"}
MOST = 300  # iterations of gaincal and QuartiCal
OURS = """
import pickle, sys
import numpy as np
from instrument import SelfCal, DirectionalCal, Visibilities, write_h5parm
folder, tolerance, first, *columns = sys.argv[1:]
of = pickle.load(open(f"{folder}/of.pickle", "rb"))
cut = slice(0, int(first) or None), slice(None)
load = lambda name: Visibilities(np.load(f"{folder}/{name}.npy").astype(complex), *of).block(*cut)
data = load("DATA")
if columns:
    minute = DirectionalCal(tolerance=float(tolerance), interval="60 s")
    parts = minute.solve(data, {name: load(name) for name in columns})
    for name in columns:
        write_h5parm(f"{folder}/ours_{name}.h5", parts[name], at=data.at, overwrite=True)
    found = parts[columns[0]]
else:
    found = SelfCal(tolerance=float(tolerance)).solve(data, load("MODEL_DATA"))
    write_h5parm(f"{folder}/ours.h5", found, at=data.at, overwrite=True)
print("Converged:", int(found.converged.sum()))
"""
# run in the environment of QuartiCal; it stops all integrations at once, and tells the share of gains that converged
READ = """
import json, sys
import numpy as np
from daskms.experimental.zarr import xds_from_zarr
store, out = sys.argv[1:]
(found,) = xds_from_zarr(f"{store}::G")
gains = found.gains.values[:, :, :, 0]
np.save(out, gains.reshape(*gains.shape[:3], 2, 2))
print(json.dumps({"share": float(found.conv_perc.values.min()), "flagged": int(found.gain_flags.values.sum())}))
"""


class Sets:
    """Data and models in a folder, as arrays for us and in a Measurement Set for others; commands that solve them."""

    def __init__(self, folder, lofar, observation, model, columns, quartical=None):
        self.folder, self.model, self.quartical = folder, model, quartical
        peer_tools(folder).make_ms(folder / "cal.MS", lofar, observation, columns)
        with open(folder / "of.pickle", "wb") as file:
            pickle.dump((model.at, model.antenna1, model.antenna2, model.interval_s), file)

    def put(self, **values):
        """Write columns as complex64; for QuartiCal, which takes no part of a set, the first integration by itself."""
        import casacore.tables as tables

        with tables.table(str(self.folder / "cal.MS"), readonly=False, ack=False) as ms:
            for name, vis in values.items():
                stored = vis.data.astype(np.complex64)
                np.save(self.folder / f"{name}.npy", stored)
                ms.putcol(name, stored.swapaxes(1, 2).reshape(-1, 1, 4))
            if self.quartical:
                shutil.rmtree(self.folder / "first.MS", ignore_errors=True)
                first = ms.selectrows(range(len(self.model.antenna1)))
                first.copy(str(self.folder / "first.MS"), deep=True).close()

    def ours(self, tolerance, columns=()):
        """Commands for all integrations, and for the first six or first one."""
        command = [sys.executable, "-c", OURS, str(self.folder), tolerance]
        return [[*command, n, *columns] for n in ("0", "6" if columns else "1")]

    def dp3(self, step, first, **settings):
        """The same two for a step of DP3."""
        command = [sys.executable, "-c", DP3, f"msin={self.folder}/cal.MS", "msout=", f"steps=[{step}]", "numthreads=2"]
        command += [f"{step}.{key}={value}" for key, value in (COMMON | settings).items()]
        return [command, [*command, f"msin.ntimes={first}"]]

    def gaincal(self, tolerance):
        file = f"{self.folder}/gaincal.h5"
        return self.dp3(
            "gaincal", 1, caltype="fulljones", usemodelcolumn="true", parmdb=file, tolerance=tolerance, maxiter=MOST
        )

    def ddecal(self, tolerance, columns):
        own = {"mode": "fulljones", "modeldatacolumns": f"[{','.join(columns)}]", "solint": 6}
        return self.dp3("ddecal", 6, h5parm=f"{self.folder}/ddecal.h5", tolerance=tolerance, **own)

    def complex_term(self, tolerance):
        """The same two for QuartiCal: full Jones matrices, all times in one chunk, one thread (the quickest)."""
        settings = {
            "input_model.recipe": "MODEL_DATA", "output.overwrite": True, "output.flags": False,
            "output.gain_directory": self.folder / "gains.qc", "output.log_directory": self.folder / "logs.qc",
            "solver.terms": "[G]", "solver.iter_recipe": f"[{MOST}]", "solver.convergence_criteria": tolerance,
            "solver.convergence_fraction": 1, "G.type": "complex", "G.time_interval": 1, "dask.threads": 1,
        }  # fmt: skip
        command = [str(self.quartical), *(f"{key}={value}" for key, value in settings.items())]
        return [[*command, f"input_ms.path={self.folder}/{name}.MS"] for name in ("cal", "first")]

    def solution(self, way, said):
        """Gains that a way of "ours", "gaincal" or "QuartiCal" has left, and what converged."""
        count = len(self.model.data)
        if not way.startswith("QuartiCal"):
            file = self.folder / ("ours.h5" if way.startswith("ours") else "gaincal.h5")
            return read_h5parm(file, layout=self.model.layout), told(said, count)
        tells, at = self.read(self.folder / "gains.qc"), self.model.at
        term = JonesTable(values=np.load(self.folder / "gains.npy"), slots_s=at.slots_s, freq_hz=at.freq_hz)
        good = tells["share"] == 1 and not tells["flagged"]
        return term, f"{count} of {count}" if good else f"{tells['share']:.1%} of gains"

    def read(self, store):
        """Gains of QuartiCal into gains.npy, by its own environment; what it tells of them."""
        return json.loads(beside(self.quartical, READ, store, self.folder / "gains.npy"))


def beside(program, code, *words):
    """The last line that code says in the environment of a program."""
    command = [program.with_name("python"), "-c", code, *words]
    return subprocess.run(command, check=True, capture_output=True, text=True).stdout.splitlines()[-1]


def version_in(quartical):
    return beside(quartical, "from importlib.metadata import version; print(version('quartical'))")
