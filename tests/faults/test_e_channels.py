"""Line E13: which channels of a cube are taken, and what its files do not say, from Python."""

import numpy as np
import pytest
from astropy import units as u
from astropy.io import fits

from instrument import InputError, Psf, StokesCube, read_cube
from instrument.errors import FileError
from instrument.files.fits_psf import read_psf
from instrument.files.number_list import read_frequencies, read_numbers
from instrument.image.channels import channel_numbers

MHZ = 134 + 0.2 * np.arange(10)


def cube(mhz=MHZ, pixels=8, psf=None):
    data = np.random.default_rng(0).normal(size=(len(mhz), 4, pixels, pixels)).astype(np.float32)
    return StokesCube(data, mhz * u.MHz, 0.5 * u.arcmin, "Jy/beam", psf=psf)


def test_e13_a_band_has_both_its_ends():
    one = cube()
    for band in ("134.4 MHz,135 MHz", (0.1344 * u.GHz, 135000 * u.kHz)):
        found = one.select(band=band)
        assert found.freq_hz / 1e6 == pytest.approx([134.4, 134.6, 134.8, 135.0])
        assert np.array_equal(found.data, one.data[2:6])
    assert one.select([9, 2, 4], band="134 MHz, 135 MHz").freq_hz / 1e6 == pytest.approx([134.4, 134.8])


def test_e13_flagged_channels_have_no_data_and_the_cube_that_was_given_keeps_its_own():
    one = cube()
    found = one.flagged([3, -1])
    assert np.isnan(found.data[[3, 9]]).all()
    assert np.array_equal(np.delete(found.data, [3, 9], 0), np.delete(one.data, [3, 9], 0))
    assert np.isfinite(one.data).all()


def test_e13_text_names_channels_as_ranges_with_both_ends():
    assert channel_numbers("3,7-9", 10).tolist() == [3, 7, 8, 9]
    assert channel_numbers(" 9 , 0-1,1", 10).tolist() == [0, 1, 9]
    for wrong in ("3,7-10", "9-7", "-1", "3;4", "", "1e3", "3,,4", "99999999999"):
        with pytest.raises(InputError, match=r"channels .*: ") as caught:
            channel_numbers(wrong, 10)
        assert "\n" not in str(caught.value)


@pytest.mark.parametrize("wrong", [10, -11, 1.5, "3", True, None, [True] * 9, [], [[1]], np.nan, slice("a", "b")])
def test_e13_channels_that_are_none_are_refused_in_one_line(wrong):
    for take in (cube().channels, cube().flagged):
        if wrong == [] and take.__name__ == "flagged":
            continue  # none is none
        with pytest.raises(InputError, match=r"channel") as caught:
            take(wrong)
        assert "\n" not in str(caught.value)


@pytest.mark.parametrize("wrong", ["134 MHz", "135 MHz,134 MHz", (134, 135), 3, None, ("a MHz", "b"), "1 m,2 m",
                                   "-1 MHz,2 MHz", "nan MHz,2 MHz", "200 MHz,300 MHz"])  # fmt: skip
def test_e13_a_band_that_is_none_is_refused_in_one_line(wrong):
    if wrong is None:
        return
    with pytest.raises(InputError, match="band") as caught:
        cube().select(band=wrong)
    assert "\n" not in str(caught.value)


def test_e13_frequencies_and_weights_of_a_text_file(tmp_path):
    path = tmp_path / "freq.txt"
    path.write_text("# Hz\n134e6\n\n134200000.125 # second\n")
    assert read_frequencies(path).to_value("Hz").tolist() == [134e6, 134200000.125]
    path.write_text("1\n0\n0.5\n")
    assert read_numbers(path).tolist() == [1, 0, 0.5]
    for content, said in (
        (b"1\nroot:x:0\n", "freq.txt, line 2: not a number"), (b"1\nnan\n", "line 2: nan is not finite"),
        (b"# nothing\n", "holds no number"), (b"\xff\xfe1\x00", "line 1: not a number"), (b"1 2\n", "line 1: not a"),
    ):  # fmt: skip
        path.write_bytes(content)
        with pytest.raises(FileError, match=said) as caught:
            read_numbers(path)
        assert "root" not in str(caught.value)
    for wrong, said in ((tmp_path, "is a folder"), (tmp_path / "none", "no list of numbers")):
        with pytest.raises(FileError, match=said):
            read_numbers(wrong)


def gaussian(width_pixels, n=16):
    y, x = np.mgrid[:n, :n] - n // 2
    return np.exp(-4 * np.log(2) * (x**2 + y**2) / width_pixels**2)


def test_e13_a_cube_of_the_psf_gives_its_beams_and_images(tmp_path):
    one = cube(MHZ[:2], 16)
    images = np.zeros((2, 4, 16, 16))
    images[:, 0] = [gaussian(4), gaussian(5)]
    StokesCube(images, MHZ[:2] * u.MHz, 0.5 * u.arcmin, "Jy/beam").write(tmp_path / "psf.fits")
    psf = read_psf(tmp_path / "psf.fits", one)
    assert np.rad2deg(psf.major_rad) * 60 == pytest.approx([2, 2.5], rel=1e-5)
    assert psf.data == pytest.approx(images[:, 0], abs=1e-7)
    # without BUNIT, STOKES and FREQ, one image for all channels
    bare = fits.PrimaryHDU(gaussian(4).astype(np.float32))
    for axis, name, step in ((1, "RA---SIN", -0.5 / 60), (2, "DEC--SIN", 0.5 / 60)):
        bare.header.update(
            {
                f"CTYPE{axis}": name,
                f"CDELT{axis}": step,
                f"CRPIX{axis}": 9.0,
                f"CRVAL{axis}": 12.0,
                f"CUNIT{axis}": "deg",
            }
        )
    bare.writeto(tmp_path / "bare.fits")
    assert np.rad2deg(read_psf(tmp_path / "bare.fits", cube(MHZ[:1], 16)).major_rad) * 60 == pytest.approx(
        [2], rel=1e-5
    )


def test_e13_images_that_are_no_psf_of_the_cube_are_refused(tmp_path):
    def written(planes, mhz=MHZ[:2], pixel=0.5):
        images = np.zeros((len(planes), 4, 16, 16))
        images[:, 0] = planes
        path = tmp_path / "psf.fits"
        path.unlink(missing_ok=True)
        StokesCube(images, mhz * u.MHz, pixel * u.arcmin, "Jy/beam").write(path)
        return path

    good = [gaussian(4), gaussian(5)]
    for path, said in (
        (lambda: written([good[0], np.roll(good[1], 1, 0)]), "channel 1 has .* at the centre pixel"),
        (lambda: written([good[0], 2 * good[1]]), "channel 1 has 2 at the centre pixel"),
        (lambda: written(good, MHZ[1:3]), "have channel 0 at 134.2 and 134 MHz"),
        (lambda: written(good, pixel=0.6), "have pixels 16 x 16 of 0.6' and 16 x 16 of 0.5'"),
        (lambda: written([*good, good[0]], MHZ[:3]), "has 3 channels, the cube 2"),
    ):
        with pytest.raises(FileError, match=said):
            read_psf(path(), cube(MHZ[:2], 16))


def test_e13_a_psf_that_is_given_stands_for_that_of_the_header(tmp_path):
    cube(psf=Psf.gaussian(3 * u.arcmin)).write(tmp_path / "a.fits")
    found = read_cube(tmp_path / "a.fits", psf=Psf.gaussian(2 * u.arcmin)).psf
    assert np.rad2deg(found.major_rad) * 60 == pytest.approx([2] * 10)
