"""Readers: BBS text and tables against values worked out by hand, each refusal, and what is written read back."""

import warnings

import numpy as np
import pytest
from astropy import units as u
from astropy.coordinates import Angle, SkyCoord
from astropy.table import MaskedColumn, Table

import instrument
from instrument.component import Component
from instrument.errors import FileError, InputError, InstrumentWarning
from instrument.observe.directions import LIGHT, lmn, offset
from instrument.sky.bbs import write_bbs
from instrument.sky.points import PointSky
from instrument.sky.readers import Catalogue, read
from instrument.units import Direction

CENTRE = Direction(np.deg2rad(123.4), np.deg2rad(48.2175))
FREQ = np.array([120e6, 150e6, 177e6])
ARCSEC = np.deg2rad(1 / 3600)
HEADER = "FORMAT = Name, Type, Ra, Dec, I"
PLACE = "08:13:36, +48.13.03"


@pytest.fixture
def bbs(tmp_path):
    def made(*lines, centre=None, name="m.skymodel"):
        (tmp_path / name).write_text("\n".join(lines) + "\n")
        return read(tmp_path / name, centre)

    return made


@pytest.fixture
def table(tmp_path):
    def made(*lines):
        (tmp_path / "t.csv").write_text("\n".join(lines) + "\n")
        return read(tmp_path / "t.csv")

    return made


# ---- files of the package


@pytest.mark.parametrize(("mhz", "jansky"), [(150, 83.1326), (134, 89.90), (166, 77.37), (174, 74.80)])
def test_the_model_of_3c196_has_its_published_total(mhz, jansky):
    total = PointSky.read("3c196_pandey.skymodel").stokes(np.array([mhz * 1e6]))[0, :, 0].sum()
    assert total == pytest.approx(jansky, abs=0.005 if mhz != 150 else 1e-10)


def test_an_axis_called_major_may_be_the_shorter_one():
    sky = read("3c196_pandey.skymodel", CENTRE)
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
    assert {name: len(read(name)) for name in sums} == sums


def test_the_mock_catalogue_reads_with_its_units():
    sky = read("mock_150mhz.csv")
    assert sky.names[:2] == ("1", "2")
    assert np.rad2deg(sky.ra_rad[1]) == pytest.approx(120.396792, abs=1e-12)
    assert sky.stokes_jy[1].tolist() == [7.7, 0, 0, 0]
    assert sky.reference_hz[0] == 150e6
    assert sky.stokes(np.array([300e6]))[0, 1, 0] == pytest.approx(7.7 * 2**-0.75, rel=1e-14)


def test_a_file_on_disk_wins_over_one_of_the_package(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "mock_150mhz.csv").write_text("ra_deg,dec_deg,i_jy\n1,2,3\n")
    assert len(read("mock_150mhz.csv")) == 1


# ---- BBS text


@pytest.mark.parametrize(
    "header",
    [
        "FORMAT = Name, Type, Ra, Dec, I, Q, U, V",
        "# (Name, Type, Ra, Dec, I, Q, U, V) = format",
        "  format=NAME,type,rA,dEC,i,q,u,v",
        "#(name,TYPE,ra,dec,I,Q,U,V)=FORMAT",
    ],
)
def test_both_spellings_of_the_format_line_read_alike(bbs, header):
    sky = bbs("# a comment", "", header, f"a, POINT, {PLACE}, 1, 2, 3, 4")
    assert sky.stokes_jy.tolist() == [[1, 2, 3, 4]]
    assert np.rad2deg(sky.ra_rad[0]) == pytest.approx(123.4, abs=1e-12)
    assert np.rad2deg(sky.dec_rad[0]) == pytest.approx(48.2175, abs=1e-12)


