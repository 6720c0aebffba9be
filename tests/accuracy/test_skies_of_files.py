"""Images and HEALPix maps of files as skies: the right place, flux and angle of polarization, against closed forms."""

import numpy as np
import pytest
from astropy import units as u
from astropy.coordinates import SkyCoord
from astropy.io import fits

import instrument
from instrument import (
    ImageGrid,
    ImageSky,
    InputError,
    InstrumentError,
    Observation,
    Psf,
    Scene,
    StokesCube,
    conformance,
)
from instrument.observe.directions import tangents
from instrument.pipeline.scene_file import parse
from instrument.sky.healpix import on_grid
from instrument.sky.reproject import angle_of, reprojected, solid_angles
from instrument.units import Direction, unit_vectors

AT = Direction(2.15, 0.84)


def waves(vectors, seed):
    """A sum of six plane waves of 12 deg on unit vectors (S, 3)."""
    rng = np.random.default_rng(seed)
    k = rng.normal(size=(6, 3))
    k *= 30 / np.linalg.norm(k, axis=1)[:, None]
    return np.cos(vectors @ k.T + np.arange(6)) @ rng.normal(size=6)


def stokes(vectors, east, north):
    """I, Q, U, V (4, S) of a field that is smooth on the sphere, in the basis given: Q and U of a tensor."""
    tensor = np.random.default_rng(7).normal(size=(3, 3))
    ee, nn, en = (
        np.einsum("si,ij,sj->s", a, tensor + tensor.T, b) for a, b in ((east, east), (north, north), (east, north))
    )
    amplitude = 2 + waves(vectors, 3)
    return np.stack([waves(vectors, 1), amplitude * (nn - ee) / 2, amplitude * en, waves(vectors, 2)])


def on(grid):
    """The field on a grid, per sr (4, Ny, Nx)."""
    ra, dec = grid.directions()
    return stokes(unit_vectors(ra, dec), *tangents(ra, dec)).reshape(4, *grid.pixels)


# Reprojection ----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("dec", [48.0, 89.5, -89.99])
def test_a_smooth_polarized_image_is_the_same_on_another_grid(dec):
    """Odd and even sides, another pixel, next to a pole where local north turns by a circle: 1e-7 of the peak."""
    first = ImageGrid(pixels=(180, 171), pixel=4 * u.arcmin, centre=Direction(2.0, np.deg2rad(dec)))
    second = ImageGrid(
        pixels=(81, 80), pixel=3 * u.arcmin, centre=Direction(2.03, np.deg2rad(dec) - 0.015 * np.sign(dec))
    )
    found = reprojected(ImageSky(grid=first, stokes=(on(first) * solid_angles(first))[None]), second)
    due = on(second)
    error = np.abs(found.stokes[0] / solid_angles(second) - due).max() / np.abs(due).max()
    assert error < 1e-6
    said = float(dict(found.remarks)["reprojection"].split("within ")[1].split(" of")[0])
    assert error < said < 1e-4
    unturned = ImageSky(grid=first, stokes=np.abs(first.pixel**2 * on(first))[None])
    assert np.abs(reprojected(unturned, second).stokes[0] / solid_angles(second) - due).max() > 0.1  # the test can fail


