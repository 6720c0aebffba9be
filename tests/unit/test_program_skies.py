"""Sky models of other programs: one source of each against known numbers, and what they get wrong in one line."""

import h5py
import numpy as np
import pytest

from instrument.errors import FileError, UnusedWarning
from instrument.sky.points import PointSky

ARCSEC = np.deg2rad(1 / 3600)
LIGHT = 299792458.0
RA, DEC = 15 * (8 + 13 / 60 + 35.98 / 3600), 48 + 12 / 60 + 59.17 / 3600
PLACE = "8 13 35.98 48 12 59.17"
AO = """skymodel fileformat 1.1
# a comment
source {
  name "3C 196"
  component {
    type gaussian
    position 8h13m35.98s +48d12m59.17s
    shape 60 30 45
    sed {
      frequency 150 MHz
      fluxdensity Jy 2 0.2 -0.1 0.05
      spectral-index { -0.8 0 }
    }
  }
  component {
    type point
    position -0h10m00s -0d30m00s
    measurement {
      frequency 0.2 GHz
      fluxdensity Jy 3 0 0 0
    }
  }
}
"""


@pytest.fixture
def read(tmp_path):
    def made(text, name="model.txt", **choices):
        (tmp_path / name).write_text(text)
        return PointSky.read(tmp_path / name, **choices)

    return made


def at(sky, mhz):
    return sky.stokes(np.array([mhz * 1e6]))[0]


def test_sagecal_has_natural_logarithms_for_all_four_stokes_parameters(read):
    sky = read(f"P1 {PLACE} 2 0.2 -0.1 0.05 -0.8 0.3 -0.1 0 0 0 0 150e6\nP2 0 0 0 -0 30 0 3 0 0 0 0 5 7 0 0 0 0 150e6")
    assert sky.names == ("P1", "P2")
    np.testing.assert_allclose(np.rad2deg([sky.ra_rad[0], sky.dec_rad[0]]), [RA, DEC], rtol=1e-14)
    assert np.rad2deg(sky.dec_rad[1]) == pytest.approx(-0.5, rel=1e-14)
    x = np.log(75 / 150)
    expected = np.array([2, 0.2, -0.1, 0.05]) * np.exp(-0.8 * x + 0.3 * x**2 - 0.1 * x**3)
    np.testing.assert_allclose(at(sky, 75)[0], expected, rtol=1e-14)
    assert at(sky, 75)[1, 0] == 3.0  # a first term of 0 switches the others off


def test_the_columns_of_sagecal_without_a_curved_spectrum(read):
    sky = read(
        "## LSM file\n### Name | RA (hr,min,sec) | DEC ...\nP1 8 13 35.98 48 12 59.17 2 0 0 0 -0.8 0 0 0 0 150e6"
    )
    assert at(sky, 75)[0, 0] == pytest.approx(2**1.8, rel=1e-14)


def test_sagecals_rotation_measures_are_named_as_not_used(read):
    with pytest.warns(UnusedWarning, match="line 1 .SAGECal takes no notice"):
        assert read("P1 8 13 35.98 48 12 59.17 2 1 0 0 -0.8 3 0 0 0 150e6").rotation_measure is None


def test_tigger_counts_angles_from_north_through_east_and_turns_from_the_reference_frequency(read):
    sky = read(
        "#format: name ra_h ra_m ra_s dec_d dec_m dec_s i q u v spi spi2 rm emaj_s emin_s pa_d freq0 tags...\n"
        "A 8 13 35.98 +48 12 59.17 2 0.2 -0.1 0.05 -0.8 0.3 3 60 30 45 150e6 +x +y\n"
    )
    np.testing.assert_allclose(np.rad2deg([sky.ra_rad[0], sky.dec_rad[0]]), [RA, DEC], rtol=1e-14)
    np.testing.assert_allclose([sky.major_rad[0], sky.minor_rad[0]], [60 * ARCSEC, 30 * ARCSEC], rtol=1e-14)
    assert np.rad2deg(sky.angle_rad[0]) == pytest.approx(45, rel=1e-14)
    x = np.log(0.5)
    growth = np.exp(-0.8 * x + 0.3 * x**2)
    turned = growth * (0.2 - 0.1j) * np.exp(2j * 3 * ((LIGHT / 75e6) ** 2 - (LIGHT / 150e6) ** 2))
    np.testing.assert_allclose(at(sky, 75)[0], [2 * growth, turned.real, turned.imag, 0.05 * growth], rtol=1e-12)