def test_without_a_format_line_the_fields_stand_in_their_usual_order(bbs):
    sky = bbs(f"a, GAUSSIAN, {PLACE}, 1, 2, 3, 4, 30, 20, 10", f"b, POINT, {PLACE}, 5", centre=CENTRE, name="m.txt")
    assert sky.stokes_jy.tolist() == [[1, 2, 3, 4], [5, 0, 0, 0]]
    assert (sky.major_rad / ARCSEC).tolist() == pytest.approx([30, 0])
    assert np.rad2deg(sky.angle_rad[0]) == pytest.approx(10, abs=1e-9)


def test_defaults_fill_empty_and_missing_fields_and_fixed_values_win(bbs):
    sky = bbs(
        "FORMAT = Name, Ra, Dec, dummy, V=fixed'0.5', I='7', ReferenceFrequency=\"150e6\", SpectralIndex='[-0.7, 0.1]'",
        f"a, {PLACE}, ignored, 9",
        f"b, {PLACE}, , , 2, 100e6, []",
    )
    # a fixed field takes no place in the lines of DP3's reader either way: it stands in the line and is not read
    assert sky.stokes_jy[:, [0, 3]].tolist() == [[7, 0.5], [2, 0.5]]
    assert sky.reference_hz.tolist() == [150e6, 100e6]
    assert sky.spectral_terms.tolist() == [[-0.7, 0.1], [0, 0]]


def test_quotes_and_brackets_hold_commas(bbs):
    sky = bbs(
        "FORMAT = Name, Type, Ra, Dec, SpectralIndex, I, ReferenceFrequency",
        f"'a, b', POINT, {PLACE}, [ -0.7 , 0.2 ], 3, 1e8",
    )
    assert sky.names == ("a, b",)
    assert sky.spectral_terms.tolist() == [[-0.7, 0.2]]


def test_patches_group_their_sources_and_the_others_stand_alone(bbs):
    sky = bbs(
        "FORMAT = Name, Type, Patch, Ra, Dec, I",
        f", , P1, {PLACE}",
        ", , P2",
        f"a, POINT, P1, {PLACE}, 1",
        f"b, POINT, , {PLACE}, 1",
        f"c, POINT, P2, {PLACE}, 1",
    )
    assert sky.patches == ("P1", "", "P2")
    assert bbs(HEADER, f"a, POINT, {PLACE}, 1").patches == ()


@pytest.mark.parametrize(
    "text", ["08:13:36.5", "-01:30:00.25", "123.4deg", "-2.1 rad", "1.5e2 deg", "08h13m36.5s", "00:00:00"]
)
def test_right_ascensions_read_in_every_form(bbs, text):
    degrees = bbs(HEADER, f"a, POINT, {text}, 0deg, 1").ra_rad[0]
    expected = Angle(text, unit=u.hourangle if ":" in text else None)
    assert degrees == pytest.approx(expected.rad, abs=1e-15)


@pytest.mark.parametrize(
    ("text", "astropy"),
    [
        ("+48.13.03.25", "48d13m03.25s"),
        ("-00.30.15", "-0d30m15s"),
        ("48d13m03s", "48d13m03s"),
        ("-0.5rad", "-0.5rad"),
        ("90.00.00", "90d"),
    ],
)
def test_declinations_read_in_every_form(bbs, text, astropy):
    assert bbs(HEADER, f"a, POINT, 0deg, {text}, 1").dec_rad[0] == pytest.approx(Angle(astropy).rad, abs=1e-15)


def test_positions_read_from_their_parts(bbs):
    sky = bbs(
        "FORMAT = Name, rah, ram, ras, decd, decm, decs, I", "a, 8, 13, 36, -0, 30, 18, 1", "b, -1, 30, 0, 5, 0, 0, 1"
    )
    np.testing.assert_allclose(np.rad2deg(sky.ra_rad), [123.4, -22.5], atol=1e-12)
    np.testing.assert_allclose(np.rad2deg(sky.dec_rad), [-0.505, 5], atol=1e-12)