def test_flux_is_kept_where_all_of_it_is_seen_and_what_lies_beyond_is_zero():
    """A Gaussian of 40' in an image of 4', 10 deg from the centre: 1/n there is 1.5 %."""
    first = ImageGrid(pixels=(128, 128), pixel=4 * u.arcmin, centre=AT)
    l, m = np.meshgrid(first.east, first.north)
    blob = np.exp(-((l - 0.02) ** 2 + m**2) / (2 * np.deg2rad(17 / 60) ** 2))
    stokes = np.zeros((1, 4, 128, 128))
    stokes[0, 0] = blob / blob.sum()
    sky = ImageSky(grid=first, stokes=stokes)
    far = ImageGrid(pixels=(300, 300), pixel=5 * u.arcmin, centre=Direction(AT.ra_rad + 0.2, AT.dec_rad + 0.05))
    found = reprojected(sky, far)
    assert found.stokes[0, 0].sum() == pytest.approx(1, abs=1e-6)
    middle = (found.stokes[0, 0].reshape(-1)[:, None] * unit_vectors(*far.directions())).sum(axis=0)
    due = (blob.reshape(-1)[:, None] * unit_vectors(*first.directions())).sum(axis=0)
    assert np.linalg.norm(middle / np.linalg.norm(middle) - due / np.linalg.norm(due)) < 1e-7
    away = reprojected(sky, ImageGrid(pixels=32, pixel=4 * u.arcmin, centre=Direction(AT.ra_rad + 3, -AT.dec_rad)))
    assert not away.stokes.any()


def test_an_image_whose_pixels_do_not_resolve_it_is_said_to_be_so():
    stokes = np.zeros((1, 4, 32, 32))
    stokes[0, 0, 16, 16] = 1
    grid = ImageGrid(pixels=32, pixel=4 * u.arcmin, centre=AT)
    near = grid.with_fields(centre=Direction(AT.ra_rad + 6e-4, AT.dec_rad))
    moved = reprojected(ImageSky(grid=grid, stokes=stokes), near)
    assert "its pixels do not resolve it: take reproject = false" in dict(moved.remarks)["reprojection"]
    with pytest.raises(InputError, match="needs the centres of both grids"):
        reprojected(ImageSky(grid=grid, stokes=stokes), ImageGrid(pixels=32, pixel=4 * u.arcmin))


# HEALPix ---------------------------------------------------------------------------------------------------------


def healpix_map(nside, frame, convention, nested=False):
    """The field as a map (4, Npix) in a frame, by astropy: its north is found by a step of 0.01 arcsec."""
    pixels = pytest.importorskip("astropy_healpix").HEALPix(
        nside=nside, order="nested" if nested else "ring", frame=frame
    )
    where = pixels.healpix_to_skycoord(np.arange(pixels.npix))
    xyz = np.asarray(where.icrs.cartesian.xyz.value.T)
    lon, lat = where.spherical.lon, where.spherical.lat
    east, north = tangents(lon.rad, lat.rad)
    step = SkyCoord([0, 90, 0] * u.deg, [0, 0, 90] * u.deg, frame=where.frame.replicate_without_data())
    axes = np.asarray(step.icrs.cartesian.xyz.value.T)
    found = stokes(xyz, east @ axes, north @ axes)
    found[2] *= -1 if convention == "COSMO" else 1
    return found


@pytest.mark.parametrize(
    ("frame", "convention"), [("galactic", "COSMO"), pytest.param("icrs", "IAU", marks=pytest.mark.long)]
)
def test_a_map_has_its_polarization_relative_to_icrs_north_in_iau(frame, convention):
    """At nside 128 what lies between pixels of 27' for waves of 12 deg is 4e-3; it falls as their square."""
    grid = ImageGrid(pixels=(40, 31), pixel=15 * u.arcmin, centre=AT)
    due, errors = on(grid), []
    for nside in (64, 128):
        maps = healpix_map(nside, frame, convention)
        found, said = on_grid(maps, grid, False, frame, convention)
        errors.append(np.sqrt(np.mean((found - due) ** 2) / np.mean(due**2)))
        assert errors[-1] < said < 3 * errors[-1]
    assert errors[1] < 5e-3 and errors[0] / errors[1] == pytest.approx(4, rel=0.15)
    nested, same = on_grid(healpix_map(128, frame, convention, nested=True), grid, True, frame, convention)
    assert np.array_equal(nested, found) and same == said
    other = "icrs" if frame == "galactic" else "galactic"
    assert np.abs(on_grid(maps, grid, False, other, convention)[0] - due).max() > 0.1
    wrong = "IAU" if convention == "COSMO" else "COSMO"
    assert np.abs(on_grid(maps, grid, False, frame, wrong)[0][2] - due[2]).max() > 0.1


