"""Beams written for others: three directions of a UVBeam file read by pyuvdata, Mueller cubes by astropy."""

import numpy as np
import pytest
from astropy import units as u
from astropy.coordinates import AltAz, EarthLocation, SkyCoord
from astropy.io import fits
from astropy.time import Time
from astropy.utils import iers
from astropy.wcs import WCS

import instrument
from instrument import ImageGrid, InputError, write_mueller, write_uvbeam
from instrument.jones.chain import Chain
from instrument.jones.parallactic import Parallactic
from instrument.model import Composed

pytestmark = pytest.mark.filterwarnings("ignore")
TIME = Time("2012-12-07T01:00:00")
FREQ = [140, 150] * u.MHz
STATIONS = ["CS001HBA0", "RS106HBA"]


@pytest.fixture(scope="module")
def lofar():
    return instrument.load("telescopes", "lofar-hba", stations=STATIONS)


@pytest.fixture(scope="module")
def element(lofar):
    """The element of LOFAR alone at a station."""
    pattern = instrument.load("elements", "hamaker").in_chain()
    return Composed(stations=lofar.layout(), terms=Chain(pattern, Parallactic()))


def seen_by_pyuvdata(path, place, directions):
    """Jones matrices (F, S, 2, 2) of north and east, by its interpolation and by astropy's AltAz."""
    from pyuvdata import UVBeam

    here = EarthLocation.from_geocentric(*place, unit="m")
    with iers.conf.set_temp("auto_download", False):
        frame = AltAz(obstime=TIME, location=here)
        at = directions.transform_to(frame)
        north, east = (directions.directional_offset_by(a * u.deg, 1e-5 * u.rad).transform_to(frame) for a in (0, 90))
    # azimuth of UVBeam counts from east through north
    turn = [
        [(at.az.rad - n.az.rad) * np.cos(at.alt.rad) / 1e-5, (at.alt.rad - n.alt.rad) / 1e-5] for n in (north, east)
    ]
    beam = UVBeam.from_file(path)
    found, basis = beam.interp(
        az_array=(np.pi / 2 - at.az.rad) % (2 * np.pi), za_array=np.pi / 2 - at.alt.rad, freq_array=FREQ.to_value("Hz")
    )
    np.testing.assert_array_equal(basis[:, :, 0], np.eye(2))  # along azimuth, along zenith angle
    return beam, np.einsum("crfs,ncs->fsrn", found, np.array(turn))


def test_three_directions_come_back_as_the_beam_has_them(tmp_path, element):
    pytest.importorskip("pyuvdata", reason="the extra 'uv'")
    write_uvbeam(tmp_path / "e.beamfits", element, TIME, FREQ, step=0.5 * u.deg)
    layout = element.layout()
    directions = SkyCoord([120, 150, 60] * u.deg, [48, 20, 70] * u.deg)
    beam, found = seen_by_pyuvdata(tmp_path / "e.beamfits", layout.positions_m[0], directions)
    due = element.beam(directions, TIME, FREQ, directions[0])[0, :, 0]
    # splines of 0.5 deg; derivatives of AltAz to 1e-5
    np.testing.assert_allclose(found, due, atol=3e-4 * np.abs(due).max())
    for wrong in (due[:, :, ::-1], due * [1, -1], due[..., ::-1]):  # swapped, mirrored, turned by 90 deg
        assert np.abs(found - wrong).max() > 0.1 * np.abs(due).max()
    assert np.abs(found - due.conj()).max() > 5e-3 * np.abs(due).max()  # the other sign of time: its phase is small
    assert (beam.data_normalization, beam.antenna_type, beam.mount_type) == ("physical", "simple", "fixed")
    # the dipoles of LOFAR lie south-west (north-east) and south-east (north-west)
    np.testing.assert_allclose(np.rad2deg(beam.feed_angle), [45, 135], atol=3)


