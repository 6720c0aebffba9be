"""A1, A2, A9 and what is no data: catalogues as programs and surveys write them are read right, or say what is open."""

import gzip
import warnings

import numpy as np
import pytest
from astropy import units as u
from astropy.io import fits
from astropy.table import MaskedColumn, Table

from instrument.errors import FileError, InputError, InstrumentWarning, UnusedWarning, unused_ledger
from instrument.observe.directions import LIGHT
from instrument.sky.points import PointSky
from instrument.sky.readers import Catalogue
from instrument.sky.sources import FWHM_TO_SIGMA
from instrument.units import Direction

ARCSEC = np.deg2rad(1 / 3600)
PLACE = {"RA": [123.4] * u.deg, "DEC": [48.2175] * u.deg}


@pytest.fixture
def text(tmp_path):
    def made(*lines, name="t.csv", **told):
        (tmp_path / name).write_text("\n".join(lines) + "\n")
        return quiet(tmp_path / name, **told)

    return made


def quiet(path, **told):
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", InstrumentWarning)
        return PointSky.read(path, **told)


def flux(sky, mhz, stokes=0):
    return sky.stokes(np.array([mhz * 1e6]))[0, :, stokes]


def visibility(sky, metres, mhz):
    """|V| of each source on baselines (metres) along north, at the centre of its own field."""
    if not sky.gaussian.any():
        return np.ones((len(metres), len(sky)))
    turns = np.asarray(metres) * mhz * 1e6 / LIGHT
    sigma = FWHM_TO_SIGMA * sky.major_rad
    return np.exp(-2 * np.pi**2 * sigma**2 * turns[:, None] ** 2)


def pybdsf(tmp_path, freq=150e6, **more):
    columns = {
        "Source_id": [7], **PLACE, "E_RA": [1e-5] * u.deg, "Total_flux": [1.0] * u.Jy, "E_Total_flux": [0.1] * u.Jy,
        "Peak_flux": [0.9] * u.Jy / u.beam, "Maj": [120.0] * u.arcsec, "Min": [120.0] * u.arcsec, "PA": [10.0] * u.deg,
        "Isl_rms": [1e-3] * u.Jy / u.beam, "S_Code": ["S"], **more,
    }  # fmt: skip
    table = Table({k: v for k, v in columns.items() if v is not None})
    path = tmp_path / "p.srl.fits"
    hdu = fits.BinTableHDU(table)
    first = fits.PrimaryHDU()
    if freq:
        first.header["FREQ0"] = freq
    fits.HDUList([first, hdu]).writeto(path, overwrite=True)
    return path


DECONVOLVED = {"DC_Maj": [0.0] * u.arcsec, "DC_Min": [0.0] * u.arcsec, "DC_PA": [0.0] * u.deg}


def test_a1_fitted_sizes_are_not_used_where_deconvolved_ones_are(tmp_path):
    sky = quiet(pybdsf(tmp_path, **DECONVOLVED))
    assert visibility(sky, [371, 1121, 1405], 150).ravel().tolist() == [1, 1, 1]
    assert not sky.gaussian.any()
    sized = quiet(pybdsf(tmp_path, DC_Maj=[60.0] * u.arcsec, DC_Min=[30.0] * u.arcsec, DC_PA=[40.0] * u.deg))
    np.testing.assert_allclose([sized.major_rad[0], sized.minor_rad[0]], [60 * ARCSEC, 30 * ARCSEC], rtol=1e-12)
    assert np.rad2deg(sized.angle_rad[0]) == pytest.approx(40)


