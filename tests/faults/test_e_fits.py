"""Lines E5 to E11 and I5, I8, I9: FITS files whose headers say less, or other, than they seem to."""

import gzip
import os
import tracemalloc
import warnings
from pathlib import Path

import numpy as np
import pytest
from astropy import units as u
from astropy.coordinates import FK4, SkyCoord
from astropy.io import fits

from instrument import InputError, Psf, StokesCube, polarized_screens, read_cube
from instrument.cli import main
from instrument.errors import FileError, InstrumentWarning, RefusedError

F, N = 4, 16
DATA = np.random.default_rng(5).normal(size=(F, 1, N, N)).astype(np.float32)
MHZ = 150 + 0.2 * np.arange(F)
# K per Jy/beam of a round beam of 3' at 150 MHz: 1.222e6 / (GHz² arcsec²)
KELVIN = 1676.4


def header(**cards):
    """RA, DEC, FREQ, STOKES I; pixels of 0.5'; None takes a card away."""
    found = fits.PrimaryHDU(np.swapaxes(DATA, 0, 1)).header
    for axis, (name, value, step, pixel, unit) in enumerate(
        (("RA---SIN", 123.4, -0.5 / 60, N // 2 + 1.0, "deg"), ("DEC--SIN", 48.2, 0.5 / 60, N // 2 + 1.0, "deg"),
         ("FREQ", 150e6, 2e5, 1.0, "Hz"), ("STOKES", 1.0, 1.0, 1.0, "")), 1,
    ):  # fmt: skip
        found.update({f"CTYPE{axis}": name, f"CRVAL{axis}": value, f"CDELT{axis}": step, f"CRPIX{axis}": pixel})
        found[f"CUNIT{axis}"] = unit
    found["BUNIT"] = "Jy/beam"
    for key, value in cards.items():
        if value is None:
            found.remove(key, ignore_missing=True)
        else:
            found[key] = value
    return found


def written(path, data=DATA, tables=(), history=(), **cards):
    hdu = fits.PrimaryHDU(np.swapaxes(data, 0, 1), header=header(**cards))
    for line in history:
        hdu.header.add_history(line)
    fits.HDUList([hdu, *tables]).writeto(path, overwrite=True)
    return path


def beams(widths, unit=None, **more):
    columns = [fits.Column(k, "E", unit if k != "BPA" else "deg", array=w) for k, w in
               (("BMAJ", widths), ("BMIN", widths), ("BPA", np.zeros(len(widths))))]  # fmt: skip
    columns += [fits.Column(k, "J", array=v) for k, v in more.items()]
    return fits.BinTableHDU.from_columns(columns, name="BEAMS")


def refused(said, *paths, error=InputError, **given):
    with pytest.raises(error, match=said) as caught:
        read_cube(*paths, **given)
    assert "\n" not in str(caught.value)
    assert len(str(caught.value)) < 350


def kelvin(cube, channel=0):
    """K that a Jy/beam of a channel becomes."""
    return cube.to_kelvin().data[channel, 0, 3, 3] / cube.data[channel, 0, 3, 3]


@pytest.fixture
def path(tmp_path):
    return tmp_path / "a.fits"


# Beams -----------------------------------------------------------------------------------------------------------


def test_e5_beams_of_every_channel_are_read_from_the_header(path):
    each = {"BMAJ": 3 / 60, "BMIN": 3 / 60}
    for k in range(F):
        each |= {f"BMAJ{k + 1}": (3 + k) / 60, f"BMIN{k + 1}": 3 / 60, f"BPA{k + 1}": 10.0 * k}
    found = read_cube(written(path, **each))
    assert np.rad2deg(found.psf.major_rad) * 60 == pytest.approx([3, 4, 5, 6])
    assert np.rad2deg(found.psf.angle_rad) == pytest.approx([0, 10, 20, 30])
    assert [kelvin(found, k) * (MHZ[k] / 150) ** 2 for k in range(F)] == pytest.approx(
        [KELVIN * 3 / (3 + k) for k in range(F)], rel=1e-4
    )
    zero = {key[:-1] + str(int(key[-1]) - 1) if key[-1].isdigit() else key: v for key, v in each.items()}
    assert np.rad2deg(read_cube(written(path, **zero)).psf.major_rad) * 60 == pytest.approx([3, 4, 5, 6])
    refused("BMAJ1 is there but BMAJ3 is not, of 4 channels: give psf=", written(path, **(each | {"BMAJ3": None})))


@pytest.mark.parametrize(
    ("cards", "said"),
    [
        ({"BMAJ": 180.0, "BMIN": 180.0}, "BMAJ has a beam of 180 deg .channel 0., wider than the image, 0.1886 deg"),
        ({"BMAJ": 0.2, "BMIN": 0.05}, "BMAJ has a beam of 0.2 deg .channel 0., wider than the image"),
        ({"BMAJ": 3 / 3600, "BMIN": 3 / 3600}, "BMAJ has a beam of 0.0008333 deg .channel 0., narrower than a pixel"),
        ({"BMAJ": 1e300}, "BMAJ has a beam of 1e.300 deg|BMAJ = 1e.300 is not finite"),
        ({"BMAJ": 1e299}, "BMAJ has a beam of 1e.299 deg"),
        ({"BMAJ": -0.05}, "BMAJ has a beam of -0.05 deg .channel 0."),
    ],
)
def test_e5_i9_a_beam_that_does_not_fit_the_image_is_asked_about(path, cards, said):
    refused(said, written(path, **cards))
    beam = Psf.gaussian(3 * u.arcmin)
    assert kelvin(read_cube(path, psf=beam)) == pytest.approx(KELVIN, rel=1e-4)


def test_e5_a_table_of_beams_without_units_is_read_as_what_fits_and_said(path):
    for widths, unit in (([180.0] * F, "arcsec"), ([0.05] * F, "deg")):
        written(path, tables=[beams(widths)])
        with pytest.warns(InstrumentWarning, match=f"has no TUNIT: BMAJ and BMIN are taken as {unit}, which fits"):
            assert kelvin(read_cube(path)) == pytest.approx(KELVIN, rel=1e-4)
    refused("no TUNIT for BMAJ, and fits the image neither in deg nor in arcsec: give psf=",
            written(path, tables=[beams([1e4] * F)]))  # fmt: skip


def test_e5_channels_without_a_beam_do_not_stop_the_others(path):
    data = DATA.copy()
    data[2] = np.nan
    for none in (0.0, np.nan):
        found = read_cube(written(path, data, [beams([180.0, 180.0, none, 180.0], "arcsec")]))
        assert kelvin(found) == pytest.approx(KELVIN, rel=1e-4)
        assert np.isnan(found.psf.major_rad[2])
        assert np.isnan(found.to_kelvin().data[2]).all()


def test_e5_the_beam_of_a_history_is_read_and_said(path):
    """As AIPS writes it: the last CLEAN counts."""
    history = [
        "AIPS   CLEAN BMAJ=  1.0000E-01 BMIN=  1.0000E-01 BPA=   0.00",
        "IMFIT made this up",
        "AIPS   CLEAN BMAJ=  5.0000E-02 BMIN=  5.0000E-02 BPA=  12.50",
        "AIPS   CLEAN NITER=     1000",
    ]
    written(path, history=history)
    with pytest.warns(InstrumentWarning, match="the beam is that of its history .AIPS CLEAN BMAJ."):
        found = read_cube(path)
    assert kelvin(found) == pytest.approx(KELVIN, rel=1e-4)
    assert np.rad2deg(found.psf.angle_rad) == pytest.approx([12.5] * F)


def test_e5_casambm_without_its_table_is_said(path):
    with pytest.warns(InstrumentWarning, match="CASAMBM = T.*there is no table BEAMS: BMAJ is taken for every"):
        assert kelvin(read_cube(written(path, CASAMBM=True, BMAJ=0.05, BMIN=0.05))) == pytest.approx(KELVIN, rel=1e-4)
    with pytest.warns(InstrumentWarning, match="CASAMBM = T.*no beam is known: give psf="):
        assert read_cube(written(path, CASAMBM=True)).psf is None


def test_e5_a_minor_axis_that_is_the_major_one_is_turned(path):
    found = read_cube(written(path, BMAJ=0.04, BMIN=0.05, BPA=10.0)).psf
    assert np.rad2deg([found.major_rad[0], found.minor_rad[0], found.angle_rad[0]]) == pytest.approx([0.05, 0.04, 100])


# Axes ------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("cards", "said"),
    [
        ({"CUNIT3": None, "CRVAL3": 150.0, "CDELT3": 0.2}, "axis 3 .FREQ. has 150 Hz .CUNIT3 is missing., not 1 MHz"),
        ({"CRVAL3": 150.0, "CDELT3": 0.2}, "axis 3 .FREQ. has 150 Hz .CUNIT3 = 'Hz'., not 1 MHz"),
        ({"CUNIT3": "MHz"}, "axis 3 .FREQ. has 1.5e.14 Hz .CUNIT3 = 'MHz'., not 1 MHz"),
        ({"CDELT3": None}, "CDELT3 of FREQ is missing .FITS then means 1 Hz.: give frequencies="),
        ({"CDELT3": 0.2}, "has 4 channels at most 0.2 Hz apart at 150 MHz: if CDELT has another unit than CRVAL"),
        ({"CRPIX3": None}, "CRPIX3 of FREQ is missing .FITS then means 0, most programs 1.: give frequencies="),
    ],
)
def test_e6_frequencies_that_none_can_mean_are_refused_with_what_settles_them(path, cards, said):
    refused(said, written(path, **cards), error=FileError)
    assert read_cube(path, frequencies=MHZ * u.MHz).freq_hz == pytest.approx(MHZ * 1e6)


