"""SkyH5 beside pyradiosky: its files read, ours read by it, and what its Q, U and V mean in the sky."""

import numpy as np
import pytest
from astropy import units as u
from astropy.coordinates import AltAz, EarthLocation, SkyCoord
from astropy.time import Time

from instrument.jones.mueller import brightness
from instrument.sky.points import PointSky

pytestmark = [pytest.mark.peer, pytest.mark.filterwarnings("ignore")]
SkyModel = pytest.importorskip("pyradiosky").SkyModel
IAU = [1, 1, 1, -1]  # V of a sky is minus that of the IAU
STOKES = np.array([[[1, 2]], [[0.1, 0]], [[-0.2, 0]], [[0.3, 0]]])


def made(**changed):
    given = {
        "name": ["a", "b"], "skycoord": SkyCoord([10, 20], [-30, 40], unit="deg", frame="icrs"),
        "stokes": STOKES * u.Jy, "spectral_type": "spectral_index", "reference_frequency": [150, 160] * u.MHz,
        "spectral_index": [-0.7, -0.8],
    }  # fmt: skip
    return SkyModel(**(given | changed))


@pytest.mark.parametrize("mhz", [75, 150, 300])
def test_what_it_writes_has_the_fluxes_that_it_has(tmp_path, mhz):
    model = made()
    model.write_skyh5(tmp_path / "m.skyh5")
    sky = PointSky.read(tmp_path / "m.skyh5")
    there = model.at_frequencies([mhz] * u.MHz, inplace=False).stokes.to_value("Jy")[:, 0]
    np.testing.assert_allclose(IAU * sky.stokes(np.array([mhz * 1e6]))[0], there.T, rtol=1e-12)
    np.testing.assert_allclose([sky.ra_rad, sky.dec_rad], [model.ra.rad, model.dec.rad], rtol=1e-15)


def test_fk5_places_are_those_of_astropy(tmp_path):
    model = made(skycoord=SkyCoord([10, 20], [-30, 40], unit="deg", frame="fk5"))
    model.write_skyh5(tmp_path / "m.skyh5")
    sky = PointSky.read(tmp_path / "m.skyh5")
    np.testing.assert_allclose([sky.ra_rad, sky.dec_rad], [model.skycoord.icrs.ra.rad, model.skycoord.icrs.dec.rad])


@pytest.mark.parametrize(("time", "ra", "dec"), [("03:00", 300, 30), ("00:20", 250, 20), ("05:00", 300, 70)])
@pytest.mark.parametrize("stokes", [1, 2, 3])
def test_its_coherencies_in_the_sky_are_our_brightness_matrices(tmp_path, time, ra, dec, stokes):
    """Along zenith angle and azimuth, as astropy turns north and east there."""
    here = EarthLocation.from_geodetic(6.87 * u.deg, 52.9 * u.deg)
    when, source = Time(f"2020-06-01T{time}:00"), SkyCoord(ra, dec, unit="deg")
    values = np.zeros((4, 1, 1))
    values[0] = values[stokes] = 1
    model = SkyModel(
        name=["a"], skycoord=SkyCoord([ra], [dec], unit="deg", frame="icrs"), stokes=values * u.Jy, spectral_type="flat"
    )
    model.write_skyh5(tmp_path / "m.skyh5")
    ours = brightness(PointSky.read(tmp_path / "m.skyh5").stokes_jy)[0] / 2
    model.update_positions(when, here)
    frame = AltAz(obstime=when, location=here)
    at = source.transform_to(frame)
    along = [source.directional_offset_by(a * u.deg, 1e-5 * u.rad).transform_to(frame) for a in (0, 90)]
    turn = np.array([[at.alt.rad - b.alt.rad, (b.az.rad - at.az.rad) * np.cos(at.alt.rad)] for b in along]).T / 1e-5
    # its rotation is of the sky as a whole: aberration is 1e-4
    np.testing.assert_allclose(model.coherency_calc().value[:, :, 0, 0], turn @ ours @ turn.T, atol=3e-4)


@pytest.mark.parametrize("freq", [None, 150 * u.MHz])
def test_pyradiosky_reads_what_is_written(tmp_path, freq):
    places = SkyCoord([10, 20.123456789], [-30, 40], unit="deg")
    fields = {} if freq is None else {"spectral_terms": [[-0.7], [-0.8]], "polarization_follows_i": [True, True]}
    sky = PointSky.at(places, STOKES[:, 0].T, freq, names=["a", "b"], patches=("", "p"), **fields)
    sky.write(tmp_path / "m.skyh5")
    model = SkyModel.from_file(tmp_path / "m.skyh5")
    assert (list(model.name), list(model.extended_model_group)) == (["a", "b"], ["", "p"])
    assert model.ra.rad.tolist() == sky.ra_rad.tolist()
    assert model.dec.rad.tolist() == sky.dec_rad.tolist()
    there = model.stokes if freq is None else model.at_frequencies([75] * u.MHz, inplace=False).stokes
    np.testing.assert_allclose(there.to_value("Jy")[:, 0], (IAU * sky.stokes(np.array([75e6]))[0]).T, rtol=1e-14)
