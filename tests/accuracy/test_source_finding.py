"""Source finding: what was put in comes out, with the errors that are claimed."""

import numpy as np
import pytest
from astropy import units as u
from astropy.table import QTable

from instrument import Analyzer, InputError, PointSky, Psf, SourceFinder, StokesCube
from instrument.errors import InstrumentWarning
from instrument.image.minor import Folding, restored
from instrument.units import direction

PIXEL = float(np.deg2rad(10 / 3600))
BEAM = (*np.deg2rad(np.array([60, 45]) / 3600), 0.5)
CENTRE = direction("08h13m36.0s +48d13m03s")
SIGMA = 1e-3


def gaussian(shape, y, x, major, minor, angle):
    """Peak 1 at a place in pixels; x to the west, angle north through east."""
    north = (np.arange(shape[0])[:, None] - y) * PIXEL
    east = -(np.arange(shape[1]) - x) * PIXEL
    along, across = north * np.cos(angle) + east * np.sin(angle), east * np.cos(angle) - north * np.sin(angle)
    return np.exp(-4 * np.log(2) * ((along / major) ** 2 + (across / minor) ** 2))


def field(sources, shape=(176, 176), sigma=SIGMA, seed=1, channels=1):
    """A cube of sources (y, x, (I, Q, U, V), widths and angle) with noise of the resolution of the beam."""
    rng, folding = np.random.default_rng(seed), Folding(shape)
    data = np.zeros((channels, 4, *shape))
    for planes in data:
        for plane in planes:
            white = restored(rng.standard_normal(shape), BEAM, PIXEL, folding)
            plane += sigma * white / white.std()
        for y, x, stokes, *size in sources:
            planes += np.asarray(stokes)[:, None, None] * gaussian(shape, y, x, *(size or BEAM))
    psf = Psf.gaussian(*(a * u.rad for a in BEAM))
    return StokesCube(data, np.linspace(150, 152, channels) * u.MHz, PIXEL * u.rad, "Jy/beam", CENTRE, psf)


def truth(cube, sources):
    ra, dec = cube.grid.at(*(np.array([s[k] for s in sources]) for k in (0, 1)))
    stokes = np.array([s[2] for s in sources], float)
    return PointSky(names=tuple(f"t{k}" for k in range(len(ra))), ra_rad=ra, dec_rad=dec, stokes_jy=stokes)


@pytest.mark.parametrize("shape", [(176, 176), (175, 161)])
def test_sources_without_noise_come_out_as_they_went_in(shape):
    sources = [(40.3, 60.7, (1, 0.1, -0.2, 0.05)), (120.5, 31.25, (0.5, 0, 0, 0)), (150.1, 140.9, (2, 0, 0.3, -0.1))]
    cube = field(sources, shape, sigma=1e-9)
    found = Analyzer(cube).sources()
    beside = found.against(truth(cube, sources), 5 * u.arcsec)
    assert len(found) == 3 and beside.completeness == 1 and beside.false == 0
    assert np.abs(beside.flux_ratio - 1).max() < 1e-5 and np.abs(beside.offset_rad).max() < 1e-5 * BEAM[1]
    assert np.abs(found.stokes_jy[0, beside.match] - [s[2] for s in sources]).max() < 1e-5
    assert not found.major_rad.any()


@pytest.mark.long
def test_errors_are_those_of_many_sources_in_noise():
    rng = np.random.default_rng(3)
    y, x = (a.ravel() + rng.uniform(-0.5, 0.5, 225) for a in np.meshgrid(*[np.arange(24, 504, 32)] * 2, indexing="ij"))
    sources = [(a, b, (20 * SIGMA, 8 * SIGMA, 0, 0)) for a, b in zip(y, x, strict=True)]
    cube = field(sources, (512, 512))
    found = SourceFinder().find(cube)
    beside = found.against(truth(cube, sources), 30 * u.arcsec)
    assert beside.completeness == 1 and beside.false == 0
    pull = (found.stokes_jy[0, beside.match] - [s[2] for s in sources]) / found.error_jy[0, beside.match]
    # of 225 the rms is known to 5 %; the fit is 1.1 times the noise, as it is not of independent pixels
    assert np.all(np.abs(pull.std(axis=0) - 1) < 0.25) and np.all(np.abs(pull.mean(axis=0)) < 4 / 15)
    place = beside.offset_rad / found.place_error_rad[beside.match]
    assert np.all(np.abs(place.std(axis=0) - 1) < 0.25) and np.all(np.abs(place.mean(axis=0)) < 4 / 15)
    assert abs(beside.bias) < 0.01


def test_an_extended_source_has_its_size_and_flux_and_a_point_has_none():
    major, minor, angle = np.deg2rad(120 / 3600), np.deg2rad(70 / 3600), 1.1
    cube = field([(100, 90, (1, 0, 0, 0), major, minor, angle), (150, 140, (0.5, 0, 0, 0))], sigma=1e-4)
    found = SourceFinder().find(cube)
    assert len(found) == 2
    wide = int(np.argmax(found.major_rad))
    due = major * minor / (BEAM[0] * BEAM[1])
    assert abs(found.stokes_jy[0, wide, 0] / due - 1) < 0.005
    assert found.major_rad[1 - wide] == 0 and abs(found.stokes_jy[0, 1 - wide, 0] / 0.5 - 1) < 0.002

    def spread(a, b, turn):
        c, s = np.cos(turn), np.sin(turn)
        turned = np.array([[c, -s], [s, c]])
        return turned @ np.diag([a**2, b**2]) @ turned.T

    own = spread(major, minor, angle) - spread(*BEAM)
    mine = spread(found.major_rad[wide], found.minor_rad[wide], found.angle_rad[wide])
    assert np.abs(mine - own).max() < 0.02 * np.abs(own).max()