def test_e6_a_stokes_axis_without_its_reference_is_refused(path):
    refused(
        "CRPIX4 of STOKES is missing .FITS then means 0, most programs 1.: give stokes=", written(path, CRPIX4=None)
    )
    assert np.array_equal(read_cube(path, stokes="I").data[:, :1], DATA)


def test_e6_one_channel_needs_no_step_and_no_reference(path):
    for cards in ({"CDELT3": None}, {"CDELT3": None, "CRPIX3": None}, {"CDELT3": 0.0, "CRPIX3": None}):
        assert read_cube(written(path, DATA[:1], **cards)).freq_hz.tolist() == [150e6]


def test_e7_an_image_turned_by_180_deg_is_turned_back(path):
    """A source in one corner, found where PC1_1 = PC2_2 = -1 has it."""
    straight = read_cube(written(path, PC1_1=-1.0, PC2_2=-1.0))
    assert np.array_equal(straight.data[:, :1], DATA[..., ::-1, ::-1])
    for cards in ({"CROTA2": 180.0}, {"CROTA1": 180.0, "CROTA2": 180.0}, {"CROTA2": -180.0}, {"CROTA1": 180.0}):
        turned = read_cube(written(path, **cards))
        assert np.array_equal(turned.data, straight.data, equal_nan=True)
        assert turned.centre == pytest.approx(straight.centre, abs=1e-12)
    for cards, said in (
        ({"CROTA2": 90.0}, "CROTA2 = 90 deg: the image is turned"),
        ({"CROTA3": 180.0}, "CROTA3 = 180 deg: the image is turned"),
        ({"CROTA1": 180.0, "CROTA2": 90.0}, "CROTA. = .* deg: the image is turned"),
        ({"CROTA2": 180.0, "PC1_1": 1.0}, "CROTA2 = 180 deg beside PC or CD"),
    ):
        refused(said, written(path, **cards))


