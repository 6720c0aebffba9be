"""Skies in the columns of surveys and source finders: what is written is read as the same sky, or refused."""

import csv
import warnings

import numpy as np
import pytest
from astropy.io import fits
from astropy.table import Table

from instrument.errors import InputError, InstrumentWarning, UnusedWarning
from instrument.sky.columns import SURVEYS, meaning_of, survey_of
from instrument.sky.points import PointSky
from instrument.sky.presets import PRESETS, held
from instrument.sky.table_sky import moments, tgss_beam

ENDINGS = (".csv", ".ecsv", ".fits")
ARCSEC = np.deg2rad(1 / 3600)
FREQ = 123456789.0123


def sky(title, count=30, seed=2):
    """Points and Gaussians of random bits, with all that the preset holds."""
    rng = np.random.default_rng(seed)
    has = held(PRESETS[title])
    point = rng.uniform(size=count) < 0.3
    stokes = np.zeros((count, 4))
    stokes[:, : 4 if "polarization" in has else 1] = rng.lognormal(size=(count, 4 if "polarization" in has else 1))
    fields = {"spectral_terms": rng.normal(-0.7, 0.1, (count, 1))} if "spectral index" in has else {}
    return PointSky(
        names=tuple(str(k + 5) for k in range(count)),
        ra_rad=rng.uniform(-np.pi, np.pi, count),  # half of them beyond the 0 to 360 deg of a catalogue
        dec_rad=rng.uniform(-0.9, 1.5, count),
        stokes_jy=stokes,
        reference_hz=np.full(count, PRESETS[title].freq_hz or FREQ),
        major_rad=np.where(point, 0, rng.uniform(1, 60, count) * ARCSEC),
        minor_rad=np.where(point, 0, rng.uniform(1, 60, count) * ARCSEC),  # half of them longer than the major
        angle_rad=rng.uniform(-3, 3, count),
        **fields,
    )


def read(path, **told):
    with warnings.catch_warnings(action="ignore", category=UnusedWarning):
        return PointSky.read(path, **told)


@pytest.mark.parametrize("ending", ENDINGS)
@pytest.mark.parametrize("title", PRESETS)
def test_what_is_written_in_a_preset_is_read_as_the_same_sky(tmp_path, title, ending):
    there = sky(title)
    with warnings.catch_warnings(action="error"):
        there.write(tmp_path / f"s{ending}", preset=title.lower())
    back = read(tmp_path / f"s{ending}")
    assert back.names == there.names
    np.testing.assert_allclose(back.ra_rad, there.ra_rad % (2 * np.pi), rtol=1e-15, atol=0)
    np.testing.assert_allclose(back.dec_rad, there.dec_rad, rtol=1e-15, atol=0)
    np.testing.assert_allclose(back.stokes_jy, there.stokes_jy, rtol=1e-15, atol=0)
    if there.spectral_terms is not None:
        assert back.spectral_terms.tolist() == there.spectral_terms.tolist()
        assert back.reference_hz.tolist() == there.reference_hz.tolist()
    beam = tgss_beam(there.dec_rad)[0] if title == "TGSS" else 0
    shapes = [np.array(moments(s.major_rad, s.minor_rad, s.angle_rad)) for s in (there, back)]
    allowed = 1e-14 * (np.maximum(there.major_rad, there.minor_rad) ** 2 + beam**2)
    assert np.all(np.abs(shapes[1] - shapes[0]) <= allowed)
    assert back.gaussian.tolist() == there.gaussian.tolist()


@pytest.mark.parametrize("ending", ENDINGS)
@pytest.mark.parametrize("title", PRESETS)
def test_columns_and_units_are_those_of_the_catalogue(tmp_path, title, ending):
    sky(title).write(tmp_path / f"s{ending}", preset=title)
    if ending == ".csv":
        with open(tmp_path / "s.csv", newline="") as file:
            rows = list(csv.DictReader(line for line in file if not line.startswith("#")))
        names, units = list(rows[0]), None
    else:
        table = Table.read(tmp_path / f"s{ending}")
        names, units = table.colnames, {n: str(table[n].unit) for n in table.colnames if table[n].unit}
    survey = PRESETS[title]
    assert " ".join(names) == survey.published
    assert survey_of(names) is survey
    if units is not None:
        flux = {"TGSS": "mJy", "LoTSS": "mJy", "NVSS": "mJy", "FIRST": "mJy"}.get(title, "Jy")
        assert {units[n] for n in names if meaning_of(n, survey)[0] == "i"} == {flux}
        assert {units[n] for n in names if meaning_of(n, survey)[0] in ("ra", "dec")} == {"deg"}


def test_every_survey_that_is_read_can_be_written():
    assert {survey.title for survey in PRESETS.values()} == {survey.title for survey in SURVEYS}