@pytest.mark.parametrize("flag", ["false", "False", "0"])
def test_linear_spectral_terms_are_in_jansky(bbs, flag):
    sky = bbs(
        f"{HEADER}, ReferenceFrequency='150e6', SpectralIndex, LogarithmicSI",
        f"a, POINT, {PLACE}, 5, , [2, -1], {flag}",
    )
    y = FREQ / 150e6 - 1
    np.testing.assert_allclose(sky.stokes(FREQ)[:, 0, 0], 5 + 2 * y - y**2, rtol=1e-14)


ROTATING = "RotationMeasure, PolarizedFraction, PolarizationAngle, ReferenceWavelength"
POLARISED = f"{HEADER}, Q, U, ReferenceFrequency, SpectralIndex, {ROTATING}"


@pytest.mark.parametrize("logarithmic", [True, False])
def test_fraction_and_angle_give_the_polarization_of_the_format(bbs, logarithmic):
    sky = bbs(f"{POLARISED}, LogarithmicSI='{logarithmic}'", f"a, POINT, {PLACE}, 5, , , 150e6, [-0.7], 3.2, 0.2, 0.4")
    intensity = 5 * (FREQ / 150e6) ** -0.7 if logarithmic else 5 - 0.7 * (FREQ / 150e6 - 1)
    expected = 0.2 * intensity * np.exp(2j * (0.4 + 3.2 * (LIGHT / FREQ) ** 2))
    stokes = sky.stokes(FREQ)[:, 0]
    # atol: phases of 40 rad in float64
    np.testing.assert_allclose(stokes[:, 1] + 1j * stokes[:, 2], expected, atol=1e-13)


@pytest.mark.parametrize("wavelength", ["", "2.5"])
def test_q_and_u_hold_at_the_reference_wavelength(bbs, wavelength):
    sky = bbs(POLARISED, f"a, POINT, {PLACE}, 5, 0.3, -0.4, 150e6, [-0.7], 3.2, , , {wavelength}")
    at = LIGHT / (float(wavelength) if wavelength else LIGHT / 150e6)
    np.testing.assert_allclose(sky.stokes(np.array([at]))[0, 0, 1:3], [0.3, -0.4], atol=1e-13)
    stokes = sky.stokes(FREQ)[:, 0]
    np.testing.assert_allclose(np.hypot(stokes[:, 1], stokes[:, 2]) / stokes[:, 0], 0.5 / (5 * (at / 150e6) ** -0.7))


def test_without_a_rotation_measure_only_i_changes_with_frequency(bbs):
    stokes = bbs(POLARISED, f"a, POINT, {PLACE}, 5, 0.3, -0.4, 150e6, [-0.7]").stokes(FREQ)[:, 0]
    np.testing.assert_array_equal(stokes[:, 1:], [[0.3, -0.4, 0]] * 3)
    assert stokes[0, 0] > 5.5


def test_sources_with_and_without_a_reference_frequency_stand_in_one_file(bbs):
    sky = bbs(
        POLARISED,
        f"a, POINT, {PLACE}, 5",
        f"b, POINT, {PLACE}, 5, , , , , 3.2, 0.2, 0.4",
        f"c, POINT, {PLACE}, 5, 0.3, 0.4, , , 3.2, , , 2.5",
    )
    stokes = sky.stokes(FREQ)
    linear = stokes[:, :, 1] + 1j * stokes[:, :, 2]
    squared = (LIGHT / FREQ) ** 2
    np.testing.assert_array_equal(stokes[:, :, 0], 5)
    np.testing.assert_allclose(linear[:, 1], np.exp(2j * (0.4 + 3.2 * squared)), atol=1e-13)
    np.testing.assert_allclose(linear[:, 2], (0.3 + 0.4j) * np.exp(6.4j * (squared - 2.5**2)), atol=1e-13)


