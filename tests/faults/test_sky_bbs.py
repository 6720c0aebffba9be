"""A3, A4: BBS text as LSMTool, LiLF, LINC, prefactor and WSClean write it: read as DP3 does, written back, or told."""

import warnings

import numpy as np
import pytest

from instrument.errors import FileError, InstrumentWarning, UnusedWarning
from instrument.sky.bbs import write_bbs
from instrument.sky.points import PointSky

PLACE = "08:13:36, +48.13.03"
LSMTOOL = (
    "FORMAT = Name, Type, Patch, Ra, Dec, I, Q, U, V, MajorAxis, MinorAxis, Orientation, ReferenceFrequency='150e6', "
    "SpectralIndex='[]'"
)


@pytest.fixture
def bbs(tmp_path):
    def made(*lines, name="m.skymodel"):
        (tmp_path / name).write_text("\n".join(lines) + "\n")
        return PointSky.read(tmp_path / name)

    return made


@pytest.mark.parametrize("field", ["MajorAxis", "MinorAxis", "Orientation"])
def test_a3_a_point_with_a_list_under_an_axis_is_told(bbs, field):
    fields = {"MajorAxis": "", "MinorAxis": "", "Orientation": "", field: "[-0.26, -0.25]"}
    with pytest.raises(FileError, match=rf"line 3: Type is POINT but {field} = '\[-0.26, -0.25\]'.*columns"):
        bbs(LSMTOOL, ", , P, 08:13:36, +48.13.03", f"a, POINT, P, {PLACE}, 1, 0, 0, 0, {', '.join(fields.values())}")


def test_a3_axes_of_a_point_are_named_as_not_used(bbs):
    with pytest.warns(UnusedWarning, match=r"m.skymodel: not used: line 3 \(axes of a POINT\)"):
        sky = bbs(LSMTOOL, ", , P, 08:13:36, +48.13.03", f"a, POINT, P, {PLACE}, 1, 0, 0, 0, 10, 5, 0")
    assert not sky.gaussian.any()
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        bbs(LSMTOOL, ", , P, 08:13:36, +48.13.03", f"a, POINT, P, {PLACE}, 1, 0, 0, 0, 0, 0, 0")


TWICE = (
    "FORMAT = Name, Type, Patch, Ra, Dec, I",
    ", , CasA, 23:23:22, +58.50.16",
    ", , CygA, 19:59:25, +40.44.14",
    "s0, POINT, CasA, 23:23:20, +58.48.26, 3",
    "s0, POINT, CygA, 19:59:28, +40.44.02, 5",
    "s1, POINT, CygA, 19:59:29, +40.44.02, 7",
)


def test_a4_a_name_in_two_patches_is_made_unique_by_its_patch_and_written_back(bbs, tmp_path):
    with pytest.warns(InstrumentWarning, match="1 name stands in several patches.*'CygA:s0'"):
        sky = bbs(*TWICE)
    assert sky.names == ("s0", "CygA:s0", "s1")
    assert sky.stokes_jy[:, 0].tolist() == [3, 5, 7]
    write_bbs(tmp_path / "w.skymodel", sky)
    again = PointSky.read(tmp_path / "w.skymodel")
    assert (again.names, again.patches) == (sky.names, ("CasA", "CygA", "CygA"))
    np.testing.assert_array_equal(again.stokes_jy, sky.stokes_jy)


def test_a4_a_name_twice_in_one_patch_is_still_told(bbs):
    with pytest.raises(FileError, match="line 7: source 's1' was there before, on line 6"):
        bbs(*TWICE, "s1, POINT, CygA, 19:59:29, +40.44.02, 7")


@pytest.mark.parametrize("kind", ["POINT", "GAUSSIAN", "point"])
def test_a4_a_patch_line_may_carry_a_type(bbs, kind):
    sky = bbs(LSMTOOL, f", {kind}, P, 08:13:36, +48.13.03", f"a, POINT, P, {PLACE}, 2")
    assert (sky.names, sky.patches) == (("a",), ("P",))


def test_a4_a_flux_without_a_name_is_named_as_not_used(bbs):
    with pytest.warns(UnusedWarning, match=r"not used: line 2 \(a patch has no flux"):
        sky = bbs(LSMTOOL, ", POINT, P, 08:13:36, +48.13.03, 5", f"a, POINT, P, {PLACE}, 2")
    assert sky.stokes_jy[:, 0].tolist() == [2]