@pytest.mark.parametrize("cards", [{"EPOCH": 1950.0}, {"EQUINOX": 1950.0}, {"EQUINOX": 1950.0, "RADESYS": "FK4"}])
def test_e8_positions_of_1950_are_precessed(path, cards):
    want = SkyCoord(123.4 * u.deg, 48.2 * u.deg, frame=FK4(equinox="B1950")).icrs
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", InstrumentWarning)
        centre = read_cube(written(path, **cards)).centre
    assert centre.skycoord.separation(want).to_value("arcsec") < 1e-3
    assert centre.skycoord.separation(SkyCoord(123.4, 48.2, unit="deg")).to_value("arcmin") > 30


def test_e8_epochs_of_2000_and_of_nothing_are_not(path):
    for cards in ({"EPOCH": 2000.0}, {"EPOCH": 0.0}, {"EPOCH": 1950.0, "EQUINOX": 2000.0}, {"RADESYS": "ICRS"}):
        centre = read_cube(written(path, **cards)).centre
        assert centre.skycoord.separation(SkyCoord(123.4, 48.2, unit="deg")).to_value("arcsec") < 0.03
    refused("coordinates on the sky cannot be read", written(path, RADESYS="GAPPT"))


def test_e9_pixels_of_60_deg_are_refused(path):
    cards = {"CDELT1": -30.0, "CDELT2": 30.0, "CUNIT1": None, "CUNIT2": None}
    refused("16 pixels of 30 deg span 480 deg, more than half the sky; CUNIT1 is missing: is CDELT1 in arcsec?",
            written(path, **cards))  # fmt: skip
    cards |= {"CUNIT1": "arcsec", "CUNIT2": "arcsec", "CRVAL1": 123.4 * 3600, "CRVAL2": 48.2 * 3600}
    found = read_cube(written(path, **cards))
    assert np.rad2deg(found.pixel_rad) * 60 == pytest.approx(0.5)
    assert np.rad2deg(found.centre) == pytest.approx([123.4, 48.2])
    refused("CDELT1 is missing", written(path, CDELT1=None))


