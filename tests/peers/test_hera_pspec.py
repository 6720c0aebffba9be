"""hera_pspec, in a process of its own: of the same file the same power, baseline by baseline and delay by delay.

It is not in the extra `peers`, for it holds numpy back: pip install hera_pspec.
"""

import json
import subprocess
import sys

import numpy as np
import pytest
from astropy import units as u
from astropy.cosmology import LambdaCDM

from instrument import Analyzer, Composed, Direction, Layout, Observation, PointSky, Scene, UVFile, write_uv

pytestmark = pytest.mark.peer
pytest.importorskip("hera_pspec")
ASK = """
import json, sys, numpy as np
import hera_pspec as hp
from pyuvdata import UVData
uv = UVData.from_file(sys.argv[1]); uv.x_orientation = "north"
cosmo = hp.conversions.Cosmo_Conversions()
beam = hp.pspecbeam.PSpecBeamGauss(float(sys.argv[2]), uv.freq_array.astype(float), cosmo=cosmo)
uv.data_array = uv.data_array * beam.Jy_to_mK(uv.freq_array, "XX")[None, :, None]
uv.vis_units = "mK"
one = hp.PSpecData(dsets=[uv, uv], dsets_std=[None, None], wgts=[None, None], beam=beam)
pairs = sorted({tuple(sorted(p)) for p in uv.get_antpairs()})
found = one.pspec(pairs, pairs, (0, 1), [("xx", "xx")], input_data_weight="identity", norm="I", taper="none",
                  little_h=False, verbose=False, store_window=False)
power = {}
for a, b in pairs:
    power[f"{a}-{b}"] = np.real(found.get_data((0, ((a, b), (a, b)), ("xx", "xx")))).mean(axis=0).tolist()
print(json.dumps({"power": power, "k_par": found.get_kparas(0, little_h=False).tolist(),
                  "H0": cosmo.H0, "Om": cosmo.Om_M, "OL": cosmo.Om_L}))
"""


def test_power_of_each_baseline_and_delay_is_that_of_hera_pspec(tmp_path):
    rng, fwhm = np.random.default_rng(1), np.deg2rad(10)
    enu = np.array([[0, 0, 0], [15, 0, 0], [0, 37, 0], [61, 20, 0.0]]) * u.m
    layout = Layout.from_enu(["a", "b", "c", "d"], enu, 21.4 * u.deg, -30.7 * u.deg, 1050 * u.m)
    night = Observation(
        phase_centre=Direction(2.15, -0.53), transit="2018-02-01", duration=60 * u.s, interval=10 * u.s,
        frequencies=(150 + 0.1 * np.arange(31)) * u.MHz, channel_width=0.1 * u.MHz,
    )  # fmt: skip
    sky = PointSky(names=("a",), ra_rad=[2.3], dec_rad=[-0.5], stokes_jy=np.array([[3.0, 0, 0, 0]]))
    vis = Scene(instrument=Composed(stations=layout), sky=sky, observation=night).plan().run()
    data = vis.data + rng.standard_normal((*vis.data.shape, 2)) @ [1, 1j]
    data[..., 1, 1] = data[..., 0, 0]  # so that I is xx
    write_uv(tmp_path / "v.uvh5", vis.with_data(data))
    done = subprocess.run(
        [sys.executable, "-W", "ignore", "-c", ASK, str(tmp_path / "v.uvh5"), repr(float(fwhm))],
        capture_output=True, text=True, timeout=500,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr[-3000:]
    theirs = json.loads(done.stdout.splitlines()[-1])
    cosmology = LambdaCDM(H0=theirs["H0"], Om0=theirs["Om"], Ode0=theirs["OL"])
    omega = np.pi * fwhm**2 / (8 * np.log(2)) * u.sr
    found = Analyzer(visibilities=UVFile(tmp_path / "v.uvh5")).delay_spectrum(omega, taper=None, cosmology=cosmology)
    cells = found.cells
    n = 31
    k_par = np.array(theirs["k_par"])
    assert np.allclose(np.abs(k_par[n // 2 :]), cells.k_par, rtol=1e-8)
    lengths = np.hypot(vis.uvw_m[..., 0], vis.uvw_m[..., 1]) * vis.freq_hz[[0, -1]].mean() / 299792458.0
    order = np.argsort(np.argsort(lengths.ravel(), kind="stable"), kind="stable").reshape(lengths.shape)
    for b, (one, two) in enumerate(zip(vis.antenna1, vis.antenna2, strict=True)):
        ours = 1e6 * cells.power[:, order[:, b]].mean(axis=1)  # K² to mK²
        both = np.array(theirs["power"][f"{one + 1}-{two + 1}"])
        folded = both[n // 2 :].copy()
        folded[1:] = (folded[1:] + both[n // 2 - 1 :: -1]) / 2
        ratio = ours / folded
        assert np.ptp(ratio) < 1e-10
        assert abs(ratio[0] - 1) < 4e-4  # they average distance, depth and wavelength over the band: 3.6e-4 measured