def test_a1_where_only_fitted_sizes_are_there_it_is_asked(tmp_path):
    path = pybdsf(tmp_path)
    with pytest.raises(FileError, match=r"Maj, Min are sizes fitted to an image.*sizes='points'.*beam='6 arcsec'"):
        quiet(path)
    assert not quiet(path, sizes="points").gaussian.any()
    assert quiet(path, sizes="as given").major_rad[0] == pytest.approx(120 * ARCSEC)
    # 120 arcsec seen with a beam of 72 are 96 (96, 72, 120 is 12 times 8, 6, 10)
    assert quiet(path, beam="72 arcsec").major_rad[0] == pytest.approx(96 * ARCSEC, rel=1e-9)
    assert not quiet(path, beam="120 arcsec").gaussian.any()
    with pytest.warns(UnusedWarning, match="Peak_flux"):
        again = Catalogue(path=str(path), beam="72 arcsec").about(Direction(2.0, 0.8))
    assert again.major_rad[0] == pytest.approx(96 * ARCSEC, rel=1e-9)


def test_a1_unmarked_sizes_are_said_to_be_taken_as_they_are(tmp_path):
    (tmp_path / "t.csv").write_text("ra_deg,dec_deg,i_jy,maj_arcsec,min_arcsec,pa_deg\n1,2,3,60,30,10\n")
    with pytest.warns(InstrumentWarning, match="taken as sizes of the sources themselves; if they hold the beam"):
        sky = PointSky.read(tmp_path / "t.csv")
    assert sky.major_rad[0] == pytest.approx(60 * ARCSEC)


def test_a1_a_beam_of_each_source_is_taken_out_as_its_matrix_of_second_moments(tmp_path):
    # GLEAM: what was fitted is the true shape convolved with the psf; built here by adding the matrices
    def matrix(a, b, pa):
        c, s = np.cos(np.deg2rad(pa)), np.sin(np.deg2rad(pa))
        turn = np.array([[c, s], [-s, c]])
        return turn.T @ np.diag([a**2, b**2]) @ turn

    true, psf = (100.0, 40.0, 25.0), (140.0, 120.0, -60.0)
    values, vectors = np.linalg.eigh(matrix(*true) + matrix(*psf))
    angle = np.rad2deg(np.arctan2(vectors[1, 1], vectors[0, 1]))
    table = Table(
        {
            "Name": ["a"], "RAJ2000": [10.0] * u.deg, "DEJ2000": [-20.0] * u.deg, "peak_flux_wide": [1.0],
            "int_flux_wide": [1.1] * u.Jy, "a_wide": [values[1] ** 0.5] * u.arcsec,
            "b_wide": [values[0] ** 0.5] * u.arcsec, "pa_wide": [angle] * u.deg, "psf_a_wide": [psf[0]] * u.arcsec,
            "psf_b_wide": [psf[1]] * u.arcsec, "psf_pa_wide": [psf[2]] * u.deg, "int_flux_076": [2.0] * u.Jy,
            "alpha": [-0.8], "int_flux_fit_200": [1.0] * u.Jy,
        }
    )  # fmt: skip
    table.write(tmp_path / "g.fits")
    sky = quiet(tmp_path / "g.fits")
    np.testing.assert_allclose([sky.major_rad[0] / ARCSEC, sky.minor_rad[0] / ARCSEC], true[:2], rtol=1e-9)
    assert np.rad2deg(sky.angle_rad[0]) % 180 == pytest.approx(25, abs=1e-6)
    assert flux(sky, 100)[0] == pytest.approx(2**0.8, rel=1e-12)  # of the fit at 200 MHz, not of the wide band


def test_a2_an_index_called_alpha_is_read(text):
    sky = text("ra_deg,dec_deg,i_jy,ref_freq_mhz,alpha", "123.4,48.2,1,150,-0.8")
    assert flux(sky, 75)[0] == pytest.approx(1.741, abs=5e-4)


def test_a2_indices_and_polarization_of_pybdsf_are_read(tmp_path):
    more = {"Spec_Indx": [-0.8], "Total_Q": [0.1] * u.Jy, "Total_U": [-0.2] * u.Jy, "Total_V": [0.05] * u.Jy}
    sky = quiet(pybdsf(tmp_path, **DECONVOLVED, **more))
    assert flux(sky, 75)[0] == pytest.approx(2**0.8, rel=1e-12)  # from FREQ0 of the header
    assert sky.stokes_jy[0].tolist() == [1.0, 0.1, -0.2, 0.05]
    assert sky.names == ("7",)