def test_the_frame_of_the_frequencies_and_parts_that_are_not_read_are_named(path):
    extra = [
        fits.ImageHDU(np.zeros((3, 3)), name="WEIGHT"),
        fits.BinTableHDU.from_columns([fits.Column("A", "E", array=[1])]),
    ]
    written(path, tables=extra, SPECSYS="LSRK")
    with pytest.warns(InstrumentWarning) as said:
        read_cube(path)
    text = "\n".join(str(w.message) for w in said)
    assert "SPECSYS = 'LSRK' (frequencies are taken as they stand" in text
    assert "extension 1 (image WEIGHT)" in text
    assert "extension 2 (table without a name)" in text
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        read_cube(written(path, SPECSYS="TOPOCENT"))


# Several files ---------------------------------------------------------------------------------------------------


def test_e11_the_mean_of_all_channels_is_left_out_of_a_glob_and_said(tmp_path):
    for k in range(F):
        written(tmp_path / f"obs-{k:04d}-I-image.fits", DATA[k : k + 1], CRVAL3=MHZ[k] * 1e6)
    written(tmp_path / "obs-MFS-I-image.fits", DATA[:1] + 9, CRVAL3=150.31e6, CDELT3=8e5)
    files = sorted(tmp_path.glob("*.fits"))
    assert len(files) == F + 1
    with pytest.warns(InstrumentWarning, match=r"obs-MFS-I-image.fits: not used: .*the mean of all channels"):
        found = read_cube(*files)
    assert found.freq_hz / 1e6 == pytest.approx(MHZ)
    assert np.array_equal(found.data[:, :1], DATA)
    assert read_cube(files[-1]).freq_hz / 1e6 == pytest.approx([150.31])  # alone it is what it is