def test_orientations_count_from_the_m_axis_of_the_phase_centre(bbs):
    ra, dec = offset(CENTRE, np.array([0.08, -0.06]), np.array([0.03, -0.05]))
    places = [f"{np.rad2deg(r)}deg, {np.rad2deg(d)}deg" for r, d in zip(ra, dec, strict=True)]
    # the source's own north, as seen in the l, m plane: a step of 1e-6 rad in declination
    here, there = (lmn(PointSky.at(SkyCoord(ra, dec + d, unit="rad"), [1.0, 1.0]).vectors, CENTRE) for d in (0, 1e-6))
    tilt = np.rad2deg(np.arctan2(*(there - here)[:, :2].T))
    lines = [f"s{k}, GAUSSIAN, {p}, 1, 60, 20, {t}" for k, (p, t) in enumerate(zip(places, tilt, strict=True))]
    sky = bbs(f"{HEADER}, MajorAxis, MinorAxis, Orientation", *lines, centre=CENTRE)
    # atol: the finite step
    np.testing.assert_allclose(sky.angle_rad, 0, atol=1e-5)
    # east of the centre its north leans west, by the convergence of the meridians
    assert tilt[0] == pytest.approx(-np.rad2deg(ra[0] - CENTRE.ra_rad) * np.sin(CENTRE.dec_rad), rel=0.05)


def test_absolute_orientations_are_kept(bbs):
    fields = f"{HEADER}, MajorAxis, MinorAxis, Orientation, OrientationIsAbsolute"
    sky = bbs(fields, "a, GAUSSIAN, 130deg, 50deg, 1, 60, 20, 33, true", centre=CENTRE)
    assert np.rad2deg(sky.angle_rad[0]) == pytest.approx(33, abs=1e-12)


def test_orientations_without_a_phase_centre_are_taken_at_the_source_with_a_warning(bbs):
    lines = [f"{HEADER}, MajorAxis, MinorAxis, Orientation"]
    lines += [f"a, GAUSSIAN, {x}deg, 50deg, 1, 60, 20, 33" for x in (123,)]
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert np.rad2deg(bbs(*lines).angle_rad[0]) == pytest.approx(33, abs=1e-12)
    with pytest.warns(
        InstrumentWarning, match=r"m.skymodel: 2 orientations count from the phase centre.*up to 1.5 deg"
    ):
        sky = bbs(*lines, "b, GAUSSIAN, 127deg, 50deg, 1, 60, 20, 33")
    np.testing.assert_allclose(np.rad2deg(sky.angle_rad), 33)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        bbs(lines[0], "a, GAUSSIAN, 123deg, 50deg, 1, 60, 60, 33", "b, GAUSSIAN, 127deg, 50deg, 1, 60, 60, 33")


GAUSS = f"{HEADER}, MajorAxis, MinorAxis, Orientation"