def test_a2_a_frequency_that_is_nowhere_is_asked_for(tmp_path):
    path = pybdsf(tmp_path, freq=None, **DECONVOLVED, Spec_Indx=[-0.8])
    with pytest.raises(FileError, match=r"spectral_index needs a column ref_freq .*or frequency='150 MHz'"):
        quiet(path)
    assert flux(quiet(path, frequency="75 MHz"), 75)[0] == 1.0
    with pytest.raises(InputError, match="frequency = 0 Hz must be above 0"):
        quiet(path, frequency="0 Hz")


def test_a2_whatever_was_not_read_is_named(tmp_path):
    (tmp_path / "t.csv").write_text("ra_deg,dec_deg,i_jy,e_i_jy,log_curv\n1,2,3,0.1,5\n")
    with pytest.warns(UnusedWarning, match="t.csv: not used: e_i_jy, log_curv"), unused_ledger() as ledger:
        sky = PointSky.read(tmp_path / "t.csv")
    assert ledger == {"t.csv": ["e_i_jy", "log_curv"]}
    assert sky.not_read == ("t.csv: e_i_jy, log_curv",)
    assert PointSky.join(sky, sky).select([1]).not_read == sky.not_read


def test_a2_a_misspelt_column_is_refused_where_its_meaning_is_missing(text):
    with pytest.raises(FileError, match="did you mean 'rotation_measure'"):
        text("ra_deg,dec_deg,i_jy,rotation_measur", "1,2,3,4")


# Surveys ---------------------------------------------------------------------------------------------------------


def test_lotss_is_at_144_mhz_with_its_deconvolved_sizes(text):
    sky = text(
        "Source_Name,RA,E_RA,DEC,E_DEC,Peak_flux,Total_flux,Maj,Min,DC_Maj,DC_Min,PA,DC_PA,Isl_rms,S_Code,Mosaic_ID",
        "ILTJ1,10,0.2,50,0.2,5,1500,7,6.5,3.6,2.5,30,31,0.1,S,P1",
        "ILTJ2,11,0.2,50,0.2,5,3,6,6,0,0,30,30,0.1,S,P1",
    )
    assert (sky.names, sky.reference_hz.tolist()) == (("ILTJ1", "ILTJ2"), [144e6, 144e6])
    np.testing.assert_allclose(sky.stokes_jy[:, 0], [1.5, 0.003])
    np.testing.assert_allclose(np.rad2deg(sky.ra_rad), [10, 11])
    np.testing.assert_allclose(sky.major_rad / ARCSEC, [3.6, 0])
    assert np.rad2deg(sky.angle_rad[0]) == pytest.approx(31)


def test_tgss_has_the_beam_of_its_declination_taken_out(text):
    south = -31.0  # 25 arcsec / cos(50 deg) from north to south
    long = 25 / np.cos(np.deg2rad(50))
    sky = text(
        "Source_name,RA,E_RA,DEC,E_DEC,Total_flux,E_Total_flux,Peak_flux,E_Peak_flux,Maj,E_Maj,Min,E_Min,PA,E_PA,"
        "RMS_noise,Source_code,Mosaic_name",
        f"T1,10,1,{south},1,200,20,150,15,{np.hypot(long, 30)},1,{np.hypot(25, 30)},1,0,1,3,S,R1",
        "T2,10,1,50,1,200,20,150,15,25,1,25,1,0,1,3,S,R1",
    )
    np.testing.assert_allclose(sky.major_rad / ARCSEC, [30, 0], rtol=1e-9, atol=1e-6)
    np.testing.assert_allclose(sky.minor_rad / ARCSEC, [30, 0], rtol=1e-9, atol=1e-6)
    assert sky.reference_hz[0] == 147.5e6
    assert sky.stokes_jy[0, 0] == pytest.approx(0.2)


