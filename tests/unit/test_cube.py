"""StokesCube and Psf: what is refused, kelvin, channels, and FITS there and back."""

from dataclasses import replace

import numpy as np
import pytest
from astropy import units as u
from astropy.io import fits

from instrument import InputError, Psf, StokesCube, read_cube
from instrument.report import images
from instrument.units import Direction

CENTRE = Direction(2.153, 0.8416)


def cube_of(mhz=(150,), unit="Jy/beam", psf=None, pixels=(6, 8), dtype=np.float32, **more):
    data = np.random.default_rng(1).normal(size=(len(mhz), 4, *pixels)).astype(dtype)
    return StokesCube(data, mhz * u.MHz, 0.5 * u.arcmin, unit, psf=psf, **more)


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"unit": None}, "unit = None is not one of 'Jy/beam', 'Jy/pixel', 'K'"),
        ({"unit": ""}, "unit = '' is not one of"),
        ({"unit": "mK"}, "unit = 'mK' is not one of"),
        ({"frequencies": [150, np.nan] * u.MHz}, "frequencies\\[1\\] = nan Hz is not finite"),
        ({"frequencies": [0, -150] * u.MHz}, "frequencies of channels 0, 1 are 0, -1.5e"),
        ({"frequencies": [150, np.inf] * u.MHz}, "frequencies\\[1\\] = inf Hz is not finite"),
        ({"pixel": 0 * u.arcmin}, "pixel = 0.0 arcmin is not"),
        ({"pixel": -1 * u.arcmin}, "pixel = -1.0 arcmin is not"),
        ({"pixel": np.nan * u.arcmin}, "pixel = nan rad is not finite"),
        ({"pixel": 0.5}, "pixel needs a unit"),
        ({"psf": Psf.gaussian([1, 2, 3] * u.arcmin)}, "the PSF has 3 channels, the cube 2"),
    ],
)
def test_impossible_cubes_are_refused_in_one_line(changes, said):
    given = {"data": np.zeros((2, 4, 3, 3)), "frequencies": [150, 151] * u.MHz, "pixel": 1 * u.arcmin, **changes}
    with pytest.raises(InputError, match=said) as error:
        StokesCube(**given)
    assert "\n" not in str(error.value)


def test_kelvin_per_jansky_are_the_numbers_of_a_handbook():
    """1.222e6 / (GHz² arcsec²) K per Jy/beam (four digits), 1676 K for 3' and 68384 K per Jy/pixel of 0.5', 150 MHz."""
    beam = Psf.gaussian([3, 4.3, 3] * u.arcmin, [3, 4.3, 2] * u.arcmin)
    kelvin = cube_of((150, 150, 134), psf=beam).to_kelvin()
    ratio = (kelvin.data / cube_of((150, 150, 134)).data)[:, 1, 2, 2]
    arcsec2 = np.array([180 * 180, 258 * 258, 180 * 120])
    assert ratio == pytest.approx(1.222e6 / (np.array([0.15, 0.15, 0.134]) ** 2 * arcsec2), rel=1e-4)
    assert ratio[:2] == pytest.approx([1676.4, 816.0], rel=1e-4)
    of_astropy = (1 * u.Jy).to_value(u.K, u.brightness_temperature(134 * u.MHz, kelvin.psf.solid_angle_sr[2] * u.sr))
    assert ratio[2] == pytest.approx(of_astropy, rel=1e-6)  # float32
    pixels = cube_of(unit="Jy/pixel").to_kelvin()
    assert pixels.unit == kelvin.unit == "K"
    assert (pixels.data / cube_of().data)[0, 0, 0, 0] == pytest.approx(68384, rel=1e-4)


def test_kelvin_by_the_sum_of_the_psf_are_those_of_the_fit_for_a_gaussian_and_nothing_without_a_zero_spacing():
    y, x = (np.arange(64) - 32) * np.ones((2, 1))
    lobe = np.exp(-4 * np.log(2) * ((y[:, None] / 8) ** 2 + (x / 6) ** 2))
    given = Psf.gaussian(8 * u.arcmin, 6 * u.arcmin)
    cube = StokesCube(np.ones((1, 4, 64, 64)), [150] * u.MHz, 1 * u.arcmin, "Jy/beam", constants="data")
    whole = cube.with_psf(replace(given, data=lobe[None]))
    fit, total = whole.solid_angle_sr(), whole.solid_angle_sr("sum")
    assert fit == pytest.approx(total, rel=1e-9)
    assert whole.to_kelvin("sum").data == pytest.approx(whole.to_kelvin().data, rel=1e-9)
    with pytest.raises(InputError, match="needs the image of the PSF"):
        cube.with_psf(given).to_kelvin("sum")
    none = cube.with_psf(replace(given, data=(lobe - lobe.mean())[None]))
    assert abs(none.solid_angle_sr("sum")[0]) < 1e-12 * fit[0]
    with pytest.raises(InputError, match=r"channel 0 is -.* sr: it has no K"):
        cube.with_psf(replace(given, data=(lobe - 1.01 * lobe.mean())[None])).to_kelvin("sum")
    with pytest.raises(InputError, match="'mean' is not one of 'fit', 'sum'"):
        whole.to_kelvin("mean")