@pytest.mark.parametrize(
    ("lines", "message"),
    [
        ([HEADER, "a, POINT, 08:13:36, +48:13:03, 1"], r"line 2: Dec = '\+48:13:03' has colons"),
        ([HEADER, "a, POINT, 08:13:36, 48.2175, 1"], r"line 2: Dec = '48.2175' is not an angle; write \+dd.mm.ss.s"),
        ([HEADER, "a, POINT, 123.4, 48deg, 1"], "line 2: Ra = '123.4' is not an angle; write hh:mm:ss.s"),
        ([HEADER, "a, POINT, 08:63:36, 48deg, 1"], "Ra = '08:63:36' is not an angle"),
        ([HEADER, "a, POINT, 25:00:00, 48deg, 1"], "Ra of 375 deg lies beyond 360 deg"),
        ([HEADER, "a, POINT, 1deg, 91deg, 1"], "Dec of 91 deg lies beyond 90 deg"),
        ([HEADER, "a, POINT, 1deg, , 1"], "line 2: Dec of 'a' is missing"),
        (["FORMAT = Name, rah, rad, dec, I", "a, 1, 2, 3deg, 4"], "rah and rad are both given"),
        ([HEADER, f"a, POINT, {PLACE}"], "line 2: I is missing; give its value, or a default"),
        ([HEADER, f"a, POINT, {PLACE}, bright"], "line 2: I = 'bright' is not a number"),
        ([HEADER, f"a, POINT, {PLACE}, nan"], "line 2: I = 'nan' is not finite"),
        ([HEADER, f"a, POINT, {PLACE}, 1, 2"], "line 2: 6 values for the 5 fields"),
        ([HEADER, f"a, POINT, {PLACE}, [1"], "line 2: a bracket is not closed"),
        ([HEADER, f"a, POINT, {PLACE}, '1"], "line 2: a quote is not closed"),
        ([HEADER, f"a, DISK, {PLACE}, 1"], "line 2: Type = 'DISK' cannot be kept"),
        ([HEADER, f"a, SHAPELET, {PLACE}, 1"], "line 2: Type = 'SHAPELET' cannot be kept"),
        ([GAUSS, f"a, GAUSSIAN, {PLACE}, 1"], "line 2: MajorAxis is missing"),
        ([GAUSS, f"a, GAUSSIAN, {PLACE}, 1, 5, 4"], "line 2: Orientation is missing"),
        ([GAUSS, f"a, GAUSSIAN, {PLACE}, 1, 5, -4, 0"], "line 2: an axis of -4 arcsec is negative"),
        ([GAUSS, f"a, , {PLACE}, 1, 5, 4, 0"], "line 2: Type is empty but axes are given"),
        ([HEADER, f", , {PLACE}, 1"], "line 2: no Name"),
        ([HEADER, f"a, POINT, {PLACE}, 1", f"a, POINT, {PLACE}, 1"], "line 3: source 'a' was there before, on line 2"),
        (["FORMAT = Name, Patch, Ra, Dec, I", ", 3C196", f"a, 3C169, {PLACE}, 1"], "did you mean '3C196'"),
        (["FORMAT = Name, Patch, Ra, Dec, I", ", P", ", P"], "line 3: patch 'P' is defined twice"),
        (
            ["FORMAT = Name, SpectralIndx, Ra, Dec, I"],
            "line 1: unknown field 'SpectralIndx': did you mean 'SpectralIndex'",
        ),
        (["FORMAT = Name, Ra, Ra, Dec, I"], "field 'Ra' stands twice"),
        (["FORMAT = Name Ra Dec I", "a"], "not Field or Field='value', separated by commas"),
        (["FORMAT = Name, I='1, Ra"], "line 1: a quote is not closed"),
        ([HEADER, f"a, POINT, {PLACE}, 1", HEADER], "line 3: a format line after the first one"),
        ([HEADER], "m.skymodel: no source in it"),
        ([f"{HEADER}, RefType", f"a, POINT, {PLACE}, 1, B1950"], "RefType = 'B1950' is not J2000"),
        (
            [f"{HEADER}, SpectralIndex", f"a, POINT, {PLACE}, 1, [-0.7]"],
            "SpectralIndex needs a positive ReferenceFrequency",
        ),
        (
            [f"{HEADER}, SpectralIndex", f"a, POINT, {PLACE}, 1, [-0.7 0.1]"],
            "SpectralIndex = '-0.7 0.1' is not a number",
        ),
        (
            [f"{HEADER}, LogarithmicSI", f"a, POINT, {PLACE}, 1, maybe"],
            "LogarithmicSI = 'maybe' is neither true nor false",
        ),
        ([POLARISED, f"a, POINT, {PLACE}, 5, , , 150e6, , , 0.2"], "without RotationMeasure"),
        ([POLARISED, f"a, POINT, {PLACE}, 5, , , 150e6, , , , 0.2"], "without RotationMeasure"),
        ([POLARISED, f"a, POINT, {PLACE}, 5, 1, , 150e6, , 3"], "needs either Q and U, or PolarizedFraction"),
        (
            [POLARISED, f"a, POINT, {PLACE}, 5, 1, 1, 150e6, , 3, 0.1, 0.2"],
            "needs either Q and U, or PolarizedFraction",
        ),
        (
            [POLARISED, f"a, POINT, {PLACE}, 5, , , 150e6, , 3, 0.1, 0.2, 2"],
            "PolarizationAngle is that of wavelength 0",
        ),
        ([POLARISED, f"a, POINT, {PLACE}, 5, 1, 1, 150e6, , 3, , , -2"], "ReferenceWavelength = '-2' is negative"),
        ([POLARISED, f"a, POINT, {PLACE}, 5, 1, 1, , , 3"], "needs ReferenceFrequency or ReferenceWavelength"),
        (
            [f"{POLARISED}, V='1'", f"a, POINT, {PLACE}, 5, 1, 1, 150e6, [1], 3"],
            "V with RotationMeasure and SpectralIndex",
        ),
        ([POLARISED, f"a, POINT, {PLACE}, 0, 1, 1, 150e6, [1], 3"], "I = 0 with RotationMeasure and SpectralIndex"),
    ],
)
def test_what_bbs_text_gets_wrong_is_told_with_its_line(bbs, lines, message):
    with pytest.raises(FileError, match=message) as caught:
        bbs(*lines)
    assert str(caught.value).startswith("m.skymodel")
    assert "\n" not in str(caught.value)


