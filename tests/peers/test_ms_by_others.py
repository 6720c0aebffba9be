"""Sets that CASA's simulator makes, of an array like MWA and one like VLA: predicted with their UVW, and imaged.

CASA predicts the sources itself. Its UVW are antenna 1 minus 2; DP3's sets are in test_measurement_set.py.
"""

import importlib.util
from pathlib import Path

import numpy as np
import pytest

from instrument import MeasurementSet
from instrument.cli import main
from instrument.files.fits import read_cube

spec = importlib.util.spec_from_file_location("casa", Path(__file__).with_name("casa.py"))
casa = importlib.util.module_from_spec(spec)
spec.loader.exec_module(casa)
pytestmark = [pytest.mark.peer, pytest.mark.filterwarnings("ignore:.*UVW are antenna 1 minus 2")]
pytest.importorskip("arcae")

SOURCES = [(0.6, 0.4, (3.0, 0.3, -0.2, 0.1)), (-0.9, 0.2, (2.0, 0.0, 0.5, 0.0))]  # deg in RA and Dec, Jy
SIMULATE = f"""
import sys
import numpy as np
import casatools
path, mwa = sys.argv[1], sys.argv[2] == "mwa"
sm, me, qa, cl = casatools.simulator(), casatools.measures(), casatools.quanta(), casatools.componentlist()
n, reach = 12, 500 if mwa else 5000
x, y = np.random.default_rng(1).uniform(-reach, reach, (2, n))
site = me.position("WGS84", "116.67deg", "-26.70deg", "377.8m") if mwa else me.observatory("VLA")
freq = "150MHz" if mwa else "1400MHz"
sm.open(path)
sm.setconfig(
    telescopename="MWA" if mwa else "VLA", x=x.tolist(), y=y.tolist(), z=[0.0] * n, dishdiameter=[4.0] * n,
    mount=["alt-az"] * n, antname=[f"A{{k:02d}}" for k in range(n)], coordsystem="local", referencelocation=site,
)
sm.setspwindow(
    spwname="w", freq=freq, deltafreq="0.2MHz", freqresolution="0.2MHz", nchannels=4,
    stokes="XX XY YX YY" if mwa else "RR RL LR LL",
)
sm.setfeed(mode="perfect X Y" if mwa else "perfect R L")
centre = me.direction("J2000", "5h00m00s", "-26d00m00s" if mwa else "+40d00m00s")
sm.setfield(sourcename="f", sourcedirection=centre)
sm.settimes(integrationtime="30s", usehourangle=True, referencetime=me.epoch("UTC", "2020/01/01/12:00:00"))
sm.setlimits(shadowlimit=0.0, elevationlimit="5deg")
sm.setauto(autocorrwt=float(not mwa))
sm.observe("f", "w", starttime="-0.25h", stoptime="0.25h")
for east, north, flux in {SOURCES}:
    there = {{"type": "direction", "refer": "J2000", "m0": qa.add(centre["m0"], f"{{east}}deg"),
             "m1": qa.add(centre["m1"], f"{{north}}deg")}}
    cl.addcomponent(flux=flux, fluxunit="Jy", polarization="Stokes", dir=there, shape="point", freq=freq)
cl.rename(path + ".cl")
cl.close()
sm.predict(complist=path + ".cl")
sm.close()
"""


@pytest.fixture(scope="module", params=["mwa", "vla"])
def simulated(request, tmp_path_factory):
    folder = tmp_path_factory.mktemp(request.param)
    casa.run(SIMULATE, folder, folder / "sim.ms", request.param)
    dec = -26 if request.param == "mwa" else 40
    rows = [
        f"s{k},{75 + east},{dec + north},{','.join(map(str, flux))},0,150"
        for k, (east, north, flux) in enumerate(SOURCES)
    ]
    head = "name,ra_deg,dec_deg,i_jy,q_jy,u_jy,v_jy,spectral_index,ref_freq_mhz"
    (folder / "two.csv").write_text("\n".join([head, *rows]) + "\n")
    (folder / "two.toml").write_text(
        f'name = "two"\n[instrument]\ntelescope = "array"\n[sky]\nkind = "catalogue"\npath = "{folder}/two.csv"\n'
        '[image]\npixels = 256\npixel = "1 arcmin"\n'
    )
    return folder


def test_what_casa_predicts_is_what_we_predict_with_its_uvw(simulated):
    words = [
        str(simulated / "two.toml"),
        "--data",
        str(simulated / "sim.ms"),
        "--out",
        str(simulated / "predict"),
        "--into",
        "OURS",
    ]
    assert main(["predict", *words]) == 0
    columns = ("DATA", "OURS")
    theirs, ours = ([*MeasurementSet(simulated / "sim.ms", c).blocks()] for c in columns)
    theirs, ours = (np.concatenate([block.data for block in some]) for some in (theirs, ours))
    error = np.sqrt(np.mean(np.abs(ours - theirs) ** 2) / np.mean(np.abs(theirs) ** 2))
    print(f"{simulated.name}: {error:.1e} rms")
    assert error < 1e-7  # both are in single precision, of 6e-8


def test_its_images_have_the_sources_where_they_are(simulated):
    words = [str(simulated / "two.toml"), "--data", str(simulated / "sim.ms"), "--out", str(simulated / "image")]
    assert main(["image", *words]) == 0
    cube = read_cube(simulated / "image" / "cube.fits")
    image = np.mean(cube.data[:, 0], axis=0)
    north, east = np.unravel_index(np.argmax(image), image.shape)
    (right, up, _), dec = SOURCES[0], np.radians(-26 if "mwa" in simulated.name else 40)
    moved = np.cos(dec + np.radians(up)) * np.sin(np.radians(right))
    shift = np.degrees(np.arcsin(moved)) * 60
    assert abs(abs(128 - east) - shift) <= 2 and (128 - east) * right > 0  # RA grows to the left
    assert abs(north - 128 - 60 * up) <= 2