def test_the_angle_between_norths_is_that_of_astropy():
    """ICRS to galactic at 50 places: position angle of the galactic pole by SkyCoord."""
    rng = np.random.default_rng(2)
    ra, dec = rng.uniform(0, 2 * np.pi, 50), rng.uniform(-1.5, 1.5, 50)
    pole = SkyCoord(0 * u.deg, 90 * u.deg, frame="galactic").icrs
    due = SkyCoord(ra * u.rad, dec * u.rad).position_angle(pole).rad
    found = angle_of(np.asarray(pole.cartesian.xyz.value), ra, dec)
    assert np.abs(np.exp(1j * found) - np.exp(1j * due)).max() < 1e-12


# Files -----------------------------------------------------------------------------------------------------------

TABLES = {
    "name": "files",
    "instrument": {"telescope": "lofar-hba", "stations": ["CS001HBA0", "CS003HBA1", "CS302HBA1"]},
    "observation": {"phase_centre": AT, "transit": "2012-12-07", "duration": "1 h", "interval": "30 min",
                    "frequencies": ["150 MHz", "151 MHz"], "channel_width": "0.2 MHz"},
}  # fmt: skip


def scene(**sky):
    return parse({**TABLES, "sky": sky}).scene()


def cube(unit="K", centre=AT, **settings):
    grid = ImageGrid(pixels=(20, 20), pixel=8 * u.arcmin, centre=centre)
    data = np.stack([on(grid), 1.1 * on(grid)]).astype(np.float32)
    return StokesCube(data, [150, 151] * u.MHz, 8 * u.arcmin, unit, centre, **settings)


def test_a_cube_of_a_file_about_the_phase_centre_is_taken_pixel_by_pixel(tmp_path):
    made = cube()
    made.write(tmp_path / "cube.fits")
    plan = scene(kind="image", file=str(tmp_path / "cube.fits")).plan()
    np.testing.assert_allclose(plan.full.sky.stokes, made.sky().stokes, rtol=1e-6)
    assert not [i for i in plan.not_modelled if i.name == "reprojection"]
    assert plan.verify().passed
    made.channels([0]).write(tmp_path / "one.fits")
    one = instrument.load("skies", "image", file=str(tmp_path / "one.fits"), temperature_index=-2.5, reproject=False)
    conformance.check(one).raise_if_failed()


def test_a_cube_elsewhere_is_brought_to_the_phase_centre_or_left_where_it_is(tmp_path):
    there = Direction(AT.ra_rad + 0.01, AT.dec_rad - 0.004)
    cube(centre=there).write(tmp_path / "cube.fits")
    name = str(tmp_path / "cube.fits")
    plan = scene(kind="image", file=name, pixels=12).plan()
    assert plan.full.sky.grid == ImageGrid(pixels=12, pixel=8 * u.arcmin, centre=AT)
    assert "splines of 20 x 20 pixels" in {i.name: i.reason for i in plan.not_modelled}["reprojection"]
    left = scene(kind="image", file=name, reproject=False).plan().full.sky
    assert left.grid.centre.ra_rad == pytest.approx(there.ra_rad, abs=1e-9) and left.stokes.shape[2:] == (20, 20)
    with pytest.raises(InputError, match="pixels is that of another grid, and reproject = false"):
        scene(kind="image", file=name, reproject=False, pixels=12)