# ---- written and read back


def rich_sky(count=40, seed=5):
    rng = np.random.default_rng(seed)
    shaped, log = rng.random(count) < 0.5, rng.random(count) < 0.5
    stokes = rng.normal(0, 1, (count, 4)) * [5, 1, 1, 0]
    follows = rng.random(count) < 0.5
    terms = rng.normal(0, 0.5, (count, 2)) * (rng.random(count) < 0.7)[:, None]
    flat = ~terms.any(axis=1)
    stokes[flat, 3] = 0.3
    return PointSky(
        names=tuple(f"src {k}" for k in range(count)),
        patches=tuple(f"patch{k % 3}" if k % 4 else "" for k in range(count)),
        ra_rad=rng.uniform(0, 2 * np.pi, count),
        dec_rad=np.arcsin(rng.uniform(-1, 1, count)),
        stokes_jy=stokes,
        reference_hz=rng.uniform(1e8, 2e8, count),
        spectral_terms=terms,
        logarithmic=log,
        rotation_measure=np.where(follows | flat, rng.normal(0, 5, count), 0.0),
        polarization_follows_i=follows,
        major_rad=np.where(shaped, rng.uniform(0, 1e-3, count), 0.0),
        minor_rad=np.where(shaped, rng.uniform(0, 1e-3, count), 0.0),
        angle_rad=np.where(shaped, rng.uniform(-3, 3, count), 0.0),
    )


def test_what_is_written_as_bbs_text_reads_back(tmp_path):
    sky = rich_sky()
    write_bbs(tmp_path / "w.skymodel", sky)
    again = read(tmp_path / "w.skymodel")
    assert (again.names, again.patches) == (sky.names, sky.patches)
    # rtol: degrees and arcsec and back in float64; fluxes and terms are written with all digits
    for field in ("ra_rad", "dec_rad", "major_rad", "minor_rad", "angle_rad"):
        np.testing.assert_allclose(getattr(again, field), getattr(sky, field), rtol=1e-14, err_msg=field)
    for field in ("stokes_jy", "reference_hz", "spectral_terms", "rotation_measure"):
        np.testing.assert_array_equal(getattr(again, field), getattr(sky, field), err_msg=field)
    np.testing.assert_array_equal(again.stokes(FREQ), sky.stokes(FREQ))