def test_e11_names_that_the_headers_contradict_are_refused(tmp_path):
    files = [written(tmp_path / f"{name}.fits", CRVAL4=k) for name, k in (("u", 3.0), ("q", 2.0))]
    refused("u.fits: its axis STOKES says U, but stokes= says Q: leave stokes= out", *files, stokes="Q,U")
    assert np.array_equal(read_cube(*files, stokes="U,Q").data[:, 1:2], DATA)
    # I that nobody filled in is said
    plain = [written(tmp_path / f"{k}.fits") for k in range(2)]
    with pytest.warns(InstrumentWarning, match=r"0.fits: not used: STOKES = I of its header .stokes = 'Q' is given"):
        assert np.array_equal(read_cube(*plain, stokes="Q,U").data[:, 2:3], DATA)


@pytest.mark.parametrize("beam", [None, Psf.gaussian(3 * u.arcmin)], ids=["no beam", "beam"])
def test_e11_a_cube_with_gaps_comes_back_with_its_frequencies_to_the_last_bit(tmp_path, beam):
    freq = np.array([134e6, 134.2e6, 150.1e6 + 1 / 3, 149e6, 166e6])
    data = np.random.default_rng(1).normal(size=(5, 4, N, N)).astype(np.float32)
    StokesCube(data, freq * u.Hz, 0.5 * u.arcmin, "K", psf=beam).write(tmp_path / "gaps.fits")
    found = read_cube(tmp_path / "gaps.fits")
    assert found.freq_hz.tolist() == freq.tolist()
    assert np.array_equal(found.data, data)
    # others do not read a linear axis that is none
    assert fits.getheader(tmp_path / "gaps.fits")["CTYPE4"] == "FREQ-TAB"


def test_e11_an_axis_tab_with_an_index_is_read(path):
    """FITS paper III: coordinates at index 1, 3, 5, 9 of a table; channels 1 to 4 lie on the lines between."""
    columns = [fits.Column("COORDS", "4D", "MHz", dim="(1,4)", array=np.array([[[150.0], [151.0], [153.0], [160.0]]])),
               fits.Column("INDEX", "4D", array=[[1.0, 3.0, 5.0, 9.0]])]  # fmt: skip
    table = fits.BinTableHDU.from_columns(columns, name="WCS-TAB")
    cards = {"CTYPE3": "FREQ-TAB", "CUNIT3": "MHz", "CRVAL3": 1.0, "CDELT3": 1.0, "PS3_0": "WCS-TAB", "PS3_1": "COORDS"}
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        found = read_cube(written(path, tables=[table], **cards, PS3_2="INDEX"))
    assert found.freq_hz / 1e6 == pytest.approx([150, 150.5, 151, 152], rel=1e-14)
    assert read_cube(written(path, tables=[table], **cards)).freq_hz / 1e6 == pytest.approx([150, 151, 153, 160])
    refused("there is no table 'NONE', column 'COORDS' .PS3_0, PS3_1.: give frequencies=",
            written(path, tables=[table], **(cards | {"PS3_0": "NONE"})))  # fmt: skip
    refused("4 channels do not lie in its table", written(path, tables=[table], **(cards | {"CRVAL3": 2.0})))


# Hostile files ---------------------------------------------------------------------------------------------------


def peak_of(what, *given, **more):
    tracemalloc.start()
    try:
        what(*given, **more)
    finally:
        peak = tracemalloc.get_traced_memory()[1]
        tracemalloc.stop()
    return peak


def test_i5_sizes_that_a_file_cannot_hold_are_refused_before_anything_is_allocated(path):
    raw = bytearray(written(path).read_bytes())
    at = raw.index(b"NAXIS4  =")
    raw[at : at + 80] = b"NAXIS4  =           1000000000".ljust(80)
    path.write_bytes(raw)
    said = r"its header declares data of 16 x 16 x 4 x 1000000000, 4.1 TB, more than it has \(8.64 kB\)"
    assert peak_of(refused, said, path, error=FileError) < 4e6