def test_tigger_takes_what_a_format_names_and_says_what_it_leaves(read):
    with pytest.warns(UnusedWarning, match="i_err, emaj_s"):
        sky = read("#format: dec_rad dec_sign ra_d i i_err emaj_s -\n0.5 - 10 3 0.1 60 x\n")
    assert (sky.names, sky.major_rad, sky.dec_rad[0]) == (("s0",), None, -0.5)


def test_ao_has_fluxes_with_units_and_components_of_a_source_as_a_patch(read):
    sky = read(AO)
    assert (sky.names, sky.patches) == (("3C 196:1", "3C 196:2"), ("3C 196", "3C 196"))
    np.testing.assert_allclose(np.rad2deg([sky.ra_rad, sky.dec_rad]), [[RA, -2.5], [DEC, -0.5]], rtol=1e-14)
    np.testing.assert_allclose([sky.major_rad, sky.minor_rad], [[60 * ARCSEC, 0], [30 * ARCSEC, 0]], rtol=1e-14)
    assert np.rad2deg(sky.angle_rad[0]) == pytest.approx(45, rel=1e-14)
    np.testing.assert_allclose(at(sky, 75)[0], 2**0.8 * np.array([2, 0.2, -0.1, 0.05]), rtol=1e-14)
    assert sky.reference_hz.tolist() == [150e6, 200e6]
    assert at(sky, 75)[1, 0] == 3.0


@pytest.mark.parametrize(
    "text",
    [
        "#format: name ra_d dec_d i emaj_s emin_s pa_d\nA 123.4 48.2 2 60 30 30\n",
        'skymodel fileformat 1.1\nsource { name "A" component { type gaussian position '
        "8h13m36s 48d12m00s shape 60 30 30 measurement { frequency 150 MHz fluxdensity Jy 2 0 0 0 } } }\n",
    ],
)
def test_a_gaussian_is_long_towards_its_position_angle(read, text):
    """The visibility of a baseline along the axis at 30 deg east of north falls faster than across it."""
    from instrument.units import Direction

    sky = read(text)
    axes = sky.shape_axes(Direction(sky.ra_rad[0], sky.dec_rad[0]))[0]
    along = np.array([np.sin(np.deg2rad(30)), np.cos(np.deg2rad(30)), 0])  # u east, v north
    expected = 60 * ARCSEC / np.sqrt(8 * np.log(2)) * along
    np.testing.assert_allclose(axes[0], expected, atol=1e-6 * np.abs(expected).max())


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (f"P1 {PLACE} 2 0 0 0 -0.8 0 0 0 0 1 150e6\n", "line 1: 18 values; a SAGECal.* has 17 a line, or 19"),
        (f"P1 {PLACE} 2 0 0 0 -0.8 0 1e-5 1e-5 0 150e6\n", "line 1: 'P1' is a point to SAGECal but has a size"),
        (f"G1 {PLACE} 2 0 0 0 -0.8 0 1e-5 1e-5 0 150e6\n", "line 1: 'G1' is a Gaussian to SAGECal"),
        (f"S3C61 {PLACE} 2 0 0 0 -0.8 0 1 1 0 150e6\n", "line 1: 'S3C61' is a shapelet to SAGECal"),
        ("P1 8 13 35.98 99 12 59.17 2 0 0 0 -0.8 0 0 0 0 150e6\n", "line 1: .* declination 99.2164 are beyond the sky"),
        (2 * f"P1 {PLACE} 2 0 0 0 -0.8 0 0 0 0 150e6\n", "line 2: source 'P1' was there before, on line 1"),
        (f"P1 {PLACE} 2 0 0 0 -0.8 0 0 0 0 150e6" + 10_000 * " 1", "line 1: more than 10,000 characters"),
        (f"P1 {PLACE} 2 0 0 0 -0.8 0 0 0 0 150e6\n" + 600_000 * "\n", "at most 500,000 are read"),
        ("#format: name ra_d dec_d\nA 1 2\n", "line 1: .*needs i"),
        ("#format: name ra_d ra_h dec_d i\nA 1 2 3 4\n", "line 1: .*needs one of ra_h, ra_d or ra_rad"),
        ("#format: name ra_d dec_d i pol_frac\nA 1 2 3 0.1\n", "line 1: column 'pol_frac' is not read; give q and u"),
        ("#format: name ra_d dec_d i\nA 1 2 3 4\n", "line 2: 5 values for the 4 columns"),
        ("#format: name ra_d dec_d i\nA 1 2 x\n", "line 2: i = 'x' is not a number"),
        ("#format: name ra_d dec_d i\nA 1 2 nan\n", "line 2: a value of 'A' is not finite"),
        ("#format: name ra_d dec_d i\n", "no source in it"),
        ("skymodel fileformat 1.1\n", "no source in it"),
        (AO[:-12], "line (20|21|22): the file ends where .* is due: it is cut off"),
        (AO.replace("type point", "type shapelet"), "line 15: type 'shapelet' cannot be kept"),
        (AO.replace("-0.8 0 }", "-0.8 0.1 }"), "line 12: '3C 196:1' has a curved spectrum"),
        (AO.replace("150 MHz", "150 m"), "line 9: unit 'm'; frequencies in MHz"),
        (AO.replace("Jy 2", "K 2"), "line 9: unit 'K'; .*fluxes in Jy"),
        (AO.replace("shape 60", "shape x"), "line 8: shape = 'x' is not a number"),
        (AO.replace("    shape 60 30 45\n", ""), "line 5: a gaussian without shape"),
        (AO.replace("position -0h10m00s", "position ten"), "line 17: Ra = 'ten' is not an angle"),
        (AO.replace("type point", "colour red"), "line 16: 'colour' in a component: known are type, position"),
        (AO.replace("    measurement {\n      frequency 0.2 GHz\n      fluxdensity Jy 3 0 0 0\n    }\n", 2 * (
            "measurement { frequency 0.2 GHz fluxdensity Jy 3 0 0 0 }\n")), "has fluxes at 2 frequencies; give it one"),
    ],
)  # fmt: skip
def test_what_a_program_s_model_gets_wrong_is_one_line(read, text, message):
    with pytest.raises(FileError, match=message) as caught:
        read(text)
    assert "\n" not in str(caught.value)