def test_a_plain_sky_reads_back_as_it_was(tmp_path):
    sky = PointSky(
        names=("a", "b"), ra_rad=[0.1, 6.0], dec_rad=[-1.0, 1.0], stokes_jy=[[1, 0.5, 0.25, -1], [-2, 0, 0, 0]]
    )
    write_bbs(tmp_path / "w.skymodel", sky)
    again = read(tmp_path / "w.skymodel")
    np.testing.assert_allclose(again.vectors, sky.vectors, atol=1e-15)
    assert again.with_fields(ra_rad=sky.ra_rad, dec_rad=sky.dec_rad) == sky


@pytest.mark.parametrize(
    ("fields", "message"),
    [
        ({"names": ("a,b",)}, "source name 'a,b' cannot be written"),
        ({"names": ("#a",)}, "source name '#a' cannot be written"),
        ({"patches": ("p]",)}, "patch name 'p]' cannot be written"),
        ({"rotation_measure": [1.0]}, "source 'a': BBS text has Q and U follow the spectrum of I"),
        ({"polarization_follows_i": [True], "stokes_jy": [[1, 0, 0, 1]]}, "V never"),
        (
            {"rotation_measure": [1.0], "spectral_terms": None, "stokes_jy": [[0, 1, 0, 0]]},
            "as a fraction of I, which is 0",
        ),
    ],
)
def test_what_bbs_text_cannot_hold_is_not_written(tmp_path, fields, message):
    start = {"names": ("a",), "ra_rad": [1], "dec_rad": [1], "stokes_jy": [[1, 1, 0, 0]], "reference_hz": [1e8]}
    with pytest.raises(InputError, match=message):
        write_bbs(tmp_path / "w.skymodel", PointSky(**(start | {"spectral_terms": [[-0.7]]} | fields)))
    assert not (tmp_path / "w.skymodel").exists()


def test_a_name_that_stands_twice_is_not_written(tmp_path):
    sky = PointSky(names=("a", "a"), ra_rad=[1, 2], dec_rad=[1, 1], stokes_jy=np.ones((2, 4)))
    with pytest.raises(InputError, match="source name 'a' stands twice"):
        write_bbs(tmp_path / "w.skymodel", sky)


# ---- tables


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
    sky = read(tmp_path / name)
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
        read(tmp_path / "t.fits")
    t.write(tmp_path / "t.ecsv")
    with pytest.raises(FileError, match=r"t.ecsv, line \d+: Q is empty"):
        read(tmp_path / "t.ecsv")


def test_a_unit_that_contradicts_the_name_of_its_column_is_refused(tmp_path):
    t = full_table()
    t.rename_column("RA", "ra_arcsec")
    t.write(tmp_path / "t.ecsv")
    with pytest.raises(FileError, match="column 'ra_arcsec' is in 'deg' by its unit but not by its name"):
        read(tmp_path / "t.ecsv")


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
        read(tmp_path / name)
    assert "\n" not in str(caught.value)


def test_files_that_are_not_there_are_told(tmp_path):
    with pytest.raises(FileError, match=r"nor among those of the package: did you mean '3c196_pandey.skymodel'"):
        read("3c196_pandy.skymodel")
    with pytest.raises(FileError, match="is a folder; name the file in it"):
        read(tmp_path)


# ---- Catalogue


def test_a_model_replaces_the_sources_at_its_place():
    whole = read("mock_150mhz.csv")
    sky = instrument.load("skies", "catalogue", path="mock_150mhz.csv", model="3c196_pandey.skymodel").about(CENTRE)
    assert sky.names == read("3c196_pandey.skymodel").names + whole.names[1:]
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
    (tmp_path / "m.skymodel").write_text(f"{GAUSS}\na, GAUSSIAN, 130deg, 50deg, 1, 60, 20, 33\n")
    sky = Catalogue(path=str(tmp_path / "m.skymodel"))
    expected = read(tmp_path / "m.skymodel", CENTRE).angle_rad[0]
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
        read("3c196_pandey.skymodel", "north")