NVSS = ("#Column NVSS", "NVSS\tRAJ2000\tDEJ2000\tS1.4\tl_MajAxis\tMajAxis\tl_MinAxis\tMinAxis\tPA",
        "\t\"h:m:s\"\t\"d:m:s\"\tmJy\t\tarcsec\t\tarcsec\tdeg", "\t".join("---------"))  # fmt: skip


def test_nvss_sizes_that_are_upper_limits_are_points(text):
    sky = text(
        *NVSS, "081336+481303\t08 13 36.05\t+48 13 02.9\t13900.1\t<\t14.0\t<\t13.2\t ",
        "081400-001500\t08 14 00.00\t-00 15 00.0\t50\t \t40.0\t<\t20.0\t-30",
        name="nvss.tsv",
    )  # fmt: skip
    np.testing.assert_allclose(np.rad2deg(sky.ra_rad), [15 * (8 + 13 / 60 + 36.05 / 3600), 123.5], rtol=1e-13)
    np.testing.assert_allclose(np.rad2deg(sky.dec_rad), [48 + 13 / 60 + 2.9 / 3600, -0.25], rtol=1e-13)
    np.testing.assert_allclose(sky.stokes_jy[:, 0], [13.9001, 0.05])
    np.testing.assert_allclose(sky.major_rad / ARCSEC, [0, 40])
    np.testing.assert_allclose(sky.minor_rad / ARCSEC, [0, 0])
    assert np.rad2deg(sky.angle_rad[1]) == pytest.approx(-30)
    assert sky.reference_hz[0] == 1.4e9


def test_nvss_without_its_limits_is_asked_about(text):
    with pytest.raises(FileError, match="upper limits where l_MajAxis says '<'"):
        text("RAJ2000,DEJ2000,S1.4,MajAxis,MinAxis,PA", "10,20,50,14,13,0")
    assert text("RAJ2000,DEJ2000,S1.4,MajAxis,MinAxis,PA", "10,20,50,14,13,", sizes="points").stokes_jy[0, 0] == 0.05


def test_first_has_deconvolved_sizes_under_the_plain_names(text):
    sky = text(
        "RA,DEC,SIDEPROB,FPEAK,FINT,RMS,MAJOR,MINOR,POSANG,FITTED_MAJOR,FITTED_MINOR,FITTED_POSANG,FLDNAME",
        "10,20,0.01,5,6,0.1,3,1,40,6.2,5.5,44,f1",
    )
    np.testing.assert_allclose([sky.major_rad[0], sky.minor_rad[0]], [3 * ARCSEC, ARCSEC])
    assert (sky.stokes_jy[0, 0], sky.reference_hz[0]) == (pytest.approx(0.006), 1.4e9)
    vizier = text("FIRST,RAJ2000,DEJ2000,Fpeak,Fint,Rms,Maj,Min,PA,fMaj,fMin,fPA", "J1,10,20,5,6,0.1,3,1,40,6.2,5.5,44")
    assert vizier.major_rad[0] == pytest.approx(3 * ARCSEC)
    assert vizier.names == ("J1",)


def test_gleam_of_vizier_takes_the_measured_flux_where_the_fit_has_failed(tmp_path):
    table = Table(
        {
            "GLEAM": ["a", "b"], "RAJ2000": [10.0, 11] * u.deg, "DEJ2000": [-20.0, -21] * u.deg,
            "Fintwide": [1.1, 0.5] * u.Jy, "awide": [150.0, 150] * u.arcsec, "bwide": [130.0, 130] * u.arcsec,
            "pawide": [0.0, 0] * u.deg, "psfawide": [150.0, 150] * u.arcsec, "psfbwide": [130.0, 130] * u.arcsec,
            "psfPAwide": [0.0, 0] * u.deg, "alpha": MaskedColumn([-0.8, 0], mask=[False, True]),
            "Fintfit200": MaskedColumn([1.0, 0.0], mask=[False, True], unit="Jy"),
        }
    )  # fmt: skip
    table.write(tmp_path / "g.vot", format="votable")
    with pytest.raises(FileError, match=r"row 2: alpha is empty; give the value .*'leave out', 'no effect'"):
        quiet(tmp_path / "g.vot")
    sky = quiet(tmp_path / "g.vot", incomplete="no effect")
    np.testing.assert_allclose(flux(sky, 100), [2**0.8, 0.5])
    assert not sky.gaussian.any()
    assert quiet(tmp_path / "g.vot", incomplete="leave out").names == ("a",)


