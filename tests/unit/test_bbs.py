"""BBS text: every form of the format against values worked out by hand."""

import warnings

import numpy as np
import pytest
from astropy import units as u
from astropy.coordinates import Angle, SkyCoord

from instrument.errors import InstrumentWarning
from instrument.observe.directions import LIGHT, lmn, offset
from instrument.sky.points import PointSky
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
        return PointSky.read(tmp_path / name, centre)

    return made


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


def test_defaults_fill_empty_and_missing_fields_and_fixed_values_have_no_place_in_the_line(bbs):
    sky = bbs(
        "FORMAT = Name, Ra, Dec, dummy, V=fixed'0.5', I='7', ReferenceFrequency=\"150e6\", SpectralIndex='[-0.7, 0.1]'",
        f"a, {PLACE}, ignored",
        f"b, {PLACE}, , 2, 100e6, []",
    )
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
    lines += ["a, GAUSSIAN, 123deg, 50deg, 1, 60, 20, 33"]
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