# SkyH5 -----------------------------------------------------------------------------------------------------------


@pytest.fixture
def skyh5(tmp_path):
    """A SkyH5 file as pyradiosky 1.1 lays it out; entries by path replace its own, `None` leaves one out."""

    def made(attrs=(), **changed):
        entries = {
            "Header/Ncomponents": 2,
            "Header/Nfreqs": 1,
            "Header/component_type": b"point",
            "Header/spectral_type": b"spectral_index",
            "Header/name": np.array([b"a", b"b"]),
            "Header/reference_frequency": np.array([150.0, 160.0]),
            "Header/spectral_index": np.array([-0.7, -0.8]),
            "Header/skycoord/frame": b"icrs",
            "Header/skycoord/ra": np.array([10.0, 20.0]),
            "Header/skycoord/dec": np.array([-30.0, 40.0]),
            "Data/stokes": np.array([[[1, 2]], [[0.1, 0]], [[-0.2, 0]], [[0.3, 0]]], float),
        } | {k.replace("__", "/"): v for k, v in changed.items()}
        units = {"reference_frequency": "MHz", "freq_array": "Hz", "ra": "deg", "dec": "deg", "l": "deg", "b": "deg"}
        with h5py.File(tmp_path / "m.skyh5", "w") as file:
            for path, value in entries.items():
                if value is not None:
                    file[path] = value
                    unit = (units | {"stokes": "Jy"} | dict(attrs)).get(path.rpartition("/")[2])
                    if unit:
                        file[path].attrs["unit"] = unit
        return tmp_path / "m.skyh5"

    return made


def test_skyh5_is_read_with_its_units(skyh5):
    sky = PointSky.read(skyh5())
    assert (sky.names, sky.patches, sky.reference_hz.tolist()) == (("a", "b"), (), [150e6, 160e6])
    np.testing.assert_allclose(np.rad2deg([sky.ra_rad, sky.dec_rad]), [[10, 20], [-30, 40]], rtol=1e-14)
    np.testing.assert_allclose(at(sky, 75)[0], 2**0.7 * np.array([1, 0.1, -0.2, -0.3]), rtol=1e-14)