def test_vlss_is_at_74_mhz_in_jansky(text):
    sky = text("VLSS;RAJ2000;DEJ2000;Si;l_MajAx;MajAx;l_MinAx;MinAx;PA", "a;08 13 36.0;+48 13 03;133;<;30;<;25;")
    assert (sky.stokes_jy[0, 0], sky.reference_hz[0], sky.major_rad[0]) == (133, 73.8e6, 0)


def test_the_text_of_pybdsf_has_its_heading_in_a_comment(text):
    lines = (
        "# Source list for field.fits", "# Generated by PyBDSM version 1.10", "# Reference frequency of the detection "
        '("ch0") image: 1.5000e+08 Hz', "# Equinox : 2000.0 ", "",
        "# Source_id  Isl_id  RA  DEC  Total_flux  Maj  Min  PA  DC_Maj  DC_Min  DC_PA  Isl_rms  S_Code  Spec_Indx",
        "0 0 123.4 48.2 1.0 0.033 0.033 10 0.01 0.005 20 0.001 S -0.8",
    )  # fmt: skip
    sky = text(*lines)
    np.testing.assert_allclose([sky.major_rad[0], sky.minor_rad[0]], np.deg2rad([0.01, 0.005]))
    assert flux(sky, 75)[0] == pytest.approx(2**0.8, rel=1e-12)
    with pytest.raises(FileError, match="positions are of equinox 1950"):
        text(*(line.replace("2000.0", "1950.0") for line in lines))


def test_a9_the_text_of_pyradiosky_is_read(text):
    sky = text(
        "SOURCE_ID\tRA_J2000 [deg]\tDec_J2000 [deg]\tFlux [Jy]\tFrequency [Hz]\tSpectral_Index",
        "J1\t123.40000000\t48.20000000\t2.00000000\t150000000.00000000\t-0.80000000",
        name="sky.txt",
    )
    assert (sky.names, flux(sky, 75)[0]) == (("J1",), pytest.approx(2 * 2**0.8, rel=1e-12))


def test_a9_oskar_is_read_with_everything_it_says(text):
    sky = text("# RA, Dec, I, Q, U, V, f0, alpha, RM, major, minor, PA", "123.4 48.2 2", name="a.osm")
    assert flux(sky, 75)[0] == 2.0
    sky = text("123.4, 48.2, 2, 0.2, 0, 0.1, 150e6, -0.8, 3, 60, 30, 45  # one", name="a.osm")
    got = sky.stokes(np.array([75e6]))[0, 0]
    turn = 2 * 3 * (LIGHT / 75e6) ** 2 * (1 - 0.25)
    expected = 2**0.8 * np.array([2, 0.2 * np.cos(turn), 0.2 * np.sin(turn), 0.1])
    np.testing.assert_allclose(got, expected, rtol=1e-12)
    assert (sky.major_rad[0], np.rad2deg(sky.angle_rad[0])) == (pytest.approx(60 * ARCSEC), pytest.approx(45))


