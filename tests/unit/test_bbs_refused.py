"""BBS text: what a file gets wrong is told with its line; what is written reads back, and nothing is lost silently."""

import numpy as np
import pytest

from instrument.errors import FileError, InputError
from instrument.sky.bbs import write_bbs
from instrument.sky.points import PointSky

FREQ = np.array([120e6, 150e6, 177e6])
HEADER = "FORMAT = Name, Type, Ra, Dec, I"
PLACE = "08:13:36, +48.13.03"
ROTATING = "RotationMeasure, PolarizedFraction, PolarizationAngle, ReferenceWavelength"
POLARISED = f"{HEADER}, Q, U, ReferenceFrequency, SpectralIndex, {ROTATING}"
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
def test_what_bbs_text_gets_wrong_is_told_with_its_line(tmp_path, lines, message):
    (tmp_path / "m.skymodel").write_text("\n".join(lines) + "\n")
    with pytest.raises(FileError, match=message) as caught:
        PointSky.read(tmp_path / "m.skymodel")
    assert str(caught.value).startswith("m.skymodel")
    assert "\n" not in str(caught.value)


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
    again = PointSky.read(tmp_path / "w.skymodel")
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
    again = PointSky.read(tmp_path / "w.skymodel")
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