@pytest.mark.parametrize(
    ("ra", "dec", "ra_deg", "dec_deg"),
    [
        ("08:13:05.1e-12", "+48.13.05.1e-12", 15 * (8 + 13 / 60), 48 + 13 / 60),
        ("08:13:60.0", "+48.12.60.0", 15 * (8 + 14 / 60), 48 + 13 / 60),
        ("08:13:60", "-00.12.60", 15 * (8 + 14 / 60), -13 / 60),
        ("8h13m5.1e1s", "-0d13m2.5E1s", 15 * (8 + 13 / 60 + 51 / 3600), -(13 / 60 + 25 / 3600)),
    ],
)
def test_a4_seconds_are_read_as_programs_write_them(bbs, tmp_path, ra, dec, ra_deg, dec_deg):
    sky = bbs("FORMAT = Name, Type, Ra, Dec, I", f"a, POINT, {ra}, {dec}, 1")
    np.testing.assert_allclose(np.rad2deg([sky.ra_rad[0], sky.dec_rad[0]]), [ra_deg, dec_deg], rtol=1e-13)
    write_bbs(tmp_path / "w.skymodel", sky)
    np.testing.assert_allclose(PointSky.read(tmp_path / "w.skymodel").dec_rad, sky.dec_rad, rtol=1e-15)


@pytest.mark.parametrize("ra", ["08:13:61", "08:60:00", "08:13:1e3"])
def test_a4_other_seconds_are_not(bbs, ra):
    with pytest.raises(FileError, match="is not an angle"):
        bbs("FORMAT = Name, Type, Ra, Dec, I", f"a, POINT, {ra}, +48.13.03, 1")


def test_component_lists_of_wsclean_are_read(bbs):
    sky = bbs(
        "Format = Name, Type, Ra, Dec, I, SpectralIndex, LogarithmicSI, ReferenceFrequency='134475708.008', MajorAxis, "
        "MinorAxis, Orientation",
        "s0c0,POINT,08:28:05.152,39.35.08.511,0.000748810650400475,[-0.00695379313004673,-0.0849693907803257],false,"
        "125584411.621094,,,",
        "s1c0,GAUSSIAN,07:51:09.24,42.32.46.177,0.000660490865128381,[0.00404869217508666,-0.011844732049232],false,"
        "125584411.621094,83.6144111272856,83.6144111272856,0",
        name="wsclean-sources.txt",
    )
    y = 134475708.008 / 125584411.621094 - 1
    expected = 0.000748810650400475 - 0.00695379313004673 * y - 0.0849693907803257 * y**2
    assert sky.stokes(np.array([134475708.008]))[0, 0, 0] == pytest.approx(expected, rel=1e-12)
    assert sky.gaussian.tolist() == [False, True]


def test_fields_with_values_that_have_no_place_here_are_named(bbs):
    with pytest.warns(UnusedWarning, match="m.skymodel: not used: Category"):
        bbs("FORMAT = Name, Type, Category, Ra, Dec, I, dummy", f"a, POINT, 2, {PLACE}, 1, x")


def test_a_file_of_line_ends_takes_no_memory(tmp_path):
    (tmp_path / "m.skymodel").write_text("FORMAT = Name, Type, Ra, Dec, I\n" + "\n" * 600_000)
    with pytest.raises(FileError, match="600,002 lines; at most 500,000 are read"):
        PointSky.read(tmp_path / "m.skymodel")


def test_what_cannot_be_written_whole_is_not_written(tmp_path, bbs, monkeypatch):
    sky = bbs(*TWICE[:5:2], "s1, POINT, CygA, 19:59:29, +40.44.02, 7")
    target = tmp_path / "w.skymodel"
    target.write_text("before")
    monkeypatch.setattr("pathlib.Path.write_text", lambda *a, **k: (_ for _ in ()).throw(OSError(28, "disk full")))
    with pytest.raises(FileError, match="disk full"):
        write_bbs(target, sky, overwrite=True)
    assert target.read_text() == "before"
    assert sorted(p.name for p in tmp_path.iterdir()) == ["m.skymodel", "w.skymodel"]