@pytest.mark.parametrize(
    ("name", "content", "message"),
    [
        ("t.lsm.html", "<HTML><BODY>\n<!-- Tigger sky model -->\n", "is a Tigger sky model.*tigger-convert"),
        ("w.txt", "SOURCE a P 1 G 0 S 0 0\nCOMPONENT POINT 4.0 -27.0\n", "is a source list of RTS or WODEN"),
        ("h.yaml", "super_sweet_source1:\n- ra: 10.0\n  dec: -27.0\n  comp_type: point\n", "hyperdrive source list"),
        ("j.json", '[\n{"name": "Cas A", "ra": "23h23m24s"}]', "is JSON"),
        ("r.reg", "# Region file format: DS9 version 4.1\nfk5\n", "is a ds9 region file"),
        ("c.txt", "# cluster\n1 2 P1C1 P2C1\n-2 1 P3C1\n", "is a cluster file of SAGECal"),
        ("u.csv", "ra,dec\n", "no column for i"),
    ],
)  # fmt: skip
def test_a9_another_programs_model_is_called_by_its_name_with_the_way_out(tmp_path, name, content, message):
    (tmp_path / name).write_bytes(content.encode("latin-1"))
    with pytest.raises(FileError, match=message) as caught:
        PointSky.read(tmp_path / name)
    assert "\n" not in str(caught.value)


# No data is not zero ---------------------------------------------------------------------------------------------


@pytest.mark.parametrize("value", ["", "nan", "NaN", "--", "null", "-999", "-99.0", "-9999", "inf"])
def test_a_placeholder_is_no_spectral_index(text, value):
    lines = ("ra_deg,dec_deg,i_jy,ref_freq_mhz,spectral_index", "1,2,3,150,-0.7", f"4,5,6,150,{value}")
    with pytest.raises(FileError, match=r"line 3: spectral_index is .*give the value \(0 for none\)"):
        text(*lines)
    assert text(*lines, incomplete="leave out").names == ("s0",)
    assert flux(text(*lines, incomplete="no effect"), 75)[1] == 6.0


@pytest.mark.parametrize(("column", "value"), [("i_jy", "-99"), ("ra_deg", "-999"), ("dec_deg", "-99"), ("i_jy", "")])
def test_a_place_or_flux_that_is_no_data_has_no_default(text, column, value):
    row = {"ra_deg": "1", "dec_deg": "2", "i_jy": "3", column: value}
    for incomplete in ("refuse", "no effect"):
        with pytest.raises(FileError, match=f"line 2: {column} is"):
            text(",".join(row), ",".join(row.values()), "5,6,7", incomplete=incomplete)
    assert len(text(",".join(row), ",".join(row.values()), "5,6,7", incomplete="leave out")) == 1


def test_numbers_that_may_be_meant_are_no_placeholders(text):
    sky = text("ra_deg,dec_deg,i_jy,ref_freq_mhz,rm,major_arcsec,minor_arcsec,pa_deg", "-99,2,999,150,-99,99,9,-99")
    assert sky.stokes_jy[0, 0] == 999
    assert (sky.rotation_measure[0], np.rad2deg(sky.angle_rad[0])) == (-99, pytest.approx(-99))


def test_indices_that_rise_are_asked_about(tmp_path):
    (tmp_path / "t.csv").write_text("ra_deg,dec_deg,i_jy,ref_freq_mhz,alpha\n" + "1,2,3,150,0.7\n" * 4)
    with pytest.warns(InstrumentWarning, match=r"most spectral indices are positive \(median 0.7\)"):
        PointSky.read(tmp_path / "t.csv")


def test_positions_in_hours_and_in_degrees_do_not_stand_in_one_column(text):
    with pytest.raises(FileError, match="ra is written as hh:mm:ss and as a plain number"):
        text("ra,dec,i_jy", "08:13:36,+48:13:03,1", "123.4,48:13:03,1")
    sky = text("ra,dec,i_jy", "08h13m36s,-00d13m03s,1", "123d24m00s,48 13 03,1")
    np.testing.assert_allclose(np.rad2deg(sky.ra_rad), [123.4, 123.4], rtol=1e-14)
    assert np.rad2deg(sky.dec_rad[0]) == pytest.approx(-0.2175, rel=1e-13)


def test_a_packed_catalogue_is_read(tmp_path):
    (tmp_path / "t.csv.gz").write_bytes(gzip.compress(b"ra_deg,dec_deg,i_jy\n1,2,3\n"))
    assert len(PointSky.read(tmp_path / "t.csv.gz")) == 1