def test_sizes_of_tgss_hold_its_beam_and_those_of_the_others_do_not(tmp_path):
    there = PointSky(names=("a",), ra_rad=[1], dec_rad=[0.6], stokes_jy=[[2, 0, 0, 0]])
    there = there.with_fields(major_rad=[60 * ARCSEC], minor_rad=[0], angle_rad=[np.pi / 2])
    there.write(tmp_path / "t.fits", preset="TGSS")
    row = Table.read(tmp_path / "t.fits")[0]
    np.testing.assert_allclose([row["Maj"], row["Min"], row["PA"] % 180], [65, 25, 90], rtol=1e-12)  # 60, 25, 65
    assert row["Total_flux"] == pytest.approx(2000, rel=1e-15)
    there.write(tmp_path / "l.fits", preset="LoTSS")
    row = Table.read(tmp_path / "l.fits")[0]
    np.testing.assert_allclose([row["DC_Maj"], row["DC_Min"], row["DC_PA"]], [60, 0, 90], rtol=1e-12)
    assert np.ma.is_masked(row["Isl_rms"])


def test_fluxes_are_brought_to_the_frequency_of_the_survey(tmp_path):
    there = PointSky(names=("1", "2"), ra_rad=[1, 2], dec_rad=[0, 0], stokes_jy=[[2, 0, 0, 0], [3, 0, 0, 0]])
    there = there.with_fields(reference_hz=[150e6, 200e6], spectral_terms=[[-0.8], [-0.7]])
    there.write(tmp_path / "g.ecsv", preset="GLEAM")
    table = Table.read(tmp_path / "g.ecsv")
    assert table["int_flux_wide"].tolist() == [2 * (200 / 150) ** -0.8, 3]
    there.write(tmp_path / "p.fits", preset="PyBDSF")
    assert fits.getheader(tmp_path / "p.fits", 1)["FREQ0"] == 150e6
    for name in ("g.ecsv", "p.fits"):
        freq = np.array([75e6, 300e6])
        np.testing.assert_allclose(read(tmp_path / name).stokes(freq), there.stokes(freq), rtol=1e-14)


def test_names_and_patches_that_a_table_has_no_columns_for_are_said(tmp_path):
    there = PointSky(names=("a", "b"), patches=("p", "q"), ra_rad=[1, 2], dec_rad=[0, 0], stokes_jy=np.eye(2, 4) + 1)
    with pytest.warns(InstrumentWarning, match=r"PyBDSF has no columns for patches and names \(its sources have num"):
        there.write(tmp_path / "p.csv", preset="PyBDSF")
    assert read(tmp_path / "p.csv").names == ("0", "1")


GIVEN = {"names": ("a",), "ra_rad": [1.0], "dec_rad": [0.5], "stokes_jy": [[1, 0, 0, 0]], "reference_hz": [1e8]}


@pytest.mark.parametrize(
    ("title", "name", "fields", "message"),
    [
        ("LoTSS", "s.csv", {"stokes_jy": [[1, 0, 0, 0.1]]}, "source 'a' has polarization, which LoTSS cannot hold; wr"),
        ("NVSS", "s.fits", {"spectral_terms": [[-0.7]]}, "source 'a' has a spectrum, which NVSS cannot hold; write it"),
        ("GLEAM", "s.csv", {"spectral_terms": [[-0.7, 0.1]]}, "has more than 1 spectral term, which GLEAM cannot hold"),
        ("PyBDSF", "s.csv", {"rotation_measure": [2.0]}, "source 'a' has a rotation measure, which PyBDSF cannot"),
        ("PyBDSF", "s.csv", {"spectral_terms": [[-0.7]], "logarithmic": [False]}, "linear spectral terms, which PyBDS"),
        ("TGSS", "s.csv", {"dec_rad": [-1.4]}, "source 'a' lies below -71 deg, where TGSS ADR1 has no beam"),
        ("LoTSS", "s.ecsv", {"names": (" a",)}, "LoTSS does not give source ' a' back as it is"),
        ("LoTSS", "s.csv", {"stokes_jy": [[-0.099, 0, 0, 0]]}, "cannot be written as LoTSS: .* stands for 'no data'"),
        ("LoTSS", "s.fits", {"names": ("\u03b1",)}, "source '\u03b1': FITS holds names of ASCII alone; rename it"),
        ("LoTSS", "s\0.csv", {}, "a name of a file holds no null byte"),
        ("LOTS", "s.csv", {}, "preset = 'LOTS' is none: did you mean 'LoTSS'"),
        ("LoTSS", "s.skymodel", {}, "s.skymodel: the name of a table of LoTSS ends in .csv, .ecsv, .fits"),
        (None, "s.fits", {}, "the name of a sky ends in .* or .fits with a preset"),
    ],
)  # fmt: skip
def test_what_a_preset_cannot_hold_is_refused_and_nothing_is_left(tmp_path, title, name, fields, message):
    with pytest.raises(InputError, match=message) as caught:
        PointSky(**(GIVEN | fields)).write(tmp_path / name, preset=title)
    assert "\n" not in str(caught.value)
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("ending", ENDINGS)
def test_nothing_is_overwritten_unless_it_is_said(tmp_path, ending):
    (tmp_path / f"s{ending}").write_text("mine")
    with pytest.raises(InputError, match="exists"):
        PointSky(**GIVEN).write(tmp_path / f"s{ending}", preset="LoTSS")
    assert (tmp_path / f"s{ending}").read_text() == "mine"
    PointSky(**GIVEN).write(tmp_path / f"s{ending}", overwrite=True, preset="LoTSS")
    assert len(read(tmp_path / f"s{ending}")) == 1