def test_kelvin_keeps_float32_and_takes_whole_numbers():
    whole = StokesCube(np.ones((1, 4, 2, 2), int), [150] * u.MHz, 0.5 * u.arcmin, "Jy/pixel").to_kelvin()
    assert whole.data[0, 0, 0, 0] == pytest.approx(68384, rel=1e-4)
    assert cube_of(unit="Jy/pixel").to_kelvin().data.dtype == np.float32
    kelvin = cube_of(unit="K")
    assert kelvin.to_kelvin() is kelvin


@pytest.mark.parametrize("bad", [0, -3, np.nan])
def test_a_beam_of_no_width_gives_no_kelvin(bad):
    cube = cube_of((150, 151, 152), psf=Psf.gaussian([3, bad, 3] * u.arcmin, [3, 3, 3] * u.arcmin))
    with pytest.raises(InputError, match=r"the PSF in channel 1 is (0|-\d|nan).* sr"):
        cube.to_kelvin()
    empty = cube.data.copy()
    empty[1] = np.nan
    found = cube.with_data(empty).to_kelvin().data  # a channel without data needs no beam
    assert np.isnan(found[1]).all()
    assert np.isfinite(found[[0, 2]]).all()


def test_one_beam_is_that_of_every_channel_and_can_be_left_without_an_image():
    psf = Psf.gaussian(4 * u.arcmin, 3 * u.arcmin, 30 * u.deg)
    cube = cube_of((150, 151), psf=psf)
    assert cube.psf.major_rad.shape == (2,)
    assert cube.psf.solid_angle_sr == pytest.approx(np.pi / (4 * np.log(2)) * 12 * np.deg2rad(1 / 60) ** 2)
    images.stokes_images(cube, channel=1)  # draws its ellipse
    with pytest.raises(InputError, match="no image of the PSF"):
        images.psf_image(cube)


def test_channels_are_chosen_and_sorted_with_their_beams():
    psf = Psf.gaussian([3, 2, 1] * u.arcmin)
    cube = cube_of((150, 148, 149), psf=psf)
    ordered = cube.sorted()
    assert ordered.freq_hz.tolist() == [148e6, 149e6, 150e6]
    assert np.array_equal(ordered.data, cube.data[[1, 2, 0]])
    assert np.rad2deg(ordered.psf.major_rad) * 60 == pytest.approx([2, 1, 3])
    assert ordered.sorted() is ordered
    assert np.array_equal(cube.channels(slice(1, None)).data, cube.data[1:])
    assert np.array_equal(cube.channels([True, False, True]).freq_hz, cube.freq_hz[[0, 2]])
    assert cube.channels(2).data.shape == (1, 4, 6, 8)


@pytest.mark.parametrize(
    "mhz",
    [(150,), (134, 134.2), tuple(np.linspace(134, 166, 161)), (150, 149, 148), (150, 151, 153), (151, 150, 151.5, 151),
     (150, 150)],
    ids=["one", "two", "paper", "descending", "gap", "unsorted", "twice"],
)  # fmt: skip
@pytest.mark.parametrize("beams", [False, True])
def test_a_written_cube_reads_back_equal(tmp_path, mhz, beams):
    psf = Psf.gaussian(np.linspace(4, 5, len(mhz)) * u.arcmin, 3 * u.arcmin, 0.3 * u.rad) if beams else None
    cube = cube_of(mhz, psf=psf, centre=CENTRE, pixels=(7, 8))
    cube.data[0, 2, 1, 1] = np.nan
    cube.write(tmp_path / "cube.fits")
    back = read_cube(tmp_path / "cube.fits")
    assert np.array_equal(back.data, cube.data, equal_nan=True)
    assert back.data.dtype.isnative
    assert back.data.dtype == np.float32
    assert back.freq_hz == pytest.approx(cube.freq_hz, rel=1e-12)
    assert back.pixel_rad == pytest.approx(cube.pixel_rad, rel=1e-14)
    assert back.unit == cube.unit
    assert back.centre == pytest.approx(CENTRE, rel=1e-14)
    assert (back.psf is None) == (psf is None)
    if beams:
        for name in ("major_rad", "minor_rad", "angle_rad"):
            assert getattr(back.psf, name) == pytest.approx(getattr(cube.psf, name), rel=1e-14)


def test_a_centre_that_is_not_known_stays_so_and_kelvin_are_kelvin(tmp_path):
    cube_of(unit="K").write(tmp_path / "cube.fits")
    back = read_cube(tmp_path / "cube.fits")
    assert back.centre is None
    assert back.unit == "K"
    cube_of(unit="Jy/pixel").write(tmp_path / "other.fits")
    assert read_cube(tmp_path / "other.fits").unit == "Jy/pixel"
    assert fits.getheader(tmp_path / "other.fits")["BUNIT"] == "Jy/pixel"


def test_beams_of_channels_without_data_come_back_as_not_known(tmp_path):
    cube = cube_of((150, 151), psf=Psf.gaussian([np.nan, 3] * u.arcmin))
    cube.write(tmp_path / "cube.fits")
    back = read_cube(tmp_path / "cube.fits").psf
    assert np.isnan(back.major_rad[0])
    assert back.major_rad[1] == pytest.approx(cube.psf.major_rad[1], rel=1e-14)
