"""xradio, in a process of its own: what is written is a set of its schema, and it reads what we mean."""

import json
import subprocess
import sys

import numpy as np
import pytest
from astropy import units as u

import instrument
from instrument import Direction, Observation, PointSky, Scene, write_msv4

pytestmark = pytest.mark.peer
pytest.importorskip("xradio")
ASK = """
import json, sys, numpy as np
import xarray, xradio.measurement_set.schema
from xradio.schema.check import check_datatree
tree = xarray.open_datatree(sys.argv[1], engine="zarr")["set"]
print(json.dumps({"issues": str(check_datatree(tree)), "phase": tree["VISIBILITY"].values[2, 1, 0, 0].imag,
                  "uvw": tree["UVW"].values[2, 1].tolist(), "flags": int(tree["FLAG"].values.sum())}))
"""


def test_a_set_of_ours_is_one_of_its_schema_and_holds_the_same(tmp_path):
    lofar = instrument.load("telescopes", "lofar-hba", stations=["CS001HBA0", "CS002HBA1", "RS106HBA"], beam=None)
    night = Observation(
        phase_centre=Direction(2.15, 0.84), start="2014-03-01T20:00:00", duration=50 * u.s, interval=10 * u.s,
        frequencies=[150, 150.1] * u.MHz, channel_width=0.1 * u.MHz,
    )  # fmt: skip
    sky = PointSky(names=("a",), ra_rad=[2.162], dec_rad=[0.846], stokes_jy=np.array([[4.0, 0, 0, 0]]))
    vis = Scene(instrument=lofar, sky=sky, observation=night).plan().run()
    vis = vis.flagged(np.arange(vis.data[..., 0, 0].size).reshape(vis.data.shape[:3]) % 7 == 0)
    write_msv4(tmp_path / "a.zarr", vis)
    done = subprocess.run(
        [sys.executable, "-W", "ignore", "-c", ASK, str(tmp_path / "a.zarr")], capture_output=True, text=True
    )
    assert done.returncode == 0, done.stderr[-2000:]
    found = json.loads(done.stdout.splitlines()[-1])
    assert found["issues"] in ("", "No schema issues found"), found["issues"]
    assert found["phase"] == vis.data[2, 0, 1, 0, 0].imag and found["uvw"] == (-vis.uvw_m[2, 1]).tolist()
    assert found["flags"] == 4 * vis.flag.sum()