def test_of_several_channels_of_skyh5_one_is_asked_for(skyh5):
    changed = {
        "Header__spectral_type": b"full", "Header__freq_array": np.array([100e6, 200e6]),
        "Header__reference_frequency": None, "Header__spectral_index": None,
        "Data__stokes": np.arange(16.0).reshape(4, 2, 2),
    }  # fmt: skip
    path = skyh5(**changed)
    with pytest.raises(FileError, match="has fluxes at 100, 200 MHz; say which with frequency='100 MHz'"):
        PointSky.read(path)
    with pytest.raises(FileError, match="has no fluxes at 150 MHz"):
        PointSky.read(path, frequency="150 MHz")
    sky = PointSky.read(path, frequency="200 MHz")
    assert (sky.stokes_jy.tolist(), sky.reference_hz.tolist()) == ([[2, 6, 10, -14], [3, 7, 11, -15]], [200e6, 200e6])


def test_galactic_places_are_brought_to_icrs_but_not_q_and_u(skyh5):
    from astropy.coordinates import SkyCoord

    frame = {
        "Header__skycoord__frame": b"galactic", "Header__skycoord__ra": None, "Header__skycoord__dec": None,
        "Header__skycoord__l": np.array([10.0, 20.0]), "Header__skycoord__b": np.array([-30.0, 40.0]),
    }  # fmt: skip
    with pytest.raises(FileError, match="Q and U of sources in galactic coordinates count from galactic north"):
        PointSky.read(skyh5(**frame))
    sky = PointSky.read(skyh5(**frame, Data__stokes=np.array([[[1, 2]], [[0, 0]], [[0, 0]], [[0, 0]]], float)))
    due = SkyCoord([10, 20], [-30, 40], unit="deg", frame="galactic").icrs
    np.testing.assert_allclose([sky.ra_rad, sky.dec_rad], [due.ra.rad, due.dec.rad], rtol=1e-14)


@pytest.mark.parametrize(
    ("attrs", "changed", "message"),
    [
        ({}, {"Header__component_type": b"healpix"}, "component_type is 'healpix': maps are read as HEALPix FITS"),
        ({}, {"Header__spectral_type": b"curved"}, "spectral_type 'curved' is none"),
        ({}, {"Header__reference_frequency": None}, "without reference_frequency"),
        ({"stokes": "K"}, {}, "stokes is in 'K', which is not convertible to Jy"),
        ({"ra": ""}, {}, "ra is in '', which is not convertible to rad"),
        ({}, {"Header__skycoord__frame": b"fk4"}, "positions are of 'fk4'; known are icrs, fk5, galactic"),
        ({}, {"Header__name": np.array([b"a"])}, "names has 1 entries for 2 sources"),
        ({}, {"Header__spectral_index": np.array([-0.7])}, "spectral_index has 1 entries for 2 sources"),
        ({}, {"Data__stokes": np.ones((3, 1, 2))}, "stokes is of shape .3, 1, 2., needed .4, channels, sources."),
        ({}, {"Data__stokes": np.ones((4, 3, 2))}, "3 channels of fluxes where spectral_type is 'spectral_index'"),
        ({}, {"Data__stokes": None, "Data__x": 1}, "there is no 'stokes'"),
        ({}, {"Header__skycoord__dec": np.array([-30, np.nan])}, "dec_rad of source 'b' is not finite"),
    ],
)  # fmt: skip
def test_what_a_skyh5_file_gets_wrong_is_one_line(skyh5, attrs, changed, message):
    with pytest.raises(FileError, match=message) as caught:
        PointSky.read(skyh5(attrs, **changed))
    assert "\n" not in str(caught.value)
    assert str(caught.value).startswith("m.skyh5")


def test_hdf5_of_something_else_is_no_sky(tmp_path):
    with h5py.File(tmp_path / "x.h5", "w") as file:
        file["data"] = 1
    with pytest.raises(FileError, match="is HDF5 but no SkyH5 file"):
        PointSky.read(tmp_path / "x.h5")
    (tmp_path / "cut.skyh5").write_bytes((tmp_path / "x.h5").read_bytes()[:200])
    with pytest.raises(FileError, match=r"cut.skyh5 is not a readable SkyH5 file"):
        PointSky.read(tmp_path / "cut.skyh5")