def test_two_sources_on_one_island_are_told_apart():
    sources = [(100, 100, (1, 0, 0, 0)), (107.5, 101, (0.4, 0.2, 0, 0))]
    cube = field(sources, sigma=1e-4)
    found = SourceFinder().find(cube)
    beside = found.against(truth(cube, sources), 20 * u.arcsec)
    assert len(found) == 2 and beside.completeness == 1 and found.island[0] == found.island[1]
    assert np.abs(found.stokes_jy[0, beside.match] - [s[2] for s in sources]).max() < 2e-3


def test_each_channel_has_its_own_fluxes_and_a_channel_or_stokes_without_data_is_nan():
    cube = field([(100, 100, (1, 0.5, 0, 0))], channels=3, sigma=1e-4)
    data = cube.data.copy()
    data[1], data[2, 3] = np.nan, np.nan
    data[2, :3] *= 2
    found = SourceFinder().find(cube.with_data(data))
    assert np.isnan(found.stokes_jy[1]).all() and np.isnan(found.stokes_jy[2, :, 3]).all()
    assert np.abs(found.stokes_jy[0, 0] - [1, 0.5, 0, 0]).max() < 1e-3
    assert np.abs(found.stokes_jy[2, 0, :3] - [2, 1, 0]).max() < 1e-3
    one = SourceFinder().find(cube, channel=2)
    assert one.stokes_jy.shape == (1, 1, 4) and abs(one.stokes_jy[0, 0, 0] - 1) < 1e-3


def test_noise_alone_and_no_data_give_an_empty_catalogue_or_a_reason():
    found = SourceFinder(threshold=6).find(field([]))
    assert len(found) == 0 and len(found.table()) == 0
    cube = field([])
    with pytest.raises(InputError, match="no channel of this cube has data"):
        SourceFinder().find(cube.flagged([0]))
    with pytest.raises(InputError, match="no source was found"):
        found.sky()
    with pytest.raises(InputError, match="PSF"):
        SourceFinder().find(cube.with_psf(None))
    with pytest.raises(InputError, match="must not be"):
        SourceFinder(island=6)
    narrow = Psf.gaussian([60, 80] * u.arcsec)
    with pytest.raises(InputError, match="at_common_beam"):
        SourceFinder().find(field([], channels=2).with_psf(narrow))


def test_polarization_without_stokes_i_and_blank_rims_make_no_source():
    cube = field([(100, 100, (0, 1, 0, 0)), (60, 60, (0.5, 0, 0, 0))])
    data = cube.data.copy()
    data[..., :20, :] = np.nan
    found = SourceFinder().find(cube.with_data(data))
    assert len(found) == 1 and abs(found.stokes_jy[0, 0, 0] - 0.5) < 0.005


def test_a_catalogue_is_written_as_ecsv_fits_and_bbs_text(tmp_path):
    cube = field([(100, 100, (1, 0.1, 0, 0)), (60, 60, (0.5, 0, 0, 0), 2 * BEAM[0], BEAM[0], 0.3)], sigma=1e-4)
    found = SourceFinder().find(cube)
    for name in ("a.ecsv", "a.fits", "a.skymodel"):
        found.write(tmp_path / name)
        with pytest.raises(InputError, match="exists"):
            found.write(tmp_path / name)
    for name in ("a.ecsv", "a.fits"):
        table = QTable.read(tmp_path / name)
        assert np.array_equal(table["I"].to_value("Jy"), found.stokes_jy[0, :, 0]) and table["ra"].unit == u.deg
    back = PointSky.read(tmp_path / "a.skymodel", centre=CENTRE.skycoord)
    assert np.allclose(back.stokes_jy, found.stokes_jy[0], rtol=1e-12, atol=0)
    assert np.allclose(back.major_rad, found.major_rad, rtol=1e-9) and back.names == found.names
    with pytest.raises(InputError, match=r"ends in "):
        found.write(tmp_path / "a.xyz")


def test_an_island_that_takes_too_long_is_said():
    cube = field([(100, 100, (1, 0, 0, 0)), (107.5, 101, (0.4, 0.2, 0, 0))], sigma=1e-4)
    with pytest.warns(InstrumentWarning, match="not fitted within 1e-09 s"):
        found = SourceFinder(seconds=1e-9 * u.s).find(cube)
    assert not found.fitted.any()


def test_a_faint_source_beside_one_of_1e8_times_the_noise_is_found_and_both_are_right():
    sources = [(40.3, 50.2, (1e5, 0, 0, 0)), (130.4, 120.7, (0.1, 0, 0, 0))]
    cube = field(sources)
    found = SourceFinder().find(cube)
    beside = found.against(truth(cube, sources), 10 * u.arcsec)
    assert beside.completeness == 1 and len(found) == 2
    assert abs(found.stokes_jy[0, 0, 0] - 1e5) < 0.1 and abs(found.stokes_jy[0, 1, 0] - 0.1) < 0.01