def test_i5_a_bomb_of_gzip_is_refused_before_it_is_unpacked(path):
    head = header()
    head["NAXIS3"] = 1_000_000
    content = head.tostring().encode("ascii")
    packed = path.with_name("bomb.fits.gz")
    with gzip.open(packed, "wb") as file:
        file.write(content)
        for _ in range(40):
            file.write(bytes(1 << 20))
    assert packed.stat().st_size < 100_000
    assert peak_of(refused, "unpacks to more than .* 100 times its size", packed, error=FileError) < 50e6


def test_i5_a_file_that_is_packed_in_earnest_is_read(path):
    packed = path.with_name("a.fits.gz")
    packed.write_bytes(gzip.compress(written(path).read_bytes()))
    assert np.array_equal(read_cube(packed).data[:, :1], DATA)


def test_i5_a_cube_that_memory_does_not_hold_is_refused(path):
    """Sparse on disk: 2 TB declared and there, as far as the file system says."""
    head = header()
    head["NAXIS3"] = 500_000_000
    path.write_bytes(head.tostring().encode("ascii"))
    os.truncate(path, len(head.tostring()) + 4 * N * N * 500_000_000)
    assert peak_of(refused, "a.fits: 500000000 channels, at most", path, error=RefusedError) < 4e6


def test_i5_a_cube_of_a_few_channels_that_memory_does_not_hold_is_refused(path):
    head = header()
    head["NAXIS1"], head["NAXIS2"], head["NAXIS3"] = 100_000, 100_000, 10
    path.write_bytes(head.tostring().encode("ascii"))
    os.truncate(path, len(head.tostring()) + 4 * 10**11)
    said = "a cube of 10 x 4 x 100000 x 100000 would take 1.6 TB of memory, and .*: cut out channels"
    assert peak_of(refused, said, path, error=RefusedError) < 4e6
    with pytest.raises(RefusedError, match="a cube of 161 channels of 100000 x 100000 pixels would take 27"):
        polarized_screens(100_000)


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="no pipes here")
def test_i5_pipes_devices_and_folders_do_not_block(tmp_path):
    os.mkfifo(tmp_path / "pipe.fits")
    for wrong in (tmp_path / "pipe.fits", Path("/dev/zero")):
        refused("no regular file", wrong, error=FileError)


@pytest.mark.parametrize("name", ["http://127.0.0.1:9/x.fits", "file:///etc/passwd", "a\0b.fits", "x" * 260])
def test_i5_i8_a_name_is_a_file_or_nothing_and_never_fetched(name):
    refused("FITS file", name, error=FileError)


@pytest.mark.parametrize("key", ["TTYPE1", "TFORM1", "TUNIT1", "TTYPE2", "NAXIS1", "NAXIS2", "TFIELDS", "EXTNAME"])
@pytest.mark.parametrize("value", [True, "?", 10**9, -1.5])
def test_i8_a_table_of_beams_with_broken_keywords_is_one_line(path, key, value):
    table = beams([180.0] * F, "arcsec")
    written(path, tables=[table])
    raw = path.read_bytes()
    card = fits.Card(key, value).image.encode("ascii")
    at = raw.index(f"{key:<8}=".encode(), raw.index(b"XTENSION"))
    path.write_bytes(raw[:at] + card + raw[at + 80 :])
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            found = read_cube(path)
    except InputError as error:
        assert "\n" not in str(error)
    else:
        assert found.psf is None or np.nanmax(np.abs(found.psf.major_rad - np.deg2rad(0.05))) < 1e-6


def test_e5_a_beam_of_the_header_that_cannot_be_is_replaced_on_the_command_line(path, tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    written(path, BMAJ=180.0, BMIN=180.0)
    words = ["analyze", str(path), "--products", "spectrum-2d", "--out", str(tmp_path / "out")]
    assert main(words) == 2
    assert "wider than the image" in (said := capsys.readouterr().err)
    assert "--beam" in said
    assert "Traceback" not in said
    assert main([*words, "--beam", "3 arcmin"]) == 0
