"""Readers: files of the package, tables with their units, catalogues with a model, and each refusal."""

import numpy as np
import pytest
from astropy import units as u
from astropy.table import MaskedColumn, Table

import instrument
from instrument.component import Component
from instrument.errors import FileError, InputError
from instrument.sky.points import PointSky
from instrument.sky.readers import Catalogue
from instrument.units import Direction

CENTRE = Direction(np.deg2rad(123.4), np.deg2rad(48.2175))
ARCSEC = np.deg2rad(1 / 3600)


@pytest.fixture
def table(tmp_path):
    def made(*lines):
        (tmp_path / "t.csv").write_text("\n".join(lines) + "\n")
        return PointSky.read(tmp_path / "t.csv")

    return made


@pytest.mark.parametrize(("mhz", "jansky"), [(150, 83.1326), (134, 89.90), (166, 77.37), (174, 74.80)])
def test_the_model_of_3c196_has_its_published_total(mhz, jansky):
    total = PointSky.read("3c196_pandey.skymodel").stokes(np.array([mhz * 1e6]))[0, :, 0].sum()
    assert total == pytest.approx(jansky, abs=0.005 if mhz != 150 else 1e-10)


def test_an_axis_called_major_may_be_the_shorter_one():
    sky = PointSky.read("3c196_pandey.skymodel", CENTRE)
    assert sky.names[3] == "3C196B2"
    assert sky.major_rad[3] / ARCSEC == pytest.approx(1.456, rel=1e-12)
    assert sky.minor_rad[3] / ARCSEC == pytest.approx(2.159, rel=1e-12)
    # the source is 4 arcsec from the phase centre: its north is that of the centre to 0.01 deg
    assert np.rad2deg(sky.angle_rad[3]) == pytest.approx(324.58, abs=0.01)
    assert sky.patches == ("3C196",) * 4


def test_every_sky_of_the_package_reads():
    sums = {
        "calibrators_scaife_heald_2012.skymodel": 9,
        "3c196_field_sagecal_143mhz.skymodel": 10,
        "mock_150mhz.csv": 4567,
    }
    assert {name: len(PointSky.read(name)) for name in sums} == sums


def test_the_mock_catalogue_reads_with_its_units():
    sky = PointSky.read("mock_150mhz.csv")
    assert sky.names[:2] == ("1", "2")
    assert np.rad2deg(sky.ra_rad[1]) == pytest.approx(120.396792, abs=1e-12)
    assert sky.stokes_jy[1].tolist() == [7.7, 0, 0, 0]
    assert sky.reference_hz[0] == 150e6
    assert sky.stokes(np.array([300e6]))[0, 1, 0] == pytest.approx(7.7 * 2**-0.75, rel=1e-14)


def test_a_file_on_disk_wins_over_one_of_the_package(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "mock_150mhz.csv").write_text("ra_deg,dec_deg,i_jy\n1,2,3\n")
    assert len(PointSky.read("mock_150mhz.csv")) == 1


def full_table():
    return Table(
        {
            "Name": ["a", "b"],
            "RA": [10.0, 20.0] * u.deg,
            "DEC": [0.5, -0.5] * u.rad,
            "Total_flux": [1500.0, 2.0] * u.mJy,
            "Q": [0.1, 0.2] * u.Jy,
            "spectral_index": [-0.7, -0.8],
            "ref_freq": [150.0, 144.0] * u.MHz,
            "Maj": [1.0, 0.0] * u.arcmin,
            "Min": [30.0, 0.0] * u.arcsec,
            "PA": [45.0, 0.0] * u.deg,
            "rotation_measure": [3.0, 0.0] * u.rad / u.m**2,
            "E_RA": [1.0, 2.0] * u.arcsec,
        }
    )


@pytest.mark.parametrize(
    ("name", "form"), [("t.ecsv", "ascii.ecsv"), ("t.fits", "fits"), ("t.vot", "votable"), ("t.xml", "votable")]
)
def test_tables_bring_their_units(tmp_path, name, form):
    full_table().write(tmp_path / name, format=form)
    sky = PointSky.read(tmp_path / name)
    assert sky.names == ("a", "b")
    np.testing.assert_allclose(np.rad2deg(sky.ra_rad), [10, 20], rtol=1e-14)
    np.testing.assert_allclose(sky.dec_rad, [0.5, -0.5], rtol=1e-14)
    np.testing.assert_allclose(sky.stokes_jy[:, :2], [[1.5, 0.1], [0.002, 0.2]], rtol=1e-14)
    np.testing.assert_allclose(sky.reference_hz, [150e6, 144e6])
    np.testing.assert_allclose(sky.major_rad / ARCSEC, [60, 0])
    np.testing.assert_allclose(sky.minor_rad / ARCSEC, [30, 0])
    np.testing.assert_allclose(np.rad2deg(sky.angle_rad), [45, 0])
    assert sky.rotation_measure.tolist() == [3, 0]
    assert sky.spectral_terms.tolist() == [[-0.7], [-0.8]]