def test_units_channels_blanks_and_indices_of_an_image_are_right_or_refused(tmp_path):
    name = str(tmp_path / "cube.fits")
    blurred = cube("Jy/beam", psf=Psf.gaussian(20 * u.arcmin))
    blurred.write(name)
    plan = scene(kind="image", file=name).plan()
    beam = np.pi / 4 / np.log(2) * np.deg2rad(20 / 60) ** 2
    np.testing.assert_allclose(
        plan.full.sky.stokes, blurred.data * np.deg2rad(8 / 60) ** 2 / beam, rtol=1e-5, atol=1e-9
    )
    assert "blurred already, by a beam of 20' to 20'" in {i.name: i.reason for i in plan.not_modelled}["image"]
    cube("Jy/beam").write(name, overwrite=True)
    with pytest.raises(InputError, match="by what beam is not known"):
        scene(kind="image", file=name).plan()
    cube().channels([0]).write(name, overwrite=True)
    with pytest.raises(InputError, match="no channel at 151 MHz"):
        scene(kind="image", file=name).plan()
    one = scene(kind="image", file=name, temperature_index=-2.5).plan().full.sky
    ratio = one.planes(np.array([75e6])) / one.planes(np.array([150e6]))
    np.testing.assert_allclose(ratio[one.planes(np.array([150e6])) != 0], 0.5**-0.5, rtol=1e-12)
    holes = np.array(cube().data)
    holes[:, :, :2] = np.nan
    holes[:, 3] = np.nan
    cube().with_data(holes).write(name, overwrite=True)
    with pytest.raises(InputError, match=r"240 pixels have no data, first pixel .* give blanks = 'zero'"):
        scene(kind="image", file=name).plan()
    dark = scene(kind="image", file=name, blanks="zero").plan().full.sky
    assert not dark.stokes[:, 3].any() and not dark.stokes[:, :, :2].any() and dark.count == 360


def healpix_file(path, maps, **header):
    columns = [fits.Column(name=n, format="D", array=a) for n, a in zip(("I", "Q", "U"), maps, strict=False)]
    table = fits.BinTableHDU.from_columns(columns)
    table.header.update({"NSIDE": round((maps.shape[1] / 12) ** 0.5), "ORDERING": "RING", **header})
    table.writeto(path, overwrite=True)
    return str(path)


def test_a_healpix_file_is_a_sky_with_the_flux_of_its_kelvin(tmp_path):
    maps = healpix_map(64, "galactic", "COSMO")[:3]
    name = healpix_file(tmp_path / "map.fits", maps, COORDSYS="G", TUNIT1="mK", FREQ=408.0, FREQUNIT="MHz")
    sky = scene(kind="healpix", file=name, pixels=16, pixel="30 arcmin", temperature_index=-2.55)
    plan = sky.plan()
    grid = plan.full.sky.grid
    due = on_grid(maps, grid, False, "galactic", "COSMO")[0] * 1e-3 * solid_angles(grid)
    due *= 2 * 1.380649e-23 * 408e6**2 / 299792458.0**2 * 1e26
    np.testing.assert_allclose(plan.full.sky.planes(np.array([408e6]))[0], due, rtol=1e-12)
    np.testing.assert_allclose(plan.full.sky.planes(np.array([204e6]))[0], due * 0.5**-0.55, rtol=1e-12)
    assert "nside 64, galactic, COSMO" in {i.name: i.reason for i in plan.not_modelled}["HEALPix"]
    conformance.check(sky.sky.with_fields(pixels=4, frequency=150 * u.MHz)).raise_if_failed()


@pytest.mark.parametrize(
    ("header", "given", "said"),
    [
        ({}, {}, "COORDSYS = '' is not one of .*give coordinates = 'galactic' or 'icrs'"),
        ({"COORDSYS": "E"}, {}, "COORDSYS = 'E'"),
        ({"COORDSYS": "C", "ORDERING": "CUBE"}, {}, "ORDERING = 'CUBE'"),
        ({"COORDSYS": "C", "TUNIT1": "m"}, {}, "the unit 'm' is not K"),
        ({"COORDSYS": "C", "TUNIT1": "K", "NSIDE": 3}, {}, "NSIDE = 3"),
        ({"COORDSYS": "C", "TUNIT1": "K", "NSIDE": 4}, {}, "column I has 48 pixels, due 192"),
        ({"COORDSYS": "C", "TUNIT1": "K"}, {"frequency": None}, "tells no frequency: give frequency"),
        ({"COORDSYS": "C", "TUNIT1": "K"}, {"hdu": 5}, "unit 5 is no table"),
        ({"COORDSYS": "C", "TUNIT1": "K"}, {"pixels": 900, "pixel": "1 deg"}, "beyond the sky"),
    ],
)
def test_a_healpix_file_that_does_not_say_what_it_is_is_refused(tmp_path, header, given, said):
    pytest.importorskip("astropy_healpix")
    name = healpix_file(tmp_path / "map.fits", np.ones((3, 48)), **header)
    settings = {"frequency": "150 MHz", "temperature_index": 0.0, "pixels": 8, **given}
    settings = {key: value for key, value in settings.items() if value is not None}
    with pytest.raises(InstrumentError, match=said) as error:
        scene(kind="healpix", file=name, **settings).plan()
    assert "\n" not in str(error.value)


