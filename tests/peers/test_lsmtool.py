"""BBS text beside LSMTool: what is written is read by it as it is, and what it writes of that comes back.

It runs in a process of its own: once imported it opens every file that astropy is asked to write before it is there.
"""

import json
import subprocess
import sys
from importlib.util import find_spec

import numpy as np
import pytest

from instrument.sky.points import PointSky

pytestmark = [pytest.mark.peer, pytest.mark.skipif(find_spec("lsmtool") is None, reason="needs LSMTool")]
TOLD = """
import json, sys, lsmtool, numpy as np
columns = {n: np.ma.filled(lsmtool.load(sys.argv[1]).getColValues(n), 0.0).tolist() for n in sys.argv[2:]}
print(json.dumps(columns))
"""
AGAIN = "import sys, lsmtool; lsmtool.load(sys.argv[1]).write(sys.argv[2])"
ARCSEC = np.pi / 180 / 3600


@pytest.fixture(scope="module")
def sky():
    """Points and Gaussians with curved spectra, in patches, on both sides of the equator."""
    rng, count = np.random.default_rng(3), 12
    shaped = np.arange(count) % 2 == 0
    stokes = rng.uniform(0.1, 1, (count, 4)) * [1, 0.1, 0.1, 0.1]
    return PointSky(
        names=tuple(f"a{k}" for k in range(count)),
        patches=tuple(f"p{k % 3}" for k in range(count)),
        ra_rad=rng.uniform(0, 2 * np.pi, count),
        dec_rad=rng.uniform(-1.4, 1.4, count),
        stokes_jy=stokes,
        reference_hz=np.full(count, 144e6),
        spectral_terms=rng.normal(-0.7, 0.1, (count, 2)),
        major_rad=np.where(shaped, rng.uniform(10, 90, count), 0) * ARCSEC,
        minor_rad=np.where(shaped, rng.uniform(5, 9, count), 0) * ARCSEC,
        angle_rad=np.where(shaped, rng.uniform(0, np.pi, count), 0),
    )


def lsmtool(program, *arguments):
    """What a program that imports LSMTool prints last."""
    command = [sys.executable, "-W", "ignore", "-c", program, *map(str, arguments)]
    done = subprocess.run(command, capture_output=True, text=True, timeout=300)
    assert done.returncode == 0, done.stderr
    return done.stdout.strip().splitlines()[-1:]


def test_lsmtool_reads_what_is_written(tmp_path, sky):
    sky.write(tmp_path / "s.skymodel")
    asked = {
        "Ra": np.rad2deg(sky.ra_rad), "Dec": np.rad2deg(sky.dec_rad), "I": sky.stokes_jy[:, 0],
        "Q": sky.stokes_jy[:, 1], "MajorAxis": sky.major_rad / ARCSEC, "MinorAxis": sky.minor_rad / ARCSEC,
        "Orientation": np.rad2deg(sky.angle_rad), "ReferenceFrequency": sky.reference_hz,
        "SpectralIndex": sky.spectral_terms,
    }  # fmt: skip
    told = json.loads(lsmtool(TOLD, tmp_path / "s.skymodel", "Name", "Patch", *asked)[0])
    order = [told["Name"].index(n) for n in sky.names]
    for column, values in asked.items():
        np.testing.assert_allclose(np.array(told[column])[order], values, rtol=1e-12, atol=1e-12, err_msg=column)
    assert [told["Patch"][k] for k in order] == list(sky.patches)


def test_what_lsmtool_writes_of_it_comes_back(tmp_path, sky):
    sky.write(tmp_path / "s.skymodel")
    lsmtool(AGAIN, tmp_path / "s.skymodel", tmp_path / "t.skymodel")
    back = PointSky.read(tmp_path / "t.skymodel")
    back = back.select([back.names.index(n) for n in sky.names])
    # it rounds places to 1e-7 h and 1e-6 deg or so, sizes and fluxes to 1e-4 of their unit
    np.testing.assert_allclose(back.ra_rad, sky.ra_rad, atol=0.02 * ARCSEC)
    np.testing.assert_allclose(back.dec_rad, sky.dec_rad, atol=0.02 * ARCSEC)
    np.testing.assert_allclose(back.stokes_jy, sky.stokes_jy, atol=1e-4)
    np.testing.assert_allclose(back.spectral_terms, sky.spectral_terms, atol=1e-4)
    np.testing.assert_allclose([back.major_rad, back.minor_rad], [sky.major_rad, sky.minor_rad], atol=0.1 * ARCSEC)
    np.testing.assert_allclose(np.rad2deg(back.angle_rad), np.rad2deg(sky.angle_rad), atol=0.1)