def test_suffixes_of_csv_columns_are_units(table):
    sky = table(
        "# a comment",
        "name,ra_deg,dec_rad,i_mjy,v_jy,major_arcsec,minor_arcmin,pa_deg,ref_freq_ghz,spectral_index,spectral_curvature,patch",
        '"a, b",10,0.5,1500,0.1,60,0.5,45,0.15,-0.7,0.1,p',
    )
    assert (sky.names, sky.patches) == (("a, b",), ("p",))
    np.testing.assert_allclose(sky.stokes_jy, [[1.5, 0, 0, 0.1]])
    np.testing.assert_allclose([sky.major_rad[0], sky.minor_rad[0]], [60 * ARCSEC, 30 * ARCSEC])
    assert sky.spectral_terms.tolist() == [[-0.7, 0.1]]
    assert sky.reference_hz[0] == pytest.approx(150e6)


GOOD = "ra_deg,dec_deg,i_jy"


@pytest.mark.parametrize(
    ("lines", "message"),
    [
        (["ra_deg,dec_deg,s74_jy", "1,2,3"], "t.csv: no column for i .*it has ra_deg, dec_deg, s74_jy"),
        ([f"{GOOD},flux_mjy", "1,2,3,4"], "columns 'i_jy' and 'flux_mjy' both mean i; remove one"),
        ([f"{GOOD},i_jy", "1,2,3,4"], "line 1: two columns of one name"),
        (["ra,dec_deg,i_jy", "1,2,3"], "column 'ra' has no unit; name it like ra_deg"),
        (["ra_mhz,dec_deg,i_jy", "1,2,3"], "column 'ra_mhz' is in 'MHz', which is not convertible to rad"),
        (["# note", GOOD, "1,2,nan"], "line 3: i_jy is nan, which is not finite"),
        ([GOOD, "1,2,3", "", "1,,3"], "line 4: dec_deg is empty"),
        ([GOOD, "1,2,<3"], "line 2: i_jy = '<3' is not a number"),
        ([GOOD, "1,2"], "line 2: 2 values for the 3 columns"),
        ([GOOD, "500,2,3"], "line 2: ra_deg = 500 is beyond the sky"),
        ([GOOD, "1,2,3", "5,-91,3"], "line 3: dec_deg = -91 is beyond the sky"),
        ([GOOD], "t.csv: no source in it"),
        (["# nothing"], "only comments in it"),
        ([""], "the file is empty"),
        ([f"{GOOD},spectral_index", "1,2,3,4"], r"column spectral_index needs a column ref_freq"),
        ([f"{GOOD},spectral_curvature,ref_freq_hz", "1,2,3,4,5"], "spectral_curvature needs a column spectral_index"),
        ([f"{GOOD},major_deg", "1,2,3,4"], "column major needs a column minor"),
        ([f"{GOOD},minor_deg", "1,2,3,4"], "column minor needs a column major"),
        ([f"{GOOD},major_deg,minor_deg", "1,2,3,4,5"], "column major needs a column angle"),
        ([f"{GOOD},major_deg,minor_deg", "1,2,3,-4,-4"], "major_rad of source 's0' is negative"),
        ([f"{GOOD},spectral_indx", "1,2,3,4"], "column 'spectral_indx' is not known; did you mean 'spectral_index'"),
    ],
)
def test_what_a_table_gets_wrong_is_told_with_its_line(table, lines, message):
    with pytest.raises(FileError, match=message) as caught:
        table(*lines)
    assert str(caught.value).startswith("t.csv")
    assert "\n" not in str(caught.value)


def test_a_masked_value_is_told_with_its_row(tmp_path):
    t = full_table()
    t["Q"] = MaskedColumn([0.1, 0.2], mask=[False, True], unit="Jy")
    t.write(tmp_path / "t.fits")
    with pytest.raises(FileError, match=r"t.fits, row 2: Q is empty"):
        PointSky.read(tmp_path / "t.fits")
    t.write(tmp_path / "t.ecsv")
    with pytest.raises(FileError, match=r"t.ecsv, line \d+: Q is empty"):
        PointSky.read(tmp_path / "t.ecsv")


def test_a_unit_that_contradicts_the_name_of_its_column_is_refused(tmp_path):
    t = full_table()
    t.rename_column("RA", "ra_arcsec")
    t.write(tmp_path / "t.ecsv")
    with pytest.raises(FileError, match="column 'ra_arcsec' is in 'deg' by its unit but not by its name"):
        PointSky.read(tmp_path / "t.ecsv")


