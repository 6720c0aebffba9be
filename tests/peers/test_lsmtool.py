"""BBS text beside LSMTool: what is written is read by it as it is, and what it writes of that comes back."""

import numpy as np
import pytest

from instrument.sky.points import PointSky

pytestmark = [pytest.mark.peer, pytest.mark.filterwarnings("ignore")]
lsmtool = pytest.importorskip("lsmtool")
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


def test_lsmtool_reads_what_is_written(tmp_path, sky):
    sky.write(tmp_path / "s.skymodel")
    model = lsmtool.load(str(tmp_path / "s.skymodel"))
    order = [list(model.getColValues("Name")).index(n) for n in sky.names]
    for column, values in {
        "Ra": np.rad2deg(sky.ra_rad), "Dec": np.rad2deg(sky.dec_rad), "I": sky.stokes_jy[:, 0],
        "Q": sky.stokes_jy[:, 1], "MajorAxis": sky.major_rad / ARCSEC, "MinorAxis": sky.minor_rad / ARCSEC,
        "Orientation": np.rad2deg(sky.angle_rad), "ReferenceFrequency": sky.reference_hz,
        "SpectralIndex": sky.spectral_terms,
    }.items():  # fmt: skip
        there = np.ma.filled(model.getColValues(column), 0.0)[order]
        np.testing.assert_allclose(there, values, rtol=1e-12, atol=1e-12, err_msg=column)
    assert [str(n) for n in np.asarray(model.getColValues("Patch"))[order]] == list(sky.patches)


def test_what_lsmtool_writes_of_it_comes_back(tmp_path, sky):
    sky.write(tmp_path / "s.skymodel")
    lsmtool.load(str(tmp_path / "s.skymodel")).write(str(tmp_path / "t.skymodel"))
    back = PointSky.read(tmp_path / "t.skymodel")
    back = back.select([back.names.index(n) for n in sky.names])
    # it rounds places to 1e-7 h and 1e-6 deg or so, sizes and fluxes to 1e-4 of their unit
    np.testing.assert_allclose(back.ra_rad, sky.ra_rad, atol=0.02 * ARCSEC)
    np.testing.assert_allclose(back.dec_rad, sky.dec_rad, atol=0.02 * ARCSEC)
    np.testing.assert_allclose(back.stokes_jy, sky.stokes_jy, atol=1e-4)
    np.testing.assert_allclose(back.spectral_terms, sky.spectral_terms, atol=1e-4)
    np.testing.assert_allclose([back.major_rad, back.minor_rad], [sky.major_rad, sky.minor_rad], atol=0.1 * ARCSEC)
    np.testing.assert_allclose(np.rad2deg(back.angle_rad), np.rad2deg(sky.angle_rad), atol=0.1)
