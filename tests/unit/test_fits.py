"""Cubes of other programs: axes in any order, units, beams, Stokes parameters, several files, broken files."""

import itertools
import tracemalloc
import warnings

import numpy as np
import pytest
from astropy import units as u
from astropy.io import fits
from astropy.wcs import WCS

from instrument import Analyzer, InputError, read_cube
from instrument.errors import FileError, InstrumentWarning
from instrument.observe.directions import lmn

F, NY, NX = 3, 6, 8
DATA = np.random.default_rng(0).normal(size=(F, 4, NY, NX)).astype(np.float32)
MHZ = 134 + 0.2 * np.arange(F)
AXES = {
    "RA": {"CTYPE": "RA---SIN", "CRVAL": 123.4, "CDELT": -0.5 / 60, "CRPIX": NX // 2 + 1.0, "CUNIT": "deg"},
    "DEC": {"CTYPE": "DEC--SIN", "CRVAL": 48.2, "CDELT": 0.5 / 60, "CRPIX": NY // 2 + 1.0, "CUNIT": "deg"},
    "FREQ": {"CTYPE": "FREQ", "CRVAL": 134e6, "CDELT": 2e5, "CRPIX": 1.0, "CUNIT": "Hz"},
    "STOKES": {"CTYPE": "STOKES", "CRVAL": 1.0, "CDELT": 1.0, "CRPIX": 1.0},
}
USUAL = ("RA", "DEC", "FREQ", "STOKES")


def written(path, data=DATA, order=USUAL, tables=(), **cards):
    """A FITS file of data (F, 4, Ny, Nx) with its axes in some order (first is fastest); None takes a card away."""
    kept = [k for k, name in enumerate(("FREQ", "STOKES", "DEC", "RA")) if name in order]
    array = data.reshape([data.shape[k] for k in kept])
    here = [("FREQ", "STOKES", "DEC", "RA")[k] for k in kept]
    array = np.transpose(array, [here.index(name) for name in reversed(order)])
    hdu = fits.PrimaryHDU(np.ascontiguousarray(array))
    for axis, name in enumerate(order, 1):
        hdu.header.update({f"{key}{axis}": value for key, value in AXES[name].items()})
    for key, value in {"BUNIT": "K", **cards}.items():
        if value is None:
            hdu.header.remove(key, ignore_missing=True)
        else:
            hdu.header[key] = value
    fits.HDUList([hdu, *tables]).writeto(path)
    return path


def refused(error, said, *paths, **given):
    with pytest.raises(error, match=said) as caught:
        read_cube(*paths, **given)
    assert "\n" not in str(caught.value)
    assert len(str(caught.value)) < 250


@pytest.fixture
def path(tmp_path):
    return tmp_path / "a.fits"


# Axes ------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("order", list(itertools.permutations(USUAL)), ids="-".join)
def test_four_axes_in_any_order_are_one_cube(path, order):
    cube = read_cube(written(path, order=order))
    assert np.array_equal(cube.data, DATA)
    assert cube.data.dtype == np.float32
    assert cube.data.dtype.isnative
    assert cube.data.flags.writeable
    assert cube.freq_hz / 1e6 == pytest.approx(MHZ, rel=1e-12)
    assert np.rad2deg(cube.pixel_rad) * 60 == pytest.approx(0.5, rel=1e-12)
    assert np.rad2deg(cube.centre) == pytest.approx([123.4, 48.2], rel=1e-12)
    assert cube.unit == "K"
    assert cube.psf is None


@pytest.mark.parametrize("order", list(itertools.permutations(("RA", "DEC", "FREQ"))), ids="-".join)
def test_three_axes_in_any_order_need_the_name_of_the_stokes_parameter(path, order):
    written(path, DATA[:, 1:2], order)
    refused(FileError, "a.fits: no axis is STOKES: say what it is, such as stokes='I'", path)
    cube = read_cube(path, stokes="Q")
    assert np.array_equal(cube.data[:, 1], DATA[:, 1])
    assert np.isnan(cube.data[:, [0, 2, 3]]).all()


def test_one_channel_is_a_cube_and_so_is_a_bare_image_with_its_frequency(path, tmp_path):
    one = read_cube(written(path, DATA[:1], CDELT3=0.0))
    assert one.freq_hz.tolist() == [134e6]
    flat = written(tmp_path / "b.fits", DATA[:1, :1], ("DEC", "RA"))
    refused(FileError, "b.fits: no axis is FREQ: give frequencies=", flat)
    cube = read_cube(flat, stokes="I", frequencies=[150] * u.MHz)
    assert np.array_equal(cube.data[0, 0], DATA[0, 0])
    assert cube.freq_hz.tolist() == [150e6]


@pytest.mark.parametrize(
    ("unit", "factor"), [("Hz", 1), ("kHz", 1e-3), ("MHz", 1e-6), ("GHz", 1e-9), ("MHZ", 1e-6), (None, 1)]
)
def test_frequencies_are_read_in_their_unit_and_from_their_reference_channel(path, unit, factor):
    cards = {"CUNIT3": unit, "CRVAL3": 134.4e6 * factor, "CDELT3": -2e5 * factor, "CRPIX3": 2.0}
    assert read_cube(written(path, **cards)).freq_hz / 1e6 == pytest.approx([134.6, 134.4, 134.2], rel=1e-12)


@pytest.mark.parametrize(
    ("cards", "said"),
    [
        ({"CTYPE3": "VRAD"}, "axis 3 is VRAD, a radio velocity, not FREQ: regrid to frequency, or give frequencies="),
        ({"CTYPE3": "VOPT-F2W"}, "axis 3 is VOPT-F2W, an optical velocity"),
        ({"CTYPE3": "VELO-LSR"}, "axis 3 is VELO-LSR, a velocity"),
        ({"CTYPE3": "WAVE"}, "axis 3 is WAVE, a wavelength"),
        ({"CTYPE3": "FREQ-LOG"}, "axis 3 is FREQ-LOG, which is not linear: give frequencies="),
        ({"CTYPE3": "FDEP"}, "axis 3 .CTYPE3. is 'FDEP': needed RA, DEC, FREQ and STOKES"),
        ({"CTYPE3": None}, "axis 3 .CTYPE3. is without a name"),
        ({"CTYPE4": "FREQ"}, "axes 3 and 4 are both FREQ"),
        ({"CTYPE1": "GLON-SIN"}, "axis 1 .CTYPE1. is 'GLON-SIN'"),
        ({"CTYPE1": "STOKES", "CTYPE4": "FOO", "CTYPE2": "DEC--SIN"}, "axis 4 .CTYPE4. is 'FOO'"),
        ({"CUNIT3": "m/s"}, "CUNIT3 = 'm/s' is not Hz, kHz, MHz or GHz"),
        ({"CRVAL3": None}, "CRVAL3 is missing"),
        ({"CRVAL3": "high"}, "CRVAL3 = 'high' is not a number"),
        ({"CRVAL3": -1e6}, "axis 3 .FREQ. has -1e.06 Hz .CUNIT3 = .Hz.., not 1 MHz to 10 THz"),
        ({"CDELT3": 0.0}, "axis 3 has the step 0"),
        ({"CDELT2": 1 / 60}, "pixels are 0.5' x 1' .axes 1 and 2.: regrid to square ones"),
        ({"CROTA2": 12.0}, "CROTA2 = 12 deg: the image is turned"),
        ({"PC1_2": 0.1}, "PC1_2 = 0.1: axes 1 and 2 are turned"),
        ({"PC01_02": 0.1}, "PC01_02 = 0.1: axes 1 and 2 are turned"),
        ({"PC001002": 0.1}, "PC001002 = 0.1: axes 1 and 2 are turned"),
        ({"CD1_1": -1e-2, "CD2_2": 1e-2, "CD2_1": 1e-3}, "CD2_1 = 0.001: axes 2 and 1 are turned"),
        ({"CRPIX1": None}, "CRPIX1 is missing"),
        ({"CRPIX1": 1e9}, "the centre pixel is not on the sky"),
        ({"CRPIX1": 1000.0, "CRPIX2": 900.0}, "pixels lie up to .* from where a SIN projection"),
        ({"CRVAL2": 123.0}, "a.fits: "),
        ({"BUNIT": None}, "BUNIT is missing: give unit='Jy/beam', 'Jy/pixel' or 'K'"),
        ({"BUNIT": "MK"}, "BUNIT = 'MK' is not K"),
        ({"BUNIT": "MJY/BEAM"}, "BUNIT = 'MJY/BEAM' is not"),
        ({"BUNIT": "Jy/sr"}, "BUNIT = 'Jy/sr' is not"),
        ({"BMAJ": "3 arcmin"}, "BMAJ = '3 arcmin' is not a number"),
        ({"POLCCONV": "Stokes"}, "POLCCONV = 'STOKES' is neither IAU nor COSMO"),
        ({"CRVAL4": -5.0, "CDELT4": -1.0}, "axis 4 .STOKES. has XX: make I, Q, U, V of it"),
        ({"CRVAL4": 2.0}, "axis 4 .STOKES. has code 5"),
        ({"CDELT4": 0.5}, "axis 4 .STOKES. has code 1.5"),
    ],
)  # fmt: skip
def test_what_cannot_be_read_is_refused_with_its_axis_or_keyword(path, cards, said):
    refused(FileError, said, written(path, **cards))


def test_frequencies_given_stand_for_an_axis_of_velocities(path):
    written(path, CTYPE3="VRAD", CUNIT3="m/s")
    assert read_cube(path, frequencies=MHZ * u.MHz).freq_hz == pytest.approx(MHZ * 1e6)
    refused(InputError, "2 frequencies, but the files have 3 channels of I", path, frequencies=[1, 2] * u.MHz)
    refused(InputError, "frequencies needs a unit", path, frequencies=[1, 2, 3])


# The sky ---------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("size", [(6, 8), (7, 9)], ids=["even", "odd"])
@pytest.mark.parametrize("sign", [(1, 1), (1, -1), (-1, 1), (-1, -1)])
def test_pixels_lie_where_the_file_has_them_whichever_way_its_axes_run(path, size, sign):
    """Every pixel of the file is looked for at its own place on the sky, with a reference pixel off the centre."""
    data = np.random.default_rng(3).normal(size=(1, 4, *size)).astype(np.float32)
    cards = {"CDELT1": sign[0] * 0.5 / 60, "CDELT2": sign[1] * 0.5 / 60, "CRPIX1": 3.25, "CRPIX2": 6.0}
    cube = read_cube(written(path, data, **cards))
    y, x = np.mgrid[: size[0], : size[1]]
    sky = WCS(fits.getheader(path)).celestial.pixel_to_world(x, y).icrs
    ra, dec = sky.ra.rad.ravel(), sky.dec.rad.ravel()
    vectors = np.stack([np.cos(dec) * np.cos(ra), np.cos(dec) * np.sin(ra), np.sin(dec)], axis=-1)
    l, m, _ = lmn(vectors, cube.centre).T / cube.pixel_rad
    column, row = size[1] // 2 - l, size[0] // 2 + m
    # a reference pixel 5 pixels away turns the grid by 1e-3 of a pixel
    assert np.abs(column - column.round()).max() < 5e-3
    assert np.abs(row - row.round()).max() < 5e-3
    found = cube.data[0, 1, row.round().astype(int), column.round().astype(int)]
    assert np.array_equal(found, data[0, 1].ravel())


def test_other_projections_and_frames_are_read_and_a_warning_says_how_far_off_they_are(path, tmp_path):
    wide = np.zeros((1, 4, 400, 400), np.float32)
    cards = {"CRPIX1": 201.0, "CRPIX2": 201.0}
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        read_cube(written(path, **{"CTYPE1": "RA---TAN", "CTYPE2": "DEC--TAN"}))
        fk4 = {"RADESYS": "FK4", "EQUINOX": 1950.0}
        old = read_cube(written(tmp_path / "fk4.fits", **fk4)).centre
    assert np.rad2deg(old)[0] - 123.4 > 0.5  # precession over 50 years
    tan = {"CTYPE1": "RA---TAN", "CTYPE2": "DEC--TAN", "CDELT1": -1 / 60, "CDELT2": 1 / 60}
    # 4.7 deg from the centre tan and sin differ by theta³/2, 0.94' in each of x and y at the corner
    with pytest.warns(InstrumentWarning, match="pixels lie up to 0.9[0-9]* pixels from where a SIN projection"):
        read_cube(written(tmp_path / "tan.fits", wide, **tan, **cards))
    with pytest.warns(InstrumentWarning, match="CTYPE1 = 'RA' names no projection: taken as SIN"):
        bare = read_cube(written(tmp_path / "bare.fits", CTYPE1="RA", CTYPE2="DEC"))
    assert np.rad2deg(bare.centre) == pytest.approx([123.4, 48.2], rel=1e-12)


def test_a_rotation_matrix_of_nothing_and_cd_are_read(path, tmp_path):
    assert read_cube(written(path, PC1_1=1.0, PC1_2=0.0, PC3_3=2.0)).freq_hz[1] == pytest.approx(134.4e6)
    assert read_cube(written(tmp_path / "casa.fits", PC01_01=1.0, PC03_03=2.0)).freq_hz[1] == pytest.approx(134.4e6)
    cd = {"CDELT1": None, "CDELT2": None, "CD1_1": -0.01, "CD2_2": 0.01, "CD1_2": 0.0}
    cube = read_cube(written(tmp_path / "cd.fits", **cd))
    assert np.rad2deg(cube.pixel_rad) == pytest.approx(0.01)
    assert cube.freq_hz[1] == pytest.approx(134.2e6)


# Units and beams -------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("text", "unit", "factor"),
    [
        ("K", "K", 1), ("mK", "K", 1e-3), ("uK", "K", 1e-6), ("Kelvin", "K", 1), ("Jy/beam", "Jy/beam", 1),
        ("JY/BEAM", "Jy/beam", 1), ("mJy/beam", "Jy/beam", 1e-3), ("uJy/beam", "Jy/beam", 1e-6),
        ("Jy beam-1", "Jy/beam", 1), ("beam-1 Jy", "Jy/beam", 1), ("Jy.beam^-1", "Jy/beam", 1),
        ("Jy/pixel", "Jy/pixel", 1), ("JY/PIXEL", "Jy/pixel", 1), ("Jy/pix", "Jy/pixel", 1),
        ("mJy pixel-1", "Jy/pixel", 1e-3), (" Jy / beam ", "Jy/beam", 1), ("Jy per beam", "Jy/beam", 1),
    ],
)  # fmt: skip
def test_units_as_programs_write_them(path, text, unit, factor):
    cube = read_cube(written(path, BUNIT=text))
    assert cube.unit == unit
    assert cube.data == pytest.approx(DATA * factor, rel=1e-6)


def test_a_unit_given_stands_for_that_of_the_header(path, tmp_path):
    cube = read_cube(written(path, BUNIT=None), unit="Jy/pixel")
    assert cube.unit == "Jy/pixel"
    assert np.array_equal(read_cube(written(tmp_path / "b.fits", BUNIT="mK"), unit="K").data, DATA)
    refused(InputError, "unit = 'mK' is not one of 'Jy/beam', 'Jy/pixel', 'K'", path, unit="mK")


def test_the_beam_of_the_header_is_that_of_every_channel(path):
    cube = read_cube(written(path, BUNIT="Jy/beam", BMAJ=0.05, BMIN=0.04, BPA=30.0))
    assert np.rad2deg(cube.psf.major_rad) == pytest.approx([0.05] * F)
    assert np.rad2deg(cube.psf.minor_rad) == pytest.approx([0.04] * F)
    assert np.rad2deg(cube.psf.angle_rad) == pytest.approx([30] * F)
    assert cube.psf.data is None
    # 3.0' x 2.4' at 134 MHz: 1.222e6 / (GHz² arcsec²)
    assert cube.to_kelvin().data[0, 0, 0, 0] / DATA[0, 0, 0, 0] == pytest.approx(1.222e6 / 0.134**2 / 25920, rel=1e-4)


def test_a_beam_of_width_0_is_read_but_gives_no_kelvin(path):
    cube = read_cube(written(path, BUNIT="Jy/beam", BMAJ=0.0, BMIN=0.0, BPA=0.0))
    with pytest.raises(InputError, match=r"solid angle of the PSF in channels 0, 1, 2 is 0, 0, 0 sr"):
        cube.to_kelvin()


def beams(rows, unit="arcsec"):
    """A table as CASA writes it: a row for each channel and Stokes parameter."""
    names = ("BMAJ", "BMIN", "BPA", "CHAN", "POL")
    units = (unit, unit, "deg", None, None)
    formats = ("E", "E", "E", "J", "J")
    columns = [
        fits.Column(n, f, w, array=[row[k] for row in rows])
        for k, (n, f, w) in enumerate(zip(names, formats, units, strict=True))
    ]
    return fits.BinTableHDU.from_columns(columns, name="BEAMS")


def test_the_table_of_beams_of_casa_is_read_whatever_the_order_of_its_rows(path, tmp_path):
    rows = [(180 + 10 * c + p, 120, 15, c, p) for p in (1, 0) for c in (2, 0, 1)]
    cube = read_cube(written(path, BUNIT="Jy/beam", CASAMBM=True, tables=[beams(rows)], BMAJ=9.0, BMIN=9.0))
    assert np.rad2deg(cube.psf.major_rad) * 3600 == pytest.approx([180, 190, 200], rel=1e-6)
    assert np.rad2deg(cube.psf.minor_rad) * 3600 == pytest.approx([120] * 3, rel=1e-6)
    assert np.rad2deg(cube.psf.angle_rad) == pytest.approx([15] * 3, rel=1e-6)
    short = written(tmp_path / "b.fits", tables=[beams(rows[:2])])
    refused(FileError, "b.fits: the table BEAMS has 2 beams, the axis FREQ 3 channels", short)
    odd = written(tmp_path / "c.fits", tables=[beams(rows, "Jy")])
    refused(FileError, "c.fits: the table BEAMS has the unit 'Jy': needed deg, arcsec or rad", odd)


# Stokes parameters and files -------------------------------------------------------------------------------------


def of_stokes(folder, names="IQUV", data=DATA, **cards):
    return [
        written(folder / f"{name}{cards.get('CRVAL3', '')}.fits", data[:, k : k + 1], CRVAL4=k + 1.0, **cards)
        for k, name in enumerate("IQUV")
        if name in names
    ]


def test_files_of_one_stokes_parameter_each_are_put_together_in_any_order(tmp_path):
    files = of_stokes(tmp_path)
    assert np.array_equal(read_cube(*reversed(files)).data, DATA)


def test_without_i_and_v_there_is_no_data_there_and_q_and_u_can_be_analyzed(tmp_path):
    cube = read_cube(*of_stokes(tmp_path, "QU"))
    assert np.isnan(cube.data[:, [0, 3]]).all()
    assert np.array_equal(cube.data[:, 1:3], DATA[:, 1:3])
    assert np.isfinite(Analyzer(cube).spectrum_2d("P", bins=2).power).any()
    with pytest.raises(InputError, match="I of channel 0 has no data"):
        Analyzer(cube).spectrum_2d("I")


def test_names_given_stand_for_what_the_files_say(tmp_path):
    files = [written(tmp_path / f"{k}.fits", DATA[:, k : k + 1], ("RA", "DEC", "FREQ")) for k in (1, 2)]
    for stokes in ("Q,U", ["Q", "U"], " q, u "):
        assert np.array_equal(read_cube(*files, stokes=stokes).data[:, 1:3], DATA[:, 1:3])
    refused(InputError, "stokes names too few: 2.fits has 1, of which 0 are left", *files, stokes="Q")
    refused(InputError, "stokes = 'Q,U,V' names 1 more than the files have planes: V", *files, stokes="Q,U,V")
    refused(InputError, "stokes = 'Q,XX' has 'XX': needed some of I, Q, U, V", *files, stokes="Q,XX")
    linear = written(tmp_path / "linear.fits", CRVAL4=-5.0, CDELT4=-1.0)
    assert np.array_equal(read_cube(linear, stokes="V,U,Q,I").data, DATA[:, ::-1])
    refused(InputError, "read_cube needs a file")


def test_files_of_one_channel_each_are_put_together(tmp_path):
    files = [p for f in range(F) for p in of_stokes(tmp_path, data=DATA[f : f + 1], CRVAL3=MHZ[f] * 1e6)]
    cube = read_cube(*files)
    assert np.array_equal(cube.data, DATA)
    assert cube.freq_hz == pytest.approx(MHZ * 1e6)
    # of I channel 2 comes first
    order = [*files[8:9], *files[:8], *files[9:]]
    refused(FileError, "channel 0 is 134.4 MHz in I, 134 MHz in Q: give the files of each", *order)
    refused(FileError, "there are 3 channels of I, but 2 of V", *files[:-1])
    # an unsorted order that all have is kept
    assert read_cube(*files[4:], *files[:4]).freq_hz[-1] == pytest.approx(134e6)
    refused(FileError, "I134.*fits and I134.*fits both have I at 134 MHz", *files, files[0])


def test_files_that_do_not_belong_together_are_refused(tmp_path):
    first = of_stokes(tmp_path, "Q")
    other = tmp_path / "other"
    other.mkdir()

    def second(said, data=DATA, **cards):
        (path,) = of_stokes(other, "U", data, **cards)
        refused(FileError, said, *first, path)
        path.unlink()

    second("U.fits and Q.fits have 7 x 6 and 8 x 6 pixels", DATA[..., :7])
    second("have pixels of 1' and 0.5'", CDELT1=-1 / 60, CDELT2=1 / 60)
    second("have centres .* and .*: needed the same grid", CRVAL2=49.0)
    second("are in Jy/beam and K", BUNIT="Jy/beam")
    second("channel 1 is 134.2 MHz in Q, 134.3 MHz in U", CDELT3=3e5)


def test_beams_that_differ_between_stokes_parameters_are_said(tmp_path):
    files = [*of_stokes(tmp_path, "Q", BMAJ=0.05, BMIN=0.05), *of_stokes(tmp_path, "U", BMAJ=0.06, BMIN=0.05)]
    with pytest.warns(InstrumentWarning, match="beams differ between Stokes parameters: those of Q are taken"):
        cube = read_cube(*files)
    assert np.rad2deg(cube.psf.major_rad) == pytest.approx([0.05] * F)


def test_u_of_the_other_convention_changes_sign(path):
    cube = read_cube(written(path, POLCCONV="COSMO"))
    assert np.array_equal(cube.data, DATA * np.array([1, 1, -1, 1], np.float32)[:, None, None])


# Data ------------------------------------------------------------------------------------------------------------


def test_blank_and_nan_are_no_data_and_scaled_integers_are_scaled(path, tmp_path):
    holes = DATA.copy()
    holes[1, 2, 3, 4] = np.nan
    assert np.array_equal(read_cube(written(path, holes)).data, holes, equal_nan=True)
    whole = np.arange(DATA.size, dtype=np.int16).reshape(DATA.shape)
    cube = read_cube(written(tmp_path / "i.fits", whole, BLANK=7, BSCALE=0.5, BZERO=3.0))
    assert np.isnan(cube.data[0, 0, 0, 7])
    assert np.nanmax(np.abs(cube.data - (whole * 0.5 + 3))) == 0
    assert np.isnan(cube.data).sum() == 1


def test_float64_stays_and_other_planes_of_an_image_do_not_matter(path, tmp_path):
    exact = DATA + 1e-12
    cube = read_cube(written(path, exact.astype(np.float64)))
    assert cube.data.dtype == np.float64
    hdus = fits.HDUList([fits.PrimaryHDU(), fits.ImageHDU(DATA.swapaxes(0, 1), fits.getheader(path), name="SCI")])
    hdus.writeto(tmp_path / "second.fits")
    assert np.array_equal(read_cube(tmp_path / "second.fits").data, DATA)


def test_reading_takes_the_memory_of_the_cube_once(path):
    data = np.zeros((8, 4, 256, 256), np.float32)
    written(path, data, CRPIX1=129.0, CRPIX2=129.0)
    read_cube(path)  # imports
    tracemalloc.start()
    read_cube(path)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 1.2 * data.nbytes


def test_broken_files_are_named(tmp_path):
    refused(FileError, "no FITS file '.*nothing.fits'", tmp_path / "nothing.fits")
    refused(FileError, "is a folder; name the", tmp_path)
    (tmp_path / "text.fits").write_text("hello")
    refused(FileError, "text.fits is not a readable FITS file", tmp_path / "text.fits")
    (tmp_path / "empty.fits").write_bytes(b"")
    refused(FileError, "empty.fits is not a readable FITS file", tmp_path / "empty.fits")
    fits.HDUList([fits.PrimaryHDU(), beams([(1, 1, 1, 0, 0)])]).writeto(tmp_path / "table.fits")
    refused(FileError, "table.fits: there is no image of two axes or more", tmp_path / "table.fits")
    whole = written(
        tmp_path / "whole.fits", np.zeros((8, 4, 64, 64), np.float32), CRPIX1=33.0, CRPIX2=33.0
    ).read_bytes()
    (tmp_path / "short.fits").write_bytes(whole[: len(whole) // 2])
    refused(FileError, "short.fits: its header declares data of 64 x 64 x 8 x 4, 524 kB", tmp_path / "short.fits")