@pytest.mark.parametrize(
    ("name", "content", "message"),
    [
        ("t.fits", b"SIMPLE  = broken", "not a fits table that astropy reads"),
        ("t.vot", b"<?xml version='1.0'?><VOTABLE>", "not a votable table that astropy reads"),
        ("t.ecsv", b"# %ECSV 1.0\n# ---\n# datatype: [\nra", "the ECSV header does not parse"),
        ("t.csv", b"ra_deg\n\xff\n", "t.csv, line 2: not UTF-8 text"),
    ],
)
def test_broken_files_are_told(tmp_path, name, content, message):
    (tmp_path / name).write_bytes(content)
    with pytest.raises(FileError, match=message) as caught:
        PointSky.read(tmp_path / name)
    assert "\n" not in str(caught.value)


def test_files_that_are_not_there_are_told(tmp_path):
    with pytest.raises(FileError, match=r"nor among those of the package: did you mean '3c196_pandey.skymodel'"):
        PointSky.read("3c196_pandy.skymodel")
    with pytest.raises(FileError, match="is a folder; name the file in it"):
        PointSky.read(tmp_path)


def test_a_model_replaces_the_sources_at_its_place():
    whole = PointSky.read("mock_150mhz.csv")
    sky = instrument.load("skies", "catalogue", path="mock_150mhz.csv", model="3c196_pandey.skymodel").about(CENTRE)
    assert sky.names == PointSky.read("3c196_pandey.skymodel").names + whole.names[1:]
    assert sky.patches == ("3C196",) * 4 + ("",) * 4566
    assert sky.stokes_jy[:, 0].sum() == pytest.approx(whole.stokes_jy[:, 0].sum(), abs=1e-9)


def test_the_brightest_count_a_model_as_one_source():
    settings = {"path": "mock_150mhz.csv", "model": "3c196_pandey.skymodel"}
    assert Catalogue(**settings, brightest=5).about(CENTRE).names[4:] == ("2", "3", "4", "5")
    assert len(Catalogue(**settings, brightest=1).about(CENTRE)) == 4
    assert Catalogue(path="mock_150mhz.csv", brightest=3).about(CENTRE).names == ("1", "2", "3")


def test_a_model_fainter_than_the_brightest_is_left_out(tmp_path):
    (tmp_path / "c.csv").write_text(f"name,{GOOD}\nx,10,0,90\ny,123.4,48.2175,80\nz,20,0,100\nw,30,0,1\n")
    settings = {"path": str(tmp_path / "c.csv"), "model": "3c196_pandey.skymodel"}
    assert Catalogue(**settings, brightest=2).about(CENTRE).names == ("x", "z")
    assert Catalogue(**settings, brightest=3).about(CENTRE).names == (
        "x",
        "3C196A1",
        "3C196A2",
        "3C196B1",
        "3C196B2",
        "z",
    )


def test_a_catalogue_gives_orientations_from_its_phase_centre(tmp_path):
    (tmp_path / "m.skymodel").write_text(
        "FORMAT = Name, Type, Ra, Dec, I, MajorAxis, MinorAxis, Orientation\n"
        "a, GAUSSIAN, 130deg, 50deg, 1, 60, 20, 33\n"
    )
    sky = Catalogue(path=str(tmp_path / "m.skymodel"))
    expected = PointSky.read(tmp_path / "m.skymodel", CENTRE).angle_rad[0]
    assert sky.about(CENTRE).angle_rad[0] == expected
    assert np.rad2deg(expected) == pytest.approx(33 + 6.6 * np.sin(np.deg2rad(49)), abs=0.1)
    assert sky.about(CENTRE) is sky.about(CENTRE)


def test_a_catalogue_goes_through_json():
    sky = Catalogue(path="mock_150mhz.csv", brightest=7, match=1 * u.arcmin)
    assert Component.from_json(sky.to_json()) == sky


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"model": "3c196_pandey.skymodel", "match": 1 * u.arcsec}, "model '3C196' is not one source"),
        ({"model": "calibrators_scaife_heald_2012.skymodel"}, "is not one source"),
        ({"brightest": 0}, "brightest = 0"),
    ],
)
def test_impossible_catalogues_are_refused(settings, message):
    with pytest.raises(InputError, match=message):
        Catalogue(path="mock_150mhz.csv", **settings).about(CENTRE)


def test_a_model_with_nothing_to_replace_is_refused(tmp_path):
    (tmp_path / "c.csv").write_text(f"{GOOD}\n124,48.2175,90\n")
    with pytest.raises(
        InputError, match=r"no source within 30 arcsec of model '3C196' to be replaced; the nearest is 1.44e"
    ):
        Catalogue(path=str(tmp_path / "c.csv"), model="3c196_pandey.skymodel").about(CENTRE)


def test_a_centre_that_is_not_a_direction_is_refused():
    with pytest.raises(InputError, match="centre = 'north' is not a direction"):
        PointSky.read("3c196_pandey.skymodel", "north")