def test_nodes_of_a_station_are_those_of_its_beam(tmp_path, lofar):
    """At a node nothing is interpolated: the peak of the array factor too, which is narrower than the grid."""
    pytest.importorskip("pyuvdata", reason="the extra 'uv'")
    from pyuvdata import UVBeam

    pointing = SkyCoord("08h13m36.0s +48d13m03s")
    write_uvbeam(tmp_path / "s.beamfits", lofar, TIME, FREQ, "RS106HBA", pointing, 5 * u.deg)
    beam = UVBeam.from_file(tmp_path / "s.beamfits")
    from instrument.files.beam_files import _icrs
    from instrument.observe.layout import geodetic_axes
    from instrument.observe.sampling import Sampling

    layout, centre = lofar.layout(), instrument.Direction(pointing.ra.rad, pointing.dec.rad)
    earth = Sampling.build(layout, [TIME.isot], 1e8, 0.0, 0.0, centre).earth
    axes = geodetic_axes(layout.positions_m[1:])[0]
    za, az = np.deg2rad(10), np.deg2rad(35)
    towards = np.array([[np.sin(za) * np.cos(az), np.sin(za) * np.sin(az), np.cos(za)]]) @ axes
    x, y, z = _icrs(earth, towards)[0]
    np.testing.assert_allclose(earth.itrf(np.array([[x, y, z]]))[0], towards, atol=1e-15)
    there = SkyCoord(np.arctan2(y, x) * u.rad, np.arcsin(z) * u.rad)
    due = lofar.beam(there, TIME, FREQ, pointing)[0, :, 1, 0]
    node = beam.data_array[:, :, :, 2, 7]  # (2, receptors, F) at za 10, az 35 deg
    power = np.einsum("crf,csf->frs", node, node.conj())
    np.testing.assert_allclose(power, due @ np.conj(np.swapaxes(due, 1, 2)), atol=1e-9 * np.abs(power).max())
    assert beam.mount_type == "phased"


@pytest.mark.parametrize(
    ("changed", "message"),
    [
        ({"path": "b.h5"}, "ends in .beamfits"),
        ({"step": 7 * u.deg}, "step = 7 deg does not divide 90 deg"),
        ({"time": ["2012-12-07T01:00:00", "2012-12-07T02:00:00"]}, "time holds 2 instants"),
        ({"station": "CS001HBA"}, "no station 'CS001HBA'"),
    ],
)
def test_an_impossible_beam_file_is_refused(tmp_path, element, changed, message):
    pytest.importorskip("pyuvdata", reason="the extra 'uv'")
    given = {"path": "b.beamfits", "telescope": element, "time": TIME, "frequencies": FREQ} | changed
    with pytest.raises(InputError, match=message):
        write_uvbeam(**(given | {"path": tmp_path / given["path"]}))
    assert not list(tmp_path.iterdir())


GRID = ImageGrid(pixels=(3, 5), pixel=1 * u.deg, centre=SkyCoord("08h13m36.0s +48d13m03s"))


@pytest.mark.parametrize("baseline", ["mean", tuple(STATIONS), ("RS106HBA", "RS106HBA")])
def test_mueller_matrices_stand_where_their_wcs_says(tmp_path, lofar, baseline):
    write_mueller(tmp_path / "m.fits", lofar, GRID, TIME, FREQ, baseline)
    with fits.open(tmp_path / "m.fits") as hdus:
        data, header = hdus[0].data, hdus[0].header
        whole = data + (1j * hdus["IMAGINARY"].data if len(hdus) > 1 else 0)
    assert data.shape == (2, 4, 4, 3, 5)
    wcs = WCS(header).celestial
    where = wcs.pixel_to_world([4], [0])  # column 4 (west), row 0 (south)
    pair = tuple(STATIONS) if baseline == "mean" else baseline
    due = lofar.mueller(where, TIME, FREQ, GRID.centre.skycoord, pair)[0, :, 0]
    if baseline == "mean":
        due = (due + lofar.mueller(where, TIME, FREQ, GRID.centre.skycoord, pair[::-1])[0, :, 0]) / 2
    np.testing.assert_allclose(whole[:, :, :, 0, 4], due, atol=1e-9)
    np.testing.assert_allclose(whole[:, :, :, 1, 2], np.broadcast_to(np.eye(4), (2, 4, 4)), atol=1e-12)
    spectral = header["CRVAL5"] + header["CDELT5"] * np.arange(2)
    assert (spectral.tolist(), header["BEAMMODE"]) == (FREQ.to_value("Hz").tolist(), "differential")


def test_mueller_files_that_cannot_be_are_refused(tmp_path, lofar):
    path = tmp_path / "m.fits"
    with pytest.raises(InputError, match="over a grid with a centre"):
        write_mueller(path, lofar, ImageGrid(pixels=4, pixel=1 * u.deg), TIME, FREQ)
    with pytest.raises(InputError, match="equally spaced"):
        write_mueller(path, lofar, GRID, TIME, [140, 150, 170] * u.MHz)
    with pytest.raises(InputError, match="needs two stations"):
        write_mueller(path, lofar.with_fields(stations=STATIONS[:1]), GRID, TIME, FREQ)
    path.write_text("mine")
    with pytest.raises(InputError, match="exists"):
        write_mueller(path, lofar, GRID, TIME, FREQ)
    assert path.read_text() == "mine"