def test_a_map_of_part_of_the_sky_is_taken_within_it_and_refused_beyond(tmp_path):
    maps = healpix_map(64, "icrs", "IAU")[:3]
    pixels = pytest.importorskip("astropy_healpix").HEALPix(nside=64, order="ring", frame="icrs")
    part = np.flatnonzero(pixels.healpix_to_skycoord(np.arange(pixels.npix)).separation(AT.skycoord) < 6 * u.deg)
    columns = [fits.Column(name="PIXEL", format="J", array=part)]
    columns += [fits.Column(name=n, format="D", array=a[part]) for n, a in zip("IQU", maps, strict=True)]
    table = fits.BinTableHDU.from_columns(columns)
    table.header.update(
        {"NSIDE": 64, "ORDERING": "RING", "INDXSCHM": "EXPLICIT", "COORDSYS": "C", "POLCCONV": "IAU", "TUNIT1": "K"}
    )
    table.writeto(tmp_path / "part.fits")
    given = {"kind": "healpix", "file": str(tmp_path / "part.fits"), "frequency": "150 MHz", "temperature_index": 0.0}
    sky = scene(**given, pixels=10, pixel="30 arcmin").plan().full.sky
    whole = on_grid(maps, sky.grid, False, "icrs", "IAU")[0] * solid_angles(sky.grid)
    per_k = 2 * 1.380649e-23 * 150e6**2 / 299792458.0**2 * 1e26
    np.testing.assert_allclose(sky.planes(np.array([150e6]))[0], per_k * whole, rtol=1e-9)
    with pytest.raises(InputError, match="of the map has no data: the field leaves the map"):
        scene(**given, pixels=40, pixel="30 arcmin").plan()


def test_observed_visibilities_of_a_reprojected_image_are_those_of_the_image(tmp_path):
    """A blob of 30' brought to another centre against its own pixels, by direct sums, LOFAR's beams in both."""
    there = Direction(AT.ra_rad + 0.006, AT.dec_rad - 0.003)
    grid = ImageGrid(pixels=(48, 48), pixel=6 * u.arcmin, centre=there)
    l, m = np.meshgrid(grid.east, grid.north)
    blob = np.exp(-(l**2 + m**2) / (2 * np.deg2rad(13 / 60) ** 2))
    stokes = (blob * np.array([1, 0.3, -0.2, 0.1])[:, None, None])[None]
    sky = ImageSky(grid=grid, stokes=stokes)
    night = Observation(
        phase_centre=AT, transit="2012-12-07", duration=1 * u.hour, interval=30 * u.min, frequencies=[150] * u.MHz
    )
    lofar = instrument.load("telescopes", "lofar-hba", stations=["CS001HBA0", "CS002HBA1", "CS003HBA0"])
    own = Scene(instrument=lofar, sky=sky, observation=night).plan().run()
    moved = reprojected(sky, ImageGrid(pixels=(64, 64), pixel=6 * u.arcmin, centre=AT))
    found = Scene(instrument=lofar, sky=moved, observation=night).plan().run()
    assert np.abs(found.data - own.data).max() < 1e-5 * np.abs(own.data).max()
